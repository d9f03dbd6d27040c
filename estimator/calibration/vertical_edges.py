"""The world's vertical in the camera frame, from vertical edges of the room in the mirror.

The paper's own check of the alignment is that all vertical edges go through the image's centre (section 5). Here the
check becomes a measurement. A vertical edge is the line p + t n: n the vertical, common to all edges, p its foot. Every
pixel (u, v) on its image has a reflected ray (o, r), which meets the line where

    (p - o) . (n x r) = 0.

A sphere has no single viewpoint, so that o differs from ray to ray. Unknown are n (2 numbers) and each edge's azimuth and
inverse distance (2 numbers); the latter is next to nothing for an aligned rig and has a wide prior. Residuals are
distances from the edge's image in pixels, to first order. Frames: everything in the camera frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.calibration.bundle import Measured
from phibench.estimator.calibration.edge_points import edges_of
from phibench.estimator.calibration.limb_image import ImageError, planes_of
from phibench.estimator.calibration.outline_start import grey
from phibench.estimator.reflection import reflect, reflect_jacobian
from phibench.scenes.frames import Array, Pose
from phibench.scenes.rig import Rig

MIN_EDGES = 3
MAX_TILT_RAD = 0.05
"""How far the vertical may be from the believed one; farther ones are other lines of the room."""
_PER_M = (0.35, 0.3)  # mean and standard deviation of an edge's inverse distance
_SLOPE_LIMIT_RAD = 4e-3  # of an edge's slope against the others' vertical, before scatter is known
_CUT = 4.0
_ROUNDS = 4


@dataclass(frozen=True)
class Vertical:
    """The vertical that edges give.

    Attributes
    ----------
    up : shape (3,), unit vector in the camera frame
    covariance : shape (2, 2)
        Of its x and y; for camera and sphere as given.
    edges, points : int
        Edges that were used, and their points.
    residual_px : float
        Root mean square distance of the points from their edges.
    """

    up: Array
    covariance: Array
    edges: int
    points: int
    residual_px: float


def find_vertical(
    image: NDArray[Any], rig: Rig, card: SensorCard | None = None, sphere_covariance_m2: Array | None = None
) -> Measured:
    """The world's vertical in the camera frame: x and y of the unit vector, shape (2,), as `bundle.calibrate` takes it.

    Parameters
    ----------
    image : array
        See `limb_image.planes_of`.
    rig : Rig
        Camera as believed and the sphere where its outline is (`Outline.rig`): a sphere that is 4 um off across the
        axis turns the vertical by 0.008 degrees.
    card : SensorCard, optional
        Of the image's preset; none for a layer.
    sphere_covariance_m2 : shape (3, 3), optional
        Of the sphere's centre; its share is added to the covariance.

    Raises
    ------
    ImageError
        If fewer than three edges agree on a vertical within 0.05 rad of the believed one.
    """
    edges = edges_of(grey(planes_of(image, card)), rig)
    found = vertical_of(edges, rig)
    covariance = found.covariance
    if sphere_covariance_m2 is not None:
        slope = _by_sphere(edges, rig, found)
        covariance = covariance + slope @ sphere_covariance_m2 @ slope.T
    return Measured(found.up[:2], covariance)


def vertical_of(edges: Sequence[Array], rig: Rig) -> Vertical:
    """Vertical from the pixels of edges, each of shape (k, 2).

    Raises
    ------
    ImageError
        See `find_vertical`.
    """
    up = rig.T_world_camera.R.T[:, 2]
    rays = [_rays(edge, rig) for edge in edges]
    chosen = _agreeing(rays, up)
    for _ in range(_ROUNDS):
        if len(chosen) < MIN_EDGES:
            raise ImageError(
                f"{len(chosen)} vertical edges were found that agree: {MIN_EDGES} are needed; show the mirror a room with "
                "door frames, corners or shelves, or leave the vertical out"
            )
        kept = [rays[k] for k in chosen]
        up, slopes, covariance, rms_px = _solved(kept, up)
        size = np.abs(slopes) / max(1.4826 * float(np.median(np.abs(slopes))), 1e-12)
        if np.all(size < _CUT) or len(chosen) == MIN_EDGES:
            break
        chosen = [k for k, off in zip(chosen, size, strict=True) if off < _CUT]
    return Vertical(up, covariance, len(kept), sum(len(r.origin_m) for r in kept), rms_px)


@dataclass(frozen=True)
class EdgeRays:
    """Reflected rays of an edge's pixels, relative to the sphere centre, camera frame; derivatives by the pixel."""

    origin_m: Array
    direction: Array
    origin_m_per_px: Array
    direction_per_px: Array


def _rays(uv_px: Array, rig: Rig) -> EdgeRays:
    view = replace(rig, T_world_camera=Pose("world", "camera")).at(0.0)
    ray, slope = reflect(view, uv_px), reflect_jacobian(view, uv_px)
    origin = ray.origin_world_m - view.sphere_centre_m
    return EdgeRays(origin, ray.direction_world, slope.origin_m_per_px, slope.direction_per_px)


def _horizontal(up: Array) -> tuple[Array, Array]:
    """Two unit vectors across `up`, near the camera's x and y."""
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    x = x / np.linalg.norm(x)
    return x, np.cross(up, x)


def _azimuth_and_slope(rays: EdgeRays, up: Array) -> tuple[float, float, float]:
    """Azimuth of an edge at the usual distance, its slope along the azimuth, radians, and that slope's weight."""
    x, y = _horizontal(up)
    a, b = rays.direction @ x, rays.direction @ y
    t = (1.0 / _PER_M[0] - np.hypot(rays.origin_m @ x, rays.origin_m @ y)) / np.hypot(a, b)
    point = rays.origin_m + t[:, None] * rays.direction
    azimuth = float(np.arctan2((point @ y).mean(), (point @ x).mean()))
    along, height = point @ (np.cos(azimuth) * y - np.sin(azimuth) * x), point @ up
    centred = height - height.mean()
    return azimuth, float(centred @ along / (centred @ centred)), float(centred @ centred)


