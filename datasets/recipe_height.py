"""A rig that is in the ceiling before it makes a stroke: the fault of its height, not of the strokes."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError

from phibench.datasets.recipe import MIN_STROKE_M, RigTable, RoomTable
from phibench.datasets.recipe_scene import build_rig, build_room, ceiling_m
from phibench.render.model_faults import Fault
from phibench.scenes.checks import SceneError


def height_faults(raw: dict[str, Any]) -> list[Fault]:
    """Fault of a rig that leaves no room for the shortest stroke; none if rig or room are faulty themselves."""
    try:
        table = RigTable.model_validate(raw.get("rig", {}))
        room = build_room(RoomTable.model_validate(raw.get("room", {})), ())
        rig = build_rig(table)
    except (ValidationError, SceneError):
        return []
    limit_m = ceiling_m(room)
    top_m = rig.at(MIN_STROKE_M).sphere_centre_m[2] + rig.mirror.radius_m
    if top_m < limit_m:
        return []
    key = "z_c_m" if table.camera_height_m is None else "camera_height_m"
    value = getattr(table, key)
    if value is None:
        key, value = "radius_m", rig.mirror.radius_m
    text = f"{value} puts the mirror's top at {top_m:.3f} m when it is down, through the ceiling at {limit_m:.2f} m"
    return [Fault(f"rig.{key}", f"{text}; give less than {value - (top_m - limit_m):.3f}")]
