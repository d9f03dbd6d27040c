"""Epipolar line of a down pixel: its place in the up image at 1 / D, with derivatives; length of a ray to distance D.

The down pixel's ray is X(t) = P + t r. t follows from |X_h - S_h| = D, h the horizontal part and S the sphere centre at
the down position. `up_image` gives the pixel of X in the up image, with derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from phibench.estimator.geometry.reflection import image_of, room_rays_both
from phibench.estimator.geometry.status import Status, StatusArray, first_fault, flag, keep, stroke_status
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig


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
    stroke_m : shape (...), h
    uv_down_px : shape (..., 2)
    inverse_depth_per_m : shape (...), 1 / D, above 0
    """
    view, uv = rig.at(0.0), np.asarray(uv_down_px, float)
    q, h = np.asarray(inverse_depth_per_m, float), np.asarray(stroke_m, float)
    ray, J = room_rays_both(view, uv)
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
