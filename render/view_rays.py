"""One look of the camera into a room of patches: film position and lens point -> electrons, inside a Dr.Jit kernel."""

from __future__ import annotations

from types import ModuleType
from typing import Any

from phibench.render.c310_plugin import MM_PER_M
from phibench.render.form_kernel import meet
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
    turned = first.is_valid() & (first_patch == surfaces.mirror_id)
    at_mirror = _meet_sphere if surfaces.view.rig.mirror.form is None else _meet_form
    mirrored, start, way, reflectance = at_mirror(mi, surfaces, ray, first.t, turned, x[2:])
    onward = mi.Ray3f(dr.select(turned, start, ray.o), dr.select(turned, way, ray.d))
    second = surfaces.scene.ray_intersect_preliminary(onward, coherent=False, active=turned)
    second_patch = surfaces.patch_ids(_pointer(mi, second), turned & second.is_valid())
    patch = dr.select(turned, second_patch, first_patch)
    hit = dr.select(turned, second.is_valid(), first.is_valid())
    place = onward(dr.select(turned, second.t, first.t))
    radiance = surfaces.radiance(patch, place, onward.d, hit, lamps=True)
    return weight * dr.select(mirrored, reflectance, 1.0) * radiance, mirrored


def _meet_sphere(mi: ModuleType, surfaces: Surfaces, ray: Any, t: Any, turned: Any, x: list[Any]) -> tuple[Any, ...]:
    """Whether rays see the mirror, where and whereto they go on, and what the mirror leaves of their light.

    `t` is the distance to the scene's sphere for those rays that are `turned` there.
    """
    import drjit as dr

    point = ray(t)
    normal = dr.normalize(mi.Vector3f(point))  # the sphere's centre is the origin
    way, reflectance = _reflect(mi, surfaces, ray.d, normal, x)
    return turned, point + _LIFT_MM * normal, way, reflectance


def _meet_form(mi: ModuleType, surfaces: Surfaces, ray: Any, t: Any, turned: Any, x: list[Any]) -> tuple[Any, ...]:
    """As `_meet_sphere`, where the scene's sphere is only what encloses a mirror with a form error.

    A ray that misses the mirror goes straight on; all go on from where they leave the enclosing sphere.
    """
    import drjit as dr

    point, normal, found = meet(mi, surfaces.view, ray)
    mirrored = turned & found
    reflected, reflectance = _reflect(mi, surfaces, ray.d, normal, x)
    way = dr.select(mirrored, reflected, ray.d)
    start = dr.select(mirrored, point, ray(t))
    b = dr.dot(start, way)
    reach = MM_PER_M * surfaces.view.rig.mirror.bound_m + _LIFT_MM
    out = dr.sqrt(dr.maximum(b * b + reach * reach - dr.dot(start, start), 0.0)) - b
    return mirrored, start + out * way, way, reflectance


def _reflect(mi: ModuleType, surfaces: Surfaces, direction: Any, normal: Any, x: list[Any]) -> tuple[Any, Any]:
    """Mirror direction and reflectance of the three bands where the mirror has a normal."""
    import drjit as dr

    rig = surfaces.view.rig
    facet, shadowing = (normal, 1.0) if not x else _facet(mi, rig.mirror.roughness_alpha, normal, direction, x)
    cos = -dr.dot(direction, facet)
    way = direction + 2.0 * cos * facet
    bands = [rig.mirror.refractive_index(nm) for nm in rig.camera.detector.band_wavelength_nm]
    fresnel = [mi.fresnel_conductor(cos, mi.Complex2f(index.real, index.imag)) for index in bands]
    return way, shadowing * mi.Color3f(*fresnel)


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
