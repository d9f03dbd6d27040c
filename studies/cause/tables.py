"""Tables of the study `cause` from its posteriors, with fits of explanations and verdicts on log evidences.

Measures of a fit do not depend on the width of its priors: posterior predictive p-values, and left-out tables.
A sampler's own error of a log evidence leaves out modes that it lost. Five pairs of samplings with a free tilt differ
by 2.0, 1.6, 2.6, 2.1 and 1.8: a scatter of 1.45 for one (95 %: 0.9 to 3.6), where the sampler states 0.6 to 0.7.
With fourteen more at 60 live points it is 1.76 (1.3 to 2.6), so that the floor is no upper limit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
import polars as pl

from phibench.scenes.frames import Array
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.rig import Rig
from phibench.studies.cause.model import (
    FREEDOM,
    NOISE,
    WHOLE_PIXEL_PX,
    DepthModel,
    brute_force,
    simulate,
    standardised_residuals,
    without_table,
)
from phibench.studies.cause.nested_sampling import CauseSettings, Posterior, Run
from phibench.studies.cause.paper_reading import (
    PARAMETERS,
    TABLES,
    Experiments,
    Reader,
    published_experiments,
    read_depths,
    sphere_image_px,
)

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
    """Fit of an explanation to its own data.

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


def fit_of(model: DepthModel, points: Array, random: np.random.Generator) -> Fit:
    """Fit of a posterior, points of shape (m, d); every point gets one replica of the data.

    Under a Gaussian with known covariance the standardised residuals of a replica are independent unit normals; with
    heavy tails they are independent Student t.
    """
    heavy = model.explanation.tails == "student"
    depth = np.mean(model.reading(points).depth_m, axis=0)
    relative = (model.experiments.estimate_m - depth) / model.experiments.depth_m
    seen = standardised_residuals(model, points, independent=heavy)
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


def left_out_score(model: DepthModel, points: Array, table: int) -> tuple[float, float]:
    """Log density of one table given draws from the posterior without it, shape (m, d), and its Monte Carlo error."""
    _, out = without_table(model, table)
    only = DepthModel(model.explanation, model.priors, model.experiments.chosen(out), model.rig, model.depth_sigma_m)
    logs = only.log_likelihoods(points)
    logs = np.where(np.isfinite(logs), logs, -np.inf)
    top = logs.max()
    weights = np.exp(logs - top)
    mean = weights.mean()
    return float(top + np.log(mean)), float(weights.std() / mean / np.sqrt(len(weights)))


def coverage(model: DepthModel, points: Array, truth: dict[str, float], level: float) -> dict[str, bool]:
    """Flags of parameters whose central interval holds the true value."""
    tail = (1.0 - level) / 2.0
    low, high = np.quantile(points, [tail, 1.0 - tail], axis=0)
    return {name: bool(low[i] <= truth[name] <= high[i]) for i, name in enumerate(model.names) if name in truth}


def band(model: DepthModel, points: Array, grid: Experiments, random: np.random.Generator, level: float) -> Array:
    """Lower end of simulated estimates on a grid, median of noise-free ones, upper end; shape (3, n)."""
    tail = (1.0 - level) / 2.0
    low, high = np.nanquantile(simulate(model, points, random, grid), [tail, 1.0 - tail], axis=0)
    middle = read_depths(model.named(points), grid, model.explanation.reader, model.rig).depth_m
    return np.stack([low, np.nanmedian(middle, axis=0), high])


def alike_parameters(model: DepthModel, point: Array) -> list[tuple[str, str, float]]:
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


def _effect(model: DepthModel, at: dict[str, Array], name: str, step: float, covariance: Array) -> Array:
    """Change of the inverse estimates by a parameter, in units of their noise, shape (n,)."""
    ends = [
        read_depths(
            {**at, name: np.asarray(by)}, model.experiments, model.explanation.reader, model.rig
        ).inverse_depth_per_m
        for by in (-step, step)
    ]
    return np.asarray((ends[1] - ends[0]) / (2.0 * step) / np.sqrt(np.diagonal(covariance)))


