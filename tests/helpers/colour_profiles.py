"""Colour profiles (ICC) made by code: sRGB with another curve or other primaries, and what they mean."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from PIL import ImageCms

SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
P3 = {b"rXYZ": (0.51512, 0.2412, -0.00105), b"gXYZ": (0.29198, 0.69225, 0.04189), b"bXYZ": (0.1571, 0.06657, 0.78407)}
P3_TO_SRGB = np.array([[1.22494, -0.22494, 0.0], [-0.04206, 1.04206, 0.0], [-0.01964, -0.07864, 1.09828]])


def edited_profile(
    gamma: float | None = None, colorants: Mapping[bytes, tuple[float, ...]] = MappingProxyType({})
) -> bytes:
    """Profile of sRGB with another curve or other primaries (ICC.1:2022, tags of type curv and XYZ)."""
    data = bytearray(SRGB)
    for at in range(132, 132 + 12 * int.from_bytes(SRGB[128:132]), 12):
        name, start = SRGB[at : at + 4], int.from_bytes(SRGB[at + 4 : at + 8])
        if gamma is not None and name in (b"rTRC", b"gTRC", b"bTRC"):
            data[start : start + 14] = struct.pack(">4s4xIH", b"curv", 1, round(256 * gamma))
        elif name in colorants:
            data[start + 8 : start + 20] = struct.pack(">3i", *(round(65536 * x) for x in colorants[name]))
    return bytes(data)


def linear(codes: np.ndarray) -> np.ndarray:
    """Light of sRGB's codes of 8 bits (IEC 61966-2-1)."""
    x = codes / 255.0
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
