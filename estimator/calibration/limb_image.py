"""An image as planes of linear light, with what the camera's processing did to each pixel.

A pixel of a demosaiced image is a weighted sum of mosaic pixels around it. Such a sum is kept as taps, so that a model
of the light can be sent through the same sum instead of undoing it. Integer (u, v) are pixel centres; RGGB mosaic, red
at even row and even column. Filters are numbered 0, 1, 2 for R, G, B.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.datasets.errors import DatasetError
from phibench.datasets.sensor_card import SensorCard
from phibench.scenes.frames import Array, BoolArray

JPEG_LUMA = (0.299, 0.587, 0.114)  # JPEG's (ITU-R BT.601): errors of its coarse chroma cancel in this sum
_CLIPPED = 250  # of 255: JPEG moves clipped pixels by some codes
_NEAR_FULL = 0.97
_SRGB_KNEE, _SRGB_SLOPE = 0.04045, 12.92  # IEC 61966-2-1


class ImageError(DatasetError):
    """An image that a calibration cannot be made from; the message is one sentence for the person at the terminal."""


@dataclass(frozen=True)
class Tap:
    """One term of a pixel's sum: `weight` x light behind `filter_index` at the pixel (u + du_px, v + dv_px)."""

    weight: float
    filter_index: int
    du_px: int = 0
    dv_px: int = 0


Taps = tuple[Tap, ...]


@dataclass(frozen=True)
class Plane:
    """Linear light of one kind.

    Attributes
    ----------
    values : shape (H, W), in any unit
    usable : shape (H, W), False where there is no such pixel or it is saturated
    taps : 4 sums, for the pixels with 2 (v mod 2) + (u mod 2) = 0, 1, 2, 3; weights sum to 1
    """

    values: Array = field(repr=False)
    usable: BoolArray = field(repr=False)
    taps: tuple[Taps, Taps, Taps, Taps]


def planes_of(image: NDArray[Any], card: SensorCard | None = None) -> tuple[Plane, ...]:
    """Planes of an image.

    Parameters
    ----------
    image : array
        Without a card, or for a card whose output is "electrons": a layer or an ideal frame, shape (3, H, W). Else by
        `card.output`: "raw" (H, W) DN; "srgb8" and "mjpeg" (H, W, 3) of 8 bits.
    card : SensorCard, optional

    Raises
    ------
    ImageError
        If the shape is not the output's.
    """
    output = "electrons" if card is None else card.output
    shape_is_right = {
        "electrons": image.ndim == 3 and image.shape[0] == 3,
        "raw": image.ndim == 2,
    }.get(output, image.ndim == 3 and image.shape[-1] == 3)
    if not shape_is_right or image.size == 0:
        raise ImageError(
            f"an image of shape {image.shape} is no '{output}' image: name the preset that it was drawn with"
        )
    if card is None or output == "electrons":
        return tuple(_whole(image[i], (Tap(1.0, i),)) for i in range(3))
    if output == "raw":
        return _raw(image, card)
    return (_luma(image, card),)


def _whole(values: NDArray[Any], taps: Taps) -> Plane:
    values = np.asarray(values, float)
    return Plane(values, np.isfinite(values), (taps, taps, taps, taps))


def _raw(image: NDArray[Any], card: SensorCard) -> tuple[Plane, ...]:
    electrons = (image.astype(float) - card.black_level_dn) / card.dn_per_e
    open_wells = electrons < _NEAR_FULL * card.saturation_e
    if card.mosaic == "mono":
        taps = tuple(Tap(1.0 / 3.0, i) for i in range(3))
        return (Plane(electrons, open_wells, (taps, taps, taps, taps)),)
    rows, columns = np.indices(image.shape) % 2
    planes = []
    for i in range(3):
        taps = (Tap(1.0, i),)
        planes.append(Plane(electrons, open_wells & (rows + columns == i), (taps, taps, taps, taps)))
    return tuple(planes)


