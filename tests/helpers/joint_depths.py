"""Depths of `joint_fit` over its bound, on pairs of a sample with the exact rig, auto exposure. Not a test file.

`python tests/helpers/joint_depths.py FOLDER PRESET DRAWS SAMPLE ...` prints a line for each sample of a data set. The
bound is that of one frame on and one off, `spot_bounds(..., frames=FrameCounts(1, 1))`.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from phibench.datasets.read import Dataset, Sample, open_dataset
from phibench.estimator.benchmark.dataset_pairs import DatasetPairs
from phibench.estimator.draw_pairs import pairs_of
from phibench.estimator.geometry.combine import combine
from phibench.estimator.limits.off_frame_bound import FrameCounts
from phibench.estimator.methods.chain_fit import chain_fit
from phibench.estimator.methods.raw_likelihood import joint_of
from phibench.estimator.paper.experiment_bounds import spot_bounds

_NORMAL_95 = 1.959964


def depths(dataset: Dataset, sample: Sample, preset: str, draws: int) -> np.ndarray:
    """Error of the two fits combined, error of `joint_fit`, its sigma; metres, shape (answered draws, 3)."""
    drawn = pairs_of(dataset, [sample], preset, draws, True)
    auto = tuple(replace(one, request=replace(one.request, exposure="auto")) for one in drawn.pair_draws)
    pairs, rows = DatasetPairs(drawn.dataset, auto), []
    for number in range(draws):
        pair = pairs.pair(number)
        separate = chain_fit(pair)
        joint = joint_of(pair, separate)
        spots = (separate.down, separate.up)
        if joint.depth_m is None or joint.sigma_depth_m is None or any(spot.uv_px is None for spot in spots):
            continue
        (uv1, C1), (uv2, C2) = ((np.array(spot.uv_px), np.array(spot.covariance_px2)) for spot in spots)
        both = combine(pair.rig, pair.stroke_m, uv1, C1, uv2, C2)
        rows.append((float(both.depth_m) - sample.row.depth_m, joint.depth_m - sample.row.depth_m, joint.sigma_depth_m))
    return np.array(rows).reshape(-1, 3)


def line(dataset: Dataset, name: str, preset: str, draws: int) -> str:
    """Figures of one sample."""
    sample = dataset[name]
    bound = float(spot_bounds(dataset, preset, [sample], frames=FrameCounts(1, 1))["bound_m"][0])
    combined, joint, sigma = depths(dataset, sample, preset, draws).T
    rms, count = (lambda x: float(np.sqrt(np.mean(np.square(x))))), len(joint)
    within = int(np.count_nonzero(np.abs(joint) < _NORMAL_95 * sigma))
    return (
        f"{name}: {count} of {draws} answered; rms over bound {rms(joint) / bound:.2f} +- {0.71 / count**0.5:.2f} of "
        f"itself, the two fits combined {rms(combined) / bound:.2f}; pull {rms(joint / sigma):.2f}; within 1.96 sigma "
        f"{within}"
    )


if __name__ == "__main__":
    folder, kind, count, *names = sys.argv[1:]
    opened = open_dataset(Path(folder))
    for one in names:
        print(line(opened, one, kind, int(count)), flush=True)
