"""Scores of dense methods: each pair is drawn once, shown to every method in its own process, compared with its truth.

Processes, limits and isolation are those of spots (`isolation.runner`).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl
from rich.console import Console

from phibench.benchmark.dense.dense_document import (
    COMMAND,
    DENSE_METRICS,
    KIND,
    VERSION,
    DenseScore,
    dense_document,
    statistic_of_dense,
)
from phibench.benchmark.dense.dense_pairs import DensePairs, DenseTruth, dense_pairs
from phibench.benchmark.dense.dense_records import COLUMN_TYPES, TruthErrors, pair_records
from phibench.benchmark.isolation.resolve import DENSE, MethodError, RunLimits, code_of_function, resolve
from phibench.benchmark.isolation.runner import Harness, Ran, asked_here, function_name, ran_here
from phibench.benchmark.pair_sets.wanted_pairs import open_scored
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.compare import Difference, compared, rules_of
from phibench.benchmark.scores.document import MethodCard, read_document, read_records, write_score
from phibench.calibration.rig.file import read_calibration
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.progress import Steps, progress_console
from phibench.datasets.read import Dataset
from phibench.datasets.store.files import require_writable
from phibench.estimator.dense.dense_interface import DenseMethod, DensePair
from phibench.estimator.interface import Outcome


@dataclass(frozen=True, repr=False)
class DenseScored:
    """A dense score, the records that it was computed from, and what the method printed where it first failed."""

    document: DenseScore
    records: pl.DataFrame
    output: str = ""

    def __repr__(self) -> str:
        from phibench.benchmark.dense.dense_tables import dense_text

        return dense_text([self.document])


def score_dense(
    dataset: str | Path | Dataset,
    method: str | DenseMethod,
    preset: str | None = None,
    *,
    draws: int | None = None,
    pairs: int | None = None,
    frames: int = 1,
    calibration: str | Path | None = None,
    limits: RunLimits | None = None,
    seed: int = 0,
    out: str | Path | None = None,
    console: Console | None = None,
) -> DenseScored:
    """Score one dense method on the pairs of a data set.

    Parameters
    ----------
    dataset : folder of a finished data set, or an opened one
    method : str or function
        Name of a built-in method, or "FILE.py:FUNCTION": it runs in a process of its own, with limits. A function runs
        in this process.
    preset, draws, pairs, frames
        As for `dense_pairs`.
    calibration : path, optional
        File of `phibench calibrate`.
    limits : RunLimits, optional
        Of time and memory; not for a function.
    seed : int
        Of the bootstrap.
    out : path, optional
        JSON file to write, with its Parquet file beside it.
    console : Console, optional
        Where progress goes; by default the standard error.

    Raises
    ------
    DatasetError, MethodError
        In one sentence.
    """
    console = console or progress_console()
    chosen = chosen_pairs(dataset, preset, draws, pairs, frames, calibration)
    if out is not None:
        require_writable(Path(out))
    if isinstance(method, str):
        (scored,) = run_dense([method], chosen, console=console, seed=seed, limits=limits)
    else:
        if limits is not None:
            raise MethodError("limits are for methods in a process of their own: give FILE.py:FUNCTION")
        card = MethodCard.of(function_name(method), kind="function", **code_of_function(method))
        with Steps(console, "dense pairs", len(chosen)) as steps:
            asked = asked_here(method)(_Shown(chosen), range(len(chosen)))
            (table,) = _records(chosen, asked, 1, steps.reach)
        alone = "not isolated: a function runs in this process"
        scored = _scored(card, chosen, table, seed, {}, alone, ran_here(), "")
    return scored if out is None else saved_dense(scored, Path(out))


def chosen_pairs(
    dataset: str | Path | Dataset,
    preset: str | None = None,
    draws: int | None = None,
    pairs: int | None = None,
    frames: int = 1,
    calibration: str | Path | None = None,
) -> DensePairs:
    """Dense pairs of a folder or of an opened data set; parameters and errors as for `dense_pairs`."""
    opened: Any = dataset if isinstance(dataset, Dataset) else open_scored(dataset)
    read = None if calibration is None else read_calibration(calibration)
    return dense_pairs(opened, preset, draws, pairs, frames, read)


def run_dense(
    references: Sequence[str],
    pairs: DensePairs,
    workers: int = 1,
    console: Console | None = None,
    seed: int = 0,
    limits: RunLimits | None = None,
) -> list[DenseScored]:
    """Score dense methods on the same pairs, each in a process of its own.

    Raises
    ------
    MethodError
        If a method cannot be found or imported.
    """
    resolved, limits = [resolve(reference, DENSE) for reference in references], limits or RunLimits()
    cards = [MethodCard.of(name, **method.document()) for name, method in zip(references, resolved, strict=True)]
    if not cards:
        return []
    with ExitStack() as stack:
        steps = stack.enter_context(Steps(console or progress_console(), "dense pairs", len(pairs)))
        harness = stack.enter_context(Harness(resolved, limits, workers, pairs.folders))
        shown = _Shown(pairs)
        tables = _records(shown, _asked(harness, shown, workers), len(cards), steps.reach)
        told = list(zip(harness.isolations, harness.ran, harness.failed_outputs, strict=True))
    return [
        _scored(card, pairs, table, seed, limits.document(), isolation, ran, output)
        for card, table, (isolation, ran, output) in zip(cards, tables, told, strict=True)
    ]


def _asked(harness: Harness, shown: _Shown, workers: int) -> Iterator[tuple[Outcome, ...]]:
    """Outcomes pair by pair. No more pairs are asked for than are worked on: an answer takes some megabytes."""
    for first in range(0, len(shown), workers):
        yield from harness.outcomes(shown, range(first, min(first + workers, len(shown))))


class _Shown:
    """Pairs and truths of a set for several threads: one is made at a time."""

    def __init__(self, pairs: DensePairs) -> None:
        self._pairs, self._lock = pairs, threading.Lock()

    def __len__(self) -> int:
        return len(self._pairs)

    def pair(self, number: int) -> DensePair:
        """Images of a pair."""
        with self._lock:
            return self._pairs.pair(number)

    def truth(self, number: int) -> DenseTruth:
        """Exact answer for a pair."""
        with self._lock:
            return self._pairs.truth(number)


def _records(
    pairs: DensePairs | _Shown, asked: Iterable[tuple[Outcome, ...]], methods: int, told: Callable[[int], None]
) -> list[pl.DataFrame]:
    """Records of every method; of each pair the truth is made once."""
    rows: list[list[pl.DataFrame]] = [[] for _ in range(methods)]
    for done, outcomes in enumerate(asked, 1):
        errors = TruthErrors(pairs.truth(outcomes[0].number))
        for own, outcome in zip(rows, outcomes, strict=True):
            message = outcome.message + _on_raw(errors.truth.preset) * (outcome.failure in ("error", "invalid"))
            own.append(pair_records(errors, outcome.dense, outcome.seconds, outcome.failure, message))
        told(done)
    return [pl.concat(own) if own else pl.DataFrame(schema=COLUMN_TYPES) for own in rows]


def _on_raw(preset: str) -> str:
    """Advice for a method that fails on raw images, which may have asked for colour."""
    if not preset.endswith("-raw"):
        return ""
    return f"; images of '{preset}' are raw, (H, W) without colours: a method that needs colours takes --preset mjpeg"


def _scored(
    card: MethodCard,
    pairs: DensePairs,
    table: pl.DataFrame,
    seed: int,
    limits: Mapping[str, Any],
    isolation: str,
    ran: Ran,
    output: str,
) -> DenseScored:
    card = card.model_copy(update=vars(ran))
    document = dense_document(card, pairs.document(), table, Rules(), seed, limits, isolation)
    return DenseScored(document, table, output)


def saved_dense(scored: DenseScored, file: Path) -> DenseScored:
    """The score, written with its records; its document then names their hash."""
    return replace(scored, document=write_score(file, scored.document, scored.records))


def read_dense(path: Path) -> DenseScore:
    """Read a dense score.

    Raises
    ------
    DatasetError
        If the file is none; in one sentence.
    """
    return read_document(path, DenseScore, KIND, VERSION, COMMAND)


COMPARED = (
    *("recall", "answered", "median_relative", "mean_relative", "rms_relative", "above_5", "above_10"),
    *("mae_m", "rmse_m", "matching", "seconds"),
)
_KEY, _TRUTH = "number", ("sample_id", "draw", "preset", "stroke_m", "pixels")


def compare_dense(first: Path, second: Path, seed: int = 0) -> list[Difference]:
    """Compare two dense scores on disk, pair by pair: paired differences with intervals over the samples.

    Raises
    ------
    DatasetError
        If they were not taken on the same pairs by the same rules.
    """
    a, b = read_dense(first), read_dense(second)
    for what, one, other in (("rules", a.rules, b.rules), ("pair sets", _same(a), _same(b))):
        if one != other:
            keys = ", ".join(sorted(key for key in {*one, *other} if one.get(key) != other.get(key)))
            raise DatasetError(f"{first} and {second} have different {what} ({keys}): score both on the same pairs")
    tables = [read_records(path, score, COLUMN_TYPES) for path, score in ((first, a), (second, b))]
    ours, theirs = (table.filter(pl.col("by") == "all").sort(_KEY) for table in tables)
    ours, theirs = ours.join(theirs, on=_KEY, how="semi"), theirs.join(ours, on=_KEY, how="semi")
    if not len(ours) or not ours.select(_TRUTH).equals(theirs.select(_TRUTH)):
        raise DatasetError(f"{first} and {second} have no pair in common: score both on the same pairs")
    metrics = {name: DENSE_METRICS[name] for name in COMPARED}
    pairs = {name: _both(ours, theirs, metric.column) for name, metric in metrics.items()}
    return compared(
        {name: (*pairs[name], partial(statistic_of_dense, metric)) for name, metric in metrics.items()},
        {name: metric.better for name, metric in metrics.items()},
        rules_of(a.rules),
        "dense compare",
        seed,
    )


def _both(a: pl.DataFrame, b: pl.DataFrame, column: str) -> tuple[pl.DataFrame, pl.DataFrame]:
    known = a[column].is_not_null() & b[column].is_not_null()
    return a.filter(known), b.filter(known)


def _same(score: DenseScore) -> dict[str, Any]:
    return {key: value for key, value in score.pair_set.items() if key not in ("pairs", "samples", "provenance")}
