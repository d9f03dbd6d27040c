"""The output folder: may it be written, does it hold another data set, is there room, what in it is of the past."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection
from pathlib import Path

from phibench.datasets import layout
from phibench.datasets.errors import DatasetError
from phibench.datasets.estimate import megabytes
from phibench.datasets.files import TEMPORARY_PREFIX, write_bytes
from phibench.datasets.info import read_info
from phibench.datasets.journal import Head, Journal

_OWN = ".phibench-"  # locks, and temporary files that a killed run left


def claim(out: Path, name: str) -> None:
    """Make the folder, refuse one that holds something else, try to write to it.

    Raises
    ------
    DatasetError
        With one sentence that says what to do.
    """
    if out.exists() and not out.is_dir():
        raise DatasetError(f"{out} is a file; give a folder")
    _refuse_other(out, name)
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_bytes(out / f"{TEMPORARY_PREFIX}probe", b"").unlink()
    except OSError as error:
        raise DatasetError(f"cannot write to {out}: {error.strerror or error}; give another folder") from error


def check_disk(out: Path, needed: int, replaced: Collection[str]) -> None:
    """Refuse when the disk has no room; files that will be replaced count as free."""
    held = sum(path.stat().st_size for name in replaced if (path := out / name).is_file())
    free = shutil.disk_usage(out).free + held
    if needed > free:
        text = f"about {megabytes(needed)} are needed and {megabytes(free)} are free at {out}"
        raise DatasetError(f"{text}; free some space or give a folder on another disk")


def stale_files(out: Path, expected: Collection[str]) -> list[str]:
    """Files that are called like a task's and that no task of now writes: of removed samples and poses."""
    below = (path for top in ("views", "spots", "previews") for path in (out / top).rglob("*"))
    names = [path.relative_to(out).as_posix() for path in (*out.glob(layout.LIGHT_MAP), *below)]
    wanted = set(expected)
    return sorted(name for name in names if layout.is_task_file(name) and name not in wanted)


def remove_files(out: Path, names: Collection[str]) -> None:
    """Delete files, and the folders that this empties."""
    for name in names:
        path = out / name
        path.unlink(missing_ok=True)
        if not any(path.parent.iterdir()):
            path.parent.rmdir()


def held_head(out: Path) -> Head | None:
    """What the folder says it holds: by its journal, else by its `dataset.json`; None for an empty one.

    Raises
    ------
    DatasetError
        If it holds something else.
    """
    if not out.is_dir() or all(path.name.startswith(_OWN) for path in out.iterdir()):
        return None
    head = Journal(out).head
    if head is not None:
        return head
    if not (out / layout.INFO).is_file():
        raise DatasetError(f"{out} is not empty and holds no data set; give an empty or a new folder")
    read_info(out)
    recipe = (out / layout.RECIPE).read_text(encoding="utf-8") if (out / layout.RECIPE).is_file() else ""
    return Head((out / layout.INFO).read_text(encoding="utf-8"), recipe)


def _refuse_other(out: Path, name: str) -> None:
    head = held_head(out)
    if head is not None and (held := json.loads(head.info)["name"]) != name:
        raise DatasetError(f"{out} holds another data set ('{held}'); give another folder or delete it")