DECIDED = float(np.log(10.0))  # odds of 10 to 1
SIGMAS = 2.0  # how many errors a difference must exceed that by
ENOUGH = 3  # samplings whose scatter is an error
FLOOR = 1.5  # of the error of a log evidence of fewer samplings
Verdict = Literal["favoured", "disfavoured", "undecided"]


def evidence_error(measured: float, repeats: int) -> float:
    """Error of a log evidence, one sigma.

    Parameters
    ----------
    measured : float
        Larger of the sampler's own error and of the scatter of repeats, of their mean
        (`nested_sampling.pooled_posterior`).
    repeats : int
        Independent samplings; of fewer than `ENOUGH` the error is at least `FLOOR`.
    """
    return measured if repeats >= ENOUGH else max(measured, FLOOR)


def verdict(difference: float, error: float) -> Verdict:
    """Verdict on the first of two, from the difference of log evidences and its error of one sigma."""
    if abs(difference) <= DECIDED + SIGMAS * error:
        return "undecided"
    return "favoured" if difference > 0.0 else "disfavoured"


INTERVAL = (0.025, 0.975)  # quantiles of an interval of 95 %
COVERED = 0.9
Posteriors = Mapping[tuple[Name, ...], Posterior]


def explanation_table(settings: CauseSettings, posteriors: Posteriors) -> pl.DataFrame:
    """A row per explanation: evidence, noise, fit, scores of left-out tables; `against` is the first explanation."""
    names = [explanation.name for explanation in settings.explanations]
    first = posteriors["published", names[0]]
    first_error = evidence_error(first.log_evidence_error, settings.repeats)
    rows = []
    for name in names:
        own, model = posteriors["published", name], settings.model(name, published_experiments())
        fit = fit_of(model, own.thinned(settings.predictive), generator("study", "cause", "fit", name))
        noise = own.points[:, model.names.index(NOISE)] if NOISE in model.names else np.full(2, WHOLE_PIXEL_PX)
        error = evidence_error(own.log_evidence_error, settings.repeats)
        score, score_error = _left_out(settings, posteriors, name)
        rows.append(
            {
                "explanation": name,
                "text": model.explanation.text,
                "parameters": len(model.names),
                "log_evidence": own.log_evidence,
                "log_evidence_error": error,
                "sampler_error": own.log_evidence_error,
                "against": own.log_evidence - first.log_evidence,
                "against_error": float(np.hypot(error, first_error)) if name != names[0] else 0.0,
                "noise_px": float(noise.mean()),
                "noise_low_px": float(np.quantile(noise, INTERVAL[0])),
                "noise_high_px": float(np.quantile(noise, INTERVAL[1])),
                "left_rms": fit.rms,
                "chi2": fit.chi2,
                "chi2_p": fit.chi2_p,
                "trend": fit.trend,
                "trend_p": fit.trend_p,
                "left_out_score": score,
                "left_out_error": score_error,
                "evaluations": own.evaluations,
            }
        )
    return pl.DataFrame(rows)


def scale_table(settings: CauseSettings, posteriors: Posteriors) -> pl.DataFrame:
    """Log evidence against the first explanation with priors of misalignment, stroke and scale wider or narrower."""
    first = posteriors["published", settings.explanations[0].name]
    first_error = evidence_error(first.log_evidence_error, settings.repeats)
    rows = []
    for name in settings.scaled if settings.prior_scales else ():
        for scale in (1.0, *settings.prior_scales):
            own = posteriors[("published", name) if scale == 1.0 else ("scale", f"{scale:g}", name)]
            repeats = settings.repeats if scale == 1.0 else 1
            error = float(np.hypot(evidence_error(own.log_evidence_error, repeats), first_error))
            against = own.log_evidence - first.log_evidence
            rows.append({"explanation": name, "scale": scale, "against": against, "error": error})
    schema = {"explanation": pl.String, "scale": pl.Float64, "against": pl.Float64, "error": pl.Float64}
    return pl.DataFrame(rows, schema=schema)


