"""Tables of the study `cause` from its posteriors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
import polars as pl

from phibench.estimator.studies.cause_checks import alike, coverage, fit_of, left_out_score
from phibench.estimator.studies.cause_evidence import evidence_error
from phibench.estimator.studies.cause_model import NOISE, WHOLE_PIXEL_PX
from phibench.estimator.studies.cause_runs import Run
from phibench.estimator.studies.cause_sampler import Posterior
from phibench.estimator.studies.cause_settings import CauseSettings
from phibench.estimator.studies.cause_simulation import brute_force
from phibench.estimator.studies.paper_reading import (
    TABLES,
    Experiments,
    Reader,
    published_experiments,
    read,
    sphere_image_px,
)
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.scenes.streams import Name, generator

INTERVAL = (0.025, 0.975)
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
    """How far the image of the sphere lies from where radii were counted, mean and central 95 %, and by the prior."""
    rows = []
    for explanation in settings.explanations:
        if "misalignment" in explanation.free and not explanation.centred:
            model = settings.model(explanation.name, published_experiments())
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
            {"explanation": name, "first": a, "second": b, "cosine": cosine} for a, b, cosine in alike(model, median)
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
        depth = read(world, data, Reader(equation=equation), Rig()).depth_m
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
    return Experiments(np.full(points, table), depth, stroke, depth, np.full(points, 1e-3))


def _left_out(settings: CauseSettings, posteriors: Posteriors, name: str) -> tuple[float, float]:
    """Sum over the four tables and its error, NaN where it was not asked for."""
    if name not in settings.left_out:
        return float("nan"), float("nan")
    own = left_out_table(settings.model_copy(update={"left_out": [name]}), posteriors)
    return float(np.sum(own["score"].to_numpy())), float(np.linalg.norm(own["error"].to_numpy()))
