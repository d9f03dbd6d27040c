"""Statistics that several studies use: power laws, root mean squares, and first crossings.

Power laws y = c D^p h^q are fitted to logarithms, with intervals of the exponents. A first crossing is the value of a
number at which a cost that grows with it reaches a given size; it takes the whole cost, not its slope.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import bootstrap

from phibench.estimator.studies.findings import Finding
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator


@dataclass(frozen=True)
class PowerLaw:
    """Exponents with their intervals.

    Attributes
    ----------
    exponents : shape (k,)
    low, high : shape (k,)
    rms_log : float
        Root mean square residual of log y: by how much, relatively, the law misses.
    """

    exponents: Array
    low: Array
    high: Array
    rms_log: float

    def holds(self, i: int, exponent: float) -> bool:
        """Whether an exponent lies in the i-th interval."""
        return bool(self.low[i] <= exponent <= self.high[i])


def fit_power_law(
    y: Array, bases: Array, random: np.random.Generator, resamples: int = 2000, confidence: float = 0.95
) -> PowerLaw:
    """Least squares on logarithms; intervals by the percentile bootstrap over cases.

    Parameters
    ----------
    y : shape (n,), above 0; other values are left out
    bases : shape (k, n), above 0
    random : Generator
    resamples, confidence
    """
    good = np.isfinite(y) & (y > 0.0)
    logs = [np.log(x[good]) for x in (*bases, y)]
    found = bootstrap(
        logs,
        lambda *rows: _exponents(rows),
        paired=True,
        vectorized=False,
        n_resamples=resamples,
        confidence_level=confidence,
        method="percentile",
        rng=random,
    )
    design = np.stack([np.ones(good.sum()), *logs[:-1]], axis=-1)
    fitted = np.linalg.lstsq(design, logs[-1], rcond=None)[0]
    rms = float(np.sqrt(np.mean((logs[-1] - design @ fitted) ** 2)))
    interval = found.confidence_interval
    return PowerLaw(fitted[1:], np.atleast_1d(interval.low), np.atleast_1d(interval.high), rms)


def _exponents(rows: tuple[Array, ...]) -> Array:
    design = np.stack([np.ones(len(rows[0])), *rows[:-1]], axis=-1)
    return np.asarray(np.linalg.lstsq(design, rows[-1], rcond=None)[0][1:])


RESAMPLES = 2000
CONFIDENCE = 0.95


def rms(values: Array) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def rms_interval(values: Array, *names: str) -> tuple[float, float]:
    """Percentile bootstrap interval, 95 %, of a root mean square over independent cases; NaN for less than three.

    `names` are those of the random stream.
    """
    if len(values) < 3:
        return float("nan"), float("nan")
    found = bootstrap(
        (np.square(values),),
        lambda squares, axis: np.sqrt(np.mean(squares, axis=axis)),
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        vectorized=True,
        rng=generator("study", "spread", *names),
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def rms_finding(label: str, values: Array, *names: str) -> Finding:
    """Rms of relative values in per cent, with its interval; values that are not finite are left out."""
    good = values[np.isfinite(values)]
    low, high = rms_interval(good, *names)
    return Finding(label, 100.0 * rms(good), 100.0 * low, 100.0 * high, "%")


Cost = Callable[[float], Array]
"""Value above 0 to costs, any shape; infinite where the value cannot be."""


def first_crossing(cost: Cost, target: float, start: float, limit: float, factor: float) -> Array:
    """Smallest value up to `limit` whose cost is `target`, in the shape of the costs; NaN where there is none.

    Costs are taken at start, start factor, start factor^2, ...; between two of them a power law is interpolated, and
    below `start` the cost counts as proportional to the value. The error of the power law is at most
    (ln factor)^2 / 8 times the curvature of ln(cost) over ln(value). Before a value that cannot be, the last one that
    can be is given.

    Parameters
    ----------
    cost : callable
    target, start, limit : float, above 0
    factor : float, above 1
    """
    before, low = start, np.asarray(cost(start), float)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.where(low >= target, start * target / low, np.nan)
    while np.isnan(found).any() and before < limit:
        value = min(before * factor, limit)
        high = np.asarray(cost(value), float)
        new = np.isnan(found) & (high >= target)
        found = np.where(new, _between(before, value, low, high, target), found)
        before, low = value, high
    return found


def _between(a: float, b: float, low: Array, high: Array, target: float) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.log(target / low) / np.log(high / low)
    # no cost at all before: the crossing is anywhere in between, the upper end is taken
    share = np.where(np.isinf(high), 0.0, np.where(low > 0.0, share, 1.0))
    return a * (b / a) ** np.clip(share, 0.0, 1.0)
