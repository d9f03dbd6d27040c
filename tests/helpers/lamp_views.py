"""A lamp alone in the dark, seen in the mirror: as an ambient layer, and by float64 rays."""

from __future__ import annotations

import math

import numpy as np

from phibench.render.optics.ray_tracer import trace_pixels
from phibench.render.optics.reflection_point import mirror_points
from phibench.render.optics.room_tracer import first_hit
from phibench.scenes.camera import Camera
from phibench.scenes.rig import View
from phibench.scenes.room import Room
from phibench.scenes.shapes import Uniform, rectangle

LAMP = rectangle(
    *("lamp", (1.5, 0.2, 0.7), (-1, 0, 0), (0.4, 0.4)),
    texture=Uniform((0.0, 0.0, 0.0)),
    radiance_w_m2_sr=(1.0, 2.0, 3.0),
)
_MARGIN_PX = 12
LAMP_ROOM = Room("a lamp", (LAMP,), (), robot=False)


def moments(image: np.ndarray) -> tuple[float, float, float]:
    """Sum and centroid (u, v)."""
    v, u = np.indices(image.shape)
    total = float(image.sum(dtype=float))
    return total, float((image * u).sum() / total), float((image * v).sum() / total)


def lamp_window(view: View) -> tuple[int, int, int, int]:
    """Window around the lamp's image in the mirror: left, top, width and height."""
    steps = np.linspace(-0.5, 0.5, 9)
    flat = np.stack(np.meshgrid(steps * LAMP.size_m[0], steps * LAMP.size_m[1], 0.0), axis=-1).reshape(-1, 3)
    points = LAMP.T_world_shape.points(flat)
    found = mirror_points(view, points, np.broadcast_to(view.camera_centre_m, points.shape))
    uv = view.rig.camera.project(view.T_world_camera.inverse().points(found.points_m[found.lit]))
    low = np.floor(uv.min(axis=0)).astype(int) - _MARGIN_PX
    width, height = np.ceil(uv.max(axis=0)).astype(int) + _MARGIN_PX + 1 - low
    return int(low[0]), int(low[1]), int(width), int(height)


def lamp_image(view: View, room: Room, crop: tuple[int, int, int, int], seed: int = 0) -> np.ndarray:
    """Ambient layer, plane R, of a room with nothing in it but a lamp: its light map is dark."""
    from phibench.render.room.ambient_layer import render_ambient
    from phibench.render.room.light_map import BakeSettings, LightMap, texel_count

    settings = BakeSettings(lamp_rays=4, bounce_rays=4, final_rays=4)
    texels = texel_count(room, settings.texel_m)
    dark = np.zeros((texels, 3), dtype=np.float32)
    light = LightMap(dark, dark, np.zeros(texels, dtype=bool))
    return render_ambient(view, room, light, settings, 4, seed, crop).electrons_per_s[0]


def traced_lamp(view: View, crop: tuple[int, int, int, int], side: int = 5) -> np.ndarray:
    """Image of the lamp, electrons/s per pixel behind R, without blur, by `trace` and `raycast`.

    Rays go all over the lens: through its centre alone the centroid would be 0.02 px off, of a sphere's image as well.
    """
    u0, v0, width, height = crop
    cell, rng = np.mgrid[0:side, 0:side].reshape(2, -1).T, np.random.default_rng(0)
    place = (cell + rng.random((width * height, side * side, 2))) / side - 0.5  # one ray in each cell of a pixel
    v, u = np.mgrid[v0 : v0 + height, u0 : u0 + width]
    uv = (np.stack([u.ravel(), v.ravel()], axis=-1)[:, None] + place).reshape(-1, 2)
    radius, turn = np.sqrt(rng.random(len(uv))), 2.0 * np.pi * rng.random(len(uv))
    lens = view.rig.camera.aperture_radius_m * radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    rays = trace_pixels(view, uv, lens)
    seen = np.isfinite(rays.cos_incidence)
    lit = np.zeros(len(uv))
    lit[seen] = first_hit((LAMP,), rays.points_m[seen], rays.directions[seen]).object_id == 0
    reflectance = view.rig.mirror.reflectance(rays.cos_incidence, view.rig.camera.detector.band_wavelength_nm[0])
    value = np.nan_to_num(lit * electrons(view.rig.camera, uv) * reflectance)
    return value.reshape(height, width, side * side).mean(axis=-1)


def electrons(camera: Camera, uv: np.ndarray) -> np.ndarray:
    """Electrons/s per pixel behind R for a radiance of 1 W/(m^2 sr) at film positions (N, 2)."""
    cos_lens = camera.rays(uv)[:, 2]
    etendue = camera.solid_angle_density(camera.normalised(uv)) * cos_lens**4 * math.pi * camera.aperture_radius_m**2
    return camera.detector.band_electrons_per_joule()[0] * etendue
