"""The JPEG in MJPEG: encoding and decoding by Pillow (libjpeg-turbo), and the grid on which it works."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

MCU_PX = {"4:4:4": (8, 8), "4:2:2": (8, 16), "4:2:0": (16, 16)}
"""Rows and columns of a minimum coded unit.

A decoded pixel depends on its own unit and, where chroma is interpolated between samples, on the units beside it.
"""


def encoded(image: NDArray[np.uint8], quality: int, subsampling: str) -> bytes:
    """JPEG file of an image, shape (H, W, 3)."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=quality, subsampling=subsampling)
    return file.getvalue()


def decoded(data: bytes) -> NDArray[np.uint8]:
    """Image, shape (H, W, 3), in a JPEG file."""
    with Image.open(io.BytesIO(data), formats=("JPEG",)) as image:
        return np.asarray(image.convert("RGB"))


def compressed(images: NDArray[np.uint8], quality: int, subsampling: str) -> NDArray[np.uint8]:
    """Images, shape (..., H, W, 3), encoded and decoded again."""
    flat = images.reshape(-1, *images.shape[-3:])
    return np.stack([decoded(encoded(image, quality, subsampling)) for image in flat]).reshape(images.shape)
