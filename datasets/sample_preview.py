"""Picture of a sample: down and up side by side at half size, laser on, the spot marked and enlarged in a corner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.preview import Picture, exposure_s, halved, to_srgb
from phibench.datasets.spot_picture import CROP_PX, MARK, SpotPlace, captioned, crop, enlarged, marked
from phibench.scenes.detector import Detector

_LARGEST_ZOOM = 6


@dataclass(frozen=True)
class Side:
    """One position of a sample: where its spot is, its frame and its ambient layer, shape (3, H, W), electrons/s."""

    position: str
    spot: SpotPlace
    frame: NDArray[np.float64]
    ambient: NDArray[np.float32]


def sample_picture(sides: Sequence[Side], detector: Detector) -> Picture:
    """Both positions side by side, exposed for the first."""
    exposure = exposure_s(halved(sides[0].ambient), detector)
    return np.concatenate([_picture(s.frame, s.position, s.spot, detector, exposure) for s in sides], axis=1)


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
