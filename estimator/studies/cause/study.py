"""Sentences of the study `cause`, made from its tables.

Study `cause`: which explanation of the paper's 25 estimates the numbers support, and what they cannot decide.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl

from phibench.estimator.studies.cause import tables
from phibench.estimator.studies.cause.drawings import evidence_drawing, posterior_drawing, predictive_drawing
from phibench.estimator.studies.cause.nested_sampling import (
    CauseSettings,
    all_runs,
    pooled_runs,
    require_consistent,
    require_sampler,
    run_all,
)
from phibench.estimator.studies.cause.tables import ENOUGH, FLOOR, RULE, Verdict, verdict
from phibench.estimator.studies.framework import Material, Result, Row, Study

ALIKE = 0.95  # cosine from which two parameters do the same
SMALL_P = 0.05


def best_sentence(table: pl.DataFrame) -> str:
    """Best evidence, and what cannot be told from it."""
    rows = table.sort("log_evidence", descending=True)
    best, first = rows.row(0, named=True), table.row(0, named=True)
    near = [row["text"] for row in rows[1:].iter_rows(named=True) if _of_two(best, row)[2] == "undecided"]
    rest = (
        f"Undecided against it: {'; '.join(near)} ({RULE})."
        if near
        else f"It is favoured over every other explanation ({RULE})."
    )
    gain = (
        "the reference itself"
        if best["explanation"] == first["explanation"]
        else f"log evidence {best['against']:+.1f} +- {best['against_error']:.1f} against '{first['text']}'"
    )
    return f"Of {len(table)} explanations '{best['text']}' has the largest evidence ({gain}). {rest}"


def _of_two(row: dict[str, Any], other: dict[str, Any]) -> tuple[float, float, Verdict]:
    """Difference of two log evidences, its error, the verdict on the first."""
    difference = row["log_evidence"] - other["log_evidence"]
    error = float(np.hypot(row["log_evidence_error"], other["log_evidence_error"]))
    return difference, error, verdict(difference, error)


def convention_sentence(settings: CauseSettings, table: pl.DataFrame) -> str:
    """What the data say of the sense of phi, in each family that differs by nothing else."""
    families: dict[str, dict[str, dict[str, Any]]] = {}
    evidence = {row["explanation"]: row for row in table.iter_rows(named=True)}
    for explanation in settings.explanations:
        key = explanation.model_dump_json(exclude={"name", "text", "convention"})
        families.setdefault(key, {})[explanation.convention] = evidence[explanation.name]
    named = {"": "noise alone", "misalignment": "tilt and decentre", "misalignment,stroke,scale": "all errors"}
    parts = []
    for key, values in families.items():
        if len(values) > 1:
            example = next(
                e for e in settings.explanations if e.model_dump_json(exclude={"name", "text", "convention"}) == key
            )
            label = named.get(",".join(example.free), ", ".join(example.free)) + (
                ", centred" if example.centred else ""
            )
            best, *others = sorted(values, key=lambda c: -values[c]["log_evidence"])
            against = ((c, *_of_two(values[c], values[best])) for c in others)
            parts.append(
                f"{label}: phi_{best} has most, then "
                + ", ".join(f"phi_{c} {by:+.1f} +- {error:.1f} ({word})" for c, by, error, word in against)
            )
    return f"Log evidence by sense of phi, against the largest of its family: {'; '.join(parts)}." if parts else ""


def noise_sentence(table: pl.DataFrame) -> str:
    """Reading noise that the first and the best explanation need."""
    best, first = table.sort("log_evidence", descending=True).row(0, named=True), table.row(0, named=True)
    chosen = [first] if best["explanation"] == first["explanation"] else [first, best]
    parts = [
        f"'{row['text']}' needs {row['noise_px']:.2f} px ({row['noise_low_px']:.2f} to {row['noise_high_px']:.2f}) and "
        f"leaves {100.0 * row['left_rms']:.2f} % rms of the real depth"
        for row in chosen
    ]
    low = chosen[-1]["noise_low_px"]
    whole = 12.0**-0.5
    verdict = (
        f"more than rounding to whole pixels makes ({whole:.2f} px)"
        if low > whole
        else f"an interval that reaches down to what rounding to whole pixels makes ({whole:.2f} px)"
    )
    return f"Reading noise of a radius, mean and 95 %: {'; '.join(parts)}. The last is {verdict}."


def rival_sentences(table: pl.DataFrame) -> tuple[str, ...]:
    """For, against and undecided; and whose residuals are not what noise makes."""
    first, groups = table.row(0, named=True), _verdicts(table)
    parts = [
        f"{word}: " + ", ".join(f"{row['text']} ({row['against']:+.1f} +- {row['against_error']:.1f})" for row in rows)
        for word, rows in groups.items()
        if rows
    ]
    words = []
    if parts:
        words.append(f"Log evidence against '{first['text']}' ({RULE}): {'; '.join(parts)}.")
    for column, fault in (
        ("chi2_p", "are too large"),
        ("trend_p", "run in trends that independent noise does not make"),
    ):
        bad = table.filter(pl.col(column) < SMALL_P).sort(column)
        if len(bad):
            named = ", ".join(f"{row['text']} ({row[column]:.3f})" for row in bad.iter_rows(named=True))
            words.append(f"Residuals {fault} (posterior predictive p below {SMALL_P:g}) for: {named}.")
    return tuple(words)


def _verdicts(table: pl.DataFrame) -> dict[Verdict, list[dict[str, Any]]]:
    groups: dict[Verdict, list[dict[str, Any]]] = {"favoured": [], "disfavoured": [], "undecided": []}
    for row in table[1:].sort("against", descending=True).iter_rows(named=True):
        groups[verdict(row["against"], row["against_error"])].append(row)
    return groups


def offset_sentence(table: pl.DataFrame, offsets: pl.DataFrame) -> str:
    """How far from the mirror's image radii must have been counted."""
    texts = dict(table.select("explanation", "text").iter_rows())
    best = table.join(offsets, on="explanation").sort("log_evidence", descending=True)
    if not len(best):
        return ""
    row = best.row(0, named=True)
    moved = "above" if row["low_px"] > row["prior_low_px"] * 1.5 else "not above"
    return (
        f"Of those with tilt and decentre '{texts[row['explanation']]}' has the largest evidence; there the image of "
        f"the sphere lies {row['mean_px']:.0f} px ({row['low_px']:.0f} to {row['high_px']:.0f}) from the point from "
        f"which radii are counted (prior: {row['prior_low_px']:.0f} to {row['prior_high_px']:.0f}); its lower "
        f"end is {moved} the prior's. Section 5 of the paper says that the mirror's image was centred."
    )


