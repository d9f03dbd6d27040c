"""How the reflected ray of a pixel moves at a point of the world when the pixel moves."""

from __future__ import annotations

import numpy as np

from phibench.estimator.reflection import reflect, reflect_jacobian
from phibench.scenes.frames import Array
from phibench.scenes.rig import View


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
