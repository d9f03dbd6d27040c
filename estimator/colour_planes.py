"""An image of any output as planes of linear electrons, one per colour filter, for what looks for a spot in it.

Raw pixels stay where they are: a mosaic's plane holds values at its own sites and zeros elsewhere. 8-bit images go back
through the sRGB curve, the colour matrix and the white balance; their pixels are interpolated, so that their noise is
correlated and only roughly what `variance` says: what uses it calibrates it on the image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.raw_pixels import raw_electrons
from phibench.estimator.seat.pair import Box, Image
from phibench.scenes.frames import Array, BoolArray

_TOP_CODE = 254  # of 8 bits: from here on a pixel may be cut
_DEMOSAIC_VARIANCE_PX2 = 0.5  # of bilinear interpolation's kernel (1/2, 1, 1/2), per axis


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
        """Whether each pixel has one colour only."""
        return len(self.values_e) > 1 and not bool(self.sites[0, 0, 1])

    @property
    def shape(self) -> tuple[int, int]:
        """(h, w)."""
        return self.values_e.shape[1], self.values_e.shape[2]


def colour_planes(image: Image, card: SensorCard, box: Box) -> ColourPlanes:
    """Planes of the part `box` of an image; see `seat.pair.Pair` for the outputs.

    Raises
    ------
    ValueError
        If the card's output is neither "raw", "srgb8" nor "mjpeg", or the image has another shape than it says.
    """
    part = image[box.slices]
    if card.output not in ("raw", "srgb8", "mjpeg") or part.ndim != (2 if card.output == "raw" else 3):
        raise ValueError(
            f"an image of the shape {image.shape} for the output '{card.output}': raw needs (H, W), srgb8 and mjpeg "
            "need (H, W, 3)"
        )
    if card.output == "raw":
        return _raw(part, card, box)
    return _developed(part, card, box)


def blur_of(card: SensorCard, sigma_px: float) -> float:
    """Blur of a spot of the optical blur `sigma_px` in the planes: interpolation between red pixels widens it."""
    interpolated = card.output != "raw" and card.mosaic == "bayer"
    return float(np.sqrt(sigma_px**2 + (_DEMOSAIC_VARIANCE_PX2 if interpolated else 0.0)))


def green_at_red(on: ColourPlanes) -> Array:
    """Green at the red sites: of a mosaic the mean of the four neighbours, zero elsewhere."""
    green = on.values_e[1]
    if not on.mosaic:
        return green
    p = np.pad(green, 1, mode="reflect")
    result = np.zeros_like(green)
    here = (slice(None, None, 2), slice(None, None, 2))
    around = p[:-2, 1:-1][here] + p[2:, 1:-1][here] + p[1:-1, :-2][here] + p[1:-1, 2:][here]
    result[here] = np.float32(0.25) * around
    return result


def variance_e2(mean_e: Array, card: SensorCard, alike: bool) -> Array:
    """Variance of a pixel's electrons, shape of `mean_e`.

    Parameters
    ----------
    mean_e : array of any shape
    card : SensorCard
    alike : bool
        Whether the fixed pattern cancels: in the difference of two frames of one camera.
    """
    mean = np.maximum(mean_e, 0.0)
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
    curve = (_decoded(np.arange(256) / 255.0) * _full_scale_e(card)).astype(np.float32)
    linear = np.stack([curve[plane] for plane in planes])
    if card.mosaic == "bayer":
        linear = np.einsum("ij,jhw->ihw", _to_sensor(card).astype(np.float32), linear, optimize=True)
    full = np.stack([plane >= _TOP_CODE for plane in planes])
    return ColourPlanes(linear, np.ones(linear.shape, bool), full, box)


def _to_sensor(card: SensorCard) -> Array:
    """Matrix, shape (3, 3), from linear sRGB to the sensor's R, G, B."""
    return np.linalg.inv(np.array(card.colour_matrix)) / np.array(card.white_balance)[:, None]


def _full_scale_e(card: SensorCard) -> float:
    return (card.top_dn - card.black_level_dn) / card.dn_per_e


def _code_step_e(mean_e: Array, card: SensorCard) -> Array:
    """Electrons per 8-bit code at a level: the slope of the sRGB curve."""
    x = np.clip(mean_e / _full_scale_e(card), 0.0, 1.0)
    slope = np.where(x <= 0.0031308, 1.0 / 12.92, 2.4 / 1.055 * np.maximum(x, 1e-6) ** (1.4 / 2.4))
    return np.asarray(slope * _full_scale_e(card) / 255.0)


def _decoded(encoded: Array) -> Array:
    """Linear values of the sRGB curve, both in [0, 1] (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
