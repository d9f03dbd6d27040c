"""Pairs that are scored: of a data set, of a frames set or of real pictures, as options choose them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

from phibench.benchmark.pair_sets.dataset_pairs import TASK_VERSION, CalibratedPairs, dataset_pairs, of_calibration
from phibench.benchmark.pair_sets.frames_set import FramesSet
from phibench.calibration.captures.imported_set import ImportedSet, imported_pairs, is_imported, open_imported
from phibench.calibration.captures.spot_shape import with_shape
from phibench.calibration.rig.file import read_calibration
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.pair_draws import FrameCounts
from phibench.datasets.frames.sensor_file import read_sensor_file
from phibench.datasets.read import Dataset, open_finished
from phibench.datasets.store.pair_files import is_frames_set
from phibench.estimator.pair_set import PairSet


@dataclass(frozen=True)
class PairChoice:
    """Pairs that are taken, and what is shown with them.

    Attributes
    ----------
    preset : str, optional
        Preset of the sensor; by default those of the recipe's `[frames]`.
    draws, pairs, hints, boxes_px
        As for `dataset_pairs`.
    calibration : path, optional
        File of `phibench calibrate`: its rig's pairs, with calibrated rig, stroke and covariance.
    sensor : path, optional
        Sensor file, whose numbers go before the recipe's and the preset's.
    frames : (on, off), optional
        Frames of each position with the laser on and off.
    """

    preset: str | None = None
    draws: int | None = None
    pairs: int | None = None
    hints: bool = True
    boxes_px: int | None = None
    calibration: str | Path | None = None
    sensor: str | Path | None = None
    frames: tuple[int, int] | None = None


class ChoiceKeywords(TypedDict, total=False):
    """`PairChoice` as keywords of `score`."""

    draws: int | None
    pairs: int | None
    hints: bool
    boxes_px: int | None
    calibration: str | Path | None
    sensor: str | Path | None
    frames: tuple[int, int] | None


def open_scored(folder: str | Path) -> Dataset | ImportedSet | FramesSet:
    """Finished data set, a frames set, or a set of real pairs."""
    if is_frames_set(folder):
        return FramesSet(folder)
    return open_imported(folder) if is_imported(folder) else open_finished(folder)


def wanted_pairs(dataset: Dataset | ImportedSet | FramesSet, choice: PairChoice) -> PairSet:
    """Pairs as of `dataset_pairs`; with a calibration file its rig's, with calibrated rig, stroke and covariance.

    Raises
    ------
    DatasetError
        As `dataset_pairs`, or if the calibration cannot be read or is that of another rig.
    """
    if isinstance(dataset, FramesSet):
        if any(option is not None for option in (choice.calibration, choice.boxes_px, choice.sensor, choice.frames)):
            raise DatasetError(
                f"{dataset.folder} holds frames that are drawn: leave --calibration, --boxes, --sensor and --frames "
                "out, or score the data set that it comes from"
            )
        return dataset.pairs(choice.preset, choice.draws, pairs=choice.pairs, hints=choice.hints)
    if isinstance(dataset, ImportedSet):
        if any(option is not None for option in (choice.boxes_px, choice.sensor, choice.frames)):
            raise DatasetError(
                f"{dataset.folder} holds pictures: their boxes are not known, and sensor and frames are those of the "
                "import; leave --boxes, --sensor and --frames out"
            )
        return _real_pairs(dataset, choice)
    camera = None if choice.sensor is None else read_sensor_file(choice.sensor)
    counts = None if choice.frames is None else frame_counts(*choice.frames)
    taken = (choice.preset, choice.draws, choice.pairs, choice.hints, choice.boxes_px, camera, counts)
    if choice.calibration is None:
        return dataset_pairs(dataset, *taken)
    read = read_calibration(choice.calibration)
    return CalibratedPairs(dataset_pairs(of_calibration(dataset, read), *taken), read)


MOST_FRAMES = 100
"""Frames of a position: an image and the single frames are held at a time."""


def frame_counts(on: int, off: int) -> FrameCounts:
    """Frames of each position with the laser on and off.

    Raises
    ------
    DatasetError
        If there are too few or too many.
    """
    if not (1 <= on <= MOST_FRAMES and 1 <= off <= MOST_FRAMES):
        raise DatasetError(
            f"--frames {on} {off}: give the frames of a position with the laser on and off, 1 to {MOST_FRAMES} each, "
            "such as --frames 6 6"
        )
    return FrameCounts(on, off)


def _real_pairs(imported: ImportedSet, choice: PairChoice) -> PairSet:
    if choice.preset not in (None, imported.preset):
        raise DatasetError(f"{imported.folder} holds pictures of the kind '{imported.preset}': leave --preset out")
    pairs = imported_pairs(imported, TASK_VERSION, choice.draws, choice.pairs)
    if choice.calibration is None:
        return pairs
    return CalibratedPairs(pairs, with_shape(read_calibration(choice.calibration, imported.rig)))
