"""Lines of sight past solids: segments that boxes block, and places that the robot hides from the mirror."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from phibench.estimator.geometry.reflection import image_of, reflect
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig
from phibench.scenes.room import escalade360
from phibench.scenes.shapes import Cuboid

_END_M = 1e-6  # a segment may touch the surface that it ends on


def blocked_segments(solid: Cuboid, start_m: Array, end_m: Array) -> BoolArray:
    """Segments, shape (..., 3), that pass through a box: bool, shape (...).

    The part of the segment inside each pair of planes is an interval of its parameter; the box is hit where the three
    have more than a point in common.
    """
    into = solid.T_world_shape.inverse()
    a, b = into.points(np.asarray(start_m, float)), into.points(np.asarray(end_m, float))
    half = 0.5 * np.array(solid.size_m)
    along = b - a
    length = np.linalg.norm(along, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        one, two = (-half - a) / along, (half - a) / along
        parallel = along == 0.0
        inside = np.abs(a) < half
        low = np.where(parallel, np.where(inside, -np.inf, np.inf), np.minimum(one, two)).max(axis=-1)
        high = np.where(parallel, np.where(inside, np.inf, -np.inf), np.maximum(one, two)).min(axis=-1)
        end = _END_M / length
    return np.asarray(np.minimum(high, 1.0 - end) > np.maximum(low, end))


def first_blocker(solids: Sequence[Cuboid], legs: Sequence[tuple[Array, Array]]) -> str | None:
    """Name of the first solid that stands in any leg (start, end), shapes (..., 3), of any ray; None if none does."""
    for solid in solids:
        if any(np.any(blocked_segments(solid, start, end)) for start, end in legs):
            return solid.name
    return None


def unhidden_places(rig: Rig, points_m: Array, offset_m: float) -> BoolArray:
    """Places that robot, mast and housing do not hide on the way to the mirror, shape (n,)."""
    view = rig.at(offset_m)
    lowered = points_m - offset_m * np.array(rig.stroke_axis_world)  # seen as the points by the raised rig
    mirror = reflect(view, image_of(rig.at(0.0), lowered).uv_px).origin_world_m
    known = np.asarray(np.isfinite(mirror).all(axis=-1))
    start = np.where(known[:, None], mirror, view.sphere_centre_m)
    solids = escalade360(view)
    inside = [_holds(solid.T_world_shape.inverse().points(points_m), solid.size_m) for solid in solids]
    return np.asarray(
        known & ~np.any([*inside, *(blocked_segments(solid, start, points_m) for solid in solids)], axis=0)
    )


def _holds(points_m: Array, size_m: Sequence[float]) -> BoolArray:
    return np.asarray(np.all(np.abs(points_m) <= 0.5 * np.array(size_m), axis=-1))
