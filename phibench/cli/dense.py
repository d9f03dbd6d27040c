"""Commands `phibench dense ...`: methods of D per pixel listed, checked, scored, drawn, compared; pairs exported."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from phibench.cli.options import (
    DEFAULT_PRESET,
    LIMITS,
    METHODS,
    BootstrapSeed,
    DataFolder,
    Flag,
    Limits,
    OutFolder,
    OwnOrPreset,
    PairsAtOnce,
    Preset,
    Whole,
)

if TYPE_CHECKING:
    from phibench.benchmark.dense.dense_pairs import DensePairSet

dense = App(
    name="dense",
    group=METHODS,
    help="Dense depth, the laser off: D of every pixel of the mirror, scored against exact truth (docs/dense.md).",
)
DenseMethods = Annotated[
    list[str] | None,
    Parameter(
        name="--method",
        negative="",
        help="A dense method: a name that `phibench dense list` shows, or FILE.py:FUNCTION. May be given again.",
    ),
]


@dense.command(name="list")
def list_() -> int:
    """List the dense methods: built in, and of installed packages."""
    from phibench.benchmark.isolation.method_references import DENSE, installed_methods
    from phibench.estimator.dense.dense_methods import KNOWN

    for method in KNOWN.values():
        missing = "" if method.installed else f" ({method.needs})"
        print(f"{method.name}: {method.description}{missing}")
    for point in installed_methods(DENSE):
        print(f"{point.name}: {point.value}")
    print("your own: a file and a function in it, my_depth.py:depth; `phibench dense new my_depth.py` writes one")
    return 0


@dense.command
def new(path: Path) -> int:
    """Write an example method that works, to begin with.

    Parameters
    ----------
    path
        Python file to write; one that is there is not touched.
    """
    from phibench.benchmark.isolation.method_references import DENSE, write_example

    written = write_example(path, DENSE)
    print(f"{written}: try it with `phibench dense check {written}:depth`")
    return 0


@dense.command
def check(
    reference: Annotated[str, Parameter(name="--method")],
    *,
    preset: Preset = DEFAULT_PRESET,
    limits: Limits = LIMITS,
    show_output: Flag = False,
) -> int:
    """Try a dense method on three easy pairs and say what is wrong; exit code 1 if something is.

    Parameters
    ----------
    reference
        File and function, my_depth.py:depth, or a name that `phibench dense list` shows.
    preset
        What the camera delivers: "mjpeg", "yuyv", "srgb8", "bayer-raw" or "mono-raw".
    show_output
        Also show what the method prints: the last 20 lines of every pair.
    """
    from phibench.benchmark.dense.dense_check import PAIRS, check_dense
    from phibench.benchmark.isolation.method_references import DENSE, resolve
    from phibench.datasets.common.progress import Steps, progress_console

    resolve(reference, DENSE)  # one that is not there is told before anything begins
    with Steps(progress_console(), "easy pairs", PAIRS, announce=True) as steps:
        done = check_dense(reference, preset, limits.of_run, told=steps.reach)
    sound = "nothing wrong on three easy pairs (conventions only: every surface has a pattern)"
    for line in done.lines(reference, sound, show_output):
        print(line)
    return 0 if done.ok else 1


@dense.command
def score(
    directory: DataFolder,
    *,
    method: DenseMethods = None,
    preset: OwnOrPreset = None,
    draws: Whole | None = None,
    pairs: Whole | None = None,
    frames: Whole = 1,
    between: Flag = False,
    calibration: Path | None = None,
    bootstrap_seed: BootstrapSeed = 0,
    workers: PairsAtOnce = 1,
    limits: Limits = LIMITS,
    out: Path | None = None,
    wide: Flag = False,
) -> int:
    """Score dense methods on the pairs of a data set; exit code 1 if one of them failed on every pair.

    With --out an interrupted run goes on where it stopped.

    Parameters
    ----------
    preset
        What the camera delivers: "mjpeg", "yuyv", "srgb8", "bayer-raw" or "mono-raw". By default the presets that the
        data set's recipe names; if it names none, one must be given.
    draws
        Draws of the noise per sample; by default the recipe's.
    pairs
        Only so many pairs.
    frames
        Frames of each image.
    between
        Also images at the heights between: of shorter strokes in the same place, or frames of a film on its way up.
    calibration
        File of `phibench calibrate`: its rig's samples, with the calibrated rig and stroke.
    out
        JSON file for the score, records beside it as Parquet; with several methods their names are added to it.
    wide
        With intervals below the values.
    """
    from phibench.benchmark.dense.dense_score import run_dense, saved_dense
    from phibench.benchmark.dense.dense_tables import dense_board, dense_failures
    from phibench.benchmark.isolation.method_references import DENSE, resolve
    from phibench.benchmark.scores.score_document import MethodCard
    from phibench.benchmark.scores.score_files import score_files
    from phibench.datasets.common.errors import DatasetError
    from phibench.datasets.common.shown_text import show_grid, table_console
    from phibench.datasets.store.files import require_writable

    if not method:
        raise DatasetError("`phibench dense score` scores methods: give --method, such as --method my_depth.py:depth")
    files = score_files(out, [MethodCard.of(name, **resolve(name, DENSE).document()) for name in method])
    for target in filter(None, files):
        require_writable(target)
    chosen = _scored_pairs(directory, preset, draws, pairs, frames, calibration, between)
    scored = run_dense(method, chosen, workers, None, bootstrap_seed, limits.of_run, files)
    for one, file in zip(scored, files, strict=True):
        if file is not None:
            saved_dense(one, file)
    console = table_console(wide)
    show_grid(console, dense_board([one.document for one in scored], wide))
    for one in scored:
        for line in dense_failures(one.records):
            print(f"{one.document.method.name}: {line}")
    for file in filter(None, files):
        print(f"written: {file}")
    return int(any(sum(one.document.failures.values()) == one.document.pairs for one in scored))


def _scored_pairs(
    directory: Path,
    preset: str | None,
    draws: int | None,
    pairs: int | None,
    frames: int,
    calibration: Path | None,
    between: bool,
) -> DensePairSet:
    """Pairs of a data set, of films, or of a dense set, whose frames are drawn."""
    from phibench.benchmark.dense.dense_films import MOST_BETWEEN, DenseFilms
    from phibench.benchmark.dense.dense_score import chosen_pairs
    from phibench.benchmark.sealed.dense_set import DENSE_SEAL, DENSE_SET, DenseSet
    from phibench.datasets.common.errors import DatasetError
    from phibench.datasets.store.schema import TruthFolder

    if (directory / TruthFolder.FILMS.value).is_file():
        if calibration is not None or frames != 1:
            raise DatasetError(f"{directory} holds films: leave --calibration and --frames out")
        return DenseFilms(directory, preset, 1 if draws is None else draws, pairs, MOST_BETWEEN * between)
    if not any((directory / name).is_file() for name in (DENSE_SET, DENSE_SEAL)):
        return chosen_pairs(directory, preset, draws, pairs, frames, calibration, between)
    if between or any(option is not None for option in (preset, draws, calibration)) or frames != 1:
        raise DatasetError(
            f"{directory} holds frames that are drawn: leave --preset, --draws, --frames, --between, --calibration out"
        )
    return DenseSet(directory, pairs)


@dense.command
def picture(
    directory: DataFolder,
    *,
    method: str,
    out: Path | None = None,
    html: Path | None = None,
    sample: str | None = None,
    preset: Preset = DEFAULT_PRESET,
    limits: Limits = LIMITS,
) -> int:
    """Draw the answer for one sample: image, D, error and causes as panoramas, and the room from above.

    Parameters
    ----------
    method
        A name that `phibench dense list` shows, or FILE.py:FUNCTION.
    out
        Folder for two pictures.
    html
        File of an interactive page: each pixel with its true and its answered D and place, and the room.
    sample
        Id or number of the sample; the first by default.
    preset
        What the camera delivers: "mjpeg", "yuyv", "srgb8", "bayer-raw" or "mono-raw".
    """
    from phibench.benchmark.dense.dense_page import DensePage
    from phibench.benchmark.dense.dense_pictures import picture_of
    from phibench.benchmark.dense.dense_score import chosen_pairs
    from phibench.benchmark.isolation.method_references import DENSE, resolve
    from phibench.datasets.common.errors import DatasetError
    from phibench.datasets.store.files import require_writable, write_bytes

    if out is None and html is None:
        raise DatasetError("name what to write: --out FOLDER for pictures, --html FILE for an interactive page")
    resolve(method, DENSE)  # one that is not there is told before anything begins
    if html is not None:
        require_writable(html)
    pairs = chosen_pairs(directory, preset, 1)
    drawn = picture_of(method, pairs, sample, limits.of_run)
    if out is not None:
        for name, data in (("panoramas.png", drawn.panoramas_png()), ("above.png", drawn.from_above_png())):
            print(f"written: {write_bytes(out / name, data)}")
    if html is not None:
        print(f"written: {DensePage(drawn, pairs).write(html)}")
    return 0


@dense.command
def export(
    directory: DataFolder,
    *,
    out: OutFolder,
    preset: OwnOrPreset = None,
    draws: Whole | None = None,
    pairs: Whole | None = None,
) -> int:
    """Write dense pairs for other tools: camera frames, and exact D and counterparts as 32-bit planes (OpenEXR).

    Parameters
    ----------
    preset
        What the camera delivers: "mjpeg", "yuyv", "srgb8", "bayer-raw" or "mono-raw". By default the presets that the
        data set's recipe names; if it names none, one must be given.
    draws
        Draws of the noise per sample; by default the recipe's.
    pairs
        Only so many pairs.
    """
    from phibench.benchmark.dense.dense_score import chosen_pairs
    from phibench.benchmark.export.dense_export import export_dense
    from phibench.datasets.common.progress import Steps, progress_console

    chosen = chosen_pairs(directory, preset, draws, pairs)
    with Steps(progress_console(), "dense pairs", len(chosen)) as steps:
        written = export_dense(chosen, out, steps.reach)
    print(f"{written}: {len(chosen)} dense pairs, dense.jsonl lists them")
    return 0


@dense.command
def compare(first: Path, second: Path, *, bootstrap_seed: BootstrapSeed = 0) -> int:
    """Compare two dense scores of the same pairs, pair by pair.

    Parameters
    ----------
    first
        JSON file that `dense score --out` wrote, with its Parquet file beside it.
    second
        Another one, of the same pairs.
    """
    from phibench.benchmark.dense.dense_score import compare_dense, read_dense
    from phibench.benchmark.dense.dense_tables import dense_differences
    from phibench.datasets.common.shown_text import show_grid, table_console

    differences = compare_dense(first, second, bootstrap_seed)
    names = [read_dense(path).method.name for path in (first, second)]
    if names[0] == names[1]:
        names = [f"{name} ({path.name})" for name, path in zip(names, (first, second), strict=True)]
    show_grid(table_console(False), dense_differences(differences, *names))
    if all(item.better == "too few samples" for item in differences):
        print("Too few samples for a verdict: 30 are the least (docs/scoring.md, Paired comparison).")
    return 0


@dense.command
def show(*files: Path, by: Literal["methods", "parts", "metrics"] = "methods", out: Path | None = None) -> int:
    """Show dense scores: methods side by side, or each one's parts or metrics; --out writes a page of results.

    Parameters
    ----------
    files
        JSON files that `dense score --out` wrote.
    by
        methods: one row each; parts: by D, elevation, texture, edges, stroke and room; metrics: all, with intervals.
    out
        Markdown file to write: all tables, and each method compared with the next one.
    """
    from phibench.benchmark.dense.dense_results import write_dense_results
    from phibench.benchmark.dense.dense_score import read_dense
    from phibench.benchmark.dense.dense_tables import dense_board, dense_metrics_table, dense_strata_table
    from phibench.datasets.common.shown_text import show_grid, table_console

    scores, console = [read_dense(path) for path in files], table_console(by == "metrics")
    if not scores:
        print("give one score or more: JSON files of `phibench dense score --out`", file=sys.stderr)
        return 1
    if out is not None:
        print(f"written: {write_dense_results(files, out)}")
        return 0
    if by == "methods":
        show_grid(console, dense_board(scores))
    for score in scores if by != "methods" else ():
        show_grid(console, dense_strata_table(score) if by == "parts" else dense_metrics_table(score))
    return 0
