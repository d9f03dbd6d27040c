"""Refraction of rays that leave a glass tube around mirror and lens, and its transmittance (Dr.Jit, float64).

They come from the mirror or from the lens; the closed forms are those of `scenes.glass_tube`. What the tube's faces
mirror back to the inside is left out.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

from phibench.render.room.camera_plugin import MM_PER_M
from phibench.render.room.surfaces import Surfaces
from phibench.scenes.rig import View


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

        The same as `room_tracer.rays_into_room`: what meets a face before the glass stays as it is.
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
