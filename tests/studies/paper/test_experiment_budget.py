"""The error budget of experiments on made-up rows whose answer is known."""

from __future__ import annotations

import io

import numpy as np
import polars as pl
import pytest
from rich.console import Console

from phibench.benchmark.scores.intervals import NORMAL_95
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.shown_text import show_grid
from phibench.scenes.random_streams import generator
from phibench.studies.paper.experiment_bounds import budget, budget_table, budgets
from phibench.studies.paper.experiment_tables import COLUMNS

SAMPLES, DRAWS = 60, 4


def rows(claimed: float = 1.0) -> pl.DataFrame:
    """Normal errors of sigma 1 % of D at half of the samples, 3 % at the others; `claimed` times that is predicted."""
    rng = generator("tests", "budget")
    sigma = np.repeat(np.where(np.arange(SAMPLES) % 2, 0.03, 0.01), DRAWS)
    depth = np.repeat(np.linspace(1.0, 4.0, SAMPLES), DRAWS)
    error = sigma * rng.standard_normal(SAMPLES * DRAWS) * depth
    predicted = claimed * sigma * depth
    names = np.repeat([f"s{k:02d}" for k in range(SAMPLES)], DRAWS)
    return pl.DataFrame(
        {
            **{name: np.zeros(len(depth)) for name in COLUMNS},
            "sample_id": names,
            "experiment": np.where(sigma > 0.02, "far", "near"),
            "depth_m": depth,
            "error_m": error,
            "relative_error": error / depth,
            "sigma_m": predicted,
            "bound_m": 0.8 * sigma * depth,
            "nominal_error": np.full(len(depth), 0.05),
            "within_95": np.abs(error) <= NORMAL_95 * predicted,
            "status": ["ok"] * len(depth),
        }
    )


def test_a_right_prediction_closes_the_budget() -> None:
    """240 normal errors: the ratio scatters by about 1 / sqrt(2 n_eff), n_eff = 240 (E s^2)^2 / E s^4 = 146: 6 %."""
    found = budget(rows())
    assert (found.n, found.samples, found.missing) == (240, 60, 0)
    assert found.predicted == pytest.approx(np.sqrt((0.01**2 + 0.03**2) / 2.0), rel=1e-12)
    assert found.bound == pytest.approx(0.8 * found.predicted, rel=1e-12)
    assert found.nominal == pytest.approx(0.05)
    assert abs(found.closure.value - 1.0) < 0.24  # 4 sigma
    assert found.closure.value == pytest.approx(found.predicted / found.measured.value, rel=1e-12)
    assert found.over_bound.value == pytest.approx(found.measured.value / found.bound, rel=1e-12)
    assert found.closure.low < 1.0 < found.closure.high
    assert found.within_95.low < 0.95 < found.within_95.high


@pytest.mark.parametrize("claimed", [0.6, 1.6])
def test_a_wrong_prediction_shows(claimed: float) -> None:
    found = budget(rows(claimed))
    assert not found.closure.low < 1.0 < found.closure.high
    if claimed < 1.0:  # where all are within, 60 samples leave 0.95 open
        assert not found.within_95.low < 0.95 < found.within_95.high


def test_what_has_no_estimate_is_counted_apart() -> None:
    table = rows().with_columns(
        status=pl.when(pl.col("sample_id") == "s00").then(pl.lit("no spot")).otherwise("status")
    )
    found = budget(table)
    assert (found.n, found.samples, found.missing) == (236, 59, 4)
    with pytest.raises(DatasetError, match="none of 4 experiments has an estimate; the first says: no spot"):
        budget(table.filter(pl.col("status") == "no spot"))
    with pytest.raises(DatasetError, match="there are none"):
        budget(table.clear())


def test_budgets_by_a_column() -> None:
    found = budgets(rows(), "experiment")
    assert list(found) == ["near", "far"]
    assert found["near"].predicted == pytest.approx(0.01, rel=1e-12)
    assert found["far"].predicted == pytest.approx(0.03, rel=1e-12)
    assert sum(one.n for one in found.values()) == 240


@pytest.mark.parametrize("wide", [False, True])
def test_the_table_of_budgets_fits_80_columns_and_a_wide_one_has_the_intervals(wide: bool) -> None:
    table = rows().with_columns(
        experiment=pl.when(pl.col("experiment") == "far").then(pl.lit("calibration")).otherwise("experiment"),
        status=pl.when(pl.col("sample_id") == "s00").then(pl.lit("no spot")).otherwise("status"),
    )
    console = Console(width=210 if wide else 80, file=io.StringIO())
    show_grid(console, budget_table(table, wide))
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert (max(map(len, lines)) <= 80) != wide
    (row,) = [line for line in lines if line.startswith("calibration")]
    assert row.count("[") == (4 if wide else 0)
    assert "120/120" in row
    assert any("236/240" in line for line in lines)
