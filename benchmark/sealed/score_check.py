"""Check of a score file that somebody hands in, one sentence for each fault; and the JSON schema of score files.

Nothing is believed that can be computed again. The file itself says which numbers follow from which: counts, metrics,
intervals and flags from its records. With the data set at hand the whole score is built again from the answers
(`rebuilt_score`). With the method at hand it is run again. How long it took there is not checked.
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
from rich.console import Console

from phibench.benchmark.isolation.run_limits import RunLimits
from phibench.benchmark.pair_sets.dataset_pairs import LOCALISE_BOX_PX, TASK_VERSION, TRACKS
from phibench.benchmark.pair_sets.wanted_pairs import PairChoice, wanted_pairs
from phibench.benchmark.scores.answer_errors import Rules, usable_covariance, whitened_errors
from phibench.benchmark.scores.record_columns import COLUMN_TYPES
from phibench.benchmark.scores.records import missed_relative, with_missed
from phibench.benchmark.scores.score_document import ScoreDocument, document_of, results_sha256
from phibench.benchmark.scores.score_files import read_records, read_score
from phibench.benchmark.scores.score_tables import failure_line
from phibench.benchmark.scores.worst_images import Worst
from phibench.benchmark.sealed.rebuilt_score import (
    ABSOLUTE,
    GIVEN,
    RELATIVE,
    CheckNotes,
    check_card,
    check_run,
    column_differences,
    pictures_alike,
    score_from_records,
    short_value,
)
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.common.progress import Steps, progress_console
from phibench.datasets.read import open_finished
from phibench.datasets.store import schema
from phibench.datasets.store.files import sha256
from phibench.estimator.pair_set import PairSet
from phibench.scenes.frames import Array

_POSITIVE = ("depth_m", "stroke_m", "depth_estimate_m")
_NOT_BELOW_0 = (
    *("electrons", "snr", "from_centre_px", "distance_px", "counted_px", "mahalanobis2", "seconds", "depth_sigma_m"),
    *("bound_px2", "raw_bound_px2", "bound_phi_rad2", "pair_bound_px2", "pair_bound_phi_rad2", "bound_depth_m2"),
    *("pair_bound_depth_m2", "rank_phi2_rad2", "rank_depth2", "depth_counted", "possible_spot_chi2", "searched_px2"),
)


@dataclass(frozen=True)
class ScoreCheck:
    """Outcome: faults, a sentence each, and what could not be checked."""

    file: str
    method: str
    pairs: int
    faults: tuple[str, ...]
    unchecked: tuple[str, ...]

    def text(self) -> str:
        """JSON document."""
        return json.dumps({**asdict(self), "valid": not self.faults}, indent=1) + "\n"


def check_score(
    path: Path,
    data: Path | None = None,
    release: Path | None = None,
    method: str | None = None,
    limits: RunLimits | None = None,
    workers: int = 1,
    console: Console | None = None,
    calibration: Path | None = None,
) -> ScoreCheck:
    """Check a score of a set that is not sealed.

    Parameters
    ----------
    path : JSON file, its Parquet file beside it
    data : folder of the data set, from which every column is built again
    release : `MANIFEST.json` of a release, which names the data set's hash
    method : the method itself, as `phibench score` takes it: its hashes are compared, and with `data` it is run again
    limits, workers : of that run
    console : where progress goes; by default the standard error
    calibration : file of `phibench calibrate` that the pairs were scored with, of a score with a calibrated rig

    Raises
    ------
    DatasetError
        If the file is no score, one of another version, or lacks its records, or if a calibration is given for a score
        without one; in one sentence.
    MethodError
        If the method cannot be found or started.
    """
    document, console = read_score(path), console or progress_console()
    table = read_records(path, document)
    card = check_card(document, method)
    rig = _of_calibration(document, table, calibration)
    faults = [*_of_document(document), *_of_release(document, release), *card.faults, *rig.faults]
    broken = [*_of_pairs(document, table), *_of_causes(table), *_impossible(table)]
    unchecked = [
        *card.unchecked,
        *rig.unchecked,
        "seconds, limits, isolation and division: they are the word of who ran it",
    ]
    if release is None:
        unchecked.append("that the data set is a released one: give --release MANIFEST.json")
    if document.pair_set.get("calibration") and (calibration is None or rig.faults):
        data = None  # its pairs cannot be made without the calibrated rig
    if data is None:
        too = " with --calibration" if document.pair_set.get("calibration") else ""
        unchecked.append(f"truth, bounds, causes and worst images: give --data, the folder of the data set{too}")
    if broken:  # of wrong records every number would differ
        return ScoreCheck(path.name, document.method.name, document.pairs, (*faults, *broken), tuple(unchecked))
    faults += [f"the method {line}"] if (line := failure_line(table)) else []
    if data is None:
        wrong = list(_of_errors(table, document))
        faults += wrong or _of_statistics(document, table)
    else:
        again = _built_again(document, table, data, console, calibration)
        faults += again.faults
        if method is not None and again.pairs is not None:
            run = check_run(document, table, method, again.pairs, limits or RunLimits(), workers, console)
            faults, unchecked = [*faults, *run.faults], [*unchecked, *run.unchecked]
    return ScoreCheck(path.name, document.method.name, document.pairs, tuple(faults), tuple(unchecked))


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
    track = pair_set.get("track")
    if track not in ("", None, *TRACKS):
        yield f"pair_set.track is {track!r}: there are {', '.join(TRACKS)}; score again"
    own = ("boxes_px", "localise", LOCALISE_BOX_PX)
    for name in ("boxes_px", "frames", "sensor_sha256"):
        if pair_set.get(name) is not None and (name, track, pair_set[name]) != own:
            yield f"pair_set.{name} is {pair_set[name]}: results are of the data set's own pairs, score without it"
    if document.seed != 0:
        yield f"seed is {document.seed}: intervals of results are of the bootstrap seed 0"
    if document.isolation.startswith("not isolated"):
        yield f"the method was {document.isolation}: score it as FILE.py:FUNCTION on a machine that isolates it"


def _of_calibration(document: ScoreDocument, table: pl.DataFrame, calibration: Path | None) -> CheckNotes:
    """Faults of what is said of the rig: the hash of the calibration, and whether D of scored samples went into it."""
    from phibench.calibration.rig.calibration_file import read_calibration  # 25 modules, which most scores do without

    stated, made_from = document.pair_set.get("calibration"), document.pair_set.get("calibrated_from") or {}
    if stated is None:
        if calibration is not None:
            raise DatasetError(f"the score was made without a calibration: leave --calibration {calibration} out")
        return CheckNotes((), ())
    samples = set(table["sample_id"])
    shared = len(samples & set(made_from.get("samples", ())))
    unchecked = []
    if made_from.get("spots") and shared:
        unchecked.append(f"independence: D of {shared} of the {len(samples)} scored samples went into the calibration")
    if calibration is None:
        unchecked.append("pair_set.calibration: give the file of `phibench calibrate`, --calibration")
    elif read_calibration(calibration).sha256 != stated:
        return CheckNotes(
            (f"pair_set.calibration is not the hash of {calibration}: give the file that was scored with",), ()
        )
    return CheckNotes((), tuple(unchecked))


def _of_release(document: ScoreDocument, release: Path | None) -> Iterator[str]:
    if release is None:
        return  # none was given: nothing to hold it against
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
    given = list(table.select("number", "image").rows())
    if given != wanted:
        missing = sorted({number for number, _ in set(wanted) - set(given)})
        if missing:
            text = ", ".join(map(str, missing[:5])) + (" and more" if len(missing) > 5 else "")
            yield f"records: no answer for pair {text}; each of {document.pairs} pairs has two rows, down and up"
        else:
            yield f"records: {len(given)} rows for {document.pairs} pairs: each has two, down and up, in order"
    stated = document.pair_set.get("pairs")
    if stated != document.pairs:
        yield f"pairs is {document.pairs} and pair_set.pairs {stated}: the method was not scored on the whole set"
    samples = table["sample_id"].n_unique()
    for name, value, right in (("images", document.images, len(table)), ("samples", document.samples, samples)):
        if value != right:
            yield f"{name} is {value}, and the records have {right}"


# -- the records -------------------------------------------------------------------------------------------------------


def _of_causes(table: pl.DataFrame) -> Iterator[str]:
    for name in ("kind", "cause", "taken_for"):
        if table.schema.get(name) != pl.String():
            yield f"records: the column {name}, from which causes are counted, is missing or no text"


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
    pull = whitened_errors(_arrays(table, "du_px", "dv_px"), usable_covariance(_matrices(table, "claimed")))
    claims = table.with_columns(first=pl.Series(pull[:, 0]).fill_nan(None), second=pl.Series(pull[:, 1]).fill_nan(None))
    placed = pl.col("u_true_px").is_not_null()
    near = (pl.col("distance_px") <= document.rules.get("match_px", math.nan)).fill_null(False)
    detected = visible & pl.when(~visible | placed).then(near).otherwise(given)
    right = claims.select(
        du_px=pl.col("u_px") - pl.col("u_true_px"),
        dv_px=pl.col("v_px") - pl.col("v_true_px"),
        distance_px=(pl.col("du_px") ** 2 + pl.col("dv_px") ** 2).sqrt(),
        detected=detected,
        missed=visible & ~detected,
        false_detection=given & ~detected,
        phi_error_rad=pl.when(pl.col("phi_convention") == "ray")
        .then(pl.col("phi_rad") - pl.col("phi_true_rad"))
        .otherwise(pl.col("phi_error_rad")),
        pull_u=pl.col("first"),
        pull_v=pl.col("second"),
        mahalanobis2=pl.col("first") ** 2 + pl.col("second") ** 2,
        bound_px2=pl.col("bound_uu_px2") + pl.col("bound_vv_px2"),
        raw_bound_px2=pl.col("raw_bound_uu_px2") + pl.col("raw_bound_vv_px2"),
        depth_error_m=pl.col("depth_estimate_m") - pl.col("depth_m"),
        depth_relative=pl.col("depth_error_m") / pl.col("depth_m"),
        depth_pull=pl.when(pl.col("depth_sigma_m") > 0.0).then(pl.col("depth_error_m") / pl.col("depth_sigma_m")),
    )
    yield from column_differences(table, right, right.columns, "what follows from the other columns")


def _arrays(table: pl.DataFrame, *names: str) -> Array:
    """Columns side by side, shape (n, columns), NaN for null."""
    return np.stack([table[name].fill_null(np.nan).to_numpy() for name in names], axis=-1)


def _matrices(table: pl.DataFrame, name: str) -> Array:
    """Symmetric matrices of (u, v) of the columns NAME_uu_px2, _uv, _vv, shape (n, 2, 2)."""
    return _arrays(table, *(f"{name}_{entry}_px2" for entry in ("uu", "uv", "uv", "vv"))).reshape(-1, 2, 2)


@dataclass(frozen=True)
class _Again:
    faults: tuple[str, ...]
    pairs: PairSet | None = None


def _built_again(
    document: ScoreDocument, table: pl.DataFrame, data: Path, console: Console, calibration: Path | None
) -> _Again:
    """Faults of what the data set and the answers give, and the pairs of the score."""
    dataset = open_finished(data)
    listed = dataset.folder / schema.CHECKSUMS
    if sha256(listed) != document.pair_set.get("dataset_sha256"):
        return _Again((f"pair_set.dataset_sha256 is not that of {data}: give the data set that was scored",))
    presets = table["preset"].unique().to_list()
    preset, track = presets[0] if len(presets) == 1 else None, document.pair_set.get("track")
    choice = PairChoice(preset, calibration=calibration, track=track if track in TRACKS else None)
    pairs = wanted_pairs(dataset, choice)
    if len(pairs) != document.pairs:
        told = f"the data set has {len(pairs)} of {', '.join(presets)}"
        return _Again((f"pairs is {document.pairs}, and {told}: score all of them",))
    try:
        with Steps(console, "built again", len(pairs)) as steps:
            right = score_from_records(document, table, pairs, steps.reach)
    except DatasetError as error:
        return _Again((str(error),))
    names = [name for name in right.records.columns if name not in GIVEN]
    faults = list(column_differences(table, right.records, names, "what answers and data set give"))
    faults += [] if faults else _of_parts(document, right.document, table)
    stated, found = (_but(described, "provenance") for described in (document.pair_set, pairs.document()))
    faults += _unequal(stated, found, "pair_set", "the data set gives")
    faults += _of_worst(document.worst, right.document.worst)
    return _Again(tuple(faults), pairs)


def _but(fields: Mapping[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in fields.items() if key != name}


def _of_worst(given: Sequence[Worst], right: Sequence[Worst]) -> Iterator[str]:
    """Worst images that are not those of answers and data set; a picture may differ as its coder does."""
    stated, found = (
        [image.model_dump(mode="json", exclude={"crop", "frame"}) for image in some] for some in (given, right)
    )
    if faults := list(_unequal(stated, found, "worst", "the data set gives")):
        yield from faults
        return  # other images: their pixels need not be compared
    for place, (a, b) in enumerate(zip(given, right, strict=True)):
        for name in ("crop", "frame"):
            if not pictures_alike(getattr(a, name), getattr(b, name)):
                yield f"worst.{place}.{name} is not the picture that the data set gives"


# -- statistics --------------------------------------------------------------------------------------------------------


def _of_statistics(document: ScoreDocument, table: pl.DataFrame) -> Iterator[str]:
    rules = Rules()
    plain = table.drop("depth_counted", "rank_depth2")
    missed = missed_relative(plain, rules)
    counted = with_missed(plain, missed)
    yield from column_differences(table, counted, ("depth_counted", "rank_depth2"), "what a missed pair costs")
    again = document_of(document.method, document.pair_set, counted, rules, document.seed, document.limits, missed)
    yield from _of_parts(document, again, table)


def _of_parts(document: ScoreDocument, again: ScoreDocument, table: pl.DataFrame) -> Iterator[str]:
    if document.results_sha256 != results_sha256(table):
        yield "results_sha256 is not that of the records: hand in both files of one run"
    for name in _FROM_RECORDS:
        given, right = (score.model_dump(mode="json")[name] for score in (document, again))
        yield from _unequal(given, right, name)


_FROM_RECORDS = (*("missed_relative", "draws", "frames", "light", "metrics", "strata", "causes", "failures", "flags"),)
"""Parts of the document that follow from the records."""


def _unequal(given: Any, right: Any, place: str, source: str = "the records give") -> Iterator[str]:
    """Leaves that differ; the first ones of a place, because one number in the records changes many."""
    leaves = list(_leaves(given, right, place))
    for where, a, b in leaves[:_MOST]:
        yield f"{where} is {short_value(a)}, and {source} {short_value(b)}"
    if len(leaves) > _MOST:
        yield f"{place}: {len(leaves) - _MOST} more are not what {source}"


_MOST = 3  # differences of a file that are told: the first ones show the cause


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


def schema_text() -> str:
    """JSON schema of a score file."""
    whole = {"$schema": "https://json-schema.org/draft/2020-12/schema", **ScoreDocument.model_json_schema()}
    return json.dumps(whole, indent=1) + "\n"
