"""Rays from the camera, reflected once at the mirror: pixel -> mirror -> world, in float64.

This is the camera-side ray tracer. It shares no mathematics with the world-side answer (`alhazen`; `fermat` for a form
error), so that the two can certify each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.render.form_trace import meet
from phibench.scenes.frames import Array
from phibench.scenes.rig import View


@dataclass(frozen=True)
class MirrorRays:
    """Rays after the mirror, world frame; NaN where the mirror is missed.

    Attributes
    ----------
    points_m : array, shape (N, 3)
        Reflection points.
    normals : array, shape (N, 3)
        Outward unit normals there.
    directions : array, shape (N, 3)
        Unit directions of the reflected rays, away from the mirror.
    cos_incidence : array, shape (N,)
    path_camera_mirror_m : array, shape (N,)
    """

    points_m: Array
    normals: Array
    directions: Array
    cos_incidence: Array
    path_camera_mirror_m: Array


def lens_rays(view: View, uv_px: Array, lens_m: Array | None = None) -> tuple[Array, Array]:
    """Origins on the lens and unit directions, world frame, of the rays that belong to film positions.

    A film position (u, v) looks at one point of the plane of focus, through every point of the aperture.

    Parameters
    ----------
    uv_px : array, shape (N, 2)
    lens_m : array, shape (N, 2), or None
        Points on the aperture, metres from the lens centre, camera x and y; None is the lens centre.
    """
    camera, pose = view.rig.camera, view.T_world_camera
    xy = camera.normalised(uv_px)
    focus = camera.focus_distance_m * np.concatenate([xy, np.ones((len(xy), 1))], axis=-1)
    lens = np.zeros_like(focus)
    if lens_m is not None:
        lens[:, :2] = lens_m
    direction = focus - lens
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return pose.points(lens), pose.directions(direction)


def reflect(view: View, origins_m: Array, directions: Array) -> MirrorRays:
    """Intersect world rays, shape (N, 3), with the mirror and reflect them."""
    if view.rig.mirror.form is not None:
        return _reflect_at_form(view, origins_m, directions)
    radius = view.rig.mirror.radius_m
    offset = origins_m - view.sphere_centre_m
    approach = -_dot(offset, directions)
    miss = offset + approach[:, None] * directions  # nearest point to the centre: no cancellation
    with np.errstate(invalid="ignore"):
        root = np.sqrt(radius**2 - _dot(miss, miss))
        t = (_dot(offset, offset) - radius**2) / (approach + root)
        t = np.where(t > 0.0, t, np.nan)
    normals = (offset + t[:, None] * directions) / radius
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    cos_i = -_dot(normals, directions)
    out = directions + 2.0 * cos_i[:, None] * normals
    return MirrorRays(view.sphere_centre_m + radius * normals, normals, out, cos_i, t)


def _reflect_at_form(view: View, origins_m: Array, directions: Array) -> MirrorRays:
    axes, centre, mirror = view.T_world_sphere.R, view.sphere_centre_m, view.rig.mirror
    assert mirror.form is not None
    points, normals, t = meet((origins_m - centre) @ axes, directions @ axes, mirror.radius_m, mirror.form)
    behind = ~(t > 0.0)
    points, normals, t = (np.where(behind.reshape(-1, *[1] * (v.ndim - 1)), np.nan, v) for v in (points, normals, t))
    normals = normals @ axes.T
    cos_i = -_dot(normals, directions)
    return MirrorRays(points @ axes.T + centre, normals, directions + 2.0 * cos_i[:, None] * normals, cos_i, t)


def trace_pixels(view: View, uv_px: Array, lens_m: Array | None = None) -> MirrorRays:
    """Trace film positions, shape (N, 2), through the lens (its centre by default) to the mirror and away."""
    return reflect(view, *lens_rays(view, uv_px, lens_m))


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("ni,ni->n", a, b)
