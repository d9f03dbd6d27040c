"""Figures of a benchmark report as SVG or PNG, each with its text alternative, and the style of all figures.

The same scores give the same bytes. A figure is one panel of about 400 px, so that it stays legible on a narrow screen.
Its background is transparent, so that a page can invert it on a dark one. Markers, lines and hatches differ,
not colours alone.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl
import scipy
from numpy.typing import ArrayLike

from phibench.benchmark.scores.metrics import METRICS
from phibench.benchmark.scores.score_document import ScoreDocument, StratumScore, Value
from phibench.scenes.frames import Array

if TYPE_CHECKING:  # Matplotlib takes half a second, and most commands that import this file draw nothing
    from matplotlib.axes import Axes
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

# M. Okabe, K. Ito: told apart with every kind of colour vision; markers, lines and hatches repeat the distinction
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f7f7f")
MARKERS = "osD^vP*X<>"
LINES = ("-", "--", "-.", ":")
STYLE: Any = {
    "svg.hashsalt": "phibench",  # without it Matplotlib names the parts of an SVG at random
    "font.size": 9.0,
    "axes.grid": True,
    "grid.alpha": 0.35,
    "hatch.linewidth": 0.6,
}
_MIME = {"svg": "image/svg+xml", "png": "image/png"}
# the date and the version of Matplotlib would change the bytes of equal figures
_METADATA: dict[str, dict[str, Any]] = {"svg": {"Date": None}, "png": {"Software": None}}


@dataclass(frozen=True)
class EmbeddedFigure:
    """A figure as a data address, with its alternative in words."""

    source: str
    alt: str


def line_style(i: int) -> dict[str, Any]:
    """Colour, line and marker of the i-th curve."""
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": LINES[i % len(LINES)], "marker": MARKERS[i % len(MARKERS)]}


def error_bars(ends: ArrayLike) -> Array:
    """Lengths of bars below and above values, shape (2, n), from value, low and high, (n, 3); 0 without an interval."""
    value, low, high = np.asarray(ends, float).T
    return np.nan_to_num(np.maximum([value - low, high - value], 0.0))


@contextmanager
def styled_figure(style: Any, size_in: tuple[float, float], **options: Any) -> Iterator[Figure]:
    """An empty figure; the style holds inside of the block."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(style):
        yield Figure(figsize=size_in, **options)


