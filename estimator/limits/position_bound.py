"""Cramer-Rao bound of one spot on raw pixels (position, phi, and D of a pair); signal to noise, raw and processed.

The bound sums the Fisher information of the pixels about their means mu, in electrons^-2. Three models of the noise:

* approximate: 1 / variance, with mu + r^2 for Poisson plus Gauss (F. Huang et al., Nature Methods 10, 653, 2013);
* exact: the convolution of a Poisson with a normal distribution, integrated;
* quantised: the converter's codes, summed, with full well and both ends of the converter.

The first two hold for pixels that nothing cuts. Both are multiplied by `censored_share`, what saturation leaves.

Unknowns besides u and v: the spot's flux, because laser, albedo and speckle are not known to a per cent; and one
background level per colour filter, because the colour of the room behind the spot is not known. With a laser-off frame
the levels may count as known. Speckle flicker scales the whole spot, so that the unknown flux covers it.

**Signal to noise** is one number for all outputs of a camera, rising with the light. With s the spot's light, b the
room's and F(m) the Fisher matrix of the image for the mean light m, it is the length of the way from the image without
the spot to that with it,

    SNR = integral from 0 to 1 of sqrt(s^T F(b + t s) s) dt,

place and room known (C. R. Rao, Bull. Calcutta Math. Soc. 37, 81, 1945). Of constant Gaussian noise this is the
matched filter's ratio. Of Poisson noise it is 2 (sqrt(b + s) - sqrt(b)) per pixel. Its square is twice the expected
logarithm of the likelihood ratio as long as the noise changes little on the way. More light makes the way longer: full
pixels, whose information is 0, add nothing and take nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike
from scipy.special import log_ndtr, ndtr

from phibench.datasets.exposures.expected_electrons import ExpectedRegion
from phibench.datasets.exposures.pair_draws import FrameCounts
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.geometry.phi import PhiEstimate, estimate_phi
from phibench.estimator.geometry.rig_parameters import rig_gradient
from phibench.estimator.geometry.status import StatusArray
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.spots.gaussian_spot import covariance_bound, fisher_matrix
from phibench.estimator.spots.raw_pixels import noise_of
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig, View
from phibench.scenes.validation import nearest

_SIGMAS = 9.0  # tails of 1e-19 are left out
_NODES = 48  # of the spline; see the test of its error
_GAUSSIAN_FROM_E = 3000.0  # there the exact value is within 1e-4 of the approximate one
_PURE_POISSON_E = 0.1  # below this read noise counts are resolved: 1 / mu
_FREE_SIGMAS = 8.0  # below saturation, from where on nothing is lost: z phi(z) = 4e-14
_FULL_SIGMAS = 4.0  # above saturation, from where on a pixel counts as full: one reading in 30 000 is not

Unknown = Literal["position", "flux", "flux+background"]
NoiseModel = Literal["approximate", "exact", "quantised"]
UNKNOWNS: tuple[Unknown, ...] = ("position", "flux", "flux+background")
NOISE_MODELS: tuple[NoiseModel, ...] = ("approximate", "exact", "quantised")


# -- information of one pixel ------------------------------------------------------------------------------------------


def raw_information(
    mean_e: Array, card: SensorCard, model: NoiseModel = "approximate", pattern_known: bool = False
) -> Array:
    """Information of a sensor's raw pixels about their means, shape of `mean_e`, electrons^-2.

    Parameters
    ----------
    mean_e : array of any shape
        Expected electrons.
    card : SensorCard
        Sensor whose noise counts.
    model : str
        As for `spot_limit`.
    pattern_known : bool
        As for `spot_limit`.

    Raises
    ------
    ValueError
        If there is no such model, or the sensor's pixels are not independent (`noise_of`).
    """
    if model not in NOISE_MODELS:
        raise ValueError(f"noise model '{model}': {nearest(model, NOISE_MODELS)}")
    noise = noise_of(card, pattern_known)
    if model == "quantised":
        return quantised_information(mean_e, card, pattern_known)
    variance = noise.variance_e2(mean_e)
    uncut = 1.0 / variance if model == "approximate" else exact_information(mean_e, noise.gaussian_e2)
    return uncut * censored_share(mean_e, variance, card.saturation_e)


def without_room(on: Array, off: Array, spot_e: Array, frames: FrameCounts, prnu: float) -> Array:
    """Information of pixels about the spot's light, electrons^-2, shape of `on`; the room is an unknown of each.

    Parameters
    ----------
    on, off : array
        Information of one reading with and without the laser, pattern left out.
    spot_e : array
        Electrons of the spot.
    frames : FrameCounts
        Frames with the laser on and off.
    prnu : float
        Relative, unknown.
    """
    with np.errstate(divide="ignore"):
        # variances of on and off add, and so does the pattern of the spot, which no mean removes
        return np.asarray(1.0 / (1.0 / (frames.on * on) + 1.0 / (frames.off * off) + (prnu * spot_e) ** 2))


def censored_share(mean_e: Array, variance_e2: Array, saturation_e: float) -> Array:
    """Part of a pixel's information that censoring at saturation leaves, 0 to 1, shape of `mean_e`.

    A reading is a Gaussian X with the score (X - mu) / V, or it says only that X >= W. With z = (W - mu) / sqrt(V) the
    mean square of the score is, in units of 1 / V,

        Phi(z) - z phi(z) + phi(z)^2 / (1 - Phi(z)).

    Its first two terms are the readings below W, the third is what the chance of a full pixel says. With its mean 2
    deviations below W a pixel keeps 99.7 %, at W 82 %, at 2 and 3 deviations above W 14 % and 1.7 %, from 4 on nothing.

    Parameters
    ----------
    mean_e : array of any shape
        Expected electrons.
    variance_e2 : array
        Of the noise; shape of `mean_e`.
    saturation_e : float
        W, `SensorCard.saturation_e`.
    """
    # a full well may be infinite
    z = np.clip((saturation_e - mean_e) / np.sqrt(variance_e2), -2.0 * _FULL_SIGMAS, 2.0 * _FREE_SIGMAS)
    log_density = -0.5 * (z * z + np.log(2.0 * np.pi))
    # information of a normal law that is cut off at z: uncut part, edge, and the counted rest
    share = ndtr(z) - z * np.exp(log_density) + np.exp(2.0 * log_density - log_ndtr(-z))
    return np.where(z > _FREE_SIGMAS, 1.0, np.where(z < -_FULL_SIGMAS, 0.0, np.minimum(share, 1.0)))


def exact_information(mean_e: Array, gaussian_e2: float) -> Array:
    """Information of Poisson plus Gaussian noise, shape of `mean_e`.

    Parameters
    ----------
    mean_e : array of any shape
        Expected electrons, 0 or above.
    gaussian_e2 : float
        Variance of the Gaussian part, electrons squared.
    """
    mean = np.asarray(mean_e, float)
    r = float(np.sqrt(gaussian_e2))
    if r < _PURE_POISSON_E:
        return 1.0 / mean
    scale = mean + gaussian_e2
    return _interpolated(np.minimum(mean, _GAUSSIAN_FROM_E), r) / scale


def _interpolated(mean: Array, r: float) -> Array:
    """J (mu + r^2), which is smooth and near 1, through nodes where there are many values."""
    flat = mean.ravel()
    if flat.size <= _NODES or np.ptp(flat) == 0.0:
        values = {mu: _poisson_gauss(mu, r) * (mu + r * r) for mu in set(flat.tolist())}
        return np.array([values[mu] for mu in flat.tolist()]).reshape(mean.shape)
    # even nodes in the logarithm of the variance, along which J (mu + r^2) bends evenly
    x = np.log(flat + r * r)
    nodes = np.linspace(x.min(), x.max(), _NODES)
    table = [_poisson_gauss(max(mu, 0.0), r) * (mu + r * r) for mu in np.exp(nodes) - r * r]
    return np.asarray(scipy.interpolate.CubicSpline(nodes, table)(x)).reshape(mean.shape)


def _poisson_gauss(mu: float, r: float) -> float:
    """Integral of (dp/dmu)^2 / p over the signal x, p = sum_n P(n; mu) N(x - n; r).

    The trapezoidal rule with a step of r / 3 is exact to exp(-2 pi^2 9) for functions as smooth as the normal's.
    """
    n = _counts(mu)
    x = np.arange(n[0] - _SIGMAS * r, n[-1] + _SIGMAS * r, r / 3.0)
    density = scipy.stats.norm.pdf(x[:, None], n, r)
    chance = scipy.stats.poisson.pmf
    # dP(n; mu)/dmu = P(n - 1; mu) - P(n; mu) of a Poisson law
    p, slope = density @ chance(n, mu), density @ (chance(n - 1, mu) - chance(n, mu))
    seen = p > 0.0
    return float(np.sum(slope[seen] ** 2 / p[seen]) * r / 3.0)


def _counts(mu: float) -> Array:
    """Counts that occur, and one more on either side for the derivative."""
    reach = _SIGMAS * np.sqrt(mu)
    return np.arange(max(np.floor(mu - reach) - 1.0, 0.0), np.ceil(mu + reach + _SIGMAS) + 2.0)


def quantised_information(mean_e: Array, card: SensorCard, pattern_known: bool = False) -> Array:
    """Information of the converter's codes, shape of `mean_e`: sum over codes of (dP/dmu)^2 / P.

    DSNU counts as read noise unless `pattern_known`; PRNU is left out.
    """
    r = float(np.hypot(card.read_noise_e, 0.0 if pattern_known else card.dsnu_e))
    mean = np.asarray(mean_e, float)
    values = {mu: _of_codes(mu, r, card) for mu in set(mean.ravel().tolist())}
    return np.array([values[mu] for mu in mean.ravel().tolist()]).reshape(mean.shape)


def _of_codes(mu: float, r: float, card: SensorCard) -> float:
    n = _counts(mu)
    charge, well = np.minimum(n, card.full_well_e), card.full_well_e
    chance, slope = scipy.stats.poisson.pmf(n, mu), scipy.stats.poisson.pmf(n - 1, mu) - scipy.stats.poisson.pmf(n, mu)
    low, high = (card.black_level_dn + card.dn_per_e * x for x in (charge[0] - _SIGMAS * r, charge[-1] + _SIGMAS * r))
    edges = np.arange(np.floor(max(low, 0.0)), np.ceil(min(high, card.top_dn))) + 0.5  # between one code and the next
    if charge[0] >= well or edges.size == 0:
        return 0.0
    # without read noise the law is a step: a width that is not 0 keeps it a number
    below = ndtr((edges[:, None] - card.black_level_dn - card.dn_per_e * charge) / (card.dn_per_e * max(r, 1e-9)))
    shares = np.diff(np.vstack([np.zeros_like(charge), below, np.ones_like(charge)]), axis=0)
    P, dP = shares @ chance, shares @ slope
    seen = P > 1e-300  # codes that never occur say nothing, and would be 0 / 0
    return float(np.sum(dP[seen] ** 2 / P[seen]))


# -- bounds of a spot --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SpotLimit:
    """Bound of one spot.

    Attributes
    ----------
    covariance_px2 : array, shape (2, 2)
        Of (u, v); NaN where the pixels cannot tell.
    fisher : array, shape (k, k)
        By u, v, relative flux, background levels in electrons, as far as they are unknown.
    """

    covariance_px2: Array
    fisher: Array

    @property
    def rms_px(self) -> float:
        """Root of the mean variance of u and v."""
        return float(np.sqrt(np.trace(self.covariance_px2) / 2.0))


@dataclass(frozen=True)
class DepthLimit:
    """Bound of D, shape (...), in its two parts, which add in squares.

    Attributes
    ----------
    depth_m : array, shape (...)
        D.
    sigma_spot_m : shape (...)
        From the pixels' noise: sqrt(g^T F^-1 g).
    sigma_calibration_m : shape (...)
        From what is not known of the rig: sqrt(g_c^T Sigma_c g_c).
    gradient : shape (..., p)
        g_c, dD by each of `rig_parameters.RIG_PARAMETERS`, metres per its unit.
    status : array, shape (...)
        Values of `Status`.
    """

    depth_m: Array
    sigma_spot_m: Array
    sigma_calibration_m: Array
    gradient: Array
    status: StatusArray

    @property
    def sigma_m(self) -> Array:
        """Both parts together."""
        return np.hypot(self.sigma_spot_m, self.sigma_calibration_m)


def spot_limit(
    region: ExpectedRegion,
    card: SensorCard,
    unknown: Unknown = "flux+background",
    model: NoiseModel = "approximate",
    pattern_known: bool = False,
) -> SpotLimit:
    """Cramer-Rao bound of a spot's position on raw pixels; full pixels carry nothing.

    Parameters
    ----------
    region : ExpectedRegion
        Expected electrons of the pixels about the spot, with derivatives.
    card : SensorCard
        Sensor whose noise counts.
    unknown : "position", "flux" or "flux+background"
        What is unknown: the position alone, the flux too, or the background levels too.
    model : "approximate", "exact" or "quantised"
        Noise: 1 / variance with all terms; Poisson and Gauss exactly, the rounding as Gaussian; the converter's codes.
        The last two leave PRNU out.
    pattern_known : bool
        The camera's PRNU and DSNU are calibrated.
    """
    information = raw_information(region.mean_e, card, model, pattern_known)
    return limit_of(derivative_images(region, unknown), information)


def limit_of(derivatives: Array, information: Array) -> SpotLimit:
    """Bound from derivative images, shape (k, h, w), u and v first, and the pixels' information, shape (h, w)."""
    fisher = fisher_matrix(derivatives, information)
    return SpotLimit(covariance_bound(fisher), fisher)


