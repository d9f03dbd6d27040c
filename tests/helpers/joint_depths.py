"""Depths of `joint_fit` over its bound, on pairs of a data set with the exact rig, auto exposure. Not a test file.

`python tests/helpers/joint_depths.py FOLDER PRESET DRAWS ON OFF [SAMPLE ...]` draws pairs of ON frames with the laser
and OFF frames without it per position. It prints a line for each sample, all of them by default, and one for all. The
bound is `spot_bounds(..., frames=FrameCounts(ON, OFF))`. DRAWS may be FIRST:LAST. Only the part of the images with both
spots is simulated, and the camera is cut to it: the same pixels in a tenth of the time.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from phibench.datasets.exposures.pair_draws import FrameCounts
from phibench.datasets.read import Dataset, Sample, open_dataset
from phibench.estimator.drawn_pairs import DrawnPairs, pairs_of
from phibench.estimator.geometry.least_squares_depth import combine
from phibench.estimator.interface import Answer, Pair
from phibench.estimator.methods.chain_fit import chain_fit
from phibench.estimator.methods.joint_fit import joint_of
from phibench.estimator.methods.raw_likelihood import raw_maximum_likelihood
from phibench.estimator.methods.spot_search import each_spot_twice
from phibench.render.sensor.light import Region
from phibench.studies.paper.experiment_bounds import spot_bounds

_AROUND_PX = 64
_NORMAL_95 = 1.959964
_each = each_spot_twice(raw_maximum_likelihood)


@dataclass(frozen=True)
class Depths:
    """Depths of one sample's pairs.

    Attributes
    ----------
    depth_m, bound_m : float
    drawn : int, pairs, some of which have no answer
    values : shape (n, 5): errors of the two fits combined and of `joint_fit`, its sigma, its interval less D; metres
    """

    depth_m: float
    bound_m: float
    drawn: int
    values: np.ndarray


def depths(dataset: Dataset, sample: Sample, preset: str, draws: range, frames: FrameCounts) -> Depths:
    """Depths of a sample."""
    drawn = pairs_of(dataset, [sample], preset, draws.stop, True, frames)
    auto = tuple(replace(one, request=replace(one.request, exposure="auto")) for one in drawn.pair_draws)
    part = _part(sample)
    pairs = DrawnPairs(drawn.dataset, tuple(replace(x, request=replace(x.request, region=part)) for x in auto))
    rows = [row for k in draws if (row := _row(_cut(pairs.pair(k), part), sample.row.depth_m)) is not None]
    bound_m = float(spot_bounds(dataset, preset, [sample], frames=frames)["bound_m"][0])
    return Depths(sample.row.depth_m, bound_m, len(draws), np.array(rows, float).reshape(-1, 5))


def _part(sample: Sample) -> Region:
    """Pixels around both spots, on the grid of the JPEG's units."""
    uv = np.array([[row.u_px, row.v_px] for row in (sample.row.down, sample.row.up)])
    low, high = np.floor((uv.min(axis=0) - _AROUND_PX) / 16), np.ceil((uv.max(axis=0) + _AROUND_PX) / 16)
    camera = sample.rig.camera
    (u0, v0), (u1, v1) = np.maximum(16 * low, 0), np.minimum(16 * high, [camera.width_px, camera.height_px])
    return Region(int(u0), int(v0), int(u1), int(v1))


def _cut(pair: Pair, part: Region) -> Pair:
    """Pair of a part of the images, with the camera cut to it."""
    camera = pair.rig.camera
    size = {"width_px": part.u1_px - part.u0_px, "height_px": part.v1_px - part.v0_px}
    cut = replace(camera, **size, cx_px=camera.cx_px - part.u0_px, cy_px=camera.cy_px - part.v0_px)
    return replace(pair, rig=replace(pair.rig, camera=cut))


def _row(pair: Pair, depth_m: float) -> tuple[float, ...] | None:
    separate = _each(pair) if pair.card.output == "raw" else chain_fit(pair)
    joint = joint_of(pair, separate)
    if joint.depth_m is None or joint.sigma_depth_m is None:
        return None
    sigma = joint.sigma_depth_m
    low, high = joint.interval_depth_m or (joint.depth_m - _NORMAL_95 * sigma, joint.depth_m + _NORMAL_95 * sigma)
    return _combined_m(pair, separate) - depth_m, joint.depth_m - depth_m, sigma, low - depth_m, high - depth_m


def _combined_m(pair: Pair, separate: Answer) -> float:
    spots = (separate.down, separate.up)
    if any(spot.uv_px is None or spot.covariance_px2 is None for spot in spots):
        return np.nan
    (uv1, C1), (uv2, C2) = ((np.array(spot.uv_px), np.array(spot.covariance_px2)) for spot in spots)
    return float(combine(pair.rig, pair.stroke_m, uv1, C1, uv2, C2).depth_m)


def line(name: str, found: list[Depths]) -> str:
    """Figures of some samples; errors relative to D, so that the far ones count most."""
    relative = [one.values[:, :3] / one.depth_m for one in found]
    values, bound2 = np.concatenate(relative), [(one.bound_m / one.depth_m) ** 2 for one in found]
    at_bound = float(np.sqrt(np.average(bound2, weights=[len(one.values) for one in found])))
    (combined, joint, sigma), raw = values.T, np.concatenate([one.values for one in found])
    rms, count = (lambda x: float(np.sqrt(np.nanmean(np.square(x))))), len(joint)
    within = int(np.count_nonzero((raw[:, 3] < 0.0) & (raw[:, 4] > 0.0)))
    each = np.concatenate([one.values[:, 1] / one.bound_m for one in found])
    return (
        f"{name}: {count} of {sum(one.drawn for one in found)} answered; rms {100.0 * rms(joint):.3f} % of D, bound "
        f"{100.0 * at_bound:.3f} %, ratio {rms(joint) / at_bound:.3f}, each over its own {rms(each):.3f}; combined "
        f"{rms(combined) / at_bound:.2f}; pull {rms(joint / sigma):.2f}; 95 % intervals hold {within}"
    )


if __name__ == "__main__":
    folder, kind, wanted, on, off, *names = sys.argv[1:]
    opened, numbers = open_dataset(Path(folder)), [int(x) for x in wanted.split(":")]
    chosen = [opened[name] for name in names] or list(opened.samples)
    results = []
    for one in chosen:
        results.append(depths(opened, one, kind, range(*numbers), FrameCounts(int(on), int(off))))
        print(line(one.row.sample_id, results[-1:]), flush=True)
    print(line("all", results))
