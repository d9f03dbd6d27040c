"""The occluding contour of a mirror with a form error: where lines of sight touch it.

A mirror point P shows itself to the eye E as an edge where g(P) = 0 and grad g . (P - E) = 0 (`form`). In the
half-plane of the eye, the centre and a direction across there is one such point, because the mirror is convex and holds
the centre.
"""

from __future__ import annotations

import numpy as np

from phibench.scenes.form import Form, deviation, level
from phibench.scenes.frames import Array

_STEPS = 8  # Newton's method starts within the form's slopes, some 1e-3 rad
_CLOSE_RAD = 1e-9  # the step after that would be its square


def limb_points(eye_m: Array, across: Array, radius_m: float, form: Form) -> Array:
    """Points of the contour, shape (N, 3), metres, sphere's frame.

    Parameters
    ----------
    eye_m : array, shape (3,)
    across : array, shape (N, 3)
        Unit vectors at right angles to the eye's direction.
    radius_m, form
    """
    distance = float(np.linalg.norm(eye_m))
    axis = eye_m / distance
    angle = np.full(len(across), np.arccos(radius_m / distance))
    for _ in range(_STEPS):
        n, n1 = _directions(axis, across, angle)
        P = _surface(n, radius_m, form)
        at = level(P, radius_m, form)
        rho = np.linalg.norm(P, axis=-1, keepdims=True)
        rho1 = -rho * np.sum(
            at.gradient * n1, axis=-1, keepdims=True
        )  # d rho / d angle: n is radial, grad g = n - grad f
        P1 = rho * n1 + rho1 * n
        facing = np.sum(at.gradient * (P - eye_m), axis=-1)
        slope = np.einsum("ni,nij,nj->n", P1, at.hessian_per_m, P - eye_m)
        step = facing / slope
        angle = angle - step
        if not np.any(np.abs(step) > _CLOSE_RAD):
            break
    return _surface(_directions(axis, across, angle)[0], radius_m, form)


def _directions(axis: Array, across: Array, angle: Array) -> tuple[Array, Array]:
    """Unit vectors at angles from the axis, and their derivatives by the angle."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return c * axis + s * across, c * across - s * axis


def _surface(n: Array, radius_m: float, form: Form) -> Array:
    """Surface points in directions n."""
    return (radius_m + deviation(n, form).value_m)[:, None] * n