def _agreeing(rays: Sequence[EdgeRays], up: Array) -> list[int]:
    """Numbers of the edges whose slopes belong to one vertical near `up`: the pair that most others agree with."""
    if len(rays) < MIN_EDGES:
        return list(range(len(rays)))
    azimuth, slope, weight = np.array([_azimuth_and_slope(r, up) for r in rays]).T
    across = np.stack([-np.sin(azimuth), np.cos(azimuth)], axis=-1)
    i, j = np.triu_indices(len(rays), 1)
    sine = across[i, 0] * across[j, 1] - across[i, 1] * across[j, 0]
    i, j, sine = i[np.abs(sine) > 0.3], j[np.abs(sine) > 0.3], sine[np.abs(sine) > 0.3]
    tilt = np.stack([slope[i] * across[j, 1] - slope[j] * across[i, 1], slope[j] * across[i, 0] - slope[i] * across[j, 0]])
    tilt = (tilt / sine).T[np.linalg.norm(tilt / sine, axis=0) < MAX_TILT_RAD]
    if not len(tilt):
        return []
    off = np.abs(slope - tilt @ across.T)
    score = np.sum(np.sqrt(weight) * np.clip(1.0 - (off / _SLOPE_LIMIT_RAD) ** 2, 0.0, None), axis=-1)
    return [int(k) for k in np.flatnonzero(off[np.argmax(score)] < _SLOPE_LIMIT_RAD)]


def _solved(rays: Sequence[EdgeRays], up: Array) -> tuple[Array, Array, Array, float]:
    """Vertical, slopes of the edges against it, covariance of its x and y, and rms distance in pixels."""
    x, y = _horizontal(up)
    start = [0.0, 0.0]
    for edge in rays:
        start += [_azimuth_and_slope(edge, up)[0], 0.0]

    def distances(theta: Array) -> list[Array]:
        n = up + theta[0] * x + theta[1] * y
        n = n / np.linalg.norm(n)
        return [_distance_px(edge, n, *theta[2 + 2 * k : 4 + 2 * k]) for k, edge in enumerate(rays)]

    def residuals(theta: Array) -> Array:
        return np.concatenate([*distances(theta), theta[3::2]])

    found = optimize.least_squares(residuals, np.array(start), x_scale="jac", loss="soft_l1", f_scale=0.3)
    tilt = found.x[:2]
    n = up + tilt[0] * x + tilt[1] * y
    n = n / np.linalg.norm(n)
    slopes, covariance = _scatter(rays, n)
    parts = np.concatenate(distances(found.x))
    return n, slopes, covariance, float(np.sqrt(np.mean(parts**2)))


def _distance_px(rays: EdgeRays, n: Array, azimuth_rad: float, nearness: float) -> Array:
    """Distance of pixels from the image of a vertical line, shape (k,), pixels; `nearness` in prior sigmas."""
    x, y = _horizontal(n)
    foot = np.cos(azimuth_rad) * x + np.sin(azimuth_rad) * y
    per_m = np.abs(_PER_M[0] + _PER_M[1] * nearness)
    gap = foot - per_m * rays.origin_m  # (p - o) / |p|
    across = np.cross(n, rays.direction)
    value = np.sum(gap * across, axis=-1)
    by_px = np.einsum("ki,kij->kj", gap, np.cross(n, rays.direction_per_px, axisb=1, axisc=1))
    by_px = by_px - per_m * np.einsum("ki,kij->kj", across, rays.origin_m_per_px)
    return np.asarray(value / np.linalg.norm(by_px, axis=-1))


def _scatter(rays: Sequence[EdgeRays], n: Array) -> tuple[Array, Array]:
    """Slopes of the edges against the vertical, and its covariance from their scatter.

    An edge's points are wrong together (its neighbourhood, JPEG's blocks): what counts is how well edges agree. Slopes
    are fitted with the points' weights; two degrees of freedom are the vertical's own.
    """
    azimuth, slope, weight = np.array([_azimuth_and_slope(edge, n) for edge in rays]).T
    x, y = _horizontal(n)
    across = np.stack([-np.sin(azimuth), np.cos(azimuth)], axis=-1) @ np.stack([x[:2], y[:2]])
    # an edge's slope is known no better than the room is vertical to it and its own errors of position allow
    weight = 1.0 / (1.0 / weight + 1.0 / np.median(weight))
    inverse = np.linalg.inv(across.T @ (weight[:, None] * across))
    leverage = np.einsum("ki,ij,kj->k", across, inverse, across) * weight
    scores = across * (weight * slope / np.sqrt(np.clip(1.0 - leverage, 0.1, None)))[:, None]  # CR2
    own = inverse @ (scores.T @ scores) @ inverse
    pooled = inverse * float(np.sum(weight * slope**2) / max(len(rays) - 2, 1))
    return slope, np.asarray(0.5 * (own + pooled))


def _by_sphere(edges: Sequence[Array], rig: Rig, found: Vertical, step_m: float = 2e-5) -> Array:
    """Change of the vertical with the sphere's centre, shape (2, 3), per metre."""
    columns = []
    for move in step_m * np.eye(3):
        pose = rig.T_camera_sphere
        moved = replace(rig, T_camera_sphere=replace(pose, translation_m=tuple(map(float, pose.t + move))))
        columns.append((vertical_of(edges, moved).up - found.up)[:2] / step_m)
    return np.stack(columns, axis=-1)
