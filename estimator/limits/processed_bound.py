"""Bound of a spot's position in processed images, or from frames with laser on and off; its table by spot electrons.

"srgb8": the information of each pixel's own code (`pixel_statistics`); interpolated colours are left out. "yuyv" and
"mjpeg", and "srgb8" whose codes sharpening, denoising or a colour matrix mix: J^T C^-1 J of the mean and covariance of
codes or quantised coefficients (M. Stein, A. Mezghani, J. A. Nossek, IEEE Signal Process. Lett. 21, 796, 2014;
`fit_jpeg`). The coefficients carry all that the decoded image does, unless the decoder cuts.

Both are lower bounds of the information. Their inverse is the smallest covariance of estimates that use no more than
the model does; it is no theorem for every method. The Cramer-Rao bound lies between that of the raw pixels
(`position_bound`) and this one.

`spot_sigma` tabulates the bound by the electrons of a round spot over flat levels, for planning.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_factor, cho_solve

from phibench.datasets.exposures.expected_electrons import ExpectedRegion
from phibench.datasets.exposures.pair_draws import FrameCounts
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.limits.position_bound import (
    SpotLimit,
    derivative_images,
    limit_of,
    raw_information,
    without_room,
)
from phibench.estimator.processed.chain_model import (
    ChainModel,
    Codes,
    chain_model,
    code_slopes,
    codes,
    excess_variance,
    noise_factor,
    raw_variance_e2,
)
from phibench.estimator.processed.fit_processed_images import codes_are_independent
from phibench.estimator.processed.fit_processed_region import grid_px
from phibench.estimator.processed.quasi_score import CoefficientWindow
from phibench.estimator.spots.camera_codes import hidden_share, quantised_output
from phibench.estimator.spots.gaussian_spot import (
    LASER_RESPONSE,
    SpotBlur,
    SpotModel,
    SpotPixels,
    covariance_bound,
    fisher_matrix,
)
from phibench.estimator.spots.image_planes import PROCESSED
from phibench.estimator.spots.pixel_statistics import CodeLaw, code_law, code_table, cut_pixels
from phibench.estimator.spots.raw_pixels import bayer_filters, noise_before_rounding
from phibench.scenes.frames import Array

_REACH_PX = 10  # around the spot, for "srgb8"
_SIDE_PX = 16  # of the window of raw pixels
_MCU_PX = (16, 8)  # of 4:2:2; an even number of Bayer cells
_PLASTIC = 1.324717957244746  # root of x^3 = x + 1: steps of 1 / x and 1 / x^2 fill the square most evenly
# from too faint to be found to far beyond saturation, four to a decade: the bound is smooth between them
_FLUXES_E = tuple(float(x) for x in np.geomspace(100.0, 3e6, 19))


# -- bound of one spot -----------------------------------------------------------------------------------------------


def chain_limit(
    card: SensorCard,
    uv_px: ArrayLike,
    blur: SpotBlur,
    flux_e: float,
    background_e: ArrayLike,
    response: tuple[float, float, float] = LASER_RESPONSE,
    pattern_known: bool = False,
) -> SpotLimit:
    """Bound of (u, v) with the flux and one background level per colour filter unknown.

    Parameters
    ----------
    card : SensorCard
        Of the output "srgb8", "yuyv" or "mjpeg".
    uv_px : shape (2,), in the image
    flux_e : float
        Electrons of the whole spot in pixels of response 1, as `SpotFit.flux_e`.
    background_e : shape (3,)
        Electrons of the room per pixel behind R, G, B, dark current included.
    response : 3 floats
        Of the filters at the laser's wavelength.
    pattern_known : bool
        PRNU and DSNU are calibrated; otherwise they count as noise.

    Raises
    ------
    ValueError
        If the output is none of them.
    """
    uv = np.asarray(uv_px, float)
    theta = np.array([*uv, flux_e, *np.asarray(background_e, float)])
    if codes_are_independent(card):
        return _of_codes(card, theta, blur, response, pattern_known)
    if card.output in PROCESSED:
        return _of_window(card, theta, blur, response, pattern_known)
    raise ValueError(
        f"output '{card.output}': chain_limit knows 'srgb8', 'yuyv' and 'mjpeg'; take spot_limit for raw pixels"
    )


def _of_codes(
    card: SensorCard, theta: Array, blur: SpotBlur, response: tuple[float, float, float], known: bool
) -> SpotLimit:
    law, mean, derivatives = spot_codes(card, theta, blur, response, known)
    fisher = fisher_matrix(derivatives[0], law.information(mean)[0])
    return SpotLimit(covariance_bound(fisher), fisher)


def spot_codes(
    card: SensorCard, theta: Array, blur: SpotBlur, response: tuple[float, float, float], pattern_known: bool
) -> tuple[CodeLaw, Array, Array]:
    """Law of the codes about a spot, shape (1, h, w), their pixels' means and derivatives by theta; a camera's own."""
    corner = np.floor(theta[:2]).astype(np.int64) - _REACH_PX
    filters = bayer_filters(corner[None], (2 * _REACH_PX + 2, 2 * _REACH_PX + 2))
    mean, derivatives = SpotPixels.of(filters, blur, SpotModel(response)).at((theta - [*corner, 0, 0, 0, 0])[None])
    law = code_law(
        np.zeros(filters.shape, np.uint8), filters, card, noise_before_rounding(card, pattern_known), code_table(card)
    )
    return law, mean, derivatives


def _of_window(
    card: SensorCard, theta: Array, blur: SpotBlur, response: tuple[float, float, float], known: bool
) -> SpotLimit:
    window, corner = limit_window(card, theta[:2], blur, response, known)
    fisher = window.fisher(theta - np.array([*corner, 0, 0, 0, 0]))
    return SpotLimit(covariance_bound(fisher), fisher)


def limit_window(
    card: SensorCard,
    uv_px: Array,
    blur: SpotBlur,
    response: tuple[float, float, float] = LASER_RESPONSE,
    pattern_known: bool = False,
) -> tuple[CoefficientWindow, Array]:
    """Window of outputs, all 0, that holds a spot at (u, v), and its first raw pixel (u, v); rest as `chain_limit`."""
    model = chain_model(card, noise_before_rounding(card, pattern_known))
    units, sides = np.array(grid_px(card)[::-1]), np.array(model.shape[::-1])
    corner = np.rint((uv_px + 0.5 - sides / 2) / units) * units - model.margin
    pixels = SpotPixels.of(model.filters[None], blur, SpotModel(response))
    return CoefficientWindow(np.zeros(len(model.step)), model, pixels), corner


# -- bound by the electrons of a spot --------------------------------------------------------------------------------


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
    response: tuple[float, float, float] = LASER_RESPONSE,
    places: int = 16,
    flux_e: Sequence[float] = _FLUXES_E,
) -> SpotSigma:
    """Table of the bound for a sensor.

    Parameters
    ----------
    card : SensorCard
        Raw output of a Bayer sensor, "srgb8", "yuyv" or "mjpeg".
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
        covariance = chain_limit(card, uv_px, SpotBlur(sigma_px), flux_e, background_e, response).covariance_px2
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
    """Bound on raw Bayer pixels; full pixels carry nothing."""
    corner = np.floor(uv_px).astype(np.int64) - _SIDE_PX // 2
    filters = bayer_filters(corner[None], (_SIDE_PX, _SIDE_PX))
    pixels = SpotPixels.of(filters, SpotBlur(sigma_px), SpotModel(response))
    mean, derivatives = pixels.at(np.array([[*(uv_px - corner), flux_e, *background_e]]))
    return limit_of(derivatives[0], raw_information(mean[0], card)).covariance_px2


