"""Task of a room: its irradiance, computed once or taken from the user's cache, and its line of `rooms.jsonl`."""

from __future__ import annotations

from pathlib import Path

from phibench.datasets.build.light_map_cache import light_map
from phibench.datasets.build.tasks import Made
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.common.parallel import return_memory
from phibench.datasets.recipe.tables import AmbientTable
from phibench.datasets.rooms.room_sources import RoomSource, room_of
from phibench.datasets.store import schema
from phibench.datasets.store.documents import to_json
from phibench.datasets.store.files import write_bytes
from phibench.datasets.store.schema import RoomInfo
from phibench.render.room.light_map import ARRAYS, BakeSettings, LightMap, encoded
from phibench.scenes.rig import Rig


def bake_settings(ambient: AmbientTable) -> BakeSettings:
    """Settings of the light map in a recipe."""
    return BakeSettings(**{name: getattr(ambient, name) for name in BakeSettings.__dataclass_fields__})


def bake_room(out: Path, rig: Rig, room_id: str, source: RoomSource, ambient: AmbientTable) -> Made:
    """Task: write a room's light map below `out`, if it has any light; the result is its `RoomInfo`."""
    room, view, file = room_of(source, out / schema.ROOM_FILES), rig.at(0.0), schema.light_map_file(room_id)
    info = RoomInfo(
        room=room_id, source=to_json(source), digest=room.digest, lit=room.lit, object_names=room.object_names(view)
    )
    if not room.lit:
        (out / file).unlink(missing_ok=True)
        return Made((), info.model_dump(mode="json"))
    return_memory()  # a bake's arrays do not fit into what views have left, and would come on top of it
    write_bytes(out / file, encoded(light_map(view, room, bake_settings(ambient))))
    return_memory()
    return Made((file,), info.model_dump(mode="json"))


def read_light_map(out: Path, room_id: str) -> LightMap:
    """Light map of a room of a data set.

    Raises
    ------
    DatasetError
        If the file is missing or not a light map.
    """
    return LightMap(**InputFile(out / schema.light_map_file(room_id), "run `phibench dataset repair`").arrays(ARRAYS))
