"""Laws of one pixel's reading x, given its mean mu: what a likelihood fit needs to know of them.

All values are in electrons; arrays are of shape (n, h, w): spot, row, column.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from phibench.estimator.raw_pixels import PixelNoise
from phibench.scenes.frames import Array


class PixelLaw(Protocol):
    """Score, information and misfit of pixels."""

    def rows(self, index: NDArray[np.int64]) -> PixelLaw:
        """Law of some of the spots."""

    def score(self, x: Array, mean: Array) -> Array:
        """Derivative of the log likelihood by the mean."""

    def information(self, mean: Array) -> Array:
        """Mean square of the score."""

    def misfit(self, x: Array, mean: Array) -> Array:
        """-2 log likelihood, up to a constant of the pixel."""


@dataclass(frozen=True)
class GaussLaw:
    """Gaussian quasi-likelihood with the variance V(mu), plus `extra_e2` of other origin.

    Parameters
    ----------
    noise : PixelNoise
    extra_e2 : float or shape (n, h, w)
        Variance that does not depend on the mean, such as that of a base image.
    """

    noise: PixelNoise
    extra_e2: float | Array = 0.0

    def rows(self, index: NDArray[np.int64]) -> GaussLaw:
        """Law of some of the spots."""
        extra = self.extra_e2[index] if isinstance(self.extra_e2, np.ndarray) else self.extra_e2
        return replace(self, extra_e2=extra)

    def score(self, x: Array, mean: Array) -> Array:
        """(x - mu) / V."""
        return (x - mean) * self.information(mean)

    def information(self, mean: Array) -> Array:
        """1 / V."""
        return np.asarray(1.0 / (self.noise.variance_e2(mean) + self.extra_e2))

    def misfit(self, x: Array, mean: Array) -> Array:
        """(x - mu)^2 / V + log V."""
        information = self.information(mean)
        return np.asarray((x - mean) ** 2 * information - np.log(information))
