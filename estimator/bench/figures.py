"""The figures of a report, each with its text alternative. Markers, lines and hatches differ, not colours alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import polars as pl
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from scipy.stats import norm

from phibench.estimator.bench.document import ScoreDocument, StratumScore, Value
from phibench.estimator.bench.picture import COLOURS, STYLE, Picture, encoded, line_style, picture
from phibench.scenes.frames import Array

_HATCHES = ("", "///", "...", "xx", "\\\\\\", "++", "oo", "--", "**", "||", "//", "O.", "xx..", "+++")
_BINS = 12
_LEAST_IN_BIN = 3

Named = Mapping[str, ScoreDocument]
Tables = Mapping[str, pl.DataFrame]


def error_curves(scores: Named) -> Picture:
    """Rms errors of position and depth against depth, stroke and signal, the bound drawn in."""
    rows = (
        ("rms_px", "bound_px", 1.0, "rms distance / px"),
        ("rms_depth_relative", "bound_depth_relative", 100.0, "rms error of D / %"),
    )
    by = (("depth", "D / m"), ("stroke", "h / m"), ("signal", "signal / electrons"))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10.5, 6.4), layout="constrained")
        grid = figure.subplots(len(rows), len(by), squeeze=False)
        for line, (metric, bound, factor, label) in zip(grid, rows, strict=True):
            for axes, (stratum, unit) in zip(line, by, strict=True):
                _curves(axes, scores, stratum, metric, factor)
                _bound(axes, scores, stratum, bound, factor)
                axes.set(xlabel=unit, ylabel=label, yscale="log", xscale="log" if stratum == "signal" else "linear")
                _plain_ticks(axes)
        _legend(figure, grid[0][0])
        return _svg(figure, _curves_in_words(scores))


def error_map(tables: Tables) -> Picture:
    """Where in the image errors happen: every image at its true position, its mark as large as its error."""
    with mpl.rc_context(STYLE):
        columns = min(len(tables), 3)
        lines = math.ceil(len(tables) / columns)
        figure = Figure(figsize=(3.6 * columns + 1.0, 2.6 * lines + 0.4), layout="constrained", dpi=130)
        grid = figure.subplots(lines, columns, squeeze=False)
        scale = _scale(tables)
        marks = [_map(axes, *item, scale) for axes, item in zip(grid.flat, tables.items(), strict=False)]
        for axes in list(grid.flat)[len(tables) :]:
            axes.remove()
        bar = figure.colorbar(marks[0], ax=list(grid.flat)[: len(tables)], label="distance / px")
        _plain_ticks(bar.ax)
        return _png(
            figure,
            f"Maps of the image for {_names(tables)}: detected spots as discs, larger and darker for "
            "larger errors; images without a right position as crosses.",
        )


def error_by_radius(tables: Tables) -> Picture:
    """Radial and tangential rms error against the distance from the image of the sphere centre."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 3.3), layout="constrained")
        pair = figure.subplots(1, 2, sharey=True)
        for axes, column, label in zip(pair, ("radial_px", "tangential_px"), ("radial", "tangential"), strict=True):
            for i, (name, table) in enumerate(tables.items()):
                radius, rms = _binned(table, column)
                axes.plot(radius, rms, label=name, **line_style(i))
            axes.set(xlabel="distance from the image of the sphere centre / px", yscale="log")
            axes.set_ylabel(f"rms {label} error / px")
            _plain_ticks(axes)
        _legend(figure, pair[0])
        return _svg(
            figure,
            f"Rms radial error (left) and tangential error (right) against the distance from the image of "
            f"the sphere centre, for {_names(tables)}.",
        )


