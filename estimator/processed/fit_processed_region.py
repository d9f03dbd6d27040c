"""Fit of a spot in one region of a processed image: window of codes or JPEG coefficients, and the room behind it.

A window is 2 x 2 JPEG units of a decoded region, or 12 x 12 pixels of another, with the spot nearest to its middle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.processed.chain_model import (
    ChainModel,
    codes,
    excess_variance,
    noise_factor,
    raw_variance_e2,
    window_px,
)
from phibench.estimator.processed.interval_fit import QuantiserSteps, fit_intervals
from phibench.estimator.processed.quasi_score import CoefficientWindow, WindowFit, fit_window
from phibench.estimator.spots.camera_codes import hidden_share, mcu_px, qtables_of, room_variance, ycbcr_codes
from phibench.estimator.spots.gaussian_spot import SpotBlur, SpotModel, SpotPixels
from phibench.estimator.spots.jpeg_recovery import recovered_coefficients
from phibench.scenes.frames import Array

_WEAK = 4.0  # by which the variance of a background counts that is made of the same frames
_HIDDEN = 1e-4  # variance of a room's coefficient, in steps squared, from which its place in the step is looked for


@dataclass(frozen=True)
class JpegRegion:
    """One region on the grid of JPEG units, or one that begins at an even row and column.

    Attributes
    ----------
    image : shape (f, h, w, 3), uint8, of f frames; (f, h, w, 2) of "yuyv"
    ends : 4 booleans
        Top, bottom, left and right side are the image's own.
    background_e, extra_e2 : shape (h, w)
        Background of the raw pixels, and the variance of its error.
    room : shape (f, h, w, 3), uint8, optional
        Decoded frames without the laser that the background was taken from.
    prnu : float
        Of the spot's light, where the background's variance holds the pattern of the room.
    """

    image: NDArray[Any]
    ends: tuple[bool, bool, bool, bool]
    background_e: Array
    extra_e2: Array
    room: NDArray[Any] | None = None
    prnu: float = 0.0


def window_at(region: JpegRegion, chain: ChainModel, uv: Array) -> tuple[int, int]:
    """First row and column, in the region, of the window on the grid that has (u, v) nearest to its middle."""
    steps = grid_px(chain.card)
    places = []
    for centre, unit, side, size in zip((uv[1], uv[0]), steps, chain.shape, region.image.shape[1:3], strict=True):
        first = int(np.clip(np.rint((centre + 0.5 - side / 2) / unit), 0, (size - side) // unit))
        places.append(first * unit)
    return places[0], places[1]


def grid_px(card: SensorCard) -> tuple[int, int]:
    """Rows and columns at whose multiples a window may begin: JPEG's units, or the mosaic's cell."""
    return mcu_px(card.jpeg_subsampling) if card.output == "mjpeg" else (2, 2)


def fit_region(
    region: JpegRegion, chain: ChainModel, starts: Array, blur: SpotBlur, model: SpotModel
) -> tuple[WindowFit, Array]:
    """Fit the spot of one region.

    Parameters
    ----------
    region : JpegRegion
    starts : shape (s, 6) or (s, 7)
        u, v in the region, flux, levels on top of the background, width if it is free.
    model : SpotModel
        Its background is not looked at; the region's is.

    Returns
    -------
    WindowFit
        Positions in the region.
    shape (2,)
        Distance of (u, v) from the window's middle, in half windows: above 1 it lies outside.
    """
    window, corner = region_window(region, chain, starts[0, :2], blur, model)
    shifted = starts.copy()
    shifted[:, :2] -= corner
    fit = fit_intervals(window, shifted[0]) if window.of_intervals else fit_window(window, shifted)
    (h, w), m = chain.shape, chain.margin
    middle = np.array([(w - 1) / 2.0 + m, (h - 1) / 2.0 + m])
    off = np.abs(fit.theta[:2] - middle) / np.array([w / 2.0, h / 2.0])
    theta = fit.theta.copy()
    theta[:2] += corner
    return WindowFit(theta, fit.fisher, fit.chi2, fit.converged), off


def region_window(
    region: JpegRegion, chain: ChainModel, uv: Array, blur: SpotBlur, model: SpotModel
) -> tuple[CoefficientWindow, Array]:
    """Window of a region for a spot near (u, v), and the window's first raw pixel (u, v) in the region."""
    row, column = window_at(region, chain, uv)
    (h, w), m = chain.shape, chain.margin
    raw = (slice(row, row + h + 2 * m), slice(column, column + w + 2 * m))
    background, extra = (np.pad(x, m, mode="reflect")[raw] for x in (region.background_e, region.extra_e2))
    # the levels are fitted on top of the background
    pixels = replace(
        SpotPixels.of(chain.filters[None], blur, replace(model, background_e=None)), background_e=background[None]
    )
    corner = np.array([column - m, row - m], float)
    room: tuple[Array | float, Array | float] = 0.0, 0.0
    if region.room is not None and chain.card.output == "mjpeg":
        room = _room(replace(region, image=region.room), chain, (row, column), background, extra.ravel())
    each = outputs_at(region, chain, row, column)
    shared = extra.ravel(), room[0], len(each), region.prnu
    return CoefficientWindow(each.mean(axis=0), chain, pixels, *shared, each, room[1]), corner


