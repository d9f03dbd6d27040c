"""Where straight rays hit a room, in float64: the exact counterpart of Mitsuba's float32 intersections.

Closed forms per shape (plane, slabs), nothing shared with Mitsuba. Rays have shape (N, 3); metres.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from phibench.scenes.frames import Array
from phibench.scenes.solids import Cuboid, Shape

IntArray = NDArray[np.int64]

SURFACE_GAP_M = 1e-7  # a segment may touch the surface it ends on by this much; far above float64 rounding
_CHUNK = 8192  # rays at a time: the work arrays stay in the cache


def first_hit(shapes: Sequence[Shape], origins_m: Array, directions: Array) -> tuple[Array, IntArray]:
    """Distance to the first shape along each ray, and that shape's index.

    Parameters
    ----------
    shapes : sequence of Rectangle or Cuboid
    origins_m, directions : arrays, shape (N, 3); directions of unit length

    Returns
    -------
    distance_m : array, shape (N,); inf where nothing is hit
    object_id : int array, shape (N,); -1 where nothing is hit
    """
    count = len(directions)
    distance, object_id = np.full(count, np.inf), np.full(count, -1, dtype=np.int64)
    for start in range(0, count, _CHUNK):
        part = slice(start, start + _CHUNK)
        o, d = np.ascontiguousarray(origins_m[part].T), np.ascontiguousarray(directions[part].T)
        for index, shape in enumerate(shapes):
            t = _hit(shape, o, d)
            nearer = t < distance[part]
            distance[part][nearer] = t[nearer]
            object_id[part][nearer] = index
    return distance, object_id


def blocked_by(shapes: Sequence[Shape], starts_m: Array, ends_m: Array) -> IntArray:
    """Index of the first shape between two points, shape (N,), or -1 where the segment is free.

    Shapes within `SURFACE_GAP_M` of either end do not count: the ends lie on surfaces themselves.
    """
    span = ends_m - starts_m
    length = np.linalg.norm(span, axis=-1)
    directions = span / length[:, None]
    distance, object_id = first_hit(shapes, starts_m + SURFACE_GAP_M * directions, directions)
    return np.where(distance < length - 2.0 * SURFACE_GAP_M, object_id, -1)


def _hit(shape: Shape, origins: Array, directions: Array) -> Array:
    """Distance to one shape for rays of shape (3, N); inf where missed."""
    pose = shape.T_world_shape
    offset = origins - pose.t[:, None]
    if shape.T_world_shape.rotation != _UPRIGHT:
        offset, directions = pose.R.T @ offset, pose.R.T @ directions
    half = 0.5 * np.array(shape.size_m)
    with np.errstate(divide="ignore", invalid="ignore"):
        return _slabs(half, offset, directions) if isinstance(shape, Cuboid) else _plane(half, offset, directions)


_UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def _plane(half: Array, o: Array, d: Array) -> Array:
    t = -o[2] / d[2]
    inside = (np.abs(o[0] + t * d[0]) <= half[0]) & (np.abs(o[1] + t * d[1]) <= half[1])
    return np.where(inside & (t > 0.0), t, np.inf)


def _slabs(half: Array, o: Array, d: Array) -> Array:
    inverse = 1.0 / np.where(d == 0.0, 1e-300, d)  # 1 / 0 would make NaN for a ray in a face's plane
    centre, reach = -o * inverse, half[:, None] * np.abs(inverse)
    near = (centre - reach).max(axis=0)
    far = (centre + reach).min(axis=0)
    t = np.where(near > 0.0, near, far)  # from inside, the way out
    return np.where((near <= far) & (far > 0.0), t, np.inf)
