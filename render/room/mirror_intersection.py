"""Intersection of rays with the mirror in Dr.Jit: points, normals; the closed body that shades its holder; reflectance.

The scene's coordinates are millimetres, world axes, and the sphere centre or the vertex of a mirror of revolution at
the origin. Numbers of a mirror are opaque: one kernel serves all mirrors of a kind. Rays come from outside; those that
miss the mirror get finite numbers that mean nothing.

**Sphere.** Closed form.

**Form error of a sphere.** Newton's method on q(t) = |P|^2 - r(P / |P|)^2 along the ray: first to its least value,
which tells hit from miss, then from the parabola's zero to that of q.

**Mirror of revolution.** A quadric gives a quadratic in the distance. Even terms add P(s) to its sag. The excess of sag
over height is a convex function along the ray, because the profile is convex. The quadric shifted by the least P lies
before the surface: from where it is met Newton's method runs up to the first root and never beyond.

`ray_tracer` answers the same questions from values alone, `reflection_point` from the other side; tests compare them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from types import ModuleType
from typing import Any

import numpy as np

from phibench.render.room.camera_plugin import MM_PER_M
from phibench.scenes.frames import Array
from phibench.scenes.metals import BandReflectance
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.revolved_profile import FormedProfile, Profile, disc_polynomials
from phibench.scenes.rig import Rig, View

Meeting = Callable[[Any, Any], tuple[Any, Any, Any]]


def mirror_intersection(mi: ModuleType, view: View) -> Meeting:
    """Function from origins and unit directions to first points, outward unit normals, and whether there is one."""
    mirror = view.rig.mirror
    if isinstance(mirror, RevolvedMirror):
        return _Revolved(mi, view, mirror.surface).meet
    if mirror.form is not None:
        return _FormedBall(mi, view).meet
    return _ball(mi, mirror.radius_m)


def _ball(mi: ModuleType, radius_m: float) -> Meeting:
    import drjit as dr

    radius = dr.opaque(mi.Float64, MM_PER_M * radius_m)
    per_radius = dr.opaque(mi.Float64, 1.0 / (MM_PER_M * radius_m))

    def meet(origin: Any, direction: Any) -> tuple[Any, Any, Any]:
        approach = -dr.dot(origin, direction)
        foot = origin + approach * direction  # nearest point to the centre: no cancellation
        square = dr.square(radius) - dr.squared_norm(foot)
        found = (square > 0.0) & (approach > 0.0)
        point = foot - dr.sqrt(dr.maximum(square, 0.0)) * direction
        return point, point * per_radius, found

    return meet


# Mirror of revolution.

_BEFORE_TIP_MM = 1e-9  # rounding of a height near the vertex
_RISES = 12  # 3 to 5 do, but where the ray grazes: each step halves the way there
_FORM_RISES = 8  # of a dearer function, from nearer to it
_TOUCHED_MM = 1e-6  # excess of what is met: 12 halvings leave a grazing ray 4^-12 of its first, some 0.01 mm
_PLACES = 1001  # where the least of the even terms is looked for


class _Revolved:
    """A profile's numbers in millimetres."""

    def __init__(self, mi: ModuleType, view: View, surface: Profile | FormedProfile) -> None:
        import drjit as dr

        profile = surface.ideal

        def number(value: float) -> Any:
            return dr.opaque(mi.Float64, float(value))

        self._vector, self._axes = mi.Vector3d, _numbers(mi, view.T_world_sphere.R)
        self._radius, self._bend = number(MM_PER_M * profile.vertex_radius_m), number(1.0 + profile.conic)
        self._rim2 = number((MM_PER_M * profile.rim_radius_m) ** 2)
        terms = profile.even_terms if not profile.is_quadric else ()
        self._terms = [number(a * MM_PER_M ** (1 - 2 * i)) for i, a in enumerate(terms, start=2)]
        self._form, before_m = None, -_least_of_terms(profile)
        if surface.form is not None:
            self._form, before_m = _DiscForm(number, surface), before_m + surface.reach_m
        self._least, self._is_plain = number(-MM_PER_M * before_m), not terms and self._form is None

    def meet(self, origin: Any, direction: Any) -> tuple[Any, Any, Any]:
        """First points, normals, and whether there are any; see `mirror_intersection`."""
        import drjit as dr

        V, axes = self._vector, self._axes
        o, d = (_turned(V, _transposed(axes), vector) for vector in (origin, direction))
        approach = -dr.dot(o, d)
        foot = o + approach * d
        if self._is_plain:
            x, found = self._to_quadric(foot, d, -approach)
            P = foot + x * d
            gradient = V(P.x, P.y, self._bend * P.z - self._radius)
        else:
            x, found = self._to_quadric(foot - V(0.0, 0.0, self._least), d, -approach)
            x, excess = self._to_sag(foot, d, x)
            found &= excess < _TOUCHED_MM
            P = foot + x * d
            _, z_x, z_y = self._height(P)
            gradient = V(z_x, z_y, -1.0)
        found &= P.x * P.x + P.y * P.y <= self._rim2
        # at a cone's tip itself there is no normal
        normal = dr.select(found & (dr.squared_norm(gradient) > 0.0), dr.normalize(gradient), -d)
        return _turned(V, axes, dr.select(found, P, foot)), _turned(V, axes, normal), found

    def _to_quadric(self, foot: Any, d: Any, start: Any) -> tuple[Any, Any]:
        """Distance from the foot to the sheet of the vertex, 0 without one, and whether the ray meets it."""
        import drjit as dr

        A, R = self._bend, self._radius
        a = d.x * d.x + d.y * d.y + A * d.z * d.z
        b = foot.x * d.x + foot.y * d.y + (A * foot.z - R) * d.z
        c = foot.x * foot.x + foot.y * foot.y + (A * foot.z - 2.0 * R) * foot.z
        square = b * b - a * c
        root = dr.sqrt(dr.maximum(square, 0.0))
        q = -(b + dr.select(b < 0.0, -root, root))  # no cancellation
        best, found = type(b)(0.0), square < 0.0
        found = found & ~found
        for x in (q / a, c / q):
            z = foot.z + x * d.z
            # the half before the equator, or one sheet of two
            here = (square > 0.0) & (R - A * z >= 0.0) & (z >= -_BEFORE_TIP_MM) & (x > start) & dr.isfinite(x)
            best = dr.select(here & (~found | (x < best)), x, best)
            found |= here
        return best, found

    def _to_sag(self, foot: Any, d: Any, x: Any) -> tuple[Any, Any]:
        """Distance to the surface with its even terms, and the excess that is left there."""
        excess = x
        rises = _RISES if self._form is None else _FORM_RISES
        for step in range(rises + 1):
            P = foot + x * d
            z, z_x, z_y = self._height(P)
            excess = z - P.z
            if step < rises:
                x = x - excess / (z_x * d.x + z_y * d.y - d.z)
        return x, excess

    def _height(self, P: Any) -> tuple[Any, Any, Any]:
        """Height of the surface at places and its derivatives by x and y; as in `FormedProfile.heights`."""
        import drjit as dr

        s = P.x * P.x + P.y * P.y
        w = dr.sqrt(self._radius * self._radius - self._bend * s)
        z, slope, bend = s / (self._radius + w), 0.5 / w, 0.25 * self._bend / (w * w * w)
        power, lower = s, type(s)(1.0)
        for i, a in enumerate(self._terms, start=2):
            z, slope, bend = z + a * power * s, slope + i * a * power, bend + i * (i - 1) * a * lower
            power, lower = power * s, power
        z_x, z_y = 2.0 * slope * P.x, 2.0 * slope * P.y
        if self._form is None:
            return z, z_x, z_y
        h, h_x, h_y = self._form.at(P)
        N = dr.sqrt(1.0 + 4.0 * s * slope * slope)
        turned = 2.0 * h * (2.0 * slope * slope + 4.0 * s * slope * bend) / N
        return z - h * N, z_x - h_x * N - turned * P.x, z_y - h_y * N - turned * P.y


