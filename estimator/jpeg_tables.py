"""Numbers of baseline JPEG: quantisation tables, units, colour conversion, and the linear part of the encoder.

ITU-T T.81 (1992), annex K for the tables; libjpeg's scaling of them by the quality; JFIF 1.02 for the colours.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.fft import dctn

from phibench.scenes.frames import Array

BLOCK_PX = 8
CHROMA_STEP = {"4:4:4": (1, 1), "4:2:2": (1, 2), "4:2:0": (2, 2)}
"""Rows and columns of pixels per chroma sample."""

RGB_FROM_YCC = np.array([[1.0, 0.0, 1.402], [1.0, -0.344136286, -0.714136286], [1.0, 1.772, 0.0]])
YCC_FROM_RGB = np.linalg.inv(RGB_FROM_YCC)

_LUMA = """16 11 10 16 24 40 51 61 12 12 14 19 26 58 60 55 14 13 16 24 40 57 69 56 14 17 22 29 51 87 80 62
18 22 37 56 68 109 103 77 24 35 55 64 81 104 113 92 49 64 78 87 103 121 120 101 72 92 95 98 112 100 103 99"""
_CHROMA = """17 18 24 47 99 99 99 99 18 21 26 66 99 99 99 99 24 26 56 99 99 99 99 99 47 66 99 99 99 99 99 99
99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99"""


def mcu_px(subsampling: str) -> tuple[int, int]:
    """Rows and columns of a minimum coded unit."""
    down, across = CHROMA_STEP[subsampling]
    return BLOCK_PX * down, BLOCK_PX * across


def quantisation(quality: int) -> tuple[Array, Array]:
    """Steps of luma and chroma coefficients, shape (8, 8) each, rows are vertical frequencies, quality 1 to 100.

    Raises
    ------
    ValueError
        If the quality is none of libjpeg's.
    """
    if not 1 <= quality <= 100:
        raise ValueError(f"JPEG quality {quality}: allowed range is 1 to 100")
    percent = 5000 // quality if quality < 50 else 200 - 2 * quality
    tables = (np.array(text.split(), int).reshape(8, 8) for text in (_LUMA, _CHROMA))
    luma, chroma = (np.clip((table * percent + 50) // 100, 1, 255).astype(float) for table in tables)
    return luma, chroma


def blocks(plane: Array) -> Array:
    """DCT coefficients of 8 x 8 blocks, shape (..., h/8, w/8, 8, 8), of a plane, shape (..., h, w); orthonormal."""
    *lead, h, w = plane.shape
    cut = plane.reshape(*lead, h // 8, 8, w // 8, 8)
    return np.asarray(dctn(np.moveaxis(cut, -2, -3), axes=(-2, -1), norm="ortho"))


def averaged(plane: Array, step: tuple[int, int]) -> Array:
    """Means of `step` pixels, shape (..., h / down, w / across)."""
    *lead, h, w = plane.shape
    return np.asarray(plane.reshape(*lead, h // step[0], step[0], w // step[1], step[1]).mean(axis=(-3, -1)))


def coefficients(rgb: Array, subsampling: str) -> Array:
    """Coefficients of an image, shape (..., n): Y, then Cb, then Cr, block after block, without rounding.

    Parameters
    ----------
    rgb : shape (..., 3, h, w), whole units, codes 0 to 255
    subsampling : "4:4:4", "4:2:2" or "4:2:0"
    """
    ycc = np.einsum("ij,...jhw->i...hw", YCC_FROM_RGB, rgb)
    step = CHROMA_STEP[subsampling]
    planes = (ycc[0], averaged(ycc[1], step), averaged(ycc[2], step))
    lead = rgb.shape[:-3]
    return np.concatenate([blocks(plane).reshape(*lead, -1) for plane in planes], axis=-1)


@lru_cache(maxsize=8)
def transform(shape: tuple[int, int], subsampling: str) -> Array:
    """Matrix of `coefficients`, shape (n, 3 h w), for an image of `shape`, read only."""
    h, w = shape
    matrix = np.ascontiguousarray(coefficients(np.eye(3 * h * w).reshape(-1, 3, h, w), subsampling).T)
    matrix.flags.writeable = False
    return matrix


def steps(shape: tuple[int, int], subsampling: str, quality: int) -> Array:
    """Quantiser's step of each of `coefficients`, shape (n,)."""
    luma, chroma = quantisation(quality)
    down, across = CHROMA_STEP[subsampling]
    count = shape[0] * shape[1] // 64
    return np.concatenate([np.tile(luma.ravel(), count), np.tile(chroma.ravel(), 2 * count // (down * across))])
