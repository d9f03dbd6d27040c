"""Pairs of a data set as somebody sees them who has calibrated the rig: rig, stroke and their covariance."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from phibench.datasets.read import Dataset, Sample
from phibench.estimator.bench.pair_set import PairSet
from phibench.estimator.bench.truth import PairTruth
from phibench.estimator.calibration.file import Calibration, CalibrationError
from phibench.estimator.calibration.parameters import stroke_of
from phibench.estimator.seat.pair import Pair


class CalibratedPairs:
    """A pair set whose believed rig and stroke are those of a calibration.

    Parameters
    ----------
    pairs : PairSet
        All of one true rig: see `of_calibration`.
    calibration : Calibration
    """

    def __init__(self, pairs: PairSet, calibration: Calibration) -> None:
        self._pairs, self._calibration = pairs, calibration
        self._covariance = np.array(calibration.covariance)
        self._covariance.flags.writeable = False

    def __len__(self) -> int:
        return len(self._pairs)

    def pair(self, number: int) -> Pair:
        """What a method sees."""
        seen = self._pairs.pair(number)
        return replace(
            seen,
            rig=self._calibration.rig,
            stroke_m=self._stroke_m(seen.stroke_m),
            calibration_covariance=self._covariance,
        )

    def truth(self, number: int) -> PairTruth:
        """The exact answer."""
        truth = self._pairs.truth(number)
        believed_m = truth.stroke_m if truth.believed_stroke_m is None else truth.believed_stroke_m
        return replace(
            truth,
            believed_rig=self._calibration.rig,
            believed_stroke_m=self._stroke_m(believed_m),
            calibration_covariance=self._covariance,
        )

    def document(self) -> dict[str, Any]:
        """Provenance of the set, with the calibration's hash."""
        made_from = self._calibration.made_from
        return {**self._pairs.document(), "calibration": self._calibration.sha256, "calibrated_from": made_from}

    def _stroke_m(self, nominal_m: float) -> float:
        return float(stroke_of(np.array(nominal_m), self._calibration.values))


def of_calibration(dataset: Dataset, calibration: Calibration) -> Dataset:
    """The samples of a data set that a calibration is for: those of the rig that it was made from.

    Raises
    ------
    CalibrationError
        If a sample believes in another rig than the calibration started from, or the samples have several true rigs
        and the calibration was made from none of them.
    """
    for sample in dataset:
        if sample.nominal_rig != calibration.believed:
            raise CalibrationError(
                f"the calibration is that of another rig than the one that sample {sample.row.sample_id} believes in; "
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
    """Whether the calibration says that it was made from another data set."""
    return calibration.made_from.get("dataset", dataset.info.name) != dataset.info.name


def _samples_of_its_rig(dataset: Dataset, calibration: Calibration) -> list[Sample]:
    if _of_another(dataset, calibration):
        return []
    made_from = set(calibration.made_from.get("samples", ()))
    rigs = {row.rig for row in dataset.rows if row.sample_id in made_from}
    return [sample for sample in dataset if sample.row.rig in rigs]
