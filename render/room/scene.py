"""Scene coordinates and loading: millimetres, with the sphere centre at the origin.

In metres with the origin on the floor Mitsuba's ray offset moves the spot by 0.01 px.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

from phibench.render.room.camera_plugin import MM_PER_M
from phibench.scenes.frames import Array
from phibench.scenes.rig import View


def load_scene(mi: ModuleType, scene: dict[str, Any]) -> Any:
    """Load a scene dictionary so that lamps keep their order, and runs their bits.

    Mitsuba's scene optimisation merges meshes and materials in an order that differs between loads.
    """
    return mi.load_dict(scene, parallel=False, optimize=False)


def to_scene_mm(view: View, points_world_m: Array) -> Array:
    """World points, metres, in Mitsuba's scene: millimetres from the sphere centre."""
    return MM_PER_M * (points_world_m - view.sphere_centre_m)
