"""Tables of the study `baseline`: spots found, D by sense of phi beside the paper's, power laws, drawn rigs.

The paper's experiments are in one table: published estimate, our estimates with scatter, and bounds. Drawn rigs are in
closed form; an aligned reader makes estimates of what they show. Power laws y = c D^p h^q are fitted to logarithms.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import polars as pl

from phibench.benchmark.pair_sets.dataset_pairs import DatasetPairs
from phibench.benchmark.scores.intervals import percentile_interval
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.parallel import parallel_map
from phibench.datasets.exposures.pair_draws import PairDraw, pair_draws
from phibench.datasets.read import Dataset, open_finished
from phibench.estimator.geometry.paper_depth import Published, depth_paper, find_published
from phibench.estimator.geometry.phi import CONVENTIONS, estimate_phi
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.sensitivities import PARAMETERS
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.interface import Spot
from phibench.estimator.methods.registry import METHODS
from phibench.estimator.methods.spot_search import SharedPair
from phibench.scenes.frames import Array
from phibench.scenes.mirror import OF_REVOLVED
from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError

EXPECTED = (2.0, -1.0)  # eq. (7): exponents of D and of h


@dataclass(frozen=True)
class PowerLaw:
    """Exponents with their intervals.

    Attributes
    ----------
    exponents : shape (k,)
    low, high : shape (k,)
    rms_log : float
        Root mean square residual of log y: by how much, relatively, the law misses.
    """

    exponents: Array
    low: Array
    high: Array
    rms_log: float

    def holds(self, i: int, exponent: float) -> bool:
        """Check that an exponent lies in the i-th interval."""
        return bool(self.low[i] <= exponent <= self.high[i])


def fit_power_law(y: Array, bases: Array, random: np.random.Generator, resamples: int = 2000) -> PowerLaw:
    """Least squares on logarithms; intervals by the percentile bootstrap over cases.

    Parameters
    ----------
    y : shape (n,), above 0; other values are left out
    bases : shape (k, n), above 0
    random : Generator
    """
    good = np.isfinite(y) & (y > 0.0)
    logs = [np.log(x[good]) for x in (*bases, y)]
    low, high = percentile_interval(logs, lambda *rows: _exponents(rows), resamples, random)
    design = np.stack([np.ones(good.sum()), *logs[:-1]], axis=-1)
    fitted = np.linalg.lstsq(design, logs[-1], rcond=None)[0]
    rms = float(np.sqrt(np.mean((logs[-1] - design @ fitted) ** 2)))
    return PowerLaw(fitted[1:], low, high, rms)


def _exponents(rows: tuple[Array, ...]) -> Array:
    design = np.stack([np.ones(len(rows[0])), *rows[:-1]], axis=-1)
    return np.asarray(np.linalg.lstsq(design, rows[-1], rcond=None)[0][1:])


@dataclass(frozen=True)
class LawFit:
    """Exponents of D and h of one quantity."""

    name: str
    law: PowerLaw
    cases: int

    @property
    def holds(self) -> tuple[bool, bool]:
        """Flags of 2 and -1: inside of the intervals."""
        return self.law.holds(0, EXPECTED[0]), self.law.holds(1, EXPECTED[1])


@dataclass(frozen=True)
class Curve:
    """Published errors of one table against h: rms residuals of simple laws, metres.

    Attributes
    ----------
    signs : int
        Changes of sign along h.
    rms_m, inverse_m, line_m, offset_m : float
        Root mean square of the errors, and of the residuals of c/h, a + b h, and a + b/h (over degrees of freedom).
    law : PowerLaw
        Of the absolute errors with h.
    """

    experiment: str
    signs: int
    rms_m: float
    inverse_m: float
    line_m: float
    offset_m: float
    law: PowerLaw


def laws_of_noise(table: pl.DataFrame, method: str, resamples: int) -> list[LawFit]:
    """Exponents of the scatter of our estimates, of the bound, and of the geometry with and without the sines."""
    rows = table.filter((pl.col("sense") == "exact") & (pl.col("method") == method))
    bases = rows.select("depth_m", "stroke_m").to_numpy().T
    sines, sd, bound, per_px, disparity = (
        rows[name].to_numpy() for name in ("sines", "sd_m", "bound_m", "m_per_px", "bound_disparity_rad")
    )
    quantities = {
        "scatter of the estimates": sd,
        "scatter, per disparity error and with the sines": sd * sines / disparity,
        "bound": bound,
        "bound, per disparity error and with the sines": bound * sines / disparity,
        "one pixel of noise": per_px,
    }
    return [_fit(name, values, bases, resamples) for name, values in quantities.items()]


def published_curve(experiment: str, stroke_m: Array, error_m: Array, resamples: int) -> Curve:
    """Laws of the published errors of one table, strokes in rising order."""
    ones, inverse = np.ones_like(stroke_m), 1.0 / stroke_m
    random = generator("study", "baseline", "published", experiment)
    return Curve(
        experiment,
        int(np.count_nonzero(np.diff(np.sign(error_m)))),
        float(np.sqrt(np.mean(error_m**2))),
        _left(error_m, inverse[:, None]),
        _left(error_m, np.stack([ones, stroke_m], -1)),
        _left(error_m, np.stack([ones, inverse], -1)),
        fit_power_law(np.abs(error_m), stroke_m[None], random, resamples),
    )


def _fit(name: str, values: Array, bases: Array, resamples: int) -> LawFit:
    law = fit_power_law(values, bases, generator("study", "baseline", "law", name), resamples)
    return LawFit(name, law, int(np.isfinite(values).sum()))


def _left(y: Array, design: Array) -> float:
    """Residual standard deviation of least squares."""
    residual = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
    return float(np.sqrt(residual @ residual / (len(y) - design.shape[1])))


EXACT = "exact"
SENSES = (*CONVENTIONS, EXACT)
_TRIES = 1000  # so many impossible ones in a row: the rig itself is about to fold the image


def drawn_misalignment(rig: Rig, random: np.random.Generator) -> Misalignment:
    """Independent normal errors of the usual study magnitudes, of all that moves a chief ray.

    One that cannot exist (a distortion that folds the image) is drawn again.
    """
    for _ in range(_TRIES):
        names = (name for name in PARAMETERS if name not in OF_REVOLVED)  # the study's mirror is a sphere
        drawn = Misalignment(**{name: random.normal(scale=MISALIGNMENT[name].study) for name in names})
        try:
            rig.perturbed(drawn)
        except SceneError:
            continue  # an impossible rig is drawn again
        return drawn
    raise SceneError(f"none of {_TRIES} drawn misalignments of the rig can exist: take a rig with less distortion")


def seen_pixels(rig: Rig, misalignment: Misalignment, points_m: Array, strokes_m: Array) -> tuple[Array, Array, Array]:
    """Pixels down and up, shape (n, 2), and true D, shape (n,), of world points (n, 3) with nominal strokes (n,)."""
    true = rig.perturbed(misalignment)
    down = image_of(true.at(0.0), points_m).uv_px
    up = np.full_like(down, np.nan)
    for stroke in np.unique(strokes_m):
        at = strokes_m == stroke
        up[at] = image_of(true.at(misalignment.stroke_m(float(stroke))), points_m[at]).uv_px
    away = points_m[:, :2] - true.at(0.0).sphere_centre_m[:2]
    return down, up, np.hypot(away[:, 0], away[:, 1])


def depth_estimates(sense: str, rig: Rig, strokes_m: Array, down_px: Array, up_px: Array) -> Array:
    """D by eq. (4) with phi in one sense, or by the exact estimator, shape (..., n), from pixels (..., n, 2).

    The rig is an aligned one, so that phi does not depend on the carriage.
    """
    if sense == EXACT:
        return depth_exact(rig, strokes_m, down_px, up_px).depth_m
    view = rig.at(0.0)
    phi1, phi2 = (CONVENTIONS[sense](view, uv) for uv in (down_px, up_px))
    return depth_paper(phi1, phi2, strokes_m, rig.sphere.radius_m).depth_m


def drawn_errors(
    rig: Rig, points_m: Array, strokes_m: Array, count: int, random: np.random.Generator
) -> dict[str, Array]:
    """Errors of D, shape (count, n), metres, in every sense of phi, of an aligned reader of drawn rigs."""
    pictures = [seen_pixels(rig, drawn_misalignment(rig, random), points_m, strokes_m) for _ in range(count)]
    down, up, true = (np.stack(rows) for rows in zip(*pictures, strict=True))
    return {sense: depth_estimates(sense, rig, strokes_m, down, up) - true for sense in SENSES}


_NOWHERE = (float("nan"), float("nan"))


@dataclass(frozen=True)
class FoundSpots:
    """Spots found in the draws of one sample.

    Attributes
    ----------
    uv_px : dict of method to array, shape (draws, 2, 2)
        Pixels by draw and position (down, up); NaN where a method has none.
    bounds_px2 : shape (2, 2, 2)
        Bound of the covariance of (u, v) of the processed image, down and up; NaN where there is none.
    """

    sample_id: str
    uv_px: dict[str, Array]
    bounds_px2: Array


def found_spots(
    dataset: Dataset, preset: str, draws: Mapping[str, int], workers: int | None = None
) -> dict[str, FoundSpots]:
    """Positions by sample, auto exposure.

    Parameters
    ----------
    draws : dict of method to int
        How many draws of the noise each method reads; draw k is the same frame for all.
    workers : int, optional
        Processes; they change no number.
    """
    job = partial(_found, dataset.folder, preset, dict(draws))
    names = [sample.row.sample_id for sample in dataset]
    return dict(zip(names, parallel_map(job, names, workers), strict=True))


def auto_exposed_draws(dataset: Dataset, preset: str, draws: int) -> tuple[PairDraw, ...]:
    """Draws at the exposure that the camera chooses, by sample and draw."""
    ordered = sorted(pair_draws(dataset, preset, draws), key=lambda pair_draw: (pair_draw.sample_id, pair_draw.draw))
    return tuple(
        replace(pair_draw, number=i, request=replace(pair_draw.request, exposure="auto"))
        for i, pair_draw in enumerate(ordered)
    )


def _found(folder: Path, preset: str, draws: dict[str, int], sample_id: str) -> FoundSpots:
    dataset = open_finished(folder)
    chosen = [
        pair_draw
        for pair_draw in auto_exposed_draws(dataset, preset, max(draws.values()))
        if pair_draw.sample_id == sample_id
    ]
    pairs = DatasetPairs(dataset, tuple(replace(pair_draw, number=i) for i, pair_draw in enumerate(chosen)))
    spots: dict[str, list[Array]] = {name: [] for name in draws}
    for number in range(len(pairs)):
        pair = SharedPair.of(pairs.pair(number))
        for name, count in draws.items():
            if number < count:
                answer = METHODS[name](pair)
                spots[name].append(np.array([_place(answer.down), _place(answer.up)]))
    truth = pairs.truth(0)
    bounds = [np.full((2, 2), np.nan) if s.bound_px2 is None else s.bound_px2 for s in (truth.down, truth.up)]
    return FoundSpots(sample_id, {name: np.stack(places) for name, places in spots.items()}, np.stack(bounds))


def _place(spot: Spot) -> tuple[float, float]:
    return _NOWHERE if spot.uv_px is None else spot.uv_px


BAND = (0.025, 0.975)  # quantiles of an interval of 95 %


@dataclass(frozen=True)
class Experiment:
    """One published experiment and its sample.

    Attributes
    ----------
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
    experiments = []
    for sample in dataset:
        row = sample.row
        published = find_published(row.experiment, row.depth_m, row.nominal_stroke_m)
        if published is not None:
            pixels = np.array([[row.down.u_px, row.down.v_px], [row.up.u_px, row.up.v_px]])
            experiments.append(Experiment(row.sample_id, published, np.array(row.spot_world_m), pixels))
    if not experiments:
        raise DatasetError(f"{dataset.folder} has none of the paper's experiments: take the recipe paper")
    return experiments


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
                "noise_free_m": float(depth_estimates(sense, rig, stroke, *experiment.true_px)),
            }
            for method, uv in found.uv_px.items():
                rows.append(
                    {**common, "method": method, **_statistics(depth_estimates(sense, rig, stroke, *uv.swapaxes(0, 1)))}
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
