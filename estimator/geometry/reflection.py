"""Camera rays reflected at the mirror: in closed form for a sphere, by Newton's method for other surfaces.

Estimators assume a perfect sphere. The form error serves the true rig, whose errors `sensitivities` predicts.

Symbols: d unit camera ray, s sphere centre in the camera frame, P reflection point relative to the sphere centre,
n outward normal, i angle of incidence, r unit ray that leaves the mirror. Frames, poses and pixels as in
`phibench.scenes.frames`. Every kernel takes leading axes and never raises for one bad ray: NaN and a `Status`.

A glass tube around the mirror bends the rays that leave it: `room_rays` follows them by Snell's law for vectors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from phibench.estimator.geometry.status import Status, StatusArray, flag, keep
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.glass_tube import GlassTube
from phibench.scenes.mirror import Form, Level, SphereMirror, level
from phibench.scenes.revolved_mirror import FormedProfile, Profile, RevolvedMirror, height_level
from phibench.scenes.rig import Mirror, View

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


@dataclass(frozen=True)
class _Hit:
    """First hit in the camera frame; vectors (..., 3), scalars (..., 1)."""

    d: Array
    t: Array
    P: Array
    n: Array
    cos_i: Array
    sin_i: Array


def reflect(view: View, uv_px: Array) -> Reflection:
    """Reflect the chief rays of pixels at the mirror.

    Parameters
    ----------
    view : View
    uv_px : shape (..., 2), pixels

    Returns
    -------
    Reflection
        In the world frame.
    """
    with np.errstate(all="ignore"):
        hit = _first_hit(view, uv_px)
        status = _status(hit)
        r = hit.d + 2.0 * hit.cos_i * hit.n  # d - 2 (d.n) n with d.n = -cos i
    T = view.T_world_camera
    return Reflection(
        keep(view.sphere_centre_m + T.directions(hit.P), status),
        keep(T.directions(r), status),
        keep(T.directions(hit.n), status),
        keep(np.arctan2(hit.sin_i, hit.cos_i)[..., 0], status),
        status,
    )


def reflect_jacobian(view: View, uv_px: Array) -> ReflectionJacobian:
    """Differentiate `reflect` by the pixel, analytically; NaN where `reflect` gives NaN.

    Parameters
    ----------
    view : View
    uv_px : shape (..., 2), pixels
    """
    with np.errstate(all="ignore"):
        hit = _first_hit(view, uv_px)
        status = _status(hit)
        d, P, n, cos_i, t = (x[..., None] for x in (hit.d, hit.P, hit.n, hit.cos_i, hit.t))
        dd = ray_jacobian(view.rig.camera, uv_px)
        outward = P if _is_round(view.rig.mirror) else n  # of any length
        dt = -t * _dot(outward, dd) / _dot(outward, d)  # P stays on the mirror: n . dP = 0
        dP = t * dd + d * dt
        dn = _normal_change(view, hit.P, dP)
        dcos = -(_dot(dd, n) + _dot(d, dn))
        dr = dd + 2.0 * (dcos * n + cos_i * dn)
        di = -dcos / hit.sin_i[..., None]
    R = view.T_world_camera.R
    origin, direction, normal = (keep(R @ tangents, status) for tangents in (dP, dr, dn))
    return ReflectionJacobian(origin, direction, normal, keep(di[..., 0, :], status))


def _normal_change(view: View, P: Array, dP: Array) -> Array:
    """Change of the unit normal, camera frame, when P, shape (..., 3), moves on the mirror by dP, shape (..., 3, k)."""
    mirror = view.rig.mirror
    if isinstance(mirror, SphereMirror) and mirror.form is None:
        return dP / mirror.radius_m
    turned = view.rig.T_camera_sphere.R
    return turned @ normal_slope(mirror.level(P @ turned)) @ turned.T @ dP


def _is_round(mirror: Mirror) -> bool:
    return isinstance(mirror, SphereMirror) and mirror.form is None


def _first_hit(view: View, uv_px: Array) -> _Hit:
    mirror = view.rig.mirror
    if isinstance(mirror, RevolvedMirror):
        return _first_hit_of_profile(view, uv_px, mirror.surface)
    if mirror.form is not None:
        return _first_hit_of_form(view, uv_px, mirror.form)
    s, radius = view.rig.sphere_in_camera_m, mirror.radius_m
    d = view.rig.camera.rays(uv_px)
    b = np.sum(d * s, axis=-1, keepdims=True)
    miss2 = np.sum(np.cross(d, s) ** 2, axis=-1, keepdims=True)  # squared distance of the ray from the sphere centre
    # NaN where the line misses; a line that hits does so ahead, because a Rig has its whole sphere before the camera
    root = np.sqrt(radius**2 - miss2)
    # t^2 - 2 b t + c = 0; the near root b - root loses digits, c / (b + root) does not
    t = (s @ s - radius**2) / (b + root)
    P = t * d - s
    return _Hit(d, t, P, P / radius, root / radius, np.sqrt(miss2) / radius)


def _first_hit_of_form(view: View, uv_px: Array, form: Form) -> _Hit:
    turned, radius = view.rig.T_camera_sphere.R, view.rig.sphere.radius_m
    d = view.rig.camera.rays(uv_px)
    t = first_meeting(-view.rig.sphere_in_camera_m @ turned, d @ turned, radius, form)
    return _hit_at(view, d, t)


def _first_hit_of_profile(view: View, uv_px: Array, surface: Profile | FormedProfile) -> _Hit:
    turned = view.rig.T_camera_sphere.R
    d = view.rig.camera.rays(uv_px)
    lens, ways = -view.rig.sphere_in_camera_m @ turned, d @ turned
    if isinstance(surface, FormedProfile):
        return _hit_at(view, d, formed_meeting(lens, ways, surface))
    return _hit_at(view, d, profile_meeting(lens, ways, surface))


def _hit_at(view: View, d: Array, distance: Array) -> _Hit:
    """Hit after distances (...) along rays (..., 3) in the camera frame."""
    turned, t = view.rig.T_camera_sphere.R, distance[..., None]
    P = t * d - view.rig.sphere_in_camera_m
    n = unit_normal(view.rig.mirror.level(P @ turned)) @ turned.T
    cos_i = -np.sum(d * n, axis=-1, keepdims=True)
    sin_i = np.linalg.norm(np.cross(d, n), axis=-1, keepdims=True)
    return _Hit(d, t, P, n, cos_i, sin_i)


def _status(hit: _Hit) -> StatusArray:
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
    ray, J = room_rays(view, uv_px), room_rays_jacobian(view, uv_px)
    along = np.sum((points_world_m - ray.origin_world_m) * ray.direction_world, axis=-1)[..., None, None]
    return ray_basis(ray.direction_world) @ (J.origin_m_per_px + along * J.direction_per_px)


def ray_basis(directions: Array) -> Array:
    """Two unit vectors across each unit direction (..., 3), as rows: shape (..., 2, 3)."""
    least = np.eye(3)[np.argmin(np.nan_to_num(np.abs(directions)), axis=-1)]
    first = np.cross(directions, least)
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=-2)


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
    J = reflect_jacobian(view, uv_px)
    if view.tube is None:
        return J
    ray = reflect(view, uv_px)
    with np.errstate(all="ignore"):
        _, _, origin, direction = _through_glass(view.tube, ray, J)
    return replace(J, origin_m_per_px=keep(origin, ray.status), direction_per_px=keep(direction, ray.status))


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


# -- hit on a mirror of revolution -------------------------------------------------------------------------------------

_CONVEX_STEPS = 60  # 6 to 9 do; each step of a ray that grazes halves what is left
_AROUND = 1.1  # of the rim: as far as a ray may enter beside it


def profile_meeting(origin_m: Array, directions: Array, profile: Profile, rim_m: float | None = None) -> Array:
    """Distance to the mirror along unit directions (..., 3) from one point (3,), shape (...), mirror's frame.

    NaN where the mirror is missed. The depth of the profile over the ray, sag(x^2 + y^2) - z, is a convex function of
    the distance t, because the profile is convex. It is above 0 at a lens outside. Newton's method on a convex function
    comes to its first zero from one side, without a bracket: it cannot pass it.
    """
    t = np.zeros(directions.shape[:-1])
    with np.errstate(invalid="ignore", divide="ignore"):
        for _ in range(_CONVEX_STEPS):
            x, y, z = np.moveaxis(origin_m + t[..., None] * directions, -1, 0)
            s = x * x + y * y
            sag = profile.sag(s)
            rise = np.where(s > 0.0, 2.0 * sag.slope_per_m * (x * directions[..., 0] + y * directions[..., 1]), 0.0)
            step = (z - sag.z_m) / (rise - directions[..., 2])
            t = np.where(step >= -_CLOSE_M, t + step, np.nan)  # back means that there is no zero ahead
            if not np.any(np.abs(step) > _CLOSE_M):
                break
        rim_m = profile.rim_radius_m if rim_m is None else rim_m
        return np.where((np.abs(step) <= _CLOSE_M) & (s <= rim_m**2), t, np.nan)


def formed_meeting(origin_m: Array, directions: Array, surface: FormedProfile) -> Array:
    """Distances as of `profile_meeting` to a surface with a form error.

    The depth over the ray is convex within the rim, where its polynomials belong. The ideal profile, brought before
    the surface, is met within it or nearly so: Newton's method goes on from there.
    """
    profile, raised = surface.ideal, np.array([0.0, 0.0, surface.reach_m])
    t = profile_meeting(origin_m + raised, directions, profile, _AROUND * profile.rim_radius_m)
    with np.errstate(invalid="ignore", divide="ignore"):
        for _ in range(_CONVEX_STEPS):
            at = height_level(surface, origin_m + t[..., None] * directions)
            step = -at.value_m / np.sum(at.gradient * directions, axis=-1)
            t = np.where(step >= -_CLOSE_M, t + step, np.nan)
            if not np.any(np.abs(step) > _CLOSE_M):
                break
        s = np.sum((origin_m + t[..., None] * directions)[..., :2] ** 2, axis=-1)
        return np.where((np.abs(step) <= _CLOSE_M) & (s <= surface.rim_radius_m**2), t, np.nan)


# -- hit on a mirror with a form error ---------------------------------------------------------------------------------

_NEAREST_STEPS = 4  # Newton's, from the foot of the perpendicular: the form's slope, 1e-3, falls to its square in each
_STEPS = 12  # Newton's, from a sphere's place that the form moves little; it ends at `_CLOSE_M`
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
