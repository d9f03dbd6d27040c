"""Findings: the numbers that a study states, one row each, and the writer of their table.

A finding has a label, a value, the ends of its 95 % interval, and a unit. Where a statement hangs on the number there
is a threshold, and a verdict. The table is text; the terminal, Markdown and the HTML report show the same cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from phibench.datasets.common.shown_text import table_lines

Row = tuple[str, ...]
Relation = Literal["", "<=", ">=", "=", "!="]
Verdict = Literal["", "met", "missed", "undecided", "favoured", "disfavoured"]
HEADS = ("finding", "value", "95 %", "unit", "threshold", "verdict")
_WHOLE_FROM = 1000.0  # three digits of a larger number would hide its units
_SMALLEST = 1e-3  # below it numbers have an exponent


@dataclass(frozen=True)
class Finding:
    """One number that a study states.

    Attributes
    ----------
    label : str
        Quantity and the case that it belongs to; no two findings of a study share it.
    value : float or None
        In `unit`; None where there is no number.
    low, high : float or None
        Ends of its interval of 95 %; None without one.
    unit : str
    relation, threshold
        Statement that the number decides, such as "<=" 1.0.
    verdict : str
        "met", "missed" or "undecided"; of an explanation "favoured", "disfavoured" or "undecided".
    """

    label: str
    value: float | None
    low: float | None = None
    high: float | None = None
    unit: str = ""
    relation: Relation = ""
    threshold: float | None = None
    verdict: Verdict = ""

    def __post_init__(self) -> None:
        for name in ("value", "low", "high", "threshold"):
            number = getattr(self, name)
            known = number is not None and math.isfinite(number)
            object.__setattr__(self, name, float(number) if known else None)

    @classmethod
    def ranged(cls, label: str, ends: Iterable[float], unit: str = "", scale: float = 1.0) -> Finding:
        """Finding from value, low and high in this order, each times `scale`."""
        value, low, high = (scale * float(x) for x in ends)
        return cls(label, value, low, high, unit)

    def judged(self, relation: Relation, threshold: float) -> Finding:
        """The same row with a threshold and a verdict.

        The whole interval decides, or the value where there is no interval. An interval with the threshold inside is
        undecided; "=" asks for just that, and "!=" for the opposite.
        """
        return replace(self, relation=relation, threshold=threshold, verdict=self._verdict(relation, threshold))

    def _verdict(self, relation: Relation, threshold: float) -> Verdict:
        low, high = (self.value if end is None else end for end in (self.low, self.high))
        if low is None or high is None:
            return "undecided"
        inside = low <= threshold <= high
        if relation == "=":
            return "met" if inside else "missed"
        if relation == "!=":
            return "undecided" if inside else "met"
        if (high <= threshold) if relation == "<=" else (low >= threshold):
            return "met"
        return "undecided" if inside else "missed"

    @property
    def row(self) -> Row:
        """Cells below `HEADS`."""
        interval = "" if self.low is None or self.high is None else f"{number(self.low)} to {number(self.high)}"
        threshold = "" if self.threshold is None else f"{self.relation} {number(self.threshold)}"
        return (self.label, number(self.value), interval, self.unit, threshold, self.verdict)

    @property
    def text(self) -> str:
        """Label, value and interval in words, for the text alternative of a drawing."""
        _, value, interval, unit, _, _ = self.row
        return " ".join(filter(None, (f"{self.label}:", value, unit, f"({interval})" if interval else "")))


def number(value: float | None) -> str:
    """A number with three digits, whole from 1000 on; a dash for none."""
    if value is None or not math.isfinite(value):
        return "-"
    if value == round(value) and abs(value) < 1e15:  # beyond it every double is whole
        return f"{value:.0f}"
    if abs(value) >= _WHOLE_FROM:
        return f"{value:.0f}"
    return f"{value:#.3g}".rstrip(".") if abs(value) >= _SMALLEST else f"{value:.2e}"


def findings_table(findings: Iterable[Finding]) -> tuple[Row, ...]:
    """Heads and a row per finding; columns that are empty throughout are left out."""
    rows = [HEADS, *(finding.row for finding in findings)]
    kept = [i for i in range(len(HEADS)) if i < 2 or any(row[i] for row in rows[1:])]
    return tuple(tuple(row[i] for i in kept) for row in rows)


def markdown_table(rows: Sequence[Row]) -> str:
    """Lines of a Markdown table; the first row is the heads."""
    head, *body = ([cell.replace("|", "\\|") for cell in row] for row in rows)
    return "\n".join(table_lines(head, body, [" --- "] * len(head)))


def print_table(rows: Sequence[Row]) -> None:
    """Print a table on the terminal; long labels are wrapped."""
    from rich.console import Console
    from rich.table import Table

    head, *body = rows
    table = Table(*head)
    for column in table.columns[1:]:
        column.no_wrap = True
    for row in body:
        table.add_row(*row)
    Console(markup=False, emoji=False).print(table)
