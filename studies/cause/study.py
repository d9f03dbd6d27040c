"""Study `cause`: what makes the error curves that the paper has published.

The run comes first, then the findings from its tables, then the small tables of the report. Log evidences are natural
logarithms; a finding gives two of their errors on both sides.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import polars as pl

from phibench.studies.cause import tables
from phibench.studies.cause.drawings import evidence_drawing, posterior_drawing, predictive_drawing
from phibench.studies.cause.model import WHOLE_PIXEL_PX
from phibench.studies.cause.nested_sampling import (
    CauseSettings,
    all_runs,
    pooled_runs,
    require_consistent,
    require_sampler,
    run_all,
)
from phibench.studies.cause.tables import DECIDED, ENOUGH, FLOOR, SIGMAS, verdict
from phibench.studies.findings import Finding, Row
from phibench.studies.framework import Study, StudyDatasets, StudyResult

ALIKE = 0.95  # cosine from which two parameters do the same
SMALL_P = 0.05  # of a posterior predictive check: the explanation does not describe the data

_LIMITS = (
    "no azimuth, spot height, lens distance or way of reading is in the paper: all are drawn from priors, "
    "and evidences depend on these",
    "the decentre has its component along the tilt alone, which restricts the prior: where spots are 45 to 135 deg "
    "from the tilt, 1 mm across it moves the estimates by more (1.0 to 2.1 % rms) than 1 mm along it (0.2 to 1.9 %); "
    "azimuths from 0 to 180 deg are all of them only because of that",
    "a tilted stroke axis, lens distortion, a mirror out of round and errors that change from day to day are not among "
    "the explanations",
)


def run(settings: CauseSettings, datasets: StudyDatasets) -> StudyResult:
    """Run the study; it needs no data set."""
    require_consistent(settings)
    require_sampler()
    runs = all_runs(settings)
    posteriors = pooled_runs(run_all(runs, datasets.workers), settings)
    table = tables.explanation_table(settings, posteriors)
    scales = tables.scale_table(settings, posteriors)
    posterior = tables.posterior_table(settings, posteriors)
    offsets = tables.offset_table(settings, posteriors)
    correlations = tables.correlation_table(settings, posteriors)
    alike = tables.alike_table(settings, posteriors)
    made_up = tables.made_up_table(settings, posteriors, runs)
    density = tables.density_table(settings, posteriors)
    short = tables.short_stroke_table()
    found = (
        *evidence_findings(table),
        *convention_findings(settings, table),
        *noise_findings(table),
        *residual_findings(table),
        *offset_findings(table, offsets),
        *scale_findings(scales),
        *left_out_findings(table),
        *alike_findings(settings, alike, correlations),
        *made_up_findings(made_up),
        *density_findings(density),
        *short_stroke_findings(short),
    )
    best = f"Best: {table.sort('log_evidence', descending=True)['text'][0]}."
    noise = "; ".join(finding.text for finding in noise_findings(table) if finding.unit == "px")
    drawn = ", ".join(f"'{settings.explanation(name).text}'" for name in settings.drawn)
    return StudyResult(
        {
            "table": table,
            "prior_scales": scales,
            "posterior": posterior,
            "offsets": offsets,
            "correlations": correlations,
            "alike": alike,
            "left_out": tables.left_out_table(settings, posteriors),
            "made_up": made_up,
            "density": density,
            "short_stroke": short,
        },
        found,
        (
            predictive_drawing(
                settings, posteriors, f"Published errors over 90 % bands and medians of {drawn}. {best}"
            ),
            evidence_drawing(table, scales, f"Log evidence of {len(table)} explanations. {best}"),
            posterior_drawing(settings, posteriors, f"Posteriors of {drawn}. Reading noise: {noise}."),
        ),
        {
            "Explanations, best first": explanations_shown(table),
            **{
                f"Posterior of '{settings.explanation(name).text}'": posterior_shown(posterior, name)
                for name in settings.drawn
            },
        },
        _LIMITS + _left_out(settings),
    )


def _left_out(settings: CauseSettings) -> tuple[str, ...]:
    few = (
        f"each explanation was sampled {settings.repeats} time(s), too few to measure the scatter: the error of a log "
        f"evidence is taken for {FLOOR:g} at least"
    )
    return (
        *((few,) if settings.repeats < ENOUGH else ()),
        *(() if settings.prior_scales else ("priors were not widened",)),
    )


# -- findings ------------------------------------------------------------------------------------------------------


def evidence_findings(table: pl.DataFrame) -> Iterator[Finding]:
    """Log evidence of every explanation, against the first one and against the best one."""
    rows = table.sort("log_evidence", descending=True).to_dicts()
    first, best = table.row(0, named=True), rows[0]
    for row in rows:
        if row["explanation"] != first["explanation"]:
            label = f"log evidence against '{first['text']}': {row['text']}"
            yield _decided(label, row["against"], row["against_error"])
    for row in rows[1:]:
        yield _against(f"log evidence against the best, '{best['text']}': {row['text']}", row, best)


def convention_findings(settings: CauseSettings, table: pl.DataFrame) -> Iterator[Finding]:
    """Senses of phi within each family that differs by nothing else, against the largest evidence of the family."""
    evidence = {row["explanation"]: row for row in table.iter_rows(named=True)}
    families: dict[str, dict[str, dict[str, Any]]] = {}
    labels = {}
    for explanation in settings.explanations:
        key = explanation.model_dump_json(exclude={"name", "text", "convention"})
        families.setdefault(key, {})[explanation.convention] = evidence[explanation.name]
        labels[key] = (", ".join(explanation.free) or "noise alone") + (", centred" if explanation.centred else "")
    for key, family in families.items():
        best, *others = sorted(family, key=lambda sense: -float(family[sense]["log_evidence"]))
        for sense in others:
            yield _against(f"sense of phi, {labels[key]}: phi_{sense} against phi_{best}", family[sense], family[best])


def noise_findings(table: pl.DataFrame) -> Iterator[Finding]:
    """Reading noise that each explanation needs, against rounding to whole pixels, and the error that it leaves."""
    for row in table.sort("log_evidence", descending=True).iter_rows(named=True):
        if row["noise_low_px"] < row["noise_high_px"]:
            ends = (row["noise_px"], row["noise_low_px"], row["noise_high_px"])
            noise = Finding(f"reading noise of a radius: {row['text']}", *ends, "px")
            yield noise.judged(">=", WHOLE_PIXEL_PX)
        yield Finding(f"rms error left, of the real depth: {row['text']}", 100.0 * row["left_rms"], unit="%")


def residual_findings(table: pl.DataFrame) -> Iterator[Finding]:
    """Posterior predictive p of every explanation: size of the residuals, and trends along the stroke."""
    for column, name in (("chi2_p", "size"), ("trend_p", "trend")):
        for row in table.sort(column).iter_rows(named=True):
            yield Finding(f"posterior predictive p, {name} of the residuals: {row['text']}", row[column]).judged(
                ">=", SMALL_P
            )


def offset_findings(table: pl.DataFrame, offsets: pl.DataFrame) -> Iterator[Finding]:
    """Distance of the sphere's image from the point from which radii are counted; half as far again as by the prior."""
    texts = dict(table.select("explanation", "text").iter_rows())
    for row in offsets.iter_rows(named=True):
        text = texts[row["explanation"]]
        offset = Finding(f"offset of the sphere's image: {text}", row["mean_px"], row["low_px"], row["high_px"], "px")
        # half as much again: more than the prior's own band would give
        yield offset.judged(">=", 1.5 * row["prior_low_px"])
        prior = (row["prior_mean_px"], row["prior_low_px"], row["prior_high_px"])
        yield Finding(f"offset of the sphere's image, prior: {text}", *prior, "px")


