"""The paper's experiments in one table: published estimate, ours with scatter, bounds, drawn misalignments."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl

from phibench.datasets.errors import DatasetError
from phibench.datasets.read import Dataset
from phibench.estimator.phi import estimate_phi
from phibench.estimator.published import Published, find_published
from phibench.estimator.studies.drawn_rigs import SENSES, drawn_errors, estimates
from phibench.estimator.studies.drawn_spots import FoundSpots
from phibench.estimator.triangulate import depth_exact
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

BAND = (0.025, 0.975)


@dataclass(frozen=True)
class Experiment:
    """One published experiment and its sample.

    Attributes
    ----------
    sample_id : str
    published : Published
    point_m : shape (3,), world point of the spot
    true_px : shape (2, 2), exact pixels, down and up
    """

    sample_id: str
    published: Published
    point_m: Array
    true_px: Array


def experiments_of(dataset: Dataset) -> list[Experiment]:
    """The published experiments that a data set has, in the order of its samples.

    Raises
    ------
    DatasetError
        If there is none.
    """
    found = []
    for sample in dataset:
        row = sample.row
        published = find_published(row.experiment, row.depth_m, row.nominal_stroke_m)
        if published is not None:
            pixels = np.array([[row.down.u_px, row.down.v_px], [row.up.u_px, row.up.v_px]])
            found.append(Experiment(row.sample_id, published, np.array(row.spot_world_m), pixels))
    if not found:
        raise DatasetError(f"{dataset.folder} has none of the paper's experiments: take the recipe paper")
    return found


def experiment_table(experiments: list[Experiment], rig: Rig, spots: Mapping[str, FoundSpots]) -> pl.DataFrame:
    """A row per experiment, method and sense of phi: mean and scatter of the draws, and what the bound predicts."""
    rows = []
    for experiment in experiments:
        found, published = spots[experiment.sample_id], experiment.published
        stroke = np.array(published.baseline_m)
        for sense in SENSES:
            common = {
                "sample_id": experiment.sample_id,
                "experiment": published.experiment,
                "depth_m": published.real_depth_m,
                "stroke_m": published.baseline_m,
                "published_m": published.estimated_depth_m,
                "sense": sense,
                "noise_free_m": float(estimates(sense, rig, stroke, *experiment.true_px)),
            }
            for method, uv in found.uv_px.items():
                rows.append(
                    {**common, "method": method, **_statistics(estimates(sense, rig, stroke, *uv.swapaxes(0, 1)))}
                )
    bounds = pl.DataFrame([bound_row(experiment, rig, spots[experiment.sample_id]) for experiment in experiments])
    return pl.DataFrame(rows).join(bounds, on="sample_id", how="left", maintain_order="left")


def bound_row(experiment: Experiment, rig: Rig, found: FoundSpots) -> dict[str, object]:
    """Bounds of one experiment: sigma of D, of the disparity 2 phi_1 - 2 phi_2, and sigma of D per pixel of noise."""
    stroke, views = experiment.published.baseline_m, (rig.at(0.0), rig.at(experiment.published.baseline_m))
    phis = [
        estimate_phi("ray", view, uv, bound)
        for view, uv, bound in zip(views, experiment.true_px, found.bounds_px2, strict=True)
    ]
    (down, up), (bound_down, bound_up) = experiment.true_px, found.bounds_px2
    pixel = depth_exact(rig, stroke, down, up, np.eye(2), np.eye(2))
    bound = depth_exact(rig, stroke, down, up, bound_down, bound_up)
    return {
        "sample_id": experiment.sample_id,
        "bound_m": float(bound.sigma_m),
        "bound_disparity_rad": float(2.0 * np.sqrt(sum(phi.variance_rad2 for phi in phis))),
        "m_per_px": float(pixel.sigma_m),
        "sines": float(np.prod([np.sin(2.0 * phi.phi_rad) for phi in phis])),
    }


def band_table(experiments: list[Experiment], rig: Rig, count: int, random: np.random.Generator) -> pl.DataFrame:
    """Errors of D under drawn misalignments: a row per experiment and sense of phi."""
    points = np.stack([experiment.point_m for experiment in experiments])
    strokes = np.array([experiment.published.baseline_m for experiment in experiments])
    rows = []
    for sense, errors in drawn_errors(rig, points, strokes, count, random).items():
        low, median, high = np.nanquantile(errors, [BAND[0], 0.5, BAND[1]], axis=0)
        rows += [
            {
                "sample_id": experiment.sample_id,
                "sense": sense,
                "low_m": float(low[i]),
                "median_m": float(median[i]),
                "high_m": float(high[i]),
                "missing": int(np.isnan(errors[:, i]).sum()),
            }
            for i, experiment in enumerate(experiments)
        ]
    return pl.DataFrame(rows)


def _statistics(depth_m: Array) -> dict[str, object]:
    good = depth_m[np.isfinite(depth_m)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the mean of nothing
        mean, sd = float(np.mean(good)), float(np.std(good, ddof=1)) if len(good) > 1 else float("nan")
    return {"n": len(good), "missing": len(depth_m) - len(good), "mean_m": mean, "sd_m": sd}
