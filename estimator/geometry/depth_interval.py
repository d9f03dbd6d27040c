"""Intervals and pulls of a depth: in D, or in 1 / D where its standard deviation is a large part of it.

A disparity is nearly linear in 1 / D, so that sigma of D goes as D squared. An error towards the rig then comes with a
sigma that is too small, and one away from it with one that is too large; in 1 / D both have the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from phibench.scenes.frames import Array

LINEAR = 0.05
"""Sigma of D over D up to which intervals and pulls are those of D itself."""
_NORMAL_95 = 1.959964


def depth_pull(depth_m: ArrayLike, sigma_m: ArrayLike, true_m: ArrayLike) -> Array:
    """Errors over their standard deviations, positive where D is too large; shapes as they broadcast.

    Beyond `LINEAR` it is that of 1 / D, whose sigma is sigma / D^2.
    """
    D, sigma, true = (np.asarray(x, float) for x in (depth_m, sigma_m, true_m))
    pull = (D - true) / sigma
    return np.asarray(np.where(sigma > LINEAR * D, pull * D / true, pull))


def depth_interval(depth_m: float, sigma_m: float) -> tuple[float, float]:
    """Ends in metres between which D lies with 95 %; the far one is infinite where 1 / D may be 0."""
    if sigma_m <= LINEAR * depth_m:
        return depth_m - _NORMAL_95 * sigma_m, depth_m + _NORMAL_95 * sigma_m
    half = _NORMAL_95 * sigma_m / depth_m
    return depth_m / (1.0 + half), depth_m / (1.0 - half) if half < 1.0 else np.inf
