"""World vertical in the camera frame: upright edges found in the unwrapped mirror image, robust fit of their tilt.

1. Edges. The image is unwrapped about the middle of the outline: columns are azimuth, half a pixel at the middle
   radius, rows radius, one pixel. A vertical edge of the room is an upright line there. Canny's edges and a
   probabilistic Hough transform find it. Its points are then taken anew, at every radius, where the gradient across the
   edge is largest.
2. Vertical. The paper's check of the alignment (section 5), that all vertical edges go through the image's centre,
   becomes a measurement. Every pixel on an edge has a reflected ray (o, r), and o differs from ray to ray. The rays are
   taken to the edge's distance from the vertical n. If n is right, the points' place across the edge does not change
   with height. An n that is wrong by the tilt t gives the edge at azimuth a the slope t . (-sin a, cos a).

So edges of two azimuths give n, and more of them its error. The distance hardly matters, since o and r lie nearly in
one vertical plane. It is taken as 1 / 0.35 m; the effect of other distances is in the edge's variance. Frames:
everything in the camera frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.feature import canny
from skimage.transform import probabilistic_hough_line

from phibench.calibration.outline.edge_ring import Circle
from phibench.calibration.outline.first_circle import grey, rig_circle
from phibench.calibration.outline.limb_image import planes_of
from phibench.calibration.outline.outline_result import PoseMeasurement
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.geometry.reflection import reflect
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.frames import Array, Pose
from phibench.scenes.rig import Rig

Rows = NDArray[np.int64]
RADII = (0.55, 0.93)
"""Rows of the unwrapped image, over the outline's radius: walls; the floor is inside, the ceiling outside."""
# of Hough's segments, in the unwrapped image; a tilt of 0.05 rad and a decentre lean edges by less
_LENGTH_PX, _GAP_PX, _LEAN_RAD = 18, 2, 0.12
_STEP_PX = 0.5  # across the edge
_REACH_PX = 4.0  # of the steepest place about a segment
_SMOOTH_PX = (1.5, 0.8)  # along the radius, along the azimuth
_LEVEL_PX = 20.0  # of the light that an edge is measured against: wider than an edge, narrower than a wall
_MIN_STEP = 0.012  # of the light, per pixel
_MIN_OVER_NOISE = 4.0  # of an edge over the usual gradient, which is noise, JPEG's waves and shading
_MIN_POINTS = 14  # of an edge: fewer are a corner, and have no direction
_NEAR_PX = 5.0  # about an edge that was taken: a second segment there is the same edge


@dataclass(frozen=True)
class Unwrapped:
    """Light over the usual light around, by radius (rows, 1 px) and azimuth (columns).

    Not its logarithm: that would move a blurred edge to its dark side, by more where the contrast is larger.
    """

    light: Array
    centre_px: Array
    low_px: float
    radians: float

    def pixels(self, row: Array, column: Array) -> Array:
        """Pixels (u, v), shape (k, 2), of rows and columns."""
        radius, azimuth = self.low_px + row, column * self.radians
        return self.centre_px + radius[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)


def unwrapped_picture(picture: Array, circle: Circle) -> Unwrapped:
    """Unwrap a picture, shape (H, W), about the circle of an outline."""
    centre, radius_px = np.array(circle[:2]), circle[2]
    low, high = (share * radius_px for share in RADII)
    # columns as wide as the step at the mean radius
    columns = int(2.0 * np.pi * 0.5 * (low + high) / _STEP_PX)
    r, azimuth = np.arange(low, high), np.arange(columns) * (2.0 * np.pi / columns)
    u, v = centre[0] + np.outer(r, np.cos(azimuth)), centre[1] + np.outer(r, np.sin(azimuth))
    light = ndimage.map_coordinates(picture, [v, u], order=3, mode="nearest")
    # the azimuth is periodic: it wraps
    level = ndimage.gaussian_filter(light, (_LEVEL_PX, _LEVEL_PX / _STEP_PX), mode=("nearest", "wrap"))
    return Unwrapped(light / np.clip(level, 2e-3, None), centre, low, 2.0 * np.pi / columns)


