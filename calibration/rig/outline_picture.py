"""Pictures of a rig's frames: a mirror's outline with its residuals enlarged, and any frame as 8 bits."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from phibench.calibration.outline.first_circle import grey
from phibench.calibration.outline.limb_image import planes_of
from phibench.calibration.outline.outline_result import SECTORS, Outline, binned_rig
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.datasets.store.files import write_bytes
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

_LONGEST_PX = 1600  # writing a PNG of twelve megapixels takes longer than finding the outline in it
_LONGEST_RESIDUAL_PX, _FONT_PX = 45.0, 18  # enlarged residuals stay beside the outline
_GAINS = (5000.0, 2000.0, 1000.0, 500.0, 200.0, 100.0, 50.0, 20.0, 10.0)
_FOUND, _RESIDUAL, _UNUSED = (0, 255, 0), (255, 225, 0), (150, 150, 150)


@dataclass(frozen=True)
class Overlay:
    """A copy of a frame to draw into.

    Attributes
    ----------
    picture : RGB
    rig : Rig
        In the picture's pixels, with the sphere where its outline is.
    times : float
        Pixels of the picture per pixel of the frame.
    legend : tuple of str
    """

    picture: Image.Image
    rig: Rig
    times: float
    legend: tuple[str, ...]

    def write(self, path: Path, *lines: str) -> Path:
        """Write a PNG, atomically, with the legend and further lines below."""
        _draw_legend(self.picture, (*self.legend, *lines))
        return write_picture(path, self.picture)


def write_picture(path: Path, picture: Image.Image) -> Path:
    """Write a PNG, atomically."""
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG")
    return write_bytes(path, buffer.getvalue())


def shown_picture(codes: NDArray[np.uint8]) -> tuple[Image.Image, int]:
    """RGB picture of codes, shape (H, W, 3) or (H, W), of at most 1600 px, and how many pixels are one of its."""
    block = max(1, math.ceil(max(codes.shape[:2]) / _LONGEST_PX))
    return Image.fromarray(np.ascontiguousarray(codes)).reduce(block).convert("RGB"), block


def overlay(codes: NDArray[np.uint8], rig: Rig, outline: Outline) -> Overlay:
    """Outline and residuals, drawn into a copy of a frame of at most 1600 px.

    Parameters
    ----------
    codes : shape (H, W, 3) or (H, W)
    rig : Rig
        Nominal.
    outline : Outline
        Found in the frame.
    """
    picture, block = shown_picture(codes)
    there = binned_rig(outline.rig(rig), block)
    legend = _draw_outline(picture, there, replace(outline, shifts_px=outline.shifts_px / block))
    return Overlay(picture, there, 1.0 / block, legend)


def write_overlay(
    path: Path, image: NDArray[Any], card: SensorCard | None, nominal: Rig, outline: Outline, title: str = ""
) -> Path:
    """Draw the outline that was found and its residuals, enlarged, onto a frame; PNG, written atomically.

    Parameters
    ----------
    path
    image, card : see `limb_image.planes_of`
    nominal : Rig
    outline : Outline, found in the image
    title : str
        Last line of the legend.
    """
    drawn = overlay(visible_picture(image, card), nominal, outline)
    return drawn.write(path, *((title,) if title else ()))


def _draw_outline(picture: Image.Image, rig: Rig, outline: Outline) -> tuple[str, ...]:
    """Draw an outline and its residuals into an RGB picture; `rig` has the sphere where the outline is.

    Returns
    -------
    tuple of str
        Lines of the legend.
    """
    draw = ImageDraw.Draw(picture)
    rim = rig.outline_px(6 * SECTORS)
    shift = outline.shifts_px[_sector_of(rig, rim)]
    gain = _gain(shift)
    outwards = rim - rim.mean(axis=0)
    outwards /= np.linalg.norm(outwards, axis=-1, keepdims=True)
    _line(draw, rim, np.full(len(rim), True), _FOUND)
    _line(draw, rim, np.isnan(shift), _UNUSED, width=3)
    _line(draw, rim + gain * np.nan_to_num(shift)[:, None] * outwards, np.isfinite(shift), _RESIDUAL, width=2)
    return ("green: outline found", f"yellow: residual x {gain:g}", "grey: not used")


def _draw_legend(picture: Image.Image, lines: Sequence[str]) -> None:
    """Write lines into the lower left corner of an RGB picture."""
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(_FONT_PX)
    corner, text = (8, picture.height - 8), "\n".join(lines)
    draw.rectangle(draw.multiline_textbbox(corner, text, font, anchor="ld", spacing=6), fill=(0, 0, 0))
    draw.multiline_text(corner, text, (255, 255, 255), font, anchor="ld", spacing=6)


def _gain(shift_px: Array) -> float:
    """Round factor by which the largest residual becomes some ten pixels long."""
    largest = float(np.nanmax(np.abs(shift_px))) if np.isfinite(shift_px).any() else 0.0
    return next((gain for gain in _GAINS if gain * largest <= _LONGEST_RESIDUAL_PX), _GAINS[-1])


def _sector_of(rig: Rig, uv_px: Array) -> NDArray[np.int64]:
    """Sector of `Outline.shifts_px` of each pixel on the outline."""
    axis = rig.sphere_in_camera_m / np.linalg.norm(rig.sphere_in_camera_m)
    rays = rig.camera.rays(uv_px)
    across = rays - (rays @ axis)[:, None] * axis
    turn = (np.arctan2(across[:, 1], across[:, 0]) + np.pi) / (2.0 * np.pi)
    return np.floor(turn * SECTORS).astype(np.int64) % SECTORS


def _line(draw: ImageDraw.ImageDraw, uv_px: Array, show: NDArray[np.bool_], colour: Any, width: int = 1) -> None:
    """Closed line through pixels, where both ends of a piece are shown."""
    for k in range(len(uv_px)):
        if show[k - 1] and show[k]:
            draw.line((*uv_px[k - 1], *uv_px[k]), fill=colour, width=width)


def visible_picture(image: NDArray[Any], card: SensorCard | None) -> NDArray[np.uint8]:
    """8-bit picture of a frame or a layer, without colours where it has to be developed first."""
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    level = grey(planes_of(image, card))
    white = max(float(np.percentile(level, 98.0)), 1e-300)  # lamps do not set the white; a black picture stays black
    return np.rint(255.0 * np.clip(0.8 * level / white, 0.0, 1.0) ** (1.0 / 2.2)).astype(np.uint8)
