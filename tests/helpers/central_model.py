"""Central model of an omnidirectional camera, for comparison: one viewpoint for all rays.

C. Mei and P. Rives, "Single view point omnidirectional camera calibration from planar grids", ICRA 2007, as in
OpenCV's omnidir: a point is put on the unit sphere, moved by xi along the axis, projected, distorted by k1, k2, p1 and
p2, and scaled. For a round rig p1 and p2 stay 0, and the axis upright. Only a hyperboloid with the lens in its focus
has a single viewpoint; under other mirrors the rays touch a caustic. This module measures the cost in depth.

Frame: z points from the mirror down to the camera, x and y as in the image. A point above the mirror has z < 0 and is
imaged far from the centre.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from phibench.estimator.geometry.reflection import image_of, reflect
from phibench.scenes.frames import Array, rotation_xyz
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.rig import Rig

_FLIP = np.array([1.0, 1.0, -1.0])  # a mirror changes the hand: world up is away from the camera


@dataclass(frozen=True)
class CentralModel:
    """A unified camera.

    Parameters
    ----------
    xi, f_px, cx_px, cy_px, k1, k2 : float
    viewpoint_world_m : shape (3,)
        At the down position.
    rms_px : float
        What the fit left.
    p1, p2 : float
    turn_rad : 2 floats
        Of the model's axis, about world x and then y.
    """

    xi: float
    f_px: float
    cx_px: float
    cy_px: float
    k1: float
    k2: float
    viewpoint_world_m: Array
    rms_px: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    turn_rad: tuple[float, float] = (0.0, 0.0)

    @property
    def axes(self) -> Array:
        """Axes of the model as columns, world, shape (3, 3), but for the flip of z."""
        return np.array(rotation_xyz(*self.turn_rad))

    def project(self, points_world_m: Array) -> Array:
        """Pixels, shape (..., 2), of world points, shape (..., 3)."""
        xy = unified((np.asarray(points_world_m) - self.viewpoint_world_m) @ self.axes * _FLIP, self.xi)
        centre = np.array([self.cx_px, self.cy_px])
        return np.asarray(self.f_px * self._distorted(xy) + centre)

    def _distorted(self, xy: Array) -> Array:
        x, y = xy[..., :1], xy[..., 1:]
        r2 = x * x + y * y
        along_x = 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x)
        along_y = self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y
        aside = np.concatenate([along_x, along_y], axis=-1)
        return np.asarray(xy * (1.0 + r2 * (self.k1 + r2 * self.k2)) + aside)

    def ray(self, uv_px: Array) -> Array:
        """Unit directions from the viewpoint, world, shape (..., 3), of pixels (..., 2)."""
        wanted = (np.asarray(uv_px, float) - [self.cx_px, self.cy_px]) / self.f_px
        xy = wanted
        for _ in range(_UNDISTORTIONS):
            xy = xy + wanted - self._distorted(xy)
        r2 = np.sum(xy * xy, axis=-1, keepdims=True)
        scale = (self.xi + np.sqrt(1.0 + (1.0 - self.xi**2) * r2)) / (1.0 + r2)
        on_sphere = np.concatenate([scale * xy, scale - self.xi], axis=-1)
        return np.asarray((on_sphere * _FLIP) @ self.axes.T)


_UNDISTORTIONS = 200  # distortion is some per cent: each gains two digits at the image's edge, at least one


def unified(points: Array, xi: float) -> Array:
    """Normalised coordinates (x, y) / (z + xi) of points on the unit sphere, shape (..., 2), of points (..., 3)."""
    X = points / np.linalg.norm(points, axis=-1, keepdims=True)
    return np.asarray(X[..., :2] / (X[..., 2:] + xi))


def fit_central(
    rig: Rig, distance_m: float = 2.0, theta_deg: tuple[float, float] = (40.0, 120.0), is_round: bool = True
) -> CentralModel:
    """Fit the model to the exact pixel-ray pairs of a rig, with points at a distance from the axis.

    Parameters
    ----------
    rig : Rig
    distance_m : float
        Horizontal distance at which the model is asked to be right.
    theta_deg : 2 floats
        Range of the rays' angle from the downward vertical.
    is_round : bool
        The viewpoint is above the lens, the axis upright, and p1 = p2 = 0; otherwise all are fitted.
    """
    uv, points = _pairs(rig, distance_m, theta_deg)
    centre, mirror = rig.at(0.0).sphere_centre_m, rig.mirror
    size_m = mirror.profile.rim_radius_m if isinstance(mirror, RevolvedMirror) else mirror.radius_m
    outline_px = float(np.ptp(rig.outline_px(), axis=0).mean()) / 2.0

    def model(x: Array) -> CentralModel:
        aside = (x[7], x[8]) if len(x) > _ROUND else (0.0, 0.0)
        viewpoint = centre + size_m * np.array([*aside, x[6]])
        more = {} if len(x) == _ROUND else {"p1": x[9], "p2": x[10], "turn_rad": (x[11], x[12])}
        return CentralModel(x[0], x[1] * outline_px, x[2], x[3], x[4], x[5], viewpoint, **more)

    def residuals(x: Array) -> Array:
        return np.asarray((model(x).project(points) - uv).ravel())

    count = _ROUND if is_round else len(_START)
    start = np.array(_START)[:count]
    start[2:4] = rig.camera.cx_px, rig.camera.cy_px
    limits, scale = (np.array(_LOW)[:count], np.array(_HIGH)[:count]), np.array(_SCALE)[:count]
    ends = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    found = optimize.least_squares(residuals, start, bounds=limits, x_scale=scale, max_nfev=1000, **ends)
    return replace(model(found.x), rms_px=float(np.sqrt(np.mean(found.fun**2))))


_ROUND = 7  # parameters of a round rig: xi, f, cx, cy, k1, k2, height of the viewpoint; the others follow
_START = (1.5, 1.6, 0.0, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
# a direction of 120 degrees has an image for xi above 0.5; the viewpoint is in or near the mirror
_LOW = (0.6, 0.1, -np.inf, -np.inf, -2.0, -2.0, -4.0, -1.0, -1.0, -1.0, -1.0, -0.5, -0.5)
_HIGH = (9.0, 9.0, np.inf, np.inf, 2.0, 2.0, 4.0, 1.0, 1.0, 1.0, 1.0, 0.5, 0.5)
_SCALE = (0.1, 0.1, 1.0, 1.0, 0.01, 0.01, 0.1, 0.1, 0.1, 0.01, 0.01, 0.01, 0.01)


def depth_central(rig: Rig, model: CentralModel, stroke_m: float, uv_down_px: Array, uv_up_px: Array) -> float:
    """Horizontal distance from the mirror's axis of where the model's two rays meet, metres.

    They pass each other where the model is wrong: the middle of their shortest connection counts.
    """
    r1, r2 = model.ray(uv_down_px), model.ray(uv_up_px)
    base = stroke_m * np.array(rig.stroke_axis_world)
    c = float(r1 @ r2)
    t1, t2 = np.linalg.solve(np.array([[1.0, -c], [c, -1.0]]), np.array([base @ r1, base @ r2]))
    middle = model.viewpoint_world_m + 0.5 * (t1 * r1 + base + t2 * r2)
    return float(np.hypot(*(middle - rig.at(0.0).sphere_centre_m)[:2]))


def error_by_distance(rig: Rig, model: CentralModel, stroke_m: float, height_m: float, depths_m: Array) -> Array:
    """Relative depth errors, shape of `depths_m`, of the model for spots that the rig sees exactly, or NaN."""
    centre, errors = rig.at(0.0).sphere_centre_m, []
    for depth in depths_m:
        point = np.array([[centre[0] + depth, centre[1], height_m]])
        down, up = (image_of(rig.at(offset_m), point).uv_px[0] for offset_m in (0.0, stroke_m))
        errors.append(depth_central(rig, model, stroke_m, down, up) / depth - 1.0)
    return np.array(errors)


def _pairs(rig: Rig, distance_m: float, theta_deg: tuple[float, float]) -> tuple[Array, Array]:
    """Pixels, shape (n, 2), and the world points, (n, 3), at `distance_m` that they see."""
    centre = rig.outline_px().mean(axis=0)
    radius = 0.5 * float(np.ptp(rig.outline_px(), axis=0).mean())
    r, turn = np.meshgrid(np.linspace(0.1, 0.99, 60) * radius, np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False))
    uv = centre + np.stack([r * np.cos(turn), r * np.sin(turn)], axis=-1).reshape(-1, 2)
    rays = reflect(rig.at(0.0), uv)
    d, P = rays.direction_world, rays.origin_world_m - rig.at(0.0).sphere_centre_m
    theta = np.degrees(np.arctan2(np.hypot(d[:, 0], d[:, 1]), -d[:, 2]))
    good = (theta > theta_deg[0]) & (theta < theta_deg[1])
    flat2, along = np.sum(d[:, :2] ** 2, axis=-1), np.sum(d[:, :2] * P[:, :2], axis=-1)
    t = (-along + np.sqrt(along**2 - flat2 * (np.sum(P[:, :2] ** 2, axis=-1) - distance_m**2))) / flat2
    return uv[good], (rays.origin_world_m + t[:, None] * d)[good]
