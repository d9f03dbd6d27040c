"""Triangulation of polygons: fans for convex ones, ear clipping within a work limit for concave ones; a test for quads.

Corners lie in a plane, or nearly. The triangles have the polygon's corners and its sense.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.scenes.frames import Array

_FLAT = 1e-12  # of the polygon's area: turns below it are straight


MOST_CUTTING = 15_000_000
"""Corners that are looked at for all concave polygons of a file together, one for each ear; some 3 to 7 s."""
_TURN_COST = 20  # corners that could be looked at in the time of one turn


class CuttingError(ValueError):
    """Concave polygons that would take too long."""


@dataclass
class CuttingBudget:
    """Rest of `MOST_CUTTING`: one for each file."""

    left: int = field(default_factory=lambda: MOST_CUTTING)

    def take(self, corners: int) -> None:
        """Count corners that are looked at."""
        self.left -= corners
        if self.left < 0:
            raise CuttingError("concave polygons of too many corners")


def triangulated(points: Array, cutting: CuttingBudget) -> NDArray[np.int64]:
    """Triangles of one polygon by the numbers of its corners, shape (n - 2, 3).

    Parameters
    ----------
    points : shape (n, 3), n from 3 up
    cutting : CuttingBudget

    Raises
    ------
    CuttingError
        If the concave polygons of the file take too long.

    Notes
    -----
    Ears are cut off as G. H. Meisters proves that they exist ("Polygons have ears", 1975). A polygon that crosses
    itself has no right answer: what is left of it becomes a fan.
    """
    count = len(points)
    fan = np.stack([np.zeros(count - 2, int), np.arange(1, count - 1), np.arange(2, count)], axis=1)
    if count == 3:
        return fan
    normal = _normal(points)
    size = float(np.linalg.norm(normal))
    if not size > 0.0:
        return fan
    flat = _flattened(points, normal / size)
    if _is_convex(flat, size):
        return fan
    return _by_ears(flat, size, cutting)


QUAD = np.array([[0, 1, 2], [0, 2, 3]])
"""Triangles of a convex polygon of four corners, as `triangulated` has them."""


def plain_quads(points: Array, polygons: Any) -> NDArray[np.bool_]:
    """Tell which polygons have four corners and are convex, shape (N,): `triangulated` takes 0.2 ms for each."""
    plain = np.array([len(polygon) == 4 for polygon in polygons], bool)
    if not plain.any():
        return plain
    index = np.array([polygon for polygon, four in zip(polygons, plain, strict=True) if four]).astype(np.int64)
    there = np.all((index >= 0) & (index < len(points)), axis=1)
    corners = points[np.where(there[:, None], index, 0)]
    along = np.roll(corners, -1, axis=1) - corners
    turns = np.cross(np.roll(along, 1, axis=1), along)
    normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])  # twice the area, as Newell's
    size = np.einsum("ni,ni->n", normal, normal)
    plain[plain] = there & np.all(np.einsum("nki,ni->nk", turns, normal) > _FLAT * size[:, None], axis=1)
    return plain


def _normal(points: Array) -> Array:
    """Twice the area times the normal (M. E. Newell)."""
    return np.asarray(np.cross(points - points[0], np.roll(points, -1, axis=0) - points[0]).sum(axis=0))


def _flattened(points: Array, normal: Array) -> Array:
    """Coordinates in the polygon's plane, shape (n, 2), against the clock."""
    first = np.eye(3)[int(np.argmin(np.abs(normal)))]
    u = np.cross(normal, first)
    u /= np.linalg.norm(u)
    return np.stack([points @ u, points @ np.cross(normal, u)], axis=1)


def _turn(a: Array, b: Array, c: Array) -> Array:
    """Twice the signed area of a, b, c; above 0 against the clock."""
    return np.asarray(
        (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
    )


def _is_convex(flat: Array, size: float) -> bool:
    turns = _turn(np.roll(flat, 1, axis=0), flat, np.roll(flat, -1, axis=0))
    if (turns < -_FLAT * size).any():
        return False  # a corner turns the other way
    edges = np.roll(flat, -1, axis=0) - flat
    angle = np.arctan2(edges[:, 1], edges[:, 0])
    around = np.angle(np.exp(1j * (np.roll(angle, -1) - angle))).sum()
    return abs(around - 2.0 * np.pi) < 1.0  # once around: a star that winds twice is not convex


def _by_ears(flat: Array, size: float, cutting: CuttingBudget) -> NDArray[np.int64]:
    left, triangles = list(range(len(flat))), []
    while len(left) > 3:
        ear = next((k for k in range(len(left)) if _is_ear(flat, left, k, size, cutting)), None)
        if ear is None:  # it crosses itself
            break
        triangles.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    triangles += [(left[0], left[k], left[k + 1]) for k in range(1, len(left) - 1)]
    return np.array(triangles, np.int64)


def _is_ear(flat: Array, left: list[int], k: int, size: float, cutting: CuttingBudget) -> bool:
    cutting.take(_TURN_COST)
    a, b, c = left[k - 1], left[k], left[(k + 1) % len(left)]
    if float(_turn(flat[a], flat[b], flat[c])) <= _FLAT * size:
        return False  # flat, or turned inwards: no ear
    cutting.take(len(left))
    others = flat[[p for p in left if p not in (a, b, c)]]
    corners = flat[[a, b, c]]
    others = others[~(others[:, None] == corners).all(axis=2).any(axis=1)]  # a corner that occurs twice is no obstacle
    inside = [_turn(corners[i], corners[(i + 1) % 3], others) >= -_FLAT * size for i in range(3)]
    return not bool(np.logical_and.reduce(inside).any())
