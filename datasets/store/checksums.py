"""SHA256SUMS of a data set, written last: files that it lists, their checks; and folders locked while a run fills them.

A folder that has the file is complete. Names are relative to the folder, with forward slashes.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path

from pydantic import ValidationError

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import FILE_NAME, InputFile, first_fault
from phibench.datasets.recipe.room_tables import RoomsTable
from phibench.datasets.rooms.room_files import RoomFiles
from phibench.datasets.rooms.room_sources import EXPORTED
from phibench.datasets.store import schema
from phibench.datasets.store.files import WriteError, remove_temporary, require_file, sha256, write_bytes
from phibench.datasets.store.folder_lock import only_run
from phibench.datasets.store.metadata import read_info, read_manifest
from phibench.datasets.store.schema import DatasetInfo
from phibench.datasets.store.stored_rooms import read_rooms
from phibench.datasets.store.temporary_folders import TEMPORARY_PREFIX, folder_for_work
from phibench.scenes.rig import POSITIONS

_FILES = {
    *(schema.INFO, schema.MANIFEST, schema.TABLE, schema.RECIPE, schema.RIGS, schema.ROOMS, schema.CROISSANT),
    *schema.NOT_DATA,
}


def data_files(folder: Path) -> list[str]:
    """Relative names of the files that make up the data set in a folder, sorted; what else lies there is not asked.

    Raises
    ------
    DatasetError
        If `dataset.json` or the manifest, which name them, cannot be read.
    """
    rows = read_manifest(folder)
    names = {schema.INFO, schema.MANIFEST, schema.TABLE, schema.RECIPE, schema.RIGS}
    if (folder / schema.CROISSANT).exists():  # data sets of version 0.2 and before have none
        names.add(schema.CROISSANT)
    info = read_info(folder)
    if info.room is None:
        names.add(schema.ROOMS)
    names.update(schema.light_map_file(room.room) for room in read_rooms(folder, info).infos.values() if room.lit)
    names.update(schema.room_file(name) for name in _room_files(info))
    names.update(_exported_files(folder, info))
    names.update(name for pose in info.poses for name in pose.files.values())
    names.update(schema.preview_file(row.sample_id) for row in rows)
    spots = (row.position(position) for row in rows for position in POSITIONS)
    names.update(spot.spot_file for spot in spots if spot.spot_file is not None)
    return sorted(names)


def _room_files(info: DatasetInfo) -> Iterable[str]:
    """Names of the files of rooms that the recipe of a data set gives."""
    try:
        rooms = info.recipe.get("rooms")
        return () if rooms is None else RoomsTable.model_validate(rooms).pinned
    except ValidationError as error:
        raise DatasetError(f"{schema.INFO} is damaged: recipe.rooms.{first_fault(error)}") from error


def _exported_files(folder: Path, info: DatasetInfo) -> Iterable[str]:
    """Files of rooms that the data set has made itself: the lines of its rooms name them."""
    for room in read_rooms(folder, info).infos.values():
        settings = room.source.get("settings")
        path = settings.get("path") if isinstance(settings, dict) else None
        if isinstance(path, str) and path.startswith(f"{EXPORTED}/") and re.fullmatch(FILE_NAME, path):
            yield schema.room_file(path)


def held_room_files(folder: Path) -> RoomFiles:
    """Files of rooms that a data set holds, with the SHA-256 that its list says; none are known without the list."""
    listed: dict[str, str] = {}
    with contextlib.suppress(DatasetError):  # a set that was cut off has no list yet
        listed = read_checksums(folder)
    head = schema.room_file("")
    known = {name.removeprefix(head): digest for name, digest in listed.items() if name.startswith(head)}
    return RoomFiles(folder / schema.ROOM_FILES, known)


def stray_files(folder: Path) -> list[str]:
    """Relative names of files in a folder that are neither listed nor ours otherwise (notes, scores), sorted."""
    known = {*read_checksums(folder), *schema.NOT_DATA}
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return sorted(name for name in names if name not in known and TEMPORARY_PREFIX not in name)


def checksums_text(hashes: Mapping[str, str]) -> str:
    """Text of the list, sorted by name."""
    return "".join(f"{hashes[name]}  {name}\n" for name in sorted(hashes))


def read_checksums(folder: Path) -> dict[str, str]:
    """Hash by relative name.

    Raises
    ------
    DatasetError
        If the list is missing (the data set is not complete) or not one.
    """
    path = folder / schema.CHECKSUMS
    if not path.is_file():
        raise DatasetError(
            f"{folder} has no {schema.CHECKSUMS}: it was not finished; run `phibench dataset make` again"
        )
    lines = InputFile(path, "run `phibench dataset repair`").read().decode("utf-8", errors="replace").splitlines()
    if not lines:
        raise DatasetError(f"{path} is damaged: it lists no file")
    for number, line in enumerate(lines, 1):
        if _LINE.fullmatch(line) is None:  # a name that leads out of the folder is none either
            raise DatasetError(f"{path} line {number} is damaged: it is not '<SHA-256>  <file>'")
    return {line[_NAME:]: line[: _NAME - 2] for line in lines}


_NAME = 66  # place of the name in a line
_LINE = re.compile(r"[0-9a-f]{64}  " + FILE_NAME)


def misplaced_files(folder: Path) -> list[str]:
    """One sentence per FIFO, socket, device or circular link in a folder, and per folder in place of a file of ours."""
    faults = []
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        try:
            if not path.is_dir() or name in _FILES or schema.is_task_file(name):
                require_file(path)
        except OSError as error:
            faults.append(f"{name} is not readable: {error.strerror or error}")
    return faults


def damaged_files(folder: Path) -> list[str]:
    """One sentence per file that is missing, cannot be read, was changed or is not listed although it belongs here.

    The list itself must have the bytes that `checksums_text` gives: sorted lines, each name once.
    """
    listed, planned = read_checksums(folder), set[str]()
    spoilt = checksums_text(listed).encode() != (folder / schema.CHECKSUMS).read_bytes()
    faults = [f"{schema.CHECKSUMS} is damaged: it is not a sorted list of files, each named once"] if spoilt else []
    with contextlib.suppress(DatasetError):  # a manifest that cannot be read is reported as what it is, below
        planned = set(data_files(folder))
    faults += differing_files(folder, listed)
    return faults + [f"{name} is not listed in {schema.CHECKSUMS}" for name in sorted(planned - set(listed))]


def differing_files(folder: Path, hashes: Mapping[str, str]) -> list[str]:
    """One sentence per file that is missing, cannot be read or has another SHA-256."""
    return [fault for name, digest in hashes.items() if (fault := _fault(folder, name, digest))]


def check_documents(folder: Path) -> None:
    """Refuse a data set that is unfinished or whose `dataset.json`, manifest or rigs are not the listed ones (cheap).

    Raises
    ------
    DatasetError
        In one sentence.
    """
    listed = read_checksums(folder)
    for name in (schema.INFO, schema.MANIFEST, schema.RIGS, *([schema.ROOMS] if schema.ROOMS in listed else [])):
        if fault := _fault(folder, name, listed.get(name, "")):
            raise DatasetError(f"{folder}: {fault}; run `phibench dataset verify` to see all faults")


def _fault(folder: Path, name: str, digest: str) -> str:
    """Sentence about a file that is not what its hash says; empty if it is."""
    try:
        return "" if sha256(folder / name) == digest else f"{name} is damaged: its SHA-256 is not the listed one"
    except (FileNotFoundError, NotADirectoryError):
        return f"{name} is missing"
    except OSError as error:
        return f"{name} is not readable: {error.strerror or error}"


# Folders that are filled by one run at a time, whatever they hold, and signed by SHA256SUMS when they are whole.
#
# All that phibench makes follows this: data sets, films, baked rooms, frames, exports, releases. A file is there whole
# or not at all (`files`). The list of hashes is written last, and goes before anything is made again.


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


def with_checksums(documents: Mapping[str, bytes], hashes: Mapping[str, str]) -> dict[str, bytes]:
    """Documents by name, and after them SHA256SUMS of them and of files whose hashes are known."""
    own = {name: hashlib.sha256(data).hexdigest() for name, data in documents.items()}
    return {**documents, schema.CHECKSUMS: checksums_text({**hashes, **own}).encode()}


def differing_documents(out: Path, wanted: Mapping[str, bytes]) -> list[str]:
    """Names of files that are missing or have other bytes."""
    return [name for name, data in wanted.items() if not (out / name).is_file() or (out / name).read_bytes() != data]


def write_documents(out: Path, wanted: Mapping[str, bytes], names: Iterable[str] | None = None) -> None:
    """Write those documents of `with_checksums` that differ, or some, in order; without SHA256SUMS no folder is whole.

    Raises
    ------
    DatasetError
        If a file that SHA256SUMS names is not there: it is then not written, or removed.
    """
    names = set(differing_documents(out, wanted) if names is None else names)
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
