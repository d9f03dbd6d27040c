"""Positions of drawn laser spots, on a board or where a ray meets the room, and whether both images show them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from phibench.datasets.recipe.recipe_scene import beam_of, build_spot, make_spot
from phibench.datasets.recipe.tables import OWN_ALBEDO, LaserTable, TargetTable
from phibench.render.optics.beam_deposit import BEAM_REACH_M
from phibench.render.optics.faces import FaceTable
from phibench.render.optics.room_tracer import RoomGeometry, RoomHits, own_geometry, room_geometry
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import VISIBLE, spot_truth
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import POSITIONS, Rig, Stroke
from phibench.scenes.room import BOARD_SIZE_M, Room

Placed = tuple[str, LaserSpot] | str
"""Name of what carries the spot, and the spot; or why there can be none."""

_TURN = 2.0 * np.pi * np.arange(16) / 16  # points around a spot that are looked at
_SAME_FACE_M = 1e-9  # rounding over 10 m is 2e-15; a step between surfaces that matters is far above
_LEAST_DISTANCE_M = 0.3  # of a spot from the axis: nearer ones lie on the robot's own ground
_LEAST_COATED_ALBEDO = 0.05  # below it a glossy surface mirrors as much light as it scatters


def reach_m(spot: LaserSpot) -> float:
    """Radius that must lie on the surface: all of a disc, 4 sigma of a Gaussian (but 3e-4 of its power)."""
    return spot.diameter_m if spot.profile == "gaussian" else spot.diameter_m / 2.0


def free_margin_m(laser: LaserTable, target: TargetTable) -> tuple[float, float]:
    """Largest |across_m| and |up_m| with which a spot lies wholly on its board; negative where none does."""
    reach = reach_m(build_spot(laser, target))
    return BOARD_SIZE_M[0] / 2.0 - reach, BOARD_SIZE_M[1] / 2.0 - reach


def spot_on_board(laser: LaserTable, target: TargetTable, across_m: float, up_m: float) -> LaserSpot:
    """Spot on a target's board, off its centre to the right as seen from the axis, and upwards."""
    centre = build_spot(laser, target)
    nx, ny, _ = centre.normal_world  # up x normal points to the right of who looks at the board
    x, y, z = centre.position_world_m
    position = (x - across_m * ny, y + across_m * nx, z + up_m)
    return make_spot(laser, position, centre.normal_world, centre.diameter_m)


def by_ray(
    laser: LaserTable, room: Room, azimuth_deg: Array, height_m: Array, elevation_deg: Array | None = None
) -> list[Placed]:
    """Spots where rays from the world's z axis first meet walls, furniture or boards.

    The robot does not stop the rays. With the surfaces' own albedo the spot is what a beam along the ray leaves there,
    over edges too, unless it is split between places far apart. With one albedo for all it is a disc, which must lie
    wholly on one face, seen from the axis. The diameter follows `[laser]` with the length of the ray for depth_m.
    """
    rays = _Rays.of(azimuth_deg, height_m, np.zeros_like(height_m) if elevation_deg is None else elevation_deg)
    geometry = own_geometry(room)
    hits = geometry.first_hit(rays.starts, rays.directions)
    placed = [_at(laser, geometry, rays, hits, i) for i in range(len(hits.patch))]
    split = _split if laser.albedo == OWN_ALBEDO else _cut
    numbers = [i for i, spot in enumerate(placed) if not isinstance(spot, str)]
    spots = [placed[i][1] for i in numbers]
    if spots:
        for i, fault in zip(numbers, split(geometry, rays[numbers], hits, numbers, spots), strict=True):  # type: ignore[arg-type]
            placed[i] = placed[i] if fault is None else fault.format(placed[i][0])
    return placed


@dataclass(frozen=True)
class _Rays:
    """Starts on the axis and unit directions, shape (N, 3)."""

    starts: Array
    directions: Array

    @staticmethod
    def of(azimuth_deg: Array, height_m: Array, elevation_deg: Array) -> _Rays:
        turn, rise = np.radians(azimuth_deg), np.radians(elevation_deg)
        still = np.zeros_like(turn)
        flat = np.cos(rise)
        directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), np.sin(rise)], axis=-1)
        return _Rays(np.stack([still, still, height_m], axis=-1), directions)

    def __getitem__(self, numbers: list[int]) -> _Rays:
        return _Rays(self.starts[numbers], self.directions[numbers])


def _at(laser: LaserTable, geometry: RoomGeometry, rays: _Rays, hits: RoomHits, i: int) -> Placed:
    """Spot of one ray, or why there can be none."""
    table, patch, direction = geometry.table, int(hits.patch[i]), rays.directions[i]
    if patch < 0:
        return "the ray meets nothing"
    name = geometry.shapes[hits.object_id[i]].name
    point, normal = rays.starts[i] + hits.distance_m[i] * direction, table.normal[patch]
    if fault := _no_ground(table, patch, point):
        return f"the ray meets {name}, {fault}"
    if np.dot(normal, direction) >= 0.0:
        if not table.two_sided[patch]:
            return f"the ray meets the back of {name}"
        normal = -normal
    if math.hypot(*point[:2]) < _LEAST_DISTANCE_M:
        return f"the ray meets {name} nearer than {_LEAST_DISTANCE_M:g} m to the axis"
    diameter = beam_of(laser).diameter_m(float(hits.distance_m[i]))
    beam = as_vector(direction) if laser.albedo == OWN_ALBEDO else None
    return name, make_spot(laser, as_vector(point), as_vector(normal), diameter, beam)


