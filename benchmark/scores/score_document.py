"""Models of the score document, the JSON of one method's run (method, metrics, strata, worst images), and its maker.

The document names the SHA-256 of the records' file, and that of the results in them, which two equal runs share.
Numbers are in SI units; null stands where there is no number.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

import polars as pl
from pydantic import AfterValidator, Field, model_validator

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.beyond_images import excesses
from phibench.benchmark.scores.failure_causes import count, count_failures
from phibench.benchmark.scores.intervals import Estimate
from phibench.benchmark.scores.metrics import METRICS, MetricEstimate
from phibench.benchmark.scores.strata import (
    PairRange,
    Stratum,
    count_pairs,
    frame_numbers,
    light_distances,
    strata,
    stratum_metrics,
)
from phibench.benchmark.scores.worst_images import Worst
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import Name
from phibench.datasets.store.provenance import code_behind, program_version, provenance
from phibench.datasets.store.schema import Document

KIND: Literal["phibench score"] = "phibench score"
VERSION = 6
SCORER = "phibench.benchmark.scores.score"
"""Module whose code, with all that it imports, is behind a score."""


class Value(Document):
    """A metric: value and interval in the metric's unit; null where there is none, and `note` says why."""

    value: float | None
    low: float | None
    high: float | None
    n: int = Field(description="records")
    samples: int = Field(description="samples that the interval resamples")
    share: float | None = Field(description="of the visible spots, or pairs, that it rests on; null if on all of them")
    note: str

    @classmethod
    def of(cls, measured: MetricEstimate, **fields: str) -> Self:
        """From a measurement, and the fields that a subclass has besides."""
        e = measured.estimate
        numbers = {"value": finite(e.value), "low": finite(e.low), "high": finite(e.high)}
        return cls.model_validate(
            {
                **numbers,
                **fields,
                "n": measured.n,
                "samples": measured.samples,
                "share": finite(measured.share),
                "note": e.note,
            }
        )

    @property
    def estimate(self) -> Estimate:
        """The same with NaN for null."""
        value, low, high = (math.nan if x is None else x for x in (self.value, self.low, self.high))
        return Estimate(value, low, high, self.note)


class MetricDescription(Value):
    """A metric of the whole, with what it is; the unit is also in the metric's name."""

    unit: str
    better: Literal["lower", "higher", "none"]
    text: str


class StratumScore(Document):
    """Metrics of one stratum; edges are null where the stratum is a value or open."""

    by: str
    label: str
    low: float | None
    high: float | None
    mean: float | None = Field(description="of what the stratum is by, over its images")
    images: int
    pairs: int
    metrics: Mapping[str, Value]


Division = Literal["closed", "open"]
DIVISIONS: tuple[Division, ...] = get_args(Division)


@dataclass(frozen=True)
class Declared:
    """Statement of a method's author on it, which nobody can check.

    Attributes
    ----------
    division : "closed", "open" or None
        Closed: tuned on dev alone. None says nothing: a method of one's own is then open.
    self_calibrates : bool
        The method corrects the rig from the pictures that it gets.

    Raises
    ------
    DatasetError
        If there is no such division.
    """

    division: Division | None = None
    self_calibrates: bool = False

    def __post_init__(self) -> None:
        if self.division not in (None, *DIVISIONS):
            raise DatasetError(f"division {self.division!r}: give {' or '.join(DIVISIONS)} (docs/submission.md)")

    def fields(self, kind: str) -> dict[str, Any]:
        """Fields of a card; none of a built-in method, of which phibench says it."""
        division = {} if self.division is None else {"division": self.division}
        return {} if kind == BUILT_IN else {**division, "self_calibrates": self.self_calibrates}


BUILT_IN = "built-in"


class MethodCard(Document):
    """Identity of a method: reference, place, hash of its code (null if it cannot be told), and what it ran with."""

    reference: Name
    name: Name = Field(default="", description="by default what follows the last slash of the reference")
    kind: Name = ""
    place: Name = ""
    function: Name = ""
    sha256: Name | None = None
    version: Name | None = None
    modules: dict[Name, Name] = Field(
        default={}, description="SHA-256 of the files beside the method's that it imports"
    )
    packages: dict[Name, Name | None] = Field(
        default={}, description="version of each package that its process loaded; null of a module of no package"
    )
    files: dict[Name, Name | None] = Field(
        default={}, description="SHA-256 of further files opened in its folder and under --allow; null: not hashed"
    )
    files_complete: bool = Field(default=False, description="all files that were opened there are known")
    sees: Literal["image", "pair", ""] = Field(
        default="", description="each image by itself, or both as one point; empty if that is not known"
    )
    division: Division = Field(
        default="open", description="closed: tuned on dev alone, by its author's word; by default of built-in methods"
    )
    self_calibrates: bool = Field(default=False, description="corrects the rig from the pictures, by the same word")

    @classmethod
    def of(cls, reference: str, **fields: Any) -> MethodCard:
        """Of a reference and what is known of it."""
        return cls.model_validate({**fields, "reference": reference})

    @model_validator(mode="before")
    @classmethod
    def _defaults(cls, fields: Any) -> Any:
        if not isinstance(fields, dict):
            return fields
        reference, told = fields.get("reference"), {}
        if isinstance(reference, str) and reference and not fields.get("name"):
            told["name"] = reference.rsplit("/", 1)[-1]
        if fields.get("kind") == BUILT_IN:
            told["division"] = fields.get("division", "closed")
        return {**fields, **told}


