"""Field of view of a mirror: rays along a meridian, resolution, viewpoints, and the robot in the image.

The rig is aligned, so that one meridian of the image stands for all. theta is the angle of a ray that leaves the mirror
from straight down. With the ray r(u) at the radius u of the image and r = (sin theta, 0, -cos theta),

    d theta / du = (r_x r_z' - r_z r_x')    (a prime is d / du; `reflect_jacobian` has it analytically),

and the resolution is its inverse. The ray's line meets the mirror's axis at the height z - x r_z / r_x: the viewpoint
of a central camera, and a different one for each ray of any other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phibench.estimator.geometry.line_of_sight import blocked_segments
from phibench.estimator.geometry.reflection import reflect, reflect_jacobian
from phibench.estimator.geometry.status import Status
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig
from phibench.scenes.room import escalade360

_FIRST_PX = 1.0  # a ray on the axis has no azimuth, and a cone has its tip there
_STEP_PX = 0.25  # of the radius: a mirror's edges are found to a quarter of a pixel
_INSIDE_PX = 1e-3  # of the outline, where a ray still hits the mirror
_REACH_M = 20.0  # beyond every part of the robot


@dataclass(frozen=True)
class Meridian:
    """Rays of the pixels along one radius of the image, shape (n,).

    Attributes
    ----------
    radius_px : array
        From the image of the mirror's axis, rising to the outline.
    theta_rad : array
    px_per_rad : array
        Pixels of the radius per radian of theta.
    viewpoint_m : array
        Height over the vertex, away from the camera, at which the ray's line meets the mirror's axis.
    """

    radius_px: Array
    theta_rad: Array
    px_per_rad: Array
    viewpoint_m: Array

    def at(self, theta_deg: float, values: Array) -> float:
        """Value at an angle, linear between rays; NaN where no ray has it."""
        theta = np.degrees(self.theta_rad)
        return float(np.interp(theta_deg, theta, values, left=np.nan, right=np.nan))

    def field_deg(self, margin_px: float = 0.0) -> tuple[float, float]:
        """Least and largest theta in degrees, up to a margin inside the outline."""
        last = float(np.interp(self.radius_px[-1] - margin_px, self.radius_px, np.degrees(self.theta_rad)))
        return float(np.degrees(self.theta_rad[0])), last

    def viewpoint_spread_m(self, band_deg: Sequence[float], margin_px: float) -> float:
        """Distance between the lowest and the highest viewpoint of a band of theta; NaN where no ray is in it."""
        theta = np.degrees(self.theta_rad)
        inside = (theta >= band_deg[0]) & (theta <= band_deg[1]) & (self.radius_px <= self.radius_px[-1] - margin_px)
        return float(np.ptp(self.viewpoint_m[inside])) if inside.any() else float("nan")


def outline_radius_px(rig: Rig) -> float:
    """Radius of the mirror's outline in the image of an aligned rig."""
    return float(np.linalg.norm(rig.outline_px(4)[0] - rig.camera.project(rig.sphere_in_camera_m)))


def meridian(rig: Rig) -> Meridian:
    """Rays along world +x of an aligned rig at the down position."""
    rim = outline_radius_px(rig) - _INSIDE_PX
    radius = np.append(np.arange(_FIRST_PX, rim, _STEP_PX), rim)
    uv = rig.camera.project(rig.sphere_in_camera_m) + radius[:, None] * np.array([1.0, 0.0])
    view = rig.at(0.0)
    ray, slope = reflect(view, uv), reflect_jacobian(view, uv).direction_per_px[..., 0]
    d = ray.direction_world
    theta = np.unwrap(np.arctan2(d[:, 0], -d[:, 2]))
    per_px = d[:, 0] * slope[:, 2] - d[:, 2] * slope[:, 0]
    place = ray.origin_world_m - view.sphere_centre_m
    with np.errstate(divide="ignore"):  # a ray straight down meets the axis nowhere
        above = place[:, 2] - place[:, 0] * d[:, 2] / d[:, 0]
    seen = (ray.status == Status.OK) & np.isfinite(per_px)
    # places count from the vertex: a sphere's frame has its origin in the centre
    return Meridian(radius[seen], theta[seen], 1.0 / per_px[seen], (above + (rig.mirror.radius_m or 0.0))[seen])


@dataclass(frozen=True)
class DiscShares:
    """Shares of the mirror's image by what its pixels show, which add up to 1.

    Attributes
    ----------
    robot : float
        Robot, mast and camera's housing.
    below_horizon, above_horizon : float
        The room, of what the robot leaves.
    robot_theta_deg : (least, largest) of all azimuths
        Angle from straight down up to which the robot is seen in the direction.
    """

    robot: float
    below_horizon: float
    above_horizon: float
    robot_theta_deg: tuple[float, float]


def disc_shares(rig: Rig, rays: Meridian, offset_m: float, azimuths_rad: Array) -> DiscShares:
    """Shares of the mirror's image by what its pixels show, for an aligned rig at an offset of its carriage.

    Parameters
    ----------
    rays : its meridian
    azimuths_rad : shape (a,), even steps over the half circle or the circle; first and last count half
    """
    hidden = np.stack([_robot_seen(rig, rays, offset_m, float(a)) for a in azimuths_rad])
    weight = np.full(len(azimuths_rad), 1.0)
    if len(weight) > 1:
        weight[[0, -1]] = 0.5
    share = np.average(hidden, axis=0, weights=weight)
    ring = rays.radius_px * np.gradient(rays.radius_px)
    ring = ring / ring.sum()
    below = np.cos(rays.theta_rad) > 0.0
    theta = np.degrees(rays.theta_rad)
    last = [float(theta[row].max()) if row.any() else float("nan") for row in hidden]
    robot = float(np.sum(ring * share))
    low = float(np.sum(ring * (1.0 - share) * below))
    return DiscShares(robot, low, 1.0 - robot - low, (min(last), max(last)))


def _robot_seen(rig: Rig, rays: Meridian, offset_m: float, azimuth_rad: float) -> BoolArray:
    """Rays of the meridian at an azimuth that end at the robot, shape (n,)."""
    view = rig.at(offset_m)
    across = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad)])
    uv = rig.camera.project(rig.sphere_in_camera_m) + rays.radius_px[:, None] * across
    ray = reflect(view, uv)
    end = ray.origin_world_m + _REACH_M * ray.direction_world
    return np.asarray(np.any([blocked_segments(solid, ray.origin_world_m, end) for solid in escalade360(view)], axis=0))
