"""One look of the camera into a room of patches: film position and lens point -> electrons, inside a Dr.Jit kernel."""

from __future__ import annotations

from types import ModuleType
from typing import Any

from phibench.render.surfaces import Surfaces

_LIFT_MM = 0.01


def look(mi: ModuleType, surfaces: Surfaces, u: Any, v: Any, x: list[Any]) -> tuple[Any, Any]:
    """Electrons/s per square pixel at film positions (u, v), float64 pixels, and whether they see the mirror.

    `x` are uniform deviates: two for the lens point, and two for the facet of a rough mirror.
    """
    import drjit as dr

    sensor = surfaces.scene.sensors()[0]
    lens = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(x[0], x[1]))
    ray, weight = sensor.film_ray(u, v, lens)
    first = surfaces.scene.ray_intersect_preliminary(ray, coherent=True)
    first_patch = surfaces.patch_ids(_pointer(mi, first), first.is_valid())
    mirrored = first.is_valid() & (first_patch == surfaces.mirror_id)
    point = ray(first.t)
    way, reflectance, lift = _reflect(mi, surfaces, ray.d, point, x[2:])
    onward = mi.Ray3f(dr.select(mirrored, point + lift, ray.o), dr.select(mirrored, way, ray.d))
    second = surfaces.scene.ray_intersect_preliminary(onward, coherent=False, active=mirrored)
    second_patch = surfaces.patch_ids(_pointer(mi, second), mirrored & second.is_valid())
    patch = dr.select(mirrored, second_patch, first_patch)
    hit = dr.select(mirrored, second.is_valid(), first.is_valid())
    place = onward(dr.select(mirrored, second.t, first.t))
    radiance = surfaces.radiance(patch, place, onward.d, hit, lamps=True)
    return weight * dr.select(mirrored, reflectance, 1.0) * radiance, mirrored


def _reflect(mi: ModuleType, surfaces: Surfaces, direction: Any, point: Any, x: list[Any]) -> tuple[Any, Any, Any]:
    """Mirror direction, reflectance of the three bands, and a short way off the surface, at points of the sphere."""
    import drjit as dr

    rig = surfaces.view.rig
    normal = dr.normalize(mi.Vector3f(point))  # the sphere's centre is the origin
    facet, shadowing = (normal, 1.0) if not x else _facet(mi, rig.mirror.roughness_alpha, normal, direction, x)
    cos = -dr.dot(direction, facet)
    way = direction + 2.0 * cos * facet
    bands = [rig.mirror.refractive_index(nm) for nm in rig.camera.detector.band_wavelength_nm]
    fresnel = [mi.fresnel_conductor(cos, mi.Complex2f(index.real, index.imag)) for index in bands]
    return way, shadowing * mi.Color3f(*fresnel), _LIFT_MM * normal


def _facet(mi: ModuleType, alpha: float, normal: Any, direction: Any, x: list[Any]) -> tuple[Any, Any]:
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


def _pointer(mi: ModuleType, hit: Any) -> Any:
    import drjit as dr

    return dr.reinterpret_array(mi.UInt32, hit.shape)
