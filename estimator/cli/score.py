"""Commands `phibench score`, `bench`, `compare` and `report`: methods on the pairs of a data set."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from phibench.estimator.cli.options import MEMORY_MB, SECONDS, BuiltIn, MemoryMb, Methods, Seconds, Whole

if TYPE_CHECKING:
    from rich.console import Console

    from phibench.estimator.benchmark.document import MethodCard, ScoreDocument
    from phibench.estimator.sandbox.resolve import RunLimits


_TABLE_WIDTH = 210


def score(
    directory: Path,
    *,
    method: Methods = None,
    preset: str | None = None,
    draws: Whole | None = None,
    pairs: Whole | None = None,
    hints: bool = True,
    bootstrap_seed: Whole = 0,
    workers: Whole = 1,
    calibration: Path | None = None,
    seconds: Seconds = SECONDS,
    memory_mb: MemoryMb = MEMORY_MB,
    out: Path | None = None,
) -> int:
    """Score methods on the pairs of a data set.

    Parameters
    ----------
    directory
        Folder of a data set.
    preset
        Preset of the sensor; by default those of the data set's recipe.
    draws
        Draws of the noise per sample; by default the recipe's.
    pairs
        Only so many pairs.
    hints
        Show the boxes that pairs have; --no-hints leaves the method to search the whole image.
    bootstrap_seed
        Seed of the bootstrap that makes the intervals.
    workers
        Pairs that are worked on at a time.
    calibration
        File of `phibench calibrate`: its rig's samples, with the calibrated rig, stroke and covariance.
    out
        JSON file for the score, records beside it as Parquet; with several methods their names are added to it.
    """
    from phibench.datasets.errors import DatasetError
    from phibench.estimator.sandbox.resolve import RunLimits

    if not method:
        raise DatasetError(
            "`phibench score` scores methods: give --method, such as --method red_centroid. "
            f"The paper's tables are `phibench paper {directory}`"
        )
    limits = RunLimits(seconds, memory_mb)
    return _score_methods(
        directory, method, preset, draws, pairs, hints, bootstrap_seed, workers, calibration, limits, out
    )


def compare(first: Path, second: Path, *, bootstrap_seed: Whole = 0) -> int:
    """Compare two scores of the same pairs, sample by sample.

    Parameters
    ----------
    first
        JSON file that `score --method --out` wrote, with its Parquet file beside it.
    second
        Another one, of the same pairs.
    bootstrap_seed
        Seed of the bootstrap that makes the intervals.
    """
    from phibench.estimator.benchmark.compare import compare as compare_scores
    from phibench.estimator.benchmark.compare import note_on_code
    from phibench.estimator.benchmark.document import read_score
    from phibench.estimator.benchmark.score_tables import comparison

    differences = compare_scores(first, second, _seed(bootstrap_seed))
    a, b = read_score(first), read_score(second)
    console = _console()
    console.print(comparison(differences, _distinct(first, a), _distinct(second, b)))
    if note := note_on_code(a, b):
        console.print(f"note: {note}", soft_wrap=True)
    if all(item.better == "too few samples" for item in differences):
        console.print(f"Too few samples for any interval: {a.rules['least_samples']:g} are the least.")
    elif all(item.better in ("no difference shown", "too few samples") for item in differences):
        console.print("No metric shows a difference: every interval that there is holds 0.")
    return 0


def report(
    *files: Path, out: Path, study: Annotated[tuple[Path, ...], Parameter(consume_multiple=True, negative="")] = ()
) -> int:
    """Write one HTML page about scores (ranking, errors, causes, the worst images) and studies. It needs no network.

    Parameters
    ----------
    files
        JSON files that `score --method --out` wrote, with their Parquet files beside them.
    out
        HTML file to write.
    study
        Folders that `phibench study` wrote.
    """
    from phibench.estimator.benchmark.report import write_report
    from phibench.estimator.studies.run import section

    print(write_report(files, out, [section(folder) for folder in study]))
    return 0


def _score_methods(
    directory: Path,
    references: Sequence[str],
    preset: str | None,
    draws: int | None,
    count: int | None,
    hints: bool,
    seed: int,
    workers: int,
    calibration: Path | None,
    limits: RunLimits,
    out: Path | None,
) -> int:
    from rich.console import Console

    from phibench.datasets.read import open_finished
    from phibench.datasets.store.files import require_writable
    from phibench.estimator.benchmark.document import MethodCard, write_score
    from phibench.estimator.benchmark.score import run_and_score, wanted_pairs
    from phibench.estimator.benchmark.score_tables import cause_table, depth_line, leaderboard, silences, strata_table
    from phibench.estimator.sandbox.resolve import resolve

    files = _files(out, [MethodCard.of(name, **resolve(name).document()) for name in references])
    for target in filter(None, files):
        require_writable(target)
    pair_set = wanted_pairs(open_finished(directory), preset, draws, count, hints, calibration)
    scored = run_and_score(references, pair_set, workers, Console(stderr=True), "pairs", _seed(seed), limits)
    console, documents = _console(), []
    for one, file in zip(scored, files, strict=True):
        documents.append(one.document if file is None else write_score(file, one.document, one.records))
    console.print(leaderboard(documents))
    if calibration is not None:
        for document in documents:
            console.print(depth_line(document), soft_wrap=True, emoji=False, highlight=False)
    if any(any(kind.values()) for document in documents for kind in document.causes.values()):
        console.print(cause_table(documents))
    for one in scored:
        for line in silences(one.records):
            console.print(f"{one.document.method.name}: {line}", soft_wrap=True, emoji=False, highlight=False)
    if len(documents) == 1:
        console.print(strata_table(documents[0]))
    for file in filter(None, files):
        console.print(f"written: {file}", soft_wrap=True)
    return 0


def _files(out: Path | None, cards: Sequence[MethodCard]) -> list[Path | None]:
    """One file per method: `out` itself for one, with the method's name added for several."""
    from phibench.datasets.errors import DatasetError

    if out is None:
        return [None] * len(cards)
    if out.suffix != ".json":
        raise DatasetError(f"--out {out}: a score is a JSON file; give a name that ends in .json")
    if len(cards) == 1:
        return [out]
    names = ["".join(c if c.isalnum() or c in "-_." else "-" for c in card.name) for card in cards]
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DatasetError(f"--method: two methods are called {twice}; score them in two runs with an --out for each")
    return [out.with_name(f"{out.stem}-{name}.json") for name in names]


