"""Files that a method opens in the folders that it may read: its weights, tables and modules of computed names.

Linux tells of every file that is opened in a folder, inotify(7), whichever library opens it. It does not tell by which
process: what others open there while the method runs is among the files.
"""

from __future__ import annotations

import ctypes
import os
import struct
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from phibench.datasets.store.files import WriteError, sha256
from phibench.scenes.validation import printable_line

_OPEN, _FOLDER_EVENT, _LOST = 0x20, 0x40000000, 0x4000  # IN_OPEN, IN_ISDIR, IN_Q_OVERFLOW
_FLAGS = os.O_NONBLOCK | os.O_CLOEXEC
_EVENT = struct.Struct("iIII")  # watch, kind, cookie, length of the name
_DEPTH, _FOLDERS = 6, 1000  # levels of folders, and folders, that are watched: a user has some thousand watches
_READ_BYTES = 1 << 16  # many events at a time
_MOST_FILES, _MOST_BYTES = 200, 1 << 34
"""Files of a method that are hashed; 16 GiB take half a minute."""


class OpenedFiles:
    """Watch over folders from now on; closed by `close`, after which the files can still be asked for.

    Parameters
    ----------
    places : sequence of (title, path)
        Folders, with all below them to a depth of 6, and single files. A title stands before the files' names.
    hidden : sequence of path
        Files and folders that are left out: no method can open them.
    """

    def __init__(self, places: Sequence[tuple[str, Path]], hidden: Sequence[Path] = ()) -> None:
        self._hidden, self._found = [path.resolve() for path in hidden], dict[str, Path]()
        self._watched: dict[int, tuple[str, Path]] = {}
        self._lock = threading.Lock()
        self._handle = self._library().inotify_init1(_FLAGS) if sys.platform == "linux" else -1
        self.complete = self._handle >= 0
        """Every file that was opened is known."""
        for title, path in places if self.complete else ():
            self._watch(title, path.resolve())

    @staticmethod
    def _library() -> ctypes.CDLL:
        return ctypes.CDLL(None)

    def _watch(self, title: str, path: Path) -> None:
        for place in _folders(path, self._hidden) if path.is_dir() else (path,):
            if len(self._watched) >= _FOLDERS:
                self.complete = False
                return  # told: the list may lack files
            name = place.relative_to(path).as_posix() if place != path else ""
            prefix = "/".join(part for part in (title, name) if part)
            watch = self._library().inotify_add_watch(self._handle, os.fsencode(place), _OPEN)
            self.complete = self.complete and watch >= 0
            self._watched.setdefault(watch, (prefix, place))

    def look(self) -> None:
        """Take up what was opened since the last look: the kernel keeps 16 384 events."""
        with self._lock, suppress(BlockingIOError):  # no more events
            while self._handle >= 0:
                self._take(os.read(self._handle, _READ_BYTES))

    def _take(self, events: bytes) -> None:
        start = 0
        while start < len(events):
            watch, kind, _, length = _EVENT.unpack_from(events, start)
            raw = events[start + _EVENT.size : start + _EVENT.size + length].rstrip(b"\0")
            start += _EVENT.size + length
            self.complete = self.complete and not kind & _LOST
            if watch in self._watched and not kind & _FOLDER_EVENT:
                prefix, place = self._watched[watch]
                name = os.fsdecode(raw)
                self._found["/".join(part for part in (prefix, name) if part)] = place / name if name else place

    def close(self) -> None:
        """Watch no more."""
        self.look()
        with self._lock:  # threads that ask the method look, too
            if self._handle >= 0:
                os.close(self._handle)
            self._handle = -1

    def hashes(self, known: Sequence[Path] = ()) -> dict[str, str | None]:
        """SHA-256 of the files that were opened, by name; None of a file that is gone, or beyond 200 files or 16 GiB.

        `known` are files that are hashed elsewhere; they are left out, and so is Python's bytecode.
        """
        self.look()
        left, result, skipped = _MOST_BYTES, dict[str, str | None](), {path.resolve() for path in known}
        for name, path in sorted(self._found.items()):
            real = path.resolve()
            if (
                real in skipped
                or "__pycache__" in path.parts
                or any(real.is_relative_to(folder) for folder in self._hidden)
            ):
                continue  # Python's, or compiled from what is hashed
            left -= real.stat().st_size if real.is_file() else 0
            counts = left >= 0 and len(result) < _MOST_FILES
            result[printable_line(name)] = _hash(real) if counts else None
        return result


def _hash(path: Path) -> str | None:
    try:
        return sha256(path)
    except (OSError, WriteError):  # deleted since, or a pipe
        return None


def _folders(path: Path, hidden: Sequence[Path]) -> Iterator[Path]:
    """A folder and those below it, the nearest first, without links and hidden ones."""
    level = [path]
    for _ in range(_DEPTH):
        below: list[Path] = []
        for folder in level:
            yield folder
            with suppress(OSError):  # a folder that cannot be listed
                below += sorted(Path(entry.path) for entry in os.scandir(folder) if entry.is_dir(follow_symlinks=False))
        level = [entry for entry in below if entry.name != "__pycache__" and entry not in hidden]
