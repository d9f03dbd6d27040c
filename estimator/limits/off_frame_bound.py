"""Bound of a spot's position from frames with the laser on and frames with it off, the room unknown in every pixel.

The other bounds take the room behind the spot as a level per filter, or as known. What is measured is another thing:
n_on frames show room and spot, n_off frames of the same place show the room, and each pixel's room is an unknown of its
own. Without those unknowns (Schur complement) a pixel keeps the information J about the spot's light s,

    1 / J = 1 / (n_on I_on) + 1 / (n_off I_off) + (PRNU s)^2,

I_on and I_off being those of one reading. The fixed pattern is shared by all frames of a camera. DSNU, and PRNU of the
room, are part of the unknown room and cost nothing; PRNU of the spot stays whatever the number of frames.

Behind the camera's processing the room's error goes through the on frame's slopes, as the noise does. The off frames
of a JPEG count as they are before the quantiser: what its steps hide of the room depends on the room's structure. A
smooth one has next to no coefficients to hide, a rough one is known to a step. `steps` counts that: with places spread
evenly in the steps q, the error of a mean of n frames has the variance q^2 / 12 (rho + (1 - rho) / n), and

    rho = 6 / pi^2 sum over k of exp(-4 pi^2 k^2 sigma^2 / q^2) / k^2

is its correlation between frames (B. Widrow, I. Kollar, "Quantization Noise", 2008, chapter 6). Without `steps` the
result is a bound for any room; with them it is what a method reaches that knows nothing of the room's structure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_factor, cho_solve

from phibench.datasets.exposures.expected import ExpectedRegion
from phibench.datasets.exposures.pair_draws import FrameCounts
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.limits.position_bound import (
    SpotLimit,
    derivative_images,
    limit_of,
    raw_information,
    without_room,
)
from phibench.estimator.limits.processed_bound import limit_window, spot_codes
from phibench.estimator.processed.chain_model import (
    ChainModel,
    Codes,
    code_slopes,
    codes,
    excess_variance,
    noise_factor,
    raw_variance_e2,
)
from phibench.estimator.processed.fit_chain import own_codes
from phibench.estimator.spots.fisher import covariance_bound, fisher_matrix
from phibench.estimator.spots.gaussian_spot import LASER_RESPONSE, SpotBlur
from phibench.estimator.spots.image_planes import PROCESSED
from phibench.estimator.spots.jpeg_coefficients import hidden_share, quantised
from phibench.estimator.spots.pixel_statistics import cut_pixels
from phibench.scenes.frames import Array

_LIVE = 2e-3  # variance of an output, in steps squared, below which its coefficient says nothing


def on_off_limit(
    region: ExpectedRegion, card: SensorCard, frames: FrameCounts, pattern_known: bool = False
) -> SpotLimit:
    """Bound of (u, v) on raw pixels; unknown are the flux and the room of each pixel.

    Parameters
    ----------
    region : ExpectedRegion
    card : SensorCard
    frames : FrameCounts
    pattern_known : bool
        PRNU is calibrated and taken out.
    """
    on, off = (raw_information(mean, card, pattern_known=True) for mean in (region.mean_e, region.background_e))
    prnu = 0.0 if pattern_known else card.prnu
    return limit_of(derivative_images(region, "flux"), without_room(on, off, region.spot_e, frames, prnu))


def processed_on_off_limit(
    card: SensorCard,
    uv_px: ArrayLike,
    blur: SpotBlur,
    flux_e: float,
    background_e: ArrayLike,
    frames: FrameCounts,
    response: tuple[float, float, float] = LASER_RESPONSE,
    steps: bool = False,
) -> SpotLimit:
    """Bound of (u, v) behind the camera's processing; unknown are the flux and the room of each pixel.

    Parameters
    ----------
    card : SensorCard
        Of the output "srgb8", "yuyv" or "mjpeg"; with `prnu` 0 where the pattern is calibrated and taken out.
    frames : FrameCounts
    uv_px, blur, flux_e, background_e, response
        As for `processed_bound.chain_limit`; `background_e` says how bright the room is, a method does not know it.
    steps : bool
        Of "mjpeg": the steps hide each of the room's coefficients, as of a room with structure everywhere.

    Raises
    ------
    ValueError
        If the output is none of the three.
    """
    theta = np.array([*np.asarray(uv_px, float), flux_e, *np.asarray(background_e, float)])
    if own_codes(card):
        return _of_codes(card, theta, blur, response, frames)
    if card.output in PROCESSED:
        return _of_window(card, theta, blur, response, frames, steps)
    raise ValueError(f"output '{card.output}': 'srgb8', 'yuyv' and 'mjpeg' are known; take on_off_limit for raw pixels")


def _of_codes(
    card: SensorCard,
    theta: Array,
    blur: SpotBlur,
    response: tuple[float, float, float],
    frames: FrameCounts,
) -> SpotLimit:
    law, mean, derivatives = spot_codes(card, theta, blur, response, pattern_known=True)
    spot = theta[2] * derivatives[:, 2]
    J = without_room(law.information(mean), law.information(mean - spot), spot, frames, card.prnu)
    fisher = fisher_matrix(derivatives[0, :3], J[0])
    return SpotLimit(covariance_bound(fisher), fisher)


# -- windows of codes, or of a JPEG's coefficients ---------------------------------------------------------------------


@dataclass(frozen=True)
class _Readings:
    """Outputs of one frame at its means: codes, factor of the noise from raw pixels, and the rest of it.

    Attributes
    ----------
    at : Codes
    slope : shape (r,), of the raw pixels' means below the full well
    factor : shape (r, n), F of which F^T F is the covariance by the raw pixels
    rest : shape (n,), variance by roundings
    mean : shape (n,), before the quantiser
    """

    at: Codes
    slope: Array
    factor: Array
    rest: Array
    mean: Array

    @property
    def sigma(self) -> Array:
        """Standard deviation before the quantiser, shape (n,)."""
        return np.sqrt(np.einsum("rn,rn->n", self.factor, self.factor) + self.rest)


def _readings(model: ChainModel, mean_e: Array) -> _Readings:
    """Outputs for means of the raw pixels, shape (r,)."""
    cut = cut_pixels(mean_e, raw_variance_e2(model, mean_e), model.card.saturation_e)
    at = codes(model, cut.mean_e)
    factor = noise_factor(model, at, cut.variance_e2, model.transform)
    rest = excess_variance(model, at, model.transform) + model.rounding
    return _Readings(at, cut.slope, factor, rest, at.mean @ model.transform + model.shift)


def _of_window(
    card: SensorCard,
    theta: Array,
    blur: SpotBlur,
    response: tuple[float, float, float],
    frames: FrameCounts,
    steps: bool,
) -> SpotLimit:
    window, corner = limit_window(card, theta[:2], blur, response, pattern_known=True)
    model = window.model
    mean, derivatives = window.pixels.at((theta - np.array([*corner, 0, 0, 0, 0]))[None])
    D = derivatives[0, :3].reshape(3, -1)
    spot, mean_e = theta[2] * D[2], mean.ravel()
    on, off = _readings(model, mean_e), _readings(model, mean_e - spot)
    output = quantised(on.mean, on.sigma, model.step)
    noise = (on.factor * output.slope).T @ (on.factor * output.slope)
    np.fill_diagonal(noise, output.variance)
    extra_e2 = raw_variance_e2(model, mean_e - spot) / frames.off + (card.prnu * spot) ** 2
    E = noise_factor(model, on.at, on.slope**2 * extra_e2, model.transform) * output.slope
    room = off.rest / frames.off + (_hidden(off, model.step, frames.off) if steps else 0.0)
    C = noise / frames.on + E.T @ E + np.diag(output.slope**2 * room)
    J = (code_slopes(model, on.at, D * on.slope) @ model.transform) * output.slope
    live = output.variance > _LIVE * model.step**2
    if not live.any():
        return SpotLimit(np.full((2, 2), np.nan), np.zeros((3, 3)))
    fisher = J[:, live] @ cho_solve(cho_factor(C[np.ix_(live, live)], lower=True), J[:, live].T)
    return SpotLimit(covariance_bound(fisher), fisher)


def _hidden(off: _Readings, step: Array, count: int) -> Array:
    """Variance of the room's coefficients by the quantiser in a mean of off frames, shape (n,)."""
    return np.asarray(step**2 / 12.0 * hidden_share(off.sigma / step, count))  # a uniform error over one step