def encoded_figure(figure: Figure, kind: str, transparent: bool = False) -> bytes:
    """A figure as a file, "svg" or "png"."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, metadata=_METADATA[kind], transparent=transparent)
    return buffer.getvalue()


def embedded_figure(data: bytes, kind: str, alt: str) -> EmbeddedFigure:
    """An encoded figure as a picture."""
    return EmbeddedFigure(f"data:{_MIME[kind]};base64,{base64.b64encode(data).decode('ascii')}", alt)


# names of methods are text: a "$" in one is no formula
_PANEL: Any = {**STYLE, "font.size": 10.0, "svg.fonttype": "none", "text.parse_math": False}
_SIZE = (4.2, 3.1)  # inches of 96 px
# left, bottom, width, height; a layout by Matplotlib draws each panel twice
_PLACE, _MAP_PLACE, _BAR_PLACE = (0.19, 0.16, 0.78, 0.81), (0.15, 0.38, 0.82, 0.58), (0.23, 0.16, 0.66, 0.04)
_HATCHES = ("", "///", "...", "xx", "\\\\\\", "++", "oo", "--", "**", "||", "//", "O.", "xx..", "+++")
_BINS = 12  # rings of the image's radius: each has some errors
_LEAST_IN_BIN = 3  # errors: the rms of fewer is noise
_ROWS = (
    ("rms_phi_rad", None, "rms error of phi"),
    ("rms_px", "bound_px", "rms distance"),
    ("rms_depth_relative", "bound_depth_relative", "rms error of D"),
)
_COLUMNS = (("depth", "D / m"), ("stroke", "h / m"), ("signal", "signal / electrons"))

Named = Mapping[str, ScoreDocument]
Tables = Mapping[str, pl.DataFrame]


def method_keys(names: Sequence[str]) -> dict[str, EmbeddedFigure]:
    """Line and marker of each method, to be shown beside its name."""
    return {name: _key(i) for i, name in enumerate(names)}


def error_panels(scores: Named) -> list[EmbeddedFigure]:
    """Rms errors of phi, position and depth against depth, stroke and signal, the bound drawn in."""
    panels = []
    for metric, bound, label in _ROWS:
        factor, unit = METRICS[metric].shown
        for stratum, below in _COLUMNS:
            if not any(_points(score, stratum, metric) for score in scores.values()):
                continue  # nothing found, or nothing off
            with styled_figure(_PANEL, _SIZE) as figure:
                axes = figure.add_axes(_PLACE)
                _curves(axes, scores, stratum, metric, factor)
                if bound is not None:
                    _bound(axes, scores, stratum, bound, factor)
                axes.set(xlabel=below, ylabel=f"{label} / {unit}", yscale="log")
                axes.set_xscale("log" if stratum == "signal" else "linear")
                plain_ticks(axes)
                alt = f"{label} against {stratum}, with intervals. {_values_in_words(scores, metric)}"
                panels.append(_svg(figure, alt + " The numbers are in the tables of strata."))
    return panels


def _placed(tables: Tables) -> dict[str, pl.DataFrame]:
    """Tables of pairs whose spots have a true place: not of real ones."""
    return {name: table for name, table in tables.items() if table["u_true_px"].is_not_null().any()}


def error_maps(tables: Tables) -> dict[str, EmbeddedFigure]:
    """Maps of errors over the frame: a mark at every true position, as large as the error."""
    tables = _placed(tables)
    maps: dict[str, EmbeddedFigure] = {}
    if not tables:
        return maps
    scale = _scale(tables)
    for name, table in tables.items():
        with styled_figure(_PANEL, _SIZE, dpi=150) as figure:
            axes = figure.add_axes(_MAP_PLACE)
            marks = _map(axes, table, scale)
            place = figure.add_axes(_BAR_PLACE)
            bar = figure.colorbar(marks, cax=place, label="distance / px", orientation="horizontal")
            plain_ticks(bar.ax, 30.0)
            found = len(table.filter(pl.col("visible") & pl.col("detected")))
            maps[name] = _png(
                figure,
                f"Map of the image for {name}: {found} found spots as discs, larger for larger errors; "
                "images without a right position as crosses.",
            )
    return maps


def radius_panels(tables: Tables) -> list[EmbeddedFigure]:
    """Radial and tangential rms error against the distance from the image of the sphere centre."""
    panels: list[EmbeddedFigure] = []
    tables = _placed(tables)
    for column, label in (("radial_px", "radial"), ("tangential_px", "tangential")) if tables else ():
        with styled_figure(_PANEL, _SIZE) as figure:
            axes = figure.add_axes(_PLACE)
            for i, (name, table) in enumerate(tables.items()):
                radius, rms = _binned(table, column)
                axes.plot(radius, rms, label=name, **line_style(i))
            axes.set(xlabel="distance from the sphere's image / px", yscale="log", ylabel=f"rms {label} error / px")
            plain_ticks(axes)
            panels.append(
                _svg(
                    figure,
                    f"Rms {label} error against the distance from the image of the sphere centre, for "
                    f"{', '.join(tables)}.",
                )
            )
    return panels


def cause_bars(scores: Named) -> EmbeddedFigure:
    """Images without a right position by cause, one bar per method."""
    causes = [c for c in next(iter(scores.values())).causes if any(sum(s.causes[c].values()) for s in scores.values())]
    height = 1.2 + 0.32 * len(scores) + 0.25 * math.ceil(len(causes) / 2)
    with styled_figure(_PANEL, (1.4 * _SIZE[0], height), layout="constrained") as figure:
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
            figure.legend(loc="outside lower center", ncols=3, fontsize=9)
        words = "; ".join(f"{name}: {_shares(score)}" for name, score in scores.items())
        return _svg(figure, f"Stacked bars of the causes, share of all images. {words}.")


def pull_histogram(tables: Tables) -> EmbeddedFigure | None:
    """Whitened errors of the methods that claim a covariance, against the normal distribution; None if none does."""
    pulls = {name: _pulls(table) for name, table in tables.items()}
    pulls = {name: values for name, values in pulls.items() if values.size}
    if not pulls:
        return None
    edges = np.linspace(-5.0, 5.0, 41)  # a quarter of a deviation each
    legend = 0.2 * math.ceil((len(pulls) + 1) / 2)  # inches below the axes, where it covers no curve
    with styled_figure(_PANEL, (1.4 * _SIZE[0], 1.2 * _SIZE[1] + legend), layout="constrained") as figure:
        axes = figure.subplots()
        for i, (name, values) in enumerate(pulls.items()):
            density = np.histogram(np.clip(values, -5.0, 5.0), edges, density=True)[0]
            style = {key: value for key, value in line_style(i).items() if key != "marker"}
            axes.stairs(density, edges, label=f"{name} (n = {values.size})", **style)
        x = np.linspace(-5.0, 5.0, 201)
        axes.plot(x, scipy.stats.norm.pdf(x), color="black", linewidth=2.0, alpha=0.6, label="normal, deviation 1")
        axes.set(xlabel="whitened error L⁻¹e; beyond ±5 in the outer bins", ylabel="density")
        figure.legend(loc="outside lower center", ncols=2, fontsize=8)
        shown = ", ".join(f"{name} {np.std(values):.2f}" for name, values in pulls.items())
        return _svg(
            figure, f"Histograms of the whitened errors with the normal distribution. Deviations: {shown}; 1 is right."
        )


# -- parts ---------------------------------------------------------------------------------------------------------


def _curves(axes: Axes, scores: Named, by: str, metric: str, factor: float) -> None:
    for i, (name, score) in enumerate(scores.items()):
        # 2 % aside: intervals of several methods do not cover each other
        shown = [(x * 1.02 ** (i - len(scores) / 2), value) for x, value in _points(score, by, metric)]
        if not shown:
            continue  # no value in any stratum
        x, y = [x for x, _ in shown], [factor * (value.value or math.nan) for _, value in shown]
        ends = [factor * np.array([e.value, e.low, e.high]) for e in (value.estimate for _, value in shown)]
        axes.errorbar(x, y, yerr=error_bars(ends), label=name, capsize=3, **line_style(i))
        lone = [number for number, (_, value) in enumerate(shown) if value.low is None]
        colour, mark = line_style(i)["color"], line_style(i)["marker"]
        axes.plot([x[n] for n in lone], [y[n] for n in lone], mark, color=colour, markerfacecolor="white", zorder=3)


def has_open_marks(score: ScoreDocument) -> bool:
    """True if a point of the curves of a score has no interval: too few samples."""
    every = (_points(score, by, metric) for metric, _, _ in _ROWS for by, _ in _COLUMNS)
    return any(value.low is None for points in every for _, value in points)


def _points(score: ScoreDocument, by: str, metric: str) -> list[tuple[float, Value]]:
    """Values above 0 of a metric over strata, which a logarithmic axis can show."""
    parts = [(x, stratum.metrics[metric]) for x, stratum in _strata(score, by) if metric in stratum.metrics]
    return [(x, value) for x, value in parts if (value.value or 0.0) > 0.0]


def _bound(axes: Axes, scores: Named, by: str, metric: str, factor: float) -> None:
    """The bound over the images that the first method with one has found."""
    for score in scores.values():
        parts = [(x, stratum.metrics[metric].value) for x, stratum in _strata(score, by) if metric in stratum.metrics]
        shown = [(x, factor * value) for x, value in parts if value]
        if shown:
            axes.plot(*zip(*shown, strict=True), color="black", linewidth=2.0, linestyle=(0, (1, 1)), label="bound")
            return  # the line of one method is enough


def _strata(score: ScoreDocument, by: str) -> list[tuple[float, StratumScore]]:
    """Strata with the mean of what they are by."""
    return [(stratum.mean, stratum) for stratum in score.strata if stratum.by == by and stratum.mean is not None]


def _scale(tables: Tables) -> LogNorm:
    """One scale of distances for all maps, a hundredth of the largest at least."""
    from matplotlib.colors import LogNorm

    largest = max(
        float(table.filter("detected")["distance_px"].to_numpy().max(initial=0.0)) for table in tables.values()
    )
    largest = largest or 1.0  # nothing found, or nothing off
    return LogNorm(0.01 * largest, largest, clip=True)  # two decades of errors have colours


def _map(axes: Axes, table: pl.DataFrame, scale: LogNorm) -> Any:
    seen = table.filter(pl.col("visible"))
    found, lost = seen.filter(pl.col("detected")), seen.filter(~pl.col("detected"))
    distance = found["distance_px"].to_numpy()
    size = 3.0 + 24.0 * np.asarray(scale(distance))
    u, v = found["u_true_px"], found["v_true_px"]
    marks = axes.scatter(u, v, s=size, c=distance, cmap="cividis_r", norm=scale, linewidths=0.3, edgecolors="black")
    axes.scatter(lost["u_true_px"], lost["v_true_px"], s=18.0, marker="x", color="#d55e00", linewidths=0.9)
    axes.set(xlabel="u / px", ylabel="v / px")
    axes.set_aspect("equal", adjustable="datalim")  # the panel is filled, however the spots lie
    axes.invert_yaxis()
    return marks


def _binned(table: pl.DataFrame, column: str) -> tuple[Array, Array]:
    """Centres of bins of the radius and the rms in them, over detected spots; bins of fewer than 3 are left out."""
    found = table.filter(pl.col("detected") & pl.col(column).is_not_null())
    if not len(found):
        return np.empty(0), np.empty(0)
    radius, error = found["from_centre_px"].to_numpy(), found[column].to_numpy()
    # a little beyond the largest radius, which would otherwise fall out of the last bin
    edges = np.linspace(0.0, radius.max() * (1.0 + 1e-9), _BINS + 1)
    index = np.clip(np.digitize(radius, edges) - 1, 0, _BINS - 1)
    n, squares = np.bincount(index, minlength=_BINS), np.bincount(index, error**2, _BINS)
    kept = (n >= _LEAST_IN_BIN) & (squares > 0.0)
    return 0.5 * (edges[:-1] + edges[1:])[kept], np.sqrt(squares[kept] / n[kept])


def _pulls(table: pl.DataFrame) -> Array:
    both = table.filter(pl.col("detected") & pl.col("pull_u").is_not_null())
    return np.concatenate([both["pull_u"].to_numpy(), both["pull_v"].to_numpy()])


def plain_ticks(axes: Axes, decades: float = 1e3) -> None:
    """Decimal numbers at 1, 2, 5 of a logarithmic axis, at the decades alone where it spans a ratio of `decades`."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in (axes.xaxis, axes.yaxis):
        if axis.get_scale() == "log":
            low, high = sorted(axis.get_view_interval())
            wide = high > decades * max(low, 1e-300)  # an empty axis begins at 0
            axis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0), numticks=12))
            axis.set_major_formatter(FuncFormatter(lambda x, _: plain_number(x)))
            axis.set_minor_formatter(NullFormatter())


