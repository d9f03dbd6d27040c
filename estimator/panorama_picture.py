"""Panorama of a sample's view as a picture."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.errors import DatasetError
from phibench.datasets.preview import exposure_s, to_srgb
from phibench.datasets.read import Sample
from phibench.estimator.calibration.align import read_picture
from phibench.estimator.panorama import FAR_M, Grid, pixels_by_model, unrolled
from phibench.estimator.panorama_truth import pixels_by_truth, ray_directions
from phibench.scenes.frames import Array
from phibench.scenes.names import nearest
from phibench.scenes.rig import POSITIONS, View

LAYERS = "layers"
COLOUR_PRESETS = (LAYERS, "srgb8", "mjpeg")
By = Literal["model", "truth"]


@dataclass(frozen=True)
class Panorama:
    """A panorama.

    Attributes
    ----------
    pixels : uint8 array, shape (H, W, 3), sRGB; black where the image shows nothing of it
    seen : float
        Part of it that the image shows.
    """

    pixels: NDArray[np.uint8] = field(repr=False)
    seen: float


def panorama(
    sample: Sample, position: str, grid: Grid, by: By = "model", distance_m: float = FAR_M, image: Array | None = None
) -> Panorama:
    """Unroll a picture, shape (h, w, 3), uint8, or the noise-free view with the laser on."""
    picture = frame(sample, position) if image is None else image
    height, width = sample.nominal_rig.camera.height_px, sample.nominal_rig.camera.width_px
    if picture.shape[:2] != (height, width):
        raise DatasetError(
            f"the picture has {picture.shape[1]} x {picture.shape[0]} pixels, the rig's camera {width} x {height}: "
            "give a whole frame of this camera"
        )
    values = unrolled(picture, places(sample, position, grid, by, distance_m))
    seen = np.isfinite(values[..., 0])
    return Panorama(np.rint(np.where(seen[..., None], values, 0.0)).astype(np.uint8), float(seen.mean()))


def places(sample: Sample, position: str, grid: Grid, by: By = "model", distance_m: float = FAR_M) -> Array:
    """Image pixel of every grid point, shape (H, W, 2), by the nominal rig or by the truth layer of the true one."""
    if by == "model":
        return pixels_by_model(nominal_view(sample, position), grid, distance_m)
    if distance_m != FAR_M:
        raise DatasetError("a distance of the scene needs the model (--by model): the truth layer gives directions")
    return pixels_by_truth(ray_directions(sample, position), grid)


def nominal_view(sample: Sample, position: str) -> View:
    """View of the rig that is believed."""
    return sample.nominal_rig.at(0.0 if position == "down" else sample.row.nominal_stroke_m)


def frame(sample: Sample, position: str, preset: str = LAYERS) -> NDArray[Any]:
    """Colour picture of the view, laser on, shape (h, w, 3), uint8.

    Parameters
    ----------
    sample : Sample
    position : "down" or "up"
    preset : "layers" (noise-free), "srgb8" or "mjpeg"

    Raises
    ------
    DatasetError
        If there is no such position or colour picture.
    """
    if position not in POSITIONS:
        raise DatasetError(f"position '{position}': must be 'down' or 'up'")
    if preset not in COLOUR_PRESETS:
        raise DatasetError(f"no colour picture of preset '{preset}'; {nearest(preset, COLOUR_PRESETS)}")
    if preset == LAYERS:
        planes, detector = sample.frame(position), sample.rig.camera.detector
        return to_srgb(planes, detector, exposure_s(sample.ambient(position), detector))
    return np.asarray(sample.frame_source(preset).frame(position, 0, True).image)


def picture_of(sample: Sample, position: str, preset: str, file: Path | None) -> NDArray[Any]:
    """Picture to unroll: a file's, or a frame of the sample.

    Raises
    ------
    DatasetError
        As `frame`, and if the file is no colour picture.
    """
    return frame(sample, position, preset) if file is None else read_picture(file)[0]
