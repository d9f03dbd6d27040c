"""Likelihood of a spot in one image, and its map over places, flux and levels profiled out; covariances to claim.

The quasi-likelihood is that of `chain_fit`: r^T C^-1 r of a JPEG's coefficients with C kept from the fit, or the law
of each raw pixel or own code. At each place flux and levels come from one step of Gauss-Newton, and what a second would
gain is taken off: both are nearly linear once the place is given.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy

from phibench.estimator.geometry.joint_posterior import MISFIT_RANGE, LikelihoodMap, single_posterior
from phibench.estimator.processed.interval_fit import interval_posterior
from phibench.estimator.processed.quasi_score import CoefficientWindow, fit_window
from phibench.estimator.spots.fit_raw import SpotData, scored_unknowns
from phibench.estimator.spots.gaussian_spot import covariance_bound, scoring_step
from phibench.scenes.frames import Array

FAINT_PX = 0.05
"""Claimed sigma from which the posterior is asked: the curvature at the best place says too little then.

Of a spot of 5 to 10 sigma, and where the mosaic or JPEG makes valleys, errors are 1.2 to 2 times such a claim.
"""
_AT_ONCE = 48  # hypotheses, whose arrays take some 50 MB
_WIDE_PX = (1.25, 2.25, 3.25)  # half sides of the first map, the next one where a posterior reaches its sides
_WIDE_STEP_PX = 0.25
_AT_SIDES = 1e-3  # part of a posterior on the outermost places of the first map, above which the next one is made
_SIGMAS = 4.5  # half side of the second map: 4e-5 of a Gaussian lie outside in two dimensions
_STEP_SIGMAS = 0.6  # of the second map: cubic splines between are within 1 % of a unit of misfit
_MOST_STEP_PX = 0.2  # of the second map: where a place is flat to its curvature, what surrounds it is steeper
_MOST_SIDE = 41
# least variance of a coefficient that counts, in steps squared: one that changes in fewer than 2 % of the frames says
# next to nothing, and when it changes a Gaussian's square is 50 and more, far beyond the logarithm of its chance
_LIVE = 0.02
_OUTLIER = 3.0  # of a residual in standard deviations
_WORTH = 1.5 * MISFIT_RANGE  # of a first guess of the misfit, above the least
_PLACE = 2  # unknowns u, v, the first ones
_MOST_GAIN = 1.0  # of a step that is not taken, in misfit: half of it in the logarithm of the likelihood
_MORE_EVALUATIONS = 4  # at most, where steps promise more
_LEAST_FLUX = 1e-3  # of the fit's flux, below which a hypothesis has no spot

Scores = Callable[[Array, int], tuple[Array, Array, Array]]
"""From hypotheses, shape (m, k): misfit (m,), and score and Fisher matrix of the unknowns from a first one on."""


@dataclass(frozen=True)
class SpotLikelihood:
    """Likelihood of one image about its best place.

    Attributes
    ----------
    theta : shape (k,), the best hypothesis found, position from `corner_px`
    corner_px : shape (2,), image pixel (u, v) of the position's origin
    excess : float
        Misfit per degree of freedom where it is above 1, by which misfits are divided; otherwise 1. Residuals count up
        to 3 sigma: a coefficient that hardly ever changes says, when it does, nothing of the others.
    """

    scores: Scores
    theta: Array
    corner_px: Array
    excess: float


def window_likelihood(window: CoefficientWindow, start: Array, corner_px: Array) -> SpotLikelihood | None:
    """Likelihood of a window of outputs; None where they say nothing."""
    if window.of_intervals:
        posterior = interval_posterior(window, start)
        if posterior is None or not posterior.settled:
            return None
        residuals, theta = posterior.likelihood(), posterior.theta
        noise = window.noise(theta, least=_LIVE)
    else:
        fit = fit_window(window, start[None])
        noise, theta = window.noise(fit.theta, least=_LIVE), fit.theta
        residuals = partial(window.residual, noise)
    if noise.dead:
        return None
    misfit, _ = window.residual(noise, theta[None])
    limited_square = float(np.minimum(misfit**2, _OUTLIER**2).sum())
    excess = max(limited_square / max(len(noise.sigma) - len(start), 1), 1.0)

    def scores(theta: Array, first: int) -> tuple[Array, Array, Array]:
        r, J = residuals(theta, first)
        return np.einsum("ml,ml->m", r, r), np.einsum("mkl,ml->mk", J, r), J @ np.swapaxes(J, 1, 2)

    return SpotLikelihood(scores, theta, corner_px, excess) if np.isfinite(excess) else None


def pixels_likelihood(data: SpotData, uv_px: Array) -> SpotLikelihood:
    """Likelihood of one region's pixels or codes about a place (u, v) in the image, where a fit has put the spot."""
    corner = np.asarray(data.regions.origin_px[0], float)

    def scores(theta: Array, first: int) -> tuple[Array, Array, Array]:
        many = data.rows(np.zeros(len(theta), np.int64))
        mean, derivatives = many.pixels.at(theta)
        used, x = many.regions.used, many.regions.x_e
        flat = derivatives.reshape(*theta.shape, -1)[:, first:]
        weight = (used * many.law.information(mean)).reshape(len(theta), 1, -1)
        score = (flat @ (used * many.law.score(x, mean)).reshape(len(theta), -1, 1))[..., 0]
        misfit = np.sum(used * many.law.misfit(x, mean), axis=(1, 2))
        return misfit, score, (flat * weight) @ np.swapaxes(flat, 1, 2)

    used, above = data.regions.used[0], (data.regions.x_e - data.pixels.background_e)[0]
    levels = [_median(above[used & (level > 0.0)]) for level in data.pixels.levels[0]]
    above = used * (above - np.einsum("c,chw->hw", levels, data.pixels.levels[0])) * data.pixels.response[0]
    start = np.array([*(uv_px - corner), max(float(above.sum()), 100.0), *levels])
    return SpotLikelihood(scores, scored_unknowns(data, start[None])[0][0], corner, 1.0)


