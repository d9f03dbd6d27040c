"""Folders that are filled by one run at a time, whatever they hold, and signed by SHA256SUMS when they are whole.

All that phibench makes follows this: data sets, films, baked rooms, frames, exports, releases. A file is there whole or
not at all (`files`). The list of hashes is written last, and goes before anything is made again.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import checksums_text
from phibench.datasets.store.files import WriteError, only_run, remove_temporary, write_bytes
from phibench.datasets.store.leftovers import TEMPORARY_PREFIX, folder_for_work


@contextlib.contextmanager
def filling(out: Path, check: Callable[[], object] = lambda: None, passing: Collection[str] = ()) -> Iterator[None]:
    """Make a folder, hold it and clear it of what a killed run left; of two that start together one is refused.

    Parameters
    ----------
    out : folder
    check : raises `DatasetError` if the folder holds something else; asked before it is made, and when it is held
    passing : names of files that alone are no reason to keep a new folder after an error

    Raises
    ------
    DatasetError
        If another run holds the folder, or the system refuses to write; in one sentence.
    """
    check()
    with writing_to(out), contextlib.ExitStack() as stack:
        try:
            stack.enter_context(folder_for_work(out, passing))
            stack.enter_context(only_run(out))
            check()  # again: now nobody else can write
            write_bytes(out / f"{TEMPORARY_PREFIX}probe", b"").unlink()
        except OSError as error:
            raise DatasetError(f"cannot write to {out}: {error.strerror or error}; give another folder") from error
        remove_temporary(out)
        try:
            yield
        finally:
            remove_temporary(out)


@contextlib.contextmanager
def writing_to(out: Path) -> Iterator[None]:
    """Errors of the system as one sentence of a folder that is written."""
    try:
        yield
    except OSError as error:
        text = str(error) if isinstance(error, WriteError) else f"could not write to {out}: {error}"
        raise DatasetError(f"{text}; then run the same command again") from error


def signed(documents: Mapping[str, bytes], hashes: Mapping[str, str]) -> dict[str, bytes]:
    """Documents by name, and after them SHA256SUMS of them and of files whose hashes are known."""
    own = {name: hashlib.sha256(data).hexdigest() for name, data in documents.items()}
    return {**documents, schema.CHECKSUMS: checksums_text({**hashes, **own}).encode()}


def differing(out: Path, wanted: Mapping[str, bytes]) -> list[str]:
    """Names of files that are missing or have other bytes."""
    return [name for name, data in wanted.items() if not (out / name).is_file() or (out / name).read_bytes() != data]


def write_documents(out: Path, wanted: Mapping[str, bytes], names: Iterable[str] | None = None) -> None:
    """Write those documents of `signed` that differ, or some, in their order; without SHA256SUMS no folder is whole.

    Raises
    ------
    DatasetError
        If a file that SHA256SUMS names is not there: it is then not written, or removed.
    """
    names = set(differing(out, wanted) if names is None else names)
    if names:
        (out / schema.CHECKSUMS).unlink(missing_ok=True)
        names.add(schema.CHECKSUMS)
    for name, data in wanted.items():
        if name in names:
            if name == schema.CHECKSUMS:
                _require_all(out, data)
            write_bytes(out / name, data)
    try:
        _require_all(out, wanted[schema.CHECKSUMS])  # again: a folder may go while its last file is written
    except DatasetError:
        (out / schema.CHECKSUMS).unlink(missing_ok=True)
        raise


def _require_all(out: Path, checksums: bytes) -> None:
    """Look for every file that the text of SHA256SUMS names."""
    require_files(out, [line.split("  ", 1)[1] for line in checksums.decode().splitlines()])


def require_files(out: Path, names: Collection[str]) -> None:
    """Raise `DatasetError` if files of a folder have gone while it was filled."""
    if missing := [name for name in names if not (out / name).is_file()]:
        what = f"{len(missing)} of {len(names)} files are gone from {out}, such as {missing[0]}"
        raise DatasetError(f"{what}: something else removed them during the run; run the same command again")
