"""Raw pixels as an estimator sees them: electrons from DN, the filter of each pixel, the noise of each pixel.

Integer (u, v) are pixel centres. RGGB: red at even row and even column of the image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phibench.datasets.sensor_card import SensorCard
from phibench.scenes.frames import Array


@dataclass(frozen=True)
class PixelNoise:
    """Variance of a pixel with the mean mu: mu + gaussian_e2 + (prnu mu)^2, electrons squared.

    Parameters
    ----------
    gaussian_e2 : float
        What does not depend on the light: read noise, DSNU, rounding.
    prnu : float
        Relative spread of the responsivity that nobody has calibrated.
    """

    gaussian_e2: float
    prnu: float = 0.0

    def __post_init__(self) -> None:
        if not self.gaussian_e2 >= 0.0 or not 0.0 <= self.prnu < 1.0:
            raise ValueError(
                f"PixelNoise: gaussian_e2 = {self.gaussian_e2:g} must be 0 or above and prnu = {self.prnu:g} in [0, 1)"
            )

    def variance_e2(self, mean_e: Array) -> Array:
        """Variance for means of any shape; a mean below 0, which a fit may try, counts as 0."""
        mean = np.maximum(mean_e, 0.0)
        return mean + self.gaussian_e2 + (self.prnu * mean) ** 2


def noise_of(card: SensorCard, pattern_known: bool = False) -> PixelNoise:
    """Noise of a sensor's pixels.

    Parameters
    ----------
    card : SensorCard
    pattern_known : bool
        Whether PRNU and DSNU of the camera were calibrated and taken out; otherwise they count as noise.

    Raises
    ------
    ValueError
        If the sensor has row noise, which is common to the pixels of a row, or no shot noise.
    """
    if card.row_noise_e > 0.0 or not card.shot_noise:
        raise ValueError(
            f"sensor '{card.name}': row_noise_e = {card.row_noise_e:g}, shot_noise = {card.shot_noise}; independent "
            "pixels need row_noise_e = 0 and shot noise: take processed_fisher with the covariance of the pixels"
        )
    rounding_e2 = 1.0 / (12.0 * card.dn_per_e**2)
    fixed_e2 = 0.0 if pattern_known else card.dsnu_e**2
    return PixelNoise(card.read_noise_e**2 + fixed_e2 + rounding_e2, 0.0 if pattern_known else card.prnu)


def raw_electrons(dn: NDArray[Any], card: SensorCard) -> Array:
    """Electrons of DN: black level taken off, divided by the system gain."""
    return (np.asarray(dn, float) - card.black_level_dn) / card.dn_per_e


def bayer_filters(origin_px: ArrayLike, shape: tuple[int, int]) -> NDArray[np.int64]:
    """Filter of each pixel, 0, 1, 2 for R, G, B, shape (n, h, w).

    Parameters
    ----------
    origin_px : shape (n, 2)
        Image pixel (u, v) of each region's first column and row.
    shape : (h, w)
    """
    origin = np.asarray(origin_px, np.int64)
    v = (origin[:, 1, None] + np.arange(shape[0])) % 2
    u = (origin[:, 0, None] + np.arange(shape[1])) % 2
    return v[:, :, None] + u[:, None, :]
