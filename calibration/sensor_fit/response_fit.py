"""Gain and response curve of a raw sensor from the noise of its levels; linearity against stated light (EMVA 1288).

A response y(x) bends what a straight sensor would have given, x = K e. A level with the signal y above black then has
the variance from frame to frame

    v(y) = (K x(y) + D) / x'(y)^2,     x(y) = y (1 + a_1 u + a_2 u^2 + a_3 u^3),     u = y / (code range)

with D the variance of dark frames. K is the gain of the smallest signals. Nine sets of terms are fitted, from none
(the straight line of EMVA 1288) to all three, and a power of the codes, black included (gamma). Each has the weight of
its Bayes factor in Schwarz's approximation, the straight line's prior being 0.5. The result is the weighted mean; its
sigma holds the spread of the sets. Where no set fits within counting noise, all sigmas grow by the root of the least
mean square (Birge's ratio). A straight line has a bend of 0 +- 0.3 % at full range, as far as the noise leaves it open:
0.3 % move K by 0.5 %. One level shows no bend at all, so that its own is 0 +- 3 %.

Where light or exposure times are stated, the signal is compared with them: a straight line with an offset and the
weights 1 / signal^2, over signals from 5 to 95 % of the brightest (EMVA 1288, release 4.0, section 6.7). A deviation
holds the sensor's bend and the error of the stated light; the two cannot be told apart there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import scipy
from scipy.optimize import least_squares

from phibench.calibration.sensor_fit.block_sums import jackknife_sigma, rounding_doubt, rounding_variance
from phibench.scenes.frames import Array

_TERMS = (1, 2, 3)
_POWER = (0,)  # a power of the codes, black included: gamma
_STRAIGHT_PRIOR = 0.5  # the eight bends share the other half
_BENT = 0.95  # posterior share of the bent sets from which on the response is said to bend
_UNSEEN = 0.003  # standard deviation of the bend at u = 1 that a response has which is taken for straight
_UNSEEN_BY_ONE = 0.03  # the same where one level cannot show a bend: sensors of the EMVA sets bend by 2 to 5 %
_CHANCE = 1e-4  # of counting noise alone, below which a fit is a misfit
_STEEPEST = 0.2  # least slope of x(y): flatter ones are no response
_ROUNDS = 4  # of the rounding, which depends on the noise


@dataclass(frozen=True)
class NoiseOfLevel:
    """One filter of one level, arrays with an entry for the whole and one for each block left out.

    Attributes
    ----------
    name : str
    signal_dn : mean above the dark frames'
    temporal_dn2 : variance from frame to frame, rounding included
    mean_dn, spread_dn : mean, and its spread from pixel to pixel
    freedom : degrees of freedom of the variance
    doubt_dn2 : of the variance, by uneven codes
    """

    name: str
    signal_dn: Array
    temporal_dn2: Array
    mean_dn: float
    spread_dn: float
    freedom: float
    doubt_dn2: float = 0.0


@dataclass(frozen=True)
class Response:
    """Gain of the smallest signals, and the bent response with it.

    Attributes
    ----------
    gain : DN per electron, shape (replicates,)
    spread : standard deviation of the gain that the choice of terms and a misfit add
    coefficients : a_1, a_2, a_3, shape (replicates, 3); all 0 for a straight response
    coefficient_sigmas : shape (3,)
    range_dn : signal of u = 1
    straight_gain, straight_sigma : of the straight line alone
    straight_misfit, misfit : mean square of the residuals of the straight line and of the best set, in sigmas
    refused : whether counting noise explains the residuals of no set
    bent : posterior share of the bent sets
    reach_dn : brightest signal used
    levels : number of levels of different names
    unseen_bend : standard deviation of a_1 that a straight line leaves open
    dark_dn2 : variance at no light
    """

    gain: Array
    spread: float
    coefficients: Array
    coefficient_sigmas: Array
    range_dn: float
    straight_gain: float
    straight_sigma: float
    straight_misfit: float
    misfit: float
    refused: bool
    bent: float
    reach_dn: float
    levels: int
    unseen_bend: float
    dark_dn2: float = 0.0

    @property
    def sigma(self) -> float:
        """Standard deviation of the gain."""
        return float(np.hypot(jackknife_sigma(self.gain), self.spread))

    @property
    def is_bent(self) -> bool:
        """Levels refuse a straight response."""
        return self.bent > _BENT

    def linear(self, signal_dn: Array) -> Array:
        """x(y), DN, of signals of shape (replicates,) or a scalar's of the whole."""
        u = np.asarray(signal_dn) / self.range_dn
        a = self.coefficients if np.ndim(signal_dn) else self.coefficients[0]
        return np.asarray(signal_dn * (1.0 + a[..., 0] * u + a[..., 1] * u**2 + a[..., 2] * u**3))

    def slope(self, signal_dn: Array) -> Array:
        """x'(y)."""
        u = np.asarray(signal_dn) / self.range_dn
        a = self.coefficients if np.ndim(signal_dn) else self.coefficients[0]
        return np.asarray(1.0 + 2.0 * a[..., 0] * u + 3.0 * a[..., 1] * u**2 + 4.0 * a[..., 2] * u**3)

    def finding(self) -> str | None:
        """Sentence about the straight line; None if it holds."""
        if self.levels < 2:
            return "one level does not show whether the response is straight; take five from 10 to 85 % of full scale"
        said = []
        if self.is_bent:
            top = np.asarray(self.reach_dn)
            loss = 100.0 * float(1.0 - top / self.linear(top))
            way = "loses" if loss > 0.0 else "gains"
            said.append(
                f"a straight line does not fit: mean square of its residuals {self.straight_misfit:.3g}, and its gain "
                f"{self.straight_gain:.4g} +- {self.straight_sigma:.2g} DN/e; the bent response of "
                f"measured.response_coefficients {way} {abs(loss):.1f} % at {self.reach_dn:.0f} DN above black, and "
                "gain_dn_per_e is its slope at black"
            )
        if self.refused:
            said.append(
                f"no response tried fits within counting noise (mean square of the residuals {self.misfit:.3g}); "
                "the sigma of the gain is widened by its root"
            )
        return "; ".join(said) or None


