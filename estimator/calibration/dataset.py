"""A calibration from the images of a data set: outlines, and if wanted the spots at their known distances."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from phibench.datasets.errors import DatasetError
from phibench.datasets.read import Dataset, Sample, open_dataset
from phibench.datasets.sensor_card import sensor_card
from phibench.estimator.calibration.bundle import Bundle, KnownSpot, Measured, calibrate
from phibench.estimator.calibration.file import write_calibration
from phibench.estimator.calibration.outline import Outline, find_outline
from phibench.estimator.centroid import find_spot
from phibench.estimator.status import Status, describe
from phibench.scenes.rig import POSITIONS, Rig

LAYERS = "layers"
SPOT_SIGMA_PX = 0.02
DISTANCE_SIGMA_M = 1e-3


def calibrate_dataset(
    folder: Path, out: Path, samples: Sequence[str] = (), preset: str = LAYERS, spots: bool = False
) -> Bundle:
    """Calibrate the rig of some samples and write the file.

    Parameters
    ----------
    folder : Path
        Data set; its rig is what is believed.
    out : Path
    samples : ids; the first of the data set by default
    preset : str
        "layers" for the noise-free layers, or a preset of the sensor whose frames are drawn.
    spots : bool
        Also use the samples' laser spots, with their D as if measured to 1 mm. Noise-free layers only.

    Raises
    ------
    DatasetError
        If the samples have different rigs, an image has no whole mirror, or a spot is not found.
    """
    dataset = open_dataset(folder)
    chosen = [dataset[name] for name in samples] or [dataset.samples[0]]
    rig = _one_rig(chosen)
    if spots and preset != LAYERS:
        raise DatasetError(f"--spots with preset '{preset}': spots are found in noise-free layers only; leave one out")
    outlines = [_outline(sample, position, preset) for sample in chosen for position in POSITIONS]
    known = [_known(sample) for sample in chosen] if spots else []
    bundle = calibrate(rig, mean_outline(outlines), known)
    write_calibration(out, bundle, rig, _made_from(dataset, chosen, preset, outlines, spots))
    return bundle


def mean_outline(outlines: Sequence[Outline]) -> Measured:
    """Weighted mean of sphere centres; their scatter widens the covariance where it is larger than they claim."""
    weights = np.array([np.linalg.inv(outline.covariance_m2) for outline in outlines])
    covariance = np.linalg.inv(weights.sum(axis=0))
    centres = np.array([outline.sphere_in_camera_m for outline in outlines])
    mean = covariance @ np.einsum("kij,kj->i", weights, centres)
    off = centres - mean
    degrees = 3 * (len(outlines) - 1)
    chi2 = float(np.einsum("ki,kij,kj->", off, weights, off))
    return Measured(mean, covariance * max(1.0, chi2 / degrees if degrees else 1.0))


def _one_rig(samples: Sequence[Sample]) -> Rig:
    """The rig that is believed in; all samples must have one true rig."""
    names = sorted({sample.row.rig for sample in samples})
    if len(names) != 1:
        raise DatasetError(f"the samples have {len(names)} rigs ({', '.join(names[:4])}, ...): calibrate one at a time")
    return samples[0].nominal_rig


def _outline(sample: Sample, position: str, preset: str) -> Outline:
    if preset == LAYERS:
        return find_outline(sample.ambient(position), sample.nominal_rig)
    frame = sample.frame_source(preset).frame(position, 0, False)
    return find_outline(frame.image, sample.nominal_rig, sensor_card(preset))


def _known(sample: Sample) -> KnownSpot:
    found = {p: find_spot(sample.frame(p, laser=True), sample.frame(p, laser=False)) for p in POSITIONS}
    for position, spot in found.items():
        if spot.status is not Status.OK:
            raise DatasetError(f"{sample.row.sample_id} {position}: no spot to calibrate with: {describe(spot.status)}")
    C = SPOT_SIGMA_PX**2 * np.eye(2)
    depth = sample.row.depth_m
    return KnownSpot(
        found["down"].uv_px, found["up"].uv_px, C, C, sample.row.nominal_stroke_m, depth, depth_sigma_m=DISTANCE_SIGMA_M
    )


def _made_from(
    dataset: Dataset, samples: Sequence[Sample], preset: str, outlines: Sequence[Outline], spots: bool
) -> dict[str, Any]:
    return {
        "dataset": dataset.info.name,
        "samples": [sample.row.sample_id for sample in samples],
        "preset": preset,
        "spots": spots,
        "sphere_in_camera_m": [outline.sphere_in_camera_m.tolist() for outline in outlines],
        "sigma_m": [outline.sigma_m.tolist() for outline in outlines],
    }
