"""Whether solids stand between two points: segments against boxes, by clipping. The estimator's own mathematics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.solids import Cuboid

_END_M = 1e-6  # a segment may touch the surface that it ends on


def blocked(solid: Cuboid, start_m: Array, end_m: Array) -> BoolArray:
    """Whether segments, shape (..., 3), pass through a box, shape (...).

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
        if any(np.any(blocked(solid, start, end)) for start, end in legs):
            return solid.name
    return None
