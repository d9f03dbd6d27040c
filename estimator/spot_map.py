"""Map of how much every half pixel looks like a spot: a matched filter, normalised by the noise.

Amplitude of a spot of the profile k (pixel-integrated Gaussian) at a place: A = sum(k d) / sum(k^2), its variance
V / sum(k^2), over the sites of the red plane; d is the light above the background. The background is
the laser-off frame where there is one; otherwise green, scaled to the local ratio of red and green, because the room's
light is not as red as the laser; without filters the mean of the surroundings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, uniform_filter
from skimage.feature import peak_local_max

from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.colour_planes import ColourPlanes, green_at_red, variance_e2
from phibench.estimator.gaussian_spot import profile
from phibench.scenes.frames import Array, BoolArray

_REACH_PX = 4
_PHASES = (0.0, 0.5)
_AROUND_PX, _CORE_PX = 13, 5  # of the surroundings that a background is taken from, and what is left out of them
# JPEG's coarse chroma spreads red into green: what is taken off would move the peak
_GREEN_TAKEN = {"raw": 1.0, "srgb8": 1.0, "mjpeg": 0.0}
_NOISE = 0.70  # standard deviation of the highest of the four phases for pure noise, measured


@dataclass(frozen=True)
class Peaks:
    """Local maxima of the map, highest first; (u, v) relative to the part, shape (n, 2), and z, shape (n,)."""

    uv_px: Array
    z: Array


def peaks(
    on: ColourPlanes,
    off: ColourPlanes | None,
    card: SensorCard,
    sigma_px: float,
    inside: BoolArray,
    least_z: float,
    most: int,
) -> Peaks:
    """The strongest local maxima of the map.

    Parameters
    ----------
    on, off : ColourPlanes
        Laser on and, if there is one, off.
    card : SensorCard
    sigma_px : float
        Blur in the planes.
    inside : shape (h, w)
        Where to look.
    least_z : float
        In standard deviations of the noise; of processed images, of the map's.
    most : int
    """
    light, variance = _above_background(on, off, card)
    z, phase = _highest_phase(light, variance, on, sigma_px)
    z = np.where(inside, z / (1.0 if card.output == "raw" else _spread(z, inside)), np.float32(0.0))
    vu = peak_local_max(  # type: ignore[no-untyped-call]
        z, min_distance=2, threshold_abs=least_z, exclude_border=False, num_peaks=most
    )
    at = (vu[:, 0], vu[:, 1])
    shift = np.stack([phase[at] % 2, phase[at] // 2], axis=-1) * _PHASES[1]
    return Peaks(vu[:, ::-1] + shift, z[at])


def _above_background(on: ColourPlanes, off: ColourPlanes | None, card: SensorCard) -> tuple[Array, Array]:
    """Red light above the background, shape (h, w), zero where there is no site, and the variance of a pixel."""
    if off is not None:
        level = np.maximum(on.values_e[0], off.values_e[0])
        return _flat(on.values_e[0] - off.values_e[0], on), 2.0 * _variance(level, on, card, True)
    if len(on.values_e) == 1:
        return _flat(on.values_e[0], on), _variance(on.values_e[0], on, card, False)
    red, green = on.values_e[0], green_at_red(on)
    ratio = _mean(red, on, _AROUND_PX) / np.maximum(_mean(green, on, _AROUND_PX), 1.0)
    ratio *= _GREEN_TAKEN[card.output]
    light = _flat(np.where(on.sites[0], red - ratio * green, np.float32(0.0)), on)
    share = 0.25 if on.mosaic else 1.0  # four green neighbours are averaged
    return light, _variance(red, on, card, False) + share * ratio**2 * _variance(green, on, card, False)


def _flat(plane: Array, on: ColourPlanes) -> Array:
    """Plane less the mean of its surroundings, the core left out."""
    outer, core = _mean(plane, on, _AROUND_PX), _mean(plane, on, _CORE_PX)
    share = (_CORE_PX / _AROUND_PX) ** 2
    return np.where(on.sites[0], plane - (outer - share * core) / (1.0 - share), 0.0)


def _mean(plane: Array, on: ColourPlanes, side: int) -> Array:
    """Mean over the red sites of a square, known at every pixel; of a mosaic as near to the side as whole sites go."""
    if not on.mosaic:
        return uniform_filter(plane, side)
    result = np.repeat(np.repeat(uniform_filter(plane[::2, ::2], side // 2 + 1 - side // 2 % 2), 2, 0), 2, 1)
    return result[: plane.shape[0], : plane.shape[1]]


def _variance(plane: Array, on: ColourPlanes, card: SensorCard, alike: bool) -> Array:
    return np.asarray(variance_e2(_mean(plane, on, _CORE_PX), card, alike), np.float32)


def _highest_phase(
    light: Array, variance: Array, on: ColourPlanes, sigma_px: float
) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
    """Largest z over the places (u, v) + (0 or 1/2, 0 or 1/2), and which it was: 2 x (row's half) + column's half."""
    count = 2 * _REACH_PX + 1
    centres = _REACH_PX + np.array(_PHASES)
    kernels = profile(centres, np.full(2, sigma_px), count).share.astype(np.float32)
    best: NDArray[np.float32] = np.full(light.shape, -np.inf, np.float32)
    which: NDArray[np.int8] = np.zeros(light.shape, np.int8)
    scale = np.sqrt(variance)
    for i, down in enumerate(kernels):
        rows = _correlated(light, down, 0)
        for j, across in enumerate(kernels):
            norm = np.sqrt(np.outer(_squares(down, on, 0), _squares(across, on, 1)))
            z = _correlated(rows, across, 1) / (scale * norm.astype(np.float32))
            higher = z > best
            best[higher], which[higher] = z[higher], 2 * i + j
    return best, which


def _correlated(plane: Array, kernel: Array, axis: int) -> Array:
    return np.asarray(correlate1d(plane, kernel, axis=axis, mode="constant"))


def _squares(kernel: Array, on: ColourPlanes, axis: int) -> Array:
    """Sum of k^2 over the red sites around each row (axis 0) or column, shape (h,) or (w,)."""
    site = (np.arange(on.shape[axis]) % 2 == 0) if on.mosaic else np.ones(on.shape[axis], bool)
    # the border counts as if the sites went on: a spot cut by the image's edge is then only underrated
    return np.asarray(correlate1d(site.astype(float), kernel**2, mode="wrap"))


def _spread(z: NDArray[Any], inside: BoolArray) -> float:
    """Scale of the map, 1 for independent noise of the variance that was taken."""
    values = z[::3, ::3][inside[::3, ::3]]
    spread = 1.4826 * np.median(np.abs(values - np.median(values))) if values.size else 1.0
    return float(max(spread / _NOISE, 0.5))
