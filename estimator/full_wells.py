"""Pixels that the full well cuts: mean, slope and variance of min(X, W) for a Gaussian X.

With z = (W - mu) / s, Phi and phi of the normal law, and T = W - min(X, W):

    E[T] = s (z Phi(z) + phi(z)),    E[T^2] = s^2 ((z^2 + 1) Phi(z) + z phi(z)),    dE[min(X, W)] / dmu = Phi(z).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from phibench.scenes.frames import Array

_FAR = 6.0  # deviations below the full well from which on a pixel counts as free


@dataclass(frozen=True)
class CutPixels:
    """What is left of pixels, shapes as the means.

    Attributes
    ----------
    mean_e, variance_e2 : electrons, electrons squared
    slope : of the mean by the uncut mean, 1 far below the full well and 0 above it
    """

    mean_e: Array
    slope: Array
    variance_e2: Array


def cut_pixels(mean_e: Array, variance_e2: Array, well_e: float) -> CutPixels:
    """Cut pixels of these means and variances, any shape, at a full well."""
    s = np.sqrt(variance_e2)
    z = (well_e - mean_e) / s
    if not (z < _FAR).any():
        return CutPixels(mean_e, np.ones_like(mean_e), variance_e2)
    below, density = ndtr(z), np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    lost = s * (z * below + density)
    square = variance_e2 * ((z * z + 1.0) * below + z * density)
    free = z >= _FAR
    return CutPixels(
        np.where(free, mean_e, well_e - lost),
        np.where(free, 1.0, below),
        np.where(free, variance_e2, np.maximum(square - lost * lost, 0.0)),
    )
