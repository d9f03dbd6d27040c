"""Files that are either complete under their final name or not there at all.

One run at a time in a folder. Locks belong to processes: they vanish with them, and no clock is asked.

The run holds `layout.LOCK`. A task in a worker shares `layout.WORKING`, and a new run waits until nobody does: what a
killed run's workers are still writing is then on the disk before anybody looks.

Reading files of one JSON document a line.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from phibench.datasets.errors import DatasetError
from phibench.datasets.store import schema as layout
from phibench.datasets.store.schema import Document

TEMPORARY_PREFIX = ".phibench-tmp-"
_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_NOT_ALLOWED = {errno.EACCES, errno.EPERM, errno.EROFS}


class WriteError(OSError):
    """A file that could not be written; the message names it, the reason and what to do."""

    def __init__(self, path: Path, error: OSError) -> None:
        super().__init__(error.errno or errno.EIO, error.strerror or str(error), str(path))

    def __str__(self) -> str:
        advice = "give another path"
        if self.errno in _NO_ROOM:
            advice = "free some space or write to another disk"
        elif self.errno in _NOT_ALLOWED:
            advice = "give a place where you may write"
        return f"could not write {self.filename}: {self.strerror}; {advice}"


def write_atomic(path: Path, write: Callable[[Path], None]) -> Path:
    """Let `write` fill a temporary file in the folder of `path`, flush it to the disk, then rename it to `path`.

    On any exception, a full disk and Ctrl-C included, the temporary file is removed and `path` is as before.

    Raises
    ------
    WriteError
        If the operating system refuses.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _write_and_rename(path, write)
        _flush_folder(path.parent)
    except OSError as error:
        raise WriteError(path, error) from error
    return path


def write_bytes(path: Path, data: bytes) -> Path:
    """Write `data` to `path` atomically."""

    def write(temporary: Path) -> None:
        temporary.write_bytes(data)

    return write_atomic(path, write)


def write_text(path: Path, text: str) -> Path:
    """Write `text` to `path` atomically, UTF-8, line ends as they are."""
    return write_bytes(path, text.encode())


def sha256(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def remove_temporary(folder: Path) -> None:
    """Remove what a killed run left under temporary names, in `folder` and below."""
    for path in folder.rglob(TEMPORARY_PREFIX + "*"):
        path.unlink(missing_ok=True)


def _write_and_rename(path: Path, write: Callable[[Path], None]) -> None:
    temporary = _temporary(path)
    try:
        write(temporary)
        _flush(temporary)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _temporary(path: Path) -> Path:
    """Name of a new empty file beside `path`, with its suffix and the permissions of an ordinary file."""
    handle, name = tempfile.mkstemp(prefix=TEMPORARY_PREFIX, suffix=path.suffix, dir=path.parent)
    os.close(handle)
    umask = os.umask(0)
    os.umask(umask)
    Path(name).chmod(0o666 & ~umask)
    return Path(name)


def _flush(path: Path) -> None:
    """Wait until the file is on the disk; here a full disk shows at the latest."""
    handle = os.open(path, os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _flush_folder(folder: Path) -> None:
    """Wait until the new name is on the disk (nothing to do on Windows, where folders cannot be opened)."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def require_writable(path: Path) -> None:
    """Find out before long work whether a file can be written; its folder is made.

    Raises
    ------
    DatasetError
        If not.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        reason = error.strerror or str(error)
        raise DatasetError(f"{path} cannot be written: {reason}; give another path") from error


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


Row = TypeVar("Row", bound=Document)


def read_rows(path: Path, model: type[Row]) -> list[Row]:
    """All documents of a file.

    Raises
    ------
    DatasetError
        If it is missing or not readable, or with the number of the first line that is not such a document.
    """
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError as error:
        raise DatasetError(f"{path} is missing") from error
    except OSError as error:
        raise DatasetError(f"{path} is not readable: {error.strerror or error}") from error
    return [_row(path, model, number, line) for number, line in enumerate(lines, 1)]


def _row(path: Path, model: type[Row], number: int, line: str) -> Row:
    try:
        return model.model_validate_json(line)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        text = f"{where}: {first['msg']}" if where else first["msg"]
        raise DatasetError(f"{path} line {number} is damaged: {text}") from error
