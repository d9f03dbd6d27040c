"""Study `noise`: errors of position, phi and D by exposure, power, noise, blur and JPEG, beside the bound; drawings.

One factor at a time about base cases; all methods that take the preset, on the same draws, with the bound. The run
comes first, then the drawings: error against each factor, and which factor matters most.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import polars as pl
from pydantic import Field

from phibench.benchmark.scores.answer_errors import Rules
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Dataset
from phibench.estimator.methods.registry import METHODS
from phibench.render.sensor.settings import SensorError
from phibench.scenes.validation import nearest
from phibench.studies.framework import (
    COLOURS,
    Drawing,
    Finding,
    Names,
    Numbers,
    Presets,
    Row,
    Settings,
    Study,
    StudyDatasets,
    StudyResult,
    canvas,
    error_bars,
    finished_drawing,
    line_style,
)
from phibench.studies.noise import tables
from phibench.studies.noise.conditions import BASE, FACTORS, Cell, cell_records, shot_and_rig

FEW_PLACES = 20  # the bootstrap resamples places: its intervals of few places are too narrow


class LevelSettings(Settings):
    """Levels by factor; a factor without levels is left out, and the base's own level is measured anyway."""

    exposure_s: Numbers = Field(default=(), description="exposure times, s")
    power_mw: Numbers = Field(default=(), description="powers of the laser, mW")
    read_noise_e: Numbers = Field(default=(), description="read noise, electrons")
    blur_sigma_px: Numbers = Field(default=(), description="optical blur besides defocus, px")
    focus_distance_m: Numbers = Field(default=(), description="distances of the plane of focus, m")
    jpeg_quality: Numbers = Field(default=(), description="libjpeg's quality")
    adc_bits: Numbers = Field(default=(), description="bits of the converter")
    speckle_contrast: Numbers = Field(default=(), description="contrast of the flux, 0.41 to 1")

    @property
    def given(self) -> dict[str, tuple[float, ...]]:
        """Levels of the factors that have some."""
        return {name: tuple(levels) for name, levels in self if levels}


class NoiseSettings(Settings):
    """Settings of the study."""

    recipe: str = Field(default="paper", description="recipe of the base cases, rendered for 1 mW")
    samples: Names = Field(min_length=1, description="base cases; the first is the main one")
    presets: Presets = Field(description="of the sensor")
    methods: Names = Field(default=(), description="built-in methods; all if empty")
    places: int = Field(ge=2, le=200, description="places of the spot on its board")
    draws: int = Field(ge=2, le=200, description="draws of the noise at each place")
    box_px: int = Field(ge=24, le=256, description="side of the boxes that methods are given")
    resamples: int = Field(ge=99, le=9999, description="of the bootstrap over places")
    levels: LevelSettings = Field(description="levels by factor; the base is added")


def run(settings: NoiseSettings, datasets: StudyDatasets) -> StudyResult:
    """Run the study."""
    dataset = datasets.dataset(settings.recipe)
    planned = cells(settings, dataset)
    records = tables.with_levels(pl.concat(datasets.map(cell_records, planned, "noise")), settings.levels.given)
    rules = Rules(resamples=settings.resamples)
    table = tables.table_of(records, rules)
    slopes = tables.elasticities(records, rules)
    slope_rows = [
        {k: v for k, v in vars(e).items() if k != "estimate"}
        | dict(zip(("slope", "slope_low", "slope_high"), e.estimate.ends, strict=True))
        for e in slopes
    ]
    shown: dict[str, tuple[Row, ...]] = {}
    findings, pictures = list[Finding](), list[Drawing]()
    for preset in settings.presets:
        for sample in settings.samples:
            findings += tables.base_findings(table, sample, preset)
            findings += tables.floor_findings(table, sample, preset)
            findings += tables.limit_findings(table, sample, preset)
            findings += tables.ranking_findings(slopes, sample, preset)
            shown[f"{preset}, {sample}: base case, 95 % intervals over places"] = tables.base_table(
                table, sample, preset
            )
            shown[f"{preset}, {sample}: elasticities of {tables.REFERENCE[preset]}"] = tables.ranking_table(
                slopes, sample, preset
            )
        pictures.append(error_drawing(table, settings.samples[0], preset))
    pictures.append(ranking_drawing(slopes, settings.samples[0], settings.presets))
    frames = {"table": table, "elasticities": pl.DataFrame(slope_rows)}
    return StudyResult(frames, tuple(findings), tuple(pictures), shown, _notes(settings))


