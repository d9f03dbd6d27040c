"""Collisions of the robot with a room's things on the drives of films (`check_drives`), before anything is made."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from phibench.datasets.common.errors import RecipeError
from phibench.datasets.film.film_plan import FilmPlan
from phibench.datasets.plan.plan import Plan
from phibench.render.optics.room_tracer import own_geometry
from phibench.scenes.frames import Array
from phibench.scenes.motion.drive import placement
from phibench.scenes.motion.film_scene import FilmScene
from phibench.scenes.room import Room

_STEP_M, _GRID_M = 0.03, 0.03  # way of the robot's ends from check to check; thinner things may slip through
# of the robot about its middle: ends, half width, and heights that are looked at
_ENDS_M, _SIDE_M, _LEVELS_M = (-0.45, 0.43), 0.255, (0.05, 0.17, 0.29)
_FLOOR_M = 0.03  # rugs and wires are no obstacles


def check_drives(plan: Plan, films: Iterable[FilmPlan]) -> None:
    """Check that no robot runs into anything on its way.

    Raises
    ------
    RecipeError
        If one does: film, leg, time and the thing.
    """
    for film in films:
        if film.scene.drive is not None and (told := _collision(film.scene, plan.room(film.pair.room))):
            raise RecipeError(f"film {film.film_id}: {told}; shorten or turn the leg, or move what stands there")


def _collision(scene: FilmScene, room: Room) -> str:
    """Sentence about the first thing that is run into; none where the way is free."""
    drive, geometry = scene.drive, own_geometry(room)
    assert drive is not None
    for number, (leg, profile) in enumerate(zip(drive.legs, drive.profiles, strict=True)):
        up_m = float(scene.carriage.position_m(profile.start_s))
        starts, ends = _robot_lines(scene, up_m)
        way_m = abs(leg.length_m) + _ENDS_M[1] * abs(leg.turn_rad) if leg.drives else 0.3  # flippers: their ends' way
        count = math.ceil(way_m / _STEP_M) + 1
        places = np.linspace(profile.start_m, profile.end_m, count)
        turns, origins = placement(drive.vehicle, drive.state_on_leg(number, places))
        one, other = (points @ turns.transpose(0, 2, 1) + origins[:, None] for points in (starts, ends))
        span = (other - one).reshape(-1, 3)
        length = np.linalg.norm(span, axis=1)
        hits = geometry.first_hit(one.reshape(-1, 3), span / length[:, None], length)
        with np.errstate(invalid="ignore"):
            high = one.reshape(-1, 3)[:, 2] + hits.distance_m * span[:, 2] / length > _FLOOR_M
        bad = np.flatnonzero((hits.object_id >= 0) & high)
        if len(bad):
            name = geometry.shapes[int(hits.object_id[bad[0]])].name
            share = (bad[0] // len(starts)) / max(count - 1, 1)
            return f"leg {number + 1} of the drive runs into '{name}' after {share:.0%} of its way"
    return ""


def _robot_lines(scene: FilmScene, up_m: float) -> tuple[Array, Array]:
    """Lines through chassis, mast and holder, in the rig's frame, shape (N, 3) each: starts and ends."""
    rig, (back, front) = scene.rig, _ENDS_M
    lines = [((back, y, z), (front, y, z)) for y in _grid(-_SIDE_M, _SIDE_M) for z in _LEVELS_M]
    lines += [((x, -_SIDE_M, z), (x, _SIDE_M, z)) for x in _grid(back, front) for z in _LEVELS_M]
    view = replace(rig, motion=None).at(up_m)
    axis, top = view.sphere_centre_m, float(view.sphere_centre_m[2]) + rig.top_m
    reach = rig.mirror.bound_m if rig.holder is None else rig.holder.plate_m
    for z in _grid(_LEVELS_M[-1], top):
        wide = reach if z > view.camera_centre_m[2] - 0.04 else 0.03  # the camera, and what it carries; the mast below
        lines += [((axis[0] - wide, axis[1], z), (axis[0] + wide, axis[1], z))]
        lines += [((axis[0], axis[1] - wide, z), (axis[0], axis[1] + wide, z))]
    ends = np.array(lines)
    return ends[:, 0], ends[:, 1]


def _grid(low: float, high: float) -> Array:
    return np.linspace(low, high, math.ceil((high - low) / _GRID_M) + 1)
