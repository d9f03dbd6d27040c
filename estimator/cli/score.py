"""`phibench score`, `compare`, `report`: methods on pairs, and the depth estimators on the paper's tables.

`phibench bench`: every built-in method on a data set, and one report.

Sealed sets: `phibench dataset seal`, `phibench submit` and `phibench unseal`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from phibench.estimator.cli.options import Whole

if TYPE_CHECKING:
    from rich.console import Console

    from phibench.estimator.benchmark.document import MethodCard, ScoreDocument
    from phibench.estimator.paper.paper_tables import Score


_TABLE_WIDTH = 210


def score(
    directory: Path,
    *,
    method: list[str] | None = None,
    preset: str | None = None,
    draws: Whole | None = None,
    pairs: Whole | None = None,
    hints: bool = True,
    seed: Whole = 0,
    workers: Whole = 1,
    calibration: Path | None = None,
    out: Path | None = None,
) -> int:
    """Score methods on a data set's pairs; without --method, every depth estimator on the paper's tables.

    Parameters
    ----------
    directory
        Folder of a data set.
    method
        Method to score: the name of one that is built in, or FILE.py:FUNCTION. May be given several times.
    preset
        Preset of the sensor; by default those of the data set's recipe.
    draws
        Draws of the noise per sample; by default the recipe's.
    pairs
        Only so many pairs.
    hints
        Show the boxes that pairs have; --no-hints leaves the method to search the whole image.
    seed
        Of the bootstrap that makes the intervals.
    workers
        Pairs that are worked on at a time.
    calibration
        File of `phibench calibrate`: its rig's samples, with the calibrated rig, stroke and covariance.
    out
        JSON file for the score, records beside it as Parquet; with several methods their names are added to it.
    """
    if method:
        return _score_methods(directory, method, preset, draws, pairs, hints, seed, workers, calibration, out)
    _refuse_without_method(preset=preset, draws=draws, pairs=pairs)
    return _score_estimators(directory, calibration, out)


def compare(first: Path, second: Path, *, seed: Whole = 0) -> int:
    """Compare two scores of the same pairs, sample by sample.

    Parameters
    ----------
    first
        JSON file that `score --method --out` wrote, with its Parquet file beside it.
    second
        Another one, of the same pairs.
    seed
        Of the bootstrap that makes the intervals.
    """
    from phibench.estimator.benchmark.compare import compare as compare_scores
    from phibench.estimator.benchmark.compare import note_on_code
    from phibench.estimator.benchmark.document import read_score
    from phibench.estimator.benchmark.score_tables import comparison

    differences = compare_scores(first, second, _seed(seed))
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
    scored = run_and_score(references, pair_set, workers, Console(stderr=True), "pairs", _seed(seed))
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


def _refuse_without_method(**given: object) -> None:
    from phibench.datasets.errors import DatasetError

    if wrong := [name for name, value in given.items() if value is not None]:
        raise DatasetError(f"--{wrong[0]} is for methods: give --method too, or leave --{wrong[0]} out")


def _seed(seed: int) -> int:
    from phibench.datasets.errors import DatasetError

    if seed < 0:
        raise DatasetError(f"--seed {seed}: must be 0 or above")
    return seed


def _distinct(path: Path, document: ScoreDocument) -> str:
    return f"{document.method.name} ({path.name})"


def _console() -> Console:
    """A console as wide as the tables: cut off at the width of a pipe or a narrow terminal they would lose numbers."""
    from rich.console import Console

    console = Console()
    return console if console.width >= _TABLE_WIDTH else Console(width=_TABLE_WIDTH)


def _score_estimators(directory: Path, calibration: Path | None, out: Path | None) -> int:
    from phibench.datasets.read import open_finished
    from phibench.estimator.benchmark.dataset_pairs import of_calibration
    from phibench.estimator.calibration.file import read_calibration
    from phibench.estimator.paper.paper_tables import bias_table, table
    from phibench.estimator.paper.paper_tables import score as score_dataset

    dataset = open_finished(directory)
    calibrated = None if calibration is None else read_calibration(calibration)
    scores = score_dataset(dataset if calibrated is None else of_calibration(dataset, calibrated), calibrated)
    console = _console()
    for grid in (table(scores, "truth"), table(scores, "frame"), bias_table(scores)):
        console.print(grid)
    if out is not None:
        _write_scores(out, directory, scores)
    return 0


def _write_scores(out: Path, directory: Path, scores: Sequence[Score]) -> None:
    from phibench.datasets.store.files import write_text
    from phibench.datasets.store.provenance import provenance
    from phibench.estimator.paper.paper_tables import as_records, summarise

    document = {
        "dataset": str(directory),
        "provenance": provenance(),
        "unit": "metre; relative errors are fractions of the true depth; null where there is no estimate",
        "summary": as_records(summarise(scores)),
        "scores": as_records(scores),
    }
    write_text(out, json.dumps(document, indent=1, allow_nan=False) + "\n")


def bench(
    directory: Path,
    *,
    out: Path,
    methods: str | None = None,
    pairs: Whole | None = None,
    workers: Whole = 1,
    calibration: Path | None = None,
) -> int:
    """Run the built-in methods on every preset of a data set and write scores and a report.

    Parameters
    ----------
    directory
        Folder of a finished data set.
    out
        Folder for the scores and report.html.
    methods
        Names of methods, joined by commas; all that are installed by default.
    pairs
        Only the first so many of each preset.
    workers
        Pairs that are worked on at a time.
    calibration
        File of `phibench calibrate`: only its rig's pairs, with the calibrated rig and stroke.
    """
    from phibench.estimator.benchmark.score import bench as run_bench
    from phibench.estimator.benchmark.score import show

    names = None if methods is None else methods.split(",")
    done = run_bench(directory, out, names, workers, pairs, calibration=calibration)
    for note in done.notes:
        print(f"note: {note}", file=sys.stderr)
    print(f"{done.report}: the report on {len(done.scores)} scores")
    show(done.report)
    return 0


def register(app: App, dataset: App) -> None:
    """Add the commands to the command line."""
    dataset.command(seal)
    app.command(submit)
    app.command(unseal)


def seal(directory: Path, *, out: Path, preset: str | None = None) -> int:
    """Write the frames of a data set without the truth, and a seal that says by hash which truth it was.

    The truth goes into the data set's folder, as `seal_ID.truth.json`: keep both to yourself until the end.

    Parameters
    ----------
    directory
        Folder of a finished data set whose seed is a secret.
    out
        Folder to write and to publish; new or empty.
    preset
        One sensor preset, instead of those of the recipe's [frames].
    """
    from phibench.estimator.benchmark.sealed_set import seal as seal_dataset

    sealed = seal_dataset(directory, out, preset)
    for warning in sealed.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    print(f"{sealed.public}: {sealed.seal.pairs} pairs, seal {sealed.seal.id}; to be published")
    print(f"{sealed.truth_file}: the truth; not to be published before `phibench unseal`")
    return 0


def submit(public: Path, *, method: str, out: Path, workers: Whole = 1) -> int:
    """Run a method on a sealed set and write its answers for who holds the truth.

    Parameters
    ----------
    public
        Folder of the sealed set.
    method
        Name of a method, or a file and its function, such as mine.py:extract.
    out
        JSON file to write.
    workers
        Pairs that are worked on at a time.
    """
    from phibench.estimator.benchmark.submission import submit as submit_method

    done = submit_method(public, method, out, workers)
    print(
        f"{done.path}: {done.answered} of {done.pairs} pairs answered, {done.positions} of {2 * done.pairs} positions"
    )
    if done.silence:
        print(f"most often without a position: {done.silence}")
    return 0


def unseal(public: Path, *, truth: Path, submission: Path, out: Path | None = None) -> int:
    """Prove that truth and submission belong to a sealed set, and score the submission.

    Parameters
    ----------
    public
        Folder of the sealed set.
    truth
        File that `phibench dataset seal` wrote into the data set's folder.
    submission
        File that `phibench submit` wrote.
    out
        JSON file for the score.
    """
    from rich.console import Console

    from phibench.datasets.errors import DatasetError
    from phibench.datasets.store.files import require_writable
    from phibench.estimator.benchmark.answer_errors import Rules
    from phibench.estimator.benchmark.document import write_score
    from phibench.estimator.benchmark.score import score_outcomes
    from phibench.estimator.benchmark.score_tables import cause_table, leaderboard
    from phibench.estimator.benchmark.submission import unseal as unseal_set

    if out is not None:
        if out.suffix != ".json":
            raise DatasetError(f"--out {out}: a score is a JSON file; give a name that ends in .json")
        require_writable(out)
    opened = unseal_set(public, truth, submission)
    print(f"seal {opened.seal.id}: the truth is the sealed one, the submission has each of {opened.seal.pairs} pairs")
    scored = score_outcomes(opened.submission.method, opened.pairs, opened.outcomes, Rules())
    document = scored.document if out is None else write_score(out, scored.document, scored.records)
    console = Console() if Console().width >= _TABLE_WIDTH else Console(width=_TABLE_WIDTH)
    console.print(leaderboard([document]))
    console.print(cause_table([document]))
    if out is not None:
        print(f"written: {out}")
    return 0
