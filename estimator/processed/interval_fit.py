"""Posterior of a spot from rounded outputs of one or several frames, by expectation propagation; truncated Gaussians.

Steps of JPEG are often larger than the noise. Then a coefficient near the edge of its step seems to say much about the
spot, and one far from the edges nothing, both only if the spot is where it is thought to be: a quasi-score has many
roots. The intervals themselves say the same for every hypothesis. With Gaussian outputs y before the quantiser,

    y = m(theta_0) + J^T (theta - theta_0) + noise,    z_i - s_i / 2 <= y_i <= z_i + s_i / 2,

the posterior of theta is a Gaussian cut by planes in y. Expectation propagation finds its mean and covariance (T. P.
Minka, UAI 2001; boxes: J. P. Cunningham, P. Hennig, S. Lacoste-Julien, arXiv:1111.6832): each interval is replaced by
a Gaussian that gives y_i the same mean and variance. m is linear about the posterior's mean, found again some times. Of
several frames y is their mean before the quantiser (`QuantiserSteps`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import erfcx, log_ndtr, ndtr

from phibench.estimator.processed.quasi_score import CoefficientWindow, Inputs, Rows, WindowFit, fit_window
from phibench.estimator.spots.gaussian_spot import limited_step
from phibench.scenes.frames import Array

# Gaussians that stand for the intervals of outputs: one frame's, and the mean of several frames'.
#
# Each site of expectation propagation gives an output y the mean and variance that its intervals do. Of one frame these
# are the moments of a cut Gaussian. Of f frames y is their mean before the quantiser. With x what they share and s the
# spread of one frame about it, the frames are independent given x, and
#
# L(x) = product over frames of [Phi((high - x) / s) - Phi((low - x) / s)]
#
# is all that the intervals say of x. The site for y = x + noise of variance s^2 / f follows from the derivatives of the
# logarithm of the integral of L over the Gaussian that the other outputs give.


_LEAST_STEP2 = 1e-9  # variance of an output, in steps squared: less is rounding of the arithmetic
_FINE = 0.9  # spread in steps from which a mean of frames is the mean of their middles, and rounding is noise
_NODES = 33  # along x
_REACH = 6.0  # standard deviations
_FAR_STEPS = 1e4  # beyond which what the others say is no place any more
_LEAST_SHARE = 0.1  # of the variance of y that x has at least: the outputs of others may tell of the noise, too


@dataclass(frozen=True)
class Sites:
    """Gaussians that stand for the intervals: exp(-precision y^2 / 2 + shift y), shape (n,) each."""

    precision: Array
    shift: Array

    def part(self, index: NDArray[np.int64]) -> Sites:
        """Take some of them."""
        return Sites(self.precision[index], self.shift[index])


@dataclass(frozen=True)
class QuantiserSteps:
    """Steps of the quantiser that the frames' outputs lie in.

    Attributes
    ----------
    step : shape (n,)
    first : shape (n,), lower edge of the lowest step
    counts : shape (l, n), frames in the lowest step and in those above it
    """

    step: Array
    first: Array
    counts: Array
    frames: int

    @classmethod
    def of(cls, outputs: Array, step: Array) -> QuantiserSteps:
        """Steps of outputs, shape (f, n)."""
        number = np.rint(outputs / step).astype(np.int64)
        lowest = number.min(axis=0)
        above = number - lowest
        counts = np.stack([(above == k).sum(axis=0) for k in range(int(above.max()) + 1)])
        return cls(step, (lowest - 0.5) * step, counts.astype(float), len(outputs))

    @property
    def last(self) -> Array:
        """Upper edge of the highest step, shape (n,)."""
        levels = np.arange(1, len(self.counts) + 1)[:, None]
        return np.asarray(self.first + self.step * np.where(self.counts > 0.0, levels, 0).max(axis=0))

    def part(self, index: NDArray[np.int64]) -> QuantiserSteps:
        """Take some of them."""
        counts = self.counts[:, index]
        levels = np.flatnonzero(counts.any(axis=1))
        top = int(levels[-1]) + 1 if levels.size else 1
        return QuantiserSteps(self.step[index], self.first[index], counts[:top], self.frames)

    def sites(self, mean: Array, variance: Array, spread: Array) -> Sites:
        """Sites for what the other outputs say of each output.

        Parameters
        ----------
        mean, variance : shape (n,), of the mean of the frames before the quantiser
        spread : shape (n,), variance of one frame about what they share
        """
        if self.frames == 1:
            return self._of_one(mean, variance)
        fine = spread >= (_FINE * self.step) ** 2
        sites = self._of_middles(spread)
        if not fine.all():
            index = np.flatnonzero(~fine)
            some = self.part(index)._of_several(mean[index], variance[index], spread[index])
            sites.precision[index], sites.shift[index] = some.precision, some.shift
        return sites

    def _of_one(self, mean: Array, variance: Array) -> Sites:
        cut_mean, cut_variance = truncated_moments(mean, np.sqrt(variance), self.first, self.first + self.step)
        cut_variance = np.maximum(cut_variance, _LEAST_STEP2 * self.step**2)
        precision = 1.0 / variance
        return Sites(np.maximum(1.0 / cut_variance - precision, 0.0), cut_mean / cut_variance - precision * mean)

    def _of_middles(self, spread: Array) -> Sites:
        """Sites of outputs that the noise spreads over many steps."""
        levels = np.arange(len(self.counts)) + 0.5
        middle = self.first + self.step * (levels @ self.counts) / self.frames
        precision = 12.0 * self.frames / self.step**2  # of a mean of uniform errors over a step
        return Sites(precision, precision * middle)

    def _of_several(self, mean: Array, variance: Array, spread: Array) -> Sites:
        far = _FAR_STEPS * self.step
        mean, variance = np.clip(mean, self.first - far, self.last + far), np.minimum(variance, far**2)
        own = spread / self.frames
        shared = np.maximum(variance - own, _LEAST_SHARE * variance)
        off, left = self._shared(mean, shared, spread)
        # derivatives of the integral's logarithm by the mean
        first, second = off / shared, np.maximum((1.0 - left / shared) / shared, 0.0)
        rest = np.maximum(1.0 - (shared + own) * second, _LEAST_STEP2)
        return Sites(second / rest, (first + mean * second) / rest)

    def shared(self, mean: Array, variance: Array, spread: Array) -> tuple[Array, Array]:
        """Mean and variance of x, shape (n,) each, of which the rest says `mean` and `variance`; several frames."""
        off, left = self._shared(mean, variance, spread)
        return mean + off, left

    def _shared(self, mean: Array, variance: Array, spread: Array) -> tuple[Array, Array]:
        """Change of the mean of x, and its variance."""
        sigma, deep = np.sqrt(spread), np.sqrt(variance)
        x = self._nodes(mean, deep, sigma)
        log = -0.5 * ((x - mean) / deep) ** 2 + self._log_chance(x, sigma)
        weight = np.exp(log - log.max(axis=0))
        weight[[0, -1]] *= 0.5
        weight /= weight.sum(axis=0)
        off = (weight * (x - mean)).sum(axis=0)
        return off, (weight * (x - mean - off) ** 2).sum(axis=0)

    def _nodes(self, mean: Array, deep: Array, sigma: Array) -> Array:
        """Nodes of x, shape (nodes, n), where both the others and the intervals leave something."""
        top, last = self.first + self.step, self.last
        single = last < top + 0.5 * self.step  # all frames in one step; else x lies about the edges between theirs
        low = np.where(single, self.first, top) - _REACH * sigma
        high = np.where(single, top, last - self.step) + _REACH * sigma
        a, b = np.maximum(mean - _REACH * deep, low), np.minimum(mean + _REACH * deep, high)
        apart = a >= b  # the others contradict: what is left lies between them and the intervals
        a, b = np.where(apart, np.minimum(mean, low), a), np.where(apart, np.maximum(mean, high), b)
        return np.asarray(a + (b - a) * np.linspace(0.0, 1.0, _NODES)[:, None])

    def _log_chance(self, x: Array, sigma: Array) -> Array:
        """Logarithm of L at nodes, shape (nodes, n)."""
        total = np.zeros_like(x)
        for k, count in enumerate(self.counts):
            index = np.flatnonzero(count > 0.0)
            low = (self.first[index] + k * self.step[index] - x[:, index]) / sigma[index]
            high = low + self.step[index] / sigma[index]
            mirrored = low + high > 0.0
            low, high = np.where(mirrored, -high, low), np.where(mirrored, -low, high)
            whole = log_ndtr(high)
            # a step far below its noise leaves the logarithm of 0: 1e-12 of its chance is the least
            total[:, index] += count[index] * (whole + np.log1p(-np.exp(np.minimum(log_ndtr(low) - whole, -1e-12))))
        return total


# -- Gaussian cut to an interval -------------------------------------------------------------------------------------

_NARROW = 0.02  # width in standard deviations below which the density is an exponential: off by 5e-5 of a deviation
_TAIL = 1e3  # distance in standard deviations from which it is too
_STEEP = 300.0  # exponent beyond which nothing is left of the other end
_SQRT2 = np.sqrt(2.0)


def truncated_moments(mean: Array, sigma: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Mean and variance of a Gaussian inside an interval; arrays broadcast together.

    Within 5e-5 standard deviations, relative in the variance, also far in the tails and for narrow intervals.
    """
    a, b = (low - mean) / sigma, (high - mean) / sigma
    mirrored = a + b < 0.0
    a, b = np.where(mirrored, -b, a), np.where(mirrored, -a, b)  # the mean lies left of the middle
    exponential = (b - a < _NARROW) | (a > _TAIL)
    by_rate, by_density = (
        _of_exponential(a, b),
        _of_gaussian(np.where(exponential, 0.0, a), np.where(exponential, 1.0, b)),
    )
    first, second = (np.where(exponential, x, y) for x, y in zip(by_rate, by_density, strict=True))
    return mean + sigma * np.where(mirrored, -first, first), sigma**2 * second


