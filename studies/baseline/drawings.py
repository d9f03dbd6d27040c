"""Figures 9 to 11 and Table 4 of the paper with our estimates, and the laws of eq. (7)."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl

from phibench.studies.baseline.tables import LawFit
from phibench.studies.framework import COLOURS, LINES, Drawing, canvas, drawn

PANELS = {
    "table1": ("Figure 9: D = 2.18 m", "stroke_m"),
    "table2": ("Figure 10: D = 3.18 m", "stroke_m"),
    "table3": ("Figure 11: D = 4.18 m", "stroke_m"),
    "table4": ("Table 4: h = 0.425 m", "depth_m"),
}
_AXES = {"stroke_m": "stroke h (m)", "depth_m": "real depth D (m)"}
_NAMES = {
    "ray": "phi_ray",
    "normal": "phi_normal",
    "incidence": "phi_incidence",
    "outline": "phi_outline",
}


def curves_drawing(table: pl.DataFrame, bands: pl.DataFrame, method: str, alt: str) -> Drawing:
    """Error of D against h, and D: published, ours with error bars, each sense of phi, drawn misalignments."""
    rows = table.filter(pl.col("method") == method).join(bands, on=["sample_id", "sense"], how="left")
    with canvas(9.0, 6.0) as figure:
        for ax, (name, (title, axis)) in zip(figure.subplots(2, 2).flat, PANELS.items(), strict=True):
            _panel(ax, rows.filter(pl.col("experiment") == name).sort(axis), axis)
            ax.set(title=title, xlabel=_AXES[axis], ylabel="error of D (m)")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
        return drawn("curves", figure, alt)


def laws_drawing(table: pl.DataFrame, laws: list[LawFit], alt: str) -> Drawing:
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
        return drawn("laws", figure, alt)


def _panel(ax: Any, rows: pl.DataFrame, axis: str) -> None:
    ax.axhline(0.0, color=COLOURS[7], linewidth=0.8)
    exact = rows.filter(pl.col("sense") == "ray")
    ax.fill_between(
        exact[axis],
        exact["low_m"],
        exact["high_m"],
        color=COLOURS[4],
        alpha=0.3,
        label="misaligned rigs, phi_ray, 95 %",
    )
    for i, (sense, label) in enumerate(_NAMES.items()):
        own = rows.filter(pl.col("sense") == sense)
        # scatter of a draw; the bound where there is one draw only
        bars = {} if sense != "ray" else {"yerr": np.where(own["sd_m"].is_nan(), own["bound_m"], own["sd_m"])}
        ax.errorbar(
            own[axis],
            own["mean_m"] - own["depth_m"],
            color=COLOURS[i],
            linestyle=LINES[i % len(LINES)],
            marker=".",
            capsize=2,
            label=f"ours, {label}",
            **bars,
        )
    ax.plot(exact[axis], exact["published_m"] - exact["depth_m"], "D", color=COLOURS[7], mfc="none", label="published")


def _exponents(ax: Any, laws: list[LawFit]) -> None:
    for i, law in enumerate(laws):
        for k, shift in enumerate((-0.12, 0.12)):
            value, low, high = law.law.exponents[k], law.law.low[k], law.law.high[k]
            ax.errorbar(
                [value],
                [i + shift],
                xerr=[[max(value - low, 0.0)], [max(high - value, 0.0)]],
                color=COLOURS[k],
                marker="os"[k],
                capsize=3,
                label=("exponent of D", "exponent of h")[k] if i == 0 else None,
            )
    for k, expected in enumerate((2.0, -1.0)):
        ax.axvline(expected, color=COLOURS[k], linestyle=":", linewidth=1.0)
    ax.set_yticks(range(len(laws)), [law.name.replace(", ", ",\n", 1) for law in laws])
    ax.set(xlabel="exponent, 95 % interval (dotted: eq. 7)")
    ax.invert_yaxis()
    ax.legend(fontsize=7)
