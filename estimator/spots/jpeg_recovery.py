"""Quantised JPEG coefficients behind a decoded image.

The decoder interpolates the chroma samples (libjpeg's triangle filter, 3/4 and 1/4 of the two nearest), converts to R,
G, B and cuts to 0 to 255. Interpolation is undone by least squares, and each coefficient is a multiple of the
quantiser's step, which takes out the decoder's rounding where steps are well above it: at quality 60 and 76 every
coefficient of 20 files is found. Steps of 1 are not (quality 95: a quarter of them is off by one), nor is the level of
an even block where its step is below 8 (quality 85 and above): several levels give one code. Where a pixel was cut,
the value that the coefficients found so far would give takes its place, and the search goes on until nothing changes.

In a dark room half of the pixels are cut at 0, and some 20 coefficients about a spot are left wrong by a step. So
single steps are taken in the blocks that do not come out again, as long as they bring the decoded image nearer to the
one that is there. The decoder is libjpeg's to the bit, but for its inverse DCT in whole numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import idctn

from phibench.estimator.spots.camera_codes import (
    BLOCK_PX,
    CHROMA_STEP,
    RGB_FROM_YCC,
    YCC_FROM_RGB,
    Tables,
    blocks,
    quantisation,
)
from phibench.scenes.frames import Array, BoolArray

_SHIFT = 128.0  # JPEG's level shift
_SAME_CODES = 1.5  # of pixels that libjpeg's inverse DCT rounds the other way
_MOST_ROUNDS = 40
_MOST_STEPS = 24  # of a block's luma coefficients, one at a time
_MOST_SEARCHES = 6  # of luma and chroma in turns
_LEAST_GAIN = 3.0  # of a block's squared codes by a step: a pixel that rounds the other way differs by 1 in R, G, B
_TINY = 1e-9  # of sums that are whole numbers


@dataclass(frozen=True)
class RecoveredCoefficients:
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


def recovered_coefficients(
    images: NDArray[Any], quality: int | Tables, subsampling: str, ends: tuple[bool, bool, bool, bool] = (False,) * 4
) -> RecoveredCoefficients:
    """Coefficients of decoded images of whole units.

    The chroma at sides that are not the image's own is interpolated with samples outside: leave a unit there.

    Parameters
    ----------
    images : shape (n, h, w, 3), uint8
    quality : int or tables, as in `quantisation`
    subsampling : "4:4:4", "4:2:2" or "4:2:0"
    ends : 4 booleans
        Top, bottom, left and right side are the image's own.
    """
    rgb = np.moveaxis(np.asarray(images, float), -1, 1)
    tables = quantisation(quality)
    down, across = (
        _interpolation(size, step, *end)
        for size, step, end in zip(rgb.shape[2:], CHROMA_STEP[subsampling], (ends[:2], ends[2:]), strict=True)
    )
    decoder = _Decoder(tables, down, across)
    recovery = decoder.quantised(rgb)
    for _ in range(_MOST_ROUNDS):
        again = decoder.uncut(*recovery)
        cut = ((rgb <= 0.0) & (again < 0.0)) | ((rgb >= 255.0) & (again > 255.0))
        before, recovery = recovery, decoder.quantised(np.where(cut, again, rgb))
        if all(np.array_equal(a, b) for a, b in zip(recovery, before, strict=True)):
            break
    luma, chroma = _searched(*recovery, rgb, decoder) if ((rgb <= 0.0) | (rgb >= 255.0)).any() else recovery
    again = decoder.image(luma, chroma)
    return RecoveredCoefficients(luma * tables[0], chroma * tables[1], (np.abs(again - rgb) > _SAME_CODES).any(axis=1))


# -- decoder -----------------------------------------------------------------------------------------------------------


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
        up[pixel, near + before] += 0.75  # libjpeg's "fancy" upsampling: 3/4 of the nearer sample, 1/4 of the next
        up[pixel, min(max(far + before, 0), up.shape[1] - 1)] += 0.25
    return _Axis(up, np.asarray(np.linalg.pinv(up), float), before, after)


@dataclass(frozen=True)
class _Decoder:
    """Decoder of images of one size; coefficients are multiples of the steps in `tables`."""

    tables: tuple[Array, Array]
    down: _Axis
    across: _Axis

    @property
    def step(self) -> tuple[int, int]:
        """Rows and columns of pixels per chroma sample."""
        return _ratio(self.down), _ratio(self.across)

    def quantised(self, rgb: Array) -> tuple[Array, Array]:
        """Multiples of the steps, of luma and chroma, for images, shape (n, 3, h, w), that nothing has cut."""
        ycc = np.einsum("ij,njhw->inhw", YCC_FROM_RGB, rgb)
        samples = np.einsum("ah,inhw,bw->niab", self.down.back, ycc[1:], self.across.back, optimize=True)
        rows, columns = samples.shape[2] - self.down.after, samples.shape[3] - self.across.after
        inner = samples[:, :, self.down.before : rows, self.across.before : columns]
        return np.rint(blocks(ycc[0] - _SHIFT) / self.tables[0]), np.rint(blocks(inner) / self.tables[1])

    def uncut(self, luma: Array, chroma: Array) -> Array:
        """Image, shape (n, 3, h, w), that nothing has cut; samples outside repeat the outermost ones."""
        return self.added(_whole(self.samples(chroma))) + (_whole(self.luma(luma)) + _SHIFT)[:, None]

    def image(self, luma: Array, chroma: Array) -> Array:
        """Decoded image, shape (n, 3, h, w): Y is cut to 0 to 255, as Cb and Cr are, and R, G, B again."""
        y = _coded(self.luma(luma)) + _SHIFT
        return np.clip(self.added(_coded(self.samples(chroma))) + y[:, None], 0.0, 255.0)

    def luma(self, luma: Array) -> Array:
        """Y less the level shift, shape (n, h, w), not rounded."""
        return _plane(luma * self.tables[0])

    def samples(self, chroma: Array) -> Array:
        """Chroma samples, shape (n, 2, a, b), those outside included, not rounded."""
        pads = [(0, 0), (0, 0), (self.down.before, self.down.after), (self.across.before, self.across.after)]
        return np.pad(_plane(chroma * self.tables[1]), pads, mode="edge")

    def added(self, samples: Array) -> Array:
        """Whole codes that whole samples of Cb and Cr add to R, G, B of Y, shape (n, 3, h, w)."""
        full = np.einsum("ha,niab,wb->nihw", self.down.up, samples, self.across.up, optimize=True)
        return np.floor(np.einsum("ij,njhw->nihw", RGB_FROM_YCC[:, 1:], _halved(full, self.step)) + 0.5)


def _coded(plane: Array) -> Array:
    """Whole codes, less the level shift, of what the inverse DCT gives: 0 to 255."""
    return np.clip(_whole(plane), -_SHIFT, 255.0 - _SHIFT)


def _whole(plane: Array) -> Array:
    """Rounded; halves go towards 0.

    libjpeg-turbo rounds them up in a block of a level alone, which has them everywhere. Where its step is below 8 the
    level found there is not always the file's, and decoding it again agrees with halves towards 0.
    """
    return np.copysign(np.ceil(np.abs(plane) - (0.5 + _TINY)), plane)


def _ratio(axis: _Axis) -> int:
    pixels, samples = axis.up.shape
    return 1 if pixels == samples - axis.before - axis.after else 2


def _halved(full: Array, step: tuple[int, int]) -> Array:
    """Interpolated samples as libjpeg rounds them: it adds 1 and 2 before it divides by 4, 8 and 7 by 16, in turns."""
    odd = np.arange(full.shape[-1]) % 2 == 1
    if step == (1, 1):
        return full
    added = np.where(odd, 7.0 / 16.0, 0.5) if step == (2, 2) else np.where(odd, 0.5, 0.25)
    return np.asarray(np.floor(full + added + _TINY))


def _plane(coefficients: Array) -> Array:
    """Plane, shape (..., h, w), of blocks."""
    *lead, rows, columns, _, _ = coefficients.shape
    cut = np.moveaxis(np.asarray(idctn(coefficients, axes=(-2, -1), norm="ortho")), -3, -2)
    return cut.reshape(*lead, BLOCK_PX * rows, BLOCK_PX * columns)


# -- steps of single coefficients --------------------------------------------------------------------------------------


def _searched(luma: Array, chroma: Array, rgb: Array, decoder: _Decoder) -> tuple[Array, Array]:
    """Multiples after steps of single coefficients, in blocks with cut pixels that do not come out again."""
    luma, chroma = luma.copy(), chroma.copy()
    for _ in range(_MOST_SEARCHES):
        first = _luma_steps(luma, chroma, rgb, decoder)
        if not _chroma_steps(luma, chroma, rgb, decoder) and not first:
            break
    return luma, chroma


@lru_cache(maxsize=1)
def _waves() -> Array:
    """Planes of the 64 coefficients, and their negatives, shape (128, 8, 8)."""
    waves = _plane(np.eye(64).reshape(64, 1, 1, 8, 8))
    return np.concatenate([waves, -waves])


def _luma_steps(luma: Array, chroma: Array, rgb: Array, decoder: _Decoder) -> bool:
    """Step the luma coefficients, in place; True if any was."""
    added = _in_blocks(decoder.added(_coded(decoder.samples(chroma))) + _SHIFT)
    there, y = _in_blocks(rgb), _in_blocks(decoder.luma(luma)[:, None])
    change = np.tile(decoder.tables[0].ravel(), 2)[:, None, None, None] * _waves()[:, None]

    def misfit(planes: Array, index: tuple[NDArray[np.int64], ...]) -> Array:
        again = np.clip(_coded(planes) + added[index][:, None], 0.0, 255.0)
        return np.asarray(np.square(again - there[index][:, None]).sum(axis=(-3, -2, -1)))

    index, any_step = np.nonzero(((there <= 0.0) | (there >= 255.0)).any(axis=(-3, -2, -1))), False
    for _ in range(_MOST_STEPS):
        now = misfit(y[index][:, None], index)[:, 0]
        index, now = _chosen(index, now > _LEAST_GAIN), now[now > _LEAST_GAIN]
        if not now.size:
            break
        tried = misfit(y[index][:, None] + change, index)
        best = np.argmin(tried, axis=1)
        better = now - np.take_along_axis(tried, best[:, None], axis=1)[:, 0] > _LEAST_GAIN
        index, best = _chosen(index, better), best[better]
        y[index] += change[best]
        luma[(*index, best % 64 // 8, best % 8)] += np.where(best < 64, 1.0, -1.0)
        any_step |= bool(best.size)
    return any_step


def _chroma_steps(luma: Array, chroma: Array, rgb: Array, decoder: _Decoder) -> bool:
    """Step one chroma coefficient of each block that is left wrong, in place; True if any was."""
    y, (down, across) = _coded(decoder.luma(luma)) + _SHIFT, decoder.step
    off = np.square(decoder.image(luma, chroma) - rgb).sum(axis=1)
    rows, columns = BLOCK_PX * down, BLOCK_PX * across
    misfit = off.reshape(len(off), off.shape[1] // rows, rows, -1, columns).sum(axis=(2, 4))
    any_step = False
    for n, i, j in np.argwhere(misfit > _LEAST_GAIN):
        part = (slice(i * rows, (i + 1) * rows), slice(j * columns, (j + 1) * columns))
        if not ((rgb[n][(slice(None), *part)] <= 0.0) | (rgb[n][(slice(None), *part)] >= 255.0)).any():
            continue
        best = _best_chroma(chroma[n], (i, j), y[n][part], rgb[n][(slice(None), *part)], decoder)
        if misfit[n, i, j] - best[0] > _LEAST_GAIN:
            plane, k = best[1:]
            chroma[n, plane, i, j, k % 64 // 8, k % 8] += 1.0 if k < 64 else -1.0
            any_step = True
    return any_step


def _best_chroma(
    chroma: Array, block: tuple[int, int], y: Array, there: Array, decoder: _Decoder
) -> tuple[float, int, int]:
    """Least misfit of a unit after a step, the plane, and the number in `_waves`."""
    ups = [_interpolation(BLOCK_PX * step, step, False, False) for step in decoder.step]
    full = _plane(chroma * decoder.tables[1])
    padded = np.pad(full, [(0, 0), (1, 1), (1, 1)], mode="edge")
    rows, columns = (BLOCK_PX * k + (0 if axis.before else 1) for k, axis in zip(block, ups, strict=True))
    sizes = [axis.up.shape[1] for axis in ups]
    window = padded[:, rows : rows + sizes[0], columns : columns + sizes[1]]
    inside = tuple(slice(axis.before, axis.before + BLOCK_PX) for axis in ups)
    candidates = []
    for plane in (0, 1):
        tried = np.repeat(window[None], 128, axis=0)
        tried[(slice(None), plane, *inside)] += np.tile(decoder.tables[1].ravel(), 2)[:, None, None] * _waves()
        up = np.einsum("ha,niab,wb->nihw", ups[0].up, _coded(tried), ups[1].up, optimize=True)
        added = np.floor(np.einsum("ij,njhw->nihw", RGB_FROM_YCC[:, 1:], _halved(up, decoder.step)) + 0.5)
        misfit = np.square(np.clip(y + added, 0.0, 255.0) - there).sum(axis=(1, 2, 3))
        k = int(np.argmin(misfit))
        candidates.append((float(misfit[k]), plane, k))
    return min(candidates)


def _chosen(index: tuple[NDArray[np.int64], ...], which: BoolArray) -> tuple[NDArray[np.int64], ...]:
    return tuple(indices[which] for indices in index)


def _in_blocks(planes: Array) -> Array:
    """Blocks, shape (n, h / 8, w / 8, c, 8, 8), of planes, shape (n, c, h, w)."""
    n, c, h, w = planes.shape
    return np.ascontiguousarray(planes.reshape(n, c, h // 8, 8, w // 8, 8).transpose(0, 2, 4, 1, 3, 5))
