"""What single frames of experiments give at best: the bound of D from the pixels alone, and what would improve it.

The bound counts PRNU and DSNU as noise. They are a camera's own, the same in all of its frames, so that a mean of n
frames keeps their part; the rest (photons, read noise, rounding) falls as 1 / n.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import polars as pl

from phibench.datasets.errors import DatasetError
from phibench.datasets.frame_request import Exposure
from phibench.datasets.frame_source import FrameSource
from phibench.datasets.read import Dataset, Sample
from phibench.datasets.taken import TakenSample
from phibench.estimator.bench.dataset_pairs import pairs_of
from phibench.estimator.bench.spot_bounds import spot_bounds as bounds_of_spot
from phibench.estimator.depth_general import depth_general
from phibench.scenes.frames import Array
from phibench.scenes.laser import Beam
from phibench.scenes.rig import POSITIONS

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
        sample_id, experiment, depth_m, stroke_m, exposure_s, bound_m (NaN where a spot has none) and relative, which
        is bound_m / depth_m; bound_pattern_known_m and relative_pattern_known are the same for a camera whose PRNU and
        DSNU are calibrated.
    """
    rows = []
    wanted = dataset.samples if samples is None else samples
    for sample, source in _sources(dataset, preset, wanted, laser_level, exposure):
        row = sample.row
        bound_m, known_m = (_bound_m(sample, source, pattern_known) for pattern_known in (False, True))
        rows.append(
            {
                "sample_id": row.sample_id,
                "experiment": row.experiment,
                "depth_m": row.depth_m,
                "stroke_m": row.nominal_stroke_m,
                "exposure_s": source.sides["down"].chain.sensor.exposure_s,
                "bound_m": bound_m,
                "relative": bound_m / row.depth_m,
                "bound_pattern_known_m": known_m,
                "relative_pattern_known": known_m / row.depth_m,
            }
        )
    return pl.DataFrame(rows)


def frames_needed(bounds: pl.DataFrame, target: float, pattern_known: bool = False) -> int | None:
    """Frames per position of one camera whose mean has a bound with an rms relative error of at most `target`.

    With B of one frame and B_0 of one frame without a pattern, both mean squares over the samples, n frames have
    B(n) = (B - B_0) + B_0 / n. The bound of n frames with weights of its own is not above that: the inverse Fisher
    matrix is concave and homogeneous in the pixels' variance P + R / n, so that its slope in 1 / n at n = 1 is B_0 or
    more. For a method at k times the bound ask for target / k.

    Parameters
    ----------
    bounds : polars.DataFrame
        Of `spot_bounds`.
    target : float
        Of sigma_D / D.
    pattern_known : bool
        Whether PRNU and DSNU are calibrated and taken out: then all of the bound falls as 1 / n.

    Returns
    -------
    int or None
        None where the pattern alone is the target or more, so that no number of frames reaches it.

    Raises
    ------
    DatasetError
        If no sample has a bound, or the target is not above 0.
    """
    names = ("relative_pattern_known",) * 2 if pattern_known else ("relative", "relative_pattern_known")
    squares = np.stack([bounds[name].cast(pl.Float64).to_numpy() ** 2 for name in names])
    squares = squares[:, np.isfinite(squares).all(axis=0)]
    if not squares.size or not target > 0.0:
        raise DatasetError(f"{squares.shape[1]} bounds and a target of {target:g}: both must be above 0")
    one, rest = (float(mean) for mean in np.mean(squares, axis=1))
    left = target**2 - max(one - rest, 0.0)
    return max(math.ceil(rest / left), 1) if left > 0.0 else None


def _sources(
    dataset: Dataset, preset: str, samples: Sequence[Sample], laser_level: float, exposure: Exposure
) -> Iterator[tuple[TakenSample, FrameSource]]:
    """Each sample with what draws its frames."""
    by_id = {sample.row.sample_id: sample for sample in samples}
    for take in pairs_of(dataset, samples, preset).takes:
        sample = TakenSample(by_id[take.sample_id])
        request = replace(take.request, exposure=exposure, laser_level=laser_level)
        yield sample, sample.source(replace(take, request=request))


def _bound_m(sample: TakenSample, source: FrameSource, pattern_known: bool) -> float:
    rows = [sample.row.position(position) for position in POSITIONS]
    C_down, C_up = (_bound_px2(sample, source, position, pattern_known) for position in POSITIONS)
    down, up = (np.array([row.u_px, row.v_px]) for row in rows)
    return float(depth_general(sample.rig, sample.row.stroke_m, down, up, C_down, C_up).sigma_m)


def _bound_px2(sample: TakenSample, source: FrameSource, position: str, pattern_known: bool) -> Array:
    """Bound of (u, v), shape (2, 2), pixels squared; NaN where there is none."""
    row = sample.row.position(position)
    uv_px, rates = (row.u_px, row.v_px), row.electrons_per_s
    side, beam, depth_m = source.sides[position], Beam(sample.row.spot_diameter_m, 0.0), sample.row.depth_m
    found = bounds_of_spot(side, sample.rig, uv_px, rates, row.visible, pattern_known, depth_m, beam).bound_px2
    return _NO_MATRIX if found is None else found