@dataclass(frozen=True)
class _Set:
    """One set of terms, fitted: parameters K and a_j, shape (replicates, 1 + terms); dK/da_1 of the straight one."""

    terms: tuple[int, ...]
    x: Array
    chi2: float
    gain_by_bend: float = 0.0


def fit_response(
    levels: Sequence[NoiseOfLevel], dark_dn2: Array, range_dn: float, free_dark_dn2: tuple[float, float] | None = None
) -> Response:
    """Fit levels that are not saturated; `dark_dn2`, shape (replicates,), is the dark variance before rounding.

    Where dark frames say nothing of it, the levels of two names or more do, within the two ends of `free_dark_dn2`.

    Raises
    ------
    ValueError
        If the noise does not grow with the level.
    """
    names = len({one.name for one in levels})
    signal = np.stack([one.signal_dn for one in levels])
    seen = np.stack([one.temporal_dn2 for one in levels])
    counted = np.array([one.temporal_dn2[0] * np.sqrt(2.0 / one.freedom) for one in levels])
    sigma = np.maximum(counted, [jackknife_sigma(one.temporal_dn2) for one in levels])
    model = np.maximum(seen[:, 0] - 1.0 / 12.0, 0.0)
    sets: list[_Set] = []
    for _ in range(_ROUNDS):
        rounding = np.array(
            [
                rounding_variance(one.mean_dn, float(np.sqrt(v)), one.spread_dn)
                for one, v in zip(levels, model, strict=True)
            ]
        )
        unknown = np.array(
            [
                float(np.hypot(rounding_doubt(float(np.sqrt(v)), one.spread_dn), one.doubt_dn2))
                for one, v in zip(levels, model, strict=True)
            ]
        )
        weights = np.hypot(sigma, unknown)
        black_u = max(float(levels[0].mean_dn - signal[0, 0]), 1.0) / range_dn
        if free_dark_dn2 is not None and names > 1:
            dark_dn2 = _intercept(signal, seen - rounding[:, None], weights, *free_dark_dn2)
        fitter = _Fitter(signal / range_dn, signal, seen - rounding[:, None], dark_dn2, weights, black_u)
        sets = [one for terms in _sets(names, len(levels)) if (one := fitter.fit(terms)) is not None]
        if not sets or sets[0].terms or sets[0].x[0, 0] <= 0.0:
            raise ValueError
        best = min(sets, key=lambda one: one.chi2 + len(one.terms) * np.log(len(levels)))
        model = np.maximum(fitter.variance(best.terms, best.x[0], 0), 0.0)
    # what each level's rounding leaves open moves K of the straight line by so much
    share = fitter.sigma**-2.0 * signal[:, 0] / np.sum((signal[:, 0] / fitter.sigma) ** 2)
    by_rounding = float(np.linalg.norm(share * unknown))
    fitted = _mean(sets, len(levels), names, range_dn, float(signal[:, 0].max()), by_rounding)
    return replace(fitted, dark_dn2=float(dark_dn2[0]))