def edges_of(picture: Array, rig: Rig) -> list[Array]:
    """Pixels, each of shape (k, 2), of all nearly radial edges of a picture of shape (H, W), about a rig's outline."""
    return edges_about(picture, rig_circle(rig))


def edges_about(picture: Array, circle: Circle) -> list[Array]:
    """The same about the circle of an outline, for a picture of an unknown camera."""
    polar = unwrapped_picture(picture, circle)
    # upright edges are radial: the step of light lies along the azimuth
    across = _gradient(polar.light)
    edges, taken = [], np.zeros(across.shape, bool)
    noise = 1.4826 * float(np.median(np.abs(across)))  # that of a normal law: edges are few
    least = max(_MIN_STEP, _MIN_OVER_NOISE * noise)
    for (c0, r0), (c1, r1) in _segments(polar, least):
        track = _track(across, least, min(r0, r1), max(r0, r1), *((c0, c1) if r0 < r1 else (c1, c0)))
        if track is None:
            continue
        row, column = track
        if _is_block_border(polar.pixels(row.astype(float), column)):
            continue
        cell = np.rint(column).astype(int) % across.shape[1]
        if taken[row, cell].mean() > 0.2:  # most of this edge is part of another
            continue
        for k in range(-int(_NEAR_PX / _STEP_PX), int(_NEAR_PX / _STEP_PX) + 1):
            taken[row, (cell + k) % across.shape[1]] = True
        edges.append(polar.pixels(row.astype(float), column))
    return edges


def _gradient(light: Array) -> Array:
    """Change of the light along the azimuth, per pixel at the middle radius."""
    sigma = (_SMOOTH_PX[0], _SMOOTH_PX[1] / _STEP_PX)
    return np.asarray(ndimage.gaussian_filter(light, sigma, order=(0, 1), mode=("nearest", "wrap")) / _STEP_PX)


