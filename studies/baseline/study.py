"""Study `baseline`: the paper's 25 experiments simulated: senses of phi, misaligned rigs, eq. (7); findings, drawings.

The settings and the run come first, then the findings, the small tables of the report, and the drawings: Figures 9 to
11 and Table 4 of the paper with our estimates, and the laws of eq. (7).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
import polars as pl
from pydantic import Field

from phibench.benchmark.scores.intervals import percentile_interval
from phibench.estimator.spots.simple_spots import find_spot
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import POSITIONS
from phibench.studies.baseline import tables
from phibench.studies.framework import (
    COLOURS,
    LINES,
    Drawing,
    Finding,
    Row,
    Settings,
    Study,
    StudyDatasets,
    StudyResult,
    canvas,
    error_bars,
    finished_drawing,
    rms,
    text_table,
)

METHODS = ("red_centroid", "chain_fit")
TABLES = ("table1", "table2", "table3")
NAMED = ("ray", "normal", "incidence", "outline")
RESAMPLES = 2000  # of the bootstrap of an rms
_LEAST = 3  # strokes for two constants and a residual


class BaselineSettings(Settings):
    """Settings of the study `baseline`."""

    recipe: str = Field(description="data set of the paper's experiments, aligned")
    preset: Literal["srgb8", "mjpeg"] = Field(description="sensor preset; exposure as the camera chooses it")
    draws: int = Field(ge=2, le=1000, description="draws of the noise that red_centroid reads")
    fit_draws: int = Field(ge=1, le=1000, description="of these, those that chain_fit reads")
    rigs: int = Field(ge=10, le=100_000, description="drawn misalignments, closed form")
    resamples: int = Field(ge=100, le=100_000, description="of the bootstrap")
    rendered: list[str] = Field(description="recipes of misaligned rigs that are rendered too")


def run(settings: BaselineSettings, datasets: StudyDatasets) -> StudyResult:
    """Run the study."""
    dataset = datasets.dataset(settings.recipe)
    experiments, rig = tables.experiments_of(dataset), dataset.samples[0].nominal_rig
    draws = dict(zip(METHODS, (settings.draws, settings.fit_draws), strict=True))
    table = tables.experiment_table(
        experiments, rig, tables.found_spots(dataset, settings.preset, draws, datasets.workers)
    )
    bands = tables.band_table(experiments, rig, settings.rigs, generator("study", "baseline", "rigs"))
    laws = tables.laws_of_noise(table, METHODS[0], settings.resamples)
    curves = [
        tables.published_curve(name, *_published(table, name), settings.resamples)
        for name in TABLES
        if _long(table, name)
    ]
    rendered = pl.concat([_rendered(name, datasets) for name in settings.rendered] or [_NONE])
    all_findings = findings(table, bands, laws, curves, rendered)
    return StudyResult(
        {"table": table, "misaligned": bands, "laws": _law_table(laws), "rendered": rendered},
        all_findings,
        (
            curves_drawing(table, bands, METHODS[1], _curves_alt(all_findings)),
            laws_drawing(table, laws, _laws_alt(laws)),
        ),
        {"Errors over the published experiments": senses_shown(table, bands), "Exponents": laws_shown(laws)},
        notes(settings.rendered, settings.fit_draws, table),
    )


def _curves_alt(found: Sequence[Finding]) -> str:
    wanted = ("error of the published", "error of the mean reading", "published minus noise-free")
    parts = "; ".join(finding.text for finding in found if finding.label.startswith(wanted))
    return f"Error of D against stroke and distance, by table of the paper. {parts}."


def _laws_alt(laws: Sequence[tables.LawFit]) -> str:
    parts = "; ".join(finding.text for law in laws for finding in _law_findings(law))
    return f"Standard deviation of D against eq. (7), and exponents of D and h. {parts}."


_NONE = pl.DataFrame(
    schema={
        "recipe": pl.String,
        "sample_id": pl.String,
        "sense": pl.String,
        "rendered_error_m": pl.Float64,
        "closed_form_error_m": pl.Float64,
    }
)


def _rendered(recipe: str, datasets: StudyDatasets) -> pl.DataFrame:
    """Errors of a rendered misaligned rig from its noise-free frames, and by the closed form of `drawn_rigs`."""
    dataset = datasets.dataset(recipe)
    samples = [sample for sample in dataset if sample.row.down.visible and sample.row.up.visible]
    rows = [sample.row for sample in samples]
    rig = dataset.samples[0].nominal_rig
    wrong = Misalignment(**dataset.info.recipe["misalignment"])
    points, strokes = np.array([row.spot_world_m for row in rows]), np.array([row.nominal_stroke_m for row in rows])
    down, up, true = tables.seen_pixels(rig, wrong, points, strokes)
    spots_px = [
        np.array(
            [
                find_spot(sample.expected_image(p, laser=True), sample.expected_image(p, laser=False)).uv_px
                for sample in samples
            ]
        )
        for p in POSITIONS
    ]
    return pl.DataFrame(
        [
            {
                "recipe": recipe,
                "sample_id": row.sample_id,
                "sense": sense,
                "rendered_error_m": float(tables.depth_estimates(sense, rig, strokes, *spots_px)[i] - row.depth_m),
                "closed_form_error_m": float(tables.depth_estimates(sense, rig, strokes, down, up)[i] - true[i]),
            }
            for sense in tables.SENSES
            for i, row in enumerate(rows)
        ]
    )


def _long(table: pl.DataFrame, experiment: str) -> bool:
    """Check that a table has strokes enough for two constants and a residual."""
    return len(_published(table, experiment)[0]) >= _LEAST


def _published(table: pl.DataFrame, experiment: str) -> tuple[Array, Array]:
    rows = table.filter(pl.col("experiment") == experiment).unique("sample_id").sort("stroke_m")
    return rows["stroke_m"].to_numpy(), (rows["published_m"] - rows["depth_m"]).to_numpy()


def _law_table(laws: list[tables.LawFit]) -> pl.DataFrame:
    return pl.DataFrame(
        [
            {
                "quantity": law.name,
                "of": name,
                "exponent": float(law.law.exponents[i]),
                "low": float(law.law.low[i]),
                "high": float(law.law.high[i]),
                "cases": law.cases,
            }
            for law in laws
            for i, name in enumerate(("D", "h"))
        ]
    )


def findings(
    table: pl.DataFrame,
    bands: pl.DataFrame,
    laws: Sequence[tables.LawFit],
    curves: Sequence[tables.Curve],
    rendered: pl.DataFrame,
) -> tuple[Finding, ...]:
    """Findings: published and ours, senses of phi, misalignment, laws, published curves, rendered misalignment."""
    return (
        *_error_findings(table),
        *_table_findings(table),
        *_sense_findings(table),
        *_band_findings(table, bands),
        *(row for law in laws for row in _law_findings(law)),
        *(row for curve in curves for row in _curve_findings(curve)),
        *(_rendered_findings(rendered) if len(rendered) else ()),
    )


def notes(rendered: Sequence[str], fit_draws: int, table: pl.DataFrame) -> tuple[str, ...]:
    """Parts that this run leaves out."""
    missing = int(table.filter(pl.col("sense") == "exact")["missing"].sum())
    return tuple(
        text
        for text, holds in (
            ("no misaligned rig was rendered: drawn misalignments are in closed form alone", not rendered),
            ("chain_fit read one draw per experiment: it has no error bars", fit_draws == 1),
            (f"{missing} readings gave no estimate and are left out", missing > 0),
            ("the points of one table share a rig: counts of points in the band are no test", True),
        )
        if holds
    )


def _error_findings(table: pl.DataFrame) -> Iterator[Finding]:
    """Relative errors of D, rms over the experiments, with exact geometry."""
    own = _rows_of_sense(table, "exact")
    published = (own["published_m"] / own["depth_m"] - 1.0).to_numpy()
    bound = (own["bound_m"] / own["depth_m"]).to_numpy()
    yield rms_finding("error of the published estimates, rms", published, "published")
    for method in table["method"].unique(maintain_order=True):
        rows = _rows_of_sense(table, "exact", method)
        error, sd = ((rows[name] / rows["depth_m"]).to_numpy() for name in ("mean_m", "sd_m"))
        yield rms_finding(f"error of the mean reading, {method}, rms", error - 1.0, "error", method)
        if np.isfinite(sd).any():
            yield rms_finding(f"scatter of a draw, {method}, rms", sd, "scatter", method)
    yield rms_finding("bound of a pair, rms", bound, "bound")
    above = int((np.abs(published) > 2.0 * bound).sum())
    yield Finding("published errors above twice the bound of their experiment", above, unit=f"of {len(own)}")


def _table_findings(table: pl.DataFrame) -> Iterator[Finding]:
    """Errors by table of the paper: a mean over all of them is ruled by the shortest strokes."""
    for name in sorted(table["experiment"].unique()):
        own = table.filter((pl.col("experiment") == name) & (pl.col("sense") == "exact"))
        first = own.filter(pl.col("method") == own["method"][0])
        published = (first["published_m"] / first["depth_m"] - 1.0).to_numpy()
        title = _title(name)
        yield Finding(f"{title}, error of the published estimates, rms", 100.0 * rms(published), unit="%")
        for method in own["method"].unique(maintain_order=True):
            rows = own.filter(pl.col("method") == method)
            error = (rows["mean_m"] / rows["depth_m"] - 1.0).to_numpy()
            value = 100.0 * rms(error[np.isfinite(error)])
            yield Finding(f"{title}, error of the mean reading, {method}, rms", value, unit="%")


def _sense_findings(table: pl.DataFrame) -> Iterator[Finding]:
    """Published minus noise-free estimate in each sense of phi, and the sum of squares that the sense leaves."""
    own = _rows_of_sense(table, "ray")
    alone = rms(((own["published_m"] - own["depth_m"]) / own["depth_m"]).to_numpy())
    for sense in NAMED:
        rows = _rows_of_sense(table, sense)
        apart = _published_differences(rows)
        yield rms_finding(f"published minus noise-free estimate, phi_{sense}, rms", apart, "sense", sense)
        share = Finding(
            f"sum of squares that phi_{sense} leaves of the published errors",
            100.0 * (rms(apart) / alone) ** 2,
            unit="%",
        )
        yield share if sense == "ray" else share.judged("<=", 100.0)


def _band_findings(table: pl.DataFrame, bands: pl.DataFrame) -> Iterator[Finding]:
    for sense in NAMED:
        inside = _inside_band(table, bands, sense)
        label = f"published points in the central 95 % of misaligned rigs, phi_{sense}"
        yield Finding(label, int(inside.sum()), unit=f"of {len(inside)}")


def _law_findings(law: tables.LawFit) -> Iterator[Finding]:
    """Exponents of D and h against those of eq. (7)."""
    for name, value, low, high, expected in zip(
        "Dh", law.law.exponents, law.law.low, law.law.high, tables.EXPECTED, strict=True
    ):
        yield Finding(f"{law.name}: exponent of {name}", value, low, high).judged("=", expected)


def _curve_findings(curve: tables.Curve) -> Iterator[Finding]:
    """Signs, exponent and residuals of the published errors of one table; 1/h is the law of noise."""
    title, law = f"published errors of {_title(curve.experiment)}", curve.law
    yield Finding(f"{title}: changes of sign along h", curve.signs)
    yield Finding(f"{title}: rms", curve.rms_m, unit="m")
    exponent = Finding(f"{title}: exponent of h", law.exponents[0], law.low[0], law.high[0])
    yield exponent.judged("=", tables.EXPECTED[1])
    residuals = {"c/h": curve.inverse_m, "a + b h": curve.line_m, "a + b/h": curve.offset_m}
    for name, value in residuals.items():
        yield Finding(f"{title}: residual of {name}, per degree of freedom", value, unit="m")


def _rendered_findings(rendered: pl.DataFrame) -> Iterator[Finding]:
    closed = rendered["closed_form_error_m"].to_numpy()
    gap = rendered["rendered_error_m"].to_numpy() - closed
    yield Finding("rendered misaligned rig: estimates", len(rendered))
    yield Finding("rendered misaligned rig: largest error of D", 1e3 * float(np.abs(closed).max()), unit="mm")
    largest = 1e3 * float(np.nanmax(np.abs(gap)))
    yield Finding("rendered misaligned rig: largest difference of frames and closed form", largest, unit="mm")


def _title(experiment: str) -> str:
    return f"Table {experiment.removeprefix('table')}"


def senses_shown(table: pl.DataFrame, bands: pl.DataFrame) -> tuple[Row, ...]:
    """Relative errors by sense of phi: rms and extremes, and how many published points lie in the misaligned band."""
    own = {sense: _rows_of_sense(table, sense) for sense in table["sense"].unique(maintain_order=True)}
    error = {sense: (rows["noise_free_m"] / rows["depth_m"] - 1.0).to_numpy() for sense, rows in own.items()}
    inside = {sense: _inside_band(table, bands, sense) for sense in own}
    return text_table(
        own,
        {
            "phi": str,
            "rms, %": lambda sense: f"{100.0 * rms(error[sense]):.3f}",
            "smallest, %": lambda sense: f"{100.0 * error[sense].min():.3f}",
            "largest, %": lambda sense: f"{100.0 * error[sense].max():.3f}",
            "rms to published, %": lambda sense: f"{100.0 * rms(_published_differences(own[sense])):.2f}",
            "published in the band": lambda sense: f"{inside[sense].sum()} of {len(inside[sense])}",
        },
    )


def laws_shown(laws: Sequence[tables.LawFit]) -> tuple[Row, ...]:
    """Exponents with intervals."""
    head = ("standard deviation of D from", "exponent of D", "95 %", "exponent of h", "95 %", "residual, %")
    return (
        head,
        *((fit.name, *_exponent(fit, 0), *_exponent(fit, 1), f"{100.0 * fit.law.rms_log:.0f}") for fit in laws),
    )


def _exponent(fit: tables.LawFit, k: int) -> tuple[str, str]:
    return f"{fit.law.exponents[k]:.2f}", f"{fit.law.low[k]:.2f} to {fit.law.high[k]:.2f}"


def rms_interval(values: Array, *names: str) -> tuple[float, float]:
    """Interval of a root mean square over independent cases; NaN for less than three.

    `names` are those of the random stream.
    """
    if len(values) < 3:
        return float("nan"), float("nan")
    low, high = percentile_interval([values], rms, RESAMPLES, generator("study", "spread", *names))
    return float(low[0]), float(high[0])


def rms_finding(label: str, values: Array, *names: str) -> Finding:
    """Rms of relative values in per cent, with its interval; values that are not finite are left out."""
    good = values[np.isfinite(values)]
    low, high = rms_interval(good, *names)
    return Finding(label, 100.0 * rms(good), 100.0 * low, 100.0 * high, "%")


def _rows_of_sense(table: pl.DataFrame, sense: str, method: str | None = None) -> pl.DataFrame:
    """Rows of one sense and one method, the first if none is named."""
    return table.filter((pl.col("sense") == sense) & (pl.col("method") == (method or table["method"][0])))


def _published_differences(rows: pl.DataFrame) -> Array:
    """Published minus noise-free estimate, relative."""
    return ((rows["published_m"] - rows["noise_free_m"]) / rows["depth_m"]).to_numpy()


def _inside_band(table: pl.DataFrame, bands: pl.DataFrame, sense: str) -> Array:
    own = _rows_of_sense(table, sense).join(bands, on=["sample_id", "sense"])
    error = own["published_m"] - own["depth_m"]
    return ((error >= own["low_m"]) & (error <= own["high_m"])).to_numpy()


# -- drawings ----------------------------------------------------------------------------------------------------------

PANELS = {
    "table1": ("Figure 9: D = 2.18 m", "stroke_m"),
    "table2": ("Figure 10: D = 3.18 m", "stroke_m"),
    "table3": ("Figure 11: D = 4.18 m", "stroke_m"),
    "table4": ("Table 4: h = 0.425 m", "depth_m"),
}
_AXES = {"stroke_m": "stroke h (m)", "depth_m": "real depth D (m)"}


def curves_drawing(table: pl.DataFrame, bands: pl.DataFrame, method: str, alt: str) -> Drawing:
    """Error of D against h, and D: published, ours with error bars, each sense of phi, drawn misalignments."""
    rows = table.filter(pl.col("method") == method).join(bands, on=["sample_id", "sense"], how="left")
    with canvas(9.0, 6.0) as figure:
        for ax, (name, (title, axis)) in zip(figure.subplots(2, 2).flat, PANELS.items(), strict=True):
            _panel(ax, rows.filter(pl.col("experiment") == name).sort(axis), axis)
            ax.set(title=title, xlabel=_AXES[axis], ylabel="error of D (m)")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
        return finished_drawing("curves", figure, alt)


def laws_drawing(table: pl.DataFrame, laws: list[tables.LawFit], alt: str) -> Drawing:
    """Deviation of D by noise against D^2 / (h s1 s2): eq. (7) is a line of slope 1."""
    rows = table.filter((pl.col("sense") == "exact") & (pl.col("method") == table["method"][0]))
    x = rows["depth_m"] ** 2 / rows["stroke_m"] / rows["sines"] * rows["bound_disparity_rad"]
    with canvas(9.0, 4.0) as figure:
        ax, other = figure.subplots(1, 2, width_ratios=[1, 1.2])
        ax.loglog(x, rows["bound_m"], "o", color=COLOURS[0], label="bound")
        ax.loglog(x, rows["sd_m"], "s", color=COLOURS[1], mfc="none", label=f"scatter, {rows['method'][0]}")
        ends = np.array([x.min(), x.max()], float)
        ax.loglog(ends, ends, "--", color=COLOURS[7], label="eq. (7)")
        ax.set(xlabel="eq. (7) with the bound of the disparity (m)", ylabel="standard deviation of D (m)")
        ax.legend()
        _exponents(other, laws)
        return finished_drawing("laws", figure, alt)


def _panel(ax: Any, rows: pl.DataFrame, axis: str) -> None:
    ax.axhline(0.0, color=COLOURS[7], linewidth=0.8)
    exact = rows.filter(pl.col("sense") == "ray")
    band = {"color": COLOURS[4], "alpha": 0.3, "label": "misaligned rigs, phi_ray, 95 %"}
    ax.fill_between(exact[axis], exact["low_m"], exact["high_m"], **band)
    for i, sense in enumerate(NAMED):
        own = rows.filter(pl.col("sense") == sense)
        # scatter of a draw; the bound where there is one draw only
        bars = {} if sense != "ray" else {"yerr": np.where(own["sd_m"].is_nan(), own["bound_m"], own["sd_m"])}
        style = {"color": COLOURS[i], "linestyle": LINES[i % len(LINES)], "marker": ".", "capsize": 2, **bars}
        ax.errorbar(own[axis], own["mean_m"] - own["depth_m"], label=f"ours, phi_{sense}", **style)
    ax.plot(exact[axis], exact["published_m"] - exact["depth_m"], "D", color=COLOURS[7], mfc="none", label="published")


def _exponents(ax: Any, laws: list[tables.LawFit]) -> None:
    for i, law in enumerate(laws):
        for k, shift in enumerate((-0.12, 0.12)):
            value, low, high = law.law.exponents[k], law.law.low[k], law.law.high[k]
            label = ("exponent of D", "exponent of h")[k] if i == 0 else None
            bars, style = error_bars([(value, low, high)]), {"color": COLOURS[k], "marker": "os"[k], "capsize": 3}
            ax.errorbar([value], [i + shift], xerr=bars, label=label, **style)
    for k, expected in enumerate(tables.EXPECTED):
        ax.axvline(expected, color=COLOURS[k], linestyle=":", linewidth=1.0)
    ax.set_yticks(range(len(laws)), [law.name.replace(", ", ",\n", 1) for law in laws])
    ax.set(xlabel="exponent, 95 % interval (dotted: eq. 7)")
    ax.invert_yaxis()
    ax.legend(fontsize=7)


STUDY = Study(
    "baseline",
    "The paper's tables and figures",
    "What do the paper's 25 experiments give when they are rendered, in each sense of phi and on misaligned rigs, and "
    "do the errors follow eq. (7)?",
    BaselineSettings,
    run,
)
