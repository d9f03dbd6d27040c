"""Outlines of lamps in the image (Dr.Jit): how much of a square of the film each rectangle that emits covers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.render.room.camera_plugin import MM_PER_M
from phibench.render.room.shading import Look
from phibench.render.room.surfaces import Surfaces, aligned, colour_planes

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))  # of a spiral that fills the disc evenly
_MEANS = (1.0 / 6.0, 1.0 / 6.0, 1.0 / 8.0, 1.0 / 8.0)  # of a second difference: half of the mean square
_MOST_BENDS = (0.04, 0.04, 0.1, 0.1)  # second differences over the film and over the lens, half squares
_FLAT = 1e-9  # of the area that the same sides would span: a lamp seen edge on
PARTS = 2  # of a cell, along a side, in each of which the map to a lamp is linear


@dataclass(frozen=True)
class LampCells:
    """Parts of n cells that lamps cover, each cell cut into `PARTS` x `PARTS` squares.

    Attributes
    ----------
    lamp : array, shape (n,), int32
    light : array, shape (3, n), float32
        Of a lamp on a cell that it covers whole, electrons/s per square pixel; 0 where it is not known.
    crossed, within : bool arrays, shape (squares, n)
        Squares that the lamp's outline may cross, and those that the lamp covers whole.
    """

    lamp: NDArray[np.int32]
    light: NDArray[np.float32]
    crossed: NDArray[np.bool_]
    within: NDArray[np.bool_]

    def of(self, chosen: Any) -> LampCells:
        """Some of the cells."""
        return LampCells(self.lamp[chosen], self.light[:, chosen], self.crossed[:, chosen], self.within[:, chosen])


@dataclass(frozen=True)
class _Square:
    """Squares of the film as lamps see them: Dr.Jit arrays.

    Attributes
    ----------
    corners : of a lamp's rectangle, in half sides of the square
    tilt : by how much they move with the point of the lens
    valid, crossed, within : masks
        Whether the map is known; whether an outline may cross the square; whether the lamp covers all of it.
    """

    corners: list[tuple[Any, Any]]
    tilt: list[tuple[Any, Any]]
    valid: Any
    crossed: Any
    within: Any


class LampOutlines:
    """Rectangles that emit, seen by an ideal mirror: how much of a square of the film each covers.

    A cell that a lamp's outline cuts is a mean over its square and over the lens. Samples that meet the lamp or not
    know it to 1e-4 only after 16 000 of them; a dark pixel beside a lamp a thousand times as bright needs that. By one
    lens point the mirror maps a small square to the lamp's plane almost linearly, and what the lamp covers of it is the
    area in which two parallelograms meet. The mean C over squares and lens points takes the place of what chance gives:
    a sample counts L (C - I) more, with I = 1 if its ray meets the plane within the lamp, and L the light of a cell
    that the lamp covers. Its expectation is 0, whatever hides the lamp; where something does, it adds noise, no bias.

    Of the map's second order the mean is taken into account; docs/model.md has what was measured of the rest. Cells in
    which the map bends too much are left to chance.
    """

    def __init__(self, mi: ModuleType, look: Look, surfaces: Surfaces) -> None:
        self._mi, self._look = mi, look
        table = surfaces.table
        patches = np.flatnonzero(table.emits)
        half = 0.5 * MM_PER_M * table.size_m[patches]
        centre = MM_PER_M * (table.centre_m[patches] - surfaces.view.sphere_centre_m)
        axes = [axis[patches] / half[:, [k]] for k, axis in enumerate((table.x_axis, table.y_axis))]
        rows = np.concatenate([centre, table.normal[patches], *axes, table.radiance_w_m2_sr[patches]], axis=1)
        numbers = np.full(len(table.size_m), -1, dtype=np.int32)
        brightest_last = np.argsort(table.radiance_w_m2_sr[patches].sum(axis=1), kind="stable")
        numbers[patches[brightest_last]] = np.arange(len(patches), dtype=np.int32)
        self._lamp = mi.Int32(aligned(numbers, np.int32))
        self._rows = [mi.Float64(aligned(column, np.float64)) for column in rows[brightest_last].T]

    def of_patch(self, patch: Any) -> Any:
        """Number of the lamp that is a patch, -1 where it is none; brighter lamps have higher numbers."""
        import drjit as dr

        return dr.gather(self._mi.Int32, self._lamp, patch)

    def cells(self, middle: list[Any], half: Any, _: Any, lamp: NDArray[np.int32]) -> LampCells:
        """Parts of cells, whose squares follow each other, that lamps, shape (n,), cover.

        The light is known where the map to the lamp is so in all squares of a cell.

        Parameters
        ----------
        middle, half
            Middle (u, v) of squares and half of their sides, float64 pixels.
        """
        import drjit as dr

        mi = self._mi
        ends, known, weight, radiance = self._ends(middle, half, mi.Int32(aligned(np.repeat(lamp, PARTS**2), np.int32)))
        shape = self._square(ends)
        light = weight * mi.Color3f(*(mi.Float(value) for value in radiance))
        light = dr.select(known & shape.valid, light, 0.0)
        dr.eval(light, shape.crossed, shape.within)
        lights = colour_planes(light).reshape(3, -1, PARTS**2)
        whole = (lights.sum(axis=0) > 0.0).all(axis=1)
        crossed, within = (np.array(one, dtype=bool).reshape(-1, PARTS**2).T for one in (shape.crossed, shape.within))
        return LampCells(lamp, np.where(whole, lights.mean(axis=2), np.float32(0.0)), crossed, within)

    def share(self, middle: list[Any], half: Any, points: Any, turn: list[Any], lamp: Any) -> Any:
        """Part of squares of the film that lamps cover.

        Parameters
        ----------
        middle, half
            As for `cells`.
        points, turn
            Number of lens points, and two uniform deviates that turn their pattern.
        lamp
            Number of each square's lamp.
        """
        return self._mi.Float(self._covered(self._square(self._ends(middle, half, lamp)[0]), points, turn))

    def _ends(self, middle: list[Any], half: Any, lamp: Any) -> tuple[list[tuple[Any, Any]], Any, Any, Any]:
        """Places on lamps, whether all are known, weight of the middle ray, and radiance of the lamps.

        The places are those of the middle, of -s, s, -t, t on the film, and of four points on the rim of the lens.
        """
        import drjit as dr

        mi, (u, v) = self._mi, middle
        steps = [(0.0, 0.0)] + [(sign * (k == 0), sign * (k == 1)) for k in (0, 1) for sign in (-1.0, 1.0)]
        rays = [self._look.reflected(u + a * half, v + b * half, mi.Point2f(0.0)) for a, b in steps]
        rays += [self._look.reflected(u, v, mi.Point2f(a, b)) for a, b in steps[1:]]
        rows, known = self._row(lamp)
        ends = [_place(dr, rows, ray) for ray in rays]
        for _, _, met in ends:
            known &= met
        return [(a, b) for a, b, _ in ends], known, rays[0][2], rows[4]

    def meets(self, ray: tuple[Any, Any, Any], lamp: Any) -> Any:
        """True where rays meet the plane of a lamp within the lamp, whatever hides it."""
        import drjit as dr

        rows, known = self._row(lamp)
        a, b, met = _place(dr, rows, ray)
        return known & met & (dr.abs(a) <= 1.0) & (dr.abs(b) <= 1.0)

    def _row(self, lamp: Any) -> tuple[list[Any], Any]:
        """Centre, normal, two axes over half sides squared, and radiance of lamps; whether there is one."""
        import drjit as dr

        mi, known = self._mi, lamp >= 0
        index = mi.UInt32(dr.maximum(lamp, 0))
        row = [dr.gather(mi.Float64, column, index, known) for column in self._rows]
        return [mi.Vector3d(*row[3 * k : 3 * k + 3]) for k in range(5)], known

    def _square(self, ends: list[tuple[Any, Any]]) -> _Square:
        """Square of the film as a lamp sees it, by the places of `_ends`."""
        import drjit as dr

        middle, *others = ends
        slopes, bends = [], []
        for low, high in zip(others[::2], others[1::2], strict=True):
            slopes.append([0.5 * (q - p) for p, q in zip(low, high, strict=True)])
            bends.append([p + q - 2.0 * m for p, q, m in zip(low, high, middle, strict=True)])
        (ja, jb), (ka, kb), *tilt = slopes
        det = ja * kb - jb * ka
        valid = dr.abs(det) > _FLAT * dr.sqrt((ja * ja + ka * ka) * (jb * jb + kb * kb))
        inverse = 1.0 / dr.select(valid, det, 1.0)

        def square(a: Any, b: Any) -> tuple[Any, Any]:
            return (kb * a - ka * b) * inverse, (ja * b - jb * a) * inverse

        # the mean of s^2 over [-1, 1] is 1/3, that of x^2 over a disc 1/4
        a, b = (m + sum(one[k] * part for one, part in zip(bends, _MEANS, strict=True)) for k, m in enumerate(middle))
        for bend, most in zip(bends, _MOST_BENDS, strict=True):
            s, t = square(*bend)
            valid &= (dr.abs(s) < most) & (dr.abs(t) < most)
        corners = [square(p - a, q - b) for p, q in ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))]
        # a lamp's outline that no point of the lens brings into the square: one point tells all
        reach = [dr.abs(j) + dr.abs(k) + dr.sqrt(x * x + y * y) for j, k, x, y in zip(*slopes, strict=True)]
        apart = (dr.abs(a) > 1.0 + reach[0]) | (dr.abs(b) > 1.0 + reach[1])
        within = (dr.abs(a) < 1.0 - reach[0]) & (dr.abs(b) < 1.0 - reach[1])
        return _Square(corners, [square(*one) for one in tilt], valid, ~(apart | within), within)

    def _covered(self, square: _Square, points: Any, turn: list[Any]) -> Any:
        """Part of squares, (s, t) in [-1, 1]^2, that a lamp covers, mean over the lens."""
        import drjit as dr

        mi = self._mi
        (xs, xt), (ys, yt) = square.tilt
        first, angle0 = mi.Float64(turn[0]), 2.0 * math.pi * mi.Float64(turn[1])

        def body(i: Any, area: Any) -> tuple[Any, Any]:
            radius = dr.sqrt((mi.Float64(i) + first) / mi.Float64(points))
            angle = _GOLDEN_ANGLE * mi.Float64(i) + angle0
            x, y = radius * dr.cos(angle), radius * dr.sin(angle)
            moved = [(s - x * xs - y * ys, t - x * xt - y * yt) for s, t in square.corners]
            return i + 1, area + dr.abs(sum(_swept(dr, moved[k], moved[(k + 1) % 4]) for k in range(4)))

        start = (mi.UInt32(0), dr.zeros(mi.Float64, dr.width(xs)))
        _, area = dr.while_loop(start, lambda i, _: i < points, body)
        return area / (4.0 * mi.Float64(dr.maximum(points, 1)))


def _place(dr: ModuleType, lamp: list[Any], ray: tuple[Any, ...]) -> tuple[Any, Any, Any]:
    """Place at which a ray meets a lamp's plane, in half sides from its centre, and whether it meets its front."""
    centre, normal, x, y, _ = lamp
    start, direction, *_, found = ray
    slope = dr.dot(normal, direction)
    way = centre - start
    height = dr.dot(normal, way)
    valid = found & (slope < 0.0) & (height < 0.0)
    arm = height / dr.select(valid, slope, -1.0) * direction - way
    return dr.dot(arm, x), dr.dot(arm, y), valid


def _swept(dr: ModuleType, start: tuple[Any, Any], end: tuple[Any, Any]) -> Any:
    """Integral of x, held within [-1, 1], by y within [-1, 1] along a line.

    Summed over the sides of a polygon this is the area of its part within the square.
    """
    (x0, y0), (x1, y1) = start, end
    rise = y1 - y0
    slope = (x1 - x0) / dr.select(dr.abs(rise) > 0.0, rise, 1.0)
    low, high = dr.clip(y0, -1.0, 1.0), dr.clip(y1, -1.0, 1.0)
    left, right = x0 + (low - y0) * slope, x0 + (high - y0) * slope
    run = right - left
    plain = dr.abs(run) < 1e-6
    mean = (_antiderivative(dr, right) - _antiderivative(dr, left)) / dr.select(plain, 1.0, run)
    return (high - low) * dr.select(plain, dr.clip(0.5 * (left + right), -1.0, 1.0), mean)


def _antiderivative(dr: ModuleType, x: Any) -> Any:
    held = dr.minimum(dr.abs(x), 1.0)
    return held * (dr.abs(x) - 0.5 * held)