def _segments(polar: Unwrapped, least: float) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Upright segments ((column, row), (column, row)), the longest first, of a picture with square pixels."""
    factor = round(1.0 / _STEP_PX)
    square = polar.light[:, ::factor]
    seam = 40  # columns again, so that an edge at azimuth 0 is whole
    wide = np.concatenate([square, square[:, :seam]], axis=1)
    edges = canny(wide, sigma=1.5, low_threshold=least, high_threshold=2.0 * least)  # type: ignore[no-untyped-call]
    # upright edges alone: tiles and lamps give Hough much to do
    upright = np.abs(ndimage.gaussian_filter(wide, 1.5, order=(0, 1))) > 2.0 * np.abs(
        ndimage.gaussian_filter(wide, 1.5, order=(1, 0))
    )
    lean = np.linspace(-_LEAN_RAD, _LEAN_RAD, 25)
    lines = probabilistic_hough_line(  # type: ignore[no-untyped-call]
        edges & upright, threshold=10, line_length=_LENGTH_PX, line_gap=_GAP_PX, theta=lean, rng=0
    )
    whole = [((a[0] * factor, a[1]), (b[0] * factor, b[1])) for a, b in lines]
    return sorted(whole, key=lambda line: -abs(line[0][1] - line[1][1]))


def _is_block_border(uv_px: Array) -> bool:
    """Tell an edge along the border of JPEG's blocks, pixels 7.5 mod 8: it may be JPEG's own."""
    off = np.abs((uv_px - 7.5 + 4.0) % 8.0 - 4.0)  # distance from the nearest border
    return bool(np.any((np.ptp(uv_px, axis=0) < 2.5) & (np.median(off, axis=0) < 1.0)))


def _track(across: Array, least: float, r0: int, r1: int, c0: float, c1: float) -> tuple[Rows, Array] | None:
    """Rows and columns of the steepest places near a segment, or None where there is no clean edge.

    Two passes: about the segment, and about the straight line through the places of the first one.
    """
    row = np.arange(r0 + 1, r1, dtype=np.int64)
    if row.size < _MIN_POINTS:
        return None
    # straight line of the segment: column by row
    line = np.polynomial.Polynomial([c0 - r0 * (c1 - c0) / max(r1 - r0, 1), (c1 - c0) / max(r1 - r0, 1)])
    sign = np.sign(np.median(across[row, np.rint(line(row)).astype(int) % across.shape[1]])) or 1.0
    for reach in (_REACH_PX, 0.6 * _REACH_PX):
        column, steep = _steepest(sign * across, row, line(row), reach)
        good = np.isfinite(column) & (steep > least)
        if good.sum() < _MIN_POINTS:
            return None
        line = np.polynomial.Polynomial.fit(row[good], column[good], 1)
    off = np.abs(column - line(row)) * _STEP_PX
    good &= off < max(3.0 * float(np.median(off[good])), 0.1)
    return (row[good], column[good]) if good.sum() >= _MIN_POINTS else None


def _steepest(across: Array, row: Rows, near: Array, reach_px: float) -> tuple[Array, Array]:
    """Column of the largest gradient within reach in each row, by a parabola, and the gradient; NaN at the reach."""
    half = int(reach_px / _STEP_PX)
    columns = np.rint(near).astype(int)[:, None] + np.arange(-half, half + 1)
    values = across[row[:, None], columns % across.shape[1]]
    best = np.argmax(values, axis=-1)
    inner = np.clip(best, 1, 2 * half - 1)
    k = np.arange(row.size)
    a, b, c = values[k, inner - 1], values[k, inner], values[k, inner + 1]
    with np.errstate(all="ignore"):
        # vertex of the parabola through the steepest place and its neighbours
        shift = 0.5 * (a - c) / (a - 2.0 * b + c)
    column = columns[k, inner] + shift
    column[(best != inner) | (np.abs(shift) > 1.0)] = np.nan
    return column, b


# -- vertical ----------------------------------------------------------------------------------------------------------

MIN_EDGES = 3  # two always agree on some vertical
MAX_TILT_RAD = 0.05
"""How far the vertical may be from the nominal one; farther ones are other lines of the room."""
_PER_M = (0.35, 0.65)  # an edge's inverse distance, as taken and one standard deviation nearer
_TOGETHER = 6.0  # points of an edge that are wrong together: smoothing, and JPEG's blocks of 8 px
_SLOPE_LIMIT = 4.0  # of an edge's slope against the others' vertical, over its own sigma
_TUKEY, _LEAST_SCALE = 4.685, 0.5  # of the usual residual: 95 % of the efficiency on normal errors
_LEAST_SLOPE_RAD = 1e-4  # of an edge's own sigma: rooms are not built better
_ROUNDS = 12


@dataclass(frozen=True)
class Vertical:
    """Vertical from edges.

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
) -> PoseMeasurement:
    """The world's vertical in the camera frame: x and y of the unit vector, shape (2,), as `bundle.calibrate` takes it.

    Parameters
    ----------
    image : array
        See `limb_image.planes_of`.
    rig : Rig
        Nominal camera, and the sphere where its outline is (`Outline.rig`): a sphere that is 4 um off across the
        axis turns the vertical by 0.008 degrees.
    card : SensorCard, optional
        Of the image's preset; none for a layer.
    sphere_covariance_m2 : shape (3, 3), optional
        Of the sphere's centre; its share is added to the covariance.

    Raises
    ------
    ImageError
        If fewer than three edges agree on a vertical within 0.05 rad of the nominal one.
    """
    return measured_vertical(edges_of(grey(planes_of(image, card)), rig), rig, sphere_covariance_m2)


def measured_vertical(edges: Sequence[Array], rig: Rig, sphere_covariance_m2: Array | None = None) -> PoseMeasurement:
    """The same from the pixels of edges, each of shape (k, 2)."""
    vertical = vertical_of(edges, rig)
    covariance = vertical.covariance
    if sphere_covariance_m2 is not None:
        slope = _by_sphere(edges, rig, vertical)
        covariance = covariance + slope @ sphere_covariance_m2 @ slope.T
    return PoseMeasurement(vertical.up[:2], covariance)