def _of_gaussian(a: Array, b: Array) -> tuple[Array, Array]:
    """Moments of the standard Gaussian in [a, b], a + b >= 0."""
    decay = np.exp(-0.5 * (b - a) * (a + b))  # density at b over that at a
    tail = np.sqrt(2.0 / np.pi) / (erfcx(np.maximum(a, 0.0) / _SQRT2) - decay * erfcx(np.maximum(b, 0.0) / _SQRT2))
    inside = np.exp(-0.5 * np.minimum(a, 0.0) ** 2) / (np.sqrt(2.0 * np.pi) * (ndtr(b) - ndtr(np.minimum(a, 0.0))))
    at_a = np.where(a > 0.0, tail, inside)
    first = at_a * (1.0 - decay)
    return first, np.clip(1.0 + at_a * (a - b * decay) - first**2, 0.0, 1.0)


def _of_exponential(a: Array, b: Array) -> tuple[Array, Array]:
    """Moments in [a, b] of a density that falls with the rate of the Gaussian, at a where it is steep."""
    width, steep = b - a, a > _TAIL
    far = np.maximum(a, 1.0)
    rate = np.where(steep, far + 0.5 * np.minimum(width, 1.0 / far), 0.5 * (a + b))
    x = 0.5 * rate * width
    flat, gone = x < 1e-2, x > _STEEP  # 1 / x - coth x loses its digits where x is small: a series
    some = np.where(flat | gone, 1.0, x)
    middle = 0.5 * (a + b) - 0.5 * width * np.where(flat, x / 3.0, 1.0 / np.tanh(some) - 1.0 / some)
    variance = 0.25 * width**2 * np.where(flat, 1.0 / 3.0 - x * x / 15.0, 1.0 / some**2 - 1.0 / np.sinh(some) ** 2)
    rest = 1.0 / np.where(gone, rate, 1.0)
    return np.where(gone, a + rest, middle), np.where(gone, rest**2, variance)