def _intercept(y: Array, v: Array, sigma: Array, least_dn2: float, most_dn2: float) -> Array:
    """Variance at no light by the line through the levels alone, DN^2, between two ends, shape (replicates,)."""
    weight = sigma[:, None] ** -2.0
    y0, v0 = ((weight * x).sum(axis=0) / weight.sum() for x in (y, v))
    slope = np.sum(weight * (y - y0) * (v - v0), axis=0) / np.sum(weight * (y - y0) ** 2, axis=0)
    return np.asarray(np.clip(v0 - slope * y0, least_dn2, most_dn2))


def _sets(names: int, count: int) -> list[tuple[int, ...]]:
    sets = [
        terms
        for size in range(len(_TERMS) + 1)
        for terms in combinations(_TERMS, size)
        if size < min(names, count - 1) or size == 0
    ]
    return [*sets, _POWER] if len(sets) > 1 else sets


class _Fitter:
    """Levels with their weights: u and signal of shape (levels, replicates), variance less rounding, dark variance."""

    def __init__(self, u: Array, signal: Array, variance: Array, dark: Array, sigma: Array, black_u: float) -> None:
        self.u, self.signal, self.seen, self.dark, self.sigma = u, signal, variance, dark, sigma
        self.black_u = black_u

    def variance(self, terms: tuple[int, ...], x: Array, k: int | slice) -> Array:
        """v(y) of replicate k, shape (levels,), or of some, shape (levels, replicates)."""
        u = self.u[:, k]
        if terms == _POWER:
            linear = self.signal[:, k] * _power_over_line(u / self.black_u, x[1])
        else:
            linear = self.signal[:, k] * (1.0 + sum(x[1 + i] * u**p for i, p in enumerate(terms)))
        return np.asarray((x[0] * linear + self.dark[k]) / self._slope(terms, x, k) ** 2)

    def _slope(self, terms: tuple[int, ...], x: Array, k: int | slice) -> Array:
        u = self.u[:, k]
        if terms == _POWER:
            return np.asarray((1.0 + u / self.black_u) ** x[1])
        return np.asarray(np.ones_like(u) + sum((p + 1) * x[1 + i] * u**p for i, p in enumerate(terms)))

    def _residuals(self, terms: tuple[int, ...], x: Array) -> Array:
        """Of all replicates, shape (levels, replicates)."""
        return np.asarray((self.variance(terms, x, slice(None)) - self.seen) / self.sigma[:, None])

    def _of_whole(self, x: Array, terms: tuple[int, ...]) -> Array:
        return np.asarray((self.variance(terms, x, 0) - self.seen[:, 0]) / self.sigma)

    def fit(self, terms: tuple[int, ...]) -> _Set | None:
        """Least squares of the whole; the replicates follow by the derivative. None where there is no such response."""
        weight = self.sigma**-2.0
        y, excess = self.signal[:, 0], self.seen[:, 0] - self.dark[0]
        straight = float(np.sum(weight * y * excess) / np.sum(weight * y * y))
        start = np.array([straight, *(0.0 for _ in terms)])
        scale = np.array([max(abs(straight), 1e-9), *(0.1 for _ in terms)])
        done = least_squares(self._of_whole, start, x_scale=scale, args=(terms,))
        if (terms and done.x[0] <= 0.0) or float(self._slope(terms, done.x, 0).min()) < _STEEPEST:
            return None
        change = np.linalg.pinv(done.jac)
        shifts = (self._residuals(terms, done.x) - done.fun[:, None]).T
        x = done.x - shifts @ change.T
        if terms == _POWER:
            x = self._as_polynomial(x)
        return _Set(terms, x, float(np.sum(done.fun**2)), 0.0 if terms else self._gain_by_bend(float(done.x[0])))

    def _as_polynomial(self, x: Array) -> Array:
        """K, a_1, a_2, a_3 that are nearest to a power of the codes, shape (replicates, 4)."""
        u = np.linspace(0.0, float(self.u.max()), 33)[1:]
        bends = np.stack([_power_over_line(u / self.black_u, power) - 1.0 for power in x[:, 1]])
        design = np.stack([u**p for p in _TERMS], axis=1)
        return np.concatenate([x[:, :1], bends @ np.linalg.pinv(design).T], axis=1)

    def _gain_by_bend(self, gain: float) -> float:
        """dK/da_1 of the straight line: how K moves where the response has a small a_1."""
        u, y = self.u[:, 0], self.signal[:, 0]
        by_gain = y / self.sigma
        by_bend = (gain * y * u - 4.0 * u * (gain * y + self.dark[0])) / self.sigma
        return -float(by_gain @ by_bend) / float(by_gain @ by_gain)


