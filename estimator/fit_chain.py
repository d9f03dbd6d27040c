"""Fit of a spot through the camera's own processing: mosaic, demosaicing, white balance, sRGB curve, 8 bits, JPEG.

`fit_srgb` takes processed 8-bit images, `fit_jpeg` decoded MJPEG ones. Fits to luminance have a floor of 0.1 to 0.25 px
that does not fall with the signal, because a demosaiced, gamma-encoded spot is no Gaussian; a fit of the raw pixels'
model through the same processing has none.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import convolve1d

from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.chain_model import UNIT_MATRIX
from phibench.estimator.code_law import code_law, code_table
from phibench.estimator.fit_raw import LASER_RESPONSE, SpotFit, fit_law
from phibench.estimator.pixel_law import GaussLaw
from phibench.estimator.raw_pixels import PixelNoise, bayer_filters, noise_of
from phibench.estimator.tone_curve import decoded, slope
from phibench.scenes.frames import Array

_UNSHARP_STEPS = 24  # the error falls by amount / (1 + amount) in each


def fit_srgb(
    images: NDArray[Any],
    origin_px: ArrayLike,
    card: SensorCard,
    sigma_px: ArrayLike,
    response: tuple[float, float, float] = LASER_RESPONSE,
    background_e: Array | None = None,
    free_width: bool = False,
    pattern_known: bool = False,
) -> SpotFit:
    """Fit one spot in each region of processed 8-bit images.

    Without sharpening and with the unit colour matrix each pixel's own colour is an interval of electrons, and the
    likelihood is exact (`code_law`). Otherwise sharpening and matrix are undone, and the codes' widths count as noise.

    Parameters
    ----------
    images : shape (n, h, w, 3), uint8
    origin_px : shape (2,) or (n, 2)
        Image pixel (u, v) of the first column and row.
    card : SensorCard
    sigma_px, response, background_e, free_width
        As for `fit_raw`.
    pattern_known : bool
        Whether PRNU and DSNU were calibrated; otherwise they count as noise.

    Raises
    ------
    ValueError
        If the images are not of three planes, or the sensor has no mosaic.
    """
    planes = _checked(images, card)
    origin = np.broadcast_to(np.asarray(origin_px, np.int64), (len(planes), 2))
    filters = bayer_filters(origin, planes.shape[1:3])
    noise = unrounded(card, pattern_known)
    if card.sharpen_amount == 0.0 and card.colour_matrix == UNIT_MATRIX:
        table = code_table(card)
        codes = np.take_along_axis(planes, filters[..., None], axis=3)[..., 0]
        law = code_law(codes, filters, card, noise, table)
        return fit_law(table.middle_e[filters, codes], origin, law, sigma_px, response, background_e, free_width)
    x, extra = undone(planes, filters, card)
    used = (planes < 255).all(axis=3)
    gauss = GaussLaw(PixelNoise(noise.gaussian_e2 + 1.0 / (12.0 * card.dn_per_e**2), noise.prnu), extra)
    return fit_law(x, origin, gauss, sigma_px, response, background_e, free_width, used)


def unrounded(card: SensorCard, pattern_known: bool = False) -> PixelNoise:
    """Noise of a sensor's pixels before the converter rounds; errors as `noise_of`."""
    noise = noise_of(card, pattern_known)
    return PixelNoise(max(noise.gaussian_e2 - 1.0 / (12.0 * card.dn_per_e**2), 0.0), noise.prnu)


def undone(images: NDArray[Any], filters: NDArray[np.int64], card: SensorCard) -> tuple[Array, Array]:
    """Electrons of each pixel's own colour and the variance that 8 bits add, electrons squared, shape (n, h, w) each.

    Undoes, from the end: sharpening, sRGB curve, colour matrix, white balance.

    Parameters
    ----------
    images : shape (n, h, w, 3), codes 0 to 255, whole or not
    filters : shape (n, h, w)
    card : SensorCard
    """
    code = _unsharpened(np.asarray(images, float), card.sharpen_amount) / 255.0
    linear = decoded(code)
    width = 1.0 / (255.0 * np.maximum(slope(np.clip(linear, 0.0, 1.0)), 1e-3))
    inverse = np.linalg.inv(np.asarray(card.colour_matrix)) / np.asarray(card.white_balance)[:, None]
    full_scale_e = (card.top_dn - card.black_level_dn) / card.dn_per_e
    own = inverse[filters] * full_scale_e  # (n, h, w, 3): row of the inverse for the pixel's filter
    return np.sum(own * linear, axis=3), np.sum((own * width) ** 2, axis=3) / 12.0


def _unsharpened(codes: Array, amount: float) -> Array:
    """Solution x of x + amount (x - blur x) = codes, shape (n, h, w, 3), by fixed-point iteration."""
    x = codes
    if amount > 0.0:
        for _ in range(_UNSHARP_STEPS):
            blurred = convolve1d(
                convolve1d(x, (0.25, 0.5, 0.25), axis=1, mode="mirror"), (0.25, 0.5, 0.25), 2, mode="mirror"
            )
            x = (codes + amount * blurred) / (1.0 + amount)
    return x


def _checked(images: NDArray[Any], card: SensorCard) -> NDArray[np.uint8]:
    planes = np.asarray(images)
    if planes.ndim != 4 or planes.shape[3] != 3 or planes.dtype != np.uint8:
        raise ValueError(
            f"images have the shape {planes.shape} and are {planes.dtype}: (n, h, w, 3) of uint8 is needed"
        )
    if card.mosaic != "bayer":
        raise ValueError(
            f"sensor '{card.name}' has the mosaic '{card.mosaic}': the fit through the chain needs 'bayer'"
        )
    return planes
