"""Smoothing of light maps where light changes slowly, decided by two independent halves.

A texel's value may be replaced by a straight-line fit through its neighbours, along rows and along columns. Let S_r be
the fit over r texels to each side, and a, b the halves. The expectation of (S_r a - b)^2 is bias^2 + var(S_r a) +
var(b). The r with the least of it, averaged around a texel, is taken there. So shadows and edges stay as they are.

Bright texels are noisier: they are smoothed, and dark ones beside them, which are left as they are, do not get what
these lose. Fits at borders lose some as well. A floor lost 0.33 % of its light, a bright part of it 1.4 %. What the
smoothed texels around have lost on average is given back to them.

The standard error is half the difference of the smoothed halves. What smoothing blurs is not in it: at a single texel
it cannot be told from noise. docs/measurements/light.md has the true errors of the lab.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import ndimage

from phibench.render.room.texel_grid import TexelGrid
from phibench.scenes.frames import Array

_REACHES = (1, 2, 4)  # texels to each side
_AROUND = 5  # texels over which the choice is averaged
_FEWEST = 12  # texels of a grid that is smoothed


def smoothed(grid: TexelGrid, a: Array, b: Array, kept: int) -> tuple[Array, Array]:
    """Mean of two halves, shape (texels, 3), smoothed, and its standard error.

    Parameters
    ----------
    kept : int, odd
        Means of smoothed texels over squares of so many along a side are kept. Small ones leave more of the noise.
    """
    mean, variance = 0.5 * (a + b), (0.5 * (a - b)) ** 2
    for part, rows, columns in grid.grids():
        if rows * columns >= _FEWEST:
            one, other = (half[part].reshape(rows, columns, 3) for half in (a, b))
            best = _best(one, other, kept)
            mean[part], variance[part] = (plane.reshape(-1, 3) for plane in best)
    return mean, np.sqrt(variance)


def _best(a: Array, b: Array, kept: int) -> tuple[Array, Array]:
    """Mean and variance of a grid, each texel with the reach that serves it best."""
    # the reach 0, in which a itself is compared with b
    best, least = [a, b], _around(2.0 * (a - b) ** 2).sum(axis=-1)
    changed = np.zeros((*least.shape, 1), dtype=bool)
    for reach in _REACHES:
        one, other = (_fit(half, reach) for half in (a, b))
        error = _around((one - b) ** 2 + (other - a) ** 2).sum(axis=-1)
        better = (error < least)[..., None]
        best = [np.where(better, new, old) for new, old in zip((one, other), best, strict=True)]
        least = np.minimum(least, error)
        changed |= better
    # given back to none but smoothed texels, and not to rounding: what is dark beside them stays dark
    changed &= (best[0] != 0.0).any(axis=-1, keepdims=True)
    share = np.divide(changed, _around(changed.astype(float), kept), where=changed, out=np.zeros(changed.shape))
    one, other = (fit + share * _around(half - fit, kept) for fit, half in zip(best, (a, b), strict=True))
    return 0.5 * (one + other), (0.5 * (one - other)) ** 2


def _around(image: Array, side: int = _AROUND) -> Array:
    return np.asarray(ndimage.uniform_filter(image, size=(side, side, 1), mode="nearest"))


def _fit(image: Array, reach: int) -> Array:
    """Straight-line fits along both axes."""
    rows, columns = (line_fit(length, reach) for length in image.shape[:2])
    return np.einsum("ij,jkc->ikc", rows, np.einsum("kl,jlc->jkc", columns, image))


@lru_cache(maxsize=512)
def line_fit(length: int, reach: int) -> Array:
    """Matrix (length, length) of straight-line fits over `reach` places to each side; the identity below 4 places."""
    if length < 4:
        return np.eye(length)
    matrix = np.zeros((length, length))
    for i in range(length):
        low, high = max(i - reach, 0), min(i + reach + 1, length)
        x = np.arange(low, high) - float(i)
        centred = x - x.mean()
        # value at x = 0 of the line through the window's points
        matrix[i, low:high] = 1.0 / len(x) - x.mean() * centred / (centred @ centred)
    return matrix
