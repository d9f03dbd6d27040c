"""Study `cause`: explanations of the paper's depth errors compared by Bayesian evidence; findings and drawings.

The run comes first, then the findings from its tables, the small tables of the report, and the drawings: predicted
errors, evidence of each explanation, posterior of noise and tilt. Log evidences are natural logarithms; a finding gives
two of their errors on both sides.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import polars as pl

from phibench.scenes.random_streams import generator
from phibench.studies.cause import tables
from phibench.studies.cause.model import NOISE, WHOLE_PIXEL_PX
from phibench.studies.cause.nested_sampling import (
    CauseSettings,
    all_runs,
    pooled_runs,
    posterior_of_run,
    require_consistent,
    require_sampler,
)
from phibench.studies.cause.paper_reading import TABLES, published_experiments
from phibench.studies.cause.tables import DECIDED, ENOUGH, FLOOR, SIGMAS, Posteriors, band, grid_of, verdict
from phibench.studies.framework import (
    COLOURS,
    LINES,
    Drawing,
    Finding,
    Row,
    Study,
    StudyDatasets,
    StudyResult,
    canvas,
    ends_text,
    finished_drawing,
    text_table,
)

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
    sampled_runs = datasets.map(posterior_of_run, runs, "cause, samplings")
    posteriors = pooled_runs(dict(zip((run.key for run in runs), sampled_runs, strict=True)), settings)
    frames = {
        "table": tables.explanation_table(settings, posteriors),
        "prior_scales": tables.scale_table(settings, posteriors),
        "posterior": tables.posterior_table(settings, posteriors),
        "offsets": tables.offset_table(settings, posteriors),
        "correlations": tables.correlation_table(settings, posteriors),
        "alike": tables.alike_table(settings, posteriors),
        "left_out": tables.left_out_table(settings, posteriors),
        "made_up": tables.made_up_table(settings, posteriors, runs),
        "density": tables.density_table(settings, posteriors),
        "short_stroke": tables.short_stroke_table(),
    }
    table = frames["table"]
    found = (
        *evidence_findings(table),
        *convention_findings(settings, table),
        *noise_findings(table),
        *residual_findings(table),
        *offset_findings(table, frames["offsets"]),
        *scale_findings(frames["prior_scales"]),
        *left_out_findings(table),
        *alike_findings(settings, frames["alike"], frames["correlations"]),
        *made_up_findings(frames["made_up"]),
        *density_findings(frames["density"]),
        *short_stroke_findings(frames["short_stroke"]),
    )
    best = f"Best: {table.sort('log_evidence', descending=True)['text'][0]}."
    noise = "; ".join(finding.text for finding in noise_findings(table) if finding.unit == "px")
    texts = {name: f"'{settings.explanation(name).text}'" for name in settings.drawn}
    names = ", ".join(texts.values())
    predicted = f"Published errors over 90 % bands and medians of {names}. {best}"
    return StudyResult(
        frames,
        found,
        (
            predictive_drawing(settings, posteriors, predicted),
            evidence_drawing(table, frames["prior_scales"], f"Log evidence of {len(table)} explanations. {best}"),
            posterior_drawing(settings, posteriors, f"Posteriors of {names}. Reading noise: {noise}."),
        ),
        {
            "Explanations, best first": explanations_shown(table),
            **{f"Posterior of {text}": posterior_shown(frames["posterior"], name) for name, text in texts.items()},
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
    return text_table(
        table.sort("log_evidence", descending=True).to_dicts(),
        {
            "explanation": lambda row: row["text"],
            "free": lambda row: str(row["parameters"]),
            "log evidence against the first": lambda row: f"{row['against']:+.1f} +- {row['against_error']:.1f}",
            "noise, px": lambda row: ends_text((row[f"noise{end}_px"] for end in ("", "_low", "_high")), ".2f"),
            "rms left, %": lambda row: f"{100.0 * row['left_rms']:.2f}",
            "chi2 p": lambda row: f"{row['chi2_p']:.3f}",
            "trend p": lambda row: f"{row['trend_p']:.3f}",
            "left-out score": _left_out_text,
        },
    )


def _left_out_text(row: dict[str, Any]) -> str:
    score = row["left_out_score"]
    return "-" if np.isnan(score) else f"{score:.1f} +- {row['left_out_error']:.1f}"


def posterior_shown(posterior: pl.DataFrame, explanation: str) -> tuple[Row, ...]:
    """Parameters of one explanation with the intervals of posterior and prior."""
    return text_table(
        posterior.filter(pl.col("explanation") == explanation).to_dicts(),
        {
            "parameter": lambda row: row["parameter"],
            "mean": lambda row: f"{row['mean']:.3g}",
            "95 %": lambda row: f"{row['low']:.3g} to {row['high']:.3g}",
            "prior, 95 %": lambda row: f"{row['prior_low']:.3g} to {row['prior_high']:.3g}",
        },
    )


# -- drawings ----------------------------------------------------------------------------------------------------------

LEVEL = 0.9  # of the bands that are drawn
_TITLES = ("Figure 9: D = 2.18 m", "Figure 10: D = 3.18 m", "Figure 11: D = 4.18 m", "Table 4: h = 0.425 m")
_SCALES = {1.0: "priors as stated", 0.5: "half as wide", 2.0: "twice as wide"}


def predictive_drawing(settings: CauseSettings, posteriors: Posteriors, alt: str) -> Drawing:
    """Published errors over what fitted explanations predict."""
    data = published_experiments()
    with canvas(9.0, 6.0) as figure:
        for table, ax in zip(range(TABLES), figure.subplots(2, 2).flat, strict=True):
            grid, own = grid_of(table), data.chosen(data.table == table)
            across = "depth_m" if table == TABLES - 1 else "stroke_m"
            ax.axhline(0.0, color=COLOURS[7], linewidth=0.8)
            for i, name in enumerate(settings.drawn):
                model = settings.model(name, data)
                points = posteriors["published", name].thinned(settings.predictive)
                random = generator("study", "cause", "band", name, table)
                low, median, high = band(model, points, grid, random, LEVEL) - grid.depth_m
                x = getattr(grid, across)
                ax.fill_between(x, low, high, color=COLOURS[i], alpha=0.15, linewidth=0)
                ax.plot(x, median, LINES[i % len(LINES)], color=COLOURS[i], label=model.explanation.text)
            error = own.estimate_m - own.depth_m
            ax.plot(getattr(own, across), error, "D", color=COLOURS[7], mfc="none", label="published")
            # noise at the shortest stroke is without limit; the points are what the eye should see
            ax.set_ylim(error.min() - 1.5 * np.ptp(error) - 0.1, error.max() + 1.5 * np.ptp(error) + 0.1)
            ax.set(title=_TITLES[table], xlabel=_axis(across), ylabel="error of D (m)")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2)
        return finished_drawing("predictive", figure, alt)


def evidence_drawing(table: pl.DataFrame, scales: pl.DataFrame, alt: str) -> Drawing:
    """Log evidence of every explanation against the first."""
    rows = table.sort("against")
    places = {name: i for i, name in enumerate(rows["explanation"])}
    with canvas(9.0, 0.6 + 0.28 * len(rows)) as figure:
        ax = figure.subplots()
        ax.axvline(0.0, color=COLOURS[7], linewidth=0.8)
        ax.axvspan(-DECIDED, DECIDED, color=COLOURS[6], alpha=0.15, label="odds below 10 to 1")
        for i, (scale, label) in enumerate(_SCALES.items()):
            own = scales.filter(pl.col("scale") == scale)
            if scale == 1.0:
                own = rows.select("explanation", "against", error="against_error")
            if len(own):
                y = [places[name] + 0.18 * (i - 1) * (i > 0) for name in own["explanation"]]
                ax.errorbar(own["against"], y, xerr=own["error"], fmt="osD"[i], color=COLOURS[i], ms=4, label=label)
        ax.set_yticks(range(len(rows)), rows["text"])
        ax.set(xlabel="log evidence against the one at 0 (bars: 1 sigma; decided: two bars or more outside the band)")
        ax.legend(loc="lower right", fontsize=7)
        return finished_drawing("evidence", figure, alt)


def posterior_drawing(settings: CauseSettings, posteriors: Posteriors, alt: str) -> Drawing:
    """Reading noise of the drawn explanations; tilt against decentre where both are free."""
    with canvas(9.0, 3.6) as figure:
        noise, plane = figure.subplots(1, 2)
        for i, name in enumerate(settings.drawn):
            explanation = settings.explanation(name)
            points = posteriors["published", name].thinned(settings.predictive)
            named = dict(zip(explanation.parameters, points.T, strict=True))
            if NOISE in named:
                _histogram(noise, named[NOISE], i, explanation.text)
            if "misalignment" in explanation.free:
                x, y = np.degrees(named["tilt_y_rad"]), 1e3 * named["decentre_x_m"]
                plane.plot(x, y, ".", ms=2, alpha=0.5, color=COLOURS[i], label=explanation.text)
        # deviation of an error uniform over a pixel
        noise.axvline(12.0**-0.5, color=COLOURS[7], linestyle=":", label="whole pixels")
        noise.set(xlabel="reading noise of a radius (px)", ylabel="posterior density (1/px)")
        plane.set(xlabel="tilt (deg)", ylabel="decentre along the tilt (mm)")
        for ax in (noise, plane):
            ax.legend(fontsize=6, markerscale=4)
        return finished_drawing("posterior", figure, alt)


def _histogram(ax: Any, values: Any, i: int, label: str) -> None:
    density, edges = np.histogram(values, bins=30, density=True)
    ax.stairs(density, edges, color=COLOURS[i], linestyle=LINES[i % len(LINES)], label=label)


def _axis(name: str) -> str:
    return {"stroke_m": "stroke h (m)", "depth_m": "real depth D (m)"}[name]


STUDY = Study(
    "cause",
    "What made the paper's error curves",
    "Which combination of sense of phi, misalignment, reading noise and unknown rig numbers explains the 25 published "
    "estimates best, and what can they not decide?",
    CauseSettings,
    run,
)
