"""Sources of rooms: what a room is made from, small enough for a task and a line of `rooms.jsonl`.

A room of the catalogue is its name and its boards; a generated one its properties and the names of its random stream;
a photographed room or a mesh its settings and the SHA-256 of its file. `room_of` builds the room, in any process.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from phibench.scenes.catalog import ROOMS, Target
from phibench.scenes.room import Room
from phibench.scenes.validation import SceneError, nearest, printable_line
from phibench.scenes.worlds.generated_room import generate_room
from phibench.scenes.worlds.properties import RoomProperties

ONLY_ROOM = "room"
"""Id of the room of a recipe that has one for all samples."""
_KEPT = 3  # rooms of a process; one with many textures has 60 MB


@dataclass(frozen=True)
class NamedRoom:
    """A room of the catalogue, with target boards."""

    name: str
    targets: tuple[Target, ...]
    kind: Literal["named"] = "named"

    def build(self) -> Room:
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

    def build(self) -> Room:
        """The room itself.

        Raises
        ------
        SceneError
            If no lamp finds a place.
        """
        return generate_room(self.properties, *self.stream)


RoomSource = NamedRoom | GeneratedRoom


@lru_cache(maxsize=_KEPT)
def room_of(source: RoomSource) -> Room:
    """Room of a source; the last few are kept."""
    return source.build()