_PRIOR_PX = 2.0  # one standard deviation about the start; twice or half of it moves a fit by hundredths of its own
_PRIOR_LEVEL_E = 200.0  # of a level, and at least of a flux
_PRIOR_WIDTH = 0.5  # of a free width, relative
_CLOSER = 0.15  # of the prior's deviations: hypotheses that count in the first round
_FAR = 6.0  # standard deviations from the edges of its step beyond which an output tells nothing
_ROUNDS = 10  # of linearisation
_SWEEPS = (8, 4)  # in the first round, and in the others
_DAMPING = 0.8  # of a site's change after the first sweep: full ones may go round in circles
_STEP_PX = 0.4
_SETTLED = 0.03  # last step in standard deviations
_TOLD = 1e6  # variance in steps squared from which an interval's Gaussian tells nothing
_START_STEPS = 6  # of the quasi-score, from whose place the first round begins


@dataclass(frozen=True)
class _Belief:
    """Gaussian prior of theta, and of the outputs through a linear model.

    Attributes
    ----------
    theta : shape (k,)
    covariance : shape (k, k)
    mean : shape (n,), of the outputs
    cross : shape (k, n), covariance of theta and the outputs
    outputs : shape (n, n), covariance of the outputs
    """

    theta: Array
    covariance: Array
    mean: Array
    cross: Array
    outputs: Array

    @classmethod
    def of(cls, prior: Array, covariance: Array, theta: Array, inputs: Inputs, index: NDArray[np.int64]) -> _Belief:
        """Prior about `prior`, with the outputs `index` linear about `theta`."""
        slopes, F = inputs.slopes[:, index], inputs.factor[:, index]
        cross = covariance @ slopes
        outputs = F.T @ F + slopes.T @ cross
        outputs[np.diag_indices_from(outputs)] += inputs.own[index]
        return cls(prior, covariance, inputs.mean[index] + (prior - theta) @ slopes, cross, outputs)

    def factor(self, sites: Sites) -> tuple[Array, Array, Array]:
        """Square roots of the sites' precisions, root outputs, and the Cholesky factor of 1 + root outputs root."""
        root = np.sqrt(sites.precision)
        R = root[:, None] * self.outputs
        B = R * root
        B[np.diag_indices_from(B)] += 1.0
        return root, R, np.asarray(np.linalg.cholesky(B))

    def updated(self, sites: Sites) -> tuple[Array, Array]:
        """Mean and variance of the outputs with the sites, shape (n,) each."""
        _, R, L = self.factor(sites)
        A = solve_triangular(L, np.asfortranarray(R), lower=True, overwrite_b=True, check_finite=False)
        push = sites.shift - sites.precision * self.mean
        mean = self.mean + self.outputs @ push - A.T @ (A @ push)
        return mean, np.diagonal(self.outputs) - np.einsum("ij,ij->j", A, A)

    def posterior(self, sites: Sites) -> tuple[Array, Array]:
        """Mean, shape (k,), and covariance, shape (k, k), of theta with the sites."""
        root, _, L = self.factor(sites)
        push = sites.shift - sites.precision * self.mean
        both = np.column_stack([root[:, None] * self.cross.T, root * (self.outputs @ push)])
        G = solve_triangular(L, both, lower=True, check_finite=False)
        cross = G[:, :-1]
        return self.theta + self.cross @ push - cross.T @ G[:, -1], self.covariance - cross.T @ cross


