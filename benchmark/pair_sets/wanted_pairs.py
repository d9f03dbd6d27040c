"""Pairs to be scored, chosen by options (`PairChoice`) from a data set, frames or pictures; with a calibrated rig."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from phibench.benchmark.pair_sets.dataset_pairs import TASK_VERSION, DatasetPairs, Track, dataset_pairs
from phibench.benchmark.pair_sets.frames_set import FramesSet
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.pair_draws import FrameCounts
from phibench.datasets.frames.sensor_file import read_sensor_file
from phibench.datasets.read import Dataset, Sample, open_finished
from phibench.datasets.store.pair_files import is_frames_set, is_imported
from phibench.estimator.geometry.rig_parameters import stroke_of
from phibench.estimator.interface import Pair
from phibench.estimator.pair_set import PairSet, PairTruth, tell_answered, truth_folders

if TYPE_CHECKING:  # 25 modules of the calibration, which most scores do without
    from phibench.calibration.captures.imported_set import ImportedSet
    from phibench.calibration.rig.calibration_file import Calibration


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
    track : str, optional
        "localise" gives every pair boxes of its own, "find" and "depth" take all away.

    Raises
    ------
    DatasetError
        If a track is given together with boxes or without hints.
    """

    preset: str | None = None
    draws: int | None = None
    pairs: int | None = None
    hints: bool = True
    boxes_px: int | None = None
    calibration: str | Path | None = None
    sensor: str | Path | None = None
    frames: tuple[int, int] | None = None
    track: Track | None = None

    def __post_init__(self) -> None:
        if self.track is not None and not (self.hints and self.boxes_px is None):
            raise DatasetError(f"--track {self.track} says which boxes there are: leave --boxes and --no-hints out")


class ChoiceKeywords(TypedDict, total=False):
    """`PairChoice` as keywords of `score`."""

    draws: int | None
    pairs: int | None
    hints: bool
    boxes_px: int | None
    calibration: str | Path | None
    sensor: str | Path | None
    frames: tuple[int, int] | None
    track: Track | None


def open_scored(folder: str | Path) -> Dataset | ImportedSet | FramesSet:
    """Finished data set, a frames set, or a set of real pairs."""
    if is_frames_set(folder):
        return FramesSet(folder)
    if not is_imported(folder):
        return open_finished(folder)
    from phibench.calibration.captures.imported_set import open_imported

    return open_imported(folder)


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
        chosen = dataset.pairs(choice.preset, choice.draws, pairs=choice.pairs, hints=choice.hints)
        return chosen if choice.track is None else chosen.of_track(choice.track)
    if not isinstance(dataset, Dataset):
        if choice.track == "localise":
            raise DatasetError(f"{dataset.folder} holds pictures whose spots nobody has measured: leave --track out")
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
        return _of_track(dataset_pairs(dataset, *taken), choice)
    from phibench.calibration.rig.calibration_file import read_calibration

    read = read_calibration(choice.calibration)
    return CalibratedPairs(_of_track(dataset_pairs(samples_of_calibration(dataset, read), *taken), choice), read)


def _of_track(pairs: DatasetPairs, choice: PairChoice) -> DatasetPairs:
    return pairs if choice.track is None else pairs.of_track(choice.track)


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
    from phibench.calibration.captures.imported_set import imported_pairs
    from phibench.calibration.captures.spot_shape import with_shape
    from phibench.calibration.rig.calibration_file import read_calibration

    if choice.preset not in (None, imported.preset):
        raise DatasetError(f"{imported.folder} holds pictures of the kind '{imported.preset}': leave --preset out")
    pairs = imported_pairs(imported, TASK_VERSION, choice.draws, choice.pairs)
    if choice.calibration is None:
        return pairs
    return CalibratedPairs(pairs, with_shape(read_calibration(choice.calibration, imported.rig)))


class CalibratedPairs:
    """A pair set whose nominal rig and stroke are those of a calibration.

    Parameters
    ----------
    pairs : PairSet
        All of one true rig: see `samples_of_calibration`.
    """

    def __init__(self, pairs: PairSet, calibration: Calibration) -> None:
        self.pairs, self.calibration = pairs, calibration
        self.folders = truth_folders(pairs)
        self._covariance = np.array(calibration.covariance)
        self._covariance.flags.writeable = False

    def __len__(self) -> int:
        return len(self.pairs)

    def pair(self, number: int) -> Pair:
        """Images of a pair, with the calibrated rig and its covariance."""
        seen = self.pairs.pair(number)
        return replace(
            seen,
            rig=self.calibration.rig,
            stroke_m=self._stroke_m(seen.stroke_m),
            calibration_covariance=self._covariance,
        )

    def answered(self, number: int) -> bool:
        """Tell the set that all methods have answered a pair."""
        return tell_answered(self.pairs, number)

    def truth(self, number: int) -> PairTruth:
        """The exact answer."""
        truth = self.pairs.truth(number)
        nominal_m = truth.stroke_m if truth.nominal_stroke_m is None else truth.nominal_stroke_m
        return replace(
            truth,
            nominal_rig=self.calibration.rig,
            nominal_stroke_m=self._stroke_m(nominal_m),
            calibration_covariance=self._covariance,
        )

    def document(self) -> dict[str, Any]:
        """Provenance of the set, with the calibration's hash."""
        made_from = self.calibration.made_from
        return {**self.pairs.document(), "calibration": self.calibration.sha256, "calibrated_from": made_from}

    def _stroke_m(self, nominal_m: float) -> float:
        return float(stroke_of(np.array(nominal_m), self.calibration.values))


def samples_of_calibration(dataset: Dataset, calibration: Calibration) -> Dataset:
    """The samples of a data set that a calibration is for: those of the rig that it was made from.

    Raises
    ------
    CalibrationError
        If the nominal rig of a sample is not the one that the calibration started from, or the samples have several
        true rigs and the calibration was made from none of them.
    """
    from phibench.calibration.rig.calibration_file import CalibrationError

    for sample in dataset:
        if sample.nominal_rig != calibration.nominal:
            raise CalibrationError(
                f"the calibration did not start from the nominal rig of sample {sample.row.sample_id}; "
                "calibrate with samples of this data set"
            )
    rigs = {row.rig for row in dataset.rows}
    if len(rigs) == 1 and not _of_another(dataset, calibration):
        return dataset
    own = _samples_of_its_rig(dataset, calibration)
    if not own:
        raise CalibrationError(
            f"{dataset.folder} has {len(rigs)} true rig{'s' * (len(rigs) > 1)} and the calibration was made from none "
            "of them; calibrate with samples of this data set"
        )
    return replace(dataset, rows=tuple(sample.row for sample in own))


def _of_another(dataset: Dataset, calibration: Calibration) -> bool:
    """Tell whether the calibration names another data set as its source."""
    return calibration.made_from.get("dataset", dataset.info.name) != dataset.info.name


def _samples_of_its_rig(dataset: Dataset, calibration: Calibration) -> list[Sample]:
    if _of_another(dataset, calibration):
        return []
    made_from = set(calibration.made_from.get("samples", ()))
    rigs = {row.rig for row in dataset.rows if row.sample_id in made_from}
    return [sample for sample in dataset if sample.row.rig in rigs]