def vertical_of(edges: Sequence[Array], rig: Rig) -> Vertical:
    """Vertical from the pixels of edges, each of shape (k, 2).

    Raises
    ------
    ImageError
        See `find_vertical`.
    """
    up = rig.T_world_camera.R.T[:, 2]
    rays = [_rays(edge, rig) for edge in edges]
    chosen = agreeing_edges(*_slopes(rays, up), MAX_TILT_RAD) if len(rays) >= MIN_EDGES else list(range(len(rays)))
    require_edges(len(chosen))
    kept = [rays[k] for k in chosen]
    for _ in range(_ROUNDS):
        fit = shift_regression(*_slopes(kept, up))
        up = up + fit.shift @ np.stack(_horizontal(up))
        up = up / np.linalg.norm(up)
    x, y = _horizontal(up)
    turn = np.stack([x[:2], y[:2]])
    return Vertical(up, turn.T @ fit.covariance @ turn, len(kept), sum(len(r.origin_m) for r in kept), fit.scale)


def require_edges(count: int) -> None:
    """Raise `ImageError` for too few edges."""
    if count < MIN_EDGES:
        raise ImageError(
            f"{count} vertical edges were found that agree: {MIN_EDGES} are needed; show the mirror a room with "
            "door frames, corners or shelves, or leave the vertical out"
        )


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
    # along the ray to the assumed distance; the origin of the ray lies on the mirror
    t = (1.0 / per_m - np.hypot(rays.origin_m @ x, rays.origin_m @ y)) / np.hypot(a, b)
    point = rays.origin_m + t[:, None] * rays.direction
    azimuth = float(np.arctan2((point @ y).mean(), (point @ x).mean()))
    along, height = point @ (np.cos(azimuth) * y - np.sin(azimuth) * x), point @ up
    centred = height - height.mean()
    square = float(centred @ centred)
    # regression of the sideways place on the height: the lean of the edge
    slope = float(centred @ along / square)
    left = along - along.mean() - slope * centred
    # an exact line leaves nothing
    return azimuth, slope, square / (_TOGETHER * float(left @ left) / max(left.size - 2, 1) + 1e-300)


def _slopes(rays: Sequence[EdgeRays], up: Array) -> tuple[Array, Array, Array]:
    """Azimuths, slopes and one over the slopes' variances of edges, shape (K,) each; their distances are not known."""
    azimuth, slope, weight = np.array([_azimuth_and_slope(r, up) for r in rays]).T
    nearer = np.array([_azimuth_and_slope(r, up, _PER_M[1])[1] for r in rays])
    # the unknown distance adds what it does to the slope; the room adds its own lean
    return azimuth, slope, 1.0 / (1.0 / weight + (nearer - slope) ** 2 + _LEAST_SLOPE_RAD**2)


def agreeing_edges(azimuth: Array, value: Array, weight: Array, most: float) -> list[int]:
    """Numbers of the edges whose values belong to one shift of at most `most`: the pair that most others agree with.

    An edge at the azimuth a has the value shift . (-sin a, cos a), besides its error. Arguments as for
    `shift_regression`.
    """
    across = np.stack([-np.sin(azimuth), np.cos(azimuth)], axis=-1)
    i, j = np.triu_indices(len(value), 1)
    sine = across[i, 0] * across[j, 1] - across[i, 1] * across[j, 0]
    # edges of nearly one azimuth tell one direction of the tilt only
    i, j, sine = i[np.abs(sine) > 0.3], j[np.abs(sine) > 0.3], sine[np.abs(sine) > 0.3]
    shift = np.stack(
        [value[i] * across[j, 1] - value[j] * across[i, 1], value[j] * across[i, 0] - value[i] * across[j, 0]]
    )
    # every two edges give one tilt; tilts beyond the limit are no candidates
    shift = (shift / sine).T[np.linalg.norm(shift / sine, axis=0) < most]
    if not len(shift):
        return []
    off = np.abs(value - shift @ across.T) * np.sqrt(_evened(weight))
    # edges that agree count, those astray count nothing, whatever their distance
    score = np.sum(np.clip(1.0 - (off / _SLOPE_LIMIT) ** 2, 0.0, None), axis=-1)
    return [int(k) for k in np.flatnonzero(off[np.argmax(score)] < _SLOPE_LIMIT)]