def scale_sentence(scales: pl.DataFrame) -> str:
    """How far prior widths move the evidences."""
    if scales["scale"].n_unique() < 2:
        return ""
    parts = []
    for name in scales["explanation"].unique(maintain_order=True):
        own = scales.filter(pl.col("explanation") == name).sort("scale")
        values = own.select("against", "error").iter_rows()
        parts.append(f"{name} {' / '.join(f'{x:+.1f} +- {error:.1f}' for x, error in values)}")
    widths = " / ".join(f"{x:g}" for x in sorted(scales["scale"].unique()))
    return f"With the normal priors of misalignment, stroke and scale {widths} times as wide: {'; '.join(parts)}."


def left_out_sentence(table: pl.DataFrame) -> str:
    """Prediction of each table from the other three."""
    rows = table.filter(pl.col("left_out_score").is_not_nan()).sort("left_out_score", descending=True)
    if not len(rows):
        return ""
    words = "; ".join(
        f"{row['text']} {row['left_out_score']:.1f} +- {row['left_out_error']:.1f}"
        for row in rows.iter_rows(named=True)
    )
    return (
        f"Each table predicted from the other three, sum of the four log densities: {words}. "
        f"Here '{rows['text'][0]}' predicts best."
    )


def alike_sentence(settings: CauseSettings, alike: pl.DataFrame, correlations: pl.DataFrame) -> str:
    """What the 25 numbers cannot tell apart."""
    name = next((n for n in settings.drawn if settings.explanation(n).free), settings.drawn[0])
    own = alike.filter(pl.col("explanation") == name)
    same = own.filter(pl.col("cosine").abs() > ALIKE)
    pairs = ", ".join(f"{a} and {b} ({c:+.3f})" for a, b, c in same.select("first", "second", "cosine").iter_rows())
    strongest = correlations.filter(pl.col("explanation") == name).row(0, named=True)
    told = (
        f"do the same to within a cosine of {ALIKE:g}: {pairs}"
        if pairs
        else f"all differ by more than a cosine of {ALIKE:g}"
    )
    return (
        f"For '{settings.explanation(name).text}' the effects of parameters on the estimates, in units of their noise, "
        f"{told}. The strongest correlation of its posterior is {strongest['correlation']:+.2f}, between "
        f"{strongest['first']} and {strongest['second']}."
    )


def made_up_sentence(made_up: pl.DataFrame) -> str:
    """What the method says of worlds that are known."""
    parts = []
    for truth in made_up["truth"].unique(maintain_order=True):
        own = made_up.filter(pl.col("truth") == truth)
        wins = lost = 0
        for repeat in own["repeat"].unique():
            rows = own.filter(pl.col("repeat") == repeat)
            best = rows.sort("log_evidence", descending=True).row(0, named=True)
            right = rows.filter(pl.col("explanation") == truth).to_dicts()
            wins += best["explanation"] == truth
            lost += bool(right) and _of_two(right[0], best)[2] == "disfavoured"
        held, of = own["covered"].sum(), own["parameters"].sum()
        n = own["repeat"].n_unique()
        parts.append(
            f"data of '{truth}' gave it the largest evidence in {wins} of {n} draws and decided against it in {lost}, "
            f"with {held} of {of} true values in the 90 % intervals"
        )
    return f"Made-up data: {'; '.join(parts)}." if parts else ""


