"""The paper's published results, Tables 1 to 4, from `published.csv`."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

PUBLISHED_CSV = Path(__file__).with_name("published.csv")
_SAME_M = 1e-6


@dataclass(frozen=True)
class Published:
    """One column of one of the paper's tables, metres; `baseline_m` has the misprint of Table 1 corrected."""

    experiment: str
    real_depth_m: float
    baseline_printed_m: float
    baseline_m: float
    estimated_depth_m: float

    @property
    def error_m(self) -> float:
        """Published estimate minus real depth."""
        return self.estimated_depth_m - self.real_depth_m


def load_published() -> tuple[Published, ...]:
    """Read the 25 published results in the order of the tables."""
    lines = (line for line in PUBLISHED_CSV.read_text(encoding="utf-8").splitlines() if not line.startswith("#"))
    return tuple(_row(record) for record in csv.DictReader(lines))


def find_published(experiment: str, depth_m: float, stroke_m: float) -> Published | None:
    """Return the published result of an experiment ("table1" to "table4"), or None if the paper has none."""
    matches = (
        row
        for row in load_published()
        if row.experiment == experiment
        and abs(row.real_depth_m - depth_m) < _SAME_M
        and abs(row.baseline_m - stroke_m) < _SAME_M
    )
    return next(matches, None)


def _row(record: dict[str, str]) -> Published:
    lengths = {name: float(text) for name, text in record.items() if name != "table"}
    return Published(f"table{record['table']}", **lengths)
