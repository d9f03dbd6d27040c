"""What a uniform quantiser makes of a Gaussian: mean, its slopes, and variance. Steps and values in the same unit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from phibench.scenes.frames import Array

_FINE = 0.9  # standard deviations per step from which the output is input plus rounding: off by 2e-7 steps
_THRESHOLDS = np.arange(-5, 6) + 0.5  # about the nearest multiple: 5 steps are 5.5 of the coarsest deviation
_LEAST = 1e-4  # standard deviation in steps; a smaller one would make slopes that no step of a fit can follow


@dataclass(frozen=True)
class Quantised:
    """Output for Gaussian inputs, arrays of the inputs' shape.

    Attributes
    ----------
    mean : E Q
    slope : its derivative by the input's mean
    variance : of Q
    """

    mean: Array
    slope: Array
    variance: Array


def quantised(mean: Array, sigma: Array, step: Array) -> Quantised:
    """Round to multiples of `step`, halves either way; arrays broadcast together."""
    m, s, q = np.broadcast_arrays(mean / step, np.maximum(sigma / step, _LEAST), step)
    fine = s >= _FINE
    result = Quantised(m * q, np.ones_like(m), (s**2 + 1.0 / 12.0) * q**2)
    if fine.all():
        return result
    coarse = ~fine
    first, slope, variance = _sums(m[coarse], s[coarse])
    q = q[coarse]
    result.mean[coarse], result.slope[coarse], result.variance[coarse] = first * q, slope, variance * q**2
    return result


def _sums(m: Array, s: Array) -> tuple[Array, Array, Array]:
    """Unit step: round(x) = nearest + sum over thresholds above of 1[x > t] - sum below of 1[x < t]."""
    nearest = np.rint(m)
    t = (nearest[:, None] + _THRESHOLDS - m[:, None]) / s[:, None]
    above = ndtr(-t)  # chance to be above each threshold
    slope = np.exp(-0.5 * t * t).sum(axis=1) / (np.sqrt(2.0 * np.pi) * s)
    low = _THRESHOLDS[0] - 0.5
    mean = low + above.sum(axis=1)  # relative to the nearest
    # k^2 = sum of its increases 2 k' - 1 over the thresholds passed, k' the multiple above the threshold
    square = low**2 + above @ (2.0 * _THRESHOLDS)
    return nearest + mean, slope, np.maximum(square - mean**2, 0.0)
