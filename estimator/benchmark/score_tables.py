"""Scores as tables for a terminal, with intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence

import polars as pl
from rich.table import Table
from rich.text import Text

from phibench.estimator.benchmark.compare import Difference
from phibench.estimator.benchmark.document import ScoreDocument
from phibench.estimator.benchmark.intervals import Estimate
from phibench.estimator.benchmark.metrics import METRICS, RANKS

# metric, head, factor from its unit, digits
BOARD: tuple[tuple[str, str, float, int], ...] = (
    ("detection_rate", "found %", 100.0, 1),
    ("false_rate", "false %", 100.0, 1),
    ("rms_counted_px", "rms px, missed counted", 1.0, 4),
    ("rms_px", "rms px", 1.0, 4),
    ("rms_phi_rad", "rms phi mrad", 1e3, 4),
    ("rms_depth_counted", "rms D %, missed counted", 100.0, 3),
    ("rms_depth_relative", "rms D %", 100.0, 3),
    ("efficiency_px", "efficiency", 1.0, 3),
    ("pull_deviation", "pull", 1.0, 3),
    ("seconds", "s/pair", 1.0, 3),
)


def ranked(documents: Sequence[ScoreDocument], by: str = "phi") -> list[ScoreDocument]:
    """Best first."""
    return sorted(documents, key=lambda document: rank_key(document, by))


def rank_key(document: ScoreDocument, by: str = "phi") -> float:
    """Rms error of phi or of D with missed spots and false detections counted; lower is better.

    Parameters
    ----------
    by : "phi" or "depth"
    """
    value = document.metrics[RANKS[by]].value
    return math.inf if value is None else value


def leaderboard(documents: Sequence[ScoreDocument]) -> Table:
    """One line per method, best first; below each value its interval."""
    confidence = documents[0].rules["confidence"]
    grid = Table(title=f"Scores with {100 * confidence:g} % intervals over samples", show_lines=True)
    grid.add_column("method", no_wrap=True)
    grid.add_column("pairs", justify="right")
    for _, head, _, _ in BOARD:
        grid.add_column(head, justify="right")
    for document in ranked(documents):
        cells = (cell(document.metrics[name].estimate, factor, digits) for name, _, factor, digits in BOARD)
        grid.add_row(document.method.name, str(document.pairs), *cells)
    return grid


def depth_line(document: ScoreDocument) -> str:
    """Whether the predicted error of D, the calibration's part included, is that of the errors."""
    pull, within = (document.metrics[name].estimate for name in ("pull_depth", "coverage_depth"))
    share = one_line(within, 100.0, 1)
    return f"{document.method.name}: pull of D {one_line(pull, 1.0, 3)}; within 1.96 sigma of D {share} %, 95 is right"


def strata_table(document: ScoreDocument) -> Table:
    """One line per stratum of one method."""
    least = round(document.rules["least_samples"])
    title = Text(f"{document.method.name}: strata")  # a string would be searched for emoji
    grid = Table(title=title, caption=f"*: fewer than {least} samples, no interval")
    for head in ("by", "stratum", "images", "found %", "rms px", "median px", "rms phi mrad", "rms D %", "efficiency"):
        grid.add_column(head, justify="left" if head in ("by", "stratum") else "right", no_wrap=True)
    for stratum in (document.whole, *document.strata):
        shown = (
            ("detection_rate", 100.0, 1),
            ("rms_px", 1.0, 4),
            ("median_px", 1.0, 4),
            ("rms_phi_rad", 1e3, 4),
            ("rms_depth_relative", 100.0, 3),
            ("efficiency_px", 1.0, 3),
        )
        there = ((stratum.metrics.get(name), factor, digits) for name, factor, digits in shown)
        cells = ("" if value is None else _starred(value.estimate, f, d) for value, f, d in there)
        grid.add_row(stratum.by, stratum.label, str(stratum.images), *cells)
    return grid


def _starred(estimate: Estimate, factor: float, digits: int) -> str:
    """As `one_line`, with a star where there are too few samples for an interval."""
    value, rest = cell_parts(estimate, factor, digits)
    return f"{value} *" if rest.startswith("(") else f"{value} {rest}".strip()


def cause_table(documents: Sequence[ScoreDocument]) -> Table:
    """Images without a right position by cause, one column per method: missed + false (+ unseen)."""
    grid = Table(title="Images without a right position: missed / false / rightly not answered")
    grid.add_column("cause")
    for document in documents:
        grid.add_column(document.method.name, justify="right")
    for cause in documents[0].causes:
        kinds = [document.causes[cause] for document in documents]
        if any(any(kind.values()) for kind in kinds):
            grid.add_row(cause, *(f"{kind['missed']} / {kind['false']} / {kind['unseen']}" for kind in kinds))
    return grid


def silences(records: pl.DataFrame, count: int = 3) -> list[str]:
    """What a method or the harness said most often where there is no position, one line each."""
    words = pl.when(pl.col("message") != "").then(pl.col("failure") + ": " + pl.col("message"))
    said = records.filter(pl.col("u_px").is_null()).with_columns(words=words.otherwise(pl.col("status")))
    most = said.group_by("words").len().sort("len", "words", descending=[True, False]).head(count)
    return [f"{number} of {len(records)} images without a position: {text}" for text, number in most.rows()]


def comparison(differences: Sequence[Difference], first: str, second: str) -> Table:
    """One line per metric: both values, the difference with its interval, and which is better if that is shown."""
    grid = Table(title=Text(f"second - first, over what both have; first: {first}, second: {second}"))
    for head in ("metric", "unit", "first", "second", "difference", "n", "samples", "better"):
        grid.add_column(head, justify="left" if head in ("metric", "better") else "right")
    for item in differences:
        names = {"first": first, "second": second}
        metric = METRICS[item.name]
        values = (number(x, 4, significant=True) for x in (item.first, item.second))
        shown = one_line(item.difference, 1.0, 3, significant=True)
        counts = (str(item.n), str(item.samples))
        grid.add_row(metric.text, metric.unit, *values, shown, *counts, names.get(item.better, item.better))
    return grid


def cell(estimate: Estimate, factor: float = 1.0, digits: int = 3) -> str:
    """Value, and its interval on a second line."""
    value, interval = cell_parts(estimate, factor, digits)
    return f"{value}\n{interval}" if interval else value


def one_line(estimate: Estimate, factor: float = 1.0, digits: int = 3, significant: bool = False) -> str:
    """Value and interval on one line."""
    return " ".join(part for part in cell_parts(estimate, factor, digits, significant) if part)


def number(value: float, digits: int, significant: bool = False) -> str:
    """A number, "-" where there is none; one below its last digit as a power of ten, not as 0."""
    if not math.isfinite(value):
        return "-"
    if significant or 0.0 < abs(value) < 0.5 * 10.0**-digits:
        return f"{value:.{max(digits - 1, 0)}e}" if 0.0 < abs(value) < 1e-3 else f"{value:.{digits}g}"
    return f"{value:.{digits}f}"


def cell_parts(estimate: Estimate, factor: float, digits: int, significant: bool = False) -> tuple[str, str]:
    """Value and interval, or value and why there is none; "-" alone where there is no value."""
    if not math.isfinite(estimate.value):
        return "-", ""
    value = number(factor * estimate.value, digits, significant)
    if not math.isfinite(estimate.low):
        return value, f"({estimate.note})" if estimate.note else ""
    low, high = (number(factor * x, digits, significant) for x in (estimate.low, estimate.high))
    return value, f"[{low}, {high}]"
