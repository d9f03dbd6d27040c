"""Error budget of a data set's experiments: errors of D predicted by bounds, against measured ones.

The bound counts PRNU and DSNU as noise. They are a camera's own, the same in all of its frames, so that a mean of n
frames keeps their part. The rest (photons, read noise, rounding) falls as 1 / n.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from phibench.benchmark.pair_sets.dataset_pairs import SpotInImage
from phibench.benchmark.pair_sets.dataset_pairs import spot_bounds as bounds_of_spot
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.intervals import Clusters, Estimate, estimates, rate, rms_of, rms_ratio_of
from phibench.benchmark.scores.score_tables import cell_parts
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.shown_text import TextTable
from phibench.datasets.exposures.pair_draws import CachedSample, FrameCounts
from phibench.datasets.frames.frame_request import Exposure
from phibench.datasets.frames.frame_source import FrameSource
from phibench.datasets.read import Dataset, Sample
from phibench.estimator.drawn_pairs import pairs_of
from phibench.estimator.geometry.least_squares_depth import depth_general
from phibench.scenes.frames import Array
from phibench.scenes.laser import Beam
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import POSITIONS

_NO_MATRIX = np.full((2, 2), np.nan)


def spot_bounds(
    dataset: Dataset,
    preset: str,
    samples: Sequence[Sample] | None = None,
    laser_level: float = 1.0,
    exposure: Exposure = "auto",
    frames: FrameCounts | None = None,
) -> pl.DataFrame:
    """Bound of D for a rig that is known exactly, from one frame per position, or from some on and some off.

    Parameters
    ----------
    samples : of the data set; all by default
    laser_level : float
        Factor of the laser's light.
    exposure : float, "auto" or None
        Seconds; "auto" is the camera's for the room of the down image; None that of the preset.
    frames : FrameCounts, optional
        Frames per position with the laser on and off, from which alone the room is known; by default one frame with the
        laser on, and the room a level per filter.

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
        bound_m, known_m = (_bound_m(sample, source, pattern_known, frames) for pattern_known in (False, True))
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


def _sources(
    dataset: Dataset, preset: str, samples: Sequence[Sample], laser_level: float, exposure: Exposure
) -> Iterator[tuple[CachedSample, FrameSource]]:
    """Each sample with what draws its frames."""
    by_id = {sample.row.sample_id: sample for sample in samples}
    for pair_draw in pairs_of(dataset, samples, preset).pair_draws:
        sample = CachedSample.of(by_id[pair_draw.sample_id])
        request = replace(pair_draw.request, exposure=exposure, laser_level=laser_level)
        yield sample, sample.source(replace(pair_draw, request=request))


def _bound_m(sample: CachedSample, source: FrameSource, pattern_known: bool, frames: FrameCounts | None) -> float:
    rows = [sample.row.position(position) for position in POSITIONS]
    C_down, C_up = (_bound_px2(sample, source, position, pattern_known, frames) for position in POSITIONS)
    down, up = (np.array([row.u_px, row.v_px]) for row in rows)
    return float(depth_general(sample.rig, sample.row.stroke_m, down, up, C_down, C_up).sigma_m)


def _bound_px2(
    sample: CachedSample, source: FrameSource, position: str, pattern_known: bool, frames: FrameCounts | None
) -> Array:
    """Bound of (u, v), shape (2, 2), pixels squared; NaN where there is none."""
    row = sample.row.position(position)
    beam = Beam(sample.row.spot_diameter_m, 0.0)
    spot = SpotInImage((row.u_px, row.v_px), row.electrons_per_s, row.visible, sample.row.depth_m, beam)
    found = bounds_of_spot(source.sides[position], sample.rig, spot, pattern_known, frames).bound_px2
    return _NO_MATRIX if found is None else found


# -- error budget ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Budget:
    """Predicted against measured errors of D over some rows; every estimate has a 95 % interval over samples.

    Attributes
    ----------
    n, samples, missing : int
        Rows with an estimate, their samples, and rows without.
    measured : Estimate
        Rms relative error of D.
    predicted : float
        Rms of the predicted relative standard deviations.
    bound : float
        The same at the bound.
    closure : Estimate
        predicted / measured; 1 is a budget that closes.
    over_bound : Estimate
        measured / bound; 1 is the bound.
    within_95 : Estimate
        Share of errors within the predicted interval.
    nominal : float
        Rms relative error with the nominal rigs.
    """

    n: int
    samples: int
    missing: int
    measured: Estimate
    predicted: float
    bound: float
    closure: Estimate
    over_bound: Estimate
    within_95: Estimate
    nominal: float