def _luma(image: NDArray[Any], card: SensorCard) -> Plane:
    """Luma of the linear, white-balanced planes. It is a filter's own light only where the colour matrix is one."""
    linear = srgb_decoded(np.asarray(image, float) / 255.0)
    values = linear @ np.array(JPEG_LUMA)
    clipped = ndimage.binary_dilation((image >= _CLIPPED).any(axis=-1), iterations=2)
    level = np.median(linear.reshape(-1, 3), axis=0) * np.array(JPEG_LUMA)
    # shares of the filters in the luma of this picture; three equal ones would be as good, the room is nearly grey
    share = level / level.sum() if level.sum() > 0.0 else np.array(JPEG_LUMA)
    taps = [_merged(_luma_taps(parity, share, card)) for parity in range(4)]
    return Plane(values, ~clipped, (taps[0], taps[1], taps[2], taps[3]))


def srgb_decoded(encoded: Array) -> Array:
    """Linear values in [0, 1] of sRGB values in [0, 1] (IEC 61966-2-1)."""
    x = np.clip(np.asarray(encoded, float), 0.0, 1.0)
    return np.where(x <= _SRGB_KNEE, x / _SRGB_SLOPE, ((x + 0.055) / 1.055) ** 2.4)


def srgb_encoded(linear: Array) -> Array:
    """sRGB curve of linear values, cut to [0, 1]; the inverse of `srgb_decoded`."""
    x = np.clip(np.asarray(linear, float), 0.0, 1.0)
    return np.where(x <= _SRGB_KNEE / _SRGB_SLOPE, x * _SRGB_SLOPE, 1.055 * x ** (1.0 / 2.4) - 0.055)


_CROSS = tuple((0.25, du, dv) for du, dv in ((-1, 0), (1, 0), (0, -1), (0, 1)))
_CORNERS = tuple((0.25, du, dv) for du in (-1, 1) for dv in (-1, 1))
_BESIDE, _ABOVE, _OWN = ((0.5, -1, 0), (0.5, 1, 0)), ((0.5, 0, -1), (0.5, 0, 1)), ((1.0, 0, 0),)
_BILINEAR = (  # by parity, then filter R, G, B: what bilinear interpolation of an RGGB mosaic takes
    (_OWN, _CROSS, _CORNERS),
    (_BESIDE, _OWN, _ABOVE),
    (_ABOVE, _OWN, _BESIDE),
    (_CORNERS, _CROSS, _OWN),
)


def _luma_taps(parity: int, share: Array, card: SensorCard) -> Iterable[Tap]:
    for weight, du, dv in _sharpening(card.sharpen_amount):
        there = (parity // 2 + dv) % 2 * 2 + (parity + du) % 2
        for i in range(3):
            sums = _BILINEAR[there][i] if card.mosaic == "bayer" else _OWN
            yield from (Tap(weight * part * float(share[i]), i, du + a, dv + b) for part, a, b in sums)


def _sharpening(amount: float) -> Iterable[tuple[float, int, int]]:
    """Unsharp mask as a sum. After the sRGB curve, in the camera; on a faint limb that is the same."""
    if amount == 0.0:
        yield 1.0, 0, 0
        return
    binomial = (0.25, 0.5, 0.25)
    for du in (-1, 0, 1):
        for dv in (-1, 0, 1):
            yield (1.0 + amount if du == dv == 0 else 0.0) - amount * binomial[du + 1] * binomial[dv + 1], du, dv


def _merged(taps: Iterable[Tap]) -> Taps:
    """One tap for each filter and place."""
    sums: dict[tuple[int, int, int], float] = {}
    for tap in taps:
        key = (tap.filter_index, tap.du_px, tap.dv_px)
        sums[key] = sums.get(key, 0.0) + tap.weight
    return tuple(Tap(weight, *key) for key, weight in sums.items())
