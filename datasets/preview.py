"""Layers to pictures for people. No camera model: neither noise nor mosaic, and an exposure that suits the eye."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from phibench.datasets.files import write_bytes
from phibench.scenes.detector import Detector

Picture = NDArray[np.uint8]
_WHITE_PERCENTILE = 98.0
_WHITE_LEVEL = 0.8
_DARK_ROOM_ELECTRONS_PER_S = 1e5  # a room below this is shown black, the spot at its own exposure


def exposure_s(planes: NDArray[Any], detector: Detector) -> float:
    """Factor that brings the brighter parts of a layer, shape (3, H, W), electrons/s, to near white."""
    bright = float(np.percentile(_balanced(planes, detector), _WHITE_PERCENTILE))
    return _WHITE_LEVEL / max(bright, _DARK_ROOM_ELECTRONS_PER_S)


def to_srgb(planes: NDArray[Any], detector: Detector, exposure: float) -> Picture:
    """8-bit sRGB picture, shape (H, W, 3), of a layer, shape (3, H, W), electrons per second."""
    linear = np.clip(_balanced(planes, detector) * exposure, 0.0, 1.0)
    coded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return np.ascontiguousarray(np.rint(255.0 * coded).astype(np.uint8).transpose(1, 2, 0))


def halved(planes: NDArray[Any]) -> NDArray[Any]:
    """Mean of 2 x 2 pixels, shape (3, H // 2, W // 2)."""
    height, width = planes.shape[1] // 2 * 2, planes.shape[2] // 2 * 2
    cropped = planes[:, :height, :width]
    return cropped.reshape(3, height // 2, 2, width // 2, 2).mean(axis=(2, 4))


def save_png(path: Path, picture: Picture) -> Path:
    """Write a picture, shape (H, W, 3), atomically."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", compress_level=6)
    return write_bytes(path, buffer.getvalue())


def _balanced(planes: NDArray[Any], detector: Detector) -> NDArray[Any]:
    """Planes on one scale: electrons per second of the green band (white light gives three equal planes)."""
    gains = np.array(detector.band_electrons_per_joule())
    return (
        np.asarray(planes, float)
        * np.where(gains > 0.0, gains[1] / np.where(gains > 0.0, gains, 1.0), 0.0)[:, None, None]
    )
