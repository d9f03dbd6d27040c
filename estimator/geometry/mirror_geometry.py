"""Kinds of mirror (sphere, with form error, of revolution) for estimators: ray hits, normals, derivatives, eq. (4).

`geometry_of` alone tests the type of a mirror. Points P are relative to the mirror's origin, a sphere's centre or a
vertex; `pose` is the mirror's in the camera, where rays begin at 0. Arrays take leading axes, and a ray that misses
gives NaN. A perfect sphere has closed forms. Other surfaces are met by Newton's method on their level function.

The simulator has its own optics (`render.optics.reflection_point`), which share no mathematics with these.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np

from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.paper_depth import depth_paper, depth_revolved, paper_gradient, revolved_gradient
from phibench.estimator.geometry.status import DepthEstimate
from phibench.scenes.form_error import HARMONICS, Form, Level, gradients_by_parameter, level
from phibench.scenes.frames import Array, Pose, cross
from phibench.scenes.mirror import Mirror, SphereMirror
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.revolved_profile import FormedProfile, Heights, Profile, height_level, lengthening
from phibench.scenes.rig import Rig, View
from phibench.scenes.validation import SceneError

Changes = Mapping[str, tuple[Array | float, Array]]
"""By parameter: of a level function's value, and of its gradient in world axes."""


@dataclass(frozen=True)
class Hit:
    """First hit of unit rays d in the camera frame; vectors (..., 3), scalars (..., 1); `outward` is of any length."""

    d: Array
    t: Array
    P: Array
    n: Array
    cos_i: Array
    sin_i: Array
    outward: Array


class MirrorGeometry(Protocol):
    """One kind of mirror."""

    def first_hit(self, d: Array, pose: Pose) -> Hit:
        """Hit of camera rays (..., 3)."""

    def normal_change(self, P: Array, dP: Array, pose: Pose) -> Array:
        """Change of the unit normal, camera frame, when P (..., 3) moves on the mirror by dP, shape (..., 3, k)."""

    def start_px(self, view: View, X: Array) -> Array:
        """Pixels near those that show world points X (..., 3)."""

    def beyond_rim(self, view: View) -> View:
        """View of a mirror that goes on behind its rim, which Newton's method may pass on its way."""

    def normal_angle(self, share: Array) -> Array:
        """Angle of the normal against the axis at so large a part of the outline's radius."""

    def normal_angle_gradient(self, offset_px: Array, radius_px: float) -> Array:
        """Derivative of `normal_angle` by the pixel at offsets (..., 2) from the middle of an outline of a radius."""

    def place_of_normal(self, n: Array, pose: Pose) -> Array:
        """Places, world, that have these outward unit normals, world; `pose` is the mirror's in the world."""

    def paper_depth(self, phi1_rad: Array, phi2_rad: Array, stroke_m: float) -> DepthEstimate:
        """D by eq. (4)."""

    def paper_gradient(self, phi1_rad: Array, phi2_rad: Array, stroke_m: float) -> Array:
        """Derivative of D by (phi1, phi2), shape (..., 2)."""

    def changing_level(self, P: Array, axes: Array) -> tuple[Level, Changes]:
        """Level function at P (3,), mirror's frame, and its changes by the mirror's own parameters."""


def geometry_of(mirror: Mirror) -> MirrorGeometry:
    """Geometry of a mirror: the one test of its type on the estimator's side."""
    if isinstance(mirror, RevolvedMirror):
        return _Revolved(mirror)
    if isinstance(mirror, SphereMirror):
        return _Round(mirror) if mirror.form is None else _Formed(mirror, mirror.form)
    raise TypeError(f"no geometry of {type(mirror).__name__}: add it to estimator/geometry/mirror_geometry.py")


# Normals by a level function.

_CLOSE_M = 1e-12  # the step of Newton's method after such a one is below rounding


def unit_normal(surface: Level) -> Array:
    """Outward unit normals, shape (..., 3)."""
    return np.asarray(surface.gradient / np.linalg.norm(surface.gradient, axis=-1, keepdims=True))


def normal_slope(surface: Level) -> Array:
    """Derivative of the unit normal by the place, shape (..., 3, 3), 1/m: (I - n n^T) Hess g / |grad g|."""
    n = unit_normal(surface)
    length = np.linalg.norm(surface.gradient, axis=-1)[..., None, None]
    return np.asarray((np.eye(3) - n[..., :, None] * n[..., None, :]) @ surface.hessian_per_m / length)


def _hit_at(mirror: Mirror, d: Array, distance: Array, pose: Pose) -> Hit:
    """Hit after distances (...) along rays (..., 3)."""
    t = distance[..., None]
    P = t * d - pose.t
    n = unit_normal(mirror.level(P @ pose.R)) @ pose.R.T
    cos_i = -np.sum(d * n, axis=-1, keepdims=True)
    return Hit(d, t, P, n, cos_i, np.linalg.norm(cross(d, n), axis=-1, keepdims=True), n)


# Sphere.

_HALVING_ROUNDS = 4  # the error of the start falls by R / distance in each