class _DiscForm:
    """Form error of a mirror of revolution, millimetres; as in `FormedProfile.deviation`."""

    def __init__(self, number: Callable[[float], Any], surface: FormedProfile) -> None:
        around, *waves = disc_polynomials(surface.form)
        parts = [around.real, *(part for w in waves for part in (w.real, -w.imag))]
        self._terms = [[number(MM_PER_M * c) for c in part] for part in parts]
        self._scale = number(1.0 / (MM_PER_M * surface.disc_m))

    def at(self, P: Any) -> tuple[Any, Any, Any]:
        """h and its derivatives by x and y."""
        c0, a1, b1, a2, b2, (a3,), (b3,) = self._terms
        X, Y = self._scale * P.x, self._scale * P.y
        t = X * X + Y * Y
        a, b = a1[0] + t * (a1[1] + t * a1[2]), b1[0] + t * (b1[1] + t * b1[2])
        p, q = a2[0] + a2[1] * t, b2[0] + b2[1] * t
        C2, S2 = X * X - Y * Y, 2.0 * X * Y
        h = c0[0] + t * (c0[1] + t * (c0[2] + t * c0[3])) + a * X + b * Y + p * C2 + q * S2
        h = h + a3 * (C2 * X - S2 * Y) + b3 * (C2 * Y + S2 * X)
        by_t = c0[1] + t * (2.0 * c0[2] + 3.0 * c0[3] * t) + (a1[1] + 2.0 * a1[2] * t) * X
        by_t = by_t + (b1[1] + 2.0 * b1[2] * t) * Y + a2[1] * C2 + b2[1] * S2
        h_x = 2.0 * X * by_t + a + 2.0 * (p * X + q * Y) + 3.0 * (a3 * C2 + b3 * S2)
        h_y = 2.0 * Y * by_t + b + 2.0 * (q * X - p * Y) + 3.0 * (b3 * C2 - a3 * S2)
        return h, self._scale * h_x, self._scale * h_y


