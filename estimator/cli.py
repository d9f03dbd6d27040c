"""The command line ``phibench``: a thin layer over the packages.

Exit codes: 0 done, 1 checked and found wanting, 2 a mistake of the user or the machine in one sentence, 130 Ctrl-C.
Every command imports what it needs itself, so that ``--help`` is quick and scoring runs without Mitsuba.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, CycloptsError, Parameter, Token

if TYPE_CHECKING:
    from phibench.estimator.score import Score

_TABLE_WIDTH = 200


def _whole(_kind: object, tokens: Sequence[Token]) -> int:
    """A whole number as it is written: cyclopts would round 1.5 without a word."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"{tokens[0].value!r} is not a whole number") from None


Whole = Annotated[int, Parameter(converter=_whole)]

app = App(
    name="phibench",
    help="Render an omnidirectional camera-mirror sensor with exact depth, and score depth estimators against it.",
    suppress_keyboard_interrupt=False,
    result_action="return_value",
)
dataset = App(name="dataset", help="Make, verify, repair, merge and show data sets, and draw camera frames.")
app.command(dataset)


@app.command
def score(directory: Path, *, out: Path | None = None) -> int:
    """Score every estimator on a data set and print the paper's tables beside ours.

    Parameters
    ----------
    directory
        Folder of a data set.
    out
        JSON file for all scores.
    """
    from rich.console import Console

    from phibench.datasets.read import open_finished
    from phibench.estimator.score import bias_table, table
    from phibench.estimator.score import score as score_dataset

    scores = score_dataset(open_finished(directory))
    # a table cut off at the width of a pipe or of a narrow terminal would lose numbers
    console = Console()
    console = console if console.width >= _TABLE_WIDTH else Console(width=_TABLE_WIDTH)
    for grid in (table(scores, "truth"), table(scores, "frame"), bias_table(scores)):
        console.print(grid)
    if out is not None:
        _write_scores(out, directory, scores)
    return 0


@app.command
def doctor() -> int:
    """Show Python, packages, LLVM, cores and disk, and render a test image.

    The exit code is 1 if something is broken; an installation that can only score is not.
    """
    # a bad LLVM aborts the process that loads it: never this one
    return subprocess.run([sys.executable, "-m", "phibench.render.doctor"], check=False).returncode


@dataset.command
def make(
    recipe: str,
    *,
    out: Path,
    workers: Whole | None = None,
    scheduler: str | None = None,
    shard: str | None = None,
) -> int:
    """Render a data set; what is finished already is kept.

    Parameters
    ----------
    recipe
        TOML file, or the name of a shipped recipe ("paper", "random", "smoke").
    out
        Folder to write; one that holds another data set is refused.
    workers
        Number of processes; one for each core by default.
    scheduler
        Address or scheduler file of a running dask scheduler, to use its workers instead.
    shard
        Part of the recipe for job arrays, such as 1/8; put the parts together with `merge`.
    """
    from phibench.datasets.make import make as make_dataset

    make_dataset(recipe, out, workers, scheduler=scheduler, shard=shard)
    return 0


@dataset.command
def repair(directory: Path, *, workers: Whole | None = None, scheduler: str | None = None) -> int:
    """Render again what is damaged or missing in a data set.

    Parameters
    ----------
    directory
        Folder of a data set.
    workers
        Number of processes; one for each core by default.
    scheduler
        Address or scheduler file of a running dask scheduler, to use its workers instead.
    """
    from phibench.datasets.repair import repair as repair_dataset

    for name in repair_dataset(directory, workers, scheduler=scheduler):
        print(f"made again: {name}")
    return 0


@dataset.command
def merge(out: Path, *shards: Path) -> int:
    """Put the shards of a data set together.

    Parameters
    ----------
    out
        Folder to write.
    shards
        Folders of all shards.
    """
    from phibench.datasets.merge import merge as merge_shards

    merge_shards(out, shards)
    return 0


