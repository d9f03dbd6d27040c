"""Temporary files and folders, removed when their owner process is gone; output folders, removed if work in them fails.

The owner holds a lock (`flock`) on the folder or file itself. It vanishes with the process, whatever ended it: no
process number and no clock is asked, and nothing is written into the folder. Where locks do not work, nothing is
removed.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path

TEMPORARY_PREFIX = ".phibench-tmp-"
_NAME = re.compile(r"\.?phibench-tmp-([a-z]+-)?[a-z0-9_]{8}(\.\w+)?")  # eight random characters, as `tempfile` has them


class OwnedFolder:
    """New empty folder, removed when it is closed, or by the next one beside it if this process is killed.

    Parameters
    ----------
    kind : str
        Lower-case word for the folder's name.
    parent : Path, optional
        By default the system's folder for temporary files. Elsewhere the name begins with a dot.

    Attributes
    ----------
    path : Path
    """

    def __init__(self, kind: str, parent: Path | None = None) -> None:
        where, dot = (Path(tempfile.gettempdir()), "") if parent is None else (parent, ".")
        remove_leftovers(where)
        self.path, self._handle = _made(where, f"{dot}phibench-tmp-{kind}-")

    def close(self) -> None:
        """Remove the folder with all that it holds; never raises. One that was given another name stays."""
        remove_tree(self.path)
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *_: object) -> None:
        self.close()


@contextlib.contextmanager
def folder_for_work(path: Path, passing: Collection[str] = ()) -> Iterator[Path]:
    """Make a folder and those above it; work that ends in an error leaves none of them empty.

    What was there before stays, and so does a folder that holds anything.

    Parameters
    ----------
    path : folder
    passing : names of files that alone are no reason to keep a folder after an error; an interruption keeps them

    Raises
    ------
    OSError
        If it cannot be made.
    """
    made = []
    for folder in (path, *path.parents):  # innermost first
        if folder.exists():
            break  # those below it are ours to remove
        made.append(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        yield path
    except BaseException as error:
        with contextlib.suppress(OSError):  # the first that is not empty ends it
            if made and isinstance(error, Exception) and {entry.name for entry in path.iterdir()} <= set(passing):
                for name in passing:
                    (path / name).unlink(missing_ok=True)
            for folder in made:
                folder.rmdir()
        raise


@contextlib.contextmanager
def owned(path: Path) -> Iterator[None]:
    """Hold a temporary file while it is written and renamed."""
    handle = None if os.name == "nt" else _held(path)  # Windows renames no open file
    try:
        yield
    finally:
        if handle is not None:
            os.close(handle)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary folders and files of this user whose owner is gone, in a folder but not below; never raises."""
    if os.name == "nt":  # no such locks
        return
    with contextlib.suppress(OSError), os.scandir(folder) as entries:  # the folder may not be readable
        names = [entry.path for entry in entries if _NAME.fullmatch(entry.name)]
        for path in map(Path, names):
            with contextlib.suppress(OSError):  # another run may have removed it
                _remove_if_free(path)


def _locked(handle: int, wait: bool = False) -> bool:
    """Lock an open file or folder until it is closed; False if another process holds it, or locks do not work."""
    if sys.platform == "win32":
        return False
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError:  # somebody holds it
        return False
    return True


def remove_tree(path: Path) -> None:
    """Remove a folder with all that it holds; never raises, follows no link, and what cannot be removed stays.

    Subfolders are moved up and emptied one by one, so that neither their depth nor the length of their paths matters.
    """
    if os.name == "nt":  # no files relative to a folder
        shutil.rmtree(path, ignore_errors=True)
        return
    with contextlib.suppress(OSError):
        if path.is_symlink():  # put in the folder's place
            path.unlink()
            return  # never through a link
        top = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            _empty(top)
        finally:
            os.close(top)
        path.rmdir()


def _empty(top: int) -> None:
    os.fchmod(top, stat.S_IRWXU)
    name_of_moved, moved, failed = os.urandom(8).hex(), 0, False  # a name that nothing in there has
    while not failed:
        folders = list(_without_files(top))
        if not folders:
            return  # only files were left, and they are gone
        for name in folders:
            with contextlib.suppress(OSError):  # one that cannot be written can be neither moved nor emptied
                os.chmod(name, stat.S_IRWXU, dir_fd=top)
            try:
                inner = os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=top)
                try:
                    for below in list(_without_files(inner)):
                        os.chmod(below, stat.S_IRWXU, dir_fd=inner)
                        moved += 1
                        os.rename(below, f"{name_of_moved}-{moved}", src_dir_fd=inner, dst_dir_fd=top)
                finally:
                    os.close(inner)
                os.rmdir(name, dir_fd=top)
            except OSError:
                failed = True  # of another user, or a mount point: it stays


def _without_files(folder: int) -> Iterator[str]:
    """Names of the folders in an open folder; all else in it is removed."""
    with os.scandir(folder) as entries:
        for entry in list(entries):
            if entry.is_dir(follow_symlinks=False):
                yield entry.name
            else:
                with contextlib.suppress(OSError):  # another user's, or gone
                    os.unlink(entry.name, dir_fd=folder)


def _made(where: Path, prefix: str) -> tuple[Path, int | None]:
    """New folder and its handle; again if another process took it for a leftover before it was locked."""
    while True:
        path = Path(tempfile.mkdtemp(prefix=prefix, dir=where))
        handle = _held(path)
        if path.is_dir() if handle is None else _is_at(handle, path):
            return path, handle
        if handle is not None:
            os.close(handle)


def _held(path: Path) -> int | None:
    """Handle of a file or folder that is locked; None where it cannot be opened or locked."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except OSError:  # gone since it was listed
        return None
    if _locked(handle, wait=True):
        return handle
    os.close(handle)
    return None


def _is_at(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), path.lstat())
    except OSError:  # removed in the meantime
        return False


def _remove_if_free(path: Path) -> None:
    status = path.lstat()
    is_folder = stat.S_ISDIR(status.st_mode)
    if status.st_uid != os.geteuid() or not (is_folder or stat.S_ISREG(status.st_mode)):
        return  # another user's, or a pipe: not ours to open
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        if _locked(handle) and _is_at(handle, path):
            remove_tree(path) if is_folder else path.unlink()
    finally:
        os.close(handle)
