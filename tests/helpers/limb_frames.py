"""A sphere's limb in a made-up room, by plain ray casting: images for the tests of the outline. Not a test file.

Other mathematics than the estimator's and no Mitsuba: rays through 3 x 3 points of every pixel near the outline are
reflected in space and meet a ceiling with lamps and a slow pattern, or a wall; lens and pixel blur are the grid's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from phibench.datasets.recipe.recipe_scene import build_rig
from phibench.datasets.recipe.tables import RigTable
from phibench.render.optics.ray_tracer import trace_pixels
from phibench.scenes.frames import Pose, as_matrix, as_vector, rotation_xyz
from phibench.scenes.mirror import SphereMirror
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig

FINE = 3
REACH_PX = 12.0
BOX_PX = 24


def drawn_rig(rng: np.random.Generator, blur_px: tuple[float, float] = (0.5, 1.0)) -> Rig:
    """Centre 1 mm, tilt 0.5 deg, z_c 2 mm, f 0.3 %, principal point 5 px (standard deviations), blur uniform."""
    n, rig = rng.standard_normal, Rig()
    z, f = 0.262 + 0.002 * n(), 1430.0 * (1.0 + 0.003 * n())
    camera = replace(
        rig.camera,
        fx_px=f,
        fy_px=f,
        cx_px=639.5 + 5.0 * n(),
        cy_px=359.5 + 5.0 * n(),
        blur_sigma_px=rng.uniform(*blur_px),
        focus_distance_m=z - 0.03,
    )
    R = np.array(rotation_xyz(*(np.radians(0.5) * rng.standard_normal(2)), rng.uniform(0.0, 2.0 * np.pi)))
    sphere = R.T @ np.array([1e-3 * n(), 1e-3 * n(), z])
    pose = Pose("world", "camera", (0.0, 0.0, 0.45), as_matrix(R))
    return replace(rig, camera=camera, T_world_camera=pose, T_camera_sphere=Pose("camera", "sphere", as_vector(sphere)))


def drawn_revolved(rng: np.random.Generator, shape: str, **mirror: object) -> Rig:
    """A mirror of revolution with the same deviations, and a tilt of its own of 0.5 deg."""
    n, f = rng.standard_normal, 1430.0 * (1.0 + 0.003 * rng.standard_normal())
    table = {"mirror": {"shape": shape, **mirror}, "fx_px": f, "fy_px": f, "blur_sigma_px": rng.uniform(0.5, 1.0)}
    size, tilt = 1e-3, np.radians(0.5)
    return build_rig(RigTable.model_validate(table)).perturbed(
        Misalignment(
            decentre_x_m=size * n(),
            decentre_y_m=size * n(),
            axial_m=2.0 * size * n(),
            tilt_x_rad=tilt * n(),
            tilt_y_rad=tilt * n(),
            mirror_tilt_x_rad=tilt * n(),
            mirror_tilt_y_rad=tilt * n(),
            cx_px=5.0 * n(),
            cy_px=5.0 * n(),
        )
    )


TINT = (1.0, 0.85, 0.45)


def limb_light(rig: Rig, rng: np.random.Generator, mean_e_per_s: float = 1.5e5, room=None, tint=TINT) -> np.ndarray:
    """Expected electrons per second, shape (3, H, W); away from the outline the room's mean level.

    `room` is a function (points, directions) -> radiance; by default it is drawn from `rng`.
    """
    camera, size = rig.camera, (rig.camera.height_px, rig.camera.width_px)
    radiance = room or _room(rng)
    outline = rig.outline_px(4000)
    mask = np.zeros(size, bool)
    cells = np.rint(outline).astype(int)
    cells = cells[np.all((cells >= 0) & (cells < [size[1], size[0]]), axis=-1)]
    mask[cells[:, 1], cells[:, 0]] = True
    ring = ndimage.distance_transform_edt(~mask) < REACH_PX
    v, u = np.nonzero(np.kron(ring, np.ones((FINE, FINE), bool)))
    uv = (np.stack([u, v], axis=-1) + 0.5) / FINE - 0.5
    d = camera.rays(uv)
    hit, start, out, cosine = (_at_sphere if isinstance(rig.mirror, SphereMirror) else _at_profile)(rig, uv, d)
    light = radiance(start @ rig.T_world_camera.R.T + rig.T_world_camera.t, out @ rig.T_world_camera.R.T)
    rows, columns = np.indices(size)
    chief = camera.rays(np.stack([columns, rows], axis=-1).astype(float))
    fall_off = chief[..., 2] ** 4
    inside = _is_inside(outline, size)  # the mirror's disc, roughly as bright as steel makes it
    level = np.where(inside, 0.67, 1.0).astype(np.float32)
    # only the box around the ring is drawn on the fine grid
    low, high = cells.min(axis=0) - BOX_PX, cells.max(axis=0) + BOX_PX
    low, high = np.clip(low, 0, None), np.clip(high, 0, [size[1], size[0]])
    box = (slice(low[1], high[1]), slice(low[0], high[0]))
    start_fine = np.kron(level[box], np.ones((FINE, FINE), np.float32))
    planes = []
    for nm, share in zip(camera.detector.band_wavelength_nm, tint, strict=True):
        fine = start_fine.copy()
        steel = rig.mirror.reflectance(np.where(hit, cosine, 1.0), nm)
        fine[v - FINE * low[1], u - FINE * low[0]] = light * np.where(hit, steel, 1.0)
        fine = ndimage.gaussian_filter(fine, FINE * camera.blur_sigma_px, mode="nearest", truncate=5.0)
        plane = level.copy()
        plane[box] = fine.reshape(high[1] - low[1], FINE, high[0] - low[0], FINE).mean(axis=(1, 3))
        planes.append(share * mean_e_per_s * fall_off * plane)
    return np.array(planes, np.float32)


def _at_sphere(rig: Rig, uv: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, ...]:
    """Hit, start, direction and cosine of incidence of what pixels see by way of the sphere, camera frame."""
    s, R = rig.sphere_in_camera_m, rig.sphere.radius_m
    along = d @ s
    gap2 = s @ s - along**2 - R * R  # squared distance of the ray from the sphere centre, less R^2
    hit = gap2 < 0.0
    t = along - np.sqrt(np.where(hit, -gap2, 0.0))
    P = t[:, None] * d
    normal = (P - s) / R
    cosine = -np.sum(d * normal, axis=-1)
    out = np.where(hit[:, None], d + 2.0 * cosine[:, None] * normal, d)
    return hit, np.where(hit[:, None], P, 0.0), out, cosine


def _at_profile(rig: Rig, uv: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, ...]:
    """The same of a mirror of revolution, by the simulator's rays."""
    found, pose = trace_pixels(rig.at(0.0), uv), rig.T_world_camera.inverse()
    hit = np.isfinite(found.cos_incidence)
    start = np.where(hit[:, None], pose.points(np.nan_to_num(found.points_m)), 0.0)
    out = np.where(hit[:, None], pose.directions(np.nan_to_num(found.directions)), d)
    return hit, start, out, np.where(hit, found.cos_incidence, 1.0)


