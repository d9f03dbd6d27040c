"""Rates with intervals: a rate over images, an interval over samples.

Images of one sample succeed and fail together, so that the n of a binomial interval is an effective one: that of a
simple random sample whose rate would vary as the clustered one does (E. L. Korn, B. I. Graubard, Survey Methodology 24,
193, 1998), at most the number of images, and reduced for the degrees of freedom. Then the exact interval of
C. J. Clopper and E. S. Pearson, Biometrika 26, 404 (1934), with beta quantiles. At a rate of 0 or 1 the spread cannot
be seen: the samples are counted as if the images of one sample were always alike.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.stats import beta, t

from phibench.estimator.bench.bootstrap import NOTHING, Clusters, Estimate
from phibench.estimator.bench.rules import Rules
from phibench.scenes.frames import Array


def rate(clusters: Clusters, hits: Array, rules: Rules) -> Estimate:
    """Share of hits with its interval.

    Parameters
    ----------
    clusters : samples of the records
    hits : shape (r,), 0 or 1
    rules : Rules
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
    low = 0.0 if hits <= 0.0 else float(beta.ppf(tail, hits, misses + 1.0))
    high = 1.0 if misses <= 0.0 else float(beta.ppf(1.0 - tail, hits + 1.0, misses))
    return low, high


def _effective_number(found: Array, tried: Array, value: float) -> float:
    m, images = len(found), float(tried.sum())
    if m < 2 or value in (0.0, 1.0):
        return float(m)
    variance = m / (m - 1) * float(np.sum((found - value * tried) ** 2)) / images**2
    if variance == 0.0:
        return float(m)
    reduction = (t.ppf(0.975, images - 1) / t.ppf(0.975, m - 1)) ** 2 if images > m else 1.0
    return min(value * (1.0 - value) / variance * float(reduction), images)
