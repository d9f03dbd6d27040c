"""Check of a score file that somebody hands in: one sentence for each fault.

Nothing is believed that can be computed again. The file itself says which numbers follow from which: counts and causes
from its records, metrics and intervals from the records, errors from answers and truth. With the data set at hand truth
and bounds are computed again, too. What a method answered cannot be checked without its code: who runs it again can.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from phibench.datasets.input_files import InputFile
from phibench.datasets.read import open_finished
from phibench.datasets.store import schema
from phibench.datasets.store.files import sha256
from phibench.estimator.benchmark.answer_errors import Rules
from phibench.estimator.benchmark.dataset_pairs import TASK_VERSION, DatasetPairs, dataset_pairs
from phibench.estimator.benchmark.document import ScoreDocument, document_of, read_records, read_score, results_sha256
from phibench.estimator.benchmark.records import COLUMN_TYPES, missed_relative, record_table, with_missed
from phibench.estimator.interface import Outcome

RELATIVE, ABSOLUTE = 1e-6, 1e-12
"""Tolerance of a number that is computed again: other processors and versions of libraries round otherwise."""
_TRUTHS = (
    *(
        "sample_id",
        "draw",
        "preset",
        "jpeg_quality",
        "hinted",
        "depth_m",
        "axis_depth_m",
        "stroke_m",
        "azimuth_rad",
        "electrons",
    ),
    *("snr", "saturated", "visible", "unseen_because", "u_true_px", "v_true_px", "from_centre_px", "bayer"),
    *("bound_px2", "raw_bound_px2", "bound_phi_rad2", "pair_bound_px2", "pair_bound_phi_rad2", "bound_depth_m2"),
    *("pair_bound_depth_m2", "pair_visible", "pair_electrons"),
)
"""Columns that follow from the data set alone."""
_POSITIVE = ("depth_m", "stroke_m", "depth_estimate_m")
_NOT_BELOW_0 = (
    *("electrons", "snr", "from_centre_px", "distance_px", "counted_px", "mahalanobis2", "seconds", "depth_sigma_m"),
    *("bound_px2", "raw_bound_px2", "bound_phi_rad2", "pair_bound_px2", "pair_bound_phi_rad2", "bound_depth_m2"),
    *("pair_bound_depth_m2", "rank_phi2_rad2", "rank_depth2", "depth_counted", "pair_phi_error_rad2"),
)


@dataclass(frozen=True)
class Checked:
    """Outcome: faults, a sentence each, and what could not be checked."""

    file: str
    method: str
    pairs: int
    faults: tuple[str, ...]
    unchecked: tuple[str, ...]

    def text(self) -> str:
        """JSON document."""
        return json.dumps({**asdict(self), "valid": not self.faults}, indent=1) + "\n"


def check_score(path: Path, data: Path | None = None, release: Path | None = None) -> Checked:
    """Check a score of a set that is not sealed.

    Parameters
    ----------
    path : JSON file, its Parquet file beside it
    data : folder of the data set, from which truth and bounds are computed again
    release : `MANIFEST.json` of a release, which names the data set's hash

    Raises
    ------
    DatasetError
        If the file is no score, one of another version, or lacks its records; in one sentence.
    """
    document = read_score(path)
    table = read_records(path, document)
    faults = [*_of_document(document), *_of_release(document, release)]
    complete = list(_of_pairs(document, table))
    faults += complete
    wrong = [*_impossible(table), *_of_errors(table, document)]
    faults += wrong
    if lacking := [name for name in ("kind", "cause", "taken_for") if name not in table.columns]:
        complete.append(f"records: the column {lacking[0]} is missing, from which causes are counted")
        faults += complete[-1:]
    if not (complete or wrong):  # of wrong records every number would differ
        faults += _of_statistics(document, table)
    unchecked = []
    if release is None:
        unchecked.append("that the data set is a released one: give --release MANIFEST.json")
    if data is None:
        unchecked.append("truth and bounds: give --data, the folder of the data set")
    elif not complete:
        faults += _of_truth(document, table, data)
    return Checked(path.name, document.method.name, document.pairs, tuple(faults), tuple(unchecked))


# -- the document ------------------------------------------------------------------------------------------------------


def _of_document(document: ScoreDocument) -> Iterator[str]:
    pair_set = document.pair_set
    if pair_set.get("sealed") is not False:
        yield "the score is not of an open set: answers to a sealed set are handed in with `phibench seal submit`"
    if pair_set.get("task_version") != TASK_VERSION:
        yield f"task_version is {pair_set.get('task_version')}, this program scores task {TASK_VERSION}: score again"
    for name, value in asdict(Rules()).items():
        if document.rules.get(name) != float(value):
            yield f"rules.{name} is {document.rules.get(name)}, and results are by {value:g}: score by the usual rules"
    for name in ("boxes_px", "frames", "sensor_sha256", "calibration"):
        if pair_set.get(name) is not None:
            yield f"pair_set.{name} is {pair_set[name]}: results are of the data set's own pairs, score without it"
    if document.seed != 0:
        yield f"seed is {document.seed}: intervals of results are of the bootstrap seed 0"
    if document.isolation.startswith("not isolated"):
        yield f"the method was {document.isolation}: score it as FILE.py:FUNCTION on a machine that isolates it"
    if not document.method.sha256:
        yield "method.sha256 is missing: nobody can tell which code was scored"


def _of_release(document: ScoreDocument, release: Path | None) -> Iterator[str]:
    if release is None:
        return
    file = InputFile(release, "give MANIFEST.json of a release")
    parts = file.json().get("parts")
    if not isinstance(parts, dict):
        raise file.fault("has no parts: give MANIFEST.json of a release")
    hashes = {name: part.get("sums_sha256") for name, part in parts.items() if isinstance(part, dict)}
    if document.pair_set.get("dataset_sha256") not in hashes.values():
        yield (
            f"pair_set.dataset_sha256 is none of the release's ({', '.join(hashes)}): score a data set that "
            "`phibench fetch` has brought"
        )


def _of_pairs(document: ScoreDocument, table: pl.DataFrame) -> Iterator[str]:
    wanted = [(number, image) for number in range(document.pairs) for image in ("down", "up")]
    found = list(table.select("number", "image").rows())
    if found != wanted:
        missing = sorted({number for number, _ in set(wanted) - set(found)})
        if missing:
            text = ", ".join(map(str, missing[:5])) + (" and more" if len(missing) > 5 else "")
            yield f"records: no answer for pair {text}; each of {document.pairs} pairs has two rows, down and up"
        else:
            yield f"records: {len(found)} rows for {document.pairs} pairs: each has two, down and up, in order"
    stated = document.pair_set.get("pairs")
    if stated != document.pairs:
        yield f"pairs is {document.pairs} and pair_set.pairs {stated}: the method was not scored on the whole set"
    samples = table["sample_id"].n_unique()
    for name, value, right in (("images", document.images, len(table)), ("samples", document.samples, samples)):
        if value != right:
            yield f"{name} is {value}, and the records have {right}"


# -- the records -------------------------------------------------------------------------------------------------------


def _impossible(table: pl.DataFrame) -> Iterator[str]:
    for name, kind in COLUMN_TYPES.items():
        values = table[name]
        if kind == pl.Float64() and not values.drop_nulls().is_finite().all():
            yield f"records.{name}: a number that is not finite"
    for names, low, words in ((_POSITIVE, 0.0, "above 0"), (_NOT_BELOW_0, -math.ulp(0.0), "0 or above")):
        for name in names:
            least = table[name].min()
            if isinstance(least, float) and not least > low:
                yield f"records.{name}: {least:g} is impossible, it is {words}"


def _of_errors(table: pl.DataFrame, document: ScoreDocument) -> Iterator[str]:
    """Columns that follow from others of the same row."""
    given, visible = pl.col("u_px").is_not_null(), pl.col("visible")
    placed = pl.col("u_true_px").is_not_null()
    near = (pl.col("distance_px") <= document.rules.get("match_px", math.nan)).fill_null(False)
    detected = visible & pl.when(~visible | placed).then(near).otherwise(given)
    right = table.select(
        du_px=pl.col("u_px") - pl.col("u_true_px"),
        dv_px=pl.col("v_px") - pl.col("v_true_px"),
        distance_px=(pl.col("du_px") ** 2 + pl.col("dv_px") ** 2).sqrt(),
        detected=detected,
        missed=visible & ~detected,
        false_detection=given & ~detected,
        phi_error_rad=pl.when(pl.col("phi_convention") == "ray")
        .then(pl.col("phi_rad") - pl.col("phi_true_rad"))
        .otherwise(pl.col("phi_error_rad")),
        mahalanobis2=pl.col("pull_u") ** 2 + pl.col("pull_v") ** 2,
        depth_error_m=pl.col("depth_estimate_m") - pl.col("depth_m"),
        depth_relative=pl.col("depth_error_m") / pl.col("depth_m"),
    )
    yield from _differences(table, right, right.columns, "what follows from the other columns")


def _of_truth(document: ScoreDocument, table: pl.DataFrame, data: Path) -> Iterator[str]:
    dataset = open_finished(data)
    listed = dataset.folder / schema.CHECKSUMS
    if sha256(listed) != document.pair_set.get("dataset_sha256"):
        yield f"pair_set.dataset_sha256 is not that of {data}: give the data set that was scored"
        return
    presets = table["preset"].unique().to_list()
    pairs = dataset_pairs(dataset, presets[0] if len(presets) == 1 else None)
    if len(pairs) != document.pairs:
        yield f"pairs is {document.pairs}, and the data set has {len(pairs)} of {', '.join(presets)}: score all of them"
    count = min(len(pairs), document.pairs)
    right = _truth_table(pairs, count, Rules())
    part = table.filter(pl.col("number") < count)
    yield from _differences(part, right, _TRUTHS, "what the data set gives")


def _truth_table(pairs: DatasetPairs, count: int, rules: Rules) -> pl.DataFrame:
    """Records of a method that is silent: their columns of truth and bounds are those of any."""
    silent = [Outcome(number, None, math.nan, "error") for number in range(count)]
    return record_table([pairs.truth(number) for number in range(count)], silent, rules)


def _differences(table: pl.DataFrame, right: pl.DataFrame, names: Sequence[str], source: str) -> Iterator[str]:
    for name in names:
        rows = np.flatnonzero(~_same(table[name], right[name]))
        if len(rows):
            number, image = table.select("number", "image").row(int(rows[0]))
            a, b = table[name][int(rows[0])], right[name][int(rows[0])]
            more = f", and {len(rows) - 1} more" if len(rows) > 1 else ""
            yield f"records.{name} of pair {number} {image} is {_short(a)}, not {_short(b)}, {source}{more}"


def _same(given: pl.Series, right: pl.Series) -> Any:
    if not right.dtype.is_float():
        return given.eq_missing(right).to_numpy()
    a, b = (x.cast(pl.Float64()).fill_null(np.nan).to_numpy() for x in (given, right))
    return np.isclose(a, b, rtol=RELATIVE, atol=ABSOLUTE, equal_nan=True)


# -- statistics --------------------------------------------------------------------------------------------------------


def _of_statistics(document: ScoreDocument, table: pl.DataFrame) -> Iterator[str]:
    rules = Rules()
    plain = table.drop("depth_counted", "rank_depth2")
    missed = missed_relative(plain, rules)
    counted = with_missed(plain, missed)
    yield from _differences(table, counted, ("depth_counted", "rank_depth2"), "what a missed pair costs")
    if document.results_sha256 != results_sha256(table):
        yield "results_sha256 is not that of the records: hand in both files of one run"
    again = document_of(document.method, document.pair_set, counted, rules, document.seed, document.limits, missed)
    for name in ("missed_relative", "metrics", "strata", "causes", "failures", "flags"):
        given, right = (one.model_dump(mode="json")[name] for one in (document, again))
        yield from _unequal(given, right, name)


def _unequal(given: Any, right: Any, place: str) -> Iterator[str]:
    """Leaves that differ; the first ones of a place, because one number in the records changes many."""
    found = list(_leaves(given, right, place))
    for where, a, b in found[:_MOST]:
        yield f"{where} is {_short(a)}, and the records give {_short(b)}"
    if len(found) > _MOST:
        yield f"{place}: {len(found) - _MOST} more numbers are not those of the records"


_MOST = 3


def _leaves(given: Any, right: Any, place: str) -> Iterator[tuple[str, Any, Any]]:
    if isinstance(given, Mapping) and isinstance(right, Mapping) and given.keys() == right.keys():
        for key, value in given.items():
            yield from _leaves(value, right[key], f"{place}.{key}")
    elif isinstance(given, list) and isinstance(right, list) and len(given) == len(right):
        for number, (a, b) in enumerate(zip(given, right, strict=True)):
            yield from _leaves(a, b, f"{place}.{number}")
    elif not _alike(given, right):
        yield place, given, right


def _alike(a: Any, b: Any) -> bool:
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=RELATIVE, abs_tol=ABSOLUTE)
    return bool(a == b)


def _short(value: Any) -> str:
    text = f"{value:.6g}" if isinstance(value, float) else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def schema_text() -> str:
    """JSON schema of a score file."""
    whole = {"$schema": "https://json-schema.org/draft/2020-12/schema", **ScoreDocument.model_json_schema()}
    return json.dumps(whole, indent=1) + "\n"