def derivative_images(region: ExpectedRegion, unknown: Unknown = "flux+background") -> Array:
    """Derivatives of the mean by u, v, relative flux and the background of each filter, shape (k, h, w)."""
    if unknown not in UNKNOWNS:
        raise ValueError(f"unknown '{unknown}': {nearest(unknown, UNKNOWNS)}")
    images = [region.du_e_per_px, region.dv_e_per_px]
    if unknown != "position":
        images.append(region.spot_e)
    if unknown == "flux+background":
        images += [(region.filters == colour).astype(float) for colour in np.unique(region.filters)]
    return np.stack(images)


def phi_limit(view: View, uv_px: ArrayLike, limit: SpotLimit) -> PhiEstimate:
    """Phi at a pixel with the bound of its variance, g C g^T."""
    return estimate_phi("ray", view, np.asarray(uv_px, float), limit.covariance_px2)


def depth_limit(
    rig: Rig,
    stroke_m: ArrayLike,
    uv_down_px: Array,
    uv_up_px: Array,
    covariance_down_px2: Array,
    covariance_up_px2: Array,
    covariance_rig: Array,
) -> DepthLimit:
    """Bound of D in its two parts, to first order.

    Parameters
    ----------
    rig : Rig
        The nominal rig.
    stroke_m : array, shape (...)
        Stroke h.
    uv_down_px, uv_up_px : array, shape (..., 2)
        Pixels.
    covariance_down_px2, covariance_up_px2 : array, shape (..., 2, 2)
        Bounds of (u, v).
    covariance_rig : shape (p, p)
        Of the calibration's parameters, see `rig_parameters.rig_covariance`.
    """
    spot = depth_exact(rig, stroke_m, uv_down_px, uv_up_px, covariance_down_px2, covariance_up_px2)
    g = rig_gradient(rig, stroke_m, uv_down_px, uv_up_px)
    calibration = np.sqrt(np.einsum("...i,ij,...j->...", g, covariance_rig, g))
    return DepthLimit(spot.depth_m, spot.sigma_m, calibration, g, spot.status)


