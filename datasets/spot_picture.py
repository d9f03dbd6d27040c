"""Pictures that show people where a spot is: a cross that leaves it free, and its surroundings enlarged."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from phibench.datasets.preview import Picture
from phibench.datasets.schema import SpotRow

CROP_PX = 24  # the enlarged window measures 24 x 24 pixels
MARK, TEXT = (0, 255, 80), (255, 255, 255)


def marked(picture: Picture, spot: SpotRow, scale: int) -> Picture:
    """Frame at 1 / `scale` of its size, with a cross that leaves the spot itself free."""
    if not np.isfinite(spot.u_px):
        return picture
    image = Image.fromarray(picture)
    _cross(ImageDraw.Draw(image), (spot.u_px + 0.5) / scale, (spot.v_px + 0.5) / scale, 3.0, 8.0)
    return np.asarray(image)


def crop(frame: NDArray[Any], spot: SpotRow) -> NDArray[Any]:
    """Window of 24 x 24 pixels around the spot, black outside the image, shape (3, 24, 24)."""
    result = np.zeros((3, CROP_PX, CROP_PX))
    corner = _corner(spot)
    if corner is not None:
        (u0, v0), (height, width) = corner, frame.shape[1:]
        rows, columns = (slice(max(x, 0), max(min(x + CROP_PX, n), 0)) for x, n in ((v0, height), (u0, width)))
        part = frame[:, rows, columns]
        if part.size:
            v, u = rows.start - v0, columns.start - u0
            result[:, v : v + part.shape[1], u : u + part.shape[2]] = part
    return result


def enlarged(picture: Picture, spot: SpotRow, zoom: int) -> Picture:
    """Picture of a crop, each pixel shown zoom x zoom, with a cross at the true position."""
    image = Image.fromarray(np.kron(picture, np.ones((zoom, zoom, 1), np.uint8)))
    corner = _corner(spot)
    if corner is not None:
        u, v = ((x - x0 + 0.5) * zoom for x, x0 in zip((spot.u_px, spot.v_px), corner, strict=True))
        _cross(ImageDraw.Draw(image), u, v, 2.5 * zoom, 6.0 * zoom)
    return np.asarray(image)


def captioned(picture: Picture, text: str) -> Picture:
    """Picture with a text, white on black, in its upper left corner."""
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    draw.rectangle(draw.multiline_textbbox((4, 4), text), fill=(0, 0, 0))
    draw.multiline_text((4, 4), text, fill=TEXT)
    return np.asarray(image)


def _corner(spot: SpotRow) -> tuple[int, int] | None:
    if not np.isfinite(spot.u_px):
        return None
    return round(spot.u_px) - CROP_PX // 2, round(spot.v_px) - CROP_PX // 2


def _cross(draw: ImageDraw.ImageDraw, u: float, v: float, inner: float, outer: float) -> None:
    for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        draw.line((u + du * inner, v + dv * inner, u + du * outer, v + dv * outer), fill=MARK)
