"""Rays that meet a mirror with a form error, from the values of its radius alone.

This is the camera-side answer: it neither uses the tensors, the gradients nor the Hessians by which `fermat` goes from
the world's side, nor its equations. The harmonics are written out as they stand in `scenes/form.py`; a ray's place is
found by the secant method on q = |P|^2 - r(P / |P|)^2, which for a sphere is a parabola in the distance along the ray;
the normal follows from differences of surface points.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict

import numpy as np

from phibench.scenes.form import Form
from phibench.scenes.frames import Array

Radius = Callable[[Array], Array]

_NARROWING = (0.3, 0.03, 3e-3, 3e-4)  # radii: half width of the parabola that looks for the nearest place
_SECANTS = 12  # 4 to 6 do
_SETTLED = 1e-17  # metres: below a rounding of the distance
_STENCIL_RAD = 1e-3  # a five-point stencil errs by 3^5 / 30 of its fourth power: 1e-11 of the form, 1e-13 rad for 1 mm

_HARMONICS: dict[str, Callable[[Array, Array, Array], Array]] = {
    "form_20_m": lambda x, y, z: 1.5 * z * z - 0.5,
    "form_21c_m": lambda x, y, z: 2.0 * x * z,
    "form_21s_m": lambda x, y, z: 2.0 * y * z,
    "form_22c_m": lambda x, y, z: x * x - y * y,
    "form_22s_m": lambda x, y, z: 2.0 * x * y,
    "form_30_m": lambda x, y, z: (2.5 * z * z - 1.5) * z,
    "form_31c_m": lambda x, y, z: 0.1875 * math.sqrt(15.0) * x * (5.0 * z * z - 1.0),
    "form_31s_m": lambda x, y, z: 0.1875 * math.sqrt(15.0) * y * (5.0 * z * z - 1.0),
    "form_32c_m": lambda x, y, z: 1.5 * math.sqrt(3.0) * z * (x * x - y * y),
    "form_32s_m": lambda x, y, z: 3.0 * math.sqrt(3.0) * x * y * z,
    "form_33c_m": lambda x, y, z: x * (x * x - 3.0 * y * y),
    "form_33s_m": lambda x, y, z: y * (3.0 * x * x - y * y),
}


def meet(origins_m: Array, directions: Array, radius_m: float, form: Form) -> tuple[Array, Array, Array]:
    """First points of the mirror on rays from outside, in the sphere's frame.

    Parameters
    ----------
    origins_m, directions : arrays, shape (N, 3); directions of unit length
    radius_m, form

    Returns
    -------
    points_m, normals : arrays, shape (N, 3); NaN where the mirror is missed
    distance_m : array, shape (N,); NaN likewise
    """
    added = _added(form)
    approach = -np.einsum("ni,ni->n", origins_m, directions)
    foot = origins_m + approach[:, None] * directions  # nearest point to the centre
    foot2 = np.einsum("ni,ni->n", foot, foot)

    def q(x: Array) -> Array:
        """How far beyond the surface the ray is at a distance x from the foot, in squares of metres."""
        rho2 = foot2 + x * x
        with np.errstate(invalid="ignore"):
            return rho2 - (radius_m + added((foot + x[:, None] * directions) / np.sqrt(rho2)[:, None])) ** 2

    # certainly hits, and q is no parabola near the sphere's centre
    central = foot2 < 0.25 * radius_m**2
    lowest = np.where(central, 0.0, _lowest(q, radius_m, len(foot2)))
    with np.errstate(invalid="ignore"):
        x = _first_zero(q, lowest, np.sqrt(-np.where(central, foot2 - radius_m**2, q(lowest))))
    points = foot + x[:, None] * directions
    return points, _normals(points, radius_m, added), approach + x


def _added(form: Form) -> Radius:
    """Deviation of the radius in unit directions, shape (N, 3) -> (N,)."""
    terms = [(peak, _HARMONICS[name]) for name, peak in asdict(form).items() if peak]

    def added(n: Array) -> Array:
        return np.asarray(sum(peak * harmonic(*n.T) for peak, harmonic in terms))

    return added


def _lowest(q: Radius, radius_m: float, count: int) -> Array:
    """Where a function that is nearly a parabola x^2 + c is least, shape (N,)."""
    lowest = np.zeros(count)
    with np.errstate(invalid="ignore", divide="ignore"):
        for width in _NARROWING:
            h = width * radius_m
            left, middle, right = (q(lowest + shift) for shift in (-h, 0.0, h))
            lowest = lowest - 0.5 * h * (right - left) / (right - 2.0 * middle + left)
    return lowest


def _first_zero(q: Radius, lowest: Array, reach: Array) -> Array:
    """Zero of q about `reach` before its lowest place, shape (N,); NaN where `reach` is."""
    with np.errstate(invalid="ignore", divide="ignore"):
        old, new = lowest - reach, lowest - 0.999 * reach
        q_old, q_new = q(old), q(new)
        for _ in range(_SECANTS):
            step = q_new * (new - old) / (q_new - q_old)
            step = np.where(np.isfinite(step) | np.isnan(new), step, 0.0)  # two equal values: nothing more to find
            old, q_old, new = new, q_new, new - step
            q_new = q(new)
            if not np.any(np.abs(step) > _SETTLED):
                break
    return new


def _normals(points_m: Array, radius_m: float, added: Radius) -> Array:
    """Outward unit normals, shape (N, 3), at surface points: the cross product of two tangents."""
    n = points_m / np.linalg.norm(points_m, axis=-1, keepdims=True)
    helper = np.eye(3)[np.argmin(np.nan_to_num(np.abs(n)), axis=-1)]
    first = np.cross(n, helper)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    second = np.cross(n, first)
    radius = (radius_m + added(n))[:, None]
    tangents = [radius * e + _slope(added, n, e)[:, None] * n for e in (first, second)]
    normals = np.cross(*tangents)
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def _slope(added: Radius, n: Array, e: Array) -> Array:
    """Derivative of the radius, metres per radian, from n towards e at right angles to it."""
    near, far = (_difference(added, n, e, angle) for angle in (_STENCIL_RAD, 2.0 * _STENCIL_RAD))
    return (8.0 * near - far) / (12.0 * _STENCIL_RAD)


def _difference(added: Radius, n: Array, e: Array, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return added(c * n + s * e) - added(c * n - s * e)
