"""Bound of a spot's position behind the camera's processing, from the estimator's own model: no frame is drawn.

For "srgb8" the information of each pixel's own code (`code_law`), for "mjpeg" the bound J^T C^-1 J of Stein, Mezghani
and Nossek (2014) with the mean and covariance of the quantised coefficients (`jpeg_fit`). The coefficients carry all
that the decoded image does, as long as the decoder cuts nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.chain_model import chain_model
from phibench.estimator.code_law import code_law, code_table
from phibench.estimator.fisher import covariance_bound, fisher_matrix
from phibench.estimator.fit_chain import unrounded
from phibench.estimator.fit_raw import LASER_RESPONSE
from phibench.estimator.jpeg_fit import Window
from phibench.estimator.jpeg_tables import mcu_px
from phibench.estimator.limits import SpotLimit
from phibench.estimator.raw_pixels import bayer_filters
from phibench.estimator.spot_means import SpotMeans
from phibench.scenes.frames import Array

_REACH_PX = 10  # around the spot, for "srgb8"


def chain_limit(
    card: SensorCard,
    uv_px: ArrayLike,
    sigma_px: float,
    flux_e: float,
    background_e: ArrayLike,
    response: tuple[float, float, float] = LASER_RESPONSE,
    ratio: float = 1.0,
    pattern_known: bool = False,
) -> SpotLimit:
    """Bound of (u, v) with the flux and one background level per colour filter unknown.

    Parameters
    ----------
    card : SensorCard
        Of the output "srgb8" or "mjpeg".
    uv_px : shape (2,), in the image
    sigma_px, ratio : float
        Blur along u, and that along v over it.
    flux_e : float
        Electrons of the whole spot in pixels of response 1, as `SpotFit.flux_e`.
    background_e : shape (3,)
        Electrons of the room per pixel behind R, G, B, dark current included.
    response : 3 floats
        Of the filters at the laser's wavelength.
    pattern_known : bool
        Whether PRNU and DSNU are calibrated.

    Raises
    ------
    ValueError
        If the output is neither of the two.
    """
    uv = np.asarray(uv_px, float)
    theta = np.array([*uv, flux_e, *np.asarray(background_e, float)])
    if card.output == "srgb8":
        return _of_codes(card, theta, sigma_px, response, ratio, pattern_known)
    if card.output == "mjpeg":
        return _of_coefficients(card, theta, sigma_px, response, ratio, pattern_known)
    raise ValueError(
        f"output '{card.output}': chain_limit knows 'srgb8' and 'mjpeg'; take limits.spot_limit for raw pixels"
    )


def _of_codes(
    card: SensorCard, theta: Array, sigma_px: float, response: tuple[float, float, float], ratio: float, known: bool
) -> SpotLimit:
    corner = np.floor(theta[:2]).astype(np.int64) - _REACH_PX
    filters = bayer_filters(corner[None], (2 * _REACH_PX + 2, 2 * _REACH_PX + 2))
    theta = theta - np.array([*corner, 0, 0, 0, 0])
    means = SpotMeans(filters[0], response, np.zeros(filters.size), sigma_px, ratio)
    mean, derivatives = means.at(theta[None])
    law = code_law(np.zeros(filters.shape, np.uint8), filters, card, unrounded(card, known), code_table(card))
    information = law.information(mean.reshape(filters.shape))[0]
    fisher = fisher_matrix(derivatives[0].reshape(-1, *information.shape), information)
    return SpotLimit(covariance_bound(fisher), fisher)


def _of_coefficients(
    card: SensorCard, theta: Array, sigma_px: float, response: tuple[float, float, float], ratio: float, known: bool
) -> SpotLimit:
    model = chain_model(card, unrounded(card, known))
    down, across = mcu_px(card.jpeg_subsampling)
    units = np.array([across, down])
    corner = (np.rint((theta[:2] + 0.5) / units) - 1.0) * units - model.margin
    theta = theta - np.array([*corner, 0, 0, 0, 0])
    means = SpotMeans(model.filters, response, np.zeros(model.filters.size), sigma_px, ratio)
    fisher = Window(np.zeros(len(model.step)), model, means).fisher(theta)
    return SpotLimit(covariance_bound(fisher), fisher)
