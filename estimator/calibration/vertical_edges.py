"""The world's vertical in the camera frame, from vertical edges of the room in the mirror.

The paper's own check of the alignment is that all vertical edges go through the image's centre (section 5). Here the
check becomes a measurement. Every pixel on an edge's image has a reflected ray (o, r): a sphere has no single
viewpoint, so that o differs from ray to ray. The rays are taken to the edge's distance from the vertical n, and there
the points' place across the edge is a straight line of their height: if n is right, it does not change with height.
An n that is wrong by the tilt t gives the edge at azimuth a the slope t . (-sin a, cos a), so that edges of two
azimuths give n, and more of them say how well. The distance hardly matters, since o and r lie nearly in one vertical
plane; it is taken as 1 / 0.35 m, and what other distances would change is in the edge's variance. Frames: everything
in the camera frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.calibration.edge_points import edges_of
from phibench.estimator.calibration.limb_image import ImageError, planes_of
from phibench.estimator.calibration.measured import Measured
from phibench.estimator.calibration.outline_start import grey
from phibench.estimator.reflection import reflect
from phibench.scenes.frames import Array, Pose
from phibench.scenes.rig import Rig

MIN_EDGES = 3
MAX_TILT_RAD = 0.05
"""How far the vertical may be from the believed one; farther ones are other lines of the room."""
_PER_M = (0.35, 0.65)  # an edge's inverse distance, as taken and one standard deviation nearer
_TOGETHER = 6.0  # points of an edge that are wrong together: smoothing, and JPEG's blocks of 8 px
_SLOPE_LIMIT = 4.0  # of an edge's slope against the others' vertical, over its own sigma
_TUKEY, _LEAST_SCALE = 4.685, 0.5
_LEAST_SLOPE_RAD = 1e-4  # of an edge's own sigma: rooms are not built better
_ROUNDS = 12


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
    scale : float
        Robust standard deviation of the edges' slopes over what their points' own scatter gives.
    """

    up: Array
    covariance: Array
    edges: int
    points: int
    scale: float


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
    if len(chosen) < MIN_EDGES:
        raise ImageError(
            f"{len(chosen)} vertical edges were found that agree: {MIN_EDGES} are needed; show the mirror a room with "
            "door frames, corners or shelves, or leave the vertical out"
        )
    kept = [rays[k] for k in chosen]
    for _ in range(_ROUNDS):
        fit = _regression(kept, up)
        up = up + fit.tilt @ np.stack(_horizontal(up))
        up = up / np.linalg.norm(up)
    x, y = _horizontal(up)
    turn = np.stack([x[:2], y[:2]])
    return Vertical(up, turn.T @ fit.covariance @ turn, len(kept), sum(len(r.origin_m) for r in kept), fit.scale)


@dataclass(frozen=True)
class EdgeRays:
    """Reflected rays of an edge's pixels, shape (k, 3), from the sphere centre, camera frame."""

    origin_m: Array
    direction: Array


def _rays(uv_px: Array, rig: Rig) -> EdgeRays:
    view = replace(rig, T_world_camera=Pose("world", "camera")).at(0.0)
    ray = reflect(view, uv_px)
    return EdgeRays(ray.origin_world_m - view.sphere_centre_m, ray.direction_world)


def _horizontal(up: Array) -> tuple[Array, Array]:
    """Two unit vectors across `up`, near the camera's x and y."""
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    x = x / np.linalg.norm(x)
    return x, np.cross(up, x)


def _azimuth_and_slope(rays: EdgeRays, up: Array, per_m: float = _PER_M[0]) -> tuple[float, float, float]:
    """Azimuth of an edge, its slope along the azimuth, radians, and one over the variance that its points give it."""
    x, y = _horizontal(up)
    a, b = rays.direction @ x, rays.direction @ y
    t = (1.0 / per_m - np.hypot(rays.origin_m @ x, rays.origin_m @ y)) / np.hypot(a, b)
    point = rays.origin_m + t[:, None] * rays.direction
    azimuth = float(np.arctan2((point @ y).mean(), (point @ x).mean()))
    along, height = point @ (np.cos(azimuth) * y - np.sin(azimuth) * x), point @ up
    centred = height - height.mean()
    square = float(centred @ centred)
    slope = float(centred @ along / square)
    left = along - along.mean() - slope * centred
    return azimuth, slope, square / (_TOGETHER * float(left @ left) / max(left.size - 2, 1) + 1e-300)


def _slopes(rays: Sequence[EdgeRays], up: Array) -> tuple[Array, Array, Array]:
    """Azimuths, slopes and one over the slopes' variances of edges, shape (K,) each; their distances are not known."""
    azimuth, slope, weight = np.array([_azimuth_and_slope(r, up) for r in rays]).T
    nearer = np.array([_azimuth_and_slope(r, up, _PER_M[1])[1] for r in rays])
    return azimuth, slope, 1.0 / (1.0 / weight + (nearer - slope) ** 2 + _LEAST_SLOPE_RAD**2)


