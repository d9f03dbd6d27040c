"""What the JPEG frame with the laser off does not say of the room: each coefficient is known to a quantiser's step.

A coefficient c of the room that was quantised lies anywhere in its step s, with the variance s^2 / 12. Where the room
is flat, the high frequencies are 0 and their step says nothing: of a coefficient whose neighbours have the mean square
P the error is taken to have the variance (s^2 / 12) P / (P + s^2 / 12), Wiener's for two Gaussian laws.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter

from phibench.scenes.frames import Array

_SIDE = 8
_NEAR = 3  # frequencies on a side of the square that the mean is taken over


def room_variance(coefficients: Array, step: Array) -> Array:
    """Variance of the error of the room's coefficients, shape (n,).

    Parameters
    ----------
    coefficients : shape (n,)
        Of the quantised frame without the laser, blocks of 8 x 8 one after the other.
    step : shape (n,), of the quantiser
    """
    blocks = np.asarray(coefficients, float).reshape(-1, _SIDE, _SIDE)
    power = blocks * blocks
    power[:, 0, 0] = 0.0  # the level says nothing of the structure
    near = uniform_filter(power, (0, _NEAR, _NEAR), mode="constant") * _NEAR**2 / _counts()
    quantised = step * step / 12.0
    mean = near.ravel()
    variance = quantised * mean / (mean + quantised)
    levels = np.zeros((_SIDE, _SIDE), bool)
    levels[0, 0] = True
    return np.where(np.tile(levels.ravel(), len(blocks)), quantised, variance)


def _counts() -> Array:
    """Frequencies in each square: at the block's sides, and beside the level, there are fewer."""
    there = np.ones((_SIDE, _SIDE))
    there[0, 0] = 0.0
    return np.asarray(np.maximum(uniform_filter(there, _NEAR, mode="constant") * _NEAR**2, 1.0))