def budget(rows: pl.DataFrame, rules: Rules | None = None, seed: int = 0) -> Budget:
    """Error budget of rows of `run_experiments`.

    Raises
    ------
    DatasetError
        If no row has an estimate.
    """
    rules, measured_rows = rules or Rules(), rows.filter(pl.col("status") == "ok")
    if measured_rows.is_empty():
        raise DatasetError(f"none of {len(rows)} experiments has an estimate; the first says: {_first_status(rows)}")
    clusters = Clusters.of(measured_rows["sample_id"].to_numpy())
    error2, sigma2, bound2 = (
        _squares(measured_rows[name] / measured_rows["depth_m"]) for name in ("error_m", "sigma_m", "bound_m")
    )
    statistics = (
        rms_of(clusters, error2),
        rms_ratio_of(clusters, sigma2, error2),
        rms_ratio_of(clusters, error2, bound2),
    )
    measured, closure, over = estimates(statistics, clusters.n, rules, generator("budget", seed))
    nominal2 = _squares(measured_rows["nominal_error"])
    predicted, bound, nominal = (float(np.sqrt(np.mean(x))) for x in (sigma2, bound2, nominal2))
    within = rate(clusters, measured_rows["within_95"].cast(pl.Float64).to_numpy(), rules)
    numbers = len(measured_rows), clusters.n, len(rows) - len(measured_rows)
    return Budget(*numbers, measured, predicted, bound, closure, over, within, nominal)


def budgets(rows: pl.DataFrame, by: str) -> dict[str, Budget]:
    """A budget for every value of a column, in the order of first appearance."""
    groups = rows.partition_by(by, maintain_order=True, as_dict=True)
    return {str(key[0]): budget(group) for key, group in groups.items()}


def budget_table(rows: pl.DataFrame, wide: bool = False) -> TextTable:
    """Budgets per experiment, of all rows, and of those whose bound is at most 1 % of D; `wide` adds the intervals."""
    ratios = ("predicted\n/ measured", "measured\n/ bound", "within\n95 %", "nominal\nrig")
    heads = ("rows", "n\nof all", "measured", "predicted", "bound", *ratios)
    body = tuple((name, *_cells(budget(own), wide)) for name, own in _parts(rows))
    confidence = "; 95 % intervals over samples" if wide else ""
    note = "" if wide else "95 % intervals: --wide."
    return TextTable(f"Relative errors of D in %{confidence}", heads, body, "L" + "r" * (len(heads) - 1), note)


def _parts(rows: pl.DataFrame) -> Iterator[tuple[str, pl.DataFrame]]:
    """Named parts of the rows, those in which something has an estimate."""
    found = pl.col("status") == "ok"
    parts = [(str(key[0]), part) for key, part in rows.partition_by("experiment", as_dict=True).items()]
    parts.append(("all", rows))
    # the few pairs with a large bound decide every rms over all rows
    parts.append(("bound at most 1 %", rows.filter(pl.col("bound_m") <= 0.01 * pl.col("depth_m"))))
    yield from ((name, part) for name, part in parts if not part.filter(found).is_empty())


def _cells(one: Budget, wide: bool) -> list[str]:
    """Cells of a row; values alone unless it is `wide`."""
    shown = slice(None if wide else 1)
    measured, closure, over_bound, within = (
        " ".join(list(filter(None, cell_parts(estimate, factor, digits)))[shown])
        for estimate, factor, digits in (
            (one.measured, 100.0, 3),
            (one.closure, 1.0, 2),
            (one.over_bound, 1.0, 2),
            (one.within_95, 100.0, 1),
        )
    )
    predicted, bound = (f"{100.0 * x:.3f}" for x in (one.predicted, one.bound))
    counts = f"{one.n}/{one.n + one.missing}"
    return [counts, measured, predicted, bound, closure, over_bound, within, _percent(one.nominal)]


def _percent(share: float) -> str:
    return f"{100.0 * share:.2f}"


def _squares(column: pl.Series) -> Array:
    return np.square(column.to_numpy())


def _first_status(rows: pl.DataFrame) -> str:
    return str(rows["status"][0]) if len(rows) else "there are none"