def _evened(weight: Array) -> Array:
    """Weights of slopes, an usual edge's variance added to each: no edge is better than its neighbourhood allows."""
    return np.asarray(1.0 / (1.0 / weight + 1.0 / np.median(weight)))


@dataclass(frozen=True)
class Regression:
    """Shift, shape (2,), that edges have in common, its covariance, and the scatter of the edges' values.

    Of slopes the shift is the tilt of the vertical along `_horizontal`.
    """

    shift: Array
    covariance: Array
    scale: float


def shift_regression(azimuth: Array, value: Array, weight: Array) -> Regression:
    """Shift from the edges' values shift . (-sin a, cos a), with Tukey's weights.

    Azimuths a, values, and one over the variances that the edges' own points give, shape (K,) each.

    An edge's points are wrong together (its neighbourhood, JPEG's blocks): what counts is how well edges agree. So the
    covariance is a sandwich over edges (CR2: Bell and McCaffrey, Survey Methodology 28, 169, 2002), averaged with the
    pooled one, which is steadier where edges are few. Two degrees of freedom are the vertical's own.
    """
    across = np.stack([-np.sin(azimuth), np.cos(azimuth)], axis=-1)
    weight = _evened(weight)
    trust = np.ones(value.size)
    for _ in range(8):
        w = weight * trust
        inverse = np.linalg.inv(across.T @ (w[:, None] * across))
        shift = inverse @ across.T @ (w * value)
        off = np.sqrt(weight) * (value - across @ shift)
        # two numbers are fitted
        scale = 1.4826 * float(np.median(np.abs(off))) * np.sqrt(value.size / (value.size - 2.0))
        scale = max(scale, _LEAST_SCALE)  # few edges may agree by chance
        trust = np.clip(1.0 - (off / (_TUKEY * scale)) ** 2, 0.0, None) ** 2
    u2 = np.minimum((off / (_TUKEY * scale)) ** 2, 1.0)
    slack = np.clip(np.sum(weight * (1.0 - u2) * (1.0 - 5.0 * u2)) / np.sum(w), 0.5, 1.0)  # psi' over psi / x
    # a single edge that decides: 1 / 0
    leverage = np.clip(np.einsum("ki,ij,kj->k", across, inverse, across) * w, 0.0, 0.9)
    scores = across * (trust * np.sqrt(weight) * off / np.sqrt(1.0 - leverage))[:, None]
    # bread and meat of a robust sandwich; the mean of it and of the pooled scale serves few edges
    meat = across.T @ ((w * trust)[:, None] * across)
    degrees = max(float(trust.sum()) - 2.0, 1.0)
    pooled = max(float(np.sum(trust * off**2)) / degrees, _LEAST_SCALE**2) * meat
    covariance = inverse @ (0.5 * (scores.T @ scores + pooled) / slack**2) @ inverse
    return Regression(shift, covariance, scale)


def _by_sphere(edges: Sequence[Array], rig: Rig, found: Vertical, step_m: float = 2e-5) -> Array:
    """Change of the vertical with the sphere's centre, shape (2, 3), per metre."""
    columns = []
    for move in step_m * np.eye(3):
        pose = rig.T_camera_sphere
        moved = replace(rig, T_camera_sphere=replace(pose, translation_m=tuple(map(float, pose.t + move))))
        columns.append((vertical_of(edges, moved).up - found.up)[:2] / step_m)
    return np.stack(columns, axis=-1)