def _median(values: Array) -> float:
    return float(np.median(values)) if values.size else 0.0


def claimed_px2(uv_px: Array, covariance_px2: Array, likelihood: Callable[[], SpotLikelihood | None]) -> Array | None:
    """Covariance that a fit may claim, shape (2, 2): that at its place, or the posterior's of a faint spot.

    The mean square of the posterior about the fit's place holds other minima as well. None where the posterior has no
    end near the place: nothing can be claimed then.
    """
    if np.trace(covariance_px2) < 2.0 * FAINT_PX**2 or (of_spot := likelihood()) is None:
        return covariance_px2
    posterior = None if (places := likelihood_map(of_spot)) is None else single_posterior(places)
    if posterior is None:
        return None
    mean, covariance = posterior
    return covariance + np.outer(mean - uv_px, mean - uv_px)


def likelihood_map(one: SpotLikelihood) -> LikelihoodMap | None:
    """Map of all places near the fit whose misfit is within the range of the least; None if the fit has no place.

    The next minimum of a Bayer grid lies a pixel from the fit, and may be the true one: of a faint spot between red
    pixels the posterior then reaches 2 px from the fit.
    """
    misfit, _, fisher = (part[0] for part in one.scores(one.theta[None], 0))
    C = covariance_bound(fisher) * one.excess
    if not np.isfinite(C).all():
        return None
    least = float(misfit) / one.excess
    wide = _wide_enough(one, least, C)
    # the curvature at a flat place says nothing of what lies outside the wide map
    low, high = _ends(wide, least, np.minimum(_SIGMAS * np.sqrt(np.diag(C)), wide.side[-1]))
    steps = np.minimum(_STEP_SIGMAS * np.sqrt(np.diag(C)), _MOST_STEP_PX)
    counts = np.clip(np.ceil((high - low) / steps) + 1, 5, _MOST_SIDE).astype(int)
    u, v = (np.linspace(*ends) for ends in zip(low, high, counts, strict=True))
    off = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, _PLACE)
    parabola = least + np.einsum("mi,ij,mj->m", off, np.linalg.inv(C), off)
    coarse = wide.between(off)
    theta = one.theta + np.where((parabola < coarse[:, 0])[:, None], _along(fisher, off), coarse[:, 1:])
    values = np.minimum(parabola, coarse[:, 0])
    worth = np.flatnonzero(values < min(float(values.min()), float(wide.misfit.min())) + _WORTH)
    values[worth], _ = _profiled(one, theta[worth], 1)
    corner = one.corner_px + one.theta[:_PLACE]
    return LikelihoodMap(u + corner[0], v + corner[1], values.reshape(len(v), len(u)))


