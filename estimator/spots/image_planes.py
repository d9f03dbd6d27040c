"""Kinds of camera images (`KINDS`) and their linear light: demosaicing, JPEG, colour planes, noise of their pixels.

Images are as a camera delivers them: raw DN of a mosaic or of pixels without filters, 8-bit R, G, B, or Y'CbCr 4:2:2.

* `linear_planes`: linear sRGB, shape (3, h, w), full scale 1 before gains. A grey room under the camera's own white
  balance has three equal planes. A sensor without filters has one plane, shape (1, h, w).
* `colour_planes`: electrons behind each filter, for the search of spots. Raw pixels stay where they are: a mosaic's
  plane holds values at its own sites and zeros elsewhere. 8-bit images go back through the tone curve, the colour
  matrix and the white balance. Their pixels are interpolated, so that their noise is correlated and only roughly what
  `variance_e2` says: what uses it calibrates it on the image.

The simulator has its own curve, demosaicing and JPEG (`render.sensor.processing`); tests compare the two.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Picture

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.interface import Box, Image
from phibench.estimator.spots.camera_codes import light_of, qtables_of, rgb_codes, rgb_picture, tone_slope
from phibench.estimator.spots.raw_pixels import bayer_filters, raw_electrons
from phibench.scenes.frames import Array, BoolArray

KINDS = ("bayer-raw", "mono-raw", "srgb8", "yuyv", "mjpeg")
RAW = KINDS[:2]
PROCESSED = KINDS[2:]

_TOP_CODE = 254  # of 8 bits: from here on a pixel may be cut
_DEMOSAIC_VARIANCE_PX2 = 0.5  # of bilinear interpolation's kernel (1/2, 1, 1/2), per axis


class ImageError(DatasetError):
    """An image that cannot be used; the message is one sentence for the person at the terminal."""


# -- kinds -------------------------------------------------------------------------------------------------


def kind_of(card: SensorCard) -> str:
    """One of `KINDS`, or the card's output if it is none of them."""
    return f"{card.mosaic}-raw" if card.output == "raw" else card.output


def through_jpeg(image: NDArray[np.uint8], card: SensorCard) -> NDArray[np.uint8]:
    """Image, shape (H, W, 3), after the card's JPEG, by libjpeg."""
    file = io.BytesIO()
    tables = qtables_of(card)
    steps = {"quality": tables} if isinstance(tables, int) else {"qtables": [list(table) for table in tables]}
    Picture.fromarray(image).save(file, "JPEG", subsampling=card.jpeg_subsampling, **steps)
    return np.array(Picture.open(file))


# -- linear planes and demosaicing -----------------------------------------------------------------------------------


def full_scale_e(card: SensorCard) -> float:
    """Electrons of linear light 1."""
    return (card.top_dn - card.black_level_dn) / card.dn_per_e


def linear_planes(image: NDArray[Any], card: SensorCard, origin_px: tuple[int, int] = (0, 0)) -> Array:
    """Linear light, shape (3, h, w) or, without filters, (1, h, w); full scale is 1 before gains.

    Parameters
    ----------
    image : shape (h, w) DN, (h, w, 3) 8-bit R, G, B, or (h, w, 2) of "yuyv"
        An image or a part of one.
    origin_px : (u, v)
        Image pixel of the first column and row: where the mosaic's red pixels are, and pairs of "yuyv" begin.
    """
    if card.output != "raw":
        codes = rgb_codes(image, card, origin_px)
        if codes.dtype == np.uint8:  # a power for each code, not for each pixel
            return np.moveaxis(light_of(np.arange(256) / 255.0, card)[codes], -1, 0)
        return light_of(np.moveaxis(np.clip(np.asarray(codes, float) / 255.0, 0.0, 1.0), -1, 0), card)
    signal = raw_electrons(image, card) / full_scale_e(card)
    if card.mosaic == "mono":
        return signal[None]
    balanced = demosaiced_planes(signal, origin_px) * np.array(card.white_balance)[:, None, None]
    return np.einsum("ij,jhw->ihw", np.array(card.colour_matrix), balanced)


def demosaiced_planes(signal: Array, origin_px: tuple[int, int] = (0, 0)) -> Array:
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


def redness(planes: Array) -> Array:
    """R - max(G, B), shape (h, w), of planes (3, h, w); the plane itself where there is one."""
    return planes[0] if len(planes) == 1 else planes[0] - np.maximum(planes[1], planes[2])


