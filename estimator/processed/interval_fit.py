"""Posterior of a spot from rounded outputs of one or several frames: each lies in one step of the quantiser.

Steps of JPEG are often larger than the noise. Then a coefficient near the edge of its step seems to say much about the
spot, and one far from the edges nothing, both only if the spot is where it is thought to be: a quasi-score has many
roots. The intervals themselves say the same for every hypothesis. With Gaussian outputs y before the quantiser,

    y = m(theta_0) + J^T (theta - theta_0) + noise,    z_i - s_i / 2 <= y_i <= z_i + s_i / 2,

the posterior of theta is a Gaussian cut by planes in y. Expectation propagation finds its mean and covariance (T. P.
Minka, UAI 2001; boxes: J. P. Cunningham, P. Hennig, S. Lacoste-Julien, arXiv:1111.6832): each interval is replaced by
a Gaussian that gives y_i the same mean and variance. m is linear about the posterior's mean, found again some times. Of
several frames y is their mean before the quantiser (`interval_moments`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from phibench.estimator.processed.interval_moments import QuantiserSteps, Sites
from phibench.estimator.processed.quasi_score import CoefficientWindow, Inputs, Rows, WindowFit, fit_window
from phibench.estimator.spots.fisher import limited
from phibench.scenes.frames import Array

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
_LEAST_STEP2 = 1e-9  # variance of an output, in steps squared: less is rounding of the arithmetic
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
    window : Window
    theta : shape (k,), mean
    covariance : shape (k, k)
    index : shape (l,), outputs that tell something
    sites : of these, shape (l,)
    settled : bool
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
        theta = limited(theta[None], change[None], most_px=_STEP_PX, free_width=window.pixels.free_width)[0]
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
