"""Files written whole or not at all, and paths tried for writing before long work; SHA-256; JSON lines as documents.

A file is written under a temporary name, flushed to the disk, then renamed.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import DIGITS, InputFile, bounds_fault, first_fault
from phibench.datasets.store.temporary_folders import TEMPORARY_PREFIX, owned, remove_leftovers, remove_tree
from phibench.scenes.validation import printable_line

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


def write_atomic(path: Path, write: Callable[[Path], None], *, secret: bool = False) -> Path:
    """Let `write` fill a temporary file in the folder of `path`, flush it to the disk, then rename it to `path`.

    On any exception, a full disk and Ctrl-C included, the temporary file is removed and `path` is as before. A secret
    file is its owner's alone (mode 600) from its first byte on.

    Raises
    ------
    WriteError
        If the operating system refuses.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _write_and_rename(path, write, secret)
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


def write_secret(path: Path, text: str) -> Path:
    """Write `text` to `path` atomically, for the eyes of its owner alone."""

    def write(temporary: Path) -> None:
        temporary.write_bytes(text.encode())

    return write_atomic(path, write, secret=True)


_KINDS = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket"}


def require_file(path: Path) -> Path:
    """Path of a regular file, or of a link to one; reading anything else may wait for ever.

    Raises
    ------
    OSError
        If it is missing, a link that leads in a circle, a folder, FIFO, socket or device.
    """
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, f"it is {_KINDS.get(stat.S_IFMT(mode), 'a device')}, not a file", str(path))
    return path


def sha256(path: Path) -> str:
    """SHA-256 of a regular file, hexadecimal."""
    with require_file(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def remove_temporary(folder: Path) -> None:
    """Remove what a killed run left under temporary names, in `folder` and below."""
    for path in folder.rglob(TEMPORARY_PREFIX + "*"):
        if path.is_dir() and not path.is_symlink():
            remove_tree(path)
        else:
            path.unlink(missing_ok=True)


def _write_and_rename(path: Path, write: Callable[[Path], None], secret: bool) -> None:
    temporary = _temporary(path, secret)
    try:
        with owned(temporary):
            write(temporary)
            _flush(temporary)
            temporary.replace(path)
    except BaseException:  # Ctrl-C too: no temporary file stays
        temporary.unlink(missing_ok=True)
        raise


def _temporary(path: Path, secret: bool) -> Path:
    """Name of a new empty file beside `path`, with its suffix; unless secret, with an ordinary file's permissions."""
    handle, name = tempfile.mkstemp(prefix=TEMPORARY_PREFIX, suffix=path.suffix, dir=path.parent)
    os.close(handle)
    if secret:  # mode 600, as the system makes it
        return Path(name)
    umask = os.umask(0)
    os.umask(umask)
    Path(name).chmod(0o666 & ~umask)  # a temporary file is its owner's alone
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
    """Find out before long work whether a file can be written; nothing is made, and its folder is cleared of leftovers.

    Where the folder is not there yet, the nearest one above it is tried. Writing makes those between.

    Raises
    ------
    DatasetError
        If not.
    """
    try:
        if path.is_dir():
            raise DatasetError(f"{path} cannot be written: it is a folder; give the name of a file")
        folder = _nearest_folder(path.parent)
        remove_leftovers(folder)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = error.strerror or str(error)
        raise DatasetError(f"{path} cannot be written: {reason}; give another path") from error


def _nearest_folder(folder: Path) -> Path:
    """Folder itself, or the nearest one above it that is there; an `OSError` where a file or a long name bars it."""
    try:
        folder.stat()
    except FileNotFoundError:
        if folder == folder.parent:
            raise
        return _nearest_folder(folder.parent)
    return folder


# Files of one JSON document a line.

Row = TypeVar("Row", bound=BaseModel)


def read_rows(path: Path, model: type[Row]) -> list[Row]:
    """All documents of a file.

    Raises
    ------
    DatasetError
        If it is missing or not readable, or with the number of the first line that is not such a document.
    """
    data = InputFile(path, "run `phibench dataset verify` to see all faults").read()
    checked = _BEYOND_BOUNDS.search(data) is None  # the model alone would take 1e999, and a number of 300 digits
    lines = data.decode("utf-8", errors="replace").splitlines()
    return [_row(path, model, number, line, checked) for number, line in enumerate(lines, 1)]


_BEYOND_BOUNDS = re.compile(rb"NaN|Infinity|[0-9]{%d}|[eE]\+?[0-9]{3}" % DIGITS)


def _row(path: Path, model: type[Row], number: int, line: str, checked: bool) -> Row:
    try:
        if not checked and (fault := bounds_fault(json.loads(line))):
            raise DatasetError(f"{path} line {number} is damaged: {fault}")
        return model.model_validate_json(line)
    except ValidationError as error:
        raise DatasetError(f"{path} line {number} is damaged: {first_fault(error)}") from error
    except (ValueError, RecursionError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{path} line {number} is damaged: {printable_line(str(error), 200)}") from error