@dataclass(frozen=True)
class _Round:
    mirror: SphereMirror

    def first_hit(self, d: Array, pose: Pose) -> Hit:
        s, radius = pose.t, self.mirror.radius_m
        b = np.sum(d * s, axis=-1, keepdims=True)
        miss2 = np.sum(cross(d, s) ** 2, axis=-1, keepdims=True)  # squared distance of the ray from the centre
        # NaN where the line misses; one that hits does so ahead, because a Rig has its whole sphere before the camera
        root = np.sqrt(radius**2 - miss2)
        # t^2 - 2 b t + c = 0; the near root b - root loses digits, c / (b + root) does not
        t = (s @ s - radius**2) / (b + root)
        P = t * d - s
        return Hit(d, t, P, P / radius, root / radius, np.sqrt(miss2) / radius, P)

    def normal_change(self, P: Array, dP: Array, pose: Pose) -> Array:
        return dP / self.mirror.radius_m

    def start_px(self, view: View, X: Array) -> Array:
        """Pixel of the point whose normal halves the angle between camera and point."""
        S, C, R = view.sphere_centre_m, view.camera_centre_m, self.mirror.radius_m
        P = np.broadcast_to(S, X.shape)
        for _ in range(_HALVING_ROUNDS):
            n = _unit(C - P) + _unit(X - P)
            P = S + R * _unit(n)
        T = view.T_world_camera
        return view.rig.camera.project((P - T.t) @ T.R)

    def beyond_rim(self, view: View) -> View:
        return view

    def normal_angle(self, share: Array) -> Array:
        return np.asarray(np.arcsin(share))

    def normal_angle_gradient(self, offset_px: Array, radius_px: float) -> Array:
        r2 = np.sum(offset_px * offset_px, axis=-1, keepdims=True)
        return np.asarray(offset_px / np.sqrt(r2 * (radius_px**2 - r2)))

    def place_of_normal(self, n: Array, pose: Pose) -> Array:
        return np.asarray(pose.t + self.mirror.radius_m * n)

    def paper_depth(self, phi1_rad: Array, phi2_rad: Array, stroke_m: float) -> DepthEstimate:
        return depth_paper(phi1_rad, phi2_rad, stroke_m, self.mirror.radius_m)

    def paper_gradient(self, phi1_rad: Array, phi2_rad: Array, stroke_m: float) -> Array:
        return paper_gradient(phi1_rad, phi2_rad, stroke_m, self.mirror.radius_m)

    def changing_level(self, P: Array, axes: Array) -> tuple[Level, Changes]:
        values, gradients = gradients_by_parameter(P)
        by_form = zip(HARMONICS, zip(-values, -gradients @ axes.T, strict=True), strict=True)
        return self.mirror.level(P), {**dict(by_form), "radius_m": (-1.0, np.zeros(3))}


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


# Sphere with a form error: of a perfect one but for its rays.

_NEAREST_STEPS = 4  # Newton's, from the foot of the perpendicular: the form's slope, 1e-3, falls to its square in each
_STEPS = 12  # Newton's, from a sphere's place that the form moves little; it ends at `_CLOSE_M`


@dataclass(frozen=True)
class _Formed(_Round):
    form: Form

    def first_hit(self, d: Array, pose: Pose) -> Hit:
        return _hit_at(
            self.mirror, d, first_meeting(-pose.t @ pose.R, d @ pose.R, self.mirror.radius_m, self.form), pose
        )

    def normal_change(self, P: Array, dP: Array, pose: Pose) -> Array:
        return pose.R @ normal_slope(self.mirror.level(P @ pose.R)) @ pose.R.T @ dP


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


def _along(origin_m: Array, directions: Array, t: Array, radius_m: float, form: Form) -> tuple[Array, Array, Array]:
    """g and its first two derivatives along the ray, shape (...)."""
    at = level(origin_m + t[..., None] * directions, radius_m, form)
    slope = np.sum(at.gradient * directions, axis=-1)
    curvature = np.einsum("...i,...ij,...j->...", directions, at.hessian_per_m, directions)
    return at.value_m, slope, curvature


# Mirror of revolution.

_HALVINGS = 40  # of the rim's diameter: the place is known to 1e-13 m
_WIDER = (1.2, 1.1, 1.05, 1.02, 1.01)  # times the rim's radius
_UNEVEN = 0.999  # so that no middle is on the axis, where a cone has its tip
_CONVEX_STEPS = 60  # 6 to 9 do; each step of a ray that grazes halves what is left
_AROUND = 1.1  # of the rim: as far as a ray may enter beside it


