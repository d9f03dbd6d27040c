"""Locks of a folder: one run at a time writes to it, and none beside the workers of a killed one.

A run holds a lock on `schema.LOCK`. Every task of a worker holds a lock on a file of its own, and a new run waits until
these are free: what a killed run's workers are still writing is then on the disk. Locks belong to processes and vanish
with them; no clock is asked. Lock files are removed when they are given back.
"""

from __future__ import annotations

import contextlib
import os
import platform
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.store import schema
from phibench.datasets.store.temporary_folders import TEMPORARY_PREFIX

PATIENCE_S = 60.0  # for workers of a killed run, which end with their task
_NAMED_S = 1.0  # the holder writes its number at once; a machine that swaps may take longer
_AT_ONCE_S, _POLL_S = 0.2, 0.05  # a holder that is just leaving; time between two looks
_WORKING_PREFIX = f"{TEMPORARY_PREFIX}working-"


@contextlib.contextmanager
def only_run(out: Path) -> Iterator[None]:
    """Hold a folder; refuse when another process does, or when a killed run's worker does not end.

    Who is refused has written nothing into the folder.

    Raises
    ------
    DatasetError
        With one sentence.
    """
    path = out / schema.LOCK
    with _locked(path) as held:
        if not held:
            raise DatasetError(f"another run{_holder(path)} is writing to {out}; wait until it has ended")
        path.write_text(f"{os.getpid()} {platform.node()}")
        try:
            _await_workers(out)
            yield
        finally:
            for left in _working_files(out):  # of workers that were killed
                _remove_if_free(left)
            _unlink(path)


@contextlib.contextmanager
def working(out: Path) -> Iterator[None]:
    """Say that this process writes into a folder, by a locked file of its own."""
    path = out / f"{_WORKING_PREFIX}{uuid.uuid4().hex}"
    with _locked(path):
        try:
            yield
        finally:
            _unlink(path)


def _holder(path: Path) -> str:
    """Process that holds a lock file, in brackets; nothing if the file does not tell within a second."""
    deadline = time.monotonic() + _NAMED_S
    while time.monotonic() < deadline:
        with contextlib.suppress(OSError):
            process, _, node = path.read_text(errors="replace").partition(" ")
            if node and node != platform.node():
                return f" (process {process} on {node})"
            if process.isdecimal() and _is_alive(int(process)):  # not that of a killed run, from before
                return f" (process {process})"
        time.sleep(_POLL_S)
    return ""


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except PermissionError:  # somebody else's
        return True
    except (OSError, OverflowError):
        return False  # gone, or a number that no process has
    return True


def _await_workers(out: Path) -> None:
    deadline = time.monotonic() + PATIENCE_S
    for path in _working_files(out):
        while not _remove_if_free(path):
            if time.monotonic() > deadline:
                raise DatasetError(f"workers of an earlier run are still writing to {out}; end them and try again")
            time.sleep(_POLL_S)


def _working_files(out: Path) -> list[Path]:
    """Files that workers hold or have left; versions before 0.2 left a common one."""
    return sorted(path for path in (*out.glob(f"{_WORKING_PREFIX}*"), out / schema.WORKING) if path.exists())


def _remove_if_free(path: Path) -> bool:
    """Remove a lock file unless a process holds it."""
    with _locked(path) as held:
        if held:
            _unlink(path)
        return held


def _unlink(path: Path) -> None:
    """Remove a lock file that this process holds; a folder that has become read-only keeps it."""
    with contextlib.suppress(OSError):
        path.unlink()


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[bool]:
    """Lock a file, which is made if need be; False if another process holds it."""
    # not at once: the library looks again where the last holder has just removed the file
    lock = FileLock(path, timeout=_AT_ONCE_S, poll_interval=_POLL_S)
    try:
        lock.acquire()
    except Timeout:
        yield False
        return
    try:
        yield True
    finally:
        lock.release()
