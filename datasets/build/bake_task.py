"""Task of the light map: the irradiance of a data set's room, computed once or taken from the user's cache."""

from __future__ import annotations

from pathlib import Path

from phibench.datasets.build.light_map_cache import light_map
from phibench.datasets.build.tasks import Made
from phibench.datasets.input_files import InputFile
from phibench.datasets.recipe.tables import AmbientTable
from phibench.datasets.store import schema
from phibench.datasets.store.files import write_bytes
from phibench.render.room.light_map import ARRAYS, BakeSettings, LightMap, encoded
from phibench.scenes.rig import Rig
from phibench.scenes.room import Room


def bake_settings(ambient: AmbientTable) -> BakeSettings:
    """Settings of the light map in a recipe."""
    return BakeSettings(**{name: getattr(ambient, name) for name in BakeSettings.__dataclass_fields__})


def bake_room(out: Path, rig: Rig, room: Room, ambient: AmbientTable) -> Made:
    """Task: write the room's light map below `out`."""
    write_bytes(out / schema.LIGHT_MAP, encoded(light_map(rig.at(0.0), room, bake_settings(ambient))))
    return Made((schema.LIGHT_MAP,))


def read_light_map(out: Path) -> LightMap:
    """Light map of a data set.

    Raises
    ------
    DatasetError
        If the file is missing or not a light map.
    """
    return LightMap(**InputFile(out / schema.LIGHT_MAP, "run `phibench dataset repair`").arrays(ARRAYS))
