"""Pictures for people: layers as sRGB, spots marked and enlarged, both positions of a sample side by side.

There is no camera model here: no noise, no mosaic, and an exposure that suits the eye. Layers have the shape (3, H, W),
electrons per second; pictures (H, W, 3), 8 bits.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.store.files import write_bytes
from phibench.render.optics.truth import SpotTruth
from phibench.render.sensor.srgb import srgb_encoded
from phibench.scenes.camera import Detector

# Layers as sRGB.


Picture = NDArray[np.uint8]
_WHITE_PERCENTILE = 98.0  # of the picture's light: lamps may be cut
_WHITE_LEVEL = 0.8  # of the largest code: what is brighter is still told apart
_MIDDLE_PERCENTILE, _MOST_CONTRAST = 60.0, 4.0  # a lamp that fills a tenth of the picture does not make the rest dark
_EVERY = 2  # rows and columns do for percentiles
_LEVELS = 65535  # linear values that are told apart: 0.05 codes where the curve is steepest
_DARK_ROOM_ELECTRONS_PER_S = 1e5  # a room below this is shown black, the spot at its own exposure


def display_exposure_s(planes: NDArray[Any], detector: Detector) -> float:
    """Exposure for display: it brings the brighter parts of a layer, shape (3, H, W), electrons/s, to near white."""
    some = np.asarray(planes[:, ::_EVERY, ::_EVERY], np.float32) * _gains(detector)[:, None, None]
    middle, bright = np.percentile(some, (_MIDDLE_PERCENTILE, _WHITE_PERCENTILE))
    bright = min(float(bright), _MOST_CONTRAST * float(middle)) if middle > 0.0 else float(bright)
    return _WHITE_LEVEL / max(bright, _DARK_ROOM_ELECTRONS_PER_S)


def to_srgb(planes: NDArray[Any], detector: Detector, exposure: float) -> Picture:
    """8-bit sRGB picture, shape (H, W, 3), of a layer, shape (3, H, W), electrons per second."""
    picture = np.empty((*planes.shape[1:], 3), dtype=np.uint8)
    for k, gain in enumerate(_gains(detector)):
        level = np.clip(planes[k] * np.float32(exposure * gain * _LEVELS), 0.0, _LEVELS)
        picture[..., k] = np.take(_codes(), level.astype(np.uint16))
    return picture


def halved_planes(planes: NDArray[Any]) -> NDArray[Any]:
    """Mean of 2 x 2 pixels, shape (3, H // 2, W // 2)."""
    height, width = planes.shape[1] // 2 * 2, planes.shape[2] // 2 * 2
    cropped = planes[:, :height, :width]
    upper, lower = (cropped[:, k::2, ::2] + cropped[:, k::2, 1::2] for k in (0, 1))
    return np.asarray((upper + lower) / 4)  # NumPy's mean over two axes takes three times as long


def save_png(path: Path, picture: Picture) -> Path:
    """Write a picture, shape (H, W, 3), atomically.

    Raises
    ------
    DatasetError
        If the name does not end in .png.
    """
    if path.suffix.lower() != ".png":
        raise DatasetError(f"{path}: pictures are written as PNG; give a name that ends in .png")
    buffer = io.BytesIO()
    # stated: the bytes must not follow Pillow's default
    Image.fromarray(picture).save(buffer, format="PNG", compress_level=1)
    return write_bytes(path, buffer.getvalue())


def _gains(detector: Detector) -> NDArray[np.float32]:
    """Factors to one scale: electrons per second of the green band (white light gives three equal planes)."""
    gains = np.array(detector.band_electrons_per_joule())
    return np.where(gains > 0.0, gains[1] / np.where(gains > 0.0, gains, 1.0), 0.0).astype(np.float32)


@cache
def _codes() -> NDArray[np.uint8]:
    """8-bit sRGB codes of the middles of linear values: a table takes half of the time of the curve."""
    return np.rint(255.0 * srgb_encoded((np.arange(_LEVELS + 1) + 0.5) / _LEVELS)).astype(np.uint8)


# Marked spots.


CROP_PX = 24  # the enlarged window measures 24 x 24 pixels
MARK, TEXT = (0, 255, 80), (255, 255, 255)


class SpotPlace(Protocol):
    """Place of a spot in its image: of its light, which scores refer to; NaN where there is none."""

    @property
    def u_px(self) -> float:
        """To the right."""

    @property
    def v_px(self) -> float:
        """Downwards."""


def marked_picture(picture: Picture, spot: SpotPlace, scale: int) -> Picture:
    """Frame at 1 / `scale` of its size, with a cross that leaves the spot itself free."""
    if not np.isfinite(spot.u_px):
        return picture
    image = Image.fromarray(picture)
    _cross(ImageDraw.Draw(image), (spot.u_px + 0.5) / scale, (spot.v_px + 0.5) / scale, 3.0, 8.0)
    return np.asarray(image)


def crop(frame: NDArray[Any], spot: SpotPlace) -> NDArray[Any]:
    """Window of 24 x 24 pixels around the spot, black outside the image, shape (3, 24, 24)."""
    result = np.zeros((3, CROP_PX, CROP_PX))
    corner = _corner(spot)
    if corner is not None:
        (u0, v0), (height, width) = corner, frame.shape[1:]
        rows, columns = (slice(max(x, 0), max(min(x + CROP_PX, n), 0)) for x, n in ((v0, height), (u0, width)))
        pixels = frame[:, rows, columns]
        if pixels.size:
            v, u = rows.start - v0, columns.start - u0
            result[:, v : v + pixels.shape[1], u : u + pixels.shape[2]] = pixels
    return result


def enlarged(picture: Picture, spot: SpotPlace, zoom: int) -> Picture:
    """Picture of a crop, each pixel shown zoom x zoom, with a cross at the true position."""
    image = Image.fromarray(np.kron(picture, np.ones((zoom, zoom, 1), np.uint8)))
    corner = _corner(spot)
    if corner is not None:
        u, v = ((x - x0 + 0.5) * zoom for x, x0 in zip((spot.u_px, spot.v_px), corner, strict=True))
        _cross(ImageDraw.Draw(image), u, v, 2.5 * zoom, 6.0 * zoom)
    return np.asarray(image)


def captioned_picture(picture: Picture, text: str) -> Picture:
    """Picture with a text, white on black, in its upper left corner."""
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    draw.rectangle(draw.multiline_textbbox((4, 4), text), fill=(0, 0, 0))
    draw.multiline_text((4, 4), text, fill=TEXT)
    return np.asarray(image)


def _corner(spot: SpotPlace) -> tuple[int, int] | None:
    if not np.isfinite(spot.u_px):
        return None
    return round(spot.u_px) - CROP_PX // 2, round(spot.v_px) - CROP_PX // 2


def _cross(draw: ImageDraw.ImageDraw, u: float, v: float, inner: float, outer: float) -> None:
    for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        draw.line((u + du * inner, v + dv * inner, u + du * outer, v + dv * outer), fill=MARK)


# Picture of a sample.


_LARGEST_ZOOM = 6


@dataclass(frozen=True)
class PositionImages:
    """One position of a sample: where its spot's light is, its frame and its ambient layer, (3, H, W), electrons/s."""

    position: str
    spot: SpotTruth
    frame: NDArray[np.float64]
    ambient: NDArray[np.float32]


def sample_picture(sides: Sequence[PositionImages], detector: Detector) -> Picture:
    """Both positions side by side, exposed for the first."""
    exposure = display_exposure_s(halved_planes(sides[0].ambient), detector)
    return np.concatenate([_picture(s.frame, s.position, s.spot, detector, exposure) for s in sides], axis=1)


def _picture(
    frame: NDArray[np.float64], position: str, spot: SpotTruth, detector: Detector, exposure: float
) -> Picture:
    picture = marked_picture(to_srgb(halved_planes(frame), detector, exposure), spot, 2)
    if not spot.visible:
        return captioned_picture(picture, f"{position}: not visible, {spot.cause}")
    window = crop(frame, spot)
    peak = float(window[1].max(initial=1.0))
    zoom = min(max(min(picture.shape[:2]) // 3 // CROP_PX, 1), _LARGEST_ZOOM)
    return _with_inset(picture, enlarged(to_srgb(window, detector, min(exposure, 1.0 / peak)), spot, zoom), spot)


def _with_inset(picture: Picture, inset: Picture, spot: SpotPlace) -> Picture:
    """Framed inset in the corner that is farthest from the spot; left out where the picture is too small for it."""
    framed = np.full((inset.shape[0] + 2, inset.shape[1] + 2, 3), MARK, np.uint8)
    framed[1:-1, 1:-1] = inset
    (height, width), (rows, columns) = picture.shape[:2], framed.shape[:2]
    if rows > height or columns > width:
        return picture
    v = height - rows if spot.v_px / 2.0 < height / 2.0 else 0
    u = width - columns if spot.u_px / 2.0 < width / 2.0 else 0
    result = picture.copy()
    result[v : v + rows, u : u + columns] = framed
    return result