def cause_bars(scores: Named) -> Picture:
    """Images without a right position by cause, one bar per method."""
    causes = [c for c in next(iter(scores.values())).causes if any(sum(s.causes[c].values()) for s in scores.values())]
    with mpl.rc_context(STYLE):
        figure = Figure(
            figsize=(9.0, 0.9 + 0.45 * len(scores) + 0.25 * math.ceil(len(causes) / 4)), layout="constrained"
        )
        axes = figure.subplots()
        start = np.zeros(len(scores))
        for i, cause in enumerate(causes):
            share = np.array([100.0 * sum(s.causes[cause].values()) / s.images for s in scores.values()])
            style: Any = {"color": COLOURS[i % len(COLOURS)], "hatch": _HATCHES[i % len(_HATCHES)]}
            axes.barh(list(scores), share, left=start, label=cause, edgecolor="black", linewidth=0.5, **style)
            start += share
        axes.invert_yaxis()
        axes.set(xlabel="images without a right position / %", xlim=(0.0, max(1.0, 1.02 * start.max())))
        if causes:
            figure.legend(loc="outside lower center", ncols=4, fontsize=8)
        words = "; ".join(f"{name}: {_shares(score)}" for name, score in scores.items())
        return _svg(figure, f"Stacked bars of the causes, share of all images. {words}.")


def pull_histogram(tables: Tables) -> Picture | None:
    """Whitened errors of the methods that claim a covariance, against the normal distribution; None if none does."""
    pulls = {name: _pulls(table) for name, table in tables.items()}
    pulls = {name: values for name, values in pulls.items() if values.size}
    if not pulls:
        return None
    edges = np.linspace(-5.0, 5.0, 41)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.0, 3.4), layout="constrained")
        axes = figure.subplots()
        for i, (name, values) in enumerate(pulls.items()):
            density = np.histogram(np.clip(values, -5.0, 5.0), edges, density=True)[0]
            style = {key: value for key, value in line_style(i).items() if key != "marker"}
            axes.stairs(density, edges, label=f"{name} (n = {values.size})", **style)
        x = np.linspace(-5.0, 5.0, 201)
        axes.plot(x, norm.pdf(x), color="black", linewidth=2.0, alpha=0.6, label="normal, deviation 1")
        axes.set(xlabel="whitened error L⁻¹e; beyond ±5 in the outer bins", ylabel="density")
        axes.legend(fontsize=8)
        shown = ", ".join(f"{name} {np.std(values):.2f}" for name, values in pulls.items())
        return _svg(
            figure, f"Histograms of the whitened errors with the normal distribution. Deviations: {shown}; 1 is right."
        )


# -- parts ---------------------------------------------------------------------------------------------------------


def _curves(axes: Axes, scores: Named, by: str, metric: str, factor: float) -> None:
    for i, (name, score) in enumerate(scores.items()):
        parts = [(x, part.metrics[metric]) for x, part in _strata(score, by) if metric in part.metrics]
        shown = [(x * 1.02 ** (i - len(scores) / 2), value) for x, value in parts if (value.value or 0.0) > 0.0]
        if not shown:
            continue
        x, y = [x for x, _ in shown], [factor * (value.value or math.nan) for _, value in shown]
        axes.errorbar(x, y, yerr=_bars([value for _, value in shown], factor), label=name, capsize=3, **line_style(i))


def _bars(values: Sequence[Value], factor: float) -> Array:
    """Lengths of the error bars downwards and upwards, shape (2, n); 0 where there is no interval."""
    y = [value.value or 0.0 for value in values]
    low = [a - value.low if value.low is not None else 0.0 for a, value in zip(y, values, strict=True)]
    high = [value.high - a if value.high is not None else 0.0 for a, value in zip(y, values, strict=True)]
    return factor * np.maximum(np.array([low, high]), 0.0)


def _bound(axes: Axes, scores: Named, by: str, metric: str, factor: float) -> None:
    """The bound over the images that the first method with one has found."""
    for score in scores.values():
        parts = [(x, part.metrics[metric].value) for x, part in _strata(score, by) if metric in part.metrics]
        shown = [(x, factor * value) for x, value in parts if value]
        if shown:
            axes.plot(*zip(*shown, strict=True), color="black", linewidth=2.0, linestyle=(0, (1, 1)), label="bound")
            return


