"""Statistics of a room's image: levels, contrast, gradients and power spectrum, comparable between cameras.

Images are bands of a panorama: columns are azimuths and close on themselves. Light is compared on one scale: white is
the 97 % quantile of luminance, brighter light is cut off as a sensor does, and black is white / 255.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
QUANTILES = 256  # of the gradients of an image
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709
_WHITE, _BLACK = 97.0, 1.0 / 255.0  # percentile; of white
_FLAT, _EDGE = 0.02, 0.5  # steps of ln luminance: below the noise of a camera; a factor of 1.65
_LOWEST = 4  # cycles a turn: what is wider depends on where the windows are
_HIGHEST = 3.0 / 16.0  # cycles a column: above, cameras blur differently


@dataclass(frozen=True)
class ImageStatistics:
    """Statistics of one image.

    Attributes
    ----------
    red, green, blue : float
        Mean level of a band, white = 1.
    contrast : float
        Standard deviation of ln luminance.
    slope : float
        Exponent s of the power spectrum 1/f^s of ln luminance along the rows; 1/f^(s + 1) over the image's plane.
    mean_step : float
        Mean absolute difference of ln luminance between neighbours along the rows.
    flat, edges : float
        Parts of these differences below 0.02, and above 0.5.
    steps : array, shape (QUANTILES,)
        Their quantiles.
    """

    red: float
    green: float
    blue: float
    contrast: float
    slope: float
    mean_step: float
    flat: float
    edges: float
    steps: Array


def image_statistics(light: NDArray[Any]) -> ImageStatistics:
    """Statistics of linear light, shape (rows, columns, 3), any unit; rows with values not finite are left out.

    Raises
    ------
    ValueError
        If less than two rows of 64 columns are left, or nothing shines.
    """
    seen = np.asarray(light, float)[np.isfinite(light).all(axis=(1, 2))]
    if len(seen) < 2 or seen.shape[1] < 64:
        raise ValueError(f"an image of {light.shape[1]} columns and {len(seen)} seen rows: give 64 and 2 or more")
    white = float(np.percentile(seen @ _LUMINANCE, _WHITE))
    if not white > 0.0:
        raise ValueError("the image is black")
    relative = np.clip(seen / white, 0.0, 1.0)
    tone = np.log(np.maximum(relative @ _LUMINANCE, _BLACK))
    step = np.abs(np.roll(tone, -1, axis=1) - tone)
    red, green, blue = (float(level) for level in relative.mean(axis=(0, 1)))
    return ImageStatistics(
        red,
        green,
        blue,
        float(tone.std()),
        spectrum_slope(tone),
        float(step.mean()),
        float((step < _FLAT).mean()),
        float((step > _EDGE).mean()),
        np.quantile(step, (np.arange(QUANTILES) + 0.5) / QUANTILES),
    )


def spectrum_slope(rows: Array) -> float:
    """Exponent s of the mean power spectrum 1/f^s of periodic rows, shape (N, columns); octaves weigh the same."""
    columns = rows.shape[1]
    frequency = np.arange(_LOWEST, int(_HIGHEST * columns) + 1)
    power = (np.abs(np.fft.rfft(rows, axis=1)) ** 2).mean(axis=0)[frequency]
    x, y, weight = np.log(frequency), np.log(np.maximum(power, 1e-30)), 1.0 / frequency
    x0, y0 = np.average(x, weights=weight), np.average(y, weights=weight)
    return -float(np.sum(weight * (x - x0) * (y - y0)) / np.sum(weight * (x - x0) ** 2))
