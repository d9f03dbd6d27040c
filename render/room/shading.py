"""Shading kernel (Dr.Jit): the camera's look into a room, directly or by the mirror.

The ray from the film to the mirror and its reflection are float64. A spherical mirror is met in closed form; it is
convex and stands in no table of faces, so that a reflected ray needs no lift. Only where something may stand between
lens and mirror, such as a holder, the way to the mirror is a query of its own.

Rays that meet a mirror with a form error are solved by Newton's method on q(t) = |P|^2 - r(P / |P|)^2 along the ray:
first to its least value, which tells hit from miss, then from the parabola's zero to that of q. `ray_tracer` answers
the same question from values alone, `reflection_point` from the other side; tests compare the three.

A glass tube around mirror and lens turns and lifts rays on their way out (`scenes.glass_tube`, float64 here as well),
whether they come from the mirror or from the lens. What its faces mirror back to the inside is left out.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from phibench.render.room.camera_plugin import MM_PER_M, sensor_dict
from phibench.render.room.surfaces import Surfaces
from phibench.scenes.frames import Array
from phibench.scenes.rig import View


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
        self._crossed = _crossed(surfaces)
        self._tube = None if self.view.tube is None else Tube(mi, self.view)
        self._radius = dr.opaque(mi.Float64, MM_PER_M * rig.mirror.radius_m)
        self._alpha = dr.opaque(mi.Float, rig.mirror.roughness_alpha)
        bands = [rig.mirror.refractive_index(nm) for nm in rig.camera.detector.band_wavelength_nm]
        self._index = [[dr.opaque(mi.Float, float(part)) for part in (one.real, one.imag)] for one in bands]

    def electrons(self, u: Any, v: Any, x: list[Any]) -> tuple[Any, Any]:
        """Electrons/s per square pixel at film positions (u, v), float64 pixels, and whether they see the mirror.

        `x` are uniform deviates: two for the lens point, and two for the facet of a rough mirror.
        """
        import drjit as dr

        mi = self._mi
        lens = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(x[0], x[1]))
        origin, direction, weight = self._sensor.film_ray(u, v, lens)
        point, normal, mirrored = self._meet(origin, direction)
        if self._crossed:
            approach = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
            approach.maxt = dr.select(mirrored, mi.Float(dr.norm(point - origin)), 0.0)
            mirrored &= ~self._surfaces.scene.ray_test(approach, coherent=True, active=mirrored)
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
        return weight * reflectance * radiance, mirrored

    def _meet(self, origin: Any, direction: Any) -> tuple[Any, Any, Any]:
        """Point of the mirror (mm), its outward normal, and whether there is one; float64."""
        import drjit as dr

        if self.view.rig.mirror.form is not None:
            return meet(self._mi, self.view, origin, direction)
        approach = -dr.dot(origin, direction)
        foot = origin + approach * direction  # nearest point to the centre: no cancellation
        square = dr.square(self._radius) - dr.squared_norm(foot)
        found = (square > 0.0) & (approach > 0.0)
        point = foot - dr.sqrt(dr.maximum(square, 0.0)) * direction
        return point, point / self._radius, found

    def _reflectance(self, cos: Any) -> Any:
        """Reflectance of the three bands."""
        mi = self._mi
        return mi.Color3f(*(mi.fresnel_conductor(cos, mi.Complex2f(n, k)) for n, k in self._index))


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


def _crossed(surfaces: Surfaces) -> bool:
    """True if a face may stand between the lens and the mirror: their common box meets a triangle's."""
    view = surfaces.view
    reach_mm = MM_PER_M * view.rig.mirror.bound_m
    lens = MM_PER_M * (view.camera_centre_m - view.sphere_centre_m)
    rim_mm = MM_PER_M * view.rig.camera.aperture_radius_m
    axis = view.T_world_camera.R[:, 2]
    tilted = rim_mm * np.sqrt(np.maximum(1.0 - axis**2, 0.0))  # half extents of the lens's disc
    low, high = np.minimum(lens - tilted, -reach_mm), np.maximum(lens + tilted, reach_mm)
    corners = surfaces.corners_mm
    return bool(np.all((corners.max(axis=1) > low) & (corners.min(axis=1) < high), axis=1).any())


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


# Mirror with a form error.

_LEAST_STEPS = 3
_STEPS = 5


def meet(mi: ModuleType, view: View, origin: Any, direction: Any) -> tuple[Any, Any, Any]:
    """First point of a mirror with a form error, its outward normal, and whether there is one.

    All are float64, in the scene's coordinates: mm, world axes, the sphere centre at the origin. The ray comes from
    outside.
    """
    import drjit as dr

    V, axes = mi.Vector3d, view.T_world_sphere.R
    form = view.rig.mirror.form
    assert form is not None
    tensors = [MM_PER_M * tensor for tensor in form.tensors]
    radius = dr.opaque(mi.Float64, MM_PER_M * view.rig.mirror.radius_m)
    o, d = (_turned(V, axes.T, vector) for vector in (origin, direction))
    d = dr.normalize(d)
    foot = o - dr.dot(o, d) * d
    foot2 = dr.dot(foot, foot)
    central = foot2 < 0.25 * radius * radius  # certainly hits, and q is no parabola near the sphere's centre
    x = mi.Float64(0.0)
    for _ in range(_LEAST_STEPS):  # q'' is 2 but for the form
        _, slope = _q(V, foot, foot2, d, x, radius, tensors)
        x = dr.select(central, 0.0, x - 0.5 * slope)
    q, _ = _q(V, foot, foot2, d, x, radius, tensors)
    q = dr.select(central, foot2 - radius * radius, q)
    found = q < 0.0
    x = x - dr.sqrt(dr.maximum(-q, 0.0))
    for _ in range(_STEPS):
        q, slope = _q(V, foot, foot2, d, x, radius, tensors)
        x = dr.select(found, x - q / slope, x)
    P = foot + x * d
    rho = dr.norm(P)
    n = P / rho
    _, gradient = _added(V, n, tensors)
    normal = dr.normalize(n - gradient / rho)
    return _turned(V, axes, P), _turned(V, axes, normal), found


def _q(V: Any, foot: Any, foot2: Any, d: Any, x: Any, radius: Any, tensors: list[Array]) -> tuple[Any, Any]:
    """q and its derivative by the distance x from the foot."""
    import drjit as dr

    rho2 = foot2 + x * x
    rho = dr.sqrt(rho2)
    added, gradient = _added(V, (foot + x * d) / rho, tensors)
    r = radius + added
    return rho2 - r * r, 2.0 * x - 2.0 * r * dr.dot(gradient, d) / rho


def _added(V: Any, n: Any, tensors: list[Array]) -> tuple[Any, Any]:
    """Deviation of the radius in a unit direction, and its derivative along the unit sphere."""
    import drjit as dr

    Q, T = tensors
    q = _turned(V, Q, n)
    t = V(*(dr.dot(n, _turned(V, T[i], n)) for i in range(3)))
    along_q, along_t = dr.dot(q, n), dr.dot(t, n)
    return along_q + along_t, 2.0 * q + 3.0 * t - (2.0 * along_q + 3.0 * along_t) * n


def _turned(V: Any, matrix: Array, vector: Any) -> Any:
    """Matrix times vector."""
    import drjit as dr

    number = type(vector.x)
    rows = [[dr.opaque(number, float(value)) for value in row] for row in matrix]  # one kernel for all forms
    return V(*(row[0] * vector.x + row[1] * vector.y + row[2] * vector.z for row in rows))