def density_sentence(density: pl.DataFrame) -> str:
    """How well the likelihood agrees with simulation."""
    gap = (density["linear"] - density["simulated"]).to_numpy()
    good = np.isfinite(gap)
    worst = density.row(int(np.nanargmax(np.where(good, np.abs(gap), np.nan))), named=True)
    sums = [
        f"{name} {float(np.sum((own['linear'] - own['simulated']).to_numpy())):+.2f}"
        for (name,), own in density.group_by("explanation", maintain_order=True)
    ]
    return (
        f"The Gaussian in 1/D differs from brute-force simulation by at most {np.abs(gap[good]).max():.2f} in the log "
        f"density of one estimate (Table {worst['table']}, h = {worst['stroke_m']:g} m), and in the sum over all by "
        f"{', '.join(sums)}."
    )


def short_stroke_sentence(short: pl.DataFrame) -> str:
    """Whether h << D can make the error rise at long h."""
    own = short.filter(pl.col("table") == 1).sort("stroke_m")
    first, last = own.row(0, named=True), own.row(-1, named=True)
    change = "grows" if abs(last["eq5_error_m"]) > abs(first["eq5_error_m"]) else "falls"
    worst4, worst5 = (float(np.abs(short[f"eq{k}_error_m"].to_numpy()).max()) for k in (4, 5))
    published = last["published_error_m"] - first["published_error_m"]
    moved = last["eq5_error_m"] - first["eq5_error_m"]
    return (
        f"Can a stroke that is not short against D make the error rise (section 6)? Eq. (4) does not use h << D: with "
        f"exact phi_ray its error stays below {1e3 * worst4:.2f} mm in all {len(short)} experiments. Eq. (5) leaves "
        f"out the mirror's radius alone: its error is at most {1e3 * worst5:.0f} mm, and in Table 1 it {change} from "
        f"{1e3 * first['eq5_error_m']:+.0f} mm at h = {first['stroke_m']:g} m to {1e3 * last['eq5_error_m']:+.0f} mm "
        f"at {last['stroke_m']:g} m, a change of {1e3 * moved:+.0f} mm where the published errors change by "
        f"{1e3 * published:+.0f} mm."
    )


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


_LIMITS = (
    "no azimuth, spot height, lens distance or way of reading is in the paper: all are drawn from priors, "
    "and evidences depend on these",
    "the decentre has its component along the tilt alone, which restricts the prior: where spots are 45 to 135 deg "
    "from the tilt, 1 mm across it moves the estimates by more (1.0 to 2.1 % rms) than 1 mm along it (0.2 to 1.9 %); "
    "azimuths from 0 to 180 deg are all of them only because of that",
    "a tilted stroke axis, lens distortion, a mirror out of round and errors that change from day to day are not among "
    "the explanations",
)


def run(settings: CauseSettings, material: Material) -> Result:
    """Run the study; it needs no data set."""
    require_consistent(settings)
    require_sampler()
    runs = all_runs(settings)
    posteriors = pooled_runs(run_all(runs, material.workers), settings)
    table = tables.explanation_table(settings, posteriors)
    scales = tables.scale_table(settings, posteriors)
    posterior = tables.posterior_table(settings, posteriors)
    offsets = tables.offset_table(settings, posteriors)
    correlations = tables.correlation_table(settings, posteriors)
    alike = tables.alike_table(settings, posteriors)
    made_up = tables.made_up_table(settings, posteriors, runs)
    density = tables.density_table(settings, posteriors)
    short = tables.short_stroke_table()
    best = best_sentence(table)
    words = (
        best,
        convention_sentence(settings, table),
        noise_sentence(table),
        *rival_sentences(table),
        offset_sentence(table, offsets),
        scale_sentence(scales),
        left_out_sentence(table),
        alike_sentence(settings, alike, correlations),
        made_up_sentence(made_up),
        density_sentence(density),
        short_stroke_sentence(short),
    )
    drawn = ", ".join(f"'{settings.explanation(name).text}'" for name in settings.drawn)
    return Result(
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
        tuple(filter(None, words)),
        (
            predictive_drawing(
                settings, posteriors, f"Published errors over 90 % bands and medians of {drawn}. {best}"
            ),
            evidence_drawing(table, scales, f"Log evidence of {len(table)} explanations. {best}"),
            posterior_drawing(settings, posteriors, f"Posteriors of {drawn}. {noise_sentence(table)}"),
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


STUDY = Study(
    "cause",
    "What made the paper's error curves",
    "Which combination of sense of phi, misalignment, reading noise and unknown rig numbers explains the 25 published "
    "estimates best, and what can they not decide?",
    CauseSettings,
    run,
)
