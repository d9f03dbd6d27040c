"""Dense methods run and scored, each in its own process; interrupted runs resumed; scores saved, read and compared.

Each pair is drawn once, shown to every method and compared with its truth. Processes, limits and isolation are those
of spots (`isolation.runner`).
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl
from rich.console import Console

from phibench.benchmark.dense.dense_document import COMMAND, KIND, SCORER, VERSION, DenseScore, dense_document
from phibench.benchmark.dense.dense_metrics import DENSE_METRICS, statistic_of_dense
from phibench.benchmark.dense.dense_pairs import DensePairs, DensePairSet, DenseTruth, dense_pairs
from phibench.benchmark.dense.dense_records import COLUMN_TYPES, TruthErrors, pair_records
from phibench.benchmark.isolation.method_references import DENSE, code_of_function, resolve
from phibench.benchmark.isolation.run_limits import MethodError, RunLimits
from phibench.benchmark.isolation.runner import Harness, RunProvenance, function_name, outcomes_here, provenance_here
from phibench.benchmark.pair_sets.wanted_pairs import open_scored
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.compare import Difference, metric_differences, rules_of
from phibench.benchmark.scores.score_document import MethodCard
from phibench.benchmark.scores.score_files import read_document, read_records, write_score
from phibench.calibration.rig.calibration_file import read_calibration
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.common.progress import Steps, progress_console
from phibench.datasets.read import Dataset
from phibench.datasets.store.files import require_writable, write_bytes
from phibench.datasets.store.parquet_tables import parquet_bytes
from phibench.datasets.store.provenance import code_behind
from phibench.datasets.store.schema import RECORDS_SO_FAR
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
        files = [None if out is None else Path(out)]
        (scored,) = run_dense([method], chosen, console=console, seed=seed, limits=limits, files=files)
    else:
        if limits is not None:
            raise MethodError("limits are for methods in a process of their own: give FILE.py:FUNCTION")
        card = MethodCard.of(function_name(method), kind="function", **code_of_function(method))
        with Steps(console, "dense pairs", len(chosen)) as steps:
            asked = outcomes_here(method)(_Shown(chosen), range(len(chosen)))
            (table,) = _records(chosen, asked, [[]], steps.reach)
        alone = "not isolated: a function runs in this process"
        scored = _scored(card, chosen, table, seed, {}, alone, provenance_here(), "")
    return scored if out is None else saved_dense(scored, Path(out))


def chosen_pairs(
    dataset: str | Path | Dataset,
    preset: str | None = None,
    draws: int | None = None,
    pairs: int | None = None,
    frames: int = 1,
    calibration: str | Path | None = None,
    between: bool = False,
) -> DensePairs:
    """Dense pairs of a folder or of an opened data set; parameters and errors as for `dense_pairs`."""
    opened: Any = dataset if isinstance(dataset, Dataset) else open_scored(dataset)
    read = None if calibration is None else read_calibration(calibration)
    return dense_pairs(opened, preset, draws, pairs, frames, read, between)


def run_dense(
    references: Sequence[str],
    pairs: DensePairSet,
    workers: int = 1,
    console: Console | None = None,
    seed: int = 0,
    limits: RunLimits | None = None,
    files: Sequence[Path | None] = (),
) -> list[DenseScored]:
    """Score dense methods on the same pairs, each in a process of its own.

    Parameters
    ----------
    files : paths of the scores to come, one per method, optional
        The records so far lie beside them while the run goes on. A run of the same methods, pairs, limits and code goes
        on from there; `saved_dense` takes them away.

    Raises
    ------
    MethodError
        If a method cannot be found or imported.
    """
    resolved, limits = [resolve(reference, DENSE) for reference in references], limits or RunLimits()
    cards = [MethodCard.of(name, **method.document()) for name, method in zip(references, resolved, strict=True)]
    if not cards:
        return []
    console = console or progress_console()
    so_far = _SoFar.of(files, cards, pairs, limits)
    rows = so_far.read(len(cards), len(pairs) - 1)  # the last pair is asked for: what a method has loaded is known then
    done = len(rows[0])
    if done:
        console.print(f"{done} of {len(pairs)} pairs are those of a run that was interrupted")
    with ExitStack() as stack:
        steps = stack.enter_context(Steps(console, "dense pairs", len(pairs)))
        harness = stack.enter_context(Harness(resolved, limits, workers, pairs.folders))
        shown = _Shown(pairs)
        tables = _records(shown, _asked(harness, shown, workers, done), rows, steps.reach, so_far)
        told = list(zip(harness.isolations, harness.ran, harness.failed_outputs, strict=True))
    return [
        _scored(card, pairs, table, seed, limits.document(), isolation, ran, output)
        for card, table, (isolation, ran, output) in zip(cards, tables, told, strict=True)
    ]


def _asked(harness: Harness, shown: _Shown, workers: int, done: int) -> Iterator[tuple[Outcome, ...]]:
    """Outcomes pair by pair. No more pairs are asked for than are worked on: an answer takes some megabytes."""
    for first in range(done, len(shown), workers):
        yield from harness.outcomes(shown, range(first, min(first + workers, len(shown))))


class _Shown:
    """Pairs and truths of a set for several threads: one is made at a time."""

    def __init__(self, pairs: DensePairSet) -> None:
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


@dataclass(frozen=True)
class _SoFar:
    """Records of the pairs before an interruption, a file per method beside that of its score.

    Attributes
    ----------
    files : tuple of Path
        None without files of scores.
    keys : tuple of str
        Hash of all that records depend on; a file with another one is not read.
    """

    files: tuple[Path, ...] = ()
    keys: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, files: Sequence[Path | None], cards: Sequence[MethodCard], pairs: DensePairSet, limits: RunLimits
    ) -> _SoFar:
        """Files of methods, in their order."""
        known = [_so_far(file) for file in files if file is not None]
        if len(known) != len(cards):
            return cls()
        shared = [pairs.document(), limits.document(), code_behind(SCORER)]
        texts = [json.dumps([card.model_dump(mode="json"), *shared], sort_keys=True, default=str) for card in cards]
        return cls(tuple(known), tuple(hashlib.sha256(text.encode()).hexdigest() for text in texts))

    def read(self, methods: int, most: int) -> list[list[pl.DataFrame]]:
        """Tables of the first pairs that every method has, at most so many: a list per method, a table per pair."""
        found = []
        for file, key in zip(self.files, self.keys, strict=True):
            table = records_so_far(file, key)
            if table is None:
                return [[] for _ in range(methods)]
            found.append(table.partition_by(_KEY, maintain_order=True))
        count = min([most, *map(len, found)])
        return [tables[: max(count, 0)] for tables in found] or [[] for _ in range(methods)]

    def write(self, rows: Sequence[Sequence[pl.DataFrame]]) -> None:
        """Tables of the pairs so far."""
        for file, key, own in zip(self.files, self.keys, rows, strict=False):
            write_bytes(file, parquet_bytes(pl.concat(own).with_columns(pl.lit(key).alias(_RUN))))


_RUN = "run"


def records_so_far(file: Path, key: str) -> pl.DataFrame | None:
    """Records that an interrupted run left, if they are whole and of the same run; else the pairs are asked again."""
    try:
        table = InputFile(file, "score again").table({_RUN: pl.String(), **COLUMN_TYPES})
    except DatasetError:
        return None
    return table.select(list(COLUMN_TYPES)) if table[_RUN].unique().to_list() == [key] else None


def _so_far(file: Path) -> Path:
    return file.with_suffix(RECORDS_SO_FAR)


def _records(
    pairs: DensePairSet | _Shown,
    asked: Iterable[tuple[Outcome, ...]],
    rows: list[list[pl.DataFrame]],
    told: Callable[[int], None],
    so_far: _SoFar | None = None,
) -> list[pl.DataFrame]:
    """Records of every method, after those of the pairs before; of each pair the truth is made once."""
    for outcomes in asked:
        errors = TruthErrors(pairs.truth(outcomes[0].number))
        for own, outcome in zip(rows, outcomes, strict=True):
            message = outcome.message + _on_raw(errors.truth.preset) * (outcome.failure in ("error", "invalid"))
            own.append(pair_records(errors, outcome.dense, outcome.seconds, outcome.failure, message))
        if so_far is not None:
            so_far.write(rows)
        told(len(rows[0]))
    return [pl.concat(own) if own else pl.DataFrame(schema=COLUMN_TYPES) for own in rows]


def _on_raw(preset: str) -> str:
    """Advice for a method that fails on raw images, which may have asked for colour."""
    if not preset.endswith("-raw"):
        return ""
    return f"; images of '{preset}' are raw, (H, W) without colours: a method that needs colours takes --preset mjpeg"


def _scored(
    card: MethodCard,
    pairs: DensePairSet,
    table: pl.DataFrame,
    seed: int,
    limits: Mapping[str, Any],
    isolation: str,
    ran: RunProvenance,
    output: str,
) -> DenseScored:
    card = card.model_copy(update=vars(ran))
    document = dense_document(card, pairs.document(), table, Rules(), seed, limits, isolation)
    return DenseScored(document, table, output)


def saved_dense(scored: DenseScored, file: Path) -> DenseScored:
    """The score, written with its records; its document then names their hash."""
    saved = replace(scored, document=write_score(file, scored.document, scored.records))
    _so_far(file).unlink(missing_ok=True)
    return saved


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
    return metric_differences(
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
