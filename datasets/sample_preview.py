"""Picture of a sample: down and up side by side at half size, laser on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phibench.datasets import layout
from phibench.datasets.layers import read_ambient, read_spot
from phibench.datasets.plan import PairPlan
from phibench.datasets.preview import exposure_s, halved, save_png, to_srgb
from phibench.datasets.task import Made
from phibench.scenes.detector import Detector
from phibench.scenes.rig import POSITIONS


def make_preview(out: Path, pair: PairPlan, detector: Detector) -> Made:
    """Task: the picture of one sample, from its views and spot layers."""
    ambients = {
        position: read_ambient(out / layout.view_file(pair.pose_id(position), "ambient")) for position in POSITIONS
    }
    exposure = exposure_s(halved(ambients["down"]), detector)
    frames = [_with_spot(out, pair, position, ambients[position].astype(float)) for position in POSITIONS]
    pictures = [to_srgb(halved(frame), detector, exposure) for frame in frames]
    file = layout.preview_file(pair.sample_id)
    save_png(out / file, np.concatenate(pictures, axis=1))
    return Made((file,))


def _with_spot(out: Path, pair: PairPlan, position: str, image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Add the spot; its task has made sure that there is a file exactly if light reaches the image."""
    path = out / layout.spot_file(pair.sample_id, position)
    if path.is_file():
        read_spot(path).add_to(image)
    return image
