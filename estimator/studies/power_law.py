"""Exponents of y = c D^p h^q with intervals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import bootstrap

from phibench.scenes.frames import Array


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