def _strata(score: ScoreDocument, by: str) -> list[tuple[float, StratumScore]]:
    """Strata with the mean of what they are by."""
    return [(part.mean, part) for part in score.strata if part.by == by and part.mean is not None]


def _scale(tables: Tables) -> LogNorm:
    """One scale of distances for all maps, a hundredth of the largest at least."""
    largest = max(
        float(table.filter("detected")["distance_px"].to_numpy().max(initial=0.0)) for table in tables.values()
    )
    return LogNorm(0.01 * max(largest, 1e-9), max(largest, 1e-9), clip=True)


def _map(axes: Axes, name: str, table: pl.DataFrame, scale: LogNorm) -> Any:
    seen = table.filter(pl.col("visible"))
    found, lost = seen.filter(pl.col("detected")), seen.filter(~pl.col("detected"))
    distance = found["distance_px"].to_numpy()
    size = 3.0 + 24.0 * np.asarray(scale(distance))
    u, v = found["u_true_px"], found["v_true_px"]
    marks = axes.scatter(u, v, s=size, c=distance, cmap="cividis_r", norm=scale, linewidths=0.3, edgecolors="black")
    axes.scatter(lost["u_true_px"], lost["v_true_px"], s=18.0, marker="x", color="#d55e00", linewidths=0.9)
    axes.set(title=f"{name}\n{len(found)} found, {len(lost)} not", xlabel="u / px", ylabel="v / px", aspect="equal")
    axes.invert_yaxis()
    return marks


def _binned(table: pl.DataFrame, column: str) -> tuple[Array, Array]:
    """Centres of bins of the radius and the rms in them, over detected spots; bins of fewer than 3 are left out."""
    found = table.filter(pl.col("detected") & pl.col(column).is_not_null())
    if not len(found):
        return np.empty(0), np.empty(0)
    radius, error = found["from_centre_px"].to_numpy(), found[column].to_numpy()
    edges = np.linspace(0.0, radius.max() * (1.0 + 1e-9), _BINS + 1)
    index = np.clip(np.digitize(radius, edges) - 1, 0, _BINS - 1)
    n, squares = np.bincount(index, minlength=_BINS), np.bincount(index, error**2, _BINS)
    kept = (n >= _LEAST_IN_BIN) & (squares > 0.0)
    return 0.5 * (edges[:-1] + edges[1:])[kept], np.sqrt(squares[kept] / n[kept])


def _pulls(table: pl.DataFrame) -> Array:
    both = table.filter(pl.col("detected") & pl.col("pull_u").is_not_null())
    return np.concatenate([both["pull_u"].to_numpy(), both["pull_v"].to_numpy()])


def _plain_ticks(axes: Axes) -> None:
    """Decimal numbers at 1, 2, 5 of a logarithmic axis, instead of powers that run into each other."""
    for axis in (axes.xaxis, axes.yaxis):
        if axis.get_scale() == "log":
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
            axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
            axis.set_minor_formatter(NullFormatter())


def _legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(handles), 4), fontsize=8)


def _names(named: Mapping[str, Any]) -> str:
    return ", ".join(named)


def _curves_in_words(scores: Named) -> str:
    values = {name: score.overall["rms_px"].value for name, score in scores.items()}
    shown = ", ".join(f"{name} {'none' if x is None else f'{x:.3g} px'}" for name, x in values.items())
    return (
        "Rms distance (top) and rms relative error of D (bottom) against D, stroke and signal, with intervals and the "
        f"bound as a dotted black line. Rms distance over all: {shown}. The numbers are in the tables of strata below."
    )


def _shares(score: ScoreDocument) -> str:
    there = {cause: sum(kinds.values()) for cause, kinds in score.causes.items() if any(kinds.values())}
    return ", ".join(f"{cause} {100.0 * n / score.images:.1f} %" for cause, n in there.items()) or "none"


def _svg(figure: Figure, alt: str) -> Picture:
    return picture(encoded(figure, "svg"), "svg", alt)


def _png(figure: Figure, alt: str) -> Picture:
    return picture(encoded(figure, "png"), "png", alt)
