"""Reader of rooms.jsonl: the rooms of a data set, each built from its source when it is asked for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.rooms.room_sources import ONLY_ROOM, SOURCES, NamedRoom, PanoramaRoom, RoomSource, room_of
from phibench.datasets.store import schema
from phibench.datasets.store.files import read_rows
from phibench.datasets.store.json_forms import from_json
from phibench.datasets.store.schema import DatasetInfo, RoomInfo
from phibench.scenes.room import Room
from phibench.scenes.validation import SceneError, nearest


@dataclass(frozen=True)
class Rooms:
    """Rooms by id; each is built from its source, and the files in `folder`, when it is asked for."""

    infos: dict[str, RoomInfo]
    folder: Path | None = None

    def __len__(self) -> int:
        return len(self.infos)

    def __iter__(self) -> Iterator[str]:
        return iter(self.infos)

    def __getitem__(self, name: str) -> Room:
        """Room of an id.

        Raises
        ------
        DatasetError
            If there is none, its source is none of a room, or this version or the files of this machine give another.
        """
        info = self.info(name)
        try:
            room = room_of(_source(info), self.folder)
        except (DatasetError, SceneError) as error:
            raise DatasetError(f"{schema.ROOMS}: {name} cannot be built: {error}") from error
        if room.digest != info.digest:
            text = f"{schema.ROOMS}: {name} is another room here than where the data set was made"
            raise DatasetError(f"{text}; install the version that made it, and give it the same files")
        return room

    def geometry(self, name: str) -> Room:
        """Room as rays meet it; a panorama's on a box is the box alone, whose picture is not read.

        Raises
        ------
        DatasetError
            As for the room itself.
        """
        from phibench.datasets.rooms.panorama_room import blank_room

        source = self.info(name).source
        if source.get("kind") != "panorama" or source["settings"].get("mesh") is not None:
            return self[name]
        return blank_room(from_json(PanoramaRoom, source).settings)

    def info(self, name: str) -> RoomInfo:
        """Line of a room."""
        if name not in self.infos:
            raise DatasetError(f"{schema.ROOMS} has no room '{name}'; {nearest(name, list(self.infos)[:20])}")
        return self.infos[name]


@dataclass(frozen=True)
class SingleRoom(Rooms):
    """The only room of a data set of version 4 or 5, whose description holds it shape by shape."""

    room: Room = field(kw_only=True)

    def __getitem__(self, name: str) -> Room:
        self.info(name)
        return self.room

    def geometry(self, name: str) -> Room:
        """Return the same: it is there already."""
        return self[name]


def _source(info: RoomInfo) -> RoomSource:
    kind: type[RoomSource] = SOURCES.get(str(info.source.get("kind")), NamedRoom)
    return from_json(kind, info.source)


def read_rooms(folder: Path, info: DatasetInfo) -> Rooms:
    """Rooms of a data set.

    Raises
    ------
    DatasetError
        If the file is missing, or with the number of the first line that is not a room or names one again.
    """
    if info.room is None:
        return Rooms(_once_each(folder / schema.ROOMS), folder / schema.ROOM_FILES)
    try:
        room = from_json(Room, info.room)
    except DatasetError as error:
        raise DatasetError(f"{folder / schema.INFO}: {error}; run `phibench dataset repair`") from error
    name = ONLY_ROOM
    row = RoomInfo(room=name, source={}, digest=room.digest, lit=room.lit, object_names=info.object_names)
    return SingleRoom({name: row}, room=room)


def _once_each(path: Path) -> dict[str, RoomInfo]:
    infos: dict[str, RoomInfo] = {}
    for number, row in enumerate(read_rows(path, RoomInfo), 1):
        if row.room in infos:
            raise DatasetError(f"{path} line {number} is damaged: room '{row.room}' is there already")
        infos[row.room] = row
    return infos
