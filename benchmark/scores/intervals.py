"""Statistics over samples (mean, rms, ratio, quantile, rate) with 95 % intervals, by bootstrap or Clopper-Pearson.

Images of one sample share its errors. All noise realisations and both images of a sample are therefore resampled
together. A resample is a weight per sample, its number of occurrences. Statistics take weights, shape (b, n), so that
one matrix product gives b resampled sums. The BCa intervals are those of `scipy.stats.bootstrap` (B. Efron, J. Am.
Stat. Assoc. 82, 171, 1987).

BCa has no value in three cases:

* fewer than `least_samples` samples: no interval;
* no spread among the resamples (all errors equal): the interval is the value itself, and the note says so;
* all resamples on one side of the value, which makes the bias correction infinite: the percentile interval, noted.

A rate over images has the exact interval of C. J. Clopper and E. S. Pearson, Biometrika 26, 404 (1934), with beta
quantiles. Its n is an effective one: that of a simple random sample whose rate would vary as the clustered one does
(E. L. Korn, B. I. Graubard, Survey Methodology 24, 193, 1998). It is at most the number of images, and is reduced for
the degrees of freedom. A rate of 0 or 1 shows no spread: images of one sample then count as always alike.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from phibench.benchmark.scores.answer_errors import Rules
from phibench.scenes.frames import Array

Statistic = Callable[[Array], Array]
"""Weights, shape (b, n samples), to values, shape (b,)."""

NORMAL_95 = 1.959963984540054
"""Standard deviations of a normal error that hold 95 %."""
EQUAL = "all resamples equal"
FEW = "under {} samples"
PERCENTILE = "BCa undefined: percentile interval"
NOTHING = "nothing to compute it from"
AT_ONCE = 2**21  # weights held at a time: 16 MiB
NO_SPREAD = 1e-12  # of the value: rounding of sums


@dataclass(frozen=True)
class Estimate:
    """A value with its interval; NaN where there is none, and `note` says why."""

    value: float
    low: float
    high: float
    note: str = ""

    @property
    def ends(self) -> tuple[float, float, float]:
        """Value, low and high."""
        return self.value, self.low, self.high


@dataclass(frozen=True)
class Clusters:
    """Sample that each of r records belongs to: `index`, shape (r,), values 0 to n - 1, each at least once.

    `key` is equal for records of the same samples.
    """

    index: NDArray[np.int64]
    n: int
    key: bytes = b""

    @classmethod
    def of(cls, labels: Sequence[str] | NDArray[Any]) -> Clusters:
        """From the labels of the records."""
        names, index = np.unique(np.asarray(labels), return_inverse=True)
        return cls(index, len(names), names.tobytes())

    def sums(self, *columns: Array) -> Array:
        """Sums per sample, shape (n, columns)."""
        return np.stack([np.bincount(self.index, column, self.n) for column in columns], axis=-1)


def mean_of(clusters: Clusters, values: Array) -> Statistic:
    """Mean over records."""
    return ratio_of(clusters, values, np.ones_like(values))


def geometric_of(clusters: Clusters, logarithms: Array) -> Statistic:
    """Geometric mean over records."""
    mean = mean_of(clusters, logarithms)
    return lambda weights: np.exp(mean(weights))


def ratio_of(clusters: Clusters, above: Array, below: Array) -> Statistic:
    """Ratio of two sums."""
    table = clusters.sums(above, below)
    return lambda weights: _ratio(weights @ table)


def rms_of(clusters: Clusters, squares: Array) -> Statistic:
    """Root of the mean of squares."""
    mean = mean_of(clusters, squares)
    return lambda weights: np.sqrt(mean(weights))


def rms_ratio_of(clusters: Clusters, above: Array, below: Array) -> Statistic:
    """Root of the ratio of two sums of squares; infinite where only the lower one is 0."""
    ratio = ratio_of(clusters, above, below)
    return lambda weights: np.sqrt(ratio(weights))


def best_constant_of(clusters: Clusters, inverse: Array) -> Statistic:
    """Relative rms error of the constant that is best for some values, from their inverses."""
    table = clusters.sums(inverse, inverse**2, np.ones_like(inverse))

    def error(weights: Array) -> Array:
        first, second, n = np.moveaxis(weights @ table, -1, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            # relative rms of the best constant c = sum(q) / sum(q^2), q = 1 / D
            return np.sqrt(np.maximum(1.0 - first**2 / (n * second), 0.0))

    return error


def deviation_of(clusters: Clusters, *columns: Array) -> Statistic:
    """Standard deviation about each column's own mean, pooled over columns (division by the number of records)."""
    table = clusters.sums(*columns, np.sum(np.square(columns), axis=0), np.ones_like(columns[0]))

    def deviation(weights: Array) -> Array:
        sums = weights @ table
        with np.errstate(invalid="ignore"):
            means, square = sums[..., :-2] / sums[..., -1:], sums[..., -2] / sums[..., -1]
        return np.sqrt(np.maximum(square - np.sum(means**2, axis=-1), 0.0) / len(columns))

    return deviation


