"""Image of a world point in the mirror: the inverse of `reflection.room_rays`; and the epipolar line of a pixel.

The pixel is the one whose reflected ray P + t r goes through the point X. Newton's method brings the ray's miss
e = w - (w . r) r, w = X - P, to 0, with the analytic derivatives of `room_rays_jacobian`.

Epipolar line: the down pixel's ray is X(t) = P + t r. t follows from |X_h - S_h| = D, h the horizontal part and S the
sphere centre at the down position. `up_image` gives the pixel of X in the up image, with derivatives.

Line of sight: segments against boxes, by clipping (`blocked`).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from phibench.estimator.geometry.reflection import room_rays, room_rays_jacobian
from phibench.estimator.geometry.status import Status, StatusArray, first_fault, flag, keep, stroke_status
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.revolved_mirror import Profile, RevolvedMirror
from phibench.scenes.rig import Rig, View
from phibench.scenes.shapes import Cuboid
from phibench.scenes.validation import SceneError

_BISECTIONS = 4  # the error of the start falls by R / distance in each
_HALVINGS = 40  # of the rim's diameter: the place is known to 1e-13 m
_WIDER = (1.2, 1.1, 1.05, 1.02, 1.01)  # times the rim's radius
_UNEVEN = 0.999  # so that no middle is on the axis, where a cone has its tip
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
    X = np.asarray(points_world_m, float)
    with np.errstate(all="ignore"):
        uv, wide = _start(view, X), _beyond_rim(view)
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


def _start(view: View, X: Array) -> Array:
    """Pixel of the point of the sphere whose normal halves the angle between camera and point."""
    if isinstance(view.rig.mirror, RevolvedMirror):
        return _start_in_meridian(view, X, view.rig.mirror.profile)
    S, C, R = view.sphere_centre_m, view.camera_centre_m, view.rig.mirror.radius_m
    P = np.broadcast_to(S, X.shape)
    for _ in range(_BISECTIONS):
        n = _unit(C - P) + _unit(X - P)
        P = S + R * _unit(n)
    T = view.T_world_camera
    return view.rig.camera.project((P - T.t) @ T.R)


def _beyond_rim(view: View) -> View:
    """View of a mirror that goes on behind its rim, which Newton's method may pass on its way."""
    return replace(view, rig=_wider(view.rig)) if isinstance(view.rig.mirror, RevolvedMirror) else view


@lru_cache(maxsize=64)
def _wider(rig: Rig) -> Rig:
    assert isinstance(rig.mirror, RevolvedMirror)
    profile = rig.mirror.profile
    for factor in _WIDER:
        with suppress(SceneError):  # folds, is no longer convex, or meets its holder
            wide = replace(profile, rim_radius_m=factor * profile.rim_radius_m)
            return replace(rig, mirror=replace(rig.mirror, profile=wide))
    return rig


def _start_in_meridian(view: View, X: Array, profile: Profile) -> Array:
    """Pixel of the point of the profile, in the meridian of X, from where the reflected ray goes to X.

    The camera is moved into the meridian; on the axis it lies in all of them. From the axis to the rim the ray turns
    from straight down outwards, and passes X once: bisection finds where.
    """
    pose = view.T_world_sphere.inverse()
    point, eye = pose.points(X), pose.points(view.camera_centre_m)
    away = np.linalg.norm(point[..., :2], axis=-1)
    across = np.where(away[..., None] > 0.0, point[..., :2] / away[..., None], [1.0, 0.0])
    aside = across @ eye[:2]
    high = np.full(away.shape, profile.rim_radius_m)
    low = -_UNEVEN * high
    for _ in range(_HALVINGS):
        r = 0.5 * (low + high)
        sag = profile.sag(r * r)
        normal = np.arctan2(2.0 * r * sag.slope_per_m, 1.0)  # angles from straight down, outwards
        ray = 2.0 * normal - np.arctan2(aside - r, sag.z_m - eye[2])
        before = ray < np.arctan2(away - r, sag.z_m - point[..., 2])
        low, high = np.where(before, r, low), np.where(before, high, r)
    P = np.concatenate([r[..., None] * across, profile.sag(r * r).z_m[..., None]], axis=-1)
    return view.rig.camera.project(view.rig.T_camera_sphere.points(P))


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


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


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
