"""Quantised coefficients behind a decoded JPEG image.

The decoder interpolates the chroma samples (libjpeg's triangle filter, 3/4 and 1/4 of the two nearest), converts to
R, G, B and cuts to 0 to 255. Interpolation is undone by least squares, and each coefficient is one of the quantiser's
multiples, which takes out the decoder's rounding. Where a pixel was cut, the value that the coefficients found so far
would give takes its place, and the search goes on until the image comes out again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import idctn

from phibench.estimator.jpeg_tables import (
    CHROMA_STEP,
    RGB_FROM_YCC,
    YCC_FROM_RGB,
    blocks,
    quantisation,
)
from phibench.scenes.frames import Array, BoolArray

_SHIFT = 128.0
_SAME_CODES = 3.5  # of the decoder's own rounding, between our decoder in floating point and libjpeg's integers
_MOST_ROUNDS = 40


@dataclass(frozen=True)
class Recovered:
    """Coefficients of images, level shift taken off.

    Attributes
    ----------
    luma : shape (n, h / 8, w / 8, 8, 8)
    chroma : shape (n, 2, ...), Cb and Cr
    wrong : boolean, shape (n, h, w)
        Pixels that do not come out again.
    """

    luma: Array
    chroma: Array
    wrong: BoolArray


def recovered(
    images: NDArray[Any], quality: int, subsampling: str, ends: tuple[bool, bool, bool, bool] = (False,) * 4
) -> Recovered:
    """Coefficients of decoded images of whole units.

    The chroma at sides that are not the image's own is interpolated with samples outside: leave a unit there.

    Parameters
    ----------
    images : shape (n, h, w, 3), uint8
    quality : int
    subsampling : "4:4:4", "4:2:2" or "4:2:0"
    ends : 4 booleans
        Whether top, bottom, left and right side are the image's own.
    """
    rgb = np.moveaxis(np.asarray(images, float), -1, 1)
    tables = quantisation(quality)
    down, across = (
        _interpolation(size, step, *end)
        for size, step, end in zip(rgb.shape[2:], CHROMA_STEP[subsampling], (ends[:2], ends[2:]), strict=True)
    )
    seen, found = rgb, _quantised(rgb, tables, down, across)
    for _ in range(_MOST_ROUNDS):
        again = _decoded(*found, tables, down, across)
        cut = ((rgb <= 0.0) & (again < 0.0)) | ((rgb >= 255.0) & (again > 255.0))
        seen, before = np.where(cut, again, rgb), found
        found = _quantised(seen, tables, down, across)
        if all(np.array_equal(a, b) for a, b in zip(found, before, strict=True)):
            break
    luma, chroma = found
    again = np.clip(_decoded(luma, chroma, tables, down, across), 0.0, 255.0)
    wrong = (np.abs(again - rgb) > _SAME_CODES).any(axis=1)
    return Recovered(luma * tables[0], chroma * tables[1], wrong)


@dataclass(frozen=True)
class _Axis:
    """Interpolation along one axis: `up` (pixels, samples), its pseudo-inverse, and how many samples lie outside."""

    up: Array
    back: Array
    before: int
    after: int


@lru_cache(maxsize=32)
def _interpolation(size: int, step: int, first: bool, last: bool) -> _Axis:
    """Triangle filter from samples to `size` pixels; a sample outside is unknown where the side is not the image's."""
    if step == 1:
        return _Axis(np.eye(size), np.eye(size), 0, 0)
    n, before, after = size // 2, int(not first), int(not last)
    up = np.zeros((size, n + before + after))
    for pixel in range(size):
        near = pixel // 2
        far = near + (1 if pixel % 2 else -1)
        up[pixel, near + before] += 0.75
        up[pixel, min(max(far + before, 0), up.shape[1] - 1)] += 0.25
    return _Axis(up, np.asarray(np.linalg.pinv(up), float), before, after)


def _quantised(rgb: Array, tables: tuple[Array, Array], down: _Axis, across: _Axis) -> tuple[Array, Array]:
    """Multiples of the steps, of luma and chroma."""
    ycc = np.einsum("ij,njhw->inhw", YCC_FROM_RGB, rgb)
    samples = np.einsum("ah,inhw,bw->niab", down.back, ycc[1:], across.back, optimize=True)
    inner = samples[:, :, down.before : samples.shape[2] - down.after, across.before : samples.shape[3] - across.after]
    return np.rint(blocks(ycc[0] - _SHIFT) / tables[0]), np.rint(blocks(inner) / tables[1])


def _decoded(luma: Array, chroma: Array, tables: tuple[Array, Array], down: _Axis, across: _Axis) -> Array:
    """Image, shape (n, 3, h, w), of multiples, not cut; samples outside repeat the outermost ones."""
    y = np.rint(_plane(luma * tables[0])) + _SHIFT
    inner = np.rint(_plane(chroma * tables[1]))
    pads = [(0, 0), (0, 0), (down.before, down.after), (across.before, across.after)]
    samples = np.pad(inner, pads, mode="edge")
    full = np.einsum("ha,niab,wb->inhw", down.up, samples, across.up, optimize=True)
    return np.einsum("ij,jnhw->nihw", RGB_FROM_YCC, np.concatenate([y[None], full]))


def _plane(coefficients: Array) -> Array:
    """Plane, shape (..., h, w), of blocks."""
    *lead, rows, columns, _, _ = coefficients.shape
    cut = np.moveaxis(np.asarray(idctn(coefficients, axes=(-2, -1), norm="ortho")), -3, -2)
    return cut.reshape(*lead, 8 * rows, 8 * columns)
