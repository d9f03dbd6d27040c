"""Tables of dense scores: methods side by side, strata and metrics of one, differences of two; failures in words."""

from __future__ import annotations

from collections.abc import Sequence

import polars as pl

from phibench.benchmark.dense.dense_document import DenseScore
from phibench.benchmark.dense.dense_metrics import DENSE_METRICS
from phibench.benchmark.scores.compare import Difference
from phibench.benchmark.scores.score_document import Value
from phibench.benchmark.scores.score_tables import cell_parts
from phibench.datasets.common.shown_text import TextTable, text_of

_SHOWN = {
    "recall": "recall",
    "answered": "answered",
    "median_relative": "median",
    "mean_relative": "mean",
    "above_5": "above 5",
    "above_10": "above 10",
    "matching": "matching",
    "central": "central",
    "calibration": "rig",
}
_OF_STRATA = ("recall", "answered", "median_relative", "above_10", "central")
_ROUNDING = 1e-9  # relative: what is below shows as 0
_NOTE = (
    "Errors are of D, relative. matching: answer against perfect matches through the same rig; central: what the "
    "central model adds to perfect matches; rig: perfect matches through the given rig."
)


def _cell(name: str, value: Value, wide: bool = False) -> str:
    if value.value is not None and abs(value.value) < _ROUNDING:
        return "0"
    shown, interval = cell_parts(value.estimate, 100.0 if DENSE_METRICS[name].unit == "1" else 1.0, 2, significant=True)
    return f"{shown}\n{interval}" if wide and interval else shown


def _head(text: str) -> str:
    """Head of two lines, the unit in the second; narrow, so that names of methods do not break."""
    word, _, limit = text.partition(" ")
    return f"{word}\n{limit} %".replace("\n %", "\n%")


def dense_board(scores: Sequence[DenseScore], wide: bool = False) -> TextTable:
    """One row per method, the best recall first."""
    first = scores[0]
    ordered = sorted(scores, key=lambda score: -(score.metrics["recall"].value or 0.0))
    rows = [(score.method.name, *(_cell(name, score.metrics[name], wide) for name in _SHOWN)) for score in ordered]
    title = f"{first.pairs} dense pairs of '{first.pair_set.get('name')}', {first.pixels} pixels that both images show"
    heads = ("method", *map(_head, _SHOWN.values()))
    return TextTable(title, heads, tuple(rows), "L" + "r" * len(_SHOWN), _NOTE)


def dense_strata_table(score: DenseScore) -> TextTable:
    """One row per stratum."""
    rows = []
    for part in score.strata:
        name = f"{part.by}, {part.label}".removesuffix(" of D").removesuffix(" of the noise")
        cells = (_cell(name, part.metrics[name]) for name in _OF_STRATA)
        rows.append((name, f"{part.pixels / 1000.0:.0f}", *cells))
    heads = ("part", "pixels\n1000", *(_head(_SHOWN[name]) for name in _OF_STRATA))
    return TextTable(f"{score.method.name}, by part", heads, tuple(rows), "l" + "r" * (1 + len(_OF_STRATA)))


def dense_metrics_table(score: DenseScore) -> TextTable:
    """Every metric with its interval, in SI units."""
    rows = []
    for name, value in score.metrics.items():
        shown, interval = cell_parts(value.estimate, 1.0, 3, significant=True)
        rows.append((name, shown, interval, value.unit, value.text))
    return TextTable(
        f"{score.method.name}, every metric", ("metric", "value", "95 %", "unit", "what"), tuple(rows), "lrrlL"
    )


def dense_differences(differences: Sequence[Difference], first: str, second: str) -> TextTable:
    """Paired differences of two scores."""
    rows = []
    for item in differences:
        metric = DENSE_METRICS[item.name]
        factor = 100.0 if metric.unit == "1" else 1.0
        shown, interval = cell_parts(item.difference, factor, 2, significant=True)
        unit = "%" if factor > 1.0 else metric.unit
        name = f"{item.name.removesuffix('_m')}, {unit}"
        values = (f"{factor * value:.3g}" for value in (item.first, item.second))
        verdict = {"first": first, "second": second}.get(item.better, item.better)
        if metric.better not in ("lower", "higher"):
            verdict = "-"  # more answers are no better ones
        rows.append((name, *values, shown, interval, verdict))
    heads = ("metric", "first", "second", "difference", "95 %", "better")
    return TextTable(f"second, {second}, minus first, {first}", heads, tuple(rows), "lrrrrL")


def dense_failures(records: pl.DataFrame) -> list[str]:
    """Sentences on the pairs on which a method failed, the message of the first of each kind."""
    failed = records.filter((pl.col("by") == "all") & (pl.col("failure") != ""))
    lines = []
    for (kind,), rows in failed.group_by(["failure"], maintain_order=True):
        lines.append(f"{len(rows)} pairs failed ({kind}), such as '{rows['sample_id'][0]}': {rows['message'][0]}")
    return lines


def dense_text(scores: Sequence[DenseScore]) -> str:
    """The table of methods as text."""
    return text_of(dense_board(scores))
