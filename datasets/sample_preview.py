"""Picture of a sample: down and up side by side at half size, laser on, the spot marked and enlarged in a corner."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from phibench.datasets import layout
from phibench.datasets.preview import Picture, exposure_s, halved, save_png, to_srgb
from phibench.datasets.read import Sample, open_dataset
from phibench.datasets.schema import SpotRow
from phibench.datasets.spot_picture import CROP_PX, MARK, captioned, crop, enlarged, marked
from phibench.scenes.rig import POSITIONS

_LARGEST_ZOOM = 6


def write_preview(folder: Path, sample_id: str) -> str:
    """Write the picture of one sample; return the sample's id."""
    sample = open_dataset(folder)[sample_id]
    pictures = [_picture(sample, position) for position in POSITIONS]
    save_png(folder / layout.preview_file(sample_id), np.concatenate(pictures, axis=1))
    return sample_id


def _picture(sample: Sample, position: str) -> Picture:
    detector, spot = sample.dataset.rig.camera.detector, sample.truth_row(position)
    frame, exposure = sample.frame(position), exposure_s(halved(sample.ambient("down")), detector)
    picture = marked(to_srgb(halved(frame), detector, exposure), spot, 2)
    if not spot.visible:
        return captioned(picture, f"{position}: not visible, {spot.cause}")
    window = crop(frame, spot)
    peak = float(window[1].max(initial=1.0))
    zoom = min(max(min(picture.shape[:2]) // 3 // CROP_PX, 1), _LARGEST_ZOOM)
    return _with_inset(picture, enlarged(to_srgb(window, detector, min(exposure, 1.0 / peak)), spot, zoom), spot)


def _with_inset(picture: Picture, inset: Picture, spot: SpotRow) -> Picture:
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
