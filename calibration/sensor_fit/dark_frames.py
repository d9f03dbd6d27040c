"""Dark frames as mean and variance images (`DarkImage`); tests for stray light in them, by pattern and by shot noise.

Light shows itself three ways. The pixels' responsivity (PRNU) is in it: the dark pattern is then like that of lit
frames. Its shot noise grows with it over the picture, with the slope K. And where a curve, a cut or a program bends
the values about black, the noise there is lopsided: its mean and its median differ.

Even light on pixels that respond alike shows none of these: it is a black level and a read noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from phibench.calibration.sensor_fit.block_sums import outliers
from phibench.scenes.frames import Array

_BOX = 5  # pixels of one filter
_SIGMAS, _PATTERN_SIGMAS = 7.0, 5.0
_LEAST_OF_NOISE = 0.02  # of the dark noise: light below it moves black by less than jitter does
_PRNU_SHARE = 0.05  # of the variance of lit patterns: below, noise is all that they show
_SIDE_PX, _FRAMES = 512, 8  # of the middle of as many frames, for the median
_GROUPS, _TRIM = 24, 0.03  # of pixels by their means; the ends, where pixels that jump and hot ones lie
_BLOCKS = 8
_SLOPES = (0.4, 2.5)  # of K: slopes of variance over mean that are shot noise
_LOPSIDED, _WIDE_DN2 = 0.01, 0.5  # of the noise; variance from which on a median is not that of codes


@dataclass(frozen=True)
class DarkImage:
    """Mean and temporal variance of each pixel of the dark frames, shape (h, w), and what their noise is like.

    Attributes
    ----------
    mean, variance : DN, DN^2
    frames : number of frames
    lopsided_dn : mean less median of the noise; 0 where it is not above chance
    """

    mean: Array
    variance: Array
    frames: int
    lopsided_dn: float


def dark_image(frames: NDArray[Any]) -> DarkImage:
    """Image of dark frames, shape (n, h, w), n >= 2."""
    n = len(frames)
    mean = frames.mean(axis=0)
    variance = sum((np.square(frame - mean) for frame in frames), np.zeros(mean.shape)) / (n - 1)
    noise2 = float(np.median(variance))
    if noise2 < _WIDE_DN2 or n < 3:
        return DarkImage(mean, variance, n, 0.0)
    v, u = (slice(max((size - _SIDE_PX) // 2, 0), max((size - _SIDE_PX) // 2, 0) + _SIDE_PX) for size in mean.shape)
    change = frames[:_FRAMES, v, u] - mean[v, u]
    change -= change.mean(axis=(1, 2), keepdims=True)  # whole frames that jitter are no shape of the pixels' noise
    # spread over their codes, values have a median between codes
    values = change + np.random.default_rng(0).uniform(-0.5, 0.5, change.shape)
    median = float(np.median(values))
    chance = 1.25 * float(np.sqrt(noise2 / change.size))
    of_codes = 1.0 / (16.0 * noise2)  # of the density's slope within a code
    seen = abs(median) > max(_LOPSIDED * np.sqrt(noise2), _SIGMAS * chance, of_codes)
    return DarkImage(mean, variance, n, -median * n / (n - 2) if seen else 0.0)


def pattern(image: Array, filters: int) -> Array:
    """Difference of each pixel to its surroundings of the same filter, shape (h, w), without outliers."""
    rough = np.zeros(image.shape)
    for i, j in np.ndindex(filters, filters):
        site = image[i::filters, j::filters]
        bad, mended = outliers(site, 0.0)
        rough[i::filters, j::filters] = np.where(bad, 0.0, mended - uniform_filter(mended, _BOX, mode="reflect"))
    return rough


@dataclass(frozen=True)
class LitPattern:
    """Pattern of a lit level, shape (h, w), its signal, DN, and the variance that temporal noise adds, DN^2."""

    values: Array
    signal_dn: float
    noise_dn2: float


def light_by_pattern(dark: DarkImage, bright: LitPattern, faint: LitPattern, filters: int) -> float:
    """Light in the dark frames, DN, by the PRNU that the difference of two lit levels shows; 0 where it is not seen."""
    lit = bright.values - faint.values  # holds no pattern of the dark
    apart = bright.signal_dn - faint.signal_dn
    seen2 = float(np.mean(lit**2)) / apart**2
    prnu2 = seen2 - (bright.noise_dn2 + faint.noise_dn2) / apart**2
    if prnu2 < _PRNU_SHARE * seen2:
        return 0.0
    rough = pattern(dark.mean, filters)
    amount = float(np.mean(rough * lit)) / apart / prnu2
    chance = float(np.sqrt(np.mean(rough**2) * seen2 / lit.size)) / prnu2
    noise_dn = float(np.sqrt(np.median(dark.variance)))
    return amount if amount > max(_PATTERN_SIGMAS * chance, _LEAST_OF_NOISE * noise_dn) else 0.0


def light_by_noise(dark: DarkImage, gain: float) -> float:
    """Light in the brighter parts of the dark frames, DN, above their darkest, by shot noise that grows with it."""
    noise2 = float(np.median(dark.variance))
    if noise2 < _WIDE_DN2:  # there rounding ties the variance to the mean
        return 0.0
    bad, mean = outliers(dark.mean, noise2 / dark.frames)
    values, variance = mean[~bad], dark.variance[~bad]
    order = np.argsort(values)
    order = order[int(_TRIM * len(order)) : len(order) - int(_TRIM * len(order))]
    groups = [part for part in np.array_split(order, _GROUPS) if len(part)]
    by_value = [(float(values[g].mean()), float(variance[g].mean()), len(g)) for g in groups]
    by_place = []
    for rows in np.array_split(np.arange(mean.shape[0]), _BLOCKS):
        for at in np.array_split(np.arange(mean.shape[1]), _BLOCKS):
            keep = ~bad[np.ix_(rows, at)]
            block, noise = mean[np.ix_(rows, at)][keep], dark.variance[np.ix_(rows, at)][keep]
            by_place.append((float(block.mean()), float(noise.mean()), max(len(block), 1)))
    return max(_grown(np.array(by_value), dark.frames, gain), _grown(np.array(by_place), dark.frames, gain))


def _grown(groups: Array, frames: int, gain: float) -> float:
    mean, variance, count = groups.T
    x = mean - mean.mean()
    slope = float(x @ variance) / max(float(x @ x), 1e-12)
    own = variance.mean() * np.sqrt(2.0 / ((frames - 1) * count))
    sigma = float(np.sqrt(np.sum((x * own) ** 2))) / max(float(x @ x), 1e-12)
    is_shot_noise = slope > _SIGMAS * sigma and _SLOPES[0] * gain < slope < _SLOPES[1] * gain
    return float(mean.mean() - mean.min()) if is_shot_noise else 0.0
