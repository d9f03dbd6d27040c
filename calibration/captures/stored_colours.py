"""Test whether pictures of R, G, B of 8 bits were stored with less before: half the chroma, or codes of 5 or 6 bits.

YUYV, NV12, I420, videos and most JPEG have a Cb and a Cr for two columns. Programs write each twice, or interpolate.
Differences of the chroma within such two columns are then far less than those between them, and a spot's red is moved.
In what was interpolated from a mosaic both are alike, to some per cent.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from phibench.estimator.interface import Image
from phibench.scenes.frames import Array, BoolArray

_CHROMA = np.array([[-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]])  # Cb and Cr of JFIF (BT.601)
_FEWEST = 1000  # pairs of pixels that must say so
_HALVED = (
    0.5  # mean square within two columns over that between them; 0.84 or more of whole chroma, 0.23 or less of half
)
_LEAST = 0.3  # mean square of differences in codes that rounding does not make: it makes 0.07
_RANGE, _FILLED = 100, 0.6  # codes from the darkest to the brightest, and their share that noise fills at least


def stored_with_less_note(images: Sequence[Image]) -> str:
    """Say what pictures of one camera, R, G, B of 8 bits and shape (H, W, 3), were stored as before; "" of none."""
    if _is_halved(images):
        return "their colour has half the columns: they were YUYV, NV12, a video or a fine JPEG"
    if _is_coarse(images):
        return "their colours have fewer codes than 8 bits: they were of 5 or 6 bits, of a palette, or stretched"
    return ""


def _is_halved(images: Sequence[Image]) -> bool:
    sums, counts = np.zeros(2), np.zeros(2)
    for image in images:
        steps, usable = _steps(image)
        for parity in (0, 1):  # columns may be cut off
            sums[parity] += steps[:, parity::2][usable[:, parity::2]].sum()
            counts[parity] += usable[:, parity::2].sum()
    if counts.min() < _FEWEST:
        return False
    low, high = sorted((sums / counts).tolist())
    return bool(high > _LEAST and low < _HALVED * high)


def _steps(image: Image) -> tuple[Array, BoolArray]:
    """Squares of differences of the chroma to the next column, and where no code is cut; shape (H, W - 1)."""
    chroma = image.astype(np.float32) @ _CHROMA.T.astype(np.float32)
    uncut: BoolArray = np.all((image > 2) & (image < 253), axis=-1)
    return np.asarray((np.diff(chroma, axis=1) ** 2).sum(axis=-1)), uncut[:, 1:] & uncut[:, :-1]


def _is_coarse(images: Sequence[Image]) -> bool:
    """Tell whether gaps lie between the codes of green, of all pictures together."""
    counts = np.sum([np.bincount(image[..., 1].ravel(), minlength=256) for image in images], axis=0)
    used = np.flatnonzero(counts[1:255]) + 1
    if not used.size or np.ptp(used) < _RANGE:
        return False
    low, high = np.quantile(np.repeat(np.arange(1, 255), np.minimum(counts[1:255], 1000)), [0.02, 0.98])
    inside = counts[int(low) : int(high) + 1]
    return bool(len(inside) >= _RANGE and np.count_nonzero(inside) < _FILLED * len(inside))
