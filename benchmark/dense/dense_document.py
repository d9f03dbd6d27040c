"""Score of a dense method: metrics of records with intervals over samples, one JSON file with its records beside it.

A metric is a mean over pairs of what a pair's pixels give, so that every pair counts alike; of mean squares the root is
taken last. Intervals resample samples, as those of spots do (`scores.intervals`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import polars as pl
from pydantic import Field

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.intervals import Clusters, Statistic, estimates, mean_of, rms_of
from phibench.benchmark.scores.metrics import MetricEstimate
from phibench.benchmark.scores.score_document import MethodCard, MetricDescription, Value, results_sha256
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.store.provenance import code_behind, program_version, provenance
from phibench.datasets.store.schema import Document
from phibench.scenes.random_streams import Name, generator

KIND: Literal["phibench dense score"] = "phibench dense score"
VERSION = 1
SCORER = "phibench.benchmark.dense.dense_score"
COMMAND = "phibench dense score ... --out"


@dataclass(frozen=True)
class DenseMetric:
    """One number of a dense score.

    Attributes
    ----------
    column : str
        Of the records.
    unit : str
    better : "lower", "higher" or "none"
    text : str
    root : bool
        Of the mean of squares.
    """

    column: str
    unit: str
    better: Literal["lower", "higher", "none"]
    text: str
    root: bool = False


def _share(column: str, better: Literal["lower", "higher", "none"], text: str) -> DenseMetric:
    return DenseMetric(column, "1", better, text)


DENSE_METRICS: dict[str, DenseMetric] = {
    "recall": _share("recall", "higher", "pixels within 0.5, 1, 2, 5, 10 and 20 % of D, averaged over these"),
    "answered": _share("answered", "none", "pixels that are answered"),
    "hidden_answered": _share("hidden_answered", "none", "pixels hidden from the up image that are answered"),
    "median_relative": _share("median", "lower", "median |error of D| / D over a pair's answers"),
    "mean_relative": _share("mean", "lower", "mean |error of D| / D; MARE of Helvipad"),
    "rms_relative": DenseMetric("square", "1", "lower", "root of the mean squared error of D / D", root=True),
    "p90_relative": _share("p90", "lower", "90 % of a pair's answers are below"),
    "bias_relative": _share("bias", "none", "median error of D / D, with its sign"),
    "above_2": _share("above_2", "lower", "answers off by more than 2 %"),
    "above_5": _share("above_5", "lower", "answers off by more than 5 %"),
    "above_10": _share("above_10", "lower", "answers off by more than 10 %"),
    "mae_m": DenseMetric("mae_m", "m", "lower", "mean |error of D|; MAE of Helvipad"),
    "rmse_m": DenseMetric(
        "square_m2", "m", "lower", "root of the mean squared error of D; RMSE of Helvipad", root=True
    ),
    "disparity_mae_deg": DenseMetric("disparity_mae_deg", "deg", "lower", "mean |error of the disparity angle|"),
    "disparity_rmse_deg": DenseMetric(
        "disparity_square_deg2", "deg", "lower", "root of the mean squared error of the disparity angle", root=True
    ),
    "disparity_mare": _share("disparity_mare", "lower", "mean |error of the disparity angle| over the angle"),
    "seam_m": DenseMetric("seam_m", "m", "lower", "left-right consistency error of D; LRCE of Helvipad"),
    "ause": _share("ause", "lower", "area between sparsification by the claimed sigma and by the error"),
    "coverage": _share("coverage", "none", "answers within 1.96 claimed sigma; 0.95 is right"),
    "matching": _share("matching", "lower", "median |answer - perfect match through the given rig| / D"),
    "matching_central": _share("matching_central", "none", "the same, and perfect matches by the central model"),
    "central": _share("central", "none", "median |central model - given rig| / D of perfect matches"),
    "central_p90": _share("central_p90", "none", "90 % of these differences are below"),
    "calibration": _share("calibration", "none", "median |given rig - truth| / D of perfect matches"),
    "seconds": DenseMetric("seconds", "s", "none", "inside the method, a pair"),
}
"""Metrics of a dense score by name."""


class DenseStratum(Document):
    """Metrics of a part of the pixels, or of the pairs."""

    by: str
    label: str
    pixels: int
    pairs: int
    metrics: Mapping[str, Value]


class DenseScore(Document):
    """One run of one dense method on one set of dense pairs."""

    kind: Literal["phibench dense score"]
    version: int
    method: MethodCard
    pair_set: dict[str, Any]
    pairs: int
    samples: int
    pixels: int = Field(description="that count, of all pairs")
    seed: int
    rules: dict[str, float]
    limits: dict[str, Any]
    isolation: str = Field(default="", description="what the method could reach: `Isolation.sentence`")
    provenance: dict[str, Any]
    program: str = ""
    code_sha256: str = Field(description="of everything behind the score")
    metrics: dict[str, MetricDescription] = Field(description="of the whole: `jq .metrics.recall.value`")
    strata: list[DenseStratum] = Field(description="parts of the whole")
    failures: dict[str, int] = Field(description="pairs on which the method failed, by the harness's word")
    records: str = Field(description="name of the Parquet file")
    records_sha256: str
    results_sha256: str = ""


def dense_document(
    method: MethodCard,
    pair_set: Mapping[str, Any],
    table: pl.DataFrame,
    rules: Rules,
    seed: int,
    limits: Mapping[str, Any],
    isolation: str,
) -> DenseScore:
    """Score of complete records."""
    whole = table.filter(pl.col("by") == "all")
    if not len(whole):
        raise DatasetError("the set of dense pairs is empty: there is nothing to score")
    failures = whole.filter(pl.col("failure") != "").group_by("failure").len().sort("failure").rows()
    measured = measure_dense(whole, rules, "dense", seed, "all")
    return DenseScore(
        kind=KIND,
        version=VERSION,
        method=method,
        pair_set=dict(pair_set),
        pairs=len(whole),
        samples=whole["sample_id"].n_unique(),
        pixels=int(whole["pixels"].sum()),
        seed=seed,
        rules={name: float(value) for name, value in asdict(rules).items()},
        limits=dict(limits),
        isolation=isolation,
        provenance=dict(provenance()),
        program=program_version(),
        code_sha256=code_behind(SCORER),
        metrics={name: _described(name, value) for name, value in measured.items()},
        strata=[_stratum(*part, rules, seed) for part in dense_strata(table)],
        failures=dict(failures),
        records="",
        records_sha256="",
        results_sha256=results_sha256(table),
    )


_STROKES_M = (0.0, 0.3, 0.6, 0.9, np.inf)


def dense_strata(table: pl.DataFrame) -> list[tuple[str, str, pl.DataFrame]]:
    """Parts of the records: those of pixels in their order, then pairs by stroke, room and preset."""
    keys = table.filter(pl.col("by") != "all").select("by", "label").unique(maintain_order=True).rows()
    parts = [(by, label, table.filter((pl.col("by") == by) & (pl.col("label") == label))) for by, label in keys]
    whole = table.filter(pl.col("by") == "all")
    for low, high in pairwise(_STROKES_M):
        label = f"from {low:g} m" if np.isinf(high) else f"{low:g} to {high:g} m"
        parts.append(("stroke", label, whole.filter((pl.col("stroke_m") >= low) & (pl.col("stroke_m") < high))))
    for by in ("room", "preset"):
        parts += [(by, value, whole.filter(pl.col(by) == value)) for value in whole[by].unique().sort()]
    return [part for part in parts if len(part[2]) and not part[2].equals(whole)]


def measure_dense(rows: pl.DataFrame, rules: Rules, *stream: Name) -> dict[str, MetricEstimate]:
    """Metrics of rows of pairs, each over those that have a value, with intervals over samples."""
    found: dict[str, MetricEstimate] = {}
    groups: dict[bytes, tuple[Clusters, list[str], list[Statistic], int]] = {}
    for name, metric in DENSE_METRICS.items():
        known = rows[metric.column].is_not_null().to_numpy()
        part = rows.filter(pl.Series(known))
        if known.tobytes() not in groups:
            groups[known.tobytes()] = (Clusters.of(part["sample_id"].to_list()), [], [], len(part))
        clusters, names, statistics, _ = groups[known.tobytes()]
        names.append(name)
        statistics.append(statistic_of_dense(metric, clusters, part))
    for clusters, names, statistics, count in groups.values():
        # one set of resamples for all metrics of the same pairs
        drawn = estimates(statistics, clusters.n, rules, generator(*stream))
        found |= {n: MetricEstimate(e, count, clusters.n) for n, e in zip(names, drawn, strict=True)}
    return {name: found[name] for name in DENSE_METRICS}


def statistic_of_dense(metric: DenseMetric, clusters: Clusters, rows: pl.DataFrame) -> Statistic:
    """Statistic of a metric over rows without nulls."""
    values = rows[metric.column].to_numpy().astype(float)
    return rms_of(clusters, values) if metric.root else mean_of(clusters, values)


def _described(name: str, value: MetricEstimate) -> MetricDescription:
    metric = DENSE_METRICS[name]
    return MetricDescription.of(value, unit=metric.unit, better=metric.better, text=metric.text)


def _stratum(by: str, label: str, rows: pl.DataFrame, rules: Rules, seed: int) -> DenseStratum:
    measured = measure_dense(rows, rules, "dense", seed, by, label)
    values = {name: Value.of(value) for name, value in measured.items()}
    return DenseStratum(by=by, label=label, pixels=int(rows["pixels"].sum()), pairs=len(rows), metrics=values)
