"""Error budget of experiments: predicted against measured errors of D, and both against the bound."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
from rich.table import Table

from phibench.datasets.errors import DatasetError
from phibench.datasets.files import write_bytes
from phibench.estimator.bench.bootstrap import Clusters, Estimate, estimates, rms_of, rms_ratio_of
from phibench.estimator.bench.rates import rate
from phibench.estimator.bench.rules import Rules
from phibench.estimator.bench.tables import one_line
from phibench.scenes.frames import Array
from phibench.scenes.streams import generator


@dataclass(frozen=True)
class Budget:
    """Predicted against measured errors of D over some rows; every estimate has a 95 % interval over samples.

    Attributes
    ----------
    n, samples, missing : int
        Rows with an estimate, their samples, and rows without.
    measured : Estimate
        Rms relative error of D.
    predicted : float
        Rms of the predicted relative standard deviations.
    bound : float
        The same at the bound.
    closure : Estimate
        predicted / measured; 1 is a budget that closes.
    over_bound : Estimate
        measured / bound; 1 is the limit.
    within_95 : Estimate
        Share of errors within the predicted interval.
    believed : float
        Rms relative error with the rigs as believed.
    """

    n: int
    samples: int
    missing: int
    measured: Estimate
    predicted: float
    bound: float
    closure: Estimate
    over_bound: Estimate
    within_95: Estimate
    believed: float


def budget(rows: pl.DataFrame, rules: Rules | None = None, seed: int = 0) -> Budget:
    """Error budget of rows of `run_experiments`.

    Raises
    ------
    DatasetError
        If no row has an estimate.
    """
    rules, found = rules or Rules(), rows.filter(pl.col("status") == "ok")
    if found.is_empty():
        raise DatasetError(f"none of {len(rows)} experiments has an estimate; the first says: {_first_status(rows)}")
    clusters = Clusters.of(found["sample_id"].to_numpy())
    error2, sigma2, bound2 = (_squares(found[name] / found["depth_m"]) for name in ("error_m", "sigma_m", "bound_m"))
    statistics = (
        rms_of(clusters, error2),
        rms_ratio_of(clusters, sigma2, error2),
        rms_ratio_of(clusters, error2, bound2),
    )
    measured, closure, over = estimates(statistics, clusters.n, rules, generator("budget", seed))
    believed2 = _squares(found["believed_error"])
    predicted, bound, believed = (float(np.sqrt(np.mean(x))) for x in (sigma2, bound2, believed2))
    within = rate(clusters, found["within_95"].cast(pl.Float64).to_numpy(), rules)
    numbers = len(found), clusters.n, len(rows) - len(found)
    return Budget(*numbers, measured, predicted, bound, closure, over, within, believed)


def budgets(rows: pl.DataFrame, by: str, rules: Rules | None = None) -> dict[str, Budget]:
    """A budget for every value of a column, in the order of first appearance."""
    groups = rows.partition_by(by, maintain_order=True, as_dict=True)
    return {str(key[0]): budget(group, rules) for key, group in groups.items()}


def budget_table(rows: pl.DataFrame) -> Table:
    """Budgets per experiment and per distance, of all rows, and of those whose bound is at most 1 % of D."""
    grid = Table(title="Relative errors of D in %; 95 % intervals over samples")
    heads = ("rows", "n", "missing", "measured", "predicted", "bound", "predicted / measured", "measured / bound")
    for head in (*heads, "within 95 %", "as believed"):
        grid.add_column(head, justify="left" if head == "rows" else "right")
    for name, part in _parts(rows):
        grid.add_row(name, *_cells(budget(part)))
    return grid


def write_rows(rows: pl.DataFrame, path: Path) -> Path:
    """Write rows of `run_experiments` as Parquet, atomically."""
    buffer = io.BytesIO()
    rows.write_parquet(buffer, compression="zstd", statistics=False)
    return write_bytes(path, buffer.getvalue())


def _parts(rows: pl.DataFrame) -> Iterator[tuple[str, pl.DataFrame]]:
    """Named parts of the rows, those in which something has an estimate."""
    found = pl.col("status") == "ok"
    parts = [(str(key[0]), part) for key, part in rows.partition_by("experiment", as_dict=True).items()]
    parts.append(("all", rows))
    parts.append(("bound at most 1 %", rows.filter(pl.col("bound_m") <= 0.01 * pl.col("depth_m"))))
    yield from ((name, part) for name, part in parts if not part.filter(found).is_empty())


def _cells(one: Budget) -> list[str]:
    errors = [one_line(one.measured, 100.0, 3), *(f"{100.0 * x:.3f}" for x in (one.predicted, one.bound))]
    ratios = [one_line(x, 1.0, 2) for x in (one.closure, one.over_bound)]
    return [str(one.n), str(one.missing), *errors, *ratios, one_line(one.within_95, 100.0, 1), _percent(one.believed)]


def _percent(share: float) -> str:
    return f"{100.0 * share:.2f}"


def _squares(column: pl.Series) -> Array:
    return np.square(column.to_numpy())


def _first_status(rows: pl.DataFrame) -> str:
    return str(rows["status"][0]) if len(rows) else "there are none"