@dataclass(frozen=True)
class IntervalPosterior:
    """Posterior of a window.

    Attributes
    ----------
    window : CoefficientWindow
    theta : shape (k,), mean
    covariance : shape (k, k)
    index : shape (l,), outputs that tell something
    sites : of these, shape (l,)
    """

    window: CoefficientWindow
    theta: Array
    covariance: Array
    index: NDArray[np.int64]
    sites: Sites
    settled: bool

    def likelihood(self) -> Callable[[Array, int], tuple[Array, Array]]:
        """Likelihood of other hypotheses, with the Gaussians in place of the intervals.

        Returns
        -------
        callable
            From hypotheses, shape (m, k), and the first unknown to derive by, to whitened residuals, shape (m, l), and
            derivatives, shape (m, k - first, l).
        """
        inputs, used = (
            self.window.inputs(self.theta),
            self.sites.precision * _TOLD > (1.0 / self.window.model.step**2)[self.index],
        )
        index, precision = self.index[used], self.sites.precision[used]
        rows, middle, F = (
            Rows.all(self.window.model).part(index),
            self.sites.shift[used] / precision,
            inputs.factor[:, index],
        )
        L = np.linalg.cholesky(F.T @ F + np.diag(inputs.own[index] + 1.0 / precision))

        def residuals(theta: Array, first: int) -> tuple[Array, Array]:
            mean, slopes = self.window.means(theta, rows, first)
            m, k, count = slopes.shape
            both = np.concatenate([(middle - mean)[:, None], slopes], axis=1).reshape(-1, count)
            white = solve_triangular(L, both.T, lower=True, check_finite=False).T.reshape(m, k + 1, count)
            return white[:, 0], white[:, 1:]

        return residuals


def fit_intervals(window: CoefficientWindow, start: Array) -> WindowFit:
    """Fit a window from a hypothesis, shape (k,), which is also the prior's mean.

    Returns
    -------
    WindowFit
        The posterior's mean, and its inverse covariance. The misfit is that of the quasi-score there.
    """
    posterior = interval_posterior(window, start)
    if posterior is None:
        return _nothing(start)
    noise = window.noise(posterior.theta)
    if noise.dead:
        return _nothing(start)
    r, _ = window.residual(noise, posterior.theta[None])
    chi2 = float(r[0] @ r[0]) / max(len(noise.sigma) - len(start), 1)
    return WindowFit(posterior.theta, np.asarray(np.linalg.inv(posterior.covariance), float), chi2, posterior.settled)


