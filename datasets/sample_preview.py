"""Picture of a sample: down and up side by side at half size, laser on."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from phibench.datasets import layout
from phibench.datasets.preview import exposure_s, halved, save_png, to_srgb
from phibench.datasets.read import open_dataset
from phibench.scenes.rig import POSITIONS


def write_preview(folder: Path, sample_id: str) -> str:
    """Write the picture of one sample; return the sample's id."""
    dataset = open_dataset(folder)
    sample, detector = dataset[sample_id], dataset.rig.camera.detector
    frames = [halved(sample.frame(position)) for position in POSITIONS]
    exposure = exposure_s(halved(sample.ambient("down")), detector)
    pictures = [to_srgb(frame, detector, exposure) for frame in frames]
    save_png(folder / layout.preview_file(sample_id), np.concatenate(pictures, axis=1))
    return sample_id
