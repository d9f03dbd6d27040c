"""Sources of rooms (named, generated, panorama, mesh): small records of what `room_of` builds a room from.

A room of the catalogue is its name and its boards; a generated one its properties and the names of its random stream;
a photographed room or a mesh its settings and the SHA-256 of its file, whose name is relative to a folder. `room_of`
builds the room, in any process, given the folder of the files there.
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal, cast, get_args

from phibench.datasets.common.input_files import FILE_NAME
from phibench.datasets.rooms.mesh_placement import MeshSettings
from phibench.datasets.rooms.panorama_room import PanoramaSettings
from phibench.datasets.rooms.room_files import RoomError, checked_file
from phibench.scenes.room import ROOMS, Room, TargetBoard
from phibench.scenes.validation import SceneError, nearest, printable_line
from phibench.scenes.worlds.room_properties import RoomProperties

EXPORTED = "exported"
"""Folder, among the files of rooms, of those that a data set makes itself."""
ONLY_ROOM = "room"
"""Id of the room of a recipe that has one for all samples."""
_KEPT = 3  # rooms of a process; one with many textures has 60 MB


@dataclass(frozen=True)
class NamedRoom:
    """A room of the catalogue, with target boards."""

    name: str
    targets: tuple[TargetBoard, ...]
    kind: Literal["named"] = "named"

    def build(self, folder: Path | None = None) -> Room:
        """The room itself.

        Raises
        ------
        SceneError
            If the catalogue has no room of that name, or the boards do not fit together.
        """
        if self.name not in ROOMS:  # a file of another version, perhaps
            raise SceneError(f"no room is called '{printable_line(self.name, 60)}'; {nearest(self.name, ROOMS)}")
        return ROOMS[self.name](self.targets)


@dataclass(frozen=True)
class GeneratedRoom:
    """A room that its properties and a named random stream make."""

    properties: RoomProperties
    stream: tuple[str | int, ...]
    kind: Literal["generated"] = "generated"

    def build(self, folder: Path | None = None) -> Room:
        """The room itself.

        Raises
        ------
        SceneError
            If no lamp finds a place.
        """
        from phibench.scenes.worlds.generated_room import generate_room  # furniture: for rooms that are built

        return generate_room(self.properties, *self.stream)


@dataclass(frozen=True)
class PanoramaRoom:
    """A photographed room, on a box or on a mesh.

    Parameters
    ----------
    settings : PanoramaSettings
        Its paths are names of files, relative to a folder of room files.
    sha256, mesh_sha256
        Of these files; the second is "" on a box.
    """

    settings: PanoramaSettings
    sha256: str
    mesh_sha256: str = ""
    kind: Literal["panorama"] = "panorama"

    def __post_init__(self) -> None:
        _require_names(self.settings.path, *(() if self.settings.mesh is None else (self.settings.mesh.path,)))

    def build(self, folder: Path | None = None) -> Room:
        """The room itself, of the files in a folder.

        Raises
        ------
        RoomError
            If a file is missing or another one, or no room can be made of it.
        """
        from phibench.datasets.rooms.panorama_room import panorama_room

        path = checked_file(folder, self.settings.path.as_posix(), self.sha256)
        mesh = self.settings.mesh
        if mesh is not None:
            mesh = replace(mesh, path=checked_file(folder, mesh.path.as_posix(), self.mesh_sha256), one_file=True)
        return panorama_room(replace(self.settings, path=path, mesh=mesh))


@dataclass(frozen=True)
class MeshRoom:
    """A room of a mesh file, whose path is a name relative to a folder of room files."""

    settings: MeshSettings
    sha256: str
    kind: Literal["mesh"] = "mesh"

    def __post_init__(self) -> None:
        _require_names(self.settings.path)

    def build(self, folder: Path | None = None) -> Room:
        """The room itself, of the file in a folder.

        Raises
        ------
        RoomError
            If the file is missing or another one, or no room can be made of it.
        """
        from phibench.datasets.rooms.mesh_room import mesh_room

        path = checked_file(folder, self.settings.path.as_posix(), self.sha256)
        return mesh_room(replace(self.settings, path=path, one_file=True))


@dataclass(frozen=True)
class UnexportedRoom:
    """A generated room that is to become a panorama or a mesh, and has no file yet.

    It gives the surfaces that the file will give, so that samples can be drawn. Nothing is rendered from it.

    Parameters
    ----------
    room : GeneratedRoom
    settings : PanoramaSettings or MeshSettings
        Of the room that reads the file.
    rows : int
        Of the panorama.
    kind
        Kind of the file, for forecasts.
    """

    room: GeneratedRoom
    settings: PanoramaSettings | MeshSettings
    rows: int
    kind: Literal["unexported panorama", "unexported mesh"]

    @property
    def file(self) -> str:
        """Name of the file below the folder of room files."""
        return self.settings.path.as_posix()

    def generated(self) -> Room:
        """The generated room that is exported, without the robot, which stands in every room by itself."""
        return replace(self.room.build(), robot=False)

    def build(self, folder: Path | None = None) -> Room:
        """The room as its file will give it; a panorama's walls are grey.

        Raises
        ------
        SceneError
            If no lamp finds a place, or the robot has none.
        """
        from phibench.datasets.rooms.gltf_export import glb_of
        from phibench.datasets.rooms.mesh_room import mesh_room
        from phibench.datasets.rooms.panorama_room import blank_room

        if isinstance(self.settings, PanoramaSettings):
            return blank_room(self.settings)
        with tempfile.TemporaryDirectory() as place:
            path = Path(place) / "room.glb"
            path.write_bytes(glb_of(self.generated()))
            return mesh_room(replace(self.settings, path=path, one_file=True))


def is_exported(source: RoomSource) -> bool:
    """Tell whether the data set makes a room's file itself."""
    if isinstance(source, UnexportedRoom):
        return True
    return isinstance(source, PanoramaRoom | MeshRoom) and source.settings.path.parts[0] == EXPORTED


def _require_names(*paths: Path) -> None:
    for path in paths:
        if re.fullmatch(FILE_NAME, path.as_posix()) is None:
            raise RoomError(f"'{printable_line(str(path), 60)}' is no name of a file below the folder of room files")


RoomSource = NamedRoom | GeneratedRoom | PanoramaRoom | MeshRoom | UnexportedRoom
SOURCES: dict[str, type[RoomSource]] = {
    cast(str, kind.__dataclass_fields__["kind"].default): kind
    for kind in get_args(RoomSource)
    if kind is not UnexportedRoom
}
"""Kinds of sources by the name that their documents have."""


@lru_cache(maxsize=_KEPT)
def room_of(source: RoomSource, folder: Path | None = None) -> Room:
    """Room of a source, of files in a folder; the last few are kept."""
    return source.build(folder)
