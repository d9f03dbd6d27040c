"""Style, file form and data address of the project's figures: the same marks give the same bytes.

The figures of a report, each with its text alternative. Markers, lines and hatches differ, not colours alone.

Scores as one HTML page: everything is in the file, nothing is fetched, no script runs.
"""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import polars as pl
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from scipy.stats import norm

from phibench.datasets.errors import DatasetError
from phibench.datasets.store.files import write_text
from phibench.estimator.benchmark.compare import same_pairs
from phibench.estimator.benchmark.document import ScoreDocument, StratumScore, Value, read_records, read_score
from phibench.estimator.benchmark.score_tables import HEADS, head, rank_key, rank_words, shown_parts
from phibench.scenes.frames import Array

# M. Okabe, K. Ito: told apart with every kind of colour vision; markers, lines and hatches repeat the distinction
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7f7f7f")
MARKERS = "osD^vP*X<>"
LINES = ("-", "--", "-.", ":")
STYLE: Any = {
    "svg.hashsalt": "phibench",
    "font.size": 9.0,
    "axes.grid": True,
    "grid.alpha": 0.35,
    "hatch.linewidth": 0.6,
}
_MIME = {"svg": "image/svg+xml", "png": "image/png"}
_METADATA: dict[str, dict[str, Any]] = {"svg": {"Date": None}, "png": {"Software": None}}


@dataclass(frozen=True)
class Picture:
    """A figure as a data address, with its alternative in words."""

    source: str
    alt: str


def line_style(i: int) -> dict[str, Any]:
    """Colour, line and marker of the i-th curve."""
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": LINES[i % len(LINES)], "marker": MARKERS[i % len(MARKERS)]}


def encoded(figure: Figure, kind: str) -> bytes:
    """A figure as a file, "svg" or "png"."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, metadata=_METADATA[kind])
    return buffer.getvalue()


def picture(data: bytes, kind: str, alt: str) -> Picture:
    """An encoded figure as a picture."""
    return Picture(f"data:{_MIME[kind]};base64,{base64.b64encode(data).decode('ascii')}", alt)


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
    values = {name: score.metrics["rms_px"].value for name, score in scores.items()}
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


_TEMPLATE = "report.html.j2"
_STRATA = ("detection_rate", "false_rate", "rms_px", "median_px", "p95_px", "rms_phi_rad", "rms_depth_relative")
_STRATA_TOO = ("efficiency_px", "pull_deviation")


@dataclass(frozen=True)
class Section:
    """A further part of a report, such as a study: paragraphs, pictures and tables of text.

    Attributes
    ----------
    title : str
    paragraphs : plain text
    pictures : tuple of Picture
    tables : rows of cells, the first row being heads
    captions : one for each table, or none at all
    """

    title: str
    paragraphs: tuple[str, ...] = ()
    pictures: tuple[Picture, ...] = ()
    tables: tuple[tuple[tuple[str, ...], ...], ...] = ()
    captions: tuple[str, ...] = ()


@dataclass(frozen=True)
class Ranking:
    """Scores that were taken on the same pairs, with all that is shown of them."""

    pair_set: Mapping[str, object]
    scores: Mapping[str, ScoreDocument]
    curves: Picture
    image_map: Picture
    by_radius: Picture
    causes: Picture
    pulls: Picture | None


def write_report(files: Sequence[Path], out: Path, sections: Sequence[Section] = (), by: str = "phi") -> Path:
    """Write a report about scores on disk.

    Parameters
    ----------
    files : JSON files of `score --method`, their Parquet files beside them
    out : HTML file
    sections : further sections after the scores
    by : "phi" or "depth", for the rank

    Raises
    ------
    DatasetError
        If there is neither a score nor a section, or a file is no score or lacks its records.
    """
    if not (files or sections):
        raise DatasetError(
            "a report of nothing: give at least one JSON file that `score --method --out` wrote, or the folder of a "
            "study (--study)"
        )
    read = [(path, read_score(path)) for path in files]
    return write_text(
        out, report_html([(document, read_records(path, document)) for path, document in read], sections, by)
    )


def report_html(
    scores: Sequence[tuple[ScoreDocument, pl.DataFrame]], sections: Sequence[Section] = (), by: str = "phi"
) -> str:
    """The page as text; the same scores give the same text."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    environment.globals.update(
        board=HEADS, head=head, parts=shown_parts, ranked_by=rank_words(by), strata_metrics=(*_STRATA, *_STRATA_TOO)
    )
    environment.filters["json"] = lambda value: json.dumps(value, indent=1)
    rankings = [_ranking(group, by) for group in _groups(scores)]
    return environment.get_template(_TEMPLATE).render(rankings=rankings, sections=sections)


def _groups(scores: Sequence[tuple[ScoreDocument, pl.DataFrame]]) -> list[list[tuple[ScoreDocument, pl.DataFrame]]]:
    """Scores by what they were taken on and by which rules."""
    groups: dict[str, list[tuple[ScoreDocument, pl.DataFrame]]] = {}
    for document, table in scores:
        key = json.dumps([same_pairs(document), document.pairs, document.rules], sort_keys=True)
        groups.setdefault(key, []).append((document, table))
    return list(groups.values())


def _ranking(group: list[tuple[ScoreDocument, pl.DataFrame]], by: str) -> Ranking:
    order = sorted(group, key=lambda item: rank_key(item[0], by))
    names = _distinct([document.method.name for document, _ in order])
    scores = {name: document for name, (document, _) in zip(names, order, strict=True)}
    tables = {name: table for name, (_, table) in zip(names, order, strict=True)}
    return Ranking(
        order[0][0].pair_set,
        scores,
        error_curves(scores),
        error_map(tables),
        error_by_radius(tables),
        cause_bars(scores),
        pull_histogram(tables),
    )


def _distinct(names: list[str]) -> list[str]:
    """Names, with a number where one occurs again."""
    return [f"{name} ({names[:i].count(name) + 1})" if names.count(name) > 1 else name for i, name in enumerate(names)]
