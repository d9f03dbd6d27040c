"""Where the mirror shows a point of the world: the inverse of `reflection.reflect`.

The pixel whose reflected ray goes through the point, by Newton's method on the ray's miss
e = w - (w . r) r, w = X - P, with the analytic derivatives of `reflect_jacobian`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.estimator.reflection import reflect, reflect_jacobian
from phibench.estimator.status import Status, StatusArray, first_fault, flag, keep
from phibench.scenes.frames import Array
from phibench.scenes.rig import View

_BISECTIONS = 4  # the error of the start falls by R / distance in each
_NEWTON_STEPS = 12
_TOLERANCE_PX = 1e-10


@dataclass(frozen=True)
class MirrorImage:
    """Images of points.

    Parameters
    ----------
    uv_px : shape (..., 2)
    px_per_m : shape (..., 2, 3), derivative of (u, v) by the point
    status : shape (...), values of `Status`; NOT_CONVERGED where no pixel shows the point
    """

    uv_px: Array
    px_per_m: Array
    status: StatusArray


def image_of(view: View, points_world_m: Array) -> MirrorImage:
    """Pixels that show points through the mirror.

    Parameters
    ----------
    view : View
    points_world_m : shape (..., 3), outside the sphere
    """
    X = np.asarray(points_world_m, float)
    with np.errstate(all="ignore"):
        uv = _start(view, X)
        for _ in range(_NEWTON_STEPS):
            step, _ = _newton(view, uv, X)
            uv = uv + step
            if not np.any(np.abs(step) > _TOLERANCE_PX):
                break
        step, px_per_m = _newton(view, uv, X)
        found = np.all(np.abs(step) < 1e3 * _TOLERANCE_PX, axis=-1)
        ahead = np.sum((X - reflect(view, uv).origin_world_m) * reflect(view, uv).direction_world, axis=-1) > 0.0
    status = first_fault(
        flag((~np.isfinite(X).all(axis=-1), Status.NOT_FINITE)), flag((~(found & ahead), Status.NOT_CONVERGED))
    )
    return MirrorImage(keep(uv, status), keep(px_per_m, status), status)


def _start(view: View, X: Array) -> Array:
    """Pixel of the point of the sphere whose normal halves the angle between camera and point."""
    S, C, R = view.sphere_centre_m, view.camera_centre_m, view.rig.mirror.radius_m
    P = np.broadcast_to(S, X.shape)
    for _ in range(_BISECTIONS):
        n = _unit(C - P) + _unit(X - P)
        P = S + R * _unit(n)
    T = view.T_world_camera
    return view.rig.camera.project((P - T.t) @ T.R)


def _newton(view: View, uv: Array, X: Array) -> tuple[Array, Array]:
    """Step of (u, v), shape (..., 2), and derivative by the point, shape (..., 2, 3), exact where the step is 0."""
    ray, J = reflect(view, uv), reflect_jacobian(view, uv)
    w, r = X - ray.origin_world_m, ray.direction_world
    along = np.sum(w * r, axis=-1)
    e = w - along[..., None] * r
    dP, dr = J.origin_m_per_px, J.direction_per_px
    dalong = np.einsum("...i,...ij->...j", w, dr) - np.einsum("...i,...ij->...j", r, dP)
    de = -dP - dalong[..., None, :] * r[..., :, None] - along[..., None, None] * dr
    pseudo = np.linalg.inv(_safe(np.swapaxes(de, -1, -2) @ de)) @ np.swapaxes(de, -1, -2)
    across = np.eye(3) - r[..., :, None] * r[..., None, :]
    return -np.einsum("...ij,...j->...i", pseudo, e), -pseudo @ across


def _safe(matrix: Array) -> Array:
    """The matrix, or the unit matrix for one without inverse: its step is NaN or does not come to rest."""
    with np.errstate(invalid="ignore"):
        good = np.isfinite(matrix).all(axis=(-1, -2)) & (np.abs(np.linalg.det(matrix)) > 0.0)
    return np.where(good[..., None, None], matrix, np.eye(2))


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
