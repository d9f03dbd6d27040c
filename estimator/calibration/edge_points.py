"""Long, nearly radial edges in the mirror, as sub-pixel points.

The image is unwrapped about the middle of the outline: columns are azimuth, half a pixel at the middle radius, rows
radius, one pixel. There a vertical edge of the room is an upright line. Canny's edges and a probabilistic Hough
transform find it; its points are then taken anew, at every radius, where the gradient across the edge is largest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.feature import canny
from skimage.transform import probabilistic_hough_line

from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

Rows = NDArray[np.int64]
RADII = (0.55, 0.93)
"""Rows of the unwrapped image, over the outline's radius: walls; the floor is inside, the ceiling outside."""
_LENGTH_PX, _GAP_PX, _LEAN_RAD = 18, 2, 0.12
_STEP_PX = 0.5  # across the edge
_REACH_PX = 4.0
_SMOOTH_PX = (1.5, 0.8)  # along the radius, along the azimuth
_LEVEL_PX = 20.0
_MIN_STEP = 0.012  # of the light, per pixel
_MIN_OVER_NOISE = 4.0  # of an edge over the usual gradient, which is noise, JPEG's waves and shading
_MIN_POINTS = 14
_NEAR_PX = 5.0


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


def unwrapped(picture: Array, rig: Rig) -> Unwrapped:
    """Unwrap a picture, shape (H, W), about the middle of the outline that the rig gives it."""
    outline = rig.outline_px()
    centre, radius = outline.mean(axis=0), 0.5 * float(np.ptp(outline, axis=0).mean())
    low, high = (part * radius for part in RADII)
    columns = int(2.0 * np.pi * 0.5 * (low + high) / _STEP_PX)
    r, azimuth = np.arange(low, high), np.arange(columns) * (2.0 * np.pi / columns)
    u, v = centre[0] + np.outer(r, np.cos(azimuth)), centre[1] + np.outer(r, np.sin(azimuth))
    light = ndimage.map_coordinates(picture, [v, u], order=3, mode="nearest")
    level = ndimage.gaussian_filter(light, (_LEVEL_PX, _LEVEL_PX / _STEP_PX), mode=("nearest", "wrap"))
    return Unwrapped(light / np.clip(level, 2e-3, None), centre, low, 2.0 * np.pi / columns)


def edges_of(picture: Array, rig: Rig) -> list[Array]:
    """Pixels, each of shape (k, 2), of all nearly radial edges of a picture of shape (H, W)."""
    polar = unwrapped(picture, rig)
    across = _gradient(polar.light)
    found, taken = [], np.zeros(across.shape, bool)
    noise = 1.4826 * float(np.median(np.abs(across)))
    least = max(_MIN_STEP, _MIN_OVER_NOISE * noise)
    for (c0, r0), (c1, r1) in _segments(polar, least):
        track = _track(across, least, min(r0, r1), max(r0, r1), *((c0, c1) if r0 < r1 else (c1, c0)))
        if track is None:
            continue
        row, column = track
        if _is_block_border(polar.pixels(row.astype(float), column)):
            continue
        cell = np.rint(column).astype(int) % across.shape[1]
        if taken[row, cell].mean() > 0.2:
            continue
        for k in range(-int(_NEAR_PX / _STEP_PX), int(_NEAR_PX / _STEP_PX) + 1):
            taken[row, (cell + k) % across.shape[1]] = True
        found.append(polar.pixels(row.astype(float), column))
    return found


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
    """Whether an edge runs along the border of JPEG's blocks, pixels 7.5 mod 8: such an edge may be JPEG's own."""
    off = np.abs((uv_px - 7.5 + 4.0) % 8.0 - 4.0)
    return bool(np.any((np.ptp(uv_px, axis=0) < 2.5) & (np.median(off, axis=0) < 1.0)))


def _track(across: Array, least: float, r0: int, r1: int, c0: float, c1: float) -> tuple[Rows, Array] | None:
    """Rows and columns of the steepest places near a segment, or None where there is no clean edge.

    Two passes: about the segment, and about the straight line through the places of the first one.
    """
    row = np.arange(r0 + 1, r1, dtype=np.int64)
    if row.size < _MIN_POINTS:
        return None
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
        part = 0.5 * (a - c) / (a - 2.0 * b + c)
    column = columns[k, inner] + part
    column[(best != inner) | (np.abs(part) > 1.0)] = np.nan
    return column, b