def _seed(seed: int) -> int:
    from phibench.datasets.errors import DatasetError

    if seed < 0:
        raise DatasetError(f"--bootstrap-seed {seed}: must be 0 or above")
    return seed


def _distinct(path: Path, document: ScoreDocument) -> str:
    return f"{document.method.name} ({path.name})"


def _console() -> Console:
    """A console as wide as the tables: cut off at the width of a pipe or a narrow terminal they would lose numbers."""
    from rich.console import Console

    console = Console()
    return console if console.width >= _TABLE_WIDTH else Console(width=_TABLE_WIDTH)


def bench(
    directory: Path,
    *,
    out: Path,
    method: BuiltIn = None,
    pairs: Whole | None = None,
    workers: Whole = 1,
    calibration: Path | None = None,
    seconds: Seconds = SECONDS,
    memory_mb: MemoryMb = MEMORY_MB,
) -> int:
    """Run the built-in methods on every preset of a data set and write scores and a report.

    Parameters
    ----------
    directory
        Folder of a finished data set.
    out
        Folder for the scores and report.html.
    pairs
        Only the first so many of each preset.
    workers
        Pairs that are worked on at a time.
    calibration
        File of `phibench calibrate`: only its rig's pairs, with the calibrated rig and stroke.
    """
    from phibench.estimator.benchmark.score import bench as run_bench
    from phibench.estimator.benchmark.score import show
    from phibench.estimator.sandbox.resolve import RunLimits

    limits = RunLimits(seconds, memory_mb)
    done = run_bench(directory, out, method, workers, pairs, calibration=calibration, limits=limits)
    for note in done.notes:
        print(f"note: {note}", file=sys.stderr)
    print(f"{done.report}: the report on {len(done.scores)} scores")
    show(done.report)
    return 0
