"""Clamped, mirrored and nearest textures of glTF and OBJ, changed into bilinear bitmaps that repeat, as rooms have.

A picture that ends at its edges gets a frame of its outermost texels, so that its other side does not shine through. Of
one with the nearest texel each becomes several equal ones, so that its neighbours reach into it by little.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.scenes.frames import Array

_FINEST = 8  # texels for one along each axis: neighbours reach into it by a sixteenth of it
_MOST_PIXELS = 1 << 20  # of a picture that is made finer
_ONE_PLACE = 1e-6  # of a picture: coordinates of three corners that are nearer are one


def reaches_edge(uv: Array, axis: int, size: int) -> bool:
    """Tell whether coordinates along an axis come nearer to a picture's edge than half a texel."""
    along = uv[..., axis]
    return bool(uv.size) and bool(along.min() < 0.5 / size or along.max() > 1.0 - 0.5 / size)


def framed(pixels: NDArray[np.uint8], axes: Sequence[int]) -> NDArray[np.uint8]:
    """Pixels with one more at each end of the axes 0 (u) or 1 (v), equal to the last one."""
    widths = [(1, 1) if 1 in axes else (0, 0), (1, 1) if 0 in axes else (0, 0), (0, 0)]
    return np.pad(pixels, widths[: pixels.ndim], mode="edge")


def mirrored(pixels: NDArray[np.uint8], axes: Sequence[int]) -> NDArray[np.uint8]:
    """Pixels and behind them, along the axes, their mirror image."""
    for axis in axes:
        pixels = np.concatenate([pixels, np.flip(pixels, 1 - axis)], axis=1 - axis)
    return pixels


def finer(pixels: NDArray[np.uint8], _: Sequence[int] = ()) -> NDArray[np.uint8]:
    """Each pixel as a square of equal ones."""
    times = int(np.clip(np.sqrt(_MOST_PIXELS / (pixels.shape[0] * pixels.shape[1])), 1, _FINEST))
    return pixels.repeat(times, axis=0).repeat(times, axis=1) if times > 1 else pixels


def nearest_places(uv: Array, size: Any, ends: Sequence[int]) -> Array:
    """Coordinates, v downwards, of which those of a triangle at one place lie in the middle of its texel."""
    is_one = np.ptp(uv, axis=1, keepdims=True) < _ONE_PLACE
    last = np.isin((0, 1), ends)
    texel = np.floor(np.clip(uv * size, np.where(last, 0.0, -np.inf), np.where(last, size - 1.0, np.inf)))
    return np.where(is_one, (texel + 0.5) / size, uv)