def cells(settings: NoiseSettings, dataset: Dataset) -> list[Cell]:
    """All cells, those of the costly presets first.

    Raises
    ------
    DatasetError
        If a sample is not in the data set or not visible, or a level is not allowed.
    """
    for name in settings.samples:
        row = dataset[name].row
        if not (row.down.visible and row.up.visible):
            raise DatasetError(f"{name}: its spot is not visible in both images; take another base case")
    methods = settings.methods or tuple(METHODS)
    for name in methods:
        if name not in METHODS:
            raise DatasetError(f"methods: there is no '{name}' here; {nearest(name, tuple(METHODS))}")
    plan = [(s, p, f, x) for p in reversed(settings.presets) for s in settings.samples for f, x in _levels(settings, p)]
    for sample, preset, factor, level in plan:
        try:
            shot_and_rig(factor, preset, dataset[sample].rig, level)
        except SensorError as error:
            raise DatasetError(f"levels of {factor}: {level:g} is not allowed: {error}") from error
    size = (settings.places, settings.draws, methods, settings.box_px)
    return [Cell(dataset.folder, *case, *size) for case in plan]


def _levels(settings: NoiseSettings, preset: str) -> Iterator[tuple[str, float]]:
    """The base case, then every level that is not the base's."""
    yield BASE, 0.0
    for name, levels in settings.levels.given.items():
        factor = FACTORS[name]
        if preset in factor.presets:
            # the base's own level is the base case
            yield from ((name, x) for x in levels if abs(x - factor.base) > 1e-9)


def _notes(settings: NoiseSettings) -> tuple[str, ...]:
    pairs = settings.places * settings.draws
    few = settings.places < FEW_PLACES
    return (
        f"{pairs} pairs per level ({settings.places} places of the spot, {settings.draws} draws each); intervals are "
        "95 %, bootstrap over places.",
        "Methods get boxes of "
        f"{settings.box_px} px; rates of detection are those inside such a box, not in the whole mirror.",
        "Laser-off frames go only to methods that cannot do without. Bounds are those of one frame per position, with "
        "flux and one background level per filter unknown.",
        "Methods know the rig, its blur and focus and the sensor's numbers; the room behind keeps the "
        "blur and the focus at which it was rendered.",
        "The base is in focus, an optimum: focus distance has no elasticity.",
        *((f"Bootstrap intervals of fewer than {FEW_PLACES} places are too narrow.",) if few else ()),
    )


# -- drawings ----------------------------------------------------------------------------------------------------------

_COLUMNS = 4
_LINEAR = ("adc_bits", "jpeg_quality", "speckle_contrast")


