"""Base image: the room behind a spot, in electrons of the raw pixels, with the variance of what is not known of it.

Each of the mosaic's four phases is smoothed as strongly as its local variance allows (adaptive Wiener filter: J. S.
Lim, "Two-Dimensional Signal and Image Processing", 1990, section 9.2): where the room is flat, the base has next to no
noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from phibench.scenes.frames import Array

_SIGMA_PX = 2.5  # of the local mean, pixels of one phase: 5 pixels of the image
_HIDDEN_PX = 5.0  # radius around the spot that the laser-on frame says nothing about
_LEAST_WEIGHT = 1e-6


@dataclass(frozen=True)
class BaseImage:
    """Base of n regions.

    Attributes
    ----------
    mean_e : shape (n, h, w)
    variance_e2 : shape (n, h, w)
        Of its error, taken as independent from pixel to pixel.
    image : shape (n, h, w, 3), uint8, optional
        The decoded JPEG frame that it was taken from.
    """

    mean_e: Array
    variance_e2: Array
    image: NDArray[Any] | None = None


def base_of(x_e: Array, variance_e2: Array, known: Array) -> BaseImage:
    """Smooth images without the spot, or around it.

    Parameters
    ----------
    x_e : shape (n, h, w), electrons of each pixel's own colour
    variance_e2 : shape (n, h, w), of its noise
    known : shape (n, h, w), 0 or 1
        0 where the image says nothing about the base: what surrounds it is carried on, and its structure counts as
        variance.
    """
    mean, variance = np.empty(x_e.shape), np.empty(x_e.shape)
    for row in (0, 1):
        for column in (0, 1):
            at = (slice(None), slice(row, None, 2), slice(column, None, 2))
            mean[at], variance[at] = _of_phase(x_e[at], variance_e2[at], np.asarray(known, float)[at])
    return BaseImage(mean, variance)


def around(uv_px: Array, origin_px: Array, shape: tuple[int, int]) -> Array:
    """Pixels farther than 5 px from (u, v), shape (n, h, w), 0 or 1; positions and origins of shape (n, 2)."""
    v = np.arange(shape[0]) + origin_px[:, 1, None] - uv_px[:, 1, None]
    u = np.arange(shape[1]) + origin_px[:, 0, None] - uv_px[:, 0, None]
    return (v[:, :, None] ** 2 + u[:, None, :] ** 2 > _HIDDEN_PX**2).astype(float)


def _of_phase(x: Array, noise: Array, known: Array) -> tuple[Array, Array]:
    weight = np.maximum(_smooth(known), _LEAST_WEIGHT)
    local = _smooth(known * x) / weight
    spread = _smooth(known * (x - local) ** 2) / weight
    typical = _smooth(known * noise) / weight
    structure = np.maximum(spread - typical, 0.0)
    gain = known * structure / np.maximum(spread, _LEAST_WEIGHT)
    left = np.where(known > 0.0, (gain + (1.0 - gain) / (4.0 * np.pi * _SIGMA_PX**2)) * typical, structure)
    return local + gain * (x - local), left


def _smooth(x: Array) -> Array:
    return np.asarray(gaussian_filter(x, (0.0, _SIGMA_PX, _SIGMA_PX), mode="nearest"))