def scale_findings(scales: pl.DataFrame) -> Iterator[Finding]:
    """Log evidence against the first explanation, by the width of the priors of misalignment, stroke and scale."""
    for row in scales.sort("explanation", "scale", maintain_order=True).iter_rows(named=True):
        label = f"log evidence with priors {row['scale']:g} times as wide: {row['explanation']}"
        yield _decided(label, row["against"], row["error"])


def left_out_findings(table: pl.DataFrame) -> Iterator[Finding]:
    """Each table predicted from the other three: sum of the four log densities."""
    rows = table.filter(pl.col("left_out_score").is_not_nan()).sort("left_out_score", descending=True)
    for row in rows.iter_rows(named=True):
        value, half = row["left_out_score"], SIGMAS * row["left_out_error"]
        yield Finding(f"log density of left-out tables: {row['text']}", value, value - half, value + half)


def alike_findings(settings: CauseSettings, alike: pl.DataFrame, correlations: pl.DataFrame) -> Iterator[Finding]:
    """Parameters whose effects on the 25 estimates are alike, and the strongest correlation of the posterior."""
    name = next((n for n in settings.drawn if settings.explanation(n).free), settings.drawn[0])
    own = alike.filter(pl.col("explanation") == name)
    same = own.filter(pl.col("cosine").abs() > ALIKE)
    for a, b, cosine in (same if len(same) else own[:1]).select("first", "second", "cosine").iter_rows():
        yield Finding(f"size of the cosine between effects: {a} and {b}", abs(cosine)).judged("<=", ALIKE)
    strongest = correlations.filter(pl.col("explanation") == name).row(0, named=True)
    label = f"strongest correlation of the posterior: {strongest['first']} and {strongest['second']}"
    yield Finding(label, strongest["correlation"])


