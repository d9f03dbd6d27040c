"""Picture of a sample: down and up side by side at half size, laser on, the spot marked and enlarged in a corner."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phibench.datasets import layout
from phibench.datasets.layers import read_ambient, read_spot
from phibench.datasets.plan import PairPlan
from phibench.datasets.preview import Picture, exposure_s, halved, save_png, to_srgb
from phibench.datasets.spot_picture import CROP_PX, MARK, SpotPlace, captioned, crop, enlarged, marked
from phibench.datasets.task import Made
from phibench.render.spot_truth import spot_truth
from phibench.scenes.detector import Detector
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import POSITIONS, Rig, Stroke
from phibench.scenes.room import Room

_LARGEST_ZOOM = 6


def make_preview(out: Path, pair: PairPlan, rig: Rig, room: Room, spot: LaserSpot) -> Made:
    """Task: the picture of one sample, from its views and spot layers."""
    detector = rig.camera.detector
    down = read_ambient(out / layout.view_file(pair.pose_id("down"), "ambient"))
    exposure, pictures = exposure_s(halved(down), detector), []
    for position in POSITIONS:
        view = rig.at(Stroke(pair.stroke_m).offset_m(position))
        place = spot_truth(view, spot, room.shapes(view))
        pictures.append(_picture(_frame(out, pair, position), position, place, detector, exposure))
    file = layout.preview_file(pair.sample_id)
    save_png(out / file, np.concatenate(pictures, axis=1))
    return Made((file,))


def _frame(out: Path, pair: PairPlan, position: str) -> NDArray[np.float64]:
    """Ambient layer and spot; the spot's task has made sure that there is a file exactly if light reaches the image."""
    image = read_ambient(out / layout.view_file(pair.pose_id(position), "ambient")).astype(float)
    path = out / layout.spot_file(pair.sample_id, position)
    if path.is_file():
        read_spot(path).add_to(image)
    return image


def _picture(
    frame: NDArray[np.float64], position: str, spot: SpotPlace, detector: Detector, exposure: float
) -> Picture:
    picture = marked(to_srgb(halved(frame), detector, exposure), spot, 2)
    if not spot.visible:
        return captioned(picture, f"{position}: not visible, {spot.cause}")
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