def _room(
    region: JpegRegion, chain: ChainModel, place: tuple[int, int], background_e: Array, extra_e2: Array
) -> tuple[Array, Array | float]:
    """Room's coefficients as the region's frames show them.

    Of several frames each coefficient has the posterior of its intervals, which knows more than their mean where the
    noise is a part of a step. The background by itself comes from the frames, too: it counts with a quarter.

    Returns
    -------
    shape (n,)
        Variance besides that of the background.
    shape (n,)
        By how much they differ from the background's.
    """
    each, step = coefficients_at(region, chain, *place), chain.step
    if len(each) == 1:
        return room_variance(each[0], step), 0.0
    mean_e = np.maximum(background_e.ravel(), 0.0)
    at = codes(chain, mean_e)
    F, E = (
        noise_factor(chain, at, x, chain.transform, chain.parts) for x in (raw_variance_e2(chain, mean_e), extra_e2)
    )
    spread = np.einsum("rn,rn->n", F, F) + excess_variance(chain, at, chain.transform, chain.parts) + chain.rounding
    room = room_variance(each.mean(axis=0), step, hidden_share(np.sqrt(spread) / step, len(each)))
    known = np.einsum("rn,rn->n", E, E)
    coarse = np.flatnonzero((spread < step**2) & (room > _HIDDEN * step**2))
    steps, mean = QuantiserSteps.of(each, step).part(coarse), (at.mean @ chain.transform + chain.shift)[coarse]
    found, left = steps.shared(mean, _WEAK * (known + room)[coarse], spread[coarse])
    offset = np.zeros(len(step))
    offset[coarse] = found - mean
    room[coarse] = np.clip(left - known[coarse], 0.0, room[coarse])
    return room, offset


def outputs_at(region: JpegRegion, chain: ChainModel, row: int, column: int) -> Array:
    """Quantised outputs of each frame, shape (f, n), of the window that begins at (row, column) of the region."""
    if chain.card.output == "mjpeg":
        return coefficients_at(region, chain, row, column)
    h, w = window_px(chain.card)
    images = region.image[:, row : row + h, column : column + w]
    if chain.card.output == "yuyv":
        return np.stack([ycbcr_codes(image) for image in images])
    return np.asarray(np.moveaxis(images, -1, 1).reshape(len(images), -1), float)


def coefficients_at(region: JpegRegion, chain: ChainModel, row: int, column: int) -> Array:
    """Quantised coefficients of each frame, shape (f, n), of the window that begins at (row, column)."""
    card, (h, w) = chain.card, chain.shape
    down, across = mcu_px(card.jpeg_subsampling)
    height, width = region.image.shape[1:3]
    top, left = max(row - down, 0), max(column - across, 0)
    bottom, right = min(row + h + down, height), min(column + w + across, width)
    ends = (
        region.ends[0] and top == 0,
        region.ends[1] and bottom == height,
        region.ends[2] and left == 0,
        region.ends[3] and right == width,
    )
    decoded = recovered_coefficients(
        region.image[:, top:bottom, left:right], qtables_of(card), card.jpeg_subsampling, ends
    )
    v, u = row - top, column - left
    luma = decoded.luma[:, v // 8 : (v + h) // 8, u // 8 : (u + w) // 8]
    chroma = decoded.chroma[:, :, v // down : (v + h) // down, u // across : (u + w) // across]
    count = len(region.image)
    return np.concatenate([luma.reshape(count, -1), chroma.reshape(count, -1)], axis=1)
