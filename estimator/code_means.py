"""Mean and spread of the 8-bit codes of interpolated pixels, from the exact law of the converter's DN.

A demosaiced value is the mean of 1, 2 or 4 pixels, so it stands on a lattice of 1, 1/2 or 1/4 DN. A webcam's converter
and the sRGB curve are coarse against the noise (12.5 electrons a DN, up to 3 codes a DN): the code's rounding does not
average out, and smooth expansions are off by up to half a code. The sums over the lattice are done once, on nodes of
the mean, as for pixels of equal means; along the slope of a spot the variances add up to the same, V being affine.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve
from scipy.special import ndtr
from scipy.stats import poisson

from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.raw_pixels import PixelNoise
from phibench.estimator.tone_curve import encoded
from phibench.scenes.frames import Array

COUNTS = (1, 2, 4)
"""Pixels in a mean."""

_NODES = 400  # even in sqrt(mu)
_POISSON_UP_TO_E = 300.0  # from there a Gaussian: skewness 0.06
_SIGMAS = 8.0


@dataclass(frozen=True)
class MeanCodes:
    """Tables on nodes even in sqrt(mean), shape (3, 3, m): colour, one of `COUNTS`, node.

    Attributes
    ----------
    step : float
        Distance of the nodes, square roots of electrons.
    mean : codes
    by_mean : codes per electron of the pixels' mean
    regression : codes per electron: covariance of code and mean of the pixels, over the variance of the latter
    excess : variance of the code that the regression leaves, codes squared
    """

    step: float
    mean: Array
    by_mean: Array
    regression: Array
    excess: Array

    def at(self, name: str, mean_e: Array, which: NDArray[np.int64]) -> Array:
        """Values of one table, linear between nodes.

        Parameters
        ----------
        name : "mean", "by_mean", "regression" or "excess"
        mean_e : shape (..., p)
            Below 0 the mean goes on along its slope at 0.
        which : shape (p,), int
            Row of the table, 3 x colour + place in `COUNTS`.
        """
        table = getattr(self, name).reshape(9, -1)
        root = np.sqrt(np.maximum(mean_e, 0.0)) / self.step
        node = np.minimum(root.astype(np.int64), table.shape[1] - 2)
        share = np.minimum(root - node, 1.0)
        first = table[which, node]
        value = first + share * (table[which, node + 1] - first)
        return value + np.minimum(mean_e, 0.0) * self.by_mean.reshape(9, -1)[which, 0] if name == "mean" else value


@lru_cache(maxsize=8)
def mean_codes(card: SensorCard, noise: PixelNoise) -> MeanCodes:
    """Tables of a sensor whose colour matrix is the unit matrix; `noise` is without the converter's rounding."""
    root, step = np.linspace(0.0, np.sqrt(1.3 * card.saturation_e), _NODES, retstep=True)
    sums = np.array([_moments(mu, card, noise) for mu in root**2])  # (m, colour, count, 4)
    mean, regression, excess = np.ascontiguousarray(sums.transpose(3, 1, 2, 0))
    by_mean = np.gradient(mean, root**2, axis=-1)
    return MeanCodes(float(step), mean, by_mean, regression, excess)


def _moments(mu: float, card: SensorCard, noise: PixelNoise) -> Array:
    """Mean code, regression and excess, shape (3 colours, 3 counts, 3)."""
    first, chance = _law(mu, card, noise)
    result = np.empty((3, len(COUNTS), 3))
    for i, count in enumerate(COUNTS):
        if count > 1:
            chance = np.maximum(fftconvolve(chance, chance), 0.0)
        x = first + np.arange(len(chance)) / count - card.black_level_dn  # DN above black
        p = chance / chance.sum()
        linear = x / (card.top_dn - card.black_level_dn)
        y = np.stack([np.rint(255.0 * encoded(gain * linear)) for gain in card.white_balance])
        mean = y @ p
        dx = x - x @ p
        variance = dx**2 @ p
        covariance = (y - mean[:, None]) * dx @ p
        slope = covariance / variance if variance > 0.0 else np.zeros(3)  # 0: full pixels have one DN only
        left = (y - mean[:, None]) ** 2 @ p - slope * covariance
        result[:, i] = np.stack([mean, slope * card.dn_per_e, np.maximum(left, 0.0)], axis=-1)
    return result


def _law(mu: float, card: SensorCard, noise: PixelNoise) -> tuple[float, Array]:
    """First DN and the chances of the DN from there on, of one pixel."""
    spread = _SIGMAS * np.sqrt(noise.variance_e2(np.array(mu)) + 1.0 / card.dn_per_e**2)
    ends = np.rint(card.black_level_dn + card.dn_per_e * np.array([mu - spread, mu + spread]))
    low, high = np.clip(ends, [0.0, 1.0], [card.top_dn - 1.0, card.top_dn])
    edges = (np.arange(low, high) + 0.5 - card.black_level_dn) / card.dn_per_e
    if mu > _POISSON_UP_TO_E:
        below = ndtr((edges - mu) / np.sqrt(noise.variance_e2(np.array(mu))))
    else:
        n = np.arange(0.0, mu + 8.0 * np.sqrt(mu) + 12.0)
        r = max(float(np.sqrt(noise.gaussian_e2 + (noise.prnu * mu) ** 2)), 1e-6)
        below = ndtr((edges[:, None] - n) / r) @ poisson.pmf(n, mu)
    return float(low), np.diff(np.concatenate([[0.0], below, [1.0]]))
