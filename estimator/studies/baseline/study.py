"""Sentences of the study `baseline`, made from its tables.

Study `baseline`: the paper's tables and figures from rendered frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import polars as pl
from pydantic import Field

from phibench.estimator.spots.simple_spots import find_spot
from phibench.estimator.studies.baseline.drawings import curves_drawing, laws_drawing
from phibench.estimator.studies.baseline.tables import (
    EXPECTED,
    SENSES,
    Curve,
    LawFit,
    band_table,
    estimates,
    experiment_table,
    experiments_of,
    found_spots,
    laws_of_noise,
    published_curve,
    seen,
)
from phibench.estimator.studies.framework import Material, Result, Row, Settings, Study
from phibench.estimator.studies.statistics import rms, rms_percent
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import POSITIONS


def findings(
    table: pl.DataFrame, bands: pl.DataFrame, laws: Sequence[LawFit], curves: Sequence[Curve], rendered: pl.DataFrame
) -> tuple[str, ...]:
    """Sentences: published and ours, senses of phi, misalignment, laws, published curves, rendered misalignment."""
    return (
        _noise(table),
        _senses(table),
        _misaligned(table, bands),
        " ".join(map(_law, laws)),
        *map(_curve, curves),
        *([_rendered_words(rendered)] if len(rendered) else []),
    )


def notes(rendered: Sequence[str], fit_draws: int, table: pl.DataFrame) -> tuple[str, ...]:
    """What this run leaves out."""
    missing = int(table.filter(pl.col("sense") == "exact")["missing"].sum())
    return tuple(
        text
        for text, holds in (
            ("no misaligned rig was rendered: drawn misalignments are in closed form alone", not rendered),
            ("chain_fit read one draw per experiment: it has no error bars", fit_draws == 1),
            (f"{missing} readings gave no estimate and are left out", missing > 0),
        )
        if holds
    )


def senses_shown(table: pl.DataFrame, bands: pl.DataFrame) -> tuple[Row, ...]:
    """Relative errors by sense of phi: rms and extremes, and how many published points lie in the misaligned band."""
    rows: list[Row] = [("phi", "rms, %", "smallest, %", "largest, %", "rms to published, %", "published in the band")]
    for sense in table["sense"].unique(maintain_order=True):
        own, inside = _own(table, sense), _inside(table, bands, sense)
        error = own["noise_free_m"].to_numpy() / own["depth_m"].to_numpy() - 1.0
        apart = (own["published_m"].to_numpy() - own["noise_free_m"].to_numpy()) / own["depth_m"].to_numpy()
        cells = (f"{100.0 * x:.3f}" for x in (rms(error), error.min(), error.max()))
        rows.append((sense, *cells, f"{100.0 * rms(apart):.2f}", f"{inside.sum()} of {len(inside)}"))
    return tuple(rows)


def laws_shown(laws: Sequence[LawFit]) -> tuple[Row, ...]:
    """Exponents with intervals."""
    head = ("standard deviation of D from", "exponent of D", "95 %", "exponent of h", "95 %", "residual, %")
    return (head, *(_law_row(law) for law in laws))


def _noise(table: pl.DataFrame) -> str:
    parts = []
    for method in table["method"].unique(maintain_order=True):
        own = _own(table, "exact", method)
        error, sd = ((own[name] / own["depth_m"]).to_numpy() for name in ("mean_m", "sd_m"))
        scatter = f", scatter of a draw {rms_percent(sd, 'scatter', method)}" if np.isfinite(sd).any() else ""
        parts.append(f"{method} {rms_percent(error - 1.0, 'error', method)}{scatter}")
    own = _own(table, "exact")
    published, bound = (
        (own["published_m"] / own["depth_m"] - 1.0).to_numpy(),
        (own["bound_m"] / own["depth_m"]).to_numpy(),
    )
    return (
        f"The {len(own)} published estimates err by {rms_percent(published, 'published')} rms; rendered on an aligned "
        f"rig and read with exact geometry, the errors of the means are, rms, {'; '.join(parts)}. The bound of a pair "
        f"is {rms_percent(bound, 'bound')} rms, and {int((np.abs(published) > 2.0 * bound).sum())} of the published "
        f"errors are more than twice the bound of their experiment. Intervals are 95 %, over the experiments. "
        f"{_by_table(table)}"
    )


def _by_table(table: pl.DataFrame) -> str:
    """Where the published errors are larger than ours: a mean over all tables is ruled by the shortest strokes."""
    parts = []
    for name in sorted(table["experiment"].unique()):
        own = table.filter((pl.col("experiment") == name) & (pl.col("sense") == "exact"))
        first = own.filter(pl.col("method") == own["method"][0])
        published = (first["published_m"] / first["depth_m"] - 1.0).to_numpy()
        ours = []
        for method in own["method"].unique(maintain_order=True):
            rows = own.filter(pl.col("method") == method)
            error = (rows["mean_m"] / rows["depth_m"] - 1.0).to_numpy()
            ours.append(f"{method} {100.0 * rms(error[np.isfinite(error)]):.2f} %")
        number = name.removeprefix("table")
        parts.append(f"Table {number} {100.0 * rms(published):.2f} % against {', '.join(ours)}")
    return f"By table, published against ours, rms: {'; '.join(parts)}."


def _senses(table: pl.DataFrame) -> str:
    apart = {}
    for sense in ("ray", "normal", "incidence", "outline"):
        own = _own(table, sense)
        apart[sense] = ((own["published_m"] - own["noise_free_m"]) / own["depth_m"]).to_numpy()
    own = _own(table, "ray")
    alone = rms(((own["published_m"] - own["depth_m"]) / own["depth_m"]).to_numpy())
    best = min(apart, key=lambda sense: rms(apart[sense]))
    words = ", ".join(f"phi_{sense} {rms_percent(value, 'sense', sense)}" for sense, value in apart.items())
    verdict = (
        f"phi_{best} comes nearest, and leaves {100.0 * (rms(apart[best]) / alone) ** 2:.0f} % of the sum of squares"
        if rms(apart[best]) < alone and best != "ray"
        else "no sense of phi comes nearer to them than phi_ray, which is exact"
    )
    return f"Published minus noise-free estimate of the recipe's aligned rig, relative rms: {words}; {verdict}."


def _misaligned(table: pl.DataFrame, bands: pl.DataFrame) -> str:
    inside = {sense: _inside(table, bands, sense) for sense in ("ray", "normal", "incidence", "outline")}
    counts = ", ".join(f"phi_{sense} {int(flags.sum())}" for sense, flags in inside.items())
    n = len(inside["ray"])
    return (
        f"With misalignments drawn at the study magnitudes, the central 95 % of the errors hold, of {n} published "
        f"points, {counts}; the points of one table share a rig, so that these counts are no test."
    )


def _law(law: LawFit) -> str:
    (p, q), low, high = law.law.exponents, law.law.low, law.law.high
    verdicts = " and ".join(
        f"{'agrees' if holds else 'does not agree'} with {expected:g}"
        for holds, expected in zip(law.holds, EXPECTED, strict=True)
    )
    first, second = verdicts.split(" and ")
    return (
        f"{law.name[0].upper()}{law.name[1:]}: sigma of D goes as D^{p:.2f} ({low[0]:.2f} to {high[0]:.2f}), which "
        f"{first}, and h^{q:.2f} ({low[1]:.2f} to {high[1]:.2f}), which {second}."
    )


def _curve(curve: Curve) -> str:
    number = curve.experiment.removeprefix("table")
    q, low, high = (float(x[0]) for x in (curve.law.exponents, curve.law.low, curve.law.high))
    left = {"c/h": curve.inverse_m, "a + b h": curve.line_m, "a + b/h": curve.offset_m}
    best = min(left, key=lambda name: left[name])
    words = ", ".join(f"{name} {value:.3f} m" for name, value in left.items())
    crossing = f"change sign {_times(curve.signs)}" if curve.signs else "keep one sign"
    agrees = "an interval that holds -1" if curve.law.holds(0, -1.0) else "an interval without -1"
    return (
        f"The published errors of Table {number} {crossing} along h (rms {curve.rms_m:.3f} m); their magnitude goes as "
        f"h^{q:.2f} ({low:.2f} to {high:.2f}, {agrees}). Signed laws leave, per degree of freedom, {words}: {best} "
        "fits best."
    )


def _rendered_words(rendered: pl.DataFrame) -> str:
    gap = (rendered["rendered_error_m"] - rendered["closed_form_error_m"]).to_numpy()
    largest = np.abs(rendered["closed_form_error_m"].to_numpy()).max()
    worst = float(np.nanmax(np.abs(gap)))
    return (
        f"A misaligned rig that was rendered errs by up to {1e3 * largest:.0f} mm; its noise-free frames and the "
        f"closed form differ by at most {1e3 * worst:.2g} mm over {len(rendered)} estimates."
    )


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _own(table: pl.DataFrame, sense: str, method: str | None = None) -> pl.DataFrame:
    """Rows of one sense and one method, the first if none is named."""
    return table.filter((pl.col("sense") == sense) & (pl.col("method") == (method or table["method"][0])))


def _inside(table: pl.DataFrame, bands: pl.DataFrame, sense: str) -> Array:
    own = _own(table, sense).join(bands, on=["sample_id", "sense"])
    error = own["published_m"] - own["depth_m"]
    return ((error >= own["low_m"]) & (error <= own["high_m"])).to_numpy()


def _law_row(law: LawFit) -> Row:
    (p, q), low, high = law.law.exponents, law.law.low, law.law.high
    return (
        law.name,
        f"{p:.2f}",
        f"{low[0]:.2f} to {high[0]:.2f}",
        f"{q:.2f}",
        f"{low[1]:.2f} to {high[1]:.2f}",
        f"{100.0 * law.law.rms_log:.0f}",
    )


METHODS = ("red_centroid", "chain_fit")
TABLES = ("table1", "table2", "table3")
_LEAST = 3


class BaselineSettings(Settings):
    """Settings of the study `baseline`."""

    recipe: str = Field(description="data set of the paper's experiments, aligned")
    preset: Literal["srgb8", "mjpeg"] = Field(description="sensor preset; exposure as the camera chooses it")
    draws: int = Field(ge=2, le=1000, description="draws of the noise that red_centroid reads")
    fit_draws: int = Field(ge=1, le=1000, description="of these, those that chain_fit reads")
    rigs: int = Field(ge=10, le=100_000, description="drawn misalignments, closed form")
    resamples: int = Field(ge=100, le=100_000, description="of the bootstrap")
    rendered: list[str] = Field(description="recipes of misaligned rigs that are rendered too")


def run(settings: BaselineSettings, material: Material) -> Result:
    """Run the study."""
    dataset = material.dataset(settings.recipe)
    experiments, rig = experiments_of(dataset), dataset.samples[0].nominal_rig
    draws = dict(zip(METHODS, (settings.draws, settings.fit_draws), strict=True))
    table = experiment_table(experiments, rig, found_spots(dataset, settings.preset, draws, material.workers))
    bands = band_table(experiments, rig, settings.rigs, generator("study", "baseline", "rigs"))
    laws = laws_of_noise(table, METHODS[0], settings.resamples)
    curves = [
        published_curve(name, *_published(table, name), settings.resamples) for name in TABLES if _long(table, name)
    ]
    rendered = pl.concat([_rendered(name, material) for name in settings.rendered] or [_NONE])
    words = findings(table, bands, laws, curves, rendered)
    return Result(
        {"table": table, "misaligned": bands, "laws": _law_table(laws), "rendered": rendered},
        words,
        (
            curves_drawing(table, bands, METHODS[1], words[0] + " " + words[1]),
            laws_drawing(table, laws, words[3]),
        ),
        {"Errors over the published experiments": senses_shown(table, bands), "Exponents": laws_shown(laws)},
        notes(settings.rendered, settings.fit_draws, table),
    )


_NONE = pl.DataFrame(
    schema={
        "recipe": pl.String,
        "sample_id": pl.String,
        "sense": pl.String,
        "rendered_error_m": pl.Float64,
        "closed_form_error_m": pl.Float64,
    }
)


def _rendered(recipe: str, material: Material) -> pl.DataFrame:
    """Errors of a rendered misaligned rig from its noise-free frames, and by the closed form of `drawn_rigs`."""
    dataset = material.dataset(recipe)
    samples = [sample for sample in dataset if sample.row.down.visible and sample.row.up.visible]
    rows = [sample.row for sample in samples]
    rig = dataset.samples[0].nominal_rig
    wrong = Misalignment(**dataset.info.recipe["misalignment"])
    points, strokes = np.array([row.spot_world_m for row in rows]), np.array([row.nominal_stroke_m for row in rows])
    down, up, true = seen(rig, wrong, points, strokes)
    found = [
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
                "rendered_error_m": float(estimates(sense, rig, strokes, *found)[i] - row.depth_m),
                "closed_form_error_m": float(estimates(sense, rig, strokes, down, up)[i] - true[i]),
            }
            for sense in SENSES
            for i, row in enumerate(rows)
        ]
    )


def _long(table: pl.DataFrame, experiment: str) -> bool:
    """Whether enough strokes of a table are there for two constants and a residual."""
    return len(_published(table, experiment)[0]) >= _LEAST


def _published(table: pl.DataFrame, experiment: str) -> tuple[Array, Array]:
    rows = table.filter(pl.col("experiment") == experiment).unique("sample_id").sort("stroke_m")
    return rows["stroke_m"].to_numpy(), (rows["published_m"] - rows["depth_m"]).to_numpy()


def _law_table(laws: list[LawFit]) -> pl.DataFrame:
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


STUDY = Study(
    "baseline",
    "The paper's tables and figures",
    "What do the paper's 25 experiments give when they are rendered, in each sense of phi and on misaligned rigs, and "
    "do the errors follow eq. (7)?",
    BaselineSettings,
    run,
)
