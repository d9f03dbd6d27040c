"""Page of results of dense methods in Markdown, from score files alone: the same files give the same bytes.

The methods stand side by side, each is compared with the next pair by pair (`compare_dense`), and the best ones are
shown by parts of the pixels.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from phibench.benchmark.dense.dense_document import DenseScore
from phibench.benchmark.dense.dense_metrics import DENSE_METRICS
from phibench.benchmark.dense.dense_score import compare_dense, read_dense
from phibench.benchmark.scores.compare import Difference
from phibench.benchmark.scores.score_document import Value
from phibench.benchmark.scores.score_tables import cell_parts
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.shown_text import markdown_cell, table_lines
from phibench.datasets.store.files import write_text

_TABLES = {
    "Recall and errors": ("recall", "answered", "median_relative", "p90_relative", "above_10", "hidden_answered"),
    "As Helvipad has them": ("mae_m", "rmse_m", "mean_relative", "disparity_mae_deg", "disparity_rmse_deg", "seam_m"),
    "Parts of the error, claims, time": ("matching", "central", "calibration", "ause", "coverage", "seconds"),
}
_COMPARED = ("recall", "median_relative", "above_10", "matching")
_OF_PARTS, _BEST = ("recall", "median_relative"), 3
_HEADS = {
    "p90_relative": "90 % of the answers",
    "median_relative": "median error",
    "mean_relative": "MARE",
    "mae_m": "MAE",
    "rmse_m": "RMSE",
    "disparity_mae_deg": "disparity MAE",
    "disparity_rmse_deg": "disparity RMSE",
    "seam_m": "LRCE",
    "above_10": "above 10 % of D",
    "hidden_answered": "hidden answered",
    "ause": "AUSE",
}
_INTRODUCTION = """# Results of dense methods

`phibench dense show FILES --out PAGE` writes this page from score files. Do not edit it by hand.
[Dense depth](dense.md#what-is-scored) defines every number. Values are means over pairs, with 95 % intervals over
samples in brackets. A dash: the method has no such value. The best recall stands first.
"""
_DIFFERENCES = (
    "Each method minus the next one, on the same pairs. Two stars: shown by an exact test, corrected for all metrics "
    "that `dense compare` has."
)


def write_dense_results(files: Sequence[Path], out: Path, seed: int = 0) -> Path:
    """Write the page about scores of the same pairs; `seed` is the bootstrap's of differences.

    Raises
    ------
    DatasetError
        If a file is no dense score, two are of other pairs, or a method has two scores.
    """
    scores = {path: read_dense(path) for path in files}
    names = [scores[path].method.name for path in files]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise DatasetError(f"{twice[0]} has two scores here: give one of them")
    order = sorted(scores, key=lambda path: -(scores[path].metrics["recall"].value or 0.0))
    differences = [compare_dense(worse, better, seed) for better, worse in pairwise(order)]
    return write_text(out, dense_results([scores[path] for path in order], differences))


def dense_results(scores: Sequence[DenseScore], differences: Sequence[Sequence[Difference]]) -> str:
    """Page of scores, the best first, and of each one's differences from the next."""
    parts = [_INTRODUCTION, _source(scores)]
    for title, names in _TABLES.items():
        rows = [(score.method.name, *(_value(name, score.metrics[name]) for name in names)) for score in scores]
        parts.append(_section(title, ("method", *map(_head, names)), rows))
    if differences:
        rows = [
            (f"{a.method.name} - {b.method.name}", *(_change(found, name) for name in _COMPARED))
            for (a, b), found in zip(pairwise(scores), differences, strict=True)
        ]
        parts.append(_section("Differences", ("methods", *map(_head, _COMPARED)), rows, _DIFFERENCES))
    parts.append(_by_parts(scores[:_BEST]))
    return "\n".join(parts)


def _source(scores: Sequence[DenseScore]) -> str:
    first = scores[0]
    programs = ", ".join(sorted({score.program or "not told" for score in scores}))
    name, presets = first.pair_set.get("name"), ", ".join(first.pair_set.get("presets", ()))
    text = (
        f"{first.pairs} pairs of `{name}`, {presets}, {first.samples} samples, {first.pixels} pixels that both images "
        f"show. Scored by {programs}."
    )
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False) + "\n"


def _section(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]], text: str = "") -> str:
    lines = [f"## {title}", "", *([textwrap.fill(text, 120), ""] * bool(text))]
    marks = (":--", *("--:" for _ in heads[1:]))
    return "\n".join([*lines, *table_lines(heads, [tuple(map(markdown_cell, row)) for row in rows], marks), ""])


def _head(name: str) -> str:
    unit = DENSE_METRICS[name].unit
    return f"{_HEADS.get(name, name.removesuffix('_relative'))} / {'%' if _is_share(name) else unit}".removesuffix(
        " / 1"
    )


def _is_share(name: str) -> bool:
    return DENSE_METRICS[name].unit == "1" and name != "ause"


def _value(name: str, value: Value, digits: int = 3) -> str:
    if value.value is not None and abs(value.value) < 1e-9:
        return "0"
    return _told(cell_parts(value.estimate, 100.0 if _is_share(name) else 1.0, digits, significant=True))


def _told(parts: tuple[str, str]) -> str:
    return " ".join(filter(None, parts)) or "-"


def _change(found: Sequence[Difference], name: str) -> str:
    """Better minus worse, with stars where a difference is shown."""
    one = next(item for item in found if item.name == name)
    shown = _told(cell_parts(one.difference, 100.0 if _is_share(name) else 1.0, 2, significant=True))
    return f"{shown} **" if one.better in ("first", "second") else shown


def _by_parts(scores: Sequence[DenseScore]) -> str:
    """Recall and median error of the best methods in each part."""
    rows = []
    for part in scores[0].strata:
        cells = []
        for score in scores:
            same = [other for other in score.strata if (other.by, other.label) == (part.by, part.label)]
            cells.append("; ".join(_value(name, same[0].metrics[name], 2) for name in _OF_PARTS) if same else "-")
        rows.append((part.by, part.label, str(part.pairs), *cells))
    heads = ("by", "part", "pairs", *(score.method.name for score in scores))
    return _section(
        "Parts", heads, rows, "Recall / %; median error / %. Pairs are those with at least 200 such pixels."
    )
