"""SHA256SUMS of a data set, for ``sha256sum -c``: written last, read first.

A folder that has the file is complete. Names are relative to the folder, with forward slashes.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from pydantic import ValidationError

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import FILE_NAME, InputFile, first_fault
from phibench.datasets.recipe.room_tables import RoomsTable
from phibench.datasets.rooms.room_files import RoomFiles
from phibench.datasets.rooms.room_sources import EXPORTED
from phibench.datasets.store import schema
from phibench.datasets.store.documents import read_info, read_manifest
from phibench.datasets.store.files import require_file, sha256
from phibench.datasets.store.leftovers import TEMPORARY_PREFIX
from phibench.datasets.store.schema import DatasetInfo
from phibench.datasets.store.stored_rooms import read_rooms
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


def strays(folder: Path) -> list[str]:
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


def misplaced(folder: Path) -> list[str]:
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


def damaged(folder: Path) -> list[str]:
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
