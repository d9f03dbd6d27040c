"""Shading kernel (Dr.Jit): electrons that film positions get from a room, directly or over a smooth or rough mirror.

The ray from the film to the mirror and its reflection are float64 (`mirror_intersection`). The mirror is convex and
stands in no table of faces, so that a reflected ray needs no lift. Only where something may stand between lens and
mirror, such as a holder, the way to the mirror is a query of its own.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

from phibench.render.room.camera_plugin import camera_plugin_dict
from phibench.render.room.glass_refraction import Tube
from phibench.render.room.mirror_intersection import mirror_bands, mirror_intersection
from phibench.render.room.surfaces import Surfaces


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
        self._sensor = mi.load_dict(camera_plugin_dict(mi, self.view))
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
