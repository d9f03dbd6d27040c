"""Shading kernels (Dr.Jit): the camera's look into a room, the outlines of lamps in it, refraction by a glass tube.

The ray from the film to the mirror and its reflection are float64 (`mirror_intersection`). The mirror is convex and
stands in no table of faces, so that a reflected ray needs no lift. Only where something may stand between lens and
mirror, such as a holder, the way to the mirror is a query of its own.

A glass tube around mirror and lens turns and lifts rays on their way out (`scenes.glass_tube`, float64 here as well),
whether they come from the mirror or from the lens. What its faces mirror back to the inside is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.render.room.camera_plugin import MM_PER_M, sensor_dict
from phibench.render.room.mirror_intersection import mirror_intersection
from phibench.render.room.surfaces import Surfaces, aligned
from phibench.scenes.metals import BandReflectance
from phibench.scenes.rig import Rig, View


class Look:
    """The camera of one view, looking into a room.

    Parameters
    ----------
    surfaces : Surfaces
        With their light.
    """

    def __init__(self, mi: ModuleType, surfaces: Surfaces) -> None:
        import drjit as dr

        self._mi, self._surfaces = mi, surfaces
        self.view = surfaces.view
        rig = self.view.rig
        self._sensor = mi.load_dict(sensor_dict(mi, self.view))
        self._crossed = surfaces.cross_the_way()
        self._tube = None if self.view.tube is None else Tube(mi, self.view)
        self._meet = mirror_intersection(mi, self.view)
        self._alpha = dr.opaque(mi.Float, rig.mirror.roughness_alpha)
        self._bands = mirror_bands(mi, rig)

    def electrons(self, u: Any, v: Any, x: list[Any]) -> tuple[Any, Any, Any, Any]:
        """Electrons/s per square pixel at film positions (u, v), float64 pixels.

        Also whether they see the mirror, the patch that is met by it, 0 for none, and the mirrored ray: its start (mm),
        direction, and whether the mirror is met, whatever stands before it.
        `x` are uniform deviates: two for the lens point, and two for the facet of a rough mirror.
        """
        import drjit as dr

        mi = self._mi
        origin, direction, weight = self._sensor.film_ray(u, v, self.lens(x))
        point, normal, mirrored = self._meet(origin, direction)
        found = mirrored
        if self._crossed:
            approach = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
            approach.maxt = dr.select(mirrored, mi.Float(dr.norm(point - origin)), 0.0)
            mirrored = mirrored & ~self._surfaces.scene.ray_test(approach, coherent=True, active=mirrored)
        facet, shadowing = normal, mi.Float(1.0)
        if x[2:]:
            turned, shadowing = _facet(mi, self._alpha, mi.Vector3f(normal), mi.Vector3f(direction), x[2:])
            facet = mi.Vector3d(turned)
        cos = -dr.dot(direction, facet)
        place = dr.select(mirrored, point, origin)
        way = dr.select(mirrored, direction + 2.0 * cos * facet, direction)
        if self._tube is not None:
            place, way, passing = self._tube.leave(self._surfaces, place, way)
            weight *= passing
        start, onward = mi.Point3f(place), mi.Vector3f(way)
        ray = mi.Ray3f(start, onward)
        t, patch, valid = self._surfaces.hit(ray)
        radiance = self._surfaces.radiance(patch, ray(t), onward, valid, lamps=True)
        reflectance = dr.select(mirrored, shadowing * self._reflectance(mi.Float(cos)), 1.0)
        met = dr.select(valid & mirrored, patch, 0)
        return weight * reflectance * radiance, mirrored, met, (point, direction + 2.0 * cos * facet, found)

    def lens(self, x: list[Any]) -> Any:
        """Point of the unit disc that two uniform deviates mean."""
        return self._mi.warp.square_to_uniform_disk_concentric(self._mi.Point2f(x[0], x[1]))

    def reflected(self, u: Any, v: Any, lens: Any) -> tuple[Any, Any, Any, Any]:
        """Ray that an ideal mirror sends on: start (mm), direction, float64; its weight, and whether there is one.

        What stands between lens and mirror does not count.
        """
        import drjit as dr

        mi = self._mi
        origin, direction, weight = self._sensor.film_ray(u, v, lens)
        point, normal, found = self._meet(origin, direction)
        cos = -dr.dot(direction, normal)
        return point, direction + 2.0 * cos * normal, weight * self._reflectance(mi.Float(cos)), found

    def _reflectance(self, cos: Any) -> Any:
        """Reflectance of the three bands."""
        return self._mi.Color3f(*(band(cos) for band in self._bands))


def mirror_bands(mi: ModuleType, rig: Rig) -> list[Callable[[Any], Any]]:
    """Reflectance of the mirror in each band, by the cosine of the angle of incidence: as `BandReflectance`."""
    return [_band(mi, rig.mirror.band(nm)) for nm in rig.camera.detector.band_wavelength_nm]


def _band(mi: ModuleType, band: BandReflectance) -> Callable[[Any], Any]:
    import drjit as dr

    numbers = (band.index.real, band.index.imag, band.gain, band.loss)
    n, k, gain, loss = (dr.opaque(mi.Float, float(x)) for x in numbers)
    start, *knots = ([dr.opaque(mi.Float, float(x)) for x in pair] for pair in _slopes(band))

    def by_angle(cos: Any) -> Any:
        angle, value = dr.safe_acos(cos), start[1]
        for (low, slope), (high, _) in pairwise([*knots, (dr.opaque(mi.Float, math.pi), 0.0)]):
            value = value + slope * dr.clip(angle - low, 0.0, high - low)
        return value

    if len(band.values):
        return by_angle
    if band.gain == band.loss == 1.0:
        return lambda cos: mi.fresnel_conductor(cos, mi.Complex2f(n, k))
    return lambda cos: 1.0 - loss * (1.0 - gain * mi.fresnel_conductor(cos, mi.Complex2f(n, k)))


def _slopes(band: BandReflectance) -> list[tuple[float, float]]:
    """Place and value of the first angle of a table, then place and slope of each part that is linear."""
    if not len(band.values):
        return [(0.0, 1.0)]
    slopes = np.append(np.diff(band.values) / np.diff(band.angles_rad), 0.0)
    return [(0.0, float(band.values[0])), *zip(band.angles_rad.tolist(), slopes.tolist(), strict=True)]


class Tube:
    """Glass tube of a view in the scene's coordinates: mm, world axes, the sphere centre, on the tube's axis, at 0."""

    def __init__(self, mi: ModuleType, view: View) -> None:
        import drjit as dr

        tube = view.tube
        assert tube is not None
        self._mi = mi
        centre = float(tube.height_m(view.sphere_centre_m[None])[0])
        lengths = (tube.inner_m, tube.outer_m, tube.low_m - centre, tube.high_m - centre)
        self._inner, self._outer, self._low, self._high = (dr.opaque(mi.Float64, MM_PER_M * one) for one in lengths)
        self._index = dr.opaque(mi.Float64, tube.index)
        self._axis = mi.Vector3d(*(dr.opaque(mi.Float64, float(x)) for x in tube.axis))

    def leave(self, surfaces: Surfaces, start: Any, direction: Any) -> tuple[Any, Any, Any]:
        """Rays from inside as they go on into the room, and what the glass passes; float64.

        The same as `room_tracer.into_room`: what meets a face before the glass stays as it is.
        """
        import drjit as dr

        mi = self._mi
        direction = dr.normalize(direction)
        inner, outer, onward, passing = self.cross(start, direction)
        crosses, passes = (self._within(point) for point in (inner, outer))
        before = mi.Ray3f(mi.Point3f(start), mi.Vector3f(direction))
        before.maxt = dr.select(crosses, mi.Float(dr.norm(inner - start)), 0.0)
        crosses &= ~surfaces.scene.ray_test(before, coherent=True, active=crosses)
        place, way = dr.select(passes, outer, inner), dr.select(passes, onward, dr.normalize(outer - inner))
        return (
            dr.select(crosses, place, start),
            dr.select(crosses, way, direction),
            dr.select(crosses, mi.Float(passing), 1.0),
        )

    def cross(self, start: Any, direction: Any) -> tuple[Any, Any, Any, Any]:
        """Points on the two faces, direction outside and transmittance: the closed forms of `scenes.glass_tube`."""
        import drjit as dr

        axis, n2 = self._axis, dr.square(self._index)
        L, q = dr.dot(axis, dr.cross(start, direction)), dr.dot(axis, direction)
        square = 1.0 - q * q
        w, w_g = dr.sqrt(square), dr.sqrt(n2 - q * q)
        towards = dr.dot(start, direction) - dr.dot(start, axis) * q
        s1, s2 = ((dr.sqrt(square * r * r - L * L) - towards) / square for r in (self._inner, self._outer))
        (S_g, C_g), (S, C) = (self._between(L / one) for one in (w_g, w))
        sine, cosine = dr.sincos(S_g - S)
        outer = self._turned(start + s2 * direction, sine, cosine) + q * (C_g / w_g - C / w) * axis
        cos = dr.sqrt(square - dr.square(L / self._inner))
        inside, steep = dr.sqrt(n2 - 1.0 + cos * cos), n2 * cos
        passing = cos * inside / (cos * cos + inside * inside) + steep * inside / (steep * steep + inside * inside)
        return start + s1 * direction, outer, self._turned(direction, sine, cosine), passing

    def _between(self, b: Any) -> tuple[Any, Any]:
        """Angle and length between the radii of a line at a distance b from the axis."""
        import drjit as dr

        near, far = self._inner, self._outer
        return dr.asin(b / near) - dr.asin(b / far), dr.sqrt(far * far - b * b) - dr.sqrt(near * near - b * b)

    def _turned(self, vector: Any, sine: Any, cosine: Any) -> Any:
        import drjit as dr

        along = dr.dot(self._axis, vector) * self._axis
        return along + cosine * (vector - along) + sine * dr.cross(self._axis, vector)

    def _within(self, point: Any) -> Any:
        import drjit as dr

        height = dr.dot(self._axis, point)
        return (height > self._low) & (height < self._high)


def _facet(mi: ModuleType, alpha: Any, normal: Any, direction: Any, x: list[Any]) -> tuple[Any, Any]:
    """Normal of a visible Beckmann facet, and Smith's masking of the way out (0 below the surface).

    Walter et al. (2007), with the visible normals of Heitz and d'Eon (2014): the weight is the masking alone.
    """
    import drjit as dr

    frame = mi.Frame3f(normal)
    facets = mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, alpha, True)
    towards = frame.to_local(-direction)
    facet, _ = facets.sample(towards, mi.Point2f(x[0], x[1]))
    out = 2.0 * dr.dot(towards, facet) * facet - towards
    return frame.to_world(facet), dr.select(out.z > 0.0, facets.smith_g1(out, facet), 0.0)


# Outlines of lamps.

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))  # of a spiral that fills the disc evenly
_MEANS = (1.0 / 6.0, 1.0 / 6.0, 1.0 / 8.0, 1.0 / 8.0)  # of a second difference: half of the mean square
_MOST_BENDS = (0.04, 0.04, 0.1, 0.1)  # second differences over the film and over the lens, half squares
_FLAT = 1e-9  # of the area that the same sides would span: a lamp seen edge on


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

    Parameters
    ----------
    look : Look
    surfaces : Surfaces
    """

    def __init__(self, mi: ModuleType, look: Look, surfaces: Surfaces) -> None:
        self._mi, self._look = mi, look
        table = surfaces.table
        patches = np.flatnonzero(table.emits)
        half = 0.5 * MM_PER_M * table.size_m[patches]
        centre = MM_PER_M * (table.centre_m[patches] - surfaces.view.sphere_centre_m)
        axes = [axis[patches] / half[:, [k]] for k, axis in enumerate((table.x_axis, table.y_axis))]
        rows = np.concatenate([centre, table.normal[patches], *axes, table.radiance_w_m2_sr[patches]], axis=1)
        self._lamp = np.full(len(table.size_m), -1, dtype=np.int32)
        brightest_last = np.argsort(table.radiance_w_m2_sr[patches].sum(axis=1), kind="stable")
        self._lamp[patches[brightest_last]] = np.arange(len(patches), dtype=np.int32)
        self._rows = [mi.Float64(aligned(column, np.float64)) for column in rows[brightest_last].T]

    def lamp(self, patch: NDArray[np.uint32]) -> NDArray[np.int32]:
        """Number of the lamp that is a patch, -1 where it is none; brighter lamps have higher numbers."""
        return np.asarray(self._lamp[patch])

    def outline(self, middle: list[Any], half: Any, lamp: Any) -> tuple[Any, Any, Any]:
        """Light of lamps on squares of the film, electrons/s per square pixel; whether their outlines may cross these.

        The light is that of a square which the lamp covers whole; 0 where the map is not known well enough. Where no
        point of the lens brings an outline into a square, the third mask tells whether the lamp covers it.

        Parameters
        ----------
        middle, half
            Middle (u, v) of squares and half of their sides, float64 pixels.
        lamp
            Numbers of lamps, -1 for none.
        """
        import drjit as dr

        mi = self._mi
        ends, known, weight, radiance = self._ends(middle, half, lamp)
        shape = self._square(ends)
        light = weight * mi.Color3f(*(mi.Float(value) for value in radiance))
        return dr.select(known & shape.valid, light, 0.0), shape.crossed, shape.within

    def share(self, middle: list[Any], half: Any, points: Any, turn: list[Any], lamp: Any) -> Any:
        """Part of squares of the film that lamps cover; arguments as for `outline`.

        Parameters
        ----------
        points, turn
            Number of lens points, and two uniform deviates that turn their pattern.
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