# Bound of a spot's position from frames with the laser on and frames with it off, the room unknown in every pixel.
#
# The other bounds take the room behind the spot as a level per filter, or as known. What is measured is another thing:
# n_on frames show room and spot, n_off frames of the same place show the room, and each pixel's room is an unknown of
# its own. Without those unknowns (Schur complement) a pixel keeps the information J about the spot's light s,
#
# 1 / J = 1 / (n_on I_on) + 1 / (n_off I_off) + (PRNU s)^2,
#
# I_on and I_off being those of one reading. The fixed pattern is shared by all frames of a camera. DSNU, and PRNU of
# the room, are part of the unknown room and cost nothing; PRNU of the spot stays whatever the number of frames.
#
# Behind the camera's processing the room's error goes through the on frame's slopes, as the noise does. The off frames
# of a JPEG count as they are before the quantiser: what its steps hide of the room depends on the room's structure. A
# smooth one has next to no coefficients to hide, a rough one is known to a step. `steps` counts that: with places
# spread evenly in the steps q, the error of a mean of n frames has the variance q^2 / 12 (rho + (1 - rho) / n), and
#
# rho = 6 / pi^2 sum over k of exp(-4 pi^2 k^2 sigma^2 / q^2) / k^2
#
# is its correlation between frames (B. Widrow, I. Kollar, "Quantization Noise", 2008, chapter 6). Without `steps` the
# result is a bound for any room; with them it is what a method reaches that knows nothing of the room's structure.


_LIVE = 2e-3  # variance of an output, in steps squared, below which its coefficient says nothing


def on_off_limit(
    region: ExpectedRegion, card: SensorCard, frames: FrameCounts, pattern_known: bool = False
) -> SpotLimit:
    """Bound of (u, v) on raw pixels; unknown are the flux and the room of each pixel.

    Parameters
    ----------
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
    if codes_are_independent(card):
        return _off_frames_of_codes(card, theta, blur, response, frames)
    if card.output in PROCESSED:
        return _off_frames_of_window(card, theta, blur, response, frames, steps)
    raise ValueError(f"output '{card.output}': 'srgb8', 'yuyv' and 'mjpeg' are known; take on_off_limit for raw pixels")


def _off_frames_of_codes(
    card: SensorCard, theta: Array, blur: SpotBlur, response: tuple[float, float, float], frames: FrameCounts
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
    factor = noise_factor(model, at, cut.variance_e2, model.transform, model.parts)
    rest = excess_variance(model, at, model.transform, model.parts) + model.rounding
    return _Readings(at, cut.slope, factor, rest, at.mean @ model.transform + model.shift)


def _off_frames_of_window(
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
    output = quantised_output(on.mean, on.sigma, model.step)
    noise = (on.factor * output.slope).T @ (on.factor * output.slope)
    np.fill_diagonal(noise, output.variance)
    extra_e2 = raw_variance_e2(model, mean_e - spot) / frames.off + (card.prnu * spot) ** 2
    E = noise_factor(model, on.at, on.slope**2 * extra_e2, model.transform, model.parts) * output.slope
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