# -- signal to noise ---------------------------------------------------------------------------------------------------

_MANY = 32  # nodes where one costs nothing: 1 % beyond saturation, 1e-3 below it
# Radau's rule with the end of the way, where the bound of the position is computed anyway
_RADAU = (((4.0 - 6.0**0.5) / 10.0, (16.0 + 6.0**0.5) / 36.0), ((4.0 + 6.0**0.5) / 10.0, (16.0 - 6.0**0.5) / 36.0))
_END = 1.0 / 9.0  # its weight there


def raw_snr(
    region: ExpectedRegion, card: SensorCard, frames: FrameCounts | None = None, pattern_known: bool = False
) -> float:
    """Signal to noise on raw pixels.

    Parameters
    ----------
    region : ExpectedRegion
        As for `spot_limit`.
    card : SensorCard
        As for `spot_limit`.
    frames : FrameCounts, optional
        Frames with the laser on and off from which alone the room is known.
    pattern_known : bool
        As for `spot_limit`.
    """
    spot, room = region.spot_e, region.background_e
    prnu = 0.0 if pattern_known else card.prnu

    def information(part: float) -> float:
        if frames is None:
            pixels = raw_information(room + part * spot, card, pattern_known=pattern_known)
        else:
            on, off = (raw_information(mean, card, pattern_known=True) for mean in (room + part * spot, room))
            pixels = without_room(on, off, part * spot, frames, prnu)
        return float(np.sum(spot**2 * pixels))

    x, weight = leggauss(_MANY)
    x = 0.5 * (x + 1.0)
    return float(sum(0.5 * w * _speed(information, node) for node, w in zip(x, weight, strict=True)))


def processed_snr(information: Callable[[float], float], at_the_end: float) -> float:
    """Signal to noise of codes or coefficients, by three nodes: within 5 % below saturation.

    Parameters
    ----------
    information : function of t
        s^T F(b + t s) s.
    at_the_end : float
        The same at t = 1.
    """
    return sum(w * _speed(information, x) for x, w in _RADAU) + _END * 2.0 * max(at_the_end, 0.0) ** 0.5


def _speed(information: Callable[[float], float], x: float) -> float:
    """Integrand of the way in x = sqrt(t), in which it is smooth where the room is dark."""
    return 2.0 * x * max(information(x * x), 0.0) ** 0.5