def posterior_table(settings: CauseSettings, posteriors: Posteriors) -> pl.DataFrame:
    """Mean, deviation and central 95 % of every parameter, and of its prior."""
    rows = []
    for explanation in settings.explanations:
        model = settings.model(explanation.name, published_experiments())
        points = posteriors["published", explanation.name].points
        for i, name in enumerate(model.names):
            low, high = np.quantile(points[:, i], INTERVAL)
            prior_low, prior_high = (float(model.priors[name].of_share(np.array(share))) for share in INTERVAL)
            rows.append(
                {
                    "explanation": explanation.name,
                    "parameter": name,
                    "mean": float(points[:, i].mean()),
                    "deviation": float(points[:, i].std()),
                    "low": float(low),
                    "high": float(high),
                    "prior_low": prior_low,
                    "prior_high": prior_high,
                }
            )
    return pl.DataFrame(rows)


def offset_table(settings: CauseSettings, posteriors: Posteriors) -> pl.DataFrame:
    """Distance of the sphere's image from the origin of the radii: mean and central 95 %, posterior and prior."""
    rows = []
    for explanation in settings.explanations:
        if "misalignment" in explanation.free and not explanation.centred:
            model = settings.model(explanation.name, published_experiments())
            # ends of the prior's band to some 2 %
            shares = generator("study", "cause", "offset").uniform(size=(4000, len(model.names)))
            row: dict[str, object] = {"explanation": explanation.name}
            points = posteriors["published", explanation.name].points
            for label, drawn in (("", points), ("prior_", model.point(shares))):
                offset = np.hypot(*sphere_image_px(model.named(drawn), model.rig))
                low, high = np.quantile(offset, INTERVAL)
                mean = float(np.mean(offset))
                row |= {f"{label}mean_px": mean, f"{label}low_px": float(low), f"{label}high_px": float(high)}
            rows.append(row)
    return pl.DataFrame(rows)


def correlation_table(settings: CauseSettings, posteriors: Posteriors) -> pl.DataFrame:
    """Correlations of the posteriors of the drawn explanations, strongest first."""
    rows = []
    for name in settings.drawn:
        names = settings.explanation(name).parameters
        matrix = np.atleast_2d(np.corrcoef(posteriors["published", name].points.T))
        rows += [
            {"explanation": name, "first": a, "second": b, "correlation": float(matrix[i, j])}
            for i, a in enumerate(names)
            for j, b in enumerate(names)
            if i < j
        ]
    return pl.DataFrame(rows).sort(pl.col("correlation").abs(), descending=True)


def alike_table(settings: CauseSettings, posteriors: Posteriors) -> pl.DataFrame:
    """Cosines between what parameters do to the estimates, at the posterior median."""
    rows = []
    for name in settings.drawn:
        model = settings.model(name, published_experiments())
        median = np.median(posteriors["published", name].points, axis=0)
        rows += [
            {"explanation": name, "first": a, "second": b, "cosine": cosine}
            for a, b, cosine in alike_parameters(model, median)
        ]
    return pl.DataFrame(rows).sort(pl.col("cosine").abs(), descending=True)


def left_out_table(settings: CauseSettings, posteriors: Posteriors) -> pl.DataFrame:
    """Log density of each table predicted from the other three."""
    rows = []
    for name in settings.left_out:
        model = settings.model(name, published_experiments())
        for table in range(TABLES):
            score, error = left_out_score(model, posteriors["without", table, name].points, table)
            rows.append({"explanation": name, "table": table + 1, "score": score, "error": error})
    schema = {"explanation": pl.String, "table": pl.Int64, "score": pl.Float64, "error": pl.Float64}
    return pl.DataFrame(rows, schema=schema)


