"""What single frames of experiments give at best: the bound of D from the pixels alone, and what would improve it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import polars as pl

from phibench.datasets.errors import DatasetError
from phibench.datasets.frame_request import Exposure
from phibench.datasets.read import Dataset, Sample
from phibench.estimator.bench.dataset_pairs import DatasetPairs, pairs_of
from phibench.estimator.bench.truth import PairTruth
from phibench.estimator.depth_general import depth_general

_NO_MATRIX = np.full((2, 2), np.nan)


def spot_bounds(
    dataset: Dataset,
    preset: str,
    samples: Sequence[Sample] | None = None,
    laser_level: float = 1.0,
    exposure: Exposure = "auto",
) -> pl.DataFrame:
    """Bound of D from one frame per position, for a rig that is known exactly.

    Parameters
    ----------
    dataset : Dataset
    preset : str
    samples : of the data set; all by default
    laser_level : float
        Factor of the laser's light.
    exposure : float, "auto" or None
        Seconds; "auto" is the camera's for the room of the down image; None that of the preset.

    Returns
    -------
    polars.DataFrame
        sample_id, experiment, depth_m, stroke_m, exposure_s, bound_m (NaN where a spot has none), and relative, which
        is bound_m / depth_m.
    """
    pairs = _pairs(dataset, preset, dataset.samples if samples is None else samples, laser_level, exposure)
    rows = []
    for number, take in enumerate(pairs.takes):
        truth, card = pairs.truth(number), pairs.card(number)
        bound_m = _bound_m(truth)
        row = dataset[take.sample_id].row
        rows.append(
            {
                "sample_id": row.sample_id,
                "experiment": row.experiment,
                "depth_m": row.depth_m,
                "stroke_m": row.nominal_stroke_m,
                "exposure_s": card.exposure_s,
                "bound_m": bound_m,
                "relative": bound_m / row.depth_m,
            }
        )
    return pl.DataFrame(rows)


def frames_needed(bounds: pl.DataFrame, target: float) -> int:
    """Frames per position whose mean has a bound with an rms relative error of at most `target`: variances fall as 1/n.

    Raises
    ------
    DatasetError
        If no sample has a bound, or the target is not above 0.
    """
    relative = bounds["relative"].drop_nulls().drop_nans().to_numpy()
    if not len(relative) or not target > 0.0:
        raise DatasetError(f"{len(relative)} bounds and a target of {target:g}: both must be above 0")
    return int(np.ceil(np.mean(relative**2) / target**2))


def _pairs(
    dataset: Dataset, preset: str, samples: Sequence[Sample], laser_level: float, exposure: Exposure
) -> DatasetPairs:
    plain = pairs_of(dataset, samples, preset)
    asked = (replace(t.request, exposure=exposure, laser_level=laser_level) for t in plain.takes)
    return DatasetPairs(
        plain.dataset, tuple(replace(t, request=request) for t, request in zip(plain.takes, asked, strict=True))
    )


def _bound_m(truth: PairTruth) -> float:
    C1, C2 = (_NO_MATRIX if b is None else b for b in (truth.down.bound_px2, truth.up.bound_px2))
    down, up = (np.array(spot.uv_px) for spot in (truth.down, truth.up))
    return float(depth_general(truth.true_rig, truth.stroke_m, down, up, C1, C2).sigma_m)
