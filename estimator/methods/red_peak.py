"""The place in a box that looks most like a small red spot, to a pixel: where a finer method starts."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from phibench.scenes.frames import Array, BoolArray

CORE_PX, AROUND_PX = 0.9, 3.0
_SIGMA_OF_MAD = 1.4826  # standard deviation of a normal law over its median absolute deviation
EDGE_PX = 2  # of a box, where the surroundings are not seen


def spot_likeness(red: Array) -> Array:
    """Narrow minus wide Gaussian of a redness image, shape (h, w): a matched filter without the room's level."""
    narrow, wide = (gaussian_filter(red, sigma, mode="nearest") for sigma in (CORE_PX, AROUND_PX))
    return np.asarray(narrow - wide)


def red_peak(red: Array, inside: BoolArray | None = None, least_sigmas: float = 0.0) -> tuple[float, float] | None:
    """Pixel (u, v) of the largest likeness, in the coordinates of `red`; None if nothing stands out.

    Parameters
    ----------
    red : shape (h, w)
        Redness, or any image in which the spot is brighter than its surroundings.
    inside : bool, shape (h, w), optional
        Where the spot may be.
    least_sigmas : float
        The peak must exceed the scatter of the likeness so many times (median absolute deviation).
    """
    if min(red.shape) < 3 or not np.isfinite(red).all():
        return None
    likeness = spot_likeness(red)
    allowed = np.ones(red.shape, bool) if inside is None else inside
    if not allowed.any():
        return None
    masked = np.where(allowed, likeness, -np.inf)
    v, u = np.unravel_index(int(np.argmax(masked)), masked.shape)
    scatter = _SIGMA_OF_MAD * float(np.median(np.abs(likeness[allowed])))
    if not masked[v, u] > max(least_sigmas * scatter, 0.0):
        return None
    return float(u), float(v)
