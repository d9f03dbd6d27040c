"""Files that a method's process may read: the folder of the method's file and what `--allow` names, without the truth.

The data set is never readable, wherever it lies: a method inside its folder is refused, and of a folder around it the
rest is readable. The same holds for what is found in the method's folder: folders and files of the store's own list
(`schema.TruthFolder`, `schema.TruthFile`), scores, sealed truths, and hard links to files of the data set.
"""

from __future__ import annotations

import os
import site
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from phibench.benchmark.isolation.isolation import Access
from phibench.benchmark.isolation.method_references import Reference
from phibench.benchmark.isolation.run_limits import MethodError, RunLimits
from phibench.datasets.store.schema import RECORDS_SO_FAR, SEALED_TRUTH, TruthFile, TruthFolder


def access_of(reference: Reference, limits: RunLimits, hidden: Sequence[Path] = ()) -> Access:
    """Files of a method's process.

    Parameters
    ----------
    hidden : sequence of Path
        Folders that hold the truth; they stay unreadable inside what is allowed.

    Raises
    ------
    MethodError
        If the method's file, Python or a path of `limits.allow` lies in such a folder, or the path is not there.
    """
    secret = [path.resolve() for path in hidden]
    readable = []
    for name in limits.allow:
        if not Path(name).exists():
            raise MethodError(f"--allow {name}: there is no such file or folder; give one that the method reads")
        readable.append(_outside(Path(name), secret, f"--allow {name}"))
    if reference.kind == "file":
        file = Path(reference.place)
        title = f"the file of method '{reference.name}'"
        folder = _outside(file, secret, title).parent
        readable += [file.parent, folder]
        if told := sorted(_FOLDERS & {entry.name for entry in _entries(folder)}):
            raise MethodError(f"{title} lies in {folder}, which holds the truth ({told[0]}): move it out")
        secret += truth_near(folder, secret)
    for place in _search_places():  # Python may read them whole
        secret += truth_near(place, secret, f"PYTHONPATH or a .pth file names {place}, which", "leave it out")
    for name in (sys.prefix, sys.base_prefix, __file__):
        _outside(Path(name), secret, f"Python's {name}")
    return Access(tuple(map(str, readable)), tuple(map(str, secret)), limits.fresh)


def _outside(path: Path, secret: Sequence[Path], title: str) -> Path:
    """The path itself, without links."""
    real = path.resolve()
    for folder in secret:
        if real.is_relative_to(folder):
            raise MethodError(f"{title} lies in {folder}, which holds the truth and cannot be read: move it out")
    return real


_MOST_ENTRIES = 200_000  # of the folders that are looked through: a second
_FOLDERS = frozenset(str(name) for name in TruthFolder)
_FILES = frozenset(str(name) for name in TruthFile)
_HEAD_BYTES = 256  # of a score's JSON, whose first field is its kind


def _search_places() -> list[Path]:
    """Folders that `PYTHONPATH` and .pth files name, but installations: a checkout may have data sets in it."""
    named = [part for part in os.environ.get("PYTHONPATH", "").split(os.pathsep) if part]
    for folder in map(Path, site.getsitepackages()):
        for file in folder.glob("*.pth"):
            with suppress(OSError):  # not readable: Python does not read it either
                named += [line for line in file.read_text(errors="replace").splitlines() if line.startswith("/")]
    places = [Path(name).resolve() for name in dict.fromkeys(named)]
    prefixes = {Path(name).resolve() for name in (sys.prefix, sys.base_prefix)}
    return [
        place
        for place in places
        if place.is_dir()
        and not place.name.endswith("-packages")  # site-packages, dist-packages
        and not any(place.is_relative_to(prefix) for prefix in prefixes)
    ]


def truth_near(
    folder: Path, secret: Sequence[Path] = (), title: str = "", advice: str = "put the method into one of its own"
) -> list[Path]:
    """Folders and files with truth in a folder and all below it; files of `secret` by other names.

    Raises
    ------
    MethodError
        If there is more in it than can be looked through.
    """
    truths: list[Path] = []
    linked: dict[tuple[int, int], Path] = {}
    passed = {*secret, *(Path(name).resolve() for name in (sys.prefix, sys.base_prefix))}
    level, left = [folder], _MOST_ENTRIES
    while level:
        below = []
        for path in level:
            entries = _entries(path)
            left -= len(entries)
            names = {entry.name for entry in entries}
            if names & _FOLDERS:
                truths.append(path)
                continue  # all of it is hidden: nothing below need be looked at
            truths += [path / entry.name for entry in entries if _holds_truth(path, entry.name, names)]
            linked.update(_linked(entries))
            below += [path / entry.name for entry in entries if entry.is_dir(follow_symlinks=False)]
        if left < 0:
            most = f"more than {_MOST_ENTRIES} files, too many to look for the truth in"
            raise MethodError(f"{title or f'the folder of the method, {folder},'} holds {most}: {advice}")
        level = [path for path in below if path not in passed]
    return [*truths, *(_same_files(linked, secret) if linked else ())]


def _entries(path: Path) -> list[os.DirEntry[str]]:
    try:
        return [entry for entry in os.scandir(path) if not entry.is_symlink()]
    except OSError:  # not readable: nothing in it is
        return []


def _holds_truth(folder: Path, name: str, names: set[str]) -> bool:
    """Tell a file of the store's list, a sealed truth, and the files of a score."""
    stem, _, kind = name.rpartition(".")
    if name in _FILES or name.endswith((SEALED_TRUTH, RECORDS_SO_FAR)):
        return True
    if kind not in ("json", "parquet") or not {f"{stem}.json", f"{stem}.parquet"} <= names:
        return False  # a score has two files of one name
    try:
        with (folder / f"{stem}.json").open("rb") as file:
            return b"phibench score" in file.read(_HEAD_BYTES)
    except OSError:  # no file of that name
        return False


def _linked(entries: Sequence[os.DirEntry[str]]) -> Iterator[tuple[tuple[int, int], Path]]:
    """Files with several names, by device and inode."""
    for entry in entries:
        if entry.is_file(follow_symlinks=False):
            state = entry.stat(follow_symlinks=False)
            if state.st_nlink > 1:
                yield (state.st_dev, state.st_ino), Path(entry.path)


def _same_files(linked: dict[tuple[int, int], Path], secret: Sequence[Path]) -> Iterator[Path]:
    """Files that are files of the secret folders by another name (hard links)."""
    for file in (file for folder in secret for file in folder.rglob("*")):
        state = file.lstat()
        if state.st_nlink > 1 and (other := linked.get((state.st_dev, state.st_ino))):
            yield other
