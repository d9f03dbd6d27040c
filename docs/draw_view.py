"""Drawing of docs/view.jpg: a view, its spot enlarged. Run `python docs/draw_view.py DATASET SAMPLE`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from phibench.datasets.read import Sample, open_dataset
from phibench.datasets.store.pictures import display_exposure_s, to_srgb

_HALF, _ZOOM, _POSITION = 14, 12, "down"  # enlarged part, in image pixels either side


def draw(sample: Sample) -> Image.Image:
    """Full frame, with the part around the spot's true position enlarged in the lower left corner."""
    frame = sample.expected_image(_POSITION, laser=True)
    detector = sample.rig.camera.detector
    picture = to_srgb(frame, detector, display_exposure_s(sample.ambient(_POSITION), detector))
    row = sample.row.position(_POSITION)
    u, v = round(row.u_px), round(row.v_px)
    crop = np.s_[v - _HALF : v + _HALF + 1, u - _HALF : u + _HALF + 1]
    size = (2 * _HALF + 1) * _ZOOM
    enlarged = Image.fromarray(picture[crop]).resize((size, size), Image.Resampling.NEAREST)
    pen = ImageDraw.Draw(enlarged)
    x, y = (_ZOOM * (value - whole + _HALF + 0.5) for value, whole in ((row.u_px, u), (row.v_px, v)))
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):  # the truth, open in the middle
        pen.line([(x + 30 * dx, y + 30 * dy), (x + 90 * dx, y + 90 * dy)], fill="white", width=2)
    pen.rectangle([0, 0, size - 1, size - 1], outline="white", width=2)
    image = Image.fromarray(picture)
    ImageDraw.Draw(image).rectangle([u - _HALF, v - _HALF, u + _HALF, v + _HALF], outline="white")
    image.paste(enlarged, (0, image.height - size))
    return image


def main() -> None:
    """Write the picture beside this file."""
    folder, sample_id = sys.argv[1:]
    image = draw(open_dataset(folder)[sample_id]).resize((960, 540), Image.Resampling.LANCZOS)
    image.save(Path(__file__).with_name("view.jpg"), quality=72, optimize=True)


if __name__ == "__main__":
    main()