def _least_of_terms(profile: Profile) -> float:
    """Least sum of the even terms inside the rim, metres, with a margin for what is between the places: at most 0."""
    s = np.linspace(0.0, profile.rim_radius_m**2, _PLACES)
    added = sum((a * s**i for i, a in enumerate(profile.even_terms, start=2)), np.zeros_like(s))
    return float(added.min()) - 1e-3 * float(np.ptp(added))


# Sphere with a form error.

_LEAST_STEPS = 3
_STEPS = 5


class _FormedBall:
    """A form's numbers in millimetres. Each is one variable: a kernel would load again what is made again."""

    def __init__(self, mi: ModuleType, view: View) -> None:
        import drjit as dr

        form = view.rig.sphere.form
        assert form is not None
        Q, T = form.tensors
        self._vector, self._axes = mi.Vector3d, _numbers(mi, view.T_world_sphere.R)
        self._radius = dr.opaque(mi.Float64, MM_PER_M * view.rig.sphere.radius_m)
        self._Q, self._T = _numbers(mi, MM_PER_M * Q), [_numbers(mi, MM_PER_M * part) for part in T]

    def meet(self, origin: Any, direction: Any) -> tuple[Any, Any, Any]:
        """First points, normals, and whether there are any; see `mirror_intersection`."""
        import drjit as dr

        V, axes, radius = self._vector, self._axes, self._radius
        o, d = (_turned(V, _transposed(axes), vector) for vector in (origin, direction))
        d = dr.normalize(d)
        foot = o - dr.dot(o, d) * d
        foot2 = dr.dot(foot, foot)
        central = foot2 < 0.25 * radius * radius  # certainly hits, and q is no parabola near the sphere's centre
        x = type(radius)(0.0)
        for _ in range(_LEAST_STEPS):  # q'' is 2 but for the form
            _, slope = self._q(foot, foot2, d, x)
            x = dr.select(central, 0.0, x - 0.5 * slope)
        q, _ = self._q(foot, foot2, d, x)
        q = dr.select(central, foot2 - radius * radius, q)
        found = q < 0.0
        x = x - dr.sqrt(dr.maximum(-q, 0.0))
        for _ in range(_STEPS):
            q, slope = self._q(foot, foot2, d, x)
            x = dr.select(found, x - q / slope, x)
        P = foot + x * d
        rho = dr.norm(P)
        n = P / rho
        _, gradient = self._added(n)
        normal = dr.normalize(n - gradient / rho)
        return _turned(V, axes, P), _turned(V, axes, normal), found

    def _q(self, foot: Any, foot2: Any, d: Any, x: Any) -> tuple[Any, Any]:
        """q and its derivative by the distance x from the foot."""
        import drjit as dr

        rho2 = foot2 + x * x
        rho = dr.sqrt(rho2)
        added, gradient = self._added((foot + x * d) / rho)
        r = self._radius + added
        return rho2 - r * r, 2.0 * x - 2.0 * r * dr.dot(gradient, d) / rho

    def _added(self, n: Any) -> tuple[Any, Any]:
        """Deviation of the radius in a unit direction, and its derivative along the unit sphere."""
        import drjit as dr

        V = self._vector
        q = _turned(V, self._Q, n)
        t = V(*(dr.dot(n, _turned(V, part, n)) for part in self._T))
        along_q, along_t = dr.dot(q, n), dr.dot(t, n)
        return along_q + along_t, 2.0 * q + 3.0 * t - (2.0 * along_q + 3.0 * along_t) * n


