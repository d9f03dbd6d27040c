"""The ambient layer: the room seen directly and through the mirror, from its light map; no laser.

Camera -> (mirror) -> surface: radiance is albedo x irradiance / pi, plus what a lamp emits. Pixels are integrated over
area, optical blur and aperture with quasi-random points; nothing else is random here, and the light map's noise is the
same in every view.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.render.bake import BakeSettings, LightMap, fixed_shapes, light_carriage
from phibench.render.patches import cut, texel_count
from phibench.render.quasi import points, shifts
from phibench.render.surfaces import Surfaces
from phibench.render.variant import activate
from phibench.scenes.camera import Camera
from phibench.scenes.rig import View
from phibench.scenes.room import Room

_LIFT_MM = 0.01
Crop = tuple[int, int, int, int]


@dataclass(frozen=True)
class AmbientLayer:
    """Ambient light of one view.

    Attributes
    ----------
    electrons_per_s : array, shape (3, height, width), float32
        Expected photo-electrons per second per pixel, planes R, G, B.
    variance_per_s2 : array, shape (3, height, width), float32
        Variance of that estimate by sampling a pixel (quasi-random points do better than this estimate says).
    """

    electrons_per_s: NDArray[np.float32]
    variance_per_s2: NDArray[np.float32]


def dark_layer(camera: Camera) -> AmbientLayer:
    """Ambient layer of a room without light."""
    zeros = np.zeros((3, camera.height_px, camera.width_px), dtype=np.float32)
    return AmbientLayer(zeros, zeros)


def render_ambient(
    view: View,
    room: Room,
    light: LightMap,
    settings: BakeSettings,
    samples_per_pixel: int,
    seed: int,
    crop: Crop | None = None,
) -> AmbientLayer:
    """Render one view from a room's light map.

    Parameters
    ----------
    light, settings
        Of `bake.bake` for this room.
    samples_per_pixel : int, at least 2
    seed : int
        Of the named stream for this view; 0 is legal.
    crop : (u0, v0, width, height), or None
        Image window, pixels; None is the whole image.
    """
    mi = activate()
    import drjit as dr

    camera = view.rig.camera
    window = crop or (0, 0, camera.width_px, camera.height_px)
    shapes = room.shapes(view)
    surfaces = Surfaces(mi, view, cut(shapes, settings.texel_m), camera=True)
    fixed = texel_count(cut(fixed_shapes(room), settings.texel_m))
    light_carriage(surfaces, shapes, fixed, light.irradiance_w_m2, settings)
    mean, variance = _render(mi, surfaces, window, samples_per_pixel, seed)
    layer = AmbientLayer(_planes(mean, window), _planes(variance, window))
    dr.flush_kernel_cache()  # every view is compiled anew, and Dr.Jit would keep them all
    return layer


def _render(mi: ModuleType, surfaces: Surfaces, window: Crop, samples: int, seed: int) -> tuple[Any, Any]:
    """Mean and its variance per pixel, as Dr.Jit colours (Welford's recurrence: no cancellation in float32)."""
    import drjit as dr

    u0, v0, width, height = window
    lanes = dr.arange(mi.UInt32, width * height)
    u, v = mi.Float64(lanes % width) + float(u0), mi.Float64(lanes // width) + float(v0)
    shift = shifts(mi, lanes, 6, seed)

    def body(i: Any, mean: Any, square: Any) -> tuple[Any, Any, Any]:
        value = _sample(mi, surfaces, u, v, points(mi, shift, i))
        new = mean + (value - mean) / mi.Float(i + 1)
        return i + 1, new, square + (value - mean) * (value - new)

    start = (mi.UInt32(0), dr.zeros(mi.Color3f, len(lanes)), dr.zeros(mi.Color3f, len(lanes)))
    _, mean, square = dr.while_loop(start, lambda i, *_: i < samples, body)
    return mean, square / float(samples * (samples - 1))


def _sample(mi: ModuleType, surfaces: Surfaces, u: Any, v: Any, x: list[Any]) -> Any:
    """One sample of the pixels: area x[0:2], blur x[2:4], aperture x[4:6]."""
    import drjit as dr

    sensor = surfaces.scene.sensors()[0]
    blur = mi.warp.square_to_std_normal(mi.Point2f(x[2], x[3]))
    sigma = sensor.number["blur_sigma_px"]
    at_u = u + mi.Float64(x[0] - 0.5) + sigma * mi.Float64(blur.x)
    at_v = v + mi.Float64(x[1] - 0.5) + sigma * mi.Float64(blur.y)
    lens = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(x[4], x[5]))
    ray, weight = sensor.film_ray(at_u, at_v, lens)
    first = surfaces.scene.ray_intersect_preliminary(ray, coherent=True)
    first_patch = surfaces.patch_ids(_pointer(mi, first), first.is_valid())
    mirrored = first.is_valid() & (first_patch == surfaces.mirror_id)
    point = ray(first.t)
    way, reflectance, lift = _reflect(mi, surfaces, ray.d, point)
    onward = mi.Ray3f(dr.select(mirrored, point + lift, ray.o), dr.select(mirrored, way, ray.d))
    second = surfaces.scene.ray_intersect_preliminary(onward, coherent=False, active=mirrored)
    second_patch = surfaces.patch_ids(_pointer(mi, second), mirrored & second.is_valid())
    patch = dr.select(mirrored, second_patch, first_patch)
    hit = dr.select(mirrored, second.is_valid(), first.is_valid())
    place = onward(dr.select(mirrored, second.t, first.t))
    radiance = surfaces.radiance(patch, place, onward.d, hit, lamps=True)
    return weight * dr.select(mirrored, reflectance, 1.0) * radiance


def _reflect(mi: ModuleType, surfaces: Surfaces, direction: Any, point: Any) -> tuple[Any, Any, Any]:
    """Mirror direction, reflectance of the three bands, and a short way off the surface, at points of the sphere."""
    import drjit as dr

    rig = surfaces.view.rig
    normal = dr.normalize(mi.Vector3f(point))  # the sphere's centre is the origin
    cos = -dr.dot(direction, normal)
    bands = [rig.mirror.refractive_index(nm) for nm in rig.camera.detector.band_wavelength_nm]
    fresnel = [mi.fresnel_conductor(cos, mi.Complex2f(index.real, index.imag)) for index in bands]
    return direction + 2.0 * cos * normal, mi.Color3f(*fresnel), _LIFT_MM * normal


def _pointer(mi: ModuleType, hit: Any) -> Any:
    import drjit as dr

    return dr.reinterpret_array(mi.UInt32, hit.shape)


def _planes(colour: Any, window: Crop) -> NDArray[np.float32]:
    _, _, width, height = window
    return np.stack([np.array(colour[k], dtype=np.float32).reshape(height, width) for k in range(3)])