def _power_over_line(t: Array, power: float) -> Array:
    """x / y of a power of the codes, ((1 + t)^(power + 1) - 1) / (power + 1) t, at the signal of t black levels."""
    return np.asarray(np.expm1((power + 1.0) * np.log1p(t)) / ((power + 1.0) * t))


def _mean(sets: list[_Set], count: int, names: int, range_dn: float, reach_dn: float, by_rounding: float) -> Response:
    """Mean of the sets by their weights; `by_rounding` is a standard deviation of the gain."""
    freedom = [max(count - 1 - len(fitted.terms), 1) for fitted in sets]
    misfits = [fitted.chi2 / n for fitted, n in zip(sets, freedom, strict=True)]
    least = min(misfits)
    birge = max(least, 1.0)
    prior = np.array([(1.0 - _STRAIGHT_PRIOR) / 8.0 if fitted.terms else _STRAIGHT_PRIOR for fitted in sets])
    evidence = np.array([-0.5 * (fitted.chi2 / birge + len(fitted.terms) * np.log(count)) for fitted in sets])
    weight = prior * np.exp(evidence - evidence.max())
    weight /= weight.sum()
    x = np.stack([_padded(fitted) for fitted in sets])
    mean = np.tensordot(weight, x, axes=1)
    spread2 = weight @ (x[:, 0] - mean[0]) ** 2
    unseen = _unseen_bend(sets, names)
    spread2[0] += weight[0] * (sets[0].gain_by_bend * unseen) ** 2 + by_rounding**2
    noise2 = (birge - 1.0) * np.array([jackknife_sigma(column) ** 2 for column in mean.T])
    sigmas = np.sqrt(np.array([jackknife_sigma(column) ** 2 for column in mean.T]) + spread2 + noise2)
    straight = sets[0].x[:, 0]
    return Response(
        gain=mean[:, 0],
        spread=float(np.sqrt(spread2[0] + noise2[0])),
        coefficients=mean[:, 1:],
        coefficient_sigmas=sigmas[1:],
        range_dn=range_dn,
        straight_gain=float(straight[0]),
        straight_sigma=jackknife_sigma(straight),
        straight_misfit=misfits[0],
        misfit=least,
        refused=all(scipy.stats.chi2.sf(fitted.chi2, n) < _CHANCE for fitted, n in zip(sets, freedom, strict=True)),
        bent=float(1.0 - weight[0]),
        reach_dn=reach_dn,
        levels=names,
        unseen_bend=float(np.sqrt(weight[0])) * unseen,
    )


