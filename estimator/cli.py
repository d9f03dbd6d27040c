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
from typing import TYPE_CHECKING

from cyclopts import App, CycloptsError

from phibench.estimator.cli_calibration import align, calibrate
from phibench.estimator.cli_dataset import dataset

if TYPE_CHECKING:
    from phibench.estimator.score import Score

_TABLE_WIDTH = 200


app = App(
    name="phibench",
    help="Render an omnidirectional camera-mirror sensor with exact depth, and score depth estimators against it.",
    suppress_keyboard_interrupt=False,
    result_action="return_value",
)
app.command(dataset)
app.command(calibrate)
app.command(align)


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
