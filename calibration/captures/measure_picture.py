"""Picture of a measurement: both positions side by side, the spots enlarged, the outline and the epipolar line.

Both panels show the part of the frame around the mirror, laser on. The line in the up panel is where the point seen by
the down spot can be, from 0.3 to 12 m away. It passes the up spot if both are one point.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont, ImageOps

from phibench.calibration.captures.measure import Measurement
from phibench.calibration.captures.measurement_doubts import SeenSpot
from phibench.calibration.rig.outline_picture import visible_picture
from phibench.datasets.store.files import write_bytes
from phibench.estimator.interface import Box
from phibench.estimator.spots.detect import epipolar_curve, mirror_box
from phibench.scenes.frames import Array
from phibench.scenes.rig import POSITIONS

# two panels make 1288 px: a screen shows them without scaling
_PANEL_PX, _GAP_PX, _FONT_PX, _LINE_PX = 640, 8, 16, 22
_INSET_PX, _AROUND_PX = 200, 10  # side of an enlarged part, and half of the pixels in it
_OUTLINE, _CURVE, _SPOT = (0, 255, 0), (255, 225, 0), (0, 225, 255)
_JPEG_QUALITY = 85


def write_measure_picture(path: Path, found: Measurement) -> Path:
    """Draw a measurement into a PNG, or a JPEG where the name ends so; written atomically.

    Raises
    ------
    DatasetError
        If the file cannot be written.
    """
    picture = draw_measurement(found)
    buffer = io.BytesIO()
    if path.suffix.lower() in (".jpg", ".jpeg"):
        picture.save(buffer, format="JPEG", quality=_JPEG_QUALITY, subsampling=0)
    else:
        picture.save(buffer, format="PNG")
    return write_bytes(path, buffer.getvalue())


def draw_measurement(found: Measurement, title: str = "") -> Image.Image:
    """RGB picture of a measurement."""
    panels = [_panel(found, position) for position in POSITIONS]
    lines = [title] if title else []
    lines += [f"D = {found.depth_m:.3f} m, sigma {found.sigma_m:.3f} m", *found.notes]
    height = max(panel.height for panel in panels)
    whole = Image.new("RGB", (2 * _PANEL_PX + _GAP_PX, height + _LINE_PX * len(lines) + _GAP_PX))
    for place, panel in enumerate(panels):
        whole.paste(panel, (place * (_PANEL_PX + _GAP_PX), 0))
    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(_FONT_PX)
    for place, line in enumerate(lines):
        draw.text((_GAP_PX, height + _GAP_PX + _LINE_PX * place), line, (255, 255, 255), font)
    return whole


def _panel(found: Measurement, position: str) -> Image.Image:
    """Mirror of one position with what was found in it, and the spot enlarged in a corner away from it."""
    image = visible_picture(found.pair.images[position], found.pair.card)
    box = mirror_box(found.rig)
    scale = _PANEL_PX / box.width_px
    panel = _part(image, box, (_PANEL_PX, round(scale * box.height_px)))
    draw, origin = ImageDraw.Draw(panel), np.array([box.u0_px, box.v0_px]) - 0.5
    for outline in found.outlines[:1]:
        _line(draw, scale * (outline.rig(found.nominal).outline_px() - origin), _OUTLINE, closed=True)
    if position == "up":
        curve = epipolar_curve(found.rig, found.stroke_m, found.down.uv_px[None])[0]
        _line(draw, scale * (curve - origin), _CURVE)
    spot: SeenSpot = getattr(found, position)
    u, v = (float(x) for x in scale * (spot.uv_px - origin))
    draw.ellipse((u - 9, v - 9, u + 9, v + 9), outline=_SPOT, width=2)
    corner = (0 if u > panel.width / 2 else panel.width - _INSET_PX, 0 if v > panel.height / 2 else -1)
    inset = _inset(image, found, spot, position)
    panel.paste(inset, (corner[0], panel.height - _INSET_PX if corner[1] < 0 else 0))
    font = ImageFont.load_default(_FONT_PX)
    text = f"{position}: ({spot.uv_px[0]:.2f}, {spot.uv_px[1]:.2f}) px, sigma {spot.sigma_px:.2f} px"
    draw.text((_GAP_PX, panel.height - _LINE_PX), text, (255, 255, 255), font, stroke_width=2, stroke_fill=(0, 0, 0))
    return panel


def _inset(image: NDArray[np.uint8], found: Measurement, spot: SeenSpot, position: str) -> Image.Image:
    """Pixels around a spot, enlarged, with its ellipse of two standard deviations."""
    u0, v0 = (round(float(x)) - _AROUND_PX for x in spot.uv_px)
    side = 2 * _AROUND_PX + 1
    scale = _INSET_PX / side
    near = _part(image, Box(u0, v0, side, side), (_INSET_PX, _INSET_PX), Image.Resampling.NEAREST)
    inset = ImageOps.autocontrast(near, cutoff=1, preserve_tone=True)
    draw, origin = ImageDraw.Draw(inset), np.array([u0, v0]) - 0.5
    if position == "up":
        curve = epipolar_curve(found.rig, found.stroke_m, found.down.uv_px[None])[0]
        _line(draw, scale * (curve - origin), _CURVE)
    turn = np.linspace(0.0, 2.0 * np.pi, 60)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    # two sigma: 86 % in two dimensions
    ellipse = spot.uv_px + 2.0 * (np.linalg.cholesky(spot.covariance_px2) @ circle).T
    _line(draw, scale * (ellipse - origin), _SPOT)
    u, v = (float(x) for x in scale * (spot.uv_px - origin))
    draw.line((u - 4, v, u + 4, v), fill=_SPOT)
    draw.line((u, v - 4, u, v + 4), fill=_SPOT)
    draw.rectangle((0, 0, _INSET_PX - 1, _INSET_PX - 1), outline=_SPOT)
    return inset


def _part(
    image: NDArray[np.uint8], box: Box, size: tuple[int, int], resampling: Image.Resampling = Image.Resampling.BILINEAR
) -> Image.Image:
    """Part of a picture, black outside of it, at another size."""
    corners = (box.u0_px, box.v0_px, box.u0_px + box.width_px, box.v0_px + box.height_px)
    return Image.fromarray(image).convert("RGB").crop(corners).resize(size, resampling)


def _line(draw: ImageDraw.ImageDraw, uv: Array, colour: tuple[int, int, int], closed: bool = False) -> None:
    points = [(float(u), float(v)) for u, v in uv if np.isfinite((u, v)).all()]
    if len(points) > 1:
        draw.line([*points, points[0]] if closed else points, fill=colour)
