"""World point -> pixel, by the estimator's own mathematics: `reflect` inverted by Newton's method.

A second answer beside the simulator's closed form. Frames, poses and pixels as in `phibench.scenes.frames`.
"""

from __future__ import annotations

import numpy as np

from phibench.estimator.reflection import reflect, reflect_jacobian
from phibench.scenes.frames import Array
from phibench.scenes.rig import View

_BISECTIONS = 60  # each divides the error by about 2 distance / radius, by less near the outline
_NEWTON_STEPS = 20
_CLOSE_RAD = 1e-12  # between ray and point: below 1e-9 px


def seen_pixel(view: View, points_world_m: Array) -> Array:
    """Pixels at which world points are seen in the mirror, through the lens centre; image borders are not asked.

    Parameters
    ----------
    view : View
    points_world_m : shape (..., 3)

    Returns
    -------
    array, shape (..., 2); NaN where no reflected ray meets the point
    """
    X = np.asarray(points_world_m, float)
    with np.errstate(all="ignore"):
        uv = view.rig.camera.project(view.T_world_camera.inverse().points(_start(view, X)))
        for _ in range(_NEWTON_STEPS):
            step = newton_step(view, X, uv)
            uv = uv - step
            if not np.any(np.abs(step) > 1e-11):
                break
        good = miss_rad(view, X, uv) < _CLOSE_RAD
    return np.where(good[..., None], uv, np.nan)


def newton_step(view: View, points_world_m: Array, uv_px: Array) -> Array:
    """By how much pixels, shape (..., 2), are off, to first order, from where points, shape (..., 3), are seen."""
    ray = reflect(view, uv_px)
    to_point = points_world_m - ray.origin_world_m
    across, slope = ray_basis(ray.direction_world), ray_slope(view, uv_px, points_world_m)
    return -np.linalg.solve(slope, np.einsum("...ki,...i->...k", across, to_point)[..., None])[..., 0]


def ray_slope(view: View, uv_px: Array, points_world_m: Array) -> Array:
    """Motion across the ray, at the point, per pixel: shape (..., 2, 2), metres per pixel, NaN where there is no ray.

    At a distance t along the ray r from the mirror point P, d(P + t r)/d(u, v) along the two directions of `ray_basis`.
    """
    ray, J = reflect(view, uv_px), reflect_jacobian(view, uv_px)
    along = np.sum((points_world_m - ray.origin_world_m) * ray.direction_world, axis=-1)[..., None, None]
    return ray_basis(ray.direction_world) @ (J.origin_m_per_px + along * J.direction_per_px)


def ray_basis(directions: Array) -> Array:
    """Two unit vectors across each unit direction (..., 3), as rows: shape (..., 2, 3)."""
    least = np.eye(3)[np.argmin(np.nan_to_num(np.abs(directions)), axis=-1)]
    first = np.cross(directions, least)
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=-2)


def miss_rad(view: View, points_world_m: Array, uv_px: Array) -> Array:
    """Angle, shape (...), between the reflected ray of a pixel and the direction from its mirror point to a point."""
    ray = reflect(view, uv_px)
    to_point = points_world_m - ray.origin_world_m
    across = np.linalg.norm(np.cross(ray.direction_world, to_point), axis=-1)
    return np.arctan2(across, np.sum(ray.direction_world * to_point, axis=-1))


def _start(view: View, X: Array) -> Array:
    """Mirror points whose normal bisects the directions to lens and point, by fixed-point iteration."""
    centre, radius = view.sphere_centre_m, view.rig.mirror.radius_m
    P = np.broadcast_to(centre, X.shape)
    for _ in range(_BISECTIONS):
        normal = _unit(view.camera_centre_m - P) + _unit(X - P)
        P = centre + radius * _unit(normal)
    return P


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