def interval_posterior(
    window: CoefficientWindow, start: Array, prior_px: float = _PRIOR_PX
) -> IntervalPosterior | None:
    """Posterior of a window, parameters as `fit_intervals`; None where the arithmetic fails.

    The place of the start is known to `prior_px`, one standard deviation of each of its coordinates.
    """
    prior, step = np.diag(_prior_sigma(start, window, prior_px) ** 2), window.model.step
    steps = QuantiserSteps.of(window.each, step)
    theta, covariance = fit_window(window, start[None], _START_STEPS).theta, _CLOSER**2 * prior
    sites, last, settled = Sites(*np.zeros((2, len(step)))), np.zeros(len(start)), False
    for k in range(_ROUNDS):
        inputs = window.inputs(theta)
        index = _near(inputs, covariance, steps)
        belief = _Belief.of(start, prior, theta, inputs, index)
        try:
            seen, spread = steps.part(index), inputs.spread[index]
            part = _propagated(belief, sites.part(index), seen, spread, _SWEEPS[k > 0])
            mean, covariance = belief.posterior(part)
        except np.linalg.LinAlgError:
            return None
        if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
            return None
        sites, change = _scattered(part, index, len(step)), mean - theta
        # about a wide posterior whole changes go to and fro
        change *= 0.5 if change[:2] @ last[:2] < 0.0 else 1.0
        theta = limited_step(theta[None], change[None], most_px=_STEP_PX, free_width=window.pixels.free_width)[0]
        last = change
        settled = bool(k and (np.abs(change[:2]) < _SETTLED * np.sqrt(np.diagonal(covariance)[:2])).all())
        if settled:
            break
    return IntervalPosterior(window, theta, covariance, index, part, settled)


def _nothing(theta: Array) -> WindowFit:
    return WindowFit(theta, np.zeros((len(theta),) * 2), np.nan, False)


def _prior_sigma(start: Array, window: CoefficientWindow, prior_px: float) -> Array:
    level = _PRIOR_LEVEL_E + np.abs(start[3:6])
    width = [_PRIOR_WIDTH * start[6]] if window.pixels.free_width else []
    return np.array([prior_px, prior_px, _PRIOR_LEVEL_E + abs(start[2]), *level, *width])


def _near(inputs: Inputs, covariance: Array, steps: QuantiserSteps) -> NDArray[np.int64]:
    """Index of outputs that noise and hypotheses can bring to an edge of their steps."""
    J, F = inputs.slopes, inputs.factor
    variance = np.einsum("rn,rn->n", F, F) + inputs.own + np.einsum("kn,kl,ln->n", J, covariance, J)
    if steps.frames > 1:
        variance += inputs.spread
    apart = steps.last - steps.first > 1.5 * steps.step  # frames lie on several steps: an edge is among them
    room = np.where(apart, 0.0, np.minimum(steps.last - inputs.mean, inputs.mean - steps.first))
    return np.flatnonzero(room < _FAR * np.sqrt(variance))


def _propagated(belief: _Belief, sites: Sites, steps: QuantiserSteps, spread: Array, sweeps: int) -> Sites:
    """Sites after some sweeps of expectation propagation, all intervals at once."""
    prior = np.diagonal(belief.outputs)
    least = _LEAST_STEP2 * steps.step**2
    for k in range(sweeps):
        mean, variance = belief.updated(sites)
        variance = np.maximum(variance, least)
        # without its own interval an output is known no worse than before all of them
        precision = np.maximum(1.0 / variance - sites.precision, 1.0 / prior)
        shift = mean / variance - sites.shift
        new = steps.sites(shift / precision, 1.0 / precision, spread)
        damping = _DAMPING if k else 1.0
        sites = Sites(
            sites.precision + damping * (new.precision - sites.precision),
            sites.shift + damping * (new.shift - sites.shift),
        )
    return sites


def _scattered(sites: Sites, index: NDArray[np.int64], count: int) -> Sites:
    """Sites of all outputs; those that tell nothing have none."""
    precision, shift = np.zeros((2, count))
    precision[index], shift[index] = sites.precision, sites.shift
    return Sites(precision, shift)
