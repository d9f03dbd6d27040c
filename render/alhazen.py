"""Alhazen's problem: the point of a sphere that reflects one given point to another.

In the plane of the two points and the sphere centre one angle gamma is unknown. With c and p the distances of the two
points from the centre and beta the angle between them, the path length is stationary where

    f(gamma) = c sin(gamma) / l_c - p sin(beta - gamma) / l_p = 0,

l_c and l_p being the two path lengths. Both points see the mirror point for gamma between beta - acos(R / p) and
acos(R / c); there f rises from a value <= 0 to a value >= 0, so the root is single and Newton's method inside the
shrinking bracket cannot fail. An empty interval means that there is no reflection.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phibench.scenes.frames import Array

_STEPS = 60  # bisection alone would need 53; Newton takes 4 to 7


def reflection_points(points_m: Array, eyes_m: Array, radius_m: float) -> tuple[Array, NDArray[np.bool_]]:
    """Reflection points on the convex side of a sphere at the origin.

    Parameters
    ----------
    points_m, eyes_m : arrays, shape (N, 3)
        The two points, metres, relative to the sphere centre.
    radius_m : float

    Returns
    -------
    reflection_m : array, shape (N, 3); NaN where there is none
    valid : bool array, shape (N,)
        Both points lie on the outer side of the tangent plane at the reflection point.
    """
    p, c = (np.linalg.norm(v, axis=-1) for v in (points_m, eyes_m))
    e1 = eyes_m / c[:, None]
    across = points_m - np.einsum("ni,ni->n", points_m, e1)[:, None] * e1
    width = np.linalg.norm(across, axis=-1)
    beta = np.arctan2(width, np.einsum("ni,ni->n", points_m, e1))
    with np.errstate(invalid="ignore", divide="ignore"):
        e2 = np.where(width[:, None] > 0.0, across / width[:, None], 0.0)
        low = np.maximum(0.0, beta - np.arccos(radius_m / p))
        high = np.minimum(beta, np.arccos(radius_m / c))
        lit = low <= high
        gamma = _solve(p, c, beta, np.where(lit, low, np.nan), np.where(lit, high, np.nan), radius_m)
    found = radius_m * (np.cos(gamma)[:, None] * e1 + np.sin(gamma)[:, None] * e2)
    return np.where(lit[:, None], found, np.nan), lit


def _solve(p: Array, c: Array, beta: Array, low: Array, high: Array, radius: float) -> Array:
    """Root gamma of f in [low, high], shape (N,): Newton, bisection where a step would leave the bracket."""
    gamma = 0.5 * (low + high)
    for _ in range(_STEPS):
        f, slope = _stationarity(p, c, beta, gamma, radius)
        low, high = np.where(f < 0.0, gamma, low), np.where(f > 0.0, gamma, high)
        step = gamma - f / slope
        new = np.where((step >= low) & (step <= high), step, 0.5 * (low + high))
        moving = np.abs(new - gamma) > 4e-16 * beta
        gamma = new
        if not moving.any():
            break
    return gamma


def _stationarity(p: Array, c: Array, beta: Array, gamma: Array, radius: float) -> tuple[Array, Array]:
    """f(gamma) and its derivative."""
    f_c, slope_c = _tangential(c, gamma, radius)
    f_p, slope_p = _tangential(p, beta - gamma, radius)
    return f_c - f_p, slope_c + slope_p


def _tangential(distance: Array, angle: Array, radius: float) -> tuple[Array, Array]:
    """d sin(a) / l and its derivative by a, with l the distance from the mirror point."""
    # l^2 = (d - R)^2 + 4 d R sin^2(a/2): no cancellation near the surface
    length = np.sqrt((distance - radius) ** 2 + 4.0 * distance * radius * np.sin(0.5 * angle) ** 2)
    value = distance * np.sin(angle) / length
    return value, (distance * np.cos(angle) - radius * value**2) / length
