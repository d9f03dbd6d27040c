"""What a spot of so many electrons can be known to: the bound of one coordinate, mean over the sub-pixel places.

A round spot of the lens's blur over flat levels: what the strength of the light alone says, for planning. The bound of
one given spot is `limits.spot_limit` or `chain_limit.chain_limit`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.chain_limit import chain_limit
from phibench.estimator.limits import limit_of
from phibench.estimator.pixel_information import approximate_information
from phibench.estimator.raw_pixels import bayer_filters, noise_of
from phibench.estimator.spot_means import SpotMeans
from phibench.scenes.frames import Array

_SIDE_PX = 16
_MCU_PX = (16, 8)  # of 4:2:2; an even number of Bayer cells
_PLASTIC = 1.324717957244746  # root of x^3 = x + 1
_FLUXES_E = tuple(float(x) for x in np.geomspace(100.0, 3e6, 19))


@dataclass(frozen=True)
class SpotSigma:
    """Bound of one coordinate by the electrons of the spot.

    Attributes
    ----------
    flux_e : tuple of float
        Electrons behind the red filter, rising.
    sigma_px : tuple of float
        Root mean square over places of the bound of u and v; infinite where pixels tell nothing.
    """

    flux_e: tuple[float, ...]
    sigma_px: tuple[float, ...]

    def at(self, flux_e: ArrayLike) -> Array:
        """Bound, shape of `flux_e`, pixels; log-log interpolation, infinite beyond the table."""
        x, y = np.log(self.flux_e), np.log(self.sigma_px)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.exp(np.interp(np.log(flux_e), x, y, left=np.inf, right=np.inf)))


def spot_sigma(
    card: SensorCard,
    blur_sigma_px: float,
    background_e: Sequence[float],
    response: tuple[float, float, float] = (1.0, 0.10, 0.03),
    places: int = 16,
    flux_e: Sequence[float] = _FLUXES_E,
) -> SpotSigma:
    """Table of the bound for a sensor.

    Parameters
    ----------
    card : SensorCard
        Raw output of a Bayer sensor, "srgb8" or "mjpeg".
    blur_sigma_px : float
        Of the spot's image.
    background_e : 3 floats
        Electrons of the room per pixel behind R, G, B.
    response : 3 floats
        Of the filters at the laser's wavelength.
    places : int
        Sub-pixel places over 16 x 8 pixels, whole JPEG units and Bayer cells: 16 are within 2 % of thousands.
    flux_e : electrons of the spot, rising
    """
    where = (_even_places(places) + 100.0) * np.array(_MCU_PX)
    rows = [[_variance_px2(card, uv, blur_sigma_px, x, background_e, response) for uv in where] for x in flux_e]
    return SpotSigma(tuple(flux_e), tuple(math.sqrt(x) for x in np.mean(rows, axis=1)))


def _even_places(count: int) -> Array:
    """Points spread over the unit square, shape (count, 2): multiples of two irrational steps.

    Sequences of dyadic fractions (Halton, Sobol) will not do: 16 of them lie on whole pixels of a unit of 16, all in
    the same place of the Bayer cell, where the bound is 15 % worse than its mean.
    """
    steps = np.array([1.0 / _PLASTIC, 1.0 / _PLASTIC**2])
    return (0.5 + np.arange(count)[:, None] * steps) % 1.0


def _variance_px2(
    card: SensorCard,
    uv_px: Array,
    sigma_px: float,
    flux_e: float,
    background_e: Sequence[float],
    response: tuple[float, float, float],
) -> float:
    """Mean variance of u and v at the bound of one spot; infinite where there is none."""
    if card.output == "raw":
        covariance = _raw_covariance(card, uv_px, sigma_px, flux_e, background_e, response)
    else:
        covariance = chain_limit(card, uv_px, sigma_px, flux_e, np.asarray(background_e), response).covariance_px2
    variance = float(np.trace(covariance)) / 2.0
    return variance if math.isfinite(variance) else math.inf


def _raw_covariance(
    card: SensorCard,
    uv_px: Array,
    sigma_px: float,
    flux_e: float,
    background_e: Sequence[float],
    response: tuple[float, float, float],
) -> Array:
    """Bound on raw Bayer pixels; a pixel expected within three deviations of saturation tells nothing."""
    corner = np.floor(uv_px).astype(np.int64) - _SIDE_PX // 2
    filters = bayer_filters(corner[None], (_SIDE_PX, _SIDE_PX))[0]
    means = SpotMeans(filters, response, np.zeros(filters.size), sigma_px)
    mean, derivatives = means.at(np.array([[*(uv_px - corner), flux_e, *background_e]]))
    mean_e = mean.reshape(filters.shape)
    information = approximate_information(mean_e, noise_of(card))
    information = np.where(mean_e + 3.0 * np.sqrt(mean_e) < card.saturation_e, information, 0.0)
    return limit_of(derivatives[0].reshape(-1, *filters.shape), information).covariance_px2