Rows = list[list[Any]]


def _numbers(mi: ModuleType, matrix: Array) -> Rows:
    """Rows of a matrix of float64."""
    import drjit as dr

    return [[dr.opaque(mi.Float64, float(value)) for value in row] for row in matrix]


def _transposed(rows: Rows) -> Rows:
    return [list(column) for column in zip(*rows, strict=True)]


def _turned(V: Any, rows: Rows, vector: Any) -> Any:
    """Matrix times vector."""
    return V(*(row[0] * vector.x + row[1] * vector.y + row[2] * vector.z for row in rows))


# Body that shades and mirrors what stands beside it.

_BODY_PLACES = 401  # of a profile
_MARGIN = 1.001  # of the ball around it


@dataclass(frozen=True)
class MirrorBody:
    """The mirror as rays from beside it meet it; in the scene, mm.

    Attributes
    ----------
    centre, radius : Dr.Jit
        Of a ball that holds it.
    meets : callable
        From points and unit directions to masks of rays that meet it, their distances from it, outward unit normals
        there, and masks of what mirrors.
    """

    centre: Any
    radius: Any
    meets: Callable[[Any, Any], tuple[Any, Any, Any, Any]]


def mirror_body(mi: ModuleType, view: View) -> MirrorBody | None:
    """Mirror of a view; None without a holder: it then has nothing beside it that is lit."""
    if view.rig.holder is None:
        return None
    mirror = view.rig.mirror
    if mirror.radius_m is None:
        return _revolved_body(mi, view, mirror)
    return _ball_body(mi, mirror.radius_m)


def _ball_body(mi: ModuleType, radius_m: float) -> MirrorBody:
    import drjit as dr

    radius = dr.opaque(mi.Float, MM_PER_M * radius_m)

    def meets(point: Any, way: Any) -> tuple[Any, Any, Any, Any]:
        approach = -dr.dot(point, way)
        foot = point + approach * way
        square = dr.square(radius) - dr.squared_norm(foot)
        near, met = approach - dr.sqrt(dr.maximum(square, 0.0)), (square > 0.0) & (approach > 0.0)
        return met, near, (point + near * way) / radius, met

    return MirrorBody(mi.Vector3f(0.0), radius, meets)


def _revolved_body(mi: ModuleType, view: View, mirror: RevolvedMirror) -> MirrorBody:
    import drjit as dr

    meeting, axes, profile = mirror_intersection(mi, view), view.T_world_sphere.R, mirror.profile
    r = np.linspace(0.0, profile.rim_radius_m, _BODY_PLACES)
    z, depth_m = profile.sag(r * r).z_m, profile.depth_m
    middle_m = min(depth_m, 0.5 * (profile.rim_radius_m**2 + depth_m**2) / depth_m)
    radius_m = _MARGIN * float(np.hypot(r, z - middle_m).max()) + mirror.reach_m
    axis = mi.Vector3d(*(dr.opaque(mi.Float64, float(a)) for a in axes[:, 2]))
    depth, rim2 = (
        dr.opaque(mi.Float64, value) for value in (MM_PER_M * depth_m, (MM_PER_M * profile.rim_radius_m) ** 2)
    )

    def meets(point: Any, way: Any) -> tuple[Any, Any, Any, Any]:
        o, d = mi.Vector3d(point), mi.Vector3d(way)
        place, normal, found = meeting(o, d)
        front = found & (dr.dot(normal, d) < 0.0)
        near = dr.select(front, dr.norm(place - o), dr.inf)
        fall = dr.dot(axis, d)
        down = (depth - dr.dot(axis, o)) / fall
        across = o + down * d - depth * axis
        back = (fall < 0.0) & (down > 0.0) & (dr.squared_norm(across) <= rim2) & (down < near)
        met = front | back
        distance = dr.select(back, down, dr.select(front, near, 0.0))
        return met, mi.Float(distance), mi.Vector3f(dr.select(back, axis, normal)), front & ~back

    centre = MM_PER_M * middle_m * axes[:, 2]
    return MirrorBody(
        mi.Vector3f(*(dr.opaque(mi.Float, float(c)) for c in centre)), dr.opaque(mi.Float, MM_PER_M * radius_m), meets
    )


# Reflectance.


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