@dataset.command
def verify(directory: Path) -> int:
    """Check every file, hash, row and certificate of a data set; exit code 1 if there is a fault.

    Parameters
    ----------
    directory
        Folder of a data set.
    """
    from phibench.datasets.verify import verify as verify_dataset

    report = verify_dataset(directory)
    for fault in report.faults:
        print(fault)
    for note in report.notes:
        print(f"note: {note}")
    print(f"{directory}: {report.files} files, {report.samples} samples, {len(report.faults)} faults")
    return 0 if report.ok else 1


@dataset.command
def show(directory: Path, *, out: Path | None = None) -> int:
    """Print a table of a data set and write its contact sheet.

    Parameters
    ----------
    directory
        Folder of a data set.
    out
        PNG file for the contact sheet; by default contact_sheet.png in the folder.
    """
    from phibench.datasets.show import show as show_dataset

    show_dataset(directory, out=out)
    return 0


@dataset.command
def frames(
    directory: Path,
    *,
    preset: str = "mjpeg",
    draws: Whole = 1,
    out: Path | None = None,
    samples: str | None = None,
    laser_off: bool = False,
    exposure: str | None = None,
    region: Whole | None = None,
    camera_seed: Whole = 0,
    workers: Whole | None = None,
) -> int:
    """Draw camera frames with noise, as PNG, JPEG or EXR files with an index; what is there already is kept.

    Parameters
    ----------
    directory
        Folder of a data set.
    preset
        Where the chain ends: "ideal" (EXR, expected electrons), "mono-raw", "bayer-raw" (PNG of 16 bits that holds
        10-bit DN, not scaled), "srgb8" (PNG) or "mjpeg" (the camera's JPEG; PNG with --region).
    draws
        Draws of every image.
    out
        Folder to write; by default beside the data set, with "-frames" added to its name.
    samples
        Sample ids, joined by commas; all by default.
    laser_off
        Also every image without the spot.
    exposure
        Seconds, or "auto"; by default the preset's.
    region
        Side in pixels of a square around the spot, instead of the whole image.
    camera_seed
        Names the camera whose fixed pattern the frames share.
    workers
        Number of processes; one for each core by default.
    """
    from phibench.datasets.draw_frames import draw_frames
    from phibench.datasets.frame_request import FrameRequest, exposure_of

    seconds = None if exposure is None else exposure_of(exposure)
    request = FrameRequest(preset, seconds, region=region, camera_seed=camera_seed)
    names = None if samples is None else samples.split(",")
    done = draw_frames(directory, request, draws, out=out, samples=names, laser_off=laser_off, workers=workers)
    for note in done.notes:
        print(f"note: {note}")
    print(f"{done.folder}: {done.made} files written, {done.kept} kept, index frames.jsonl")
    return 0


def main(tokens: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    try:
        return int(app(tokens, exit_on_error=False) or 0)
    except CycloptsError:
        return 2  # cyclopts has said what is wrong
    except KeyboardInterrupt:
        print("Interrupted: stopped at your request.", file=sys.stderr)
        return 130
    except (ValueError, OSError) as error:
        if not _is_users(error):
            raise
        print(f"phibench: {_sentence(error)}", file=sys.stderr)
        return 2


def _is_users(error: Exception) -> bool:
    from phibench.datasets.errors import DatasetError
    from phibench.scenes.checks import SceneError

    return isinstance(error, (SceneError, DatasetError, OSError))


def _sentence(error: Exception) -> str:
    """Return the message of an error; an operating system's without its number."""
    if isinstance(error, OSError) and error.strerror and type(error).__module__ == "builtins":
        return f"{error.strerror}: {error.filename}" if error.filename else str(error.strerror)
    return str(error)


def _write_scores(out: Path, directory: Path, scores: Sequence[Score]) -> None:
    from phibench.datasets.files import write_text
    from phibench.datasets.provenance import provenance
    from phibench.estimator.score import as_records, summarise

    document = {
        "dataset": str(directory),
        "provenance": provenance(),
        "unit": "metre; relative errors are fractions of the true depth; null where there is no estimate",
        "summary": as_records(summarise(scores)),
        "scores": as_records(scores),
    }
    write_text(out, json.dumps(document, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    sys.exit(main())
