"""How well an explanation does, by measures that do not depend on the width of its priors, and what looks alike."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from phibench.estimator.studies.cause_model import FREEDOM, Model, standardised, without_table
from phibench.estimator.studies.cause_simulation import simulate
from phibench.estimator.studies.paper_reading import PARAMETERS, Experiments, read
from phibench.scenes.frames import Array

# What the size of an effect is compared at; the units are those of `scenes.misalignment`.
STEPS = {
    "decentre_x_m": 1e-5,
    "tilt_y_rad": 1e-5,
    "cx_px": 1e-2,
    "pitch_rad": 1e-5,
    "stroke_relative": 1e-5,
    "stroke_offset_m": 1e-5,
    "focal_relative": 1e-5,
    "axial_m": 1e-5,
    "radius_m": 1e-6,
}


@dataclass(frozen=True)
class Fit:
    """How an explanation fits what it was fitted to.

    Attributes
    ----------
    rms : float
        Of (published - mean noise-free estimate) / real depth.
    chi2, chi2_p : float
        Sum of squared standardised residuals, mean over the posterior; share of replicas that have a larger one.
    trend, trend_p : float
        Mean product of standardised residuals of neighbouring strokes; share of replicas with a larger one. Small where
        residuals run in trends that independent noise does not make.
    """

    rms: float
    chi2: float
    chi2_p: float
    trend: float
    trend_p: float


def fit_of(model: Model, points: Array, random: np.random.Generator) -> Fit:
    """Fit of a posterior, points of shape (m, d); every point gets one replica of the data.

    Under a Gaussian with known covariance the standardised residuals of a replica are independent unit normals; with
    heavy tails they are independent Student t.
    """
    heavy = model.explanation.tails == "student"
    depth = np.mean(model.reading(points).depth_m, axis=0)
    relative = (model.experiments.estimate_m - depth) / model.experiments.depth_m
    seen = standardised(model, points, independent=heavy)
    replica = random.standard_t(FREEDOM, seen.shape) if heavy else random.normal(size=seen.shape)
    (chi2, chi2_of), (trend, trend_of) = (
        (f(seen), f(replica)) for f in (lambda z: np.sum(z * z, axis=-1), lambda z: _trend(z, model.experiments))
    )
    return Fit(
        float(np.sqrt(np.mean(relative**2))),
        float(chi2.mean()),
        float(np.mean(chi2_of > chi2)),
        float(trend.mean()),
        float(np.mean(trend_of > trend)),
    )


def _trend(residuals: Array, experiments: Experiments) -> Array:
    """Mean product of neighbours with the same target, shape (m,)."""
    neighbours = np.flatnonzero(np.diagonal(experiments.same_target, 1))
    return np.asarray(np.mean(residuals[:, neighbours] * residuals[:, neighbours + 1], axis=-1))


def left_out_score(model: Model, points: Array, table: int) -> tuple[float, float]:
    """Log density of one table given draws from the posterior without it, shape (m, d), and its Monte Carlo error."""
    _, out = without_table(model, table)
    only = Model(model.explanation, model.priors, model.experiments.chosen(out), model.rig, model.depth_sigma_m)
    logs = only.log_likelihoods(points)
    logs = np.where(np.isfinite(logs), logs, -np.inf)
    top = logs.max()
    weights = np.exp(logs - top)
    mean = weights.mean()
    return float(top + np.log(mean)), float(weights.std() / mean / np.sqrt(len(weights)))


def coverage(model: Model, points: Array, truth: dict[str, float], level: float) -> dict[str, bool]:
    """Whether the central interval of each parameter holds its true value."""
    tail = (1.0 - level) / 2.0
    low, high = np.quantile(points, [tail, 1.0 - tail], axis=0)
    return {name: bool(low[i] <= truth[name] <= high[i]) for i, name in enumerate(model.names) if name in truth}


def band(model: Model, points: Array, grid: Experiments, random: np.random.Generator, level: float) -> Array:
    """Lower end of simulated estimates on a grid, median of noise-free ones, upper end; shape (3, n)."""
    tail = (1.0 - level) / 2.0
    low, high = np.nanquantile(simulate(model, points, random, grid), [tail, 1.0 - tail], axis=0)
    middle = read(model.named(points), grid, model.explanation.reader, model.rig).depth_m
    return np.stack([low, np.nanmedian(middle, axis=0), high])


def alike(model: Model, point: Array) -> list[tuple[str, str, float]]:
    """Pairs of parameters and the cosine between what they do to the 25 estimates, in units of their noise.

    +-1: the estimates cannot tell the two apart, however good they are.
    """
    named = {name: value for name, value in model.named(point).items() if name not in PARAMETERS}
    azimuths = {name: value for name, value in model.named(point).items() if name.startswith("azimuth")}
    at = {**named, **azimuths}
    covariance = model.covariance(model.reading(point), point)
    effects = {name: _effect(model, at, name, step, covariance) for name, step in STEPS.items()}
    return [
        (a, b, float(effects[a] @ effects[b] / np.linalg.norm(effects[a]) / np.linalg.norm(effects[b])))
        for a, b in combinations(STEPS, 2)
    ]


def _effect(model: Model, at: dict[str, Array], name: str, step: float, covariance: Array) -> Array:
    """Change of the inverse estimates by a parameter, in units of their noise, shape (n,)."""
    ends = [
        read({**at, name: np.asarray(by)}, model.experiments, model.explanation.reader, model.rig).inverse_depth_per_m
        for by in (-step, step)
    ]
    return np.asarray((ends[1] - ends[0]) / (2.0 * step) / np.sqrt(np.diagonal(covariance)))
