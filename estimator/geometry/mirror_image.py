"""Image of a world point in the mirror: the inverse of `reflection.room_rays`; and the epipolar line of a pixel.

The pixel is the one whose reflected ray P + t r goes through the point X. Newton's method brings the ray's miss
e = w - (w . r) r, w = X - P, to 0, with the analytic derivatives of `room_rays_jacobian`.

Epipolar line: the down pixel's ray is X(t) = P + t r. t follows from |X_h - S_h| = D, h the horizontal part and S the
sphere centre at the down position. `up_image` gives the pixel of X in the up image, with derivatives.

Line of sight: segments against boxes, by clipping (`blocked`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from phibench.estimator.geometry.mirror_geometry import geometry_of
from phibench.estimator.geometry.reflection import room_rays, room_rays_jacobian
from phibench.estimator.geometry.status import Status, StatusArray, first_fault, flag, keep, stroke_status
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig, View
from phibench.scenes.shapes import Cuboid

_NEWTON_STEPS = 12
_TOLERANCE_PX = 1e-10  # of a step: the next one, of the order of its square, is below rounding


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
    X, geometry = np.asarray(points_world_m, float), geometry_of(view.rig.mirror)
    with np.errstate(all="ignore"):
        uv, wide = geometry.start_px(view, X), geometry.beyond_rim(view)
        for _ in range(_NEWTON_STEPS):
            step, _ = _newton(wide, uv, X)
            uv = uv + step
            if not np.any(np.abs(step) > _TOLERANCE_PX):
                break
        step, px_per_m = _newton(view, uv, X)
        at_rest = np.all(np.abs(step) < 1e3 * _TOLERANCE_PX, axis=-1)
        ray = room_rays(view, uv)
        ahead = np.sum((X - ray.origin_world_m) * ray.direction_world, axis=-1) > 0.0
    status = first_fault(
        flag((~np.isfinite(X).all(axis=-1), Status.NOT_FINITE)), flag((~(at_rest & ahead), Status.NOT_CONVERGED))
    )
    return MirrorImage(keep(uv, status), keep(px_per_m, status), status)


def _newton(view: View, uv: Array, X: Array) -> tuple[Array, Array]:
    """Step of (u, v), shape (..., 2), and derivative by the point, shape (..., 2, 3), exact where the step is 0."""
    ray, J = room_rays(view, uv), room_rays_jacobian(view, uv)
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


# -- epipolar line -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class UpImage:
    """Pixels of the up image, shape (...).

    Parameters
    ----------
    uv_px : shape (..., 2)
    jacobian : shape (..., 2, 3)
        Derivatives by u and v of the down image, and by 1 / D in 1 / m, in which the images move nearly evenly.
    point_world_m : shape (..., 3)
    status : shape (...), values of `Status`
    """

    uv_px: Array
    jacobian: Array
    point_world_m: Array
    status: StatusArray


def up_image(rig: Rig, stroke_m: ArrayLike, uv_down_px: Array, inverse_depth_per_m: ArrayLike) -> UpImage:
    """Image in the up frame of the point at 1 / D on the ray of a down pixel.

    Parameters
    ----------
    rig : Rig
    stroke_m : shape (...), h
    uv_down_px : shape (..., 2)
    inverse_depth_per_m : shape (...), 1 / D, above 0
    """
    view, uv = rig.at(0.0), np.asarray(uv_down_px, float)
    q, h = np.asarray(inverse_depth_per_m, float), np.asarray(stroke_m, float)
    ray, J = room_rays(view, uv), room_rays_jacobian(view, uv)
    with np.errstate(all="ignore"):
        D = 1.0 / q
        t = range_at(ray.origin_world_m - view.sphere_centre_m, ray.direction_world, D)
        X = ray.origin_world_m + t[..., None] * ray.direction_world
        dX = _tangents(X - view.sphere_centre_m, ray.direction_world, t, D, J.origin_m_per_px, J.direction_per_px)
        # the stroke moves the rig along the axis and turns nothing: move the point against it instead
        image = image_of(view, X - h[..., None] * np.array(rig.stroke_axis_world))
        jacobian = image.px_per_m @ dX
    range_status = flag((~(q > 0.0), Status.OUT_OF_RANGE), (~(t > 0.0), Status.DIVERGING))
    status = first_fault(ray.status, stroke_status(h), range_status, image.status)
    return UpImage(keep(image.uv_px, status), keep(jacobian, status), keep(X, status), status)


def range_at(origin_m: Array, direction: Array, D: Array) -> Array:
    """Length along rays at which the horizontal distance from the vertical through the origin is D, shape (...).

    Parameters
    ----------
    origin_m, direction : shape (..., 3)
    D : shape (...)
    """
    a = np.sum(direction[..., :2] ** 2, axis=-1)
    b = np.sum(origin_m[..., :2] * direction[..., :2], axis=-1)
    c = np.sum(origin_m[..., :2] ** 2, axis=-1) - D * D
    return np.asarray((np.sqrt(b * b - a * c) - b) / a)


def _tangents(radial: Array, r: Array, t: Array, D: Array, dP: Array, dr: Array) -> Array:
    """Derivatives of X by u, v, 1 / D, shape (..., 3, 3): those of t keep rho . drho = D dD."""
    fixed = dP + t[..., None, None] * dr
    rho = radial[..., :2]
    outward = np.sum(rho * r[..., :2], axis=-1)
    dt_px = -np.einsum("...i,...ij->...j", rho, fixed[..., :2, :]) / outward[..., None]
    dt_q = -(D**3) / outward  # dD = -D^2 d(1/D)
    pixel = fixed + r[..., :, None] * dt_px[..., None, :]
    return np.concatenate([pixel, (r * dt_q[..., None])[..., None]], axis=-1)


# -- line of sight -----------------------------------------------------------------------------------------------------

_END_M = 1e-6  # a segment may touch the surface that it ends on


def blocked(solid: Cuboid, start_m: Array, end_m: Array) -> BoolArray:
    """Segments, shape (..., 3), that pass through a box: bool, shape (...).

    The part of the segment inside each pair of planes is an interval of its parameter; the box is hit where the three
    have more than a point in common.
    """
    into = solid.T_world_shape.inverse()
    a, b = into.points(np.asarray(start_m, float)), into.points(np.asarray(end_m, float))
    half = 0.5 * np.array(solid.size_m)
    along = b - a
    length = np.linalg.norm(along, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        one, two = (-half - a) / along, (half - a) / along
        parallel = along == 0.0
        inside = np.abs(a) < half
        low = np.where(parallel, np.where(inside, -np.inf, np.inf), np.minimum(one, two)).max(axis=-1)
        high = np.where(parallel, np.where(inside, np.inf, -np.inf), np.maximum(one, two)).min(axis=-1)
        end = _END_M / length
    return np.asarray(np.minimum(high, 1.0 - end) > np.maximum(low, end))


def first_blocker(solids: Sequence[Cuboid], legs: Sequence[tuple[Array, Array]]) -> str | None:
    """Name of the first solid that stands in any leg (start, end), shapes (..., 3), of any ray; None if none does."""
    for solid in solids:
        if any(np.any(blocked(solid, start, end)) for start, end in legs):
            return solid.name
    return None
