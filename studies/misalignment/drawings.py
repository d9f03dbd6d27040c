"""Figures of the study `misalignment`: change of D by azimuth, cost of each parameter, interactions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import polars as pl

from phibench.scenes.misalignment import PARAMETERS
from phibench.studies.framework import Drawing, canvas, drawn, line_style
from phibench.studies.misalignment.interactions import Interactions
from phibench.studies.misalignment.tables import Rank, percent, shown

_CURVES, _BARS = 5, 14  # as many as can be told apart


def azimuth_drawing(table: pl.DataFrame, rendered: pl.DataFrame, ranks: Sequence[Rank], stroke_m: float) -> Drawing:
    """Change of D against the azimuth, exact estimator: lines predicted, crosses rendered; nearest and farthest D."""
    names = [rank.parameter for rank in ranks[:_CURVES]]
    depths = (ranks[0].depths_m[0], ranks[0].depths_m[-1])
    with canvas(9.0, 4.2) as figure:
        axes = figure.subplots(1, 2, sharex=True)
        for ax, D in zip(axes, depths, strict=True):
            for i, name in enumerate(names):
                size = PARAMETERS[name].study
                style = {**line_style(i), "marker": ""}
                x, y = _curve(table, name, size, stroke_m, D, "whole_relative")
                ax.plot(x, y, label=f"{name}, {shown(name, size)}", **style)
                x, y = _curve(rendered, name, size, stroke_m, D, "rendered_relative")
                ax.plot(x, y, "x", color=style["color"], markersize=7)
            ax.set(title=f"D = {D:g} m", xlabel="azimuth of the spot, degrees", ylabel="change of D, %")
            ax.set_xticks(range(0, 361, 90))
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        parts = ", ".join(f"{rank.parameter} {percent(rank.worst[-1])} %" for rank in ranks[:_CURVES])
        alt = (
            "Change of the exact estimator's D against the spot's azimuth for the costliest misalignments, predicted "
            f"as lines and rendered as crosses, at D = {depths[0]:g} and {depths[1]:g} m; largest at {depths[1]:g} m: "
            f"{parts}."
        )
        return drawn("azimuth", figure, alt)


def ranking_drawing(by_estimator: Mapping[str, Sequence[Rank]], depth_index: int) -> Drawing:
    """Bars: what each parameter costs each estimator at one D."""
    first = next(iter(by_estimator.values()))
    D = first[0].depths_m[depth_index]
    order = sorted(first, key=lambda one: -float(one.rms[depth_index]))[:_BARS]
    names = [one.parameter for one in order]
    height = 0.8 / len(by_estimator)
    with canvas(9.0, 5.2) as figure:
        ax = figure.subplots()
        for i, (estimator, ranks) in enumerate(by_estimator.items()):
            cost = {one.parameter: 100.0 * float(one.rms[depth_index]) for one in ranks}
            places = np.arange(len(names)) + (i - 0.5 * (len(by_estimator) - 1)) * height
            values = [cost[name] for name in names]
            ax.barh(places, values, height, label=estimator, color=line_style(i)["color"])
        ax.set_xscale("log")
        ax.set_yticks(range(len(names)), [f"{name}, {shown(name, PARAMETERS[name].study)}" for name in names])
        ax.invert_yaxis()
        ax.set(xlabel=f"change of D, % (rms over azimuths and signs), D = {D:g} m")
        ax.legend()
        top = ", ".join(f"{one.parameter} {percent(one.rms[depth_index])} %" for one in order[:3])
        alt = f"Cost of each misalignment at D = {D:g} m by estimator, logarithmic; exact with nominal numbers: {top}."
        return drawn("ranking", figure, alt)


def interaction_drawing(found: Sequence[Interactions]) -> Drawing:
    """First-order and total indices of the relative error with intervals, at the farthest D."""
    error_of = [each for each in found if each.output == "error"][-1]
    p = len(error_of.parameters)
    order = np.argsort(-error_of.total, kind="stable")[:10]  # the others have no effect that a bar shows
    with canvas(9.0, 4.0) as figure:
        ax = figure.subplots()
        for i, (label, start) in enumerate((("first order", 0), ("total", p))):
            at = start + order
            value, low, high = (row[at] for row in (error_of.indices, error_of.low, error_of.high))
            error = np.maximum([value - low, high - value], 0.0)
            x = np.arange(len(order)) + (i - 0.5) * 0.25
            style = {**line_style(i), "linestyle": "none"}
            ax.errorbar(x, value, error, label=label, capsize=3, **style)
        ax.set_xticks(range(len(order)), [error_of.parameters[i] for i in order], rotation=30, ha="right")
        ax.set(ylabel="Sobol index (95 %)", xlabel=f"parameter; D = {error_of.depth_m:g} m, spots along x")
        ax.legend()
        alt = (
            f"Sobol indices of the relative error of D at {error_of.depth_m:g} m; the first-order ones sum to "
            f"{error_of.indices[-2]:.2f} ({error_of.low[-2]:.2f} to {error_of.high[-2]:.2f}); largest total "
            f"{error_of.total.max():.2f}, "
            f"{error_of.parameters[int(np.argmax(error_of.total))]}."
        )
        return drawn("interactions", figure, alt)


def _curve(
    table: pl.DataFrame, parameter: str, value: float, stroke_m: float, depth_m: float, column: str
) -> tuple[list[float], list[float]]:
    mine = table.filter(
        (pl.col("parameter") == parameter)
        & (pl.col("value") == value)
        & (pl.col("estimator") == "exact")
        & (pl.col("stroke_m") == stroke_m)
        & (pl.col("depth_m") == depth_m)
    ).sort("azimuth_deg")
    return mine["azimuth_deg"].to_list(), (100.0 * mine[column]).to_list()
