"""Drawing of docs/epipolar.jpg, the paper's Figure 1. Run `python docs/draw_epipolar.py DATASET SAMPLE`.

The picture is rendered, the lines are computed: a line is the image, at the up position, of all points that one pixel
of the down position can show, from 0.3 to 12 m away.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from phibench.datasets.read import Sample, open_dataset
from phibench.estimator.geometry.panorama import PanoramaGrid, nominal_view, panorama, view_picture
from phibench.estimator.geometry.reflection import reflect
from phibench.estimator.spots.detect import epipolar_curve, mirror_box
from phibench.scenes.frames import Array

LINES, SIDE, GAP, FONT = 12, 560, 10, 18
GRID = PanoramaGrid(860, math.radians(-75.0), math.radians(35.0))
COLOURS = {"down": (80, 190, 255), "up": (255, 220, 60), "line": (255, 130, 60)}


def down_pixels(sample: Sample) -> Array:
    """Pixels of the down position, shape (LINES, 2): the spot's, and others at equal angles from it."""
    rig = sample.nominal_rig
    centre = rig.camera.project(rig.sphere_in_camera_m)
    spot = np.array([sample.row.down.u_px, sample.row.down.v_px]) - centre
    turn = 2.0 * np.pi * np.arange(LINES) / LINES
    c, s = np.cos(turn), np.sin(turn)
    return centre + np.stack([c * spot[0] - s * spot[1], s * spot[0] + c * spot[1]], axis=-1)


def mirror_panel(sample: Sample, curves: Array, down_px: Array) -> Image.Image:
    """Image of the up position with the lines, the down pixels that they belong to, and the spot."""
    box = mirror_box(sample.nominal_rig)
    origin, scale = np.array([box.u0_px, box.v0_px]) - 0.5, SIDE / max(box.width_px, box.height_px)
    part = view_picture(sample, "up")[box.v0_px : box.v0_px + box.height_px, box.u0_px : box.u0_px + box.width_px]
    image = Image.fromarray(part).resize((SIDE, round(scale * box.height_px)), Image.Resampling.LANCZOS)
    pen = ImageDraw.Draw(image)
    for curve, pixel in zip(scale * (curves - origin), scale * (down_px - origin), strict=True):
        draw_line(pen, curve)
        ring(pen, pixel, COLOURS["down"], 4)
    spot = np.array([sample.row.up.u_px, sample.row.up.v_px])
    ring(pen, scale * (spot - origin), COLOURS["up"], 8)
    return image


def panorama_panel(sample: Sample, position: str, pixels: Array) -> Image.Image:
    """Panorama of one position; a line over its whole height in the column of each pixel's direction."""
    image = Image.fromarray(panorama(sample, position, GRID).pixels)
    pen = ImageDraw.Draw(image)
    for x, _ in places(sample, position, pixels):
        pen.line([(x, 0), (x, image.height)], fill=COLOURS["line"], width=1)
    row = sample.row.position(position)
    ring(pen, places(sample, position, np.array([[row.u_px, row.v_px]]))[0], COLOURS[position], 8)
    return image


def places(sample: Sample, position: str, uv_px: Array) -> Array:
    """Column and row of pixels in the panorama."""
    return GRID.place(reflect(nominal_view(sample, position), uv_px).direction_world)


def draw_line(pen: ImageDraw.ImageDraw, points: Array) -> None:
    """Line through points; those that the image does not show are left out."""
    pen.line([tuple(point) for point in points[np.isfinite(points).all(axis=-1)]], fill=COLOURS["line"], width=2)


def ring(pen: ImageDraw.ImageDraw, at: Array, colour: tuple[int, int, int], radius: int) -> None:
    """Circle around a place."""
    x, y = map(float, at)
    pen.ellipse((x - radius, y - radius, x + radius, y + radius), outline=colour, width=2)


def draw(sample: Sample) -> Image.Image:
    """Figure 1: (a) the omnidirectional image, (b) the panoramas of both positions."""
    down_px = down_pixels(sample)
    curves = epipolar_curve(sample.nominal_rig, sample.row.nominal_stroke_m, down_px)
    left = mirror_panel(sample, curves, down_px)
    panels = [panorama_panel(sample, position, down_px) for position in ("down", "up")]
    words = (FONT + GAP) * 2
    height = max(left.height, sum(panel.height for panel in panels) + GAP) + words
    whole = Image.new("RGB", (SIDE + GAP + GRID.width_px, height), "white")
    whole.paste(left, (0, 0))
    for k, panel in enumerate(panels):
        whole.paste(panel, (SIDE + GAP, k * (panel.height + GAP)))
    pen, font = ImageDraw.Draw(whole), ImageFont.load_default(FONT)
    top = height - words + GAP // 2
    for x, title in (
        (0, "(a) omnidirectional image: lines are radial"),
        (SIDE + GAP, "(b) panoramas, position 1 above position 2: lines are columns"),
    ):
        pen.text((x, top), title, "black", font)
    spots = (("spot at position 1, and other pixels of it", "down"), ("spot at position 2", "up"))
    x = 0.0
    for text, position in spots:
        ring(pen, np.array([x + 8, top + FONT + GAP + 10]), COLOURS[position], 7)
        pen.text((x + 22, top + FONT + GAP), text, "black", font)
        x += 22 + font.getlength(text) + 3 * GAP
    return whole


def main() -> None:
    """Write the picture beside this file."""
    folder, sample_id = sys.argv[1:]
    draw(open_dataset(folder)[sample_id]).save(
        Path(__file__).with_name("epipolar.jpg"), quality=78, optimize=True, progressive=True
    )


if __name__ == "__main__":
    main()