@dataclass(frozen=True)
class _Revolved:
    mirror: RevolvedMirror

    def first_hit(self, d: Array, pose: Pose) -> Hit:
        lens, ways, mirror = -pose.t @ pose.R, d @ pose.R, self.mirror
        plain = mirror.form is None
        t = profile_meeting(lens, ways, mirror.profile) if plain else formed_meeting(lens, ways, mirror.surface)
        return _hit_at(mirror, d, t, pose)

    def normal_change(self, P: Array, dP: Array, pose: Pose) -> Array:
        return pose.R @ normal_slope(self.mirror.level(P @ pose.R)) @ pose.R.T @ dP

    def start_px(self, view: View, X: Array) -> Array:
        """Pixel of the point of the profile, in the meridian of X, from where the reflected ray goes to X.

        The camera is moved into the meridian; on the axis it lies in all of them. From the axis to the rim the ray
        turns from straight down outwards, and passes X once: bisection finds where.
        """
        profile, pose = self.mirror.profile, view.T_world_sphere.inverse()
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

    def beyond_rim(self, view: View) -> View:
        return replace(view, rig=_wider(view.rig, self.mirror))

    def normal_angle(self, share: Array) -> Array:
        r = share * self.mirror.profile.rim_radius_m
        return np.asarray(np.arctan(2.0 * r * self.mirror.profile.sag(r * r).slope_per_m))

    def normal_angle_gradient(self, offset_px: Array, radius_px: float) -> Array:
        r2 = np.sum(offset_px * offset_px, axis=-1, keepdims=True)
        scale = self.mirror.profile.rim_radius_m / radius_px
        s = r2 * scale * scale
        sag = self.mirror.profile.sag(s)
        steeper = (2.0 * sag.slope_per_m + 4.0 * s * sag.bend_per_m3) / (1.0 + 4.0 * s * sag.slope_per_m**2)
        return np.asarray(offset_px / np.sqrt(r2) * scale * steeper)

    def place_of_normal(self, n: Array, pose: Pose) -> Array:
        profile, n = self.mirror.profile, n @ pose.R
        if profile.shape == "cone":
            raise DatasetError(
                "a panorama by the truth layer needs a mirror whose normal tells the place on it, and a cone has the "
                "same slope everywhere: use the model (--by model)"
            )
        across = np.hypot(n[..., 0], n[..., 1])
        r = profile.radius_at_slope(-across / n[..., 2])
        share = r / np.maximum(across, 1e-300)  # at the vertex 0 / 0: r is 0 as well
        return pose.points(np.stack([share * n[..., 0], share * n[..., 1], profile.sag(r * r).z_m], axis=-1))

    def paper_depth(self, phi1_rad: Array, phi2_rad: Array, stroke_m: float) -> DepthEstimate:
        return depth_revolved(phi1_rad, phi2_rad, stroke_m, self.mirror.profile)

    def paper_gradient(self, phi1_rad: Array, phi2_rad: Array, stroke_m: float) -> Array:
        return revolved_gradient(phi1_rad, phi2_rad, stroke_m, self.mirror.profile)

    def changing_level(self, P: Array, axes: Array) -> tuple[Level, Changes]:
        changes = _height_changes(self.mirror, P).items()
        world = {name: (value, axes @ gradient) for name, (value, gradient) in changes}
        return height_level(self.mirror.surface, P), world


@lru_cache(maxsize=64)
def _wider(rig: Rig, mirror: RevolvedMirror) -> Rig:
    profile = mirror.profile
    for factor in _WIDER:
        with suppress(SceneError):  # folds, is no longer convex, or meets its holder
            wide = replace(profile, rim_radius_m=factor * profile.rim_radius_m)
            return replace(rig, mirror=replace(mirror, profile=wide))
    return rig


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


def formed_meeting(origin_m: Array, directions: Array, surface: Profile | FormedProfile) -> Array:
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


def _height_changes(mirror: RevolvedMirror, P: Array) -> dict[str, tuple[Array, Array]]:
    """Changes of z(x, y) - z and of its gradient at P, mirror's frame, by the peaks of a form and the vertex radius.

    z = sag - h N is linear in the peaks. With w of the sag, dsag/dR = -s / (w (R + w)); N changes with sag'.
    """
    profile, (x, y) = mirror.profile, P[:2]
    if profile.shape == "cone":
        return {}
    disc_m, across, s = mirror.form_radius_m or profile.rim_radius_m, np.array([x, y, 0.0]), x * x + y * y
    N, N_s, _ = lengthening(profile, s)

    def raised(h: Heights, N: Array, N_s: Array) -> tuple[Array, Array]:
        """Value and gradient of -h N."""
        return -h.z_m * N, -np.array([h.x, h.y, 0.0]) * N - 2.0 * h.z_m * N_s * across

    changes = {
        name: raised(FormedProfile(profile, Form(**{name: 1.0}), disc_m).deviation(x, y), N, N_s) for name in HARMONICS
    }
    R, A, sag = profile.vertex_radius_m, 1.0 + profile.conic, profile.sag(s)
    w, p, p_s = np.sqrt(R * R - A * s), sag.slope_per_m, sag.bend_per_m3
    q, q_s = -0.5 * R / w**3, -0.75 * R * A / w**5  # change of p = sag' by R, and its own by s
    turned = 4.0 * s * p * q / N
    turned_s = (4.0 * p * q + 4.0 * s * (p_s * q + p * q_s) - turned * N_s) / N
    value, gradient = raised(FormedProfile(profile, mirror.form or Form(), disc_m).deviation(x, y), turned, turned_s)
    changes["radius_m"] = value - s / (w * (R + w)), gradient + 2.0 * q * across
    return changes
