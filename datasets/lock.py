"""One run at a time in a folder. Locks belong to processes: they vanish with them, and no clock is asked.

The run holds `layout.LOCK`. A task in a worker shares `layout.WORKING`, and a new run waits until nobody does: what a
killed run's workers are still writing is then on the disk before anybody looks.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

from phibench.datasets import layout
from phibench.datasets.errors import DatasetError

PATIENCE_S = 60.0
_POLL_S = 0.05


@contextlib.contextmanager
def only_run(out: Path) -> Iterator[None]:
    """Hold a folder; refuse when another process does, or when a killed run's worker does not end.

    Raises
    ------
    DatasetError
        With one sentence.
    """
    with _open(out / layout.LOCK) as lock:
        if not _try(lock, fcntl.LOCK_EX):
            holder = os.pread(lock, 32, 0).decode(errors="replace").strip()
            raise DatasetError(f"another run (process {holder or '?'}) is writing to {out}; wait until it has ended")
        os.ftruncate(lock, 0)
        os.pwrite(lock, str(os.getpid()).encode(), 0)
        _await_workers(out)
        yield


@contextlib.contextmanager
def working(out: Path) -> Iterator[None]:
    """Say that this process writes into a folder."""
    with _open(out / layout.WORKING) as lock:
        fcntl.flock(lock, fcntl.LOCK_SH)
        yield


def _await_workers(out: Path) -> None:
    deadline = time.monotonic() + PATIENCE_S
    with _open(out / layout.WORKING) as lock:
        while not _try(lock, fcntl.LOCK_EX):
            if time.monotonic() > deadline:
                raise DatasetError(f"workers of an earlier run are still writing to {out}; end them and try again")
            time.sleep(_POLL_S)


def _try(lock: int, kind: int) -> bool:
    try:
        fcntl.flock(lock, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


@contextlib.contextmanager
def _open(path: Path) -> Iterator[int]:
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        yield handle
    finally:
        os.close(handle)
