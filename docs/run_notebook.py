"""Executed tutorials: `python docs/run_notebook.py docs/tutorials/own_rig.py FOLDER` runs one there, as the tests do.

The tutorials are Python files with cells (jupytext, `py:percent`), so that their changes can be read. They are executed
in a fresh kernel in an empty folder, with `phibench` on the path.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import jupytext
import nbformat
from nbclient import NotebookClient

SECONDS_PER_CELL = 1200


def executed(source: Path, folder: Path) -> Any:
    """Notebook of a tutorial with its outputs, executed in `folder`.

    Raises
    ------
    nbclient.exceptions.CellExecutionError
        If a cell raises, or one of its commands fails.
    """
    folder.mkdir(parents=True, exist_ok=True)
    notebook = jupytext.read(source)
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    kernel = {"env": {**os.environ, "PATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}}
    quiet = ["--log-level=40"]  # the kernel warns that it talks over TCP
    place = {"metadata": {"path": str(folder)}}
    client = NotebookClient(notebook, timeout=SECONDS_PER_CELL, kernel_name="python3", resources=place)
    client.coalesce_streams, client.extra_arguments = True, quiet
    client.execute(**kernel)
    return notebook


def main() -> None:
    """Run the tutorial of the first argument in the folder of the second, and write it there as .ipynb."""
    source, folder = (Path(argument).resolve() for argument in sys.argv[1:3])
    nbformat.write(executed(source, folder), folder / f"{source.stem}.ipynb")


if __name__ == "__main__":
    main()