def plain_number(x: float) -> str:
    """A number without a power of ten: 0.002, 20, 50 000."""
    if x == 0.0 or not math.isfinite(x):
        return f"{x:g}"
    digits = max(0, 2 - math.floor(math.log10(abs(x))))
    text = f"{x:,.{digits}f}".replace(",", "\u202f")
    return text.rstrip("0").rstrip(".") if digits else text


def _key(i: int) -> EmbeddedFigure:
    with styled_figure(_PANEL, (0.5, 0.2)) as figure:
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.plot([0.0, 0.5, 1.0], [0.0, 0.0, 0.0], markevery=[1], **line_style(i))
        axes.set(xlim=(-0.05, 1.05), ylim=(-1.0, 1.0))
        axes.axis("off")
        return _svg(figure, "")


def _values_in_words(scores: Named, metric: str) -> str:
    factor, unit = METRICS[metric].shown
    values = {name: score.metrics[metric].value for name, score in scores.items()}
    shown = ", ".join(f"{name} {'none' if x is None else f'{factor * x:.3g} {unit}'}" for name, x in values.items())
    return f"Over all: {shown}."


def _shares(score: ScoreDocument) -> str:
    there = {cause: sum(kinds.values()) for cause, kinds in score.causes.items() if any(kinds.values())}
    return ", ".join(f"{cause} {100.0 * n / score.images:.1f} %" for cause, n in there.items()) or "none"


def _svg(figure: Figure, alt: str) -> EmbeddedFigure:
    return embedded_figure(encoded_figure(figure, "svg", True), "svg", alt)


def _png(figure: Figure, alt: str) -> EmbeddedFigure:
    return embedded_figure(encoded_figure(figure, "png", True), "png", alt)