class Flag(Document):
    """A quantity that is better than the images allow, as `beyond_images.Excess`; null is an infinite ratio."""

    quantity: str
    part: str = Field(description="images or pairs that show it best")
    ratio: float | None
    pairs: int = Field(description="pairs, or images of one position")
    chance: float

    @property
    def text(self) -> str:
        """Sentence about it."""
        often = self.quantity in ("exact answers", "faint spots")
        better = "as often as the images allow" if often else "better than the images allow"
        times = "without error" if self.ratio is None else f"{self.ratio:.3g} times {better}"
        chance = f"below {1e-6:g}" if self.chance < 1e-6 else f"{self.chance:.1g}"
        where = f"{self.part}, {self.pairs}"
        return f"knows more than the images: {self.quantity} {times} ({where}; by chance {chance})"


def _beside(name: str) -> str:
    if name != Path(name).name or not name.isprintable() or name.startswith(".."):
        raise ValueError("the records lie beside the document: no folder in their name")
    return name


class ScoreDocument(Document):
    """One run of one method on one pair set."""

    kind: Literal["phibench score"]
    version: int
    method: MethodCard
    pair_set: dict[str, Any]
    pairs: int
    images: int
    samples: int
    draws: int = Field(description="draws of the noise of a sample and preset, at most")
    frames: dict[str, PairRange | None] = Field(description="how they were taken; null where nobody knows")
    light: dict[str, PairRange | None] = Field(description="how far the light lies from the beam's axis")
    seed: int
    rules: dict[str, float]
    limits: dict[str, Any]
    isolation: Name = Field(default="", description="what the method could reach: `Isolation.sentence`")
    provenance: dict[str, Any]
    program: Name = Field(default="", description="that scored: version of phibench, commit of a checkout")
    code_sha256: str = Field(description="of everything behind the score")
    missed_relative: float = Field(description="relative error of D as which a missed pair counts")
    flags: list[Flag] = Field(description="what the images cannot tell so well")
    metrics: dict[str, MetricDescription] = Field(description="of the whole: `jq .metrics.rms_px.value`")
    strata: list[StratumScore] = Field(description="parts of the whole")
    causes: dict[str, dict[str, int]] = Field(description="images by cause and kind")
    failures: dict[str, int] = Field(description="pairs for which the method did not come back, by the harness's word")
    worst: list[Worst]
    records: Annotated[str, AfterValidator(_beside)] = Field(description="name of the Parquet file")
    records_sha256: str
    results_sha256: Name = Field(default="", description="of the records without times and messages: `results_sha256`")

    @property
    def whole(self) -> StratumScore:
        """The whole as a stratum, for tables that begin with it."""
        return StratumScore(
            by="all",
            label="all",
            low=None,
            high=None,
            mean=None,
            images=self.images,
            pairs=self.pairs,
            metrics=self.metrics,
        )


def document_of(
    method: MethodCard,
    pair_set: Mapping[str, Any],
    table: pl.DataFrame,
    rules: Rules,
    seed: int,
    limits: Mapping[str, Any],
    missed: float,
) -> ScoreDocument:
    """Score of complete records, without its worst images, whose pictures the records do not hold."""
    whole, *others = strata(table)
    return ScoreDocument(
        kind=KIND,
        version=VERSION,
        method=method,
        pair_set=dict(pair_set),
        pairs=table["number"].n_unique(),
        images=len(table),
        samples=table["sample_id"].n_unique(),
        draws=table["draw"].n_unique(),
        frames=frame_numbers(table),
        light=light_distances(table),
        seed=seed,
        rules={name: float(value) for name, value in asdict(rules).items()},
        limits=dict(limits),
        provenance=dict(provenance()),
        program=program_version(),
        code_sha256=code_behind(SCORER),
        missed_relative=missed,
        flags=[Flag(**{**asdict(excess), "ratio": finite(excess.ratio)}) for excess in excesses(whole.images)],
        metrics={name: _metric(name, value) for name, value in stratum_metrics(whole, rules, "score", seed).items()},
        strata=[_stratum(stratum, rules, seed) for stratum in others],
        causes=count(table),
        failures=count_failures(table),
        worst=[],
        records="",
        records_sha256="",
        results_sha256=results_sha256(table),
    )


_NOT_RESULTS = ("seconds", "message")
"""Columns that may differ between two runs that answer alike; a message can name the line at which time was up."""


def results_sha256(records: pl.DataFrame) -> str:
    """SHA-256 of the records without times and messages: of the JSON of [name, values] of every column, in order.

    Two runs share it if every answer, truth and error is the same to the last bit.
    """
    columns = [[name, records[name].to_list()] for name in records.columns if name not in _NOT_RESULTS]
    return hashlib.sha256(json.dumps(columns, separators=(",", ":")).encode()).hexdigest()


def _metric(name: str, value: MetricEstimate) -> MetricDescription:
    metric = METRICS[name]
    return MetricDescription.of(value, unit=metric.unit, better=metric.better, text=metric.text)


def _stratum(stratum: Stratum, rules: Rules, seed: int) -> StratumScore:
    # the same stream for every method: on the same pairs they are resampled alike, so that their intervals compare
    values = stratum_metrics(stratum, rules, "score", seed)
    return StratumScore(
        by=stratum.by,
        label=stratum.label,
        low=finite(stratum.low),
        high=finite(stratum.high),
        mean=finite(stratum.mean),
        images=len(stratum.images),
        pairs=count_pairs(stratum),
        metrics={name: Value.of(value) for name, value in values.items()},
    )


def finite(value: float | None) -> float | None:
    """Value, or None where it is not finite."""
    return value if value is not None and math.isfinite(value) else None
