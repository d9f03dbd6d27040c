"""Simple extractors of a spot's position, to compare with; and `find_spot`, the centroid in noise-free frames.

Regions are images of one spot, shape (n, h, w), or (n, h, w, 3) R, G, B, of which the luma is taken. Integer (u, v) are
pixel centres; `origin_px`, shape (2,) or (n, 2), is the image pixel of a region's first column and row. The background
is the median of the region's border. NaN and a `Status` where there is no position.

`find_spot` is the centroid of a noise-free frame of expected electrons per second, shape (3, H, W), filters R, G, B.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_laplace

from phibench.datasets.common.shown_text import ShortForm, short_text
from phibench.estimator.geometry.status import Status, StatusArray, flag, keep
from phibench.scenes.frames import Array, BoolArray

LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601, what cvtColor of OpenCV and convert("L") of Pillow take
_WINDOW_STEPS = 60
_WINDOW_TOLERANCE_PX = 1e-5


@dataclass(frozen=True)
class SpotPositions:
    """Positions, shape (n, 2), pixels of the image, and statuses, shape (n,)."""

    uv_px: Array
    status: StatusArray


def brightest_pixel(images: NDArray[Any], origin_px: ArrayLike = (0, 0)) -> SpotPositions:
    """Pixel of the largest luma; the first of several."""
    signal = _signal(images)
    return _positions(signal, _peak(signal), origin_px)


def thresholded_centroid(images: NDArray[Any], origin_px: ArrayLike = (0, 0), share: float = 0.3) -> SpotPositions:
    """Centroid of what exceeds `share` of the peak above the background, the threshold taken off."""
    signal = _signal(images)
    peak = signal.max(axis=(1, 2), keepdims=True)
    return _positions(signal, _centroids(np.maximum(signal - share * peak, 0.0)), origin_px)


def laplacian_blob(images: NDArray[Any], origin_px: ArrayLike = (0, 0), sigma_px: float = 1.0) -> SpotPositions:
    """Maximum of the negative Laplacian of Gaussian at one scale, refined by a parabola along u and v.

    scikit-image's `blob_log` is the same filter over several scales; it gives whole pixels, one image at a time.
    """
    signal = _signal(images)
    response = -gaussian_laplace(signal, sigma_px, mode="nearest", axes=(1, 2))
    uv = _peak(response)
    return _positions(signal, uv + _parabola(response, uv), origin_px)


def windowed_centroid(images: NDArray[Any], origin_px: ArrayLike = (0, 0), sigma_px: float = 1.5) -> SpotPositions:
    """Iterated centroid under a Gaussian window: where sum(w I (x_i - x)) = 0.

    The position XWIN of SExtractor, E. Bertin and S. Arnouts, A&AS 117, 393 (1996) and its manual. Its step of 2 times
    the offset is taken as 1.5 times: the same end, but no oscillation for a spot much narrower than the window. From
    the brightest pixel, at most 60 steps, to 1e-5 px.
    """
    signal = _signal(images)
    h, w = signal.shape[1:]
    uv, moved = _peak(signal), np.full(len(signal), np.inf)
    with np.errstate(all="ignore"):
        for _ in range(_WINDOW_STEPS):
            du, dv = np.arange(w) - uv[:, 0, None], np.arange(h) - uv[:, 1, None]
            weighted = signal * np.exp(-0.5 * (du[:, None, :] ** 2 + dv[:, :, None] ** 2) / sigma_px**2)
            total = weighted.sum(axis=(1, 2))
            across, down = (np.sum(weighted.sum(axis=axis) * d, axis=1) for axis, d in ((1, du), (2, dv)))
            # longer than the mean: a window pulls towards its middle
            step = 1.5 * np.stack([across, down], axis=1) / total[:, None]
            uv, moved = uv + step, np.abs(step).max(axis=1)
            if not (moved >= _WINDOW_TOLERANCE_PX).any():
                break
    return _positions(signal, uv, origin_px, moved < _WINDOW_TOLERANCE_PX)


def gaussian_least_squares(images: NDArray[Any], origin_px: ArrayLike = (0, 0)) -> SpotPositions:
    """Unweighted least squares of a round Gaussian, sampled at pixel centres, plus a constant (scipy)."""
    signal = _signal(images)
    start = _peak(signal)
    fits = [_gaussian_fit(image, uv) for image, uv in zip(signal, start, strict=True)]
    uv = np.array([fit[0] for fit in fits]).reshape(-1, 2)
    return _positions(signal, uv, origin_px, np.array([fit[1] for fit in fits], bool))


SIMPLE_METHODS: dict[str, Callable[..., SpotPositions]] = {
    "brightest_pixel": brightest_pixel,
    "thresholded_centroid": thresholded_centroid,
    "laplacian_blob": laplacian_blob,
    "windowed_centroid": windowed_centroid,
    "gaussian_least_squares": gaussian_least_squares,
}


def luma(images: NDArray[Any]) -> Array:
    """Luma, shape (n, h, w), of colour images; images of one plane as they are.

    Raises
    ------
    ValueError
        If the shape is neither (n, h, w) nor (n, h, w, 3), with 3 x 3 pixels or more.
    """
    x = np.asarray(images, float)
    if x.ndim not in (3, 4) or (x.ndim == 4 and x.shape[3] != 3) or min(x.shape[1:3]) < 3:
        raise ValueError(
            f"regions have the shape {x.shape}: (n, h, w) or (n, h, w, 3) of 3 x 3 pixels or more is needed"
        )
    return x @ np.array(LUMA) if x.ndim == 4 else x


def _signal(images: NDArray[Any]) -> Array:
    x = luma(images)
    edge = np.concatenate([x[:, 0], x[:, -1], x[:, 1:-1, 0], x[:, 1:-1, -1]], axis=1)
    return x - np.median(edge, axis=1)[:, None, None]


def _peak(images: Array) -> Array:
    """(u, v) of the largest value, shape (n, 2)."""
    v, u = np.unravel_index(np.argmax(images.reshape(len(images), -1), axis=1), images.shape[1:])
    return np.stack([u, v], axis=1).astype(float)


def _centroids(images: Array) -> Array:
    with np.errstate(all="ignore"):
        total = images.sum(axis=(1, 2))
        u = images.sum(axis=1) @ np.arange(images.shape[2]) / total
        v = images.sum(axis=2) @ np.arange(images.shape[1]) / total
    return np.stack([u, v], axis=1)


def _parabola(images: Array, uv: Array) -> Array:
    """Offset of the vertex of a parabola through three pixels, along u and v; 0 on the border."""
    n, h, w = images.shape
    u, v = uv.astype(int).T
    inside = (u > 0) & (u < w - 1) & (v > 0) & (v < h - 1)
    u, v, each = u.clip(1, w - 2), v.clip(1, h - 2), np.arange(n)
    here = images[each, v, u]
    sides = ((images[each, v, u - 1], images[each, v, u + 1]), (images[each, v - 1, u], images[each, v + 1, u]))
    with np.errstate(all="ignore"):
        offsets = [0.5 * (a - b) / (a - 2.0 * here + b) for a, b in sides]
    return np.where(inside[:, None], np.nan_to_num(np.stack(offsets, axis=1)).clip(-0.5, 0.5), 0.0)


def _gaussian_fit(image: Array, start: Array) -> tuple[Array, bool]:
    """Position and whether the fit came to an end; theta = u, v, height, width, constant."""
    if not np.isfinite(image).all():
        return np.full(2, np.nan), False
    v, u = np.indices(image.shape).reshape(2, -1)
    data = image.ravel()

    from scipy.optimize import least_squares  # a quarter of a second that no other method needs

    def residual(theta: Array) -> Array:
        r2 = (u - theta[0]) ** 2 + (v - theta[1]) ** 2
        return theta[2] * np.exp(-0.5 * r2 / theta[3] ** 2) + theta[4] - data

    def jacobian(theta: Array) -> Array:
        du, dv, s = u - theta[0], v - theta[1], theta[3]
        r2 = du * du + dv * dv
        shape = np.exp(-0.5 * r2 / s**2)
        tall = theta[2] * shape / s**2
        return np.stack([tall * du, tall * dv, shape, tall * r2 / s, np.ones_like(shape)], axis=1)

    # an amplitude of 0 has no derivative by place and width
    fit = least_squares(residual, [*start, max(data.max(), 1e-12), 1.0, 0.0], jac=jacobian, method="lm", max_nfev=200)
    return fit.x[:2], bool(fit.success)


def _positions(signal: Array, uv: Array, origin_px: ArrayLike, converged: BoolArray | None = None) -> SpotPositions:
    h, w = signal.shape[1:]
    inside = (np.abs(uv[:, 0] - (w - 1) / 2) <= w / 2) & (np.abs(uv[:, 1] - (h - 1) / 2) <= h / 2)
    status = flag(
        (~np.isfinite(signal).all(axis=(1, 2)), Status.NOT_FINITE),
        (~(signal.max(axis=(1, 2)) > 0.0), Status.NO_SPOT),
        (np.zeros(len(uv), bool) if converged is None else ~converged, Status.NOT_CONVERGED),
        (~inside, Status.SPOT_CUT),
    )
    return SpotPositions(keep(uv + np.asarray(origin_px, float), status), status)


# -- noise-free frames -----------------------------------------------------------------------------------------------

EMPTY = 1e-9  # of the peak: a border below this holds no flux; 1e-9 at 10 px distance moves a centroid by about 1e-7 px
MAX_WIDTH_PX = 201  # of a region that grows until its border is empty: what is wider is no spot

Region = tuple[int, int, int, int]  # u0, v0, u1, v1: first column and row, last column and row + 1


@dataclass(frozen=True, repr=False)
class SpotPosition(ShortForm):
    """Position of a spot in a noise-free frame.

    Parameters
    ----------
    uv_px : shape (2,), NaN unless status is OK
    flux : float, sum of the window, in the unit of the frame
    """

    uv_px: Array
    flux: float
    window: Region
    status: Status

    def _shown(self) -> dict[str, Any]:
        u0, v0, u1, v1 = self.window
        return {
            "position": f"{short_text(self.uv_px)} px",
            "flux": self.flux,
            "window": f"{u1 - u0} x {v1 - v0} px from ({u0}, {v0})",
            "status": self.status.name,
        }


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
    inside = red[v0:v1, u0:u1]
    if inside.size == 0 or not np.isfinite(inside).all():
        return _nowhere((u0, v0, u1, v1), Status.NO_SPOT if inside.size == 0 else Status.NOT_FINITE)
    row, column = np.unravel_index(int(np.argmax(inside)), inside.shape)
    u, v, peak = u0 + int(column), v0 + int(row), float(inside[row, column])
    if peak <= 0.0:
        return _nowhere((u0, v0, u1, v1), Status.NO_SPOT)
    window, status = _grow(red, u, v, EMPTY * peak)
    return _centroid_in(red, window) if status is Status.OK else _nowhere(window, status)


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


def _centroid_in(red: Array, window: Region) -> SpotPosition:
    u0, v0, u1, v1 = window
    inside = red[v0:v1, u0:u1]
    flux = float(inside.sum())
    # moments about the window's corner, so that large pixel numbers cost no digits
    du = float(inside.sum(axis=0) @ np.arange(u1 - u0)) / flux
    dv = float(inside.sum(axis=1) @ np.arange(v1 - v0)) / flux
    return SpotPosition(np.array([u0 + du, v0 + dv]), flux, window, Status.OK)


def _nowhere(window: Region, status: Status) -> SpotPosition:
    return SpotPosition(np.full(2, np.nan), 0.0, window, status)
