"""Benchmark of methods on a pair set: run them, compare with the truth, name causes, keep the worst images.

`score_methods` is for methods that are run, `score_outcomes` for answers that are there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Unpack

import polars as pl
from rich.console import Console

from phibench.benchmark.isolation.method_references import code_of_function, resolve
from phibench.benchmark.isolation.prefetched_pairs import PrefetchedPairs
from phibench.benchmark.isolation.run_limits import MethodError, RunLimits
from phibench.benchmark.isolation.runner import Harness, RunProvenance, function_name, outcomes_here, provenance_here
from phibench.benchmark.pair_sets.dataset_pairs import DatasetPairs
from phibench.benchmark.pair_sets.frames_set import FramesSet
from phibench.benchmark.pair_sets.wanted_pairs import (
    CalibratedPairs,
    ChoiceKeywords,
    PairChoice,
    open_scored,
    wanted_pairs,
)
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.failure_causes import with_causes
from phibench.benchmark.scores.fit_at_truth import KeptFits
from phibench.benchmark.scores.records import in_order, missed_relative, record_table, with_missed
from phibench.benchmark.scores.score_document import Declared, Division, MethodCard, ScoreDocument, document_of
from phibench.benchmark.scores.score_files import UnfinishedError, records_kept, write_score
from phibench.benchmark.scores.score_tables import score_table
from phibench.benchmark.scores.worst_images import Worst, worst_images, worst_of, worst_records
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.progress import Steps, progress_console
from phibench.datasets.common.shown_text import ShortForm, text_of
from phibench.datasets.read import Dataset
from phibench.datasets.store.files import require_writable
from phibench.estimator.interface import Method, Outcome
from phibench.estimator.pair_set import CachedPairs, PairSet, truth_folders

Ask = Callable[[PairSet, Sequence[int]], Iterable[tuple[Outcome, ...]]]
"""Pairs and numbers to the outcomes of every method: `isolation.runner.Harness.outcomes`."""
_LATE = "late"
AT_ONCE = 16
"""Pairs that are examined together; twice as many are in memory. One of MJPEG frames, on and off, takes 11 MB."""


@dataclass(frozen=True, repr=False)
class Scored(ShortForm):
    """A score, the records that it was computed from, and what the method printed where it first failed.

    Its `repr` is the table that `phibench score` prints first.
    """

    document: ScoreDocument
    records: pl.DataFrame
    output: str = ""

    def __repr__(self) -> str:
        return text_of(score_table(self.document))


@dataclass(frozen=True)
class Examined:
    """Some pairs of one method: records with causes, and its worst images among them.

    `leading` are the records of the worst images of these and all pairs before.
    """

    records: pl.DataFrame
    worst: list[Worst]
    leading: pl.DataFrame


def score_methods(
    methods: Sequence[MethodCard],
    pairs: PairSet,
    ask: Ask,
    rules: Rules | None = None,
    seed: int = 0,
    limits: Mapping[str, Any] | None = None,
    told: Callable[[int], None] = lambda done: None,
    stages: dict[str, float] | None = None,
) -> list[Scored]:
    """Run methods on all pairs of a set and score them; each pair is simulated once for all of them.

    Parameters
    ----------
    methods : sequence of MethodCard, in the order in which `ask` answers
    rules : Rules, by default the usual ones
    seed : int
        Of the bootstrap; 0 or above.
    limits : the harness's, for the record
    told : callable
        Given the number of pairs that are answered, after each.
    stages : dict, optional
        Gets the CPU-seconds of "bounds" and of "statistics", causes and worst images included.

    Raises
    ------
    DatasetError
        If the set is sealed or empty, or an outcome belongs to no pair.
    """
    rules = rules or Rules()
    parts: list[list[Examined]] = [[] for _ in methods]
    batches, answered = _asked(pairs, ask), 0
    following = next(batches, None)
    while following is not None:
        # the next pairs are asked for first: methods work on them while these are examined
        (held, asked), following = following, next(batches, None)
        answers: list[tuple[Outcome, ...]] = []
        try:
            for outcomes in asked:
                answers.append(outcomes)
                told(answered + len(answers))
            _examine_each(parts, held, answers, rules, stages)
        except DatasetError as error:
            raise _unfinished(error, parts, held, answers, rules) from error
        answered += len(answers)
        if stages is not None:
            for stage, seconds in (("bounds", held.truth_seconds), (_LATE, held.late_seconds)):
                stages[stage] = stages.get(stage, 0.0) + seconds
    with _timed("statistics", stages):
        return [
            _scored(method, pairs, part, rules, seed, limits or {}) for method, part in zip(methods, parts, strict=True)
        ]


def _examine_each(
    parts: list[list[Examined]],
    held: CachedPairs,
    answers: Sequence[tuple[Outcome, ...]],
    rules: Rules,
    stages: dict[str, float] | None = None,
) -> None:
    """Examine the answers of every method on the same pairs; all are added, or none."""
    fits, added = KeptFits(), []
    for part, outcomes in zip(parts, zip(*answers, strict=True), strict=True):
        with _timed("statistics", stages):
            added.append(examine(held, outcomes, rules, part[-1].leading if part else None, fits))
    for part, examined in zip(parts, added, strict=True):
        part.append(examined)


def _unfinished(
    error: DatasetError,
    parts: list[list[Examined]],
    held: CachedPairs,
    answers: Sequence[tuple[Outcome, ...]],
    rules: Rules,
) -> DatasetError:
    """The error with the records of the pairs before; of a pair whose truth cannot be read there are none."""
    with suppress(DatasetError):  # another pair's truth cannot be read either: these records are not written
        if answers:
            _examine_each(parts, held, answers, rules)
    if not all(parts):
        return error
    records = [pl.concat([part.records for part in own]) for own in parts]
    return UnfinishedError(str(error), records, records[0]["number"].n_unique())


def _asked(pairs: PairSet, ask: Ask) -> Iterator[tuple[CachedPairs, Iterable[tuple[Outcome, ...]]]]:
    """Some pairs of a set and their outcomes to come, then the next ones."""
    held = None
    for start in range(0, len(pairs), AT_ONCE):
        held = CachedPairs(pairs, held)
        yield held, ask(held, range(start, min(start + AT_ONCE, len(pairs))))


@contextmanager
def _timed(stage: str, stages: dict[str, float] | None) -> Iterator[None]:
    start = time.thread_time()
    yield
    if stages is not None:
        stages[stage] = stages.get(stage, 0.0) + time.thread_time() - start


def score_outcomes(
    method: MethodCard,
    pairs: PairSet,
    outcomes: Iterable[Outcome],
    rules: Rules,
    seed: int = 0,
    limits: Mapping[str, Any] | None = None,
    told: Callable[[int], None] = lambda done: None,
) -> Scored:
    """Score what a method has answered on all pairs; parameters as for `score_methods`."""
    ordered = in_order(outcomes, len(pairs))
    parts: list[Examined] = []
    for i in range(0, max(len(ordered), 1), AT_ONCE):
        leading = parts[-1].leading if parts else None
        parts.append(examine(CachedPairs(pairs), ordered[i : i + AT_ONCE], rules, leading))
        told(min(i + AT_ONCE, len(ordered)))
    return _scored(method, pairs, parts, rules, seed, limits or {})


def examine(
    pairs: PairSet,
    outcomes: Sequence[Outcome],
    rules: Rules,
    before: pl.DataFrame | None = None,
    fits: KeptFits | None = None,
) -> Examined:
    """Join outcomes with truth and images.

    Parameters
    ----------
    outcomes : of some of the pairs
    before : optional
        `Examined.leading` of the pairs before.
    fits : KeptFits, optional
        Fits at the truth of the same pairs, which methods share.
    """
    truths = [pairs.truth(outcome.number) for outcome in outcomes]
    table = record_table(truths, outcomes, rules)
    table = with_causes(table, pairs, rules, fits or KeptFits())
    return Examined(table, worst_images(table, pairs, before=before), worst_records(table, before=before))


def _scored(
    method: MethodCard, pairs: PairSet, parts: Sequence[Examined], rules: Rules, seed: int, limits: Mapping[str, Any]
) -> Scored:
    if not parts:
        raise DatasetError("the pair set is empty: there is nothing to score")
    table = pl.concat([part.records for part in parts])
    missed = missed_relative(table, rules)
    table = with_missed(table, missed)
    document = document_of(method, pairs.document(), table, rules, seed, limits, missed)
    entries = [entry for part in parts for entry in part.worst]
    return Scored(document.model_copy(update={"worst": worst_of(table, entries)}), table)


def score(
    dataset: str | Path | Dataset | FramesSet,
    method: str | Method,
    preset: str | None = None,
    *,
    limits: RunLimits | None = None,
    workers: int = 1,
    seed: int = 0,
    out: str | Path | None = None,
    console: Console | None = None,
    division: Division | None = None,
    self_calibrates: bool = False,
    **choice: Unpack[ChoiceKeywords],
) -> Scored:
    """Score one method on the pairs of a data set: `phibench.score`.

    Parameters
    ----------
    dataset : folder of a finished data set or frames set, or an opened one (also a slice of one)
    method : str or function
        Name of a built-in method, or "FILE.py:FUNCTION": it runs in a process of its own, with limits. A function runs
        in this process: no limits, and it can be stopped with a debugger.
    preset : str, optional
        Preset of the sensor; by default those of the recipe's `[frames]`.
    limits : RunLimits, optional
        Of time and memory; not for a function.
    workers : int
        Pairs that are worked on at a time; 1 for a function.
    seed : int
        Of the bootstrap; 0 or above.
    out : path, optional
        JSON file to write, with its Parquet file beside it.
    console : Console, optional
        Where progress goes; by default the standard error.
    division, self_calibrates : optional
        What you say of your method, as `Declared`: "closed" if it was tuned on dev alone, "open" by default.
    **choice
        Fields of `PairChoice` but the preset: draws, pairs, hints, boxes_px, calibration, sensor, frames, track.

    Returns
    -------
    Scored
        `document` as in the JSON file, `records` as a polars table: one row per image.

    Raises
    ------
    DatasetError
        If data set, preset or calibration will not do.
    MethodError
        If the method cannot be found or imported.
    """
    console, declared = console or progress_console(), Declared(division, self_calibrates)
    opened = dataset if isinstance(dataset, Dataset | FramesSet) else open_scored(dataset)
    if out is not None:
        require_writable(Path(out))
    chosen = wanted_pairs(opened, PairChoice(preset, **choice))
    if isinstance(method, str):
        with records_kept([None if out is None else Path(out)]):
            (scored,) = run_and_score([method], chosen, workers, console, "pairs", seed, limits, None, declared)
    else:
        if limits is not None or workers != 1:
            raise MethodError("limits and workers are for methods in a process of their own: give FILE.py:FUNCTION")
        with Steps(console, "pairs", len(chosen)) as steps:
            code = code_of_function(method) | declared.fields("function")
            card = MethodCard.of(function_name(method), kind="function", **code)
            (scored,) = score_methods([card], chosen, outcomes_here(method), None, seed, None, steps.reach)
        scored = with_provenance(
            with_isolation(scored, "not isolated: a function runs in this process"), provenance_here()
        )
    return scored if out is None else saved_score(scored, Path(out))


def saved_score(scored: Scored, file: Path) -> Scored:
    """The score, written with its records; its document then names their hash."""
    return replace(scored, document=write_score(file, scored.document, scored.records))


def saved_scores(scores: Sequence[Scored], files: Sequence[Path]) -> list[Scored]:
    """The scores, each written for itself: a file that cannot be written costs no other method its score.

    Raises
    ------
    DatasetError
        When all others are written, with the files that are not.
    """
    written, faults = [], []
    for score, file in zip(scores, files, strict=True):
        try:
            written.append(saved_score(score, file))
        except (DatasetError, OSError) as error:  # the others are written all the same
            faults.append(f"{file} could not be written: {error}")
    if faults:
        told = f"{len(written)} of {len(files)} scores are written" if written else "no score is written"
        raise DatasetError(f"{'; '.join(faults)}; {told}")
    return written


def run_and_score(
    references: Sequence[str],
    pairs: PairSet,
    workers: int,
    console: Console,
    title: str,
    seed: int = 0,
    limits: RunLimits | None = None,
    stages: dict[str, float] | None = None,
    declared: Declared | None = None,
) -> list[Scored]:
    """Score methods on the same pairs, built-in ones in one process, others in their own; parameters as for `bench`.

    `stages` gets the CPU-seconds by stage: of all pairs together. `declared` is of methods that are not built in.

    Raises
    ------
    MethodError
        If a method cannot be found or imported.
    """
    resolved, limits = [resolve(reference) for reference in references], limits or RunLimits()
    declared = declared or Declared()
    cards = [
        MethodCard.of(name, **method.document(), **declared.fields(method.kind))
        for name, method in zip(references, resolved, strict=True)
    ]
    if not cards:
        return []
    # the steps first: they tell of time that goes by while methods start
    with (
        Steps(console, title, len(pairs)) as steps,
        _ahead(pairs, workers) as (made, making),
        Harness(resolved, limits, workers, truth_folders(pairs)) as harness,
    ):
        scored = score_methods(cards, made, harness.outcomes, None, seed, limits.document(), steps.reach, stages)
    if stages is not None:
        stages.update(harness.stages)
        # bounds are made in the turns of pairs, but for the late ones: `CachedPairs`
        stages["draw"] -= stages["bounds"] - stages.pop(_LATE)
        stages |= {stage: stages[stage] + seconds for stage, seconds in making.items()}
    told = zip(scored, harness.failed_outputs, harness.isolations, harness.ran, strict=True)
    return [
        replace(with_provenance(with_isolation(one, isolation), ran), output=output)
        for one, output, isolation, ran in told
    ]


_WORTH_A_PROCESS = 40  # pairs; a process that makes them starts in 2 s


@contextmanager
def _ahead(pairs: PairSet, workers: int) -> Iterator[tuple[PairSet, dict[str, float]]]:
    """Pairs of a data set made by as many processes as work on them, and their CPU-seconds by stage.

    Few pairs, and those of other sets, are made here.
    """
    drawn = pairs.pairs if isinstance(pairs, CalibratedPairs) else pairs
    if workers == 1 or len(pairs) < _WORTH_A_PROCESS or not isinstance(drawn, DatasetPairs):
        yield pairs, {}
        return
    with PrefetchedPairs(drawn, workers) as made:
        yield CalibratedPairs(made, pairs.calibration) if isinstance(pairs, CalibratedPairs) else made, made.seconds


def with_isolation(scored: Scored, isolation: str) -> Scored:
    """The score with how its method was isolated."""
    return replace(scored, document=scored.document.model_copy(update={"isolation": isolation}))


def with_provenance(scored: Scored, ran: RunProvenance) -> Scored:
    """The score with packages and files of its method."""
    card = scored.document.method.model_copy(update=vars(ran))
    return replace(scored, document=scored.document.model_copy(update={"method": card}))