def _unseen_bend(sets: list[_Set], names: int) -> float:
    """Standard deviation of a_1 where none is found: what is usual, or less where the noise would show it."""
    if names == 1:
        return _UNSEEN_BY_ONE
    shown = [jackknife_sigma(fitted.x[:, 1]) for fitted in sets if fitted.terms == _TERMS[:1]]
    return float(sum(sigma**-2 for sigma in [_UNSEEN, *shown] if sigma > 0.0) ** -0.5)


def _padded(one: _Set) -> Array:
    """K, a_1, a_2, a_3, shape (replicates, 4)."""
    whole = np.zeros((len(one.x), 1 + len(_TERMS)))
    whole[:, 0] = one.x[:, 0]
    for i, power in enumerate(_TERMS if one.terms == _POWER else one.terms):
        whole[:, power] = one.x[:, 1 + i]
    return whole


# -- signal against stated light -------------------------------------------------------------------------------------

_LEAST, _MOST = 0.05, 0.95  # of the brightest signal that is not saturated
_NEEDED = 4  # levels of stated light: a line, and what is left of it
_SAID_PERCENT = 0.3  # deviations below it are within what lamps and clocks hold
_SIGMAS = 5.0  # a finding is said where it is no chance


@dataclass(frozen=True)
class LightLevel:
    """One level: its light (photons or seconds), signal above black, DN, and the signal's standard deviation."""

    light: float
    signal_dn: float
    sigma_dn: float


@dataclass(frozen=True)
class Linearity:
    """Deviation from the straight line.

    Attributes
    ----------
    mean_percent, most_percent : mean and largest absolute deviation
    most_at_dn : signal of the largest
    sigma_percent : of one level's deviation, by noise and flicker
    unit : "photons" or "seconds"
    """

    mean_percent: float
    most_percent: float
    most_at_dn: float
    sigma_percent: float
    unit: str

    def finding(self) -> str | None:
        """Sentence about the line; None if it holds."""
        if self.most_percent < max(_SAID_PERCENT, _SIGMAS * self.sigma_percent):
            return None
        return (
            f"signal against {self.unit} leaves a straight line by up to {self.most_percent:.2g} %, at "
            f"{self.most_at_dn:.0f} DN above black, and by {self.mean_percent:.2g} % on the mean: the sensor bends, or "
            f"the stated {self.unit} do"
        )


def fit_linearity(levels: Sequence[LightLevel], unit: str) -> Linearity | None:
    """Deviation of levels that are not saturated; None if fewer than four lie in the range."""
    if not levels:
        return None
    end = max(level.signal_dn for level in levels)
    used = [level for level in levels if _LEAST * end <= level.signal_dn <= _MOST * end]
    light: Array = np.array([level.light for level in used])
    if len(set(light)) < _NEEDED:
        return None
    signal = np.array([level.signal_dn for level in used])
    design = np.stack([np.ones_like(light), light / light.max()], axis=1)
    line = design @ np.linalg.lstsq(design / signal[:, None], np.ones_like(signal), rcond=None)[0]
    percent = 100.0 * (signal - line) / line
    most = int(np.argmax(np.abs(percent)))
    # two frames of one level say little of its scatter, all levels together enough
    sigma = float(np.sqrt(np.mean([(level.sigma_dn / level.signal_dn) ** 2 for level in used])))
    return Linearity(float(np.abs(percent).mean()), float(abs(percent[most])), float(signal[most]), 100.0 * sigma, unit)
