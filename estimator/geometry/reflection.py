"""Camera rays reflected at any mirror, through a glass tube as well, with derivatives; pixels that show a room point.

Estimators assume a perfect surface. The form error serves the true rig, whose errors `sensitivities` predicts.

Symbols: d unit camera ray, s sphere centre in the camera frame, P reflection point relative to the sphere centre,
n outward normal, i angle of incidence, r unit ray that leaves the mirror. Frames, poses and pixels as in
`phibench.scenes.frames`. Every kernel takes leading axes and never raises for one bad ray: NaN and a `Status`.

A glass tube around the mirror bends the rays that leave it: `room_rays` follows them by Snell's law for vectors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from phibench.estimator.geometry.mirror_geometry import Hit, geometry_of
from phibench.estimator.geometry.status import Status, StatusArray, first_fault, flag, keep
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array, cross
from phibench.scenes.glass_tube import GlassTube
from phibench.scenes.rig import View

# cos i = 1e-3 is 2e-4 px inside the outline of the default rig; the error of theta per pixel grows as 1 / cos i.
GRAZING_COSINE = 1e-3
# Sine of the angle of incidence below which a ray has no azimuth: 1e-9 is less than 1e-6 px from the axis.
ON_AXIS_SINE = 1e-9


@dataclass(frozen=True)
class Reflection:
    """Rays that leave the mirror.

    Parameters
    ----------
    origin_world_m : shape (..., 3), reflection points, metres
    direction_world : shape (..., 3), unit vectors, away from the mirror
    normal_world : shape (..., 3), unit vectors, outward
    incidence_rad : shape (...)
    status : shape (...), values of `Status`
    """

    origin_world_m: Array
    direction_world: Array
    normal_world: Array
    incidence_rad: Array
    status: StatusArray


@dataclass(frozen=True)
class ReflectionJacobian:
    """Derivatives of a `Reflection` by the pixel (u, v): the last axis is (u, v), shapes (..., 3, 2) and (..., 2)."""

    origin_m_per_px: Array
    direction_per_px: Array
    normal_per_px: Array
    incidence_rad_per_px: Array


def reflect(view: View, uv_px: Array) -> Reflection:
    """Reflect the chief rays of pixels at the mirror.

    Parameters
    ----------
    uv_px : shape (..., 2), pixels

    Returns
    -------
    Reflection
        In the world frame.
    """
    return _reflection(view, *_first_hit(view, uv_px))


def reflect_jacobian(view: View, uv_px: Array) -> ReflectionJacobian:
    """Differentiate `reflect` by the pixel, analytically; NaN where `reflect` gives NaN.

    Parameters
    ----------
    uv_px : shape (..., 2), pixels
    """
    return _reflection_jacobian(view, uv_px, *_first_hit(view, uv_px))


def reflect_both(view: View, uv_px: Array) -> tuple[Reflection, ReflectionJacobian]:
    """`reflect` and `reflect_jacobian`: both ask for the same hit."""
    hit, status = _first_hit(view, uv_px)
    return _reflection(view, hit, status), _reflection_jacobian(view, uv_px, hit, status)


def _first_hit(view: View, uv_px: Array) -> tuple[Hit, StatusArray]:
    with np.errstate(all="ignore"):
        hit = geometry_of(view.rig.mirror).first_hit(view.rig.camera.rays(uv_px), view.rig.T_camera_sphere)
        return hit, _status(hit)


def _reflection(view: View, hit: Hit, status: StatusArray) -> Reflection:
    T = view.T_world_camera
    with np.errstate(all="ignore"):
        r = hit.d + 2.0 * hit.cos_i * hit.n  # d - 2 (d.n) n with d.n = -cos i
    return Reflection(
        keep(view.sphere_centre_m + T.directions(hit.P), status),
        keep(T.directions(r), status),
        keep(T.directions(hit.n), status),
        keep(np.arctan2(hit.sin_i, hit.cos_i)[..., 0], status),
        status,
    )


def _reflection_jacobian(view: View, uv_px: Array, hit: Hit, status: StatusArray) -> ReflectionJacobian:
    geometry, pose = geometry_of(view.rig.mirror), view.rig.T_camera_sphere
    with np.errstate(all="ignore"):
        d, n, cos_i, t, outward = (x[..., None] for x in (hit.d, hit.n, hit.cos_i, hit.t, hit.outward))
        dd = ray_jacobian(view.rig.camera, uv_px)
        dt = -t * _dot(outward, dd) / _dot(outward, d)  # P stays on the mirror: n . dP = 0
        dP = t * dd + d * dt
        dn = geometry.normal_change(hit.P, dP, pose)
        dcos = -(_dot(dd, n) + _dot(d, dn))
        dr = dd + 2.0 * (dcos * n + cos_i * dn)
        di = -dcos / hit.sin_i[..., None]
    R = view.T_world_camera.R
    origin, direction, normal = (keep(R @ tangents, status) for tangents in (dP, dr, dn))
    return ReflectionJacobian(origin, direction, normal, keep(di[..., 0, :], status))


def _status(hit: Hit) -> StatusArray:
    return flag(
        (~np.isfinite(hit.d).all(axis=-1), Status.NOT_FINITE),
        (np.isnan(hit.cos_i[..., 0]), Status.MISSES_MIRROR),
        (hit.cos_i[..., 0] < GRAZING_COSINE, Status.GRAZING),
        (hit.sin_i[..., 0] < ON_AXIS_SINE, Status.ON_AXIS),
    )


def ray_jacobian(camera: Camera, uv_px: Array) -> Array:
    """Derivative of the unit camera ray by the pixel, shape (..., 3, 2)."""
    xy = camera.normalised(uv_px)
    J = camera.distort_jacobian(xy)
    (a, b), (c, e) = ((J[..., i, 0], J[..., i, 1]) for i in (0, 1))
    det = a * e - b * c
    inverse = np.stack([np.stack([e, -b], -1), np.stack([-c, a], -1)], -2) / det[..., None, None]
    dq = np.zeros((*xy.shape[:-1], 3, 2))
    dq[..., :2, :] = inverse / np.array([camera.fx_px, camera.fy_px])
    q = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)[..., None]
    length = np.sqrt(np.sum(q * q, axis=-2, keepdims=True))
    d = q / length
    return (dq - d * _dot(d, dq)) / length


def _dot(a: Array, b: Array) -> Array:
    """Dot product over the second last axis, kept with length 1."""
    return np.sum(a * b, axis=-2, keepdims=True)


# -- motion of a ray with its pixel ------------------------------------------------------------------------------------


def ray_slope(view: View, uv_px: Array, points_world_m: Array) -> Array:
    """Motion across the ray, at the point, per pixel: shape (..., 2, 2), metres per pixel, NaN where there is no ray.

    At a distance t along the ray r from the mirror point P, d(P + t r)/d(u, v) along the two directions of `ray_basis`.
    """
    ray, J = room_rays_both(view, uv_px)
    along = np.sum((points_world_m - ray.origin_world_m) * ray.direction_world, axis=-1)[..., None, None]
    return ray_basis(ray.direction_world) @ (J.origin_m_per_px + along * J.direction_per_px)


def ray_basis(directions: Array) -> Array:
    """Two unit vectors across each unit direction (..., 3), as rows: shape (..., 2, 3)."""
    least = np.eye(3)[np.argmin(np.nan_to_num(np.abs(directions)), axis=-1)]
    first = cross(directions, least)
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, cross(directions, first)], axis=-2)


# -- glass tube around the mirror --------------------------------------------------------------------------------------


def room_rays(view: View, uv_px: Array) -> Reflection:
    """Reflected rays as they go on into the room: from the mirror, or from the outer face of a glass tube around it.

    Normals and angles are those at the mirror. What a plate of the tube hides is not asked.
    """
    ray = reflect(view, uv_px)
    if view.tube is None:
        return ray
    with np.errstate(all="ignore"):
        origin, direction, _, _ = _through_glass(view.tube, ray, None)
    return replace(ray, origin_world_m=keep(origin, ray.status), direction_world=keep(direction, ray.status))


def room_rays_jacobian(view: View, uv_px: Array) -> ReflectionJacobian:
    """Derivatives of `room_rays` by the pixel, analytically."""
    return room_rays_both(view, uv_px)[1]


def room_rays_both(view: View, uv_px: Array) -> tuple[Reflection, ReflectionJacobian]:
    """`room_rays` and `room_rays_jacobian`: both ask for the same hit."""
    ray, J = reflect_both(view, uv_px)
    if view.tube is None:
        return ray, J
    with np.errstate(all="ignore"):
        places = _through_glass(view.tube, ray, J)
    origin, direction, origin_per_px, direction_per_px = (keep(x, ray.status) for x in places)
    return (
        replace(ray, origin_world_m=origin, direction_world=direction),
        replace(J, origin_m_per_px=origin_per_px, direction_per_px=direction_per_px),
    )


def _through_glass(tube: GlassTube, ray: Reflection, J: ReflectionJacobian | None) -> tuple[Array, Array, Array, Array]:
    """Points on the outer face, directions behind it, and the derivatives of both; 0 without those of the ray."""
    flat = np.eye(3) - np.outer(tube.axis, tube.axis)
    X, d = ((vector)[..., None] for vector in (ray.origin_world_m - tube.origin_m, ray.direction_world))
    zero = np.zeros((*ray.origin_world_m.shape, 2))
    dX, dd = (zero, zero) if J is None else (J.origin_m_per_px, J.direction_per_px)
    for radius, ratio in ((tube.inner_m, 1.0 / tube.index), (tube.outer_m, tube.index)):
        # |flat (X + t d)| = radius, the later of its two roots
        a, b, c = _dot(flat @ d, d), _dot(flat @ d, X), _dot(flat @ X, X) - radius**2
        t = (np.sqrt(b * b - a * c) - b) / a
        X = X + t * d
        n, moved = flat @ X / radius, dX + t * dd
        dX = moved - d * _dot(n, moved) / _dot(n, d)  # it stays on the cylinder
        dn = flat @ dX / radius
        cos = _dot(n, d)
        along = ratio * (d - cos * n)
        dalong = ratio * (dd - (_dot(dd, n) + _dot(d, dn)) * n - cos * dn)
        behind = np.sqrt(1.0 - _dot(along, along))
        d, dd = along + behind * n, dalong - _dot(along, dalong) / behind * n + behind * dn
    return X[..., 0] + tube.origin_m, d[..., 0], dX, dd


# Image of a world point in the mirror: the inverse of `room_rays`.
#
# The pixel is the one whose reflected ray P + t r goes through the point X. Newton's method brings the ray's miss
# e = w - (w . r) r, w = X - P, to 0, with the analytic derivatives of `room_rays_jacobian`.


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
    ray, J = room_rays_both(view, uv)
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