def made_up_table(settings: CauseSettings, posteriors: Posteriors, runs: list[Run]) -> pl.DataFrame:
    """Candidates on made-up data: evidence, and how many true values the truth's 90 % intervals hold."""
    rows = []
    for run in runs:
        if run.key[0] == "made-up":
            _, number, repeat, name = run.key
            truth, own = settings.validation.truths[int(number)], posteriors[run.key]
            held = coverage(run.model, own.points, truth.values, COVERED) if name == truth.explanation else {}
            rows.append(
                {
                    "truth": truth.explanation,
                    "repeat": int(repeat),
                    "explanation": str(name),
                    "log_evidence": own.log_evidence,
                    "log_evidence_error": evidence_error(own.log_evidence_error, 1),
                    "covered": sum(held.values()),
                    "parameters": len(held),
                }
            )
    schema = ["truth", "repeat", "explanation", "log_evidence", "log_evidence_error", "covered", "parameters"]
    return pl.DataFrame(rows, schema=None if rows else schema)


def density_table(settings: CauseSettings, posteriors: Posteriors) -> pl.DataFrame:
    """Log density of each published estimate at posterior medians, by the likelihood and by brute force."""
    data, rows = published_experiments(), []
    for name in settings.drawn:
        model = settings.model(name, data)
        median = np.median(posteriors["published", name].points, axis=0)
        random = generator("study", "cause", "brute force", name)
        simulated, linear = brute_force(model, median, random, settings.brute_force)
        rows += [
            {
                "explanation": name,
                "table": int(data.table[i]) + 1,
                "depth_m": float(data.depth_m[i]),
                "stroke_m": float(data.stroke_m[i]),
                "simulated": float(simulated[i]),
                "linear": float(linear[i]),
            }
            for i in range(len(data))
        ]
    return pl.DataFrame(rows)


def short_stroke_table(height_m: float = -0.21, z_c_m: float = 0.26) -> pl.DataFrame:
    """Errors of eqs. (4) and (5) from exact pixels of an aligned rig, by experiment.

    Eq. (4) does not use h << D; eq. (5) leaves out the mirror's radius alone.
    """
    data = published_experiments()
    world: dict[str, Array] = {"z_c_m": np.asarray(z_c_m)}
    world.update({f"height_{k}_m": np.asarray(height_m) for k in range(1, TABLES + 1)})
    columns = {
        "table": data.table + 1,
        "depth_m": data.depth_m,
        "stroke_m": data.stroke_m,
        "published_error_m": data.estimate_m - data.depth_m,
    }
    equations: tuple[Literal[4, 5], ...] = (4, 5)
    for equation in equations:
        depth = read_depths(world, data, Reader(equation=equation), Rig()).depth_m
        columns[f"eq{equation}_error_m"] = depth - data.depth_m
    return pl.DataFrame(columns)


def grid_of(table: int, points: int = 40) -> Experiments:
    """Experiments along one table: strokes of Tables 1 to 3 (0 to 2), depths of Table 4 (3)."""
    data = published_experiments()
    own = data.chosen(data.table == table)
    ends = np.linspace(0.0, 1.0, points)

    def along(values: Array) -> Array:
        return np.asarray(values.min() + np.ptp(values) * ends)

    depth, stroke = along(own.depth_m), along(own.stroke_m)
    # as Table 4: to the millimetre
    return Experiments(np.full(points, table), depth, stroke, depth, np.full(points, 1e-3))


def _left_out(settings: CauseSettings, posteriors: Posteriors, name: str) -> tuple[float, float]:
    """Sum over the four tables and its error, NaN where it was not asked for."""
    if name not in settings.left_out:
        return float("nan"), float("nan")
    own = left_out_table(settings.model_copy(update={"left_out": [name]}), posteriors)
    return float(np.sum(own["score"].to_numpy())), float(np.linalg.norm(own["error"].to_numpy()))