def made_up_findings(made_up: pl.DataFrame) -> Iterator[Finding]:
    """Evidences on made-up data, whose cause is known."""
    for (truth,), own in made_up.group_by("truth", maintain_order=True):
        wins = lost = 0
        for _, rows in own.group_by("repeat", maintain_order=True):
            best = rows.sort("log_evidence", descending=True).row(0, named=True)
            right = rows.filter(pl.col("explanation") == truth).to_dicts()
            wins += best["explanation"] == truth
            lost += bool(right) and _against("", right[0], best).verdict == "disfavoured"
        of, values = f"of {own['repeat'].n_unique()}", f"of {own['parameters'].sum()}"
        yield Finding(f"made-up data of '{truth}': draws in which it has the largest evidence", wins, unit=of)
        yield Finding(f"made-up data of '{truth}': draws that decide against it", lost, unit=of)
        held = int(np.sum(own["covered"].to_numpy()))
        yield Finding(f"made-up data of '{truth}': true values in the 90 % intervals", held, unit=values)


def density_findings(density: pl.DataFrame) -> Iterator[Finding]:
    """Log densities of the likelihood less those of brute-force simulation."""
    gap = (density["linear"] - density["simulated"]).to_numpy()
    largest = float(np.abs(gap[np.isfinite(gap)]).max())
    yield Finding("likelihood against simulation: largest difference of a log density", largest)
    for (name,), own in density.group_by("explanation", maintain_order=True):
        total = float(np.sum((own["linear"] - own["simulated"]).to_numpy()))
        yield Finding(f"likelihood against simulation: sum over all estimates, {name}", total)


def short_stroke_findings(short: pl.DataFrame) -> Iterator[Finding]:
    """Errors of eqs. (4) and (5) with exact phi_ray; neither needs h << D to rise or fall."""
    for equation in (4, 5):
        worst = 1e3 * float(np.abs(short[f"eq{equation}_error_m"].to_numpy()).max())
        yield Finding(
            f"eq. ({equation}) with exact phi_ray: largest error of {len(short)} experiments", worst, unit="mm"
        )
    own = short.filter(pl.col("table") == 1).sort("stroke_m")
    first, last = own.row(0, named=True), own.row(-1, named=True)
    for row in (first, last):
        label = f"eq. (5) with exact phi_ray: error of Table 1 at h = {row['stroke_m']:g} m"
        yield Finding(label, 1e3 * float(row["eq5_error_m"]), unit="mm")
    growth = 1e3 * (abs(float(last["eq5_error_m"])) - abs(float(first["eq5_error_m"])))
    label = "eq. (5) with exact phi_ray: growth of the size of the error along Table 1"
    yield Finding(label, growth, unit="mm").judged("<=", 0.0)
    change = 1e3 * float(last["published_error_m"] - first["published_error_m"])
    yield Finding("published: change of the error along Table 1", change, unit="mm")


def _against(label: str, row: dict[str, Any], other: dict[str, Any]) -> Finding:
    """Difference of two log evidences, with the verdict on the first."""
    error = float(np.hypot(row["log_evidence_error"], other["log_evidence_error"]))
    return _decided(label, row["log_evidence"] - other["log_evidence"], error)


def _decided(label: str, difference: float, error: float) -> Finding:
    half = SIGMAS * error
    return Finding(
        label, difference, difference - half, difference + half, "ln", ">=", DECIDED, verdict(difference, error)
    )


# -- small tables of the report ---------------------------------------------------------------------------------------


def explanations_shown(table: pl.DataFrame) -> tuple[Row, ...]:
    """All explanations, best first."""
    rows: list[Row] = [
        (
            "explanation",
            "free",
            "log evidence against the first",
            "noise, px",
            "rms left, %",
            "chi2 p",
            "trend p",
            "left-out score",
        )
    ]
    for row in table.sort("log_evidence", descending=True).iter_rows(named=True):
        score = row["left_out_score"]
        rows.append(
            (
                row["text"],
                str(row["parameters"]),
                f"{row['against']:+.1f} +- {row['against_error']:.1f}",
                f"{row['noise_px']:.2f} ({row['noise_low_px']:.2f} to {row['noise_high_px']:.2f})",
                f"{100.0 * row['left_rms']:.2f}",
                f"{row['chi2_p']:.3f}",
                f"{row['trend_p']:.3f}",
                "-" if np.isnan(score) else f"{score:.1f} +- {row['left_out_error']:.1f}",
            )
        )
    return tuple(rows)


def posterior_shown(posterior: pl.DataFrame, explanation: str) -> tuple[Row, ...]:
    """Parameters of one explanation with the intervals of posterior and prior."""
    own = posterior.filter(pl.col("explanation") == explanation)
    rows = [
        (
            row["parameter"],
            f"{row['mean']:.3g}",
            f"{row['low']:.3g} to {row['high']:.3g}",
            f"{row['prior_low']:.3g} to {row['prior_high']:.3g}",
        )
        for row in own.iter_rows(named=True)
    ]
    return (("parameter", "mean", "95 %", "prior, 95 %"), *rows)


STUDY = Study(
    "cause",
    "What made the paper's error curves",
    "Which combination of sense of phi, misalignment, reading noise and unknown rig numbers explains the 25 published "
    "estimates best, and what can they not decide?",
    CauseSettings,
    run,
)
