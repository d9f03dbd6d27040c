"""Positions of drawn laser spots: on a target board, or where a horizontal ray from the axis meets the room.

The first part finds boards that the carriage would hit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from phibench.datasets.recipe.build import build_spot, grown_diameter_m, make_spot
from phibench.datasets.recipe.tables import LaserTable, TargetTable
from phibench.render.optics.room_tracer import first_hit
from phibench.scenes.catalog import BOARD_SIZE_M, Target, board
from phibench.scenes.faces import IntArray
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import Rig, View
from phibench.scenes.room import Room, carriage
from phibench.scenes.shapes import Cuboid, Rectangle, Shape

_HOUSING_REACH_M = 0.1  # housing and mast stay within this of the lens


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
                if hit := cut_part(rig.at(offset_m), self._plates[k]):
                    return f"the {self._plates[k].name} cuts the {hit} at stroke {offset_m:g} m"
        return None


def _tilt(rig: Rig) -> float:
    """Sine of the angle between the optical axis and the vertical."""
    return math.hypot(*rig.T_world_camera.R[:2, 2])


def cut_part(view: View, plate: Cuboid) -> str | None:
    """Name the part of the carriage (mirror, housing, mast) that a board cuts; None if none."""
    if plate.distance_m(view.sphere_centre_m) <= view.rig.mirror.bound_m:
        return "mirror"
    return next((part.name.replace("_", " ") for part in carriage(view) if plate.meets(part)), None)


Placed = tuple[str, LaserSpot] | str
"""Name of what carries the spot, and the spot; or why there can be none."""

_RING = 16  # points around a spot that must lie on the same face
_SAME_FACE_M = 1e-9  # rounding over 10 m is 2e-15; a step between surfaces that matters is far above


def reach_m(spot: LaserSpot) -> float:
    """Radius that must lie on the surface: all of a disc, 4 sigma of a Gaussian (but 3e-4 of its power)."""
    return spot.diameter_m if spot.profile == "gaussian" else spot.diameter_m / 2.0


def free_margin_m(laser: LaserTable, target: TargetTable) -> tuple[float, float]:
    """Largest |across_m| and |up_m| with which a spot lies wholly on its board; negative where none does."""
    reach = reach_m(build_spot(laser, target))
    return BOARD_SIZE_M[0] / 2.0 - reach, BOARD_SIZE_M[1] / 2.0 - reach


def on_board(laser: LaserTable, target: TargetTable, across_m: float, up_m: float) -> LaserSpot:
    """Spot on a target's board, off its centre to the right as seen from the axis, and upwards."""
    centre = build_spot(laser, target)
    nx, ny, _ = centre.normal_world  # up x normal points to the right of who looks at the board
    x, y, z = centre.position_world_m
    position = (x - across_m * ny, y + across_m * nx, z + up_m)
    return make_spot(laser, position, centre.normal_world, centre.diameter_m)


def by_ray(laser: LaserTable, room: Room, azimuth_deg: Array, height_m: Array) -> list[Placed]:
    """Spots where horizontal rays from the world's z axis first meet walls, furniture or boards.

    The robot does not stop the rays. Each spot must lie wholly on one face, seen from the axis; its diameter follows
    `[laser]` with the distance from the axis for depth_m.
    """
    shapes: tuple[Shape, ...] = (*room.surfaces, *room.furniture)
    turn = np.radians(azimuth_deg)
    starts = np.stack([np.zeros_like(turn), np.zeros_like(turn), height_m], axis=-1)
    directions = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=-1)
    hits = first_hit(shapes, starts, directions)
    distance, found = hits.distance_m, hits.object_id
    spots = [_at(laser, shapes, *hit) for hit in zip(starts, directions, distance, found, strict=True)]
    return _whole(shapes, starts, found, spots)


def _at(laser: LaserTable, shapes: Sequence[Shape], start: Array, direction: Array, distance: float, k: int) -> Placed:
    if k < 0:
        return "the ray meets nothing"
    shape = shapes[k]
    if isinstance(shape, Rectangle) and shape.emits:
        return f"the ray meets {shape.name}, a lamp"
    point = start + distance * direction
    normal = _normal(shape, point)
    if np.dot(normal, direction) >= 0.0:
        return f"the ray meets the back of {shape.name}"
    diameter = grown_diameter_m(laser, float(distance))
    return shape.name, make_spot(laser, tuple(map(float, point)), tuple(map(float, normal)), diameter)


def _normal(shape: Shape, point: Array) -> Array:
    """Outward normal of the face that a point on the surface lies on."""
    assert isinstance(shape, Rectangle | Cuboid)
    pose = shape.T_world_shape
    if not isinstance(shape, Cuboid):
        return pose.R[:, 2]
    local = pose.R.T @ (point - pose.t) / (0.5 * np.array(shape.size_m))
    axis = int(np.argmax(np.abs(local)))
    return np.sign(local[axis]) * pose.R[:, axis]


def _whole(shapes: Sequence[Shape], starts: Array, found: IntArray, spots: list[Placed]) -> list[Placed]:
    """Refuse spots of which some point around them is hidden from the axis, or on something else."""
    placed = [i for i, spot in enumerate(spots) if not isinstance(spot, str)]
    if not placed:
        return spots
    rings = np.stack([_ring(spots[i][1]) for i in placed])  # type: ignore[arg-type]
    to_ring = rings - starts[placed][:, None]
    length = np.linalg.norm(to_ring, axis=-1)
    origins = np.broadcast_to(starts[placed][:, None], rings.shape).reshape(-1, 3)
    hits = first_hit(shapes, origins, (to_ring / length[..., None]).reshape(-1, 3))
    distance, hit = hits.distance_m, hits.object_id
    same = hit.reshape(length.shape) == found[placed][:, None]
    same &= np.abs(distance.reshape(length.shape) - length) < _SAME_FACE_M
    for i, fits in zip(placed, same.all(axis=1), strict=True):
        if not fits:
            spots[i] = f"the spot would not lie wholly on {spots[i][0]}"
    return spots


def _ring(spot: LaserSpot) -> Array:
    turn = 2.0 * np.pi * np.arange(_RING)[:, None] / _RING
    a, b = spot.tangents()
    return np.array(spot.position_world_m) + reach_m(spot) * (np.cos(turn) * a + np.sin(turn) * b)


def place(laser: LaserTable, room: Room, targets: Mapping[str, TargetTable], values: Mapping[str, Any]) -> list[Placed]:
    """Spots of many samples; `values` holds, by parameter, one entry per sample (see `sampling.PARAMETERS`)."""
    if "spot.azimuth_deg" in values:
        return by_ray(laser, room, values["spot.azimuth_deg"], values["spot.height_m"])
    names = values["spot.target"]
    still = np.zeros(len(names))
    offsets = zip(values.get("spot.across_m", still), values.get("spot.up_m", still), strict=True)
    return [
        (name, on_board(laser, targets[name], float(across), float(up)))
        for name, (across, up) in zip(names, offsets, strict=True)
    ]
