"""Fisher information of one pixel about its mean mu, per electron squared: what a Cramer-Rao bound sums up.

Three models of the noise:

* approximate: 1 / variance, F. Huang et al., Nature Methods 10, 653 (2013), with mu + r^2 for Poisson plus Gauss;
* exact: of the convolution of a Poisson with a normal distribution;
* quantised: of the converter's codes, with full well and both ends of the converter.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import ndtr
from scipy.stats import norm, poisson

from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.raw_pixels import PixelNoise
from phibench.scenes.frames import Array

_SIGMAS = 9.0  # tails of 1e-19 are left out
_NODES = 48  # of the spline; see the test of its error
_GAUSSIAN_FROM_E = 3000.0  # there the exact value is within 1e-4 of the approximate one
_PURE_POISSON_E = 0.1  # below this read noise counts are resolved: 1 / mu


def approximate_information(mean_e: Array, noise: PixelNoise) -> Array:
    """1 / variance, shape of `mean_e`; electrons and electrons^-2."""
    return 1.0 / noise.variance_e2(mean_e)


def exact_information(mean_e: Array, gaussian_e2: float) -> Array:
    """Information of Poisson plus Gaussian noise, shape of `mean_e`.

    Parameters
    ----------
    mean_e : array of any shape, 0 or above, electrons
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
    x = np.log(flat + r * r)
    nodes = np.linspace(x.min(), x.max(), _NODES)
    table = [_poisson_gauss(max(mu, 0.0), r) * (mu + r * r) for mu in np.exp(nodes) - r * r]
    return np.asarray(CubicSpline(nodes, table)(x)).reshape(mean.shape)


def _poisson_gauss(mu: float, r: float) -> float:
    """Integral of (dp/dmu)^2 / p over the signal x, p = sum_n P(n; mu) N(x - n; r).

    The trapezoidal rule with a step of r / 3 is exact to exp(-2 pi^2 9) for functions as smooth as the normal's.
    """
    n = _counts(mu)
    x = np.arange(n[0] - _SIGMAS * r, n[-1] + _SIGMAS * r, r / 3.0)
    density = norm.pdf(x[:, None], n, r)
    p, slope = density @ poisson.pmf(n, mu), density @ (poisson.pmf(n - 1, mu) - poisson.pmf(n, mu))
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
    chance, slope = poisson.pmf(n, mu), poisson.pmf(n - 1, mu) - poisson.pmf(n, mu)
    low, high = (card.black_level_dn + card.dn_per_e * x for x in (charge[0] - _SIGMAS * r, charge[-1] + _SIGMAS * r))
    edges = np.arange(np.floor(max(low, 0.0)), np.ceil(min(high, card.top_dn))) + 0.5  # between one code and the next
    if charge[0] >= well or edges.size == 0:
        return 0.0
    below = ndtr((edges[:, None] - card.black_level_dn - card.dn_per_e * charge) / (card.dn_per_e * max(r, 1e-9)))
    shares = np.diff(np.vstack([np.zeros_like(charge), below, np.ones_like(charge)]), axis=0)
    P, dP = shares @ chance, shares @ slope
    seen = P > 1e-300
    return float(np.sum(dP[seen] ** 2 / P[seen]))
