"""Whether a recipe's target boards leave the carriage room to move, and are large enough for their spots."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from phibench.datasets.recipe import LaserTable, TargetTable
from phibench.datasets.recipe_scene import build_spot, build_target
from phibench.render.model_faults import Fault
from phibench.scenes.catalog import BOARD_SIZE_M, Target, board
from phibench.scenes.rig import Rig, View
from phibench.scenes.robot import carriage
from phibench.scenes.solids import Cuboid

Targets = Sequence[tuple[int, TargetTable]]
_HOUSING_REACH_M = 0.1  # housing and mast stay within this of the lens


def boards_in_the_way(rig: Rig, strokes_m: Sequence[float], targets: Targets) -> Iterator[Fault]:
    """Boards that cut the mirror, the camera's housing or the mast at an end of a stroke."""
    for i, target in targets:
        for offset_m in (0.0, *sorted(set(strokes_m))):
            if hit := _hit(rig, offset_m, target):
                text = f"the board (0.40 m wide, 0.30 m high) cuts the {hit} at stroke {offset_m:g} m"
                yield Fault(f"targets[{i}].depth_m", f"{text}; move it away from the axis or to another height")
                break


def spots_on_boards(laser: LaserTable | None, targets: Targets) -> Iterator[Fault]:
    """Spots that are larger than the board that carries them."""
    if laser is None:
        return
    limit_m = min(BOARD_SIZE_M)
    for i, target in targets:
        diameter_m = build_spot(laser, target).diameter_m
        if diameter_m > limit_m:
            text = f"the spot's diameter is {diameter_m:g} m, its board measures {limit_m:g} m"
            yield Fault(f"targets[{i}]", f"{text}; make laser.diameter_m (or its growth) smaller")


class Boards:
    """Boards of a room, for many rigs: nearly all are too far from the carriage to be asked."""

    def __init__(self, targets: Sequence[Target]) -> None:
        self._plates = [board(target) for target in targets]
        self._centres_m = np.array([plate.T_world_shape.translation_m for plate in self._plates]).reshape(-1, 3)

    def cut_by(self, rig: Rig, stroke_m: float) -> str | None:
        """Say which board a rig cuts at an end of its stroke; None if none."""
        lens_m = rig.T_world_camera.t
        reach_m = float(np.linalg.norm(rig.sphere_in_camera_m[:2])) + rig.mirror.bound_m + _HOUSING_REACH_M
        reach_m += abs(stroke_m) * math.hypot(*rig.stroke_axis_world[:2]) + rig.sphere_in_camera_m[2] * _tilt(rig)
        if rig.motion is not None:  # at most: the sphere swings about the lens as far as it is from it, twice
            reach_m += math.hypot(*rig.motion.translation_m) + 2.0 * float(np.linalg.norm(rig.sphere_in_camera_m))
        near = np.hypot(*(self._centres_m - lens_m)[:, :2].T) < reach_m + math.hypot(*BOARD_SIZE_M)
        for k in np.flatnonzero(near):
            for offset_m in (0.0, stroke_m):
                if hit := _cut(rig.at(offset_m), self._plates[k]):
                    return f"the {self._plates[k].name} cuts the {hit} at stroke {offset_m:g} m"
        return None


def _tilt(rig: Rig) -> float:
    """Sine of the angle between the optical axis and the vertical."""
    return math.hypot(*rig.T_world_camera.R[:2, 2])


def _hit(rig: Rig, offset_m: float, target: TargetTable) -> str | None:
    """What a board cuts with the carriage at an offset; None if nothing."""
    return _cut(rig.at(offset_m), board(build_target(target)))


def _cut(view: View, plate: Cuboid) -> str | None:
    if plate.distance_m(view.sphere_centre_m) <= view.rig.mirror.bound_m:
        return "mirror"
    return next((part.name.replace("_", " ") for part in carriage(view) if plate.meets(part)), None)
