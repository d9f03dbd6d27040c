"""Figures of the study `cause`: predicted errors, evidence of each explanation, posterior of noise and tilt."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl

from phibench.scenes.random_streams import generator
from phibench.studies.cause.model import NOISE
from phibench.studies.cause.nested_sampling import CauseSettings
from phibench.studies.cause.paper_reading import TABLES, published_experiments
from phibench.studies.cause.tables import DECIDED, Posteriors, band, grid_of
from phibench.studies.framework import COLOURS, LINES, Drawing, canvas, drawn

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
        return drawn("predictive", figure, alt)


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
        return drawn("evidence", figure, alt)


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
        return drawn("posterior", figure, alt)


def _histogram(ax: Any, values: Any, i: int, label: str) -> None:
    density, edges = np.histogram(values, bins=30, density=True)
    ax.stairs(density, edges, color=COLOURS[i], linestyle=LINES[i % len(LINES)], label=label)


def _axis(name: str) -> str:
    return {"stroke_m": "stroke h (m)", "depth_m": "real depth D (m)"}[name]
