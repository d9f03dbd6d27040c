"""Linear light of an image as a camera delivers it, raw or 8 bits; and which kind of image it is.

Planes stand first, shape (3, h, w): linear sRGB, in which a grey room under the camera's own white balance has three
equal planes. A sensor without filters has one plane, shape (1, h, w).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.raw_pixels import bayer_filters, raw_electrons
from phibench.scenes.frames import Array

KINDS = ("bayer-raw", "mono-raw", "srgb8", "mjpeg")
RAW = KINDS[:2]
PROCESSED = KINDS[2:]


def kind_of(card: SensorCard) -> str:
    """One of `KINDS`, or the card's output if it is none of them."""
    return f"{card.mosaic}-raw" if card.output == "raw" else card.output


def linear_planes(image: NDArray[Any], card: SensorCard, origin_px: tuple[int, int] = (0, 0)) -> Array:
    """Linear light, shape (3, h, w) or, without filters, (1, h, w); full scale is 1 before gains.

    Parameters
    ----------
    image : shape (h, w) DN or (h, w, 3) 8-bit R, G, B
        An image or a part of one.
    card : SensorCard
    origin_px : (u, v)
        Image pixel of the first column and row: where the mosaic's red pixels are.
    """
    if card.output != "raw":
        return srgb_to_linear(np.moveaxis(np.asarray(image, float) / 255.0, -1, 0))
    full_scale_e = (card.top_dn - card.black_level_dn) / card.dn_per_e
    signal = raw_electrons(image, card) / full_scale_e
    if card.mosaic == "mono":
        return signal[None]
    balanced = demosaiced(signal, origin_px) * np.array(card.white_balance)[:, None, None]
    return np.einsum("ij,jhw->ihw", np.array(card.colour_matrix), balanced)


def demosaiced(signal: Array, origin_px: tuple[int, int] = (0, 0)) -> Array:
    """Bilinear interpolation of an RGGB mosaic, shape (h, w), to planes, shape (3, h, w).

    Beyond the border stands what is mirrored about the border pixel, which keeps the mosaic's colours in order.
    """
    u0, v0 = origin_px
    padded = np.pad(signal, 1, mode="reflect")
    filters = bayer_filters(np.array([(u0 - 1, v0 - 1)]), (padded.shape[0], padded.shape[1]))[0]
    red, green, blue = (np.where(filters == colour, padded, 0.0) for colour in range(3))
    return np.stack([_of_quarter(red), _of_half(green), _of_quarter(blue)])


def _of_quarter(sites: Array) -> Array:
    """Plane of a filter on every fourth pixel: its own value, the mean of two neighbours, or of four corners."""
    down = 0.5 * sites[:-2] + sites[1:-1] + 0.5 * sites[2:]
    return 0.5 * down[:, :-2] + down[:, 1:-1] + 0.5 * down[:, 2:]


def _of_half(sites: Array) -> Array:
    """Plane of a filter on every second pixel: its own value, or the mean of four neighbours."""
    beside = sites[1:-1, :-2] + sites[1:-1, 2:] + sites[:-2, 1:-1] + sites[2:, 1:-1]
    return sites[1:-1, 1:-1] + 0.25 * beside


def srgb_to_linear(encoded: Array) -> Array:
    """Linear values of the sRGB curve, both in [0, 1] (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """sRGB curve of values cut to [0, 1] (IEC 61966-2-1)."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1.0 / 2.4) - 0.055)


def redness(planes: Array) -> Array:
    """R - max(G, B), shape (h, w), of planes (3, h, w); the plane itself where there is one."""
    return planes[0] if len(planes) == 1 else planes[0] - np.maximum(planes[1], planes[2])
