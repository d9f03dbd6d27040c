"""Commands `score`, `bench`, `compare`, `report`, `results`: methods scored on pairs, compared, and shown as pages."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from phibench.cli.options import (
    LIMITS,
    OWN_WORD,
    BootstrapSeed,
    BuiltIn,
    Counts,
    DataFolder,
    Limits,
    Methods,
    OwnOrPreset,
    OwnWord,
    PairsAtOnce,
    Whole,
)

if TYPE_CHECKING:
    from phibench.benchmark.scores.score_document import ScoreDocument
    from phibench.estimator.pair_set import PairSet

Rank = Annotated[
    Literal["phi", "depth"],
    Parameter(help="Error that methods are ranked by, missed spots and false detections counted: phi, or depth for D."),
]


@Parameter(name="*")
@dataclass(frozen=True)
class Output:
    """Form of the tables on the standard output."""

    wide: Annotated[bool, Parameter(negative="", help="Every interval and metric, in 210 columns instead of 80.")] = (
        False
    )
    csv: Annotated[bool, Parameter(negative="", help="Numbers as CSV: every metric with its interval, in full.")] = (
        False
    )
    markdown: Annotated[bool, Parameter(negative="", help="The table in Markdown.")] = False
    latex: Annotated[bool, Parameter(negative="", help="The table in LaTeX, for the package booktabs.")] = False
    json: Annotated[bool, Parameter(negative="", help="The whole as JSON, one score a line: for jq.")] = False

    @property
    def form(self) -> str:
        """Chosen form, "terminal" by default.

        Raises
        ------
        DatasetError
            If several are chosen.
        """
        from phibench.datasets.common.errors import DatasetError

        chosen = [name for name in ("csv", "markdown", "latex", "json") if getattr(self, name)]
        if len(chosen) > 1:
            raise DatasetError(f"--{chosen[0]} and --{chosen[1]}: give one of them")
        return chosen[0] if chosen else "terminal"


_TABLES = Output()


@Parameter(name="*")
@dataclass(frozen=True)
class ChoiceOptions:
    """Pairs that are scored, and what is known of them.

    Parameters
    ----------
    preset
        Preset of the sensor, such as "mjpeg"; by default those of the data set's recipe, and one must be given if it
        names none.
    draws
        Draws of the noise per sample; by default the recipe's.
    pairs
        Only so many pairs.
    hints
        Show the boxes that pairs have; --no-hints leaves the method to search the whole image.
    boxes
        Give every pair boxes of so many pixels a side. The spot is anywhere in them: their centre tells nothing.
    calibration
        File of `phibench calibrate`: its rig's samples, with the calibrated rig, stroke and covariance.
    sensor
        Sensor file of `phibench sensor fit`: its numbers stand for the recipe's and the preset's.
    frames
        Frames of each position with the laser on and with it off, such as 6 6; one of each by default.
    track
        localise: every pair in boxes of 64 pixels; find or depth: whole frames (docs/scoring.md). `phibench bench`
        takes several.
    """

    preset: OwnOrPreset = None
    draws: Whole | None = None
    pairs: Whole | None = None
    hints: bool = True
    boxes: Whole | None = None
    calibration: Path | None = None
    sensor: Path | None = None
    frames: Counts = None
    track: Literal["localise", "find", "depth"] | None = None

    def of(self, directory: Path) -> PairSet:
        """Pairs of a data set, of frames or of pictures.

        Raises
        ------
        DatasetError
            If the folder does not hold them.
        """
        from phibench.benchmark.pair_sets.wanted_pairs import PairChoice, open_scored, wanted_pairs

        known = self.calibration, self.sensor, self.frames, self.track
        choice = PairChoice(self.preset, self.draws, self.pairs, self.hints, self.boxes, *known)
        return wanted_pairs(open_scored(directory), choice)


_ALL = ChoiceOptions()


def score(
    directory: DataFolder,
    *,
    method: Methods = None,
    choice: ChoiceOptions = _ALL,
    rank: Rank = "phi",
    bootstrap_seed: BootstrapSeed = 0,
    workers: PairsAtOnce = 1,
    limits: Limits = LIMITS,
    own: OwnWord = OWN_WORD,
    out: Path | None = None,
    output: Output = _TABLES,
) -> int:
    """Score methods on the pairs of a data set; exit code 1 if one of them failed on every pair.

    Parameters
    ----------
    out
        JSON file for the score, records beside it as Parquet; with several methods their names are added to it.
    """
    from phibench.benchmark.isolation.method_references import resolve
    from phibench.benchmark.scores.score import run_and_score, saved_scores
    from phibench.benchmark.scores.score_document import MethodCard
    from phibench.benchmark.scores.score_files import records_kept, score_files
    from phibench.benchmark.scores.score_tables import nothing_answered, print_scores
    from phibench.datasets.common.errors import DatasetError
    from phibench.datasets.common.progress import progress_console
    from phibench.datasets.store.files import require_writable

    if not method:
        raise DatasetError(
            "`phibench score` scores methods: give --method, such as --method red_centroid. "
            f"The paper's tables are `phibench paper {directory}`"
        )
    run_limits, form, declared = limits.of_run, output.form, own.declared(method)
    files = score_files(out, [MethodCard.of(name, **resolve(name).document()) for name in method])
    for target in filter(None, files):
        require_writable(target)
    pair_set, console, number = choice.of(directory), progress_console(), _seed(bootstrap_seed)
    with records_kept(files):
        scored = run_and_score(method, pair_set, workers, console, "pairs", number, run_limits, None, declared)
    if targets := [file for file in files if file is not None]:
        scored = saved_scores(scored, targets)
    print_scores(scored, form, rank, output.wide, choice.calibration is not None)
    for file in filter(None, files):
        print(f"written: {file}", file=sys.stdout if form == "terminal" else sys.stderr)
    return int(nothing_answered(scored))


def compare(first: Path, second: Path, *, bootstrap_seed: BootstrapSeed = 0, output: Output = _TABLES) -> int:
    """Compare two scores of the same pairs, sample by sample.

    Parameters
    ----------
    first
        JSON file that `score --method --out` wrote, with its Parquet file beside it.
    second
        Another one, of the same pairs.
    """
    from phibench.benchmark.scores.compare import compare as compare_scores
    from phibench.benchmark.scores.compare import note_on_code, note_on_pairs, note_on_size, print_comparison
    from phibench.benchmark.scores.score_files import read_records, read_score
    from phibench.benchmark.scores.score_tables import failure_line

    form, differences = output.form, compare_scores(first, second, _seed(bootstrap_seed))
    a, b = read_score(first), read_score(second)
    # stdout holds the table alone where a program may read it
    print_comparison(differences, _distinct(first, a), _distinct(second, b), form, output.wide)
    lines = sys.stdout if form == "terminal" else sys.stderr
    failures = [
        f"{path}: {one.method.name} {line}"
        for path, one in ((first, a), (second, b))
        if (line := failure_line(read_records(path, one)))
    ]
    for note in filter(None, (*failures, note_on_pairs(a, b, str(first), str(second)), note_on_code(a, b))):
        print(f"note: {note}", file=lines)
    if small := note_on_size(differences, a.rules, min(a.samples, b.samples)):
        print(small, file=lines)
    # an empty table says less
    elif all(item.better in ("no difference shown", "too few samples") for item in differences):
        print("No metric shows a difference: see docs/scoring.md, Paired comparison, for the test.", file=lines)
    return 0


def report(
    *files: Path,
    out: Path,
    rank: Rank = "phi",
    study: Annotated[tuple[Path, ...], Parameter(consume_multiple=True, negative="")] = (),
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
    from phibench.benchmark.reports.report_page import write_report
    from phibench.studies.run import section

    print(write_report(files, out, [section(folder) for folder in study], rank))
    return 0


def results(
    *files: Path,
    out: Path | None = None,
    html: Path | None = None,
    records: Path | None = None,
    dataset_id: str | None = None,
    organization: str | None = None,
    against: str = "chain_fit",
    rank: Rank = "phi",
    bootstrap_seed: Whole = 0,
    json: Annotated[bool, Parameter(negative="", help="Everything as one JSON document on the standard output.")] = (
        False
    ),
) -> int:
    """Write the page of results: every method on every preset, differences, strata, causes, from score files.

    Without --out, --html, --records or --json the page goes to the standard output.

    Parameters
    ----------
    files
        JSON files that `score --out` or `bench` wrote, with their Parquet files beside them.
    out
        Page in Markdown to write.
    html
        Page in HTML to write: one file, without network and scripts.
    records
        Folder for the same scores in the formats of Every Eval Ever and of the Hugging Face Hub.
    dataset_id
        Name of the data set on the Hub, ORGANIZATION/NAME, for the records.
    organization
        Who ran the scores, for the records.
    against
        Method that the others are compared with, sample by sample; the best one where it has no score.
    bootstrap_seed
        Seed of the bootstrap that makes the intervals of differences.
    """
    from json import dumps

    from phibench.benchmark.reports.eval_records import write_eval_records
    from phibench.benchmark.reports.results_page import read_parts, results_document, results_page, write_results
    from phibench.datasets.common.errors import DatasetError

    written = []
    if records is not None:
        if dataset_id is None or organization is None:
            raise DatasetError("--records needs --dataset-id and --organization: whose scores, and of which data set")
        written = write_eval_records(files, records, dataset_id, organization)
    parts = read_parts(files, against, rank, _seed(bootstrap_seed))
    # files first: they are wanted even where the pipe is closed
    for path in [*written, *write_results(parts, out, html, rank)]:
        print(f"written: {path}", file=sys.stderr)
    if json:
        print(dumps(results_document(parts), allow_nan=False))
    elif out is None and html is None and records is None:
        sys.stdout.write(results_page(parts, rank))
    return 0


def _seed(seed: int) -> int:
    from phibench.datasets.common.errors import DatasetError

    if seed < 0:
        raise DatasetError(f"--bootstrap-seed {seed}: must be 0 or above")
    return seed


def _distinct(path: Path, document: ScoreDocument) -> str:
    return f"{document.method.name} ({path.name})"


def bench(
    directory: Path,
    *,
    out: Path,
    method: BuiltIn = None,
    pairs: Whole | None = None,
    workers: PairsAtOnce = 1,
    calibration: Path | None = None,
    track: Annotated[list[Literal["localise", "find", "depth"]] | None, Parameter(negative="")] = None,
    limits: Limits = LIMITS,
) -> int:
    """Run built-in and registered methods on every preset of a data set and write scores and a report.

    The exit code is 1 if a method failed on every pair.

    Parameters
    ----------
    directory
        Folder of a finished data set.
    out
        Folder for the scores and report.html.
    pairs
        Only the first so many of each preset.
    calibration
        File of `phibench calibrate`: only its rig's pairs, with the calibrated rig and stroke.
    track
        Tracks that are run, by default all: find and depth are one run on whole frames. May be given several times.
    """
    from phibench.benchmark.reports.bench import bench as run_bench
    from phibench.benchmark.reports.bench import open_in_browser

    done = run_bench(
        directory, out, method, workers, pairs, calibration=calibration, limits=limits.of_run, tracks=track
    )
    for note in (*done.notes, *done.failures):
        print(f"note: {note}", file=sys.stderr)
    count = len(done.scores)
    print(f"{done.report}: the report on {count} score{'s' * (count != 1)}")
    open_in_browser(done.report)
    return int(bool(done.failures))
