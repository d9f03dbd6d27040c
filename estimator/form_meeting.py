"""Where a ray meets a mirror with a form error, by Newton's method on the level function of `scenes.form`.

Estimators believe in a perfect sphere; this is for the true rig, whose errors `sensitivities` predicts.
"""

from __future__ import annotations

import numpy as np

from phibench.scenes.form import Form, Level, level
from phibench.scenes.frames import Array

_NEAREST_STEPS = 4  # Newton's, from the foot of the perpendicular: the form's slope, 1e-3, falls to its square in each
_STEPS = 12
_CLOSE_M = 1e-12  # the step after such a one is below rounding


def first_meeting(origin_m: Array, directions: Array, radius_m: float, form: Form) -> Array:
    """Distance to the mirror along unit directions (..., 3) from one point (3,), shape (...), sphere's frame.

    NaN where the mirror is missed. The first place is looked for before that where g is least, which tells hit from
    miss: a sphere of the radius that the mirror has there gives the start.
    """
    foot = -np.sum(origin_m * directions, axis=-1)
    off_centre = np.linalg.norm(origin_m + foot[..., None] * directions, axis=-1)
    central = off_centre < 0.5 * radius_m  # such a ray hits, and near the centre g has no use for Newton's method
    with np.errstate(invalid="ignore", divide="ignore"):
        t = foot
        for _ in range(_NEAREST_STEPS):
            _, slope, curvature = _along(origin_m, directions, t, radius_m, form)
            t = np.where(central, foot, t - slope / curvature)
        g, _, _ = _along(origin_m, directions, t, radius_m, form)
        rho = np.linalg.norm(origin_m + t[..., None] * directions, axis=-1)
        t = t - np.sqrt(np.where(central, radius_m**2 - off_centre**2, -g * (2.0 * rho - g)))  # (rho - g)^2 - rho^2
        for _ in range(_STEPS):
            g, slope, _ = _along(origin_m, directions, t, radius_m, form)
            step = g / slope
            t = t - step
            if not np.any(np.abs(step) > _CLOSE_M):
                break
    return t


def unit_normal(surface: Level) -> Array:
    """Outward unit normals, shape (..., 3)."""
    return np.asarray(surface.gradient / np.linalg.norm(surface.gradient, axis=-1, keepdims=True))


def normal_slope(surface: Level) -> Array:
    """Derivative of the unit normal by the place, shape (..., 3, 3), 1/m: (I - n n^T) Hess g / |grad g|."""
    n = unit_normal(surface)
    length = np.linalg.norm(surface.gradient, axis=-1)[..., None, None]
    return np.asarray((np.eye(3) - n[..., :, None] * n[..., None, :]) @ surface.hessian_per_m / length)


def _along(origin_m: Array, directions: Array, t: Array, radius_m: float, form: Form) -> tuple[Array, Array, Array]:
    """g and its first two derivatives along the ray, shape (...)."""
    at = level(origin_m + t[..., None] * directions, radius_m, form)
    slope = np.sum(at.gradient * directions, axis=-1)
    curvature = np.einsum("...i,...ij,...j->...", directions, at.hessian_per_m, directions)
    return at.value_m, slope, curvature
