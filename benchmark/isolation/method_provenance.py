"""Packages that a method's process has loaded, versions and hashes; files that it opens in folders that it may read.

The process tells the names of its modules. Versions are looked up outside it, in the metadata of the same environment,
and an installed package has the hash of its files. Opened files are weights, tables and modules of computed names.
Linux tells of every file that is opened in a folder, inotify(7), whichever library opens it. It does not tell by which
process: what others open there while the method runs is among the files.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import struct
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache, lru_cache
from importlib.metadata import Distribution, PackageNotFoundError, distribution, packages_distributions
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from phibench.datasets.store.files import WriteError, sha256
from phibench.scenes.validation import printable_line

MOST_NAMES = 4096
"""Modules that a process tells of."""
_LONGEST_NAME = 100  # of a module: what is longer is no package's


def loaded_names(folder: str = "") -> list[str]:
    """Names of this process's packages and modules, without the standard library's and those below `folder`.

    A part of a namespace package stands with its own name, "google.protobuf".
    """
    names = set[str]()
    with suppress(Exception):  # a method may put anything into sys.modules
        for name, module in list(sys.modules.items()):
            if isinstance(name, str) and len(name) <= _LONGEST_NAME and _is_of_others(name, module, folder):
                names.add(_unit(name))
    return sorted(names)[:MOST_NAMES]


def _is_of_others(name: str, module: Any, folder: str) -> bool:
    if name.partition(".")[0] in sys.stdlib_module_names:
        return False  # Python's own
    file = getattr(module, "__dict__", {}).get("__file__")
    return isinstance(file, str) and not (folder and Path(file).is_relative_to(folder))


def _unit(name: str) -> str:
    """First part of a module's name that is no namespace."""
    parts = name.split(".")
    for count in range(1, len(parts)):
        unit = ".".join(parts[:count])
        if getattr(sys.modules.get(unit), "__dict__", {}).get("__file__") is not None:
            return unit
    return name


def packages_of(names: Iterable[str]) -> dict[str, str | None]:
    """Installed packages to which modules belong, with their versions; a module of none has the version None.

    Modules of no package whose names begin with an underscore are left out: they are parts of an installation.
    """
    owners, versions = _owners(_places()), dict[str, str | None]()
    for name in names:
        candidates = owners.get(name.partition(".")[0], ())
        packages = [
            package for package in dict.fromkeys(candidates) if len(candidates) == 1 or _has(package, name)
        ] or candidates
        versions |= {printable_line(package): _version(package) for package in packages}
        if not packages and not name.startswith("_"):
            versions[printable_line(name)] = None
    return dict(sorted(versions.items()))


def _places() -> tuple[tuple[str, int], ...]:
    """Folders of the search path with their times, which an installation changes."""
    paths = [Path(path) for path in sys.path if Path(path).is_dir()]
    return tuple((str(path), path.stat().st_mtime_ns) for path in paths)


@lru_cache(maxsize=1)
def _owners(places: tuple[tuple[str, int], ...]) -> Mapping[str, list[str]]:
    """Packages by name of a top-level module: a third of what a score of few pairs takes here."""
    return packages_distributions()


@cache
def _files(package: str) -> frozenset[str]:
    try:
        return frozenset(file.as_posix() for file in distribution(package).files or ())
    except PackageNotFoundError:
        return frozenset()


def _has(package: str, name: str) -> bool:
    place = name.replace(".", "/")
    return any(file.startswith((f"{place}/", f"{place}.")) for file in _files(package))


def _version(package: str) -> str | None:
    try:
        return printable_line(distribution(package).version)
    except PackageNotFoundError:
        return None


def package_sha256(owner: Distribution | None, module: str) -> str | None:
    """SHA-256 of the files of an installed package, by name; None if they cannot be found.

    Parameters
    ----------
    owner : distribution that the files' list (RECORD) belongs to
    module : str
        Name of a module in it. The files beside it count where the list does not hold it: of an editable installation,
        or of a package without a list.
    """
    top = module.partition(".")[0]
    files = dict(_listed(owner))
    if not any(name.startswith((f"{top}/", f"{top}.")) for name in files):
        files = dict(_beside(top))
    return _hash(files) if files else None


_OF_INSTALLERS = {"RECORD", "INSTALLER", "REQUESTED", "direct_url.json"}
_BYTECODE = (".pyc", ".pyo")


def _listed(owner: Distribution | None) -> Iterator[tuple[str, Path]]:
    """Files of a distribution's list that lie in its folder; scripts elsewhere hold paths of the machine."""
    for file in getattr(owner, "files", None) or ():
        path, name = Path(str(file.locate())), file.as_posix()
        if ".." not in file.parts and not name.endswith(_BYTECODE) and file.name not in _OF_INSTALLERS:
            yield name, path


_MOST_FILES = 20_000  # of a package: what is beyond is not hashed


def _beside(top: str) -> Iterator[tuple[str, Path]]:
    """Files of a package or module that is found by its name; nothing of it is run."""
    try:
        spec = find_spec(top)
    except (ImportError, ValueError, AttributeError):  # its parent cannot be imported, or is no package
        return
    if spec is None:
        return
    for folder in spec.submodule_search_locations or ():
        paths = (path for path in sorted(Path(folder).rglob("*")) if path.is_file())
        for count, path in enumerate(paths):
            if count == _MOST_FILES:
                return
            if not path.name.endswith(_BYTECODE):
                yield f"{top}/{path.relative_to(folder).as_posix()}", path
    if not spec.submodule_search_locations and spec.origin and Path(spec.origin).is_file():
        yield Path(spec.origin).name, Path(spec.origin)


def _hash(files: Mapping[str, Path]) -> str:
    digest = hashlib.sha256()
    for name, path in sorted(files.items()):
        hashed = sha256(path) if path.is_file() else "missing"
        digest.update(f"{name}\0{hashed}\0".encode(errors="surrogateescape"))
    return digest.hexdigest()


# -- opened files ------------------------------------------------------------------------------------------------------

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
            result[printable_line(name)] = _file_hash(real) if counts else None
        return result


def _file_hash(path: Path) -> str | None:
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