def error_drawing(table: pl.DataFrame, sample: str, preset: str) -> Drawing:
    """Rms error of position against every factor, a curve per method, and the bound."""
    mine = table.filter(pl.col("sample") == sample, pl.col("preset") == preset)
    factors = [name for name in FACTORS if name in mine["factor"].unique().to_list()]
    methods = sorted(table["method"].unique().to_list())  # of all presets: a method has one look in all drawings
    rows = math.ceil(len(factors) / _COLUMNS)
    with canvas(11.0, 2.6 * rows + 0.9) as figure:
        axes = np.atleast_1d(figure.subplots(rows, min(_COLUMNS, len(factors)), sharey=True, squeeze=False)).ravel()
        for ax, factor in zip(axes, factors, strict=False):
            _panel(ax, mine.filter(pl.col("factor") == factor), factor, methods)
        for ax in axes[len(factors) :]:
            ax.set_axis_off()
        for ax in axes[:: min(_COLUMNS, len(factors))]:
            ax.set_ylabel("rms distance, px")
        seen = {label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
        figure.legend(list(seen.values()), list(seen), loc="outside lower center", ncols=5, frameon=False)
        figure.suptitle(f"{sample}, {preset}")
        return finished_drawing(f"errors-{preset}-{sample}", figure, _alt(mine, sample, preset), "png")


def ranking_drawing(found: Sequence[tables.Elasticity], sample: str, presets: Sequence[str]) -> Drawing:
    """Elasticities of the reference methods with intervals, and of the bound."""
    with canvas(9.0, 3.6) as figure:
        ax, names = figure.subplots(), [n for n in FACTORS if any(e.factor == n for e in found if e.sample == sample)]
        for k, preset in enumerate(presets):
            mine = {e.factor: e for e in tables.ranked_elasticities(found, sample, preset, tables.REFERENCE[preset])}
            here = [(i, mine[n]) for i, n in enumerate(names) if n in mine]
            _bars(ax, here, (k - 0.5 * (len(presets) - 1)) * 0.3, k, f"{tables.REFERENCE[preset]} on {preset}")
        ax.axhline(0.0, color="black", linewidth=0.8)
        ax.set_xticks(range(len(names)), [FACTORS[n].label.split(",")[0] for n in names], rotation=20, ha="right")
        ax.set_ylabel("d ln rms / d ln factor")
        ax.legend(frameon=False, fontsize=8)
        figure.suptitle(f"{sample}: what the error does when a factor changes; crosses: the bound")
        return finished_drawing(f"ranking-{sample}", figure, _ranking_alt(found, sample, presets))


def _panel(ax: Any, part: pl.DataFrame, factor: str, methods: Sequence[str]) -> None:
    for i, method in enumerate(methods):
        curve = part.filter(pl.col("method") == method, pl.col("rms_px").is_not_nan()).sort("level")
        if curve.is_empty():
            continue  # it was not run on this preset
        x, y = curve["level"].to_numpy(), curve["rms_px"].to_numpy()
        bars = error_bars(curve.select("rms_px", "rms_px_low", "rms_px_high").to_numpy())
        # more methods than colours: those of the second round have open markers and other lines
        other = line_style(i + i // len(COLOURS))
        style = {**line_style(i), "marker": other["marker"], "linestyle": other["linestyle"]}
        face = style["color"] if i < len(COLOURS) else "white"
        ax.errorbar(x, y, bars, label=method, markersize=3.5, linewidth=1.0, mfc=face, **style)
    bound = part.group_by("level").agg(pl.col("bound_px").max()).sort("level")
    ax.plot(bound["level"], bound["bound_px"], color="black", linewidth=2.0, label="bound")
    ax.axvline(FACTORS[factor].base, color="grey", linewidth=0.8, linestyle=":")
    ax.set_xscale("linear" if factor in _LINEAR else "log")
    ax.set_yscale("log")
    levels = bound["level"].to_list()
    ax.set_xticks(levels, [f"{x:.3g}" for x in levels], fontsize=7)
    ax.minorticks_off()
    ax.set_xlabel(FACTORS[factor].label)


def _bars(ax: Any, found: list[tuple[int, tables.Elasticity]], shift: float, k: int, label: str) -> None:
    x = np.array([i + shift for i, _ in found])
    ends = np.array([e.estimate.ends for _, e in found]).reshape(-1, 3)
    ax.bar(x, ends[:, 0], 0.28, color=COLOURS[k], label=label)
    ax.errorbar(x, ends[:, 0], error_bars(ends), fmt="none", ecolor="black", capsize=2)
    ax.plot(x, [e.bound for _, e in found], "kx", markersize=5)


def _alt(mine: pl.DataFrame, sample: str, preset: str) -> str:
    known = mine.filter(pl.col("rms_px").is_not_nan())
    low, high = (float(getattr(known["rms_px"], name)() or math.nan) for name in ("min", "max"))
    factors = sum(name in FACTORS for name in mine["factor"].unique())
    return (
        f"Rms distance of {mine['method'].n_unique()} methods on {preset} frames of {sample} against {factors} "
        f"factors, from {low:.3g} to {high:.3g} px, with the bound."
    )


def _ranking_alt(found: Sequence[tables.Elasticity], sample: str, presets: Sequence[str]) -> str:
    parts = []
    for preset in presets:
        mine = tables.ranked_elasticities(found, sample, preset, tables.REFERENCE[preset])
        if mine:
            parts.append(f"{preset}: largest {tables.name_of(mine[0])} {mine[0].estimate.value:+.2f}")
    return f"Elasticities of the error of position in {sample}. " + "; ".join(parts) + "."


STUDY = Study(
    "noise",
    "Noise, blur and compression",
    "How do the errors of pixel, phi and depth depend on exposure, laser power, read noise, blur, focus, JPEG quality, "
    "bits and speckle, for every method, and what is the bound?",
    NoiseSettings,
    run,
)