# -- colour planes in electrons --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ColourPlanes:
    """Part of an image.

    Attributes
    ----------
    values_e : shape (c, h, w), float32 to be quick
        Electrons behind R, G, B, or of pixels without filters (c = 1).
    sites : shape (c, h, w), bool
        Pixels at which a plane was measured or interpolated.
    full : shape (c, h, w), bool
        Pixels at saturation.
    box : Box
        The part; its first row and column are even, so that red comes first.
    """

    values_e: NDArray[Any]
    sites: BoolArray
    full: BoolArray
    box: Box

    @property
    def mosaic(self) -> bool:
        """Each pixel has one colour only."""
        return len(self.values_e) > 1 and not bool(self.sites[0, 0, 1])

    @property
    def shape(self) -> tuple[int, int]:
        """(h, w)."""
        return self.values_e.shape[1], self.values_e.shape[2]

    @cached_property
    def green_at_red(self) -> Array:
        """Green at the red sites, shape (h, w); kept, because every test of places asks for it."""
        green = self.values_e[1]
        if not self.mosaic:
            return green
        p = np.pad(green, 1, mode="reflect")
        result = np.zeros_like(green)
        here = (slice(None, None, 2), slice(None, None, 2))
        around = p[:-2, 1:-1][here] + p[2:, 1:-1][here] + p[1:-1, :-2][here] + p[1:-1, 2:][here]
        result[here] = np.float32(0.25) * around
        return result


def colour_planes(image: Image, card: SensorCard, box: Box) -> ColourPlanes:
    """Planes of the part `box` of an image; see `interface.Pair` for the outputs.

    Raises
    ------
    ValueError
        If the card's output is "electrons", or the image has another shape than it says.
    """
    pixels = image[box.slices]
    if pixels.shape[2:] != {"raw": (), "srgb8": (3,), "yuyv": (2,), "mjpeg": (3,)}.get(card.output) or pixels.ndim < 2:
        raise ValueError(
            f"an image of the shape {image.shape} for the output '{card.output}': raw needs (H, W), srgb8 and mjpeg "
            "need (H, W, 3), yuyv needs (H, W, 2)"
        )
    if card.output == "raw":
        return _raw(pixels, card, box)
    return _developed(rgb_picture(pixels, card, (box.u0_px, box.v0_px)), card, box)


def blur_of(card: SensorCard, sigma_px: float) -> float:
    """Blur of a spot of the optical blur `sigma_px` in the planes: interpolation between red pixels widens it."""
    interpolated = card.output != "raw" and card.mosaic == "bayer"
    return float(np.sqrt(sigma_px**2 + (_DEMOSAIC_VARIANCE_PX2 if interpolated else 0.0)))


def green_at_red(on: ColourPlanes) -> Array:
    """Green at the red sites: of a mosaic the mean of the four neighbours, zero elsewhere."""
    return on.green_at_red


def variance_e2(mean_e: Array, card: SensorCard, alike: bool) -> Array:
    """Variance of a pixel's electrons, shape of `mean_e`.

    Parameters
    ----------
    mean_e : array of any shape
    alike : bool
        The fixed pattern cancels, as in the difference of two frames of one camera.
    """
    mean = np.maximum(mean_e, 0.0)
    # rounding is uniform over a code
    constant = card.read_noise_e**2 + card.row_noise_e**2 + 1.0 / (12.0 * card.dn_per_e**2)
    pattern = 0.0 if alike else card.dsnu_e**2 + (card.prnu * mean) ** 2
    code = 0.0 if card.output == "raw" else _code_step_e(mean, card) ** 2 / 12.0
    return mean + constant + pattern + code


def _raw(part: Image, card: SensorCard, box: Box) -> ColourPlanes:
    electrons = raw_electrons(part, card).astype(np.float32)
    full = electrons >= card.saturation_e
    if card.mosaic == "mono":
        return ColourPlanes(electrons[None], np.ones((1, *part.shape), bool), full[None], box)
    colour = (np.arange(part.shape[0])[:, None] + box.v0_px) % 2 + (np.arange(part.shape[1]) + box.u0_px) % 2
    sites = np.stack([colour == c for c in range(3)])
    return ColourPlanes(np.where(sites, electrons, np.float32(0.0)), sites, full & sites, box)


def _developed(part: Image, card: SensorCard, box: Box) -> ColourPlanes:
    planes = [np.ascontiguousarray(part[..., c]) for c in range(3 if card.mosaic == "bayer" else 1)]
    curve = (light_of(np.arange(256) / 255.0, card) * full_scale_e(card)).astype(np.float32)  # a look-up of 256 codes
    linear = np.stack([curve.take(plane) for plane in planes])
    if card.mosaic == "bayer":  # as a product of matrices: einsum leaves the planes interleaved, for slow filters
        linear = (_to_sensor(card).astype(np.float32) @ linear.reshape(3, -1)).reshape(linear.shape)
    full = np.stack([plane >= _TOP_CODE for plane in planes])
    return ColourPlanes(linear, np.ones(linear.shape, bool), full, box)


def _to_sensor(card: SensorCard) -> Array:
    """Matrix, shape (3, 3), from linear sRGB to the sensor's R, G, B."""
    return np.linalg.inv(np.array(card.colour_matrix)) / np.array(card.white_balance)[:, None]


def _code_step_e(mean_e: Array, card: SensorCard) -> Array:
    """Electrons per 8-bit code at a level: the slope of the tone curve."""
    slope = tone_slope(np.clip(mean_e / full_scale_e(card), 0.0, 1.0), card)
    return np.asarray(full_scale_e(card) / (255.0 * slope))