def _agreeing(rays: Sequence[EdgeRays], up: Array) -> list[int]:
    """Numbers of the edges whose slopes belong to one vertical near `up`: the pair that most others agree with."""
    if len(rays) < MIN_EDGES:
        return list(range(len(rays)))
    azimuth, slope, weight = _slopes(rays, up)
    across = np.stack([-np.sin(azimuth), np.cos(azimuth)], axis=-1)
    i, j = np.triu_indices(len(rays), 1)
    sine = across[i, 0] * across[j, 1] - across[i, 1] * across[j, 0]
    i, j, sine = i[np.abs(sine) > 0.3], j[np.abs(sine) > 0.3], sine[np.abs(sine) > 0.3]
    tilt = np.stack(
        [slope[i] * across[j, 1] - slope[j] * across[i, 1], slope[j] * across[i, 0] - slope[i] * across[j, 0]]
    )
    tilt = (tilt / sine).T[np.linalg.norm(tilt / sine, axis=0) < MAX_TILT_RAD]
    if not len(tilt):
        return []
    off = np.abs(slope - tilt @ across.T) * np.sqrt(_evened(weight))
    score = np.sum(np.clip(1.0 - (off / _SLOPE_LIMIT) ** 2, 0.0, None), axis=-1)
    return [int(k) for k in np.flatnonzero(off[np.argmax(score)] < _SLOPE_LIMIT)]


def _evened(weight: Array) -> Array:
    """Weights of slopes, an usual edge's variance added to each: no edge is better than its neighbourhood allows."""
    return np.asarray(1.0 / (1.0 / weight + 1.0 / np.median(weight)))


@dataclass(frozen=True)
class Regression:
    """Tilt, shape (2,), of the vertical along `_horizontal`, its covariance, and the slopes' scatter."""

    tilt: Array
    covariance: Array
    scale: float


def _regression(rays: Sequence[EdgeRays], up: Array) -> Regression:
    """Tilt from the edges' slopes, with Tukey's weights.

    An edge's points are wrong together (its neighbourhood, JPEG's blocks): what counts is how well edges agree. So the
    covariance is a sandwich over edges (CR2: Bell and McCaffrey, Survey Methodology 28, 169, 2002), averaged with the
    pooled one, which is steadier where edges are few. Two degrees of freedom are the vertical's own.
    """
    azimuth, slope, weight = _slopes(rays, up)
    across = np.stack([-np.sin(azimuth), np.cos(azimuth)], axis=-1)
    weight = _evened(weight)
    trust = np.ones(slope.size)
    for _ in range(8):
        w = weight * trust
        inverse = np.linalg.inv(across.T @ (w[:, None] * across))
        tilt = inverse @ across.T @ (w * slope)
        off = np.sqrt(weight) * (slope - across @ tilt)
        scale = 1.4826 * float(np.median(np.abs(off))) * np.sqrt(slope.size / (slope.size - 2.0))
        scale = max(scale, _LEAST_SCALE)  # few edges may agree by chance
        trust = np.clip(1.0 - (off / (_TUKEY * scale)) ** 2, 0.0, None) ** 2
    u2 = np.minimum((off / (_TUKEY * scale)) ** 2, 1.0)
    slack = np.clip(np.sum(weight * (1.0 - u2) * (1.0 - 5.0 * u2)) / np.sum(w), 0.5, 1.0)  # psi' over psi / x
    leverage = np.clip(np.einsum("ki,ij,kj->k", across, inverse, across) * w, 0.0, 0.9)
    scores = across * (trust * np.sqrt(weight) * off / np.sqrt(1.0 - leverage))[:, None]
    meat = across.T @ ((w * trust)[:, None] * across)
    degrees = max(float(trust.sum()) - 2.0, 1.0)
    pooled = max(float(np.sum(trust * off**2)) / degrees, _LEAST_SCALE**2) * meat
    covariance = inverse @ (0.5 * (scores.T @ scores + pooled) / slack**2) @ inverse
    return Regression(tilt, covariance, scale)


def _by_sphere(edges: Sequence[Array], rig: Rig, found: Vertical, step_m: float = 2e-5) -> Array:
    """Change of the vertical with the sphere's centre, shape (2, 3), per metre."""
    columns = []
    for move in step_m * np.eye(3):
        pose = rig.T_camera_sphere
        moved = replace(rig, T_camera_sphere=replace(pose, translation_m=tuple(map(float, pose.t + move))))
        columns.append((vertical_of(edges, moved).up - found.up)[:2] / step_m)
    return np.stack(columns, axis=-1)