def quantile_of(clusters: Clusters, values: Array, share: Fraction) -> Statistic:
    """Quantile of the records: where the empirical distribution steps over `share`, the mean of both sides at a step.

    Definition 2 of R. J. Hyndman and Y. Fan, Am. Stat. 50, 361 (1996): the median as everybody knows it.
    """
    order = np.argsort(values, kind="stable")
    ordered, index = values[order], clusters.index[order]

    def quantile(weights: Array) -> Array:
        rows = max(1, AT_ONCE // len(ordered))
        # records first, resamples last: running sums of whole rows are quick; counts are exact in 32 bits up to 2^24
        counts = np.ascontiguousarray(weights.T, dtype=np.float32)
        parts = [_quantile(counts[:, i : i + rows][index], ordered, share) for i in range(0, len(weights), rows)]
        return np.concatenate(parts)

    return quantile


def estimates(statistics: Sequence[Statistic], n: int, rules: Rules, rng: np.random.Generator) -> list[Estimate]:
    """Values of statistics of n samples with intervals from one common set of resamples.

    Returns
    -------
    list of Estimate, one per statistic
    """
    if n == 0:
        return [Estimate(math.nan, math.nan, math.nan, NOTHING) for _ in statistics]
    values = [float(statistic(np.ones((1, n)))[0]) for statistic in statistics]
    if n < max(rules.least_samples, 2):
        note = FEW.format(rules.least_samples)
        return [Estimate(value, math.nan, math.nan, note) for value in values]
    result = _bootstrap(statistics, n, rules, rng)
    low, high = result.confidence_interval
    drawn = result.bootstrap_distribution
    return [_estimate(*row, rules.confidence) for row in zip(values, low, high, drawn, strict=True)]


def _bootstrap(statistics: Sequence[Statistic], n: int, rules: Rules, rng: np.random.Generator) -> Any:
    def all_of(index: NDArray[np.int64], axis: int = -1) -> Array:
        weights = _weights(np.atleast_2d(index), n)
        values = np.stack([statistic(weights) for statistic in statistics])
        return values if index.ndim > 1 else values[:, 0]

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")  # degenerate statistics come back NaN and are told apart below
        return scipy.stats.bootstrap(
            (np.arange(n),),
            all_of,
            n_resamples=rules.resamples,
            batch=max(1, AT_ONCE // n),
            confidence_level=rules.confidence,
            method="BCa",
            vectorized=True,
            rng=rng,
        )


def percentile_interval(
    data: Sequence[NDArray[Any]], statistic: Callable[..., Any], resamples: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Ends of the percentile bootstrap's 95 % interval of a statistic of n independent cases.

    Parameters
    ----------
    data : columns of shape (n,), drawn together
    statistic : of as many columns; where it takes `axis`, of many resamples at once
    """
    drawn = scipy.stats.bootstrap(data, statistic, paired=True, n_resamples=resamples, method="percentile", rng=rng)
    return np.atleast_1d(drawn.confidence_interval.low), np.atleast_1d(drawn.confidence_interval.high)


def _estimate(value: float, low: float, high: float, drawn: Array, confidence: float) -> Estimate:
    if not math.isfinite(value):
        return Estimate(value, math.nan, math.nan, "infinite" if math.isinf(value) else NOTHING)
    drawn = drawn[np.isfinite(drawn)]
    if drawn.size == 0 or np.ptp(drawn) <= NO_SPREAD * max(abs(value), np.finfo(float).tiny):
        return Estimate(value, value, value, EQUAL)
    if math.isfinite(low) and math.isfinite(high):
        return Estimate(value, float(low), float(high))
    tail = (1.0 - confidence) / 2.0
    low, high = np.quantile(drawn, [tail, 1.0 - tail])
    return Estimate(value, float(low), float(high), PERCENTILE)


def _weights(index: NDArray[np.int64], n: int) -> Array:
    """Counts of each sample in each row of indices, shape (b, n); float, for the matrix products."""
    rows = np.arange(len(index))[:, None] * n
    return np.bincount((index + rows).ravel(), minlength=len(index) * n).reshape(-1, n).astype(float)


def _ratio(sums: Array) -> Array:
    with np.errstate(invalid="ignore", divide="ignore"):
        return sums[..., 0] / sums[..., 1]


def _quantile(counts: NDArray[np.float32], ordered: Array, share: Fraction) -> Array:
    """Quantiles of `ordered` under whole-number weights, shape (r, b); without fractions, so that a step is a step."""
    below = np.cumsum(counts, axis=0, out=counts)
    goal = below[-1] * np.float32(share.numerator)
    below *= np.float32(share.denominator)
    # both neighbours where the share falls between two values; whole numbers alone, so that it is exact
    low, high = np.count_nonzero(below < goal, axis=0), np.count_nonzero(below <= goal, axis=0)
    return 0.5 * (ordered[low] + ordered[np.minimum(high, len(ordered) - 1)])


def rate(clusters: Clusters, hits: Array, rules: Rules) -> Estimate:
    """Share of hits with its interval.

    Parameters
    ----------
    clusters : samples of the records
    hits : shape (r,), 0 or 1
    """
    if clusters.n == 0:
        return Estimate(math.nan, math.nan, math.nan, NOTHING)
    found, tried = clusters.sums(hits, np.ones_like(hits)).T
    value = float(found.sum() / tried.sum())
    n = _effective_number(found, tried, value)
    return Estimate(value, *clopper_pearson(value * n, n, rules.confidence))


def clopper_pearson(hits: float, n: float, confidence: float) -> tuple[float, float]:
    """Exact binomial interval; hits and n need not be whole."""
    tail, misses = (1.0 - confidence) / 2.0, n - hits
    # ends of the interval are quantiles of beta laws; hits and trials need not be whole
    low = 0.0 if hits <= 0.0 else float(scipy.stats.beta.ppf(tail, hits, misses + 1.0))
    high = 1.0 if misses <= 0.0 else float(scipy.stats.beta.ppf(1.0 - tail, hits + 1.0, misses))
    return low, high


def _effective_number(found: Array, tried: Array, value: float) -> float:
    m, images = len(found), float(tried.sum())
    if m < 2 or value in (0.0, 1.0):
        return float(m)
    # variance of a ratio over samples, by its linear part
    variance = m / (m - 1) * float(np.sum((found - value * tried) ** 2)) / images**2
    if variance == 0.0:
        return float(m)
    # Korn and Graubard: samples, not images, are the degrees of freedom
    reduction = (scipy.stats.t.ppf(0.975, images - 1) / scipy.stats.t.ppf(0.975, m - 1)) ** 2 if images > m else 1.0
    return min(value * (1.0 - value) / variance * float(reduction), images)
