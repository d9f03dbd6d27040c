"""Experiments with misaligned rigs as a table: each rig is calibrated from its own frames, measures D, and is judged.

For every rig of a data set (recipe `paper-misaligned`, or any with experiments and calibration spots):

1. outlines of the mirror in the frames, one for each of some mirror poses, and the spots of the experiment
   "calibration", whose distances were measured with a ruler, give the rig with its covariance (`rig.bundle`);
2. every other pair gives D with its standard deviation and a 95 % interval from `joint_fit` with the calibrated rig;
   the calibration's part comes from `depth_general`, as all of it does where `joint_fit` has no depth;
3. beside it stands the bound: the pixels' bound of these frames on and off and the same calibration, at the true
   pixels.

One row per sample and draw. `experiment_bounds` makes the error budget of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import polars as pl

from phibench.benchmark.pair_sets.dataset_pairs import DatasetPairs
from phibench.benchmark.scores.intervals import NORMAL_95
from phibench.calibration.outline.outline_result import mean_outline
from phibench.calibration.rig.bundle import Bundle, calibrate
from phibench.calibration.rig.from_dataset import frame_outline, frame_spots
from phibench.calibration.rig.known_spots import Ruler, one_per_pose
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.exposures.pair_draws import FrameCounts
from phibench.datasets.read import Dataset, Sample
from phibench.estimator.drawn_pairs import pairs_of
from phibench.estimator.geometry.least_squares_depth import GeneralDepth, depth_general
from phibench.estimator.geometry.status import describe
from phibench.estimator.interface import OK, Answer, Pair
from phibench.estimator.methods.joint_fit import joint_of
from phibench.estimator.methods.registry import method_for
from phibench.estimator.pair_set import PairTruth
from phibench.scenes.rig import POSITIONS

CALIBRATION = "calibration"
"""Experiment of a recipe whose spots stand at known distances."""
LEAST_SPOTS = 2
"""Calibration spots without which a rig counts as not calibrated; those that are not found are left out."""
_NO_MATRIX = np.full((2, 2), np.nan)

COLUMNS: dict[str, str] = {
    "sample_id": "sample",
    "experiment": "experiment of the recipe",
    "rig": "id of the true rig",
    "draw": "draw of the noise",
    "depth_m": "D",
    "stroke_m": "nominal stroke, before calibration",
    "estimate_m": "D from the frames and the calibrated rig",
    "error_m": "estimate_m - depth_m",
    "relative_error": "error_m / depth_m",
    "sigma_m": "predicted standard deviation of estimate_m",
    "sigma_spot_m": "its part from the pixels",
    "sigma_calibration_m": "its part from the rig and the stroke",
    "bound_m": "standard deviation at the bound of the pixels, with this calibration",
    "bound_spot_m": "its part from the pixels",
    "bound_calibration_m": "its part from the rig and the stroke",
    "chi2": "of the two rays' meeting, one degree of freedom",
    "p_value": "probability of a larger chi2",
    "within_95": "whether D is in the 95 % interval",
    "nominal_error": "relative error with the nominal rig, before calibration, same pixels",
    "status": "ok, or why there is no estimate",
}

_WORDS, _COUNTS, _FLAGS = ("sample_id", "experiment", "rig", "status"), ("draw",), ("within_95",)
_SCHEMA = {
    name: pl.String if name in _WORDS else pl.Int64 if name in _COUNTS else pl.Boolean if name in _FLAGS else pl.Float64
    for name in COLUMNS
}


@dataclass(frozen=True)
class Procedure:
    """Settings of the experiments.

    Parameters
    ----------
    preset : str
        Of the sensor: "mjpeg", "bayer-raw", "srgb8" or "mono-raw".
    draws : int
        Draws of the noise per sample; the calibration takes draw 0 of its own samples.
    laser_off : bool
        Whether every frame has one with the laser off beside it.
    ruler : Ruler
        How the places of the calibration spots are measured.
    calibration : str
        Experiment with these spots.
    outlines : int
        Mirror poses whose outlines are taken, spread over those that there are; the room behind the limb differs.
    frames : FrameCounts
        Frames per position of the pairs that are measured, with the laser on and, with `laser_off`, off.
    """

    preset: str = "mjpeg"
    draws: int = 1
    laser_off: bool = True
    ruler: Ruler = field(default=Ruler())
    calibration: str = CALIBRATION
    outlines: int = 6
    frames: FrameCounts = field(default=FrameCounts())


Told = Callable[[str], None]


def run_experiments(
    dataset: Dataset, procedure: Procedure, rigs: Sequence[str] | None = None, told: Told = lambda what: None
) -> pl.DataFrame:
    """Calibrate every rig and make its experiments.

    Parameters
    ----------
    rigs : ids of true rigs; all of the data set by default
    told : called with the id of each rig when it is done

    Returns
    -------
    polars.DataFrame
        `COLUMNS`, one row per sample and draw, NaN where there is no estimate.

    Raises
    ------
    DatasetError
        If a rig is unknown, has no calibration spots, or cannot be calibrated.
    """
    rows: list[dict[str, Any]] = []
    for rig in _rigs(dataset, rigs):
        bundle = calibrate_rig(dataset, rig, procedure)
        measured = [s for s in _of_rig(dataset, rig) if s.row.experiment != procedure.calibration]
        rows += experiment_rows(dataset, measured, bundle, procedure)
        told(rig)
    return pl.DataFrame(rows, schema=_SCHEMA)


def calibrate_rig(dataset: Dataset, rig: str, procedure: Procedure) -> Bundle:
    """Calibration of one rig from its frames: outlines of some poses, and the calibration spots.

    Raises
    ------
    DatasetError
        If there are no calibration spots, or fewer than `LEAST_SPOTS` were found.
    """
    samples = _of_rig(dataset, rig)
    known = [sample for sample in samples if sample.row.experiment == procedure.calibration]
    if not known:
        raise DatasetError(
            f"{dataset.folder}: rig {rig} has no experiment '{procedure.calibration}' whose spots stand at known "
            "distances; make the recipe paper-misaligned, or add such an experiment to yours"
        )
    preset, off = procedure.preset, procedure.laser_off
    poses = one_per_pose(samples)
    # poses spread evenly over the strokes: their outlines share neither lamps nor JPEG blocks
    chosen = sorted({round(place) for place in np.linspace(0, len(poses) - 1, max(procedure.outlines, 1))})
    outlines = [frame_outline(dataset, s, p, preset, off) for s, p in (poses[place] for place in chosen)]
    spots = frame_spots(dataset, known, preset, procedure.ruler, off, LEAST_SPOTS)
    return calibrate(known[0].nominal_rig, mean_outline(outlines), spots)


def experiment_rows(
    dataset: Dataset, samples: Sequence[Sample], bundle: Bundle, procedure: Procedure
) -> list[dict[str, Any]]:
    """Rows of `COLUMNS` for samples of one rig, by its calibration."""
    pairs, rows = _pairs(dataset, samples, procedure, procedure.draws), []
    for number, pair_draw in enumerate(pairs.pair_draws):
        sample, seen, truth = dataset[pair_draw.sample_id], pairs.pair(number), pairs.truth(number)
        pair = replace(seen, rig=bundle.rig, stroke_m=float(bundle.stroke(np.array(seen.stroke_m))))
        separate = method_for(pair.card)(pair)  # may use the calibrated rig, never the truth
        rows.append(
            {
                "sample_id": pair_draw.sample_id,
                "experiment": sample.row.experiment,
                "rig": sample.row.rig,
                "draw": pair_draw.draw,
                "depth_m": truth.depth_m,
                "stroke_m": sample.row.nominal_stroke_m,
                **_estimate(pair, separate, bundle, truth.depth_m),
                **_bound(truth, bundle),
                "nominal_error": _nominal(seen, separate) / truth.depth_m - 1.0,
            }
        )
    return [{name: row[name] for name in COLUMNS} for row in rows]


def _estimate(pair: Pair, separate: Answer, bundle: Bundle, depth_m: float) -> dict[str, Any]:
    depth, joint = _depth_of(pair, separate, bundle), joint_of(pair, separate)
    fault = _answer_fault(separate)
    calibration_m = float(np.hypot(depth.sigma_calibration_m, depth.sigma_stroke_m))
    here_m, spot_m, interval_m = float(depth.depth_m), float(depth.sigma_spot_m), joint.interval_depth_m
    if joint.depth_m is not None and joint.sigma_depth_m is not None:
        here_m, spot_m = joint.depth_m, joint.sigma_depth_m
    low_m, high_m = interval_m or (here_m - NORMAL_95 * spot_m, here_m + NORMAL_95 * spot_m)
    # the calibration widens both sides of an interval that need not be even
    below, above = (np.hypot(x, NORMAL_95 * calibration_m) for x in (here_m - low_m, high_m - here_m))
    error = here_m - depth_m
    return {
        "estimate_m": here_m,
        "error_m": error,
        "relative_error": error / depth_m,
        "sigma_m": float(np.hypot(spot_m, calibration_m)),
        "sigma_spot_m": spot_m,
        "sigma_calibration_m": calibration_m,
        "chi2": float(depth.chi2),
        "p_value": float(depth.p_value),
        "within_95": bool(-above <= error <= below),
        "status": fault or describe(int(depth.status)),
    }


def _answer_fault(answer: Answer) -> str:
    """Reason for which an answer gives no depth with a standard deviation; empty if it gives one."""
    for position in POSITIONS:
        spot = getattr(answer, position)
        if spot.status != OK or spot.uv_px is None:
            return f"{position}: {spot.status}"
        if spot.covariance_px2 is None:
            return f"{position}: a place without covariance"
    return ""


def _depth_of(pair: Pair, answer: Answer, bundle: Bundle | None) -> GeneralDepth:
    down, up = (np.array(getattr(answer, p).uv_px or (np.nan, np.nan)) for p in POSITIONS)
    claims = [getattr(answer, p).covariance_px2 for p in POSITIONS]
    C1, C2 = (_NO_MATRIX if claim is None else np.array(claim) for claim in claims)
    covariance = None if bundle is None else bundle.covariance
    return depth_general(pair.rig, pair.stroke_m, down, up, C1, C2, covariance)


def _nominal(seen: Pair, answer: Answer) -> float:
    return float(_depth_of(seen, answer, None).depth_m)


def _bound(truth: PairTruth, bundle: Bundle) -> dict[str, float]:
    """Bound at the true pixels of the true rig, with the calibration's covariance."""
    C1, C2 = (_NO_MATRIX if b is None else b for b in (truth.down.bound_px2, truth.up.bound_px2))
    down, up = (np.array(spot.uv_px) for spot in (truth.down, truth.up))
    # the calibration's covariance is that of the fitted rig: gradients at the true rig differ in second order
    at = depth_general(truth.true_rig, truth.stroke_m, down, up, C1, C2, bundle.covariance)
    return {
        "bound_m": float(at.sigma_m),
        "bound_spot_m": float(at.sigma_spot_m),
        "bound_calibration_m": float(np.hypot(at.sigma_calibration_m, at.sigma_stroke_m)),
    }


def _pairs(dataset: Dataset, samples: Sequence[Sample], procedure: Procedure, draws: int = 1) -> DatasetPairs:
    drawn = pairs_of(dataset, samples, procedure.preset, draws, procedure.laser_off, procedure.frames)
    return DatasetPairs(drawn.dataset, drawn.pair_draws, count_frames=True)


def _of_rig(dataset: Dataset, rig: str) -> list[Sample]:
    return [sample for sample in dataset if sample.row.rig == rig]


def _rigs(dataset: Dataset, wanted: Sequence[str] | None) -> list[str]:
    known = list(dict.fromkeys(row.rig for row in dataset.rows))
    if strange := [name for name in wanted or () if name not in known]:
        raise DatasetError(f"{dataset.folder}: no sample has the rig '{strange[0]}'; known: {', '.join(known)}")
    return known if wanted is None else list(wanted)
