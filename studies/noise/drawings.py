"""Drawings of the study `noise`: error against each factor, and which factor matters most."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl

from phibench.studies.framework import COLOURS, Drawing, canvas, drawn, line_style
from phibench.studies.noise.conditions import FACTORS
from phibench.studies.noise.tables import REFERENCE, Elasticity, name_of, ranked

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
        return drawn(f"errors-{preset}-{sample}", figure, _alt(mine, sample, preset), "png")


def ranking_drawing(found: Sequence[Elasticity], sample: str, presets: Sequence[str]) -> Drawing:
    """Elasticities of the reference methods with intervals, and of the bound."""
    with canvas(9.0, 3.6) as figure:
        ax, names = figure.subplots(), [n for n in FACTORS if any(e.factor == n for e in found if e.sample == sample)]
        for k, preset in enumerate(presets):
            mine = {e.factor: e for e in ranked(found, sample, preset, REFERENCE[preset])}
            here = [(i, mine[n]) for i, n in enumerate(names) if n in mine]
            _bars(ax, here, (k - 0.5 * (len(presets) - 1)) * 0.3, k, f"{REFERENCE[preset]} on {preset}")
        ax.axhline(0.0, color="black", linewidth=0.8)
        ax.set_xticks(range(len(names)), [FACTORS[n].label.split(",")[0] for n in names], rotation=20, ha="right")
        ax.set_ylabel("d ln rms / d ln factor")
        ax.legend(frameon=False, fontsize=8)
        figure.suptitle(f"{sample}: what the error does when a factor changes; crosses: the bound")
        return drawn(f"ranking-{sample}", figure, _ranking_alt(found, sample, presets))


def _panel(ax: Any, part: pl.DataFrame, factor: str, methods: Sequence[str]) -> None:
    for i, method in enumerate(methods):
        curve = part.filter(pl.col("method") == method, pl.col("rms_px").is_not_nan()).sort("level")
        if curve.is_empty():
            continue  # it was not run on this preset
        x, y = curve["level"].to_numpy(), curve["rms_px"].to_numpy()
        ends = (curve[f"rms_px_{end}"].to_numpy() for end in ("low", "high"))
        low, high = (np.where(np.isfinite(end), np.abs(y - end), 0.0) for end in ends)
        # more methods than colours: those of the second round have open markers and other lines
        other = line_style(i + i // len(COLOURS))
        style = {**line_style(i), "marker": other["marker"], "linestyle": other["linestyle"]}
        face = style["color"] if i < len(COLOURS) else "white"
        ax.errorbar(x, y, np.stack([low, high]), label=method, markersize=3.5, linewidth=1.0, mfc=face, **style)
    bound = part.group_by("level").agg(pl.col("bound_px").max()).sort("level")
    ax.plot(bound["level"], bound["bound_px"], color="black", linewidth=2.0, label="bound")
    ax.axvline(FACTORS[factor].base, color="grey", linewidth=0.8, linestyle=":")
    ax.set_xscale("linear" if factor in _LINEAR else "log")
    ax.set_yscale("log")
    levels = bound["level"].to_list()
    ax.set_xticks(levels, [f"{x:.3g}" for x in levels], fontsize=7)
    ax.minorticks_off()
    ax.set_xlabel(FACTORS[factor].label)


def _bars(ax: Any, found: list[tuple[int, Elasticity]], shift: float, k: int, label: str) -> None:
    x = np.array([i + shift for i, _ in found])
    y = np.array([e.estimate.value for _, e in found])
    ends = np.array([[e.estimate.low, e.estimate.high] for _, e in found]).reshape(-1, 2).T
    spread = np.where(np.isfinite(ends), np.abs(ends - y), 0.0)
    ax.bar(x, y, 0.28, color=COLOURS[k], label=label)
    ax.errorbar(x, y, spread, fmt="none", ecolor="black", capsize=2)
    ax.plot(x, [e.bound for _, e in found], "kx", markersize=5)


def _alt(mine: pl.DataFrame, sample: str, preset: str) -> str:
    known = mine.filter(pl.col("rms_px").is_not_nan())
    low, high = (float(getattr(known["rms_px"], name)() or math.nan) for name in ("min", "max"))
    factors = sum(name in FACTORS for name in mine["factor"].unique())
    return (
        f"Rms distance of {mine['method'].n_unique()} methods on {preset} frames of {sample} against {factors} "
        f"factors, from {low:.3g} to {high:.3g} px, with the bound."
    )


def _ranking_alt(found: Sequence[Elasticity], sample: str, presets: Sequence[str]) -> str:
    parts = []
    for preset in presets:
        mine = ranked(found, sample, preset, REFERENCE[preset])
        if mine:
            parts.append(f"{preset}: largest {name_of(mine[0])} {mine[0].estimate.value:+.2f}")
    return f"Elasticities of the error of position in {sample}. " + "; ".join(parts) + "."
