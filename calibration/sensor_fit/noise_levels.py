"""Noise of processed flat frames: covariances of the codes from frame to frame, with a jackknife over blocks.

Planes are those of the frames, Y', Cb, Cr of "yuyv", whose chroma has half of the columns, or R, G, B. Besides each
plane's own covariances there are those of the first plane (of R, G, B: of green) with the two others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from phibench.estimator.spots.camera_codes import YCC_FROM_RGB
from phibench.scenes.frames import Array

Lags = tuple[tuple[int, int], ...]
NEAR: Lags = ((0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (2, 0))
FAR: Lags = (*NEAR, (1, 2), (2, 1), (2, 2), (0, 3), (3, 0))
BESIDE: Lags = ((0, 0), (0, -1), (0, 1))
"""Lags (rows, columns): of chroma, of other planes, and from a pixel of chroma to one of Y'."""
BOX_PX = 5  # noise is what a pixel differs by from its surroundings: shading goes
_BLOCKS = 8  # along each side, for the jackknife
_EDGE = 3  # largest lag


@dataclass(frozen=True)
class PlaneNoise:
    """Noise of one plane of codes, or of two.

    Attributes
    ----------
    lags : of the covariances, each in the plane's own samples; of two planes in those of the first
    covariance : shape (replicates, lags), codes^2
        Of the time; the first row is the whole, the others leave a block out.
    mean : float, codes
    spread : float
        Variance of the pixels' means, codes^2.
    apart : shape (lags,)
        Variance of the difference of two pixels' means, codes^2.
    """

    lags: Lags
    covariance: Array
    mean: float = 0.0
    spread: float = 0.0
    apart: Array | None = None


@dataclass(frozen=True)
class NoiseLevel:
    """Noise of one level.

    Attributes
    ----------
    name : str
    codes : mean of R, G, B, codes
    planes : of the three planes; then of the main plane with the two others (0 with 1 and 2, or 1 with 0 and 2)
    spatial : shape (replicates,), codes^2
        Variance of the mean frame's Y' less a mean over 5 x 5 pixels, temporal noise taken off.
    """

    name: str
    codes: tuple[float, float, float]
    planes: tuple[PlaneNoise, ...]
    spatial: Array


def planes_of(frames: NDArray[Any]) -> list[Array]:
    """Planes, shape (n, h, w) each, or (n, h, w / 2) of chroma, of frames (n, h, w, 3), or (n, h, w, 2) of yuyv."""
    if frames.shape[-1] == 2:
        y, chroma = frames[..., 0].astype(float), frames[..., 1].astype(float)
        return [y, chroma[..., 0::2], chroma[..., 1::2]]
    return list(np.moveaxis(frames.astype(float), -1, 0))


def stack_level(name: str, frames: NDArray[Any], codes: tuple[float, float, float]) -> NoiseLevel:
    """Noise from frame to frame of two frames or more, as `planes_of` takes them."""
    halved = frames.shape[-1] == 2
    planes = planes_of(frames)
    own = [_plane(stack, NEAR if halved and k else FAR) for k, stack in enumerate(planes)]
    main, others = (0, (1, 2)) if halved else (1, (0, 2))
    noise = [_noise(stack) for stack in planes]
    both = [_both(noise[main], noise[k], halved) for k in others]
    luma = planes[0] if halved else np.tensordot(np.stack(planes, axis=-1), YCC_FROM_RGB[0], 1)
    return NoiseLevel(name, codes, (*own, *both), _spatial(np.asarray(luma)))


def _noise(stack: Array) -> Array:
    """Deviations from the mean frame and from each frame's mean, scaled to the variance of one frame."""
    noise = stack - stack.mean(axis=0)
    noise -= noise.mean(axis=(1, 2), keepdims=True)
    return np.asarray(noise * np.sqrt(len(stack) / (len(stack) - 1.0)))


def _plane(stack: Array, lags: Lags) -> PlaneNoise:
    mean, noise = stack.mean(axis=0), _noise(stack)
    products = [_lagged(noise, noise, lag) for lag in lags]
    covariance = np.stack([_leave_one_out(x) / _leave_one_out(np.ones_like(x)) for x in products], axis=1)
    rest = (mean - mean.mean())[None]
    fixed = np.array([float(np.mean(_lagged(rest, rest, lag))) for lag in lags]) - covariance[0] / len(stack)
    apart = np.maximum(2.0 * (fixed[0] - fixed), 0.0)
    return PlaneNoise(lags, covariance, float(mean.mean()), max(float(fixed[0]), 0.0), apart)


def _both(main: Array, other: Array, halved: bool) -> PlaneNoise:
    """Covariances of the other plane's samples with the main plane's at the lags `BESIDE` from them."""
    if not halved:
        products = [_lagged(other, main, lag) for lag in BESIDE]
    else:
        h = main.shape[1]
        columns = np.arange(_EDGE // 2 + 1, other.shape[2] - _EDGE // 2 - 1)
        rows = slice(_EDGE, h - _EDGE)
        here, there = other[:, rows][..., columns], main[:, rows]
        products = [(here * there[..., 2 * columns + c]).mean(axis=0) for _, c in BESIDE]
    return PlaneNoise(BESIDE, np.stack([_leave_one_out(x) / _leave_one_out(np.ones_like(x)) for x in products], axis=1))


def _spatial(stack: Array) -> Array:
    temporal = np.mean([_rough(frame) ** 2 for frame in _noise(stack)], axis=0)
    spatial = _rough(stack.mean(axis=0)) ** 2 - temporal / len(stack)
    return _leave_one_out(spatial) / _leave_one_out(np.ones_like(spatial))


def _lagged(one: Array, two: Array, lag: tuple[int, int]) -> Array:
    """Mean products of a pixel and the other plane's pixel `lag` away, in the image's inner part."""
    rows, columns = lag
    _, h, w = one.shape
    inner = one[:, _EDGE : h - _EDGE, _EDGE : w - _EDGE]
    moved = two[:, _EDGE + rows : h - _EDGE + rows, _EDGE + columns : w - _EDGE + columns]
    return np.asarray((inner * moved).mean(axis=0))


def _rough(image: Array) -> Array:
    half = BOX_PX // 2
    return np.asarray((image - uniform_filter(image, BOX_PX, mode="reflect"))[half:-half, half:-half])


def _leave_one_out(values: Array) -> Array:
    rows, columns = (np.linspace(0, side, _BLOCKS + 1).astype(int)[:-1] for side in values.shape)
    sums = np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1).ravel()
    return np.concatenate([[sums.sum()], sums.sum() - sums])
