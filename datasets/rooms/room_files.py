"""Files of rooms (panoramas and meshes that a recipe names, each with its SHA-256), checked reading, and `RoomError`.

The folder is the recipe's own. A data set keeps a copy of each file in its folder `rooms/`, by the same names.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import MIB, InputFile, path_below
from phibench.scenes.validation import SceneError

LARGEST_BYTES = 64 * MIB  # a data set keeps a copy of every file
_REMEDY = "put a file of at most 64 MiB there, or give the name of another one"


class RoomError(DatasetError, SceneError):
    """A mesh, a panorama or settings of which no room can be made."""


@dataclass(frozen=True)
class RoomFiles:
    """Folder of room files, and what is known of them.

    Parameters
    ----------
    folder : Path or None
        None where nobody knows it: then no file can be read.
    digests : mapping
        SHA-256 by name, relative to the folder; what is not in it has the one that its file has.
    """

    folder: Path | None = None
    digests: Mapping[str, str] = field(default_factory=dict)

    def sha256(self, name: str) -> str:
        """SHA-256 that a file must have.

        Raises
        ------
        RoomError
            If it is not known and the file cannot be read.
        """
        return self.digests.get(name) or hashlib.sha256(_data(self.folder, name)).hexdigest()

    def holds(self, name: str) -> bool:
        """True if a file is known or there."""
        return name in self.digests or (self.folder is not None and (self.folder / name).is_file())

    def of(self, names: Iterable[str]) -> RoomFiles:
        """Some of the files, whose SHA-256 are all known."""
        return replace(self, digests={name: self.sha256(name) for name in dict.fromkeys(names)})


def checked_data(folder: Path | None, name: str, sha256: str) -> bytes:
    """Bytes of a file.

    Raises
    ------
    RoomError
        If it is missing, larger than 64 MiB, or not the file with that SHA-256.
    """
    data = _data(folder, name)
    if (digest := hashlib.sha256(data).hexdigest()) != sha256:
        raise RoomError(
            f"{folder}/{name} is another file than the room was made from: its SHA-256 begins with {digest[:12]}, not "
            f"{sha256[:12]}; put the right file back"
        )
    return data


def checked_file(folder: Path | None, name: str, sha256: str) -> Path:
    """Path of a file; raises `RoomError` as `checked_data`."""
    checked_data(folder, name, sha256)
    assert folder is not None
    return folder / name


def _data(folder: Path | None, name: str) -> bytes:
    if folder is None:
        raise RoomError(f"the file '{name}' of a room is needed, and nobody says in which folder it is; give a folder")
    return InputFile(path_below(folder, name), _REMEDY, RoomError, LARGEST_BYTES).read()
