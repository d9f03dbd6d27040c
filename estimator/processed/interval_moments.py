"""Gaussians that stand for the intervals of outputs: one frame's, and the mean of several frames'.

Each site of expectation propagation gives an output y the mean and variance that its intervals do. Of one frame these
are the moments of a cut Gaussian. Of f frames y is their mean before the quantiser. With x what they share and s the
spread of one frame about it, the frames are independent given x, and

    L(x) = product over frames of [Phi((high - x) / s) - Phi((low - x) / s)]

is all that the intervals say of x. The site for y = x + noise of variance s^2 / f follows from the derivatives of the
logarithm of the integral of L over the Gaussian that the other outputs give.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfcx, log_ndtr, ndtr

from phibench.scenes.frames import Array

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
    frames : int
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
