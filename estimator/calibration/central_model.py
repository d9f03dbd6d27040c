"""Central model of an omnidirectional camera, for comparison: one viewpoint for all rays.

C. Mei and P. Rives, "Single view point omnidirectional camera calibration from planar grids", ICRA 2007, as in
OpenCV's omnidir: a point is put on the unit sphere, moved by xi along the axis, projected, distorted by k1 and k2, and
scaled. p1 and p2 stay 0, because the fitted rig is round. A camera under a sphere has no single viewpoint: its rays
touch a caustic. This module measures the cost in depth.

Frame: z points from the mirror down to the camera, x and y as in the image. A point above the mirror has z < 0 and is
imaged far from the centre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize

from phibench.estimator.calibration.bundle import seen_at
from phibench.estimator.geometry.reflection import reflect
from phibench.scenes.frames import Array
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
    """

    xi: float
    f_px: float
    cx_px: float
    cy_px: float
    k1: float
    k2: float
    viewpoint_world_m: Array
    rms_px: float = 0.0

    def project(self, points_world_m: Array) -> Array:
        """Pixels, shape (..., 2), of world points, shape (..., 3)."""
        xy = unified((np.asarray(points_world_m) - self.viewpoint_world_m) * _FLIP, self.xi)
        r2 = np.sum(xy * xy, axis=-1, keepdims=True)
        centre = np.array([self.cx_px, self.cy_px])
        return np.asarray(self.f_px * xy * (1.0 + r2 * (self.k1 + r2 * self.k2)) + centre)

    def elevation(self, points_world_m: Array) -> Array:
        """Angle from the downward vertical, shape (...), of points seen from the viewpoint, radians."""
        d = np.asarray(points_world_m) - self.viewpoint_world_m
        return np.arctan2(np.hypot(d[..., 0], d[..., 1]), -d[..., 2])


def unified(points: Array, xi: float) -> Array:
    """Normalised coordinates (x, y) / (z + xi) of points on the unit sphere, shape (..., 2), of points (..., 3)."""
    X = points / np.linalg.norm(points, axis=-1, keepdims=True)
    return np.asarray(X[..., :2] / (X[..., 2:] + xi))


def fit_central(rig: Rig, distance_m: float = 2.0, theta_deg: tuple[float, float] = (40.0, 120.0)) -> CentralModel:
    """Fit the model to the exact pixel-ray pairs of a rig, with points at a distance from the axis.

    Parameters
    ----------
    rig : Rig
        Upright: without tilt.
    distance_m : float
        Horizontal distance at which the model is asked to be right.
    theta_deg : 2 floats
        Range of the rays' angle from the downward vertical.
    """
    uv, points = _pairs(rig, distance_m, theta_deg)
    centre = rig.at(0.0).sphere_centre_m
    outline_px = float(np.ptp(rig.outline_px(), axis=0).mean()) / 2.0

    def model(x: Array) -> CentralModel:
        up = centre + np.array([0.0, 0.0, x[6] * rig.sphere.radius_m])
        return CentralModel(x[0], x[1] * outline_px, x[2], x[3], x[4], x[5], up)

    def residuals(x: Array) -> Array:
        return np.asarray((model(x).project(points) - uv).ravel())

    start = np.array([1.5, 1.6, rig.camera.cx_px, rig.camera.cy_px, 0.0, 0.0, -0.5])
    # xi below 1 has directions without an image; the viewpoint is in or near the ball
    low = [1.0, 0.1, -np.inf, -np.inf, -2.0, -2.0, -2.0]
    high = [9.0, 9.0, np.inf, np.inf, 2.0, 2.0, 2.0]
    scale = [0.1, 0.1, 1.0, 1.0, 0.01, 0.01, 0.1]
    found = optimize.least_squares(residuals, start, bounds=(low, high), x_scale=scale, max_nfev=1000)
    best = model(found.x)
    return CentralModel(
        best.xi,
        best.f_px,
        best.cx_px,
        best.cy_px,
        best.k1,
        best.k2,
        best.viewpoint_world_m,
        float(np.sqrt(np.mean(found.fun**2))),
    )


def depth_central(model: CentralModel, stroke_m: float, uv_down_px: Array, uv_up_px: Array) -> float:
    """Depth from two pixels on one radius: where the model's two rays meet in the vertical plane, metres."""
    down, up = (_theta(model, float(np.linalg.norm(uv - [model.cx_px, model.cy_px]))) for uv in (uv_down_px, uv_up_px))
    # rays from (0, 0) and (0, h): D = h tan t1 tan t2 / (tan t1 - tan t2), regular at 90 degrees
    return float(stroke_m * np.sin(down) * np.sin(up) / np.sin(down - up))


def error_by_distance(rig: Rig, model: CentralModel, stroke_m: float, height_m: float, depths_m: Array) -> Array:
    """Relative depth errors, shape of `depths_m`, of the model for spots seen by the rig exactly."""
    centre, errors = rig.at(0.0).sphere_centre_m, []
    for depth in depths_m:
        point = np.array([[centre[0] + depth, centre[1], height_m]])
        start = model.project(point)
        down = seen_at(rig.at(0.0), point, start)[0]
        up = seen_at(rig.at(0.0), point - stroke_m * np.array(rig.stroke_axis_world), start)[0]
        errors.append(depth_central(model, stroke_m, down, up) / depth - 1.0)
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


def _theta(model: CentralModel, radius_px: float) -> float:
    """Angle from the downward vertical of the model's ray at a distance from the image's centre."""

    def off(theta: float) -> float:
        point = model.viewpoint_world_m + np.array([np.sin(theta), 0.0, -np.cos(theta)])
        return float(model.project(point)[0] - model.cx_px - radius_px)

    return float(optimize.brentq(off, 1e-6, np.radians(150.0), xtol=1e-14))
