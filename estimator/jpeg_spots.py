"""Windows of decoded MJPEG images around spots: where they lie, what is in them, and the fit of each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.estimator.chain_model import ChainModel
from phibench.estimator.jpeg_fit import JpegFit, Window, fit_window
from phibench.estimator.jpeg_recovery import recovered
from phibench.estimator.jpeg_tables import mcu_px
from phibench.estimator.room_coefficients import room_variance
from phibench.estimator.spot_blur import SpotBlur
from phibench.estimator.spot_means import SpotMeans
from phibench.scenes.frames import Array


@dataclass(frozen=True)
class Region:
    """One decoded region on the grid of JPEG units.

    Attributes
    ----------
    image : shape (h, w, 3), uint8
    ends : 4 booleans
        Whether top, bottom, left and right side are the image's own.
    base_e, extra_e2 : shape (h, w)
        Base of the raw pixels, and the variance of its error.
    room : shape (h, w, 3), uint8, optional
        Decoded frame without the laser that the base was taken from.
    """

    image: NDArray[Any]
    ends: tuple[bool, bool, bool, bool]
    base_e: Array
    extra_e2: Array
    room: NDArray[Any] | None = None


def window_at(region: Region, model: ChainModel, uv: Array) -> tuple[int, int]:
    """First row and column, in the region, of the 2 x 2 units that have (u, v) nearest to their middle."""
    sides = mcu_px(model.card.jpeg_subsampling)
    places = []
    for centre, unit, size in zip((uv[1], uv[0]), sides, region.image.shape[:2], strict=True):
        first = int(np.clip(np.rint((centre + 0.5) / unit) - 1, 0, size // unit - 2))
        places.append(first * unit)
    return places[0], places[1]


def fit_region(
    region: Region, model: ChainModel, starts: Array, blur: SpotBlur, free_width: bool, response: Any
) -> tuple[JpegFit, Array]:
    """Fit the spot of one region.

    Parameters
    ----------
    starts : shape (s, 6) or (s, 7)
        u, v in the region, flux, levels on top of the base, width if it is free.
    blur : SpotBlur
    free_width, response
        As `SpotMeans`.

    Returns
    -------
    JpegFit
        Positions in the region.
    shape (2,)
        Distance of (u, v) from the window's middle, in half windows: above 1 it lies outside.
    """
    row, column = window_at(region, model, starts[0, :2])
    (h, w), m = model.shape, model.margin
    raw = (slice(row, row + h + 2 * m), slice(column, column + w + 2 * m))
    base, extra = (np.pad(x, m, mode="reflect")[raw].ravel() for x in (region.base_e, region.extra_e2))
    means = SpotMeans(model.filters, response, base, blur.sigma_px, blur.ratio, blur.mixed_px2, free_width)
    corner = np.array([column - m, row - m], float)
    shifted = starts.copy()
    shifted[:, :2] -= corner
    room: Array | float = 0.0
    if region.room is not None:
        room = room_variance(coefficients_at(replace(region, image=region.room), model, row, column), model.step)
    fit = fit_window(Window(coefficients_at(region, model, row, column), model, means, extra, room), shifted)
    middle = np.array([(w - 1) / 2.0 + m, (h - 1) / 2.0 + m])
    off = np.abs(fit.theta[:2] - middle) / np.array([w / 2.0, h / 2.0])
    theta = fit.theta.copy()
    theta[:2] += corner
    return JpegFit(theta, fit.fisher, fit.chi2, fit.converged), off


def coefficients_at(region: Region, model: ChainModel, row: int, column: int) -> Array:
    """Quantised coefficients, shape (n,), of the window that begins at (row, column) of the region."""
    card, (h, w) = model.card, model.shape
    down, across = mcu_px(card.jpeg_subsampling)
    height, width = region.image.shape[:2]
    top, left = max(row - down, 0), max(column - across, 0)
    bottom, right = min(row + h + down, height), min(column + w + across, width)
    ends = (
        region.ends[0] and top == 0,
        region.ends[1] and bottom == height,
        region.ends[2] and left == 0,
        region.ends[3] and right == width,
    )
    found = recovered(region.image[None, top:bottom, left:right], card.jpeg_quality, card.jpeg_subsampling, ends)
    v, u = row - top, column - left
    luma = found.luma[0, v // 8 : (v + h) // 8, u // 8 : (u + w) // 8]
    chroma = found.chroma[0, :, v // down : (v + h) // down, u // across : (u + w) // across]
    return np.concatenate([luma.ravel(), chroma.ravel()])