def _is_inside(outline: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Pixels inside a closed curve that is nearly a circle, shape `size`."""
    middle = outline.mean(axis=0)
    turn = np.arctan2(*(outline - middle).T[::-1])
    order = np.argsort(turn)
    v, u = np.indices(size)
    there = np.interp(
        np.arctan2(v - middle[1], u - middle[0]),
        turn[order],
        np.hypot(*(outline - middle).T)[order],
        period=2.0 * np.pi,
    )
    return np.hypot(u - middle[0], v - middle[1]) < there


def drawn_tint(rng: np.random.Generator) -> tuple[float, float, float]:
    """Colour of a room: from candle light to a cloudy day."""
    return (1.0, rng.uniform(0.7, 1.1), rng.uniform(0.3, 1.0))


def drawn_room(rng: np.random.Generator):
    """Radiance at (points, directions) of a ceiling, 2.3 to 4 m high, with a pattern and up to 8 lamps, and walls."""
    phase, wave, depth = rng.uniform(0.0, 2.0 * np.pi, 4), rng.uniform(0.3, 2.5, 4), rng.uniform(0.0, 0.08, 2)
    count, height, wall = rng.integers(0, 9), rng.uniform(2.3, 4.0), rng.uniform(0.4, 0.9)
    lamps = rng.uniform(-3.0, 3.0, (count, 2))
    half, level = rng.uniform(0.1, 0.7, (count, 2)), rng.uniform(1.3, 6.0, count)

    def radiance(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        up = directions[:, 2]
        with np.errstate(all="ignore"):
            t = np.where(up > 0.05, (height - points[:, 2]) / up, np.nan)
        x, y = (points[:, i] + t * directions[:, i] for i in (0, 1))
        light = 1.0 + depth[0] * np.sin(wave[0] * x + phase[0]) + depth[1] * np.sin(wave[1] * y + phase[1])
        for (a, b), (p, q), bright in zip(lamps, half, level, strict=True):
            light = np.where((np.abs(x - a) < p) & (np.abs(y - b) < q), bright, light)
        return np.where(np.isfinite(t), light, wall)

    return radiance


def _room(rng: np.random.Generator):
    """Radiance at (points, directions): a ceiling at 3 m with a slow pattern and some lamps, and walls."""
    phase, wave = rng.uniform(0.0, 2.0 * np.pi, 4), rng.uniform(0.5, 2.0, 4)
    lamps = rng.uniform(-3.0, 3.0, (5, 2))

    def radiance(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        up = directions[:, 2]
        with np.errstate(all="ignore"):
            t = np.where(up > 0.05, (3.0 - points[:, 2]) / up, np.nan)
        x, y = (points[:, i] + t * directions[:, i] for i in (0, 1))
        slow = 1.0 + 0.05 * np.sin(wave[0] * x + phase[0]) + 0.05 * np.sin(wave[1] * y + phase[1])
        for a, b in lamps:
            slow = np.where((np.abs(x - a) < 0.6) & (np.abs(y - b) < 0.15), 4.0, slow)
        return np.where(np.isfinite(t), slow, 0.7)

    return radiance