@dataclass(frozen=True)
class _Wide:
    """Profiled misfits and hypotheses on places `side` x `side` from the fit's.

    Attributes
    ----------
    side : shape (s,), pixels
    values : shape (s, s, 1 + k), misfit, and hypothesis less the best one
    """

    side: Array
    values: Array

    @property
    def misfit(self) -> Array:
        return self.values[..., 0]

    def at_sides(self, least: float, peak_px2: float) -> float:
        """Part of the posterior that lies on the outermost places; at the fit it has `least` on an area `peak_px2`."""
        weight = np.exp(-0.5 * (self.misfit - min(float(self.misfit.min()), least)))
        inside = float(weight[1:-1, 1:-1].sum())
        whole = max(float(weight.sum()), peak_px2 / _WIDE_STEP_PX**2)
        return (float(weight.sum()) - inside) / whole

    def between(self, off: Array) -> Array:
        """Values at places from the fit's, shape (m, 1 + k), linear; beyond the last places as on them."""
        at = scipy.interpolate.RegularGridInterpolator((self.side, self.side), self.values)
        values = np.asarray(at(np.clip(off[:, ::-1], self.side[0], self.side[-1])))
        values[:, 1 : 1 + _PLACE] = off
        return values


def _wide_enough(one: SpotLikelihood, least: float, C: Array) -> _Wide:
    """The smallest of the wide maps that holds the posterior; the largest one if none does."""
    peak_px2 = 2.0 * np.pi * float(np.sqrt(max(np.linalg.det(C), 0.0)))
    for half in _WIDE_PX:
        wide = _wide(one, half)
        if wide.at_sides(least, peak_px2) <= _AT_SIDES:
            break
    return wide


def _wide(one: SpotLikelihood, half_px: float) -> _Wide:
    side = np.arange(-half_px, half_px + 1e-9, _WIDE_STEP_PX)  # 1e-9: both ends are places
    off = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, _PLACE)
    theta = np.repeat(one.theta[None], len(off), axis=0)
    theta[:, :_PLACE] += off
    misfit, theta = _profiled(one, theta, 2)
    return _Wide(side, np.column_stack([misfit, theta - one.theta]).reshape(len(side), len(side), -1))


def _ends(wide: _Wide, least: float, reach: Array) -> tuple[Array, Array]:
    """Sides, shape (2,) each, of what is worth a closer look, from the fit's place."""
    near = wide.misfit < min(float(wide.misfit.min()), least) + MISFIT_RANGE
    near[len(wide.side) // 2, len(wide.side) // 2] = False  # the fit's own place, about which `reach` is enough
    low, high = -reach, reach.copy()
    for axis in range(_PLACE):
        index = np.flatnonzero(near.any(axis=axis))
        if index.size:
            low[axis] = min(low[axis], wide.side[index[0]] - _WIDE_STEP_PX)
            high[axis] = max(high[axis], wide.side[index[-1]] + _WIDE_STEP_PX)
    return low, high


def _along(fisher: Array, off: Array) -> Array:
    """Change of a hypothesis, shape (m, k), along which flux and levels are at their best near the fit."""
    slope = -np.linalg.solve(fisher[_PLACE:, _PLACE:], fisher[_PLACE:, :_PLACE])
    return np.concatenate([off, off @ slope.T], axis=1)


def _profiled(one: SpotLikelihood, theta: Array, evaluations: int) -> tuple[Array, Array]:
    """Misfit, shape (m,), with flux and levels at their best for the places of hypotheses, and these."""
    parts = [_part_profiled(one, theta[i : i + _AT_ONCE], evaluations) for i in range(0, len(theta), _AT_ONCE)]
    misfits, thetas = zip(*parts, strict=True)
    return np.concatenate(misfits), np.concatenate(thetas)


def _part_profiled(one: SpotLikelihood, theta: Array, evaluations: int) -> tuple[Array, Array]:
    """As `_profiled`; where a step promises much it is taken and looked at: beside full codes promises are not kept."""
    theta, at_least = theta.copy(), _LEAST_FLUX * one.theta[_PLACE]
    theta[:, _PLACE] = np.maximum(theta[:, _PLACE], at_least)
    least, gain, steep = np.full(len(theta), np.inf), np.zeros(len(theta)), np.arange(len(theta))
    value = least.copy()
    for number in range(1, evaluations + _MORE_EVALUATIONS + 1):
        misfit, score, F = one.scores(theta[steep], _PLACE)
        step = scoring_step(F, score)
        least[steep], gain[steep] = np.minimum(least[steep], misfit), np.maximum(np.sum(step * score, axis=1), 0.0)
        value[steep] = misfit - gain[steep]
        theta[steep, _PLACE:] += step
        theta[steep, _PLACE] = np.maximum(theta[steep, _PLACE], at_least)
        if number >= evaluations:
            steep = steep[gain[steep] > _MOST_GAIN]
        if not steep.size:
            break
    value[steep] = least[steep]
    return value / one.excess, theta


def place_covariance(one: SpotLikelihood) -> Array:
    """Covariance of the place, shape (2, 2), pixels squared, by the curvature at the best hypothesis."""
    _, _, fisher = one.scores(one.theta[None], 0)
    return covariance_bound(fisher[0]) * one.excess
