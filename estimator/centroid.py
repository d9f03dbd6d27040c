"""First extractor: background-subtracted centroid of the spot, for noise-free frames.

Frames are expected electrons per second, shape (3, H, W), filters R, G, B; integer (u, v) are pixel centres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.estimator.status import Status
from phibench.scenes.frames import Array

EMPTY = 1e-9  # of the peak: a border below this holds no flux; 1e-9 at 10 px distance moves a centroid by about 1e-7 px
MAX_WIDTH_PX = 201

Region = tuple[int, int, int, int]  # u0, v0, u1, v1: first column and row, last column and row + 1


@dataclass(frozen=True)
class SpotPosition:
    """Where the spot is.

    Parameters
    ----------
    uv_px : shape (2,), NaN unless status is OK
    flux : float, sum of the window, in the unit of the frame
    window : Region
    status : Status
    """

    uv_px: Array
    flux: float
    window: Region
    status: Status


def find_spot(on: Array, off: Array | None = None, region: Region | None = None) -> SpotPosition:
    """Centroid of the red plane of `on` - `off`, over the smallest window around its peak whose border is empty.

    Parameters
    ----------
    on, off : shape (3, H, W)
        Frames with the laser on and off; `on` alone is taken for their difference.
    region : Region, optional
        Where to look for the peak.

    Returns
    -------
    SpotPosition
        NO_SPOT, SPOT_CUT, NOT_ISOLATED or NOT_FINITE instead of a position that would be wrong.
    """
    red = np.asarray(on[0] if off is None else on[0] - off[0], float)
    height, width = red.shape
    u0, v0, u1, v1 = region if region is not None else (0, 0, width, height)
    part = red[v0:v1, u0:u1]
    if part.size == 0 or not np.isfinite(part).all():
        return _nowhere((u0, v0, u1, v1), Status.NO_SPOT if part.size == 0 else Status.NOT_FINITE)
    row, column = np.unravel_index(int(np.argmax(part)), part.shape)
    u, v, peak = u0 + int(column), v0 + int(row), float(part[row, column])
    if peak <= 0.0:
        return _nowhere((u0, v0, u1, v1), Status.NO_SPOT)
    window, status = _grow(red, u, v, EMPTY * peak)
    return _centroid(red, window) if status is Status.OK else _nowhere(window, status)


def _grow(red: Array, u: int, v: int, threshold: float) -> tuple[Region, Status]:
    """Move every side of the window that carries flux outwards by one pixel, until none does."""
    height, width = red.shape
    window, last = [u, v, u + 1, v + 1], (0, 0, width, height)
    while window[2] - window[0] <= MAX_WIDTH_PX and window[3] - window[1] <= MAX_WIDTH_PX:
        full = [bool(np.max(np.abs(side)) > threshold) for side in _sides(red, window)]
        if not any(full):
            return _region(window), Status.OK
        if any(f and w == end for f, w, end in zip(full, window, last, strict=True)):
            return _region(window), Status.SPOT_CUT
        window = [w + step * f for w, step, f in zip(window, (-1, -1, 1, 1), full, strict=True)]
    return _region(window), Status.NOT_ISOLATED


def _sides(red: Array, window: list[int]) -> tuple[Array, Array, Array, Array]:
    """First column, first row, last column, last row of the window."""
    u0, v0, u1, v1 = window
    return red[v0:v1, u0], red[v0, u0:u1], red[v0:v1, u1 - 1], red[v1 - 1, u0:u1]


def _region(window: list[int]) -> Region:
    u0, v0, u1, v1 = window
    return (u0, v0, u1, v1)


def _centroid(red: Array, window: Region) -> SpotPosition:
    u0, v0, u1, v1 = window
    part = red[v0:v1, u0:u1]
    flux = float(part.sum())
    # moments about the window's corner, so that large pixel numbers cost no digits
    du = float(part.sum(axis=0) @ np.arange(u1 - u0)) / flux
    dv = float(part.sum(axis=1) @ np.arange(v1 - v0)) / flux
    return SpotPosition(np.array([u0 + du, v0 + dv]), flux, window, Status.OK)


def _nowhere(window: Region, status: Status) -> SpotPosition:
    return SpotPosition(np.full(2, np.nan), 0.0, window, status)