def _no_ground(table: FaceTable, patch: int, point: Array) -> str | None:
    """Say why a face carries no spot; None if it does."""
    if table.window[patch]:
        return "a window"
    if table.emits[patch]:
        return "a lamp"
    albedo = float(table.laser_albedo(np.array([patch]), point[None])[0])
    if table.is_radiance[patch] and albedo <= 0.0:
        return "a screen"
    if table.coat[patch] > 0.0 and albedo < _LEAST_COATED_ALBEDO:
        return "which is like a mirror"
    return None


def _cut(
    geometry: RoomGeometry, rays: _Rays, hits: RoomHits, numbers: list[int], spots: list[LaserSpot]
) -> Iterator[str | None]:
    """Faults of discs of which some point around them is hidden from the axis, or on something else."""
    rings = np.stack([_ring(spot) for spot in spots])
    to_ring = rings - rays.starts[:, None]
    length = np.linalg.norm(to_ring, axis=-1)
    origins = np.broadcast_to(rays.starts[:, None], rings.shape).reshape(-1, 3)
    around = geometry.first_hit(origins, (to_ring / length[..., None]).reshape(-1, 3))
    same = around.object_id.reshape(length.shape) == hits.object_id[numbers][:, None]
    same &= np.abs(around.distance_m.reshape(length.shape) - length) < _SAME_FACE_M
    yield from (None if fits else "the spot would not lie wholly on {}" for fits in same.all(axis=1))


def _split(
    geometry: RoomGeometry, rays: _Rays, hits: RoomHits, numbers: list[int], spots: list[LaserSpot]
) -> Iterator[str | None]:
    """Faults of beams that also meet something farther from the spot, along the beam, than what counts as the spot."""
    frames = np.array([spot.across_beam() for spot in spots])
    rim = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=-1)
    circles = np.array([reach_m(spot) for spot in spots])[:, None, None] * (np.concatenate([rim, 0.5 * rim]) @ frames)
    starts = rays.starts[:, None] + circles
    directions = np.broadcast_to(rays.directions[:, None], starts.shape)
    around = geometry.first_hit(starts.reshape(-1, 3), directions.reshape(-1, 3)).distance_m.reshape(len(spots), -1)
    apart = np.abs(around - hits.distance_m[numbers][:, None]) >= BEAM_REACH_M
    fault = f"the beam would be split between {{}} and what is {BEAM_REACH_M:g} m or more away"
    yield from (fault if np.any(far) else None for far in apart)


def _ring(spot: LaserSpot) -> Array:
    turn, (a, b) = _TURN[:, None], spot.tangents()
    return np.array(spot.position_world_m) + reach_m(spot) * (np.cos(turn) * a + np.sin(turn) * b)


def place(laser: LaserTable, room: Room, targets: Mapping[str, TargetTable], values: Mapping[str, Any]) -> list[Placed]:
    """Spots of many samples; `values` holds, by parameter, one entry per sample (see `sampling.PARAMETERS`)."""
    if "spot.azimuth_deg" in values:
        return by_ray(
            *(laser, room, values["spot.azimuth_deg"], values["spot.height_m"]), values.get("spot.elevation_deg")
        )
    names = values["spot.target"]
    still = np.zeros(len(names))
    offsets = zip(values.get("spot.across_m", still), values.get("spot.up_m", still), strict=True)
    return [
        (name, spot_on_board(laser, targets[name], float(across), float(up)))
        for name, (across, up) in zip(names, offsets, strict=True)
    ]


_DARK = 0.01  # of the spot's light in the image that shows it: what a hidden spot may still send into the other one


def causes_or_fault(hidden: bool, rig: Rig, stroke_m: float, spot: LaserSpot, room: Room) -> tuple[str, ...] | str:
    """Causes of both views, or why a spot is not shown as it should be: by exactly one image if `hidden`, else by both.

    The hidden image must hold no light of the spot either. Where a chief ray just fails, half of the spot may be seen:
    whoever finds that is not wrong.
    """
    views = [rig.at(Stroke(stroke_m).offset_m(position)) for position in POSITIONS]
    rooms = [room_geometry(room, view) for view in views]
    causes = [spot_truth(view, spot, geometry).cause for view, geometry in zip(views, rooms, strict=True)]
    seen = [cause == VISIBLE for cause in causes]
    if not hidden:
        return tuple(causes) if all(seen) else f"the spot is not visible ({next(c for c in causes if c != VISIBLE)})"
    if all(seen) or not any(seen):
        return "the spot is not hidden in exactly one image"
    shown = seen.index(True)
    hidden_e = float(spot_layer(views[1 - shown], spot, rooms[1 - shown]).total_electrons_per_s.sum())
    if hidden_e == 0.0:  # whatever the other one shows
        return tuple(causes)
    shown_e = float(spot_layer(views[shown], spot, rooms[shown]).total_electrons_per_s.sum())
    return tuple(causes) if hidden_e <= _DARK * shown_e else "the image that hides the spot shows a part of it"
