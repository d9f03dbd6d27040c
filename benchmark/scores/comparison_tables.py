"""Tables of a comparison of two scores: for a terminal, as CSV and as JSON."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence

from phibench.benchmark.scores.compare import Difference
from phibench.benchmark.scores.metrics import METRICS
from phibench.benchmark.scores.score_tables import DIGITS, cell_parts, number
from phibench.datasets.common.shown_text import TextTable, csv_table, latex, markdown, show_grid, table_console

_BETTER = {"no difference shown": "not shown", "too few samples": "not shown"}


def comparison(differences: Sequence[Difference], first: str, second: str, wide: bool = False) -> TextTable:
    """One row per metric: both values, second minus first with its interval, and which is better if that is shown."""
    rows = []
    for item in differences:
        metric = METRICS[item.name]
        factor, unit = metric.shown
        values = (number(factor * x, DIGITS, significant=True) for x in (item.first, item.second))
        change = cell_parts(item.difference, factor, DIGITS, significant=True)
        counts = (str(item.n), str(item.samples), number(item.chance, 4)) if wide else ()
        rows.append((metric.text, unit, *values, *change, *counts, _BETTER.get(item.better, item.better)))
    counted = ("n", "samples", "chance") if wide else ()
    heads = ("metric", "unit", "first", "second", "second\n- first", "interval", *counted, "better")
    columns = "LlrrrL" + "r" * len(counted) + "L"
    return TextTable(f"Over what both have. First: {first}. Second: {second}", heads, tuple(rows), columns)


def print_comparison(differences: Sequence[Difference], first: str, second: str, form: str, wide: bool) -> None:
    """Print a comparison; parameters as for `print_scores`."""
    grid = comparison(differences, first, second, wide)
    if form == "terminal":
        show_grid(table_console(wide), grid)
    else:
        texts = {"csv": lambda: differences_csv(differences), "json": lambda: differences_json(differences)}
        texts |= {"markdown": lambda: markdown(grid), "latex": lambda: latex(grid)}
        sys.stdout.write(texts[form]())


def differences_csv(differences: Sequence[Difference]) -> str:
    """One row per metric, in the units of the files, in full."""
    return csv_table(
        list(_difference_fields(differences[0])), [list(_difference_fields(d).values()) for d in differences]
    )


def differences_json(differences: Sequence[Difference]) -> str:
    """One JSON object: metric to values and difference."""
    fields = {d.name: {key: x for key, x in _difference_fields(d).items() if key != "metric"} for d in differences}
    return json.dumps(fields, indent=1, allow_nan=False) + "\n"


def _difference_fields(d: Difference) -> dict[str, str | float | int | None]:
    numbers = {"first": d.first, "second": d.second, "difference": d.difference.value}
    numbers |= {"low": d.difference.low, "high": d.difference.high}
    finite = {name: x if math.isfinite(x) else None for name, x in numbers.items()}
    return {
        "metric": d.name,
        "unit": METRICS[d.name].unit,
        **finite,
        "n": d.n,
        "samples": d.samples,
        "chance": d.chance if math.isfinite(d.chance) else None,
        "better": d.better,
    }
