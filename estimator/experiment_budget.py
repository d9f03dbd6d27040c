"""Error budget of experiments: predicted against measured errors of D, and both against the bound."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from phibench.datasets.errors import DatasetError
from phibench.estimator.bench.bootstrap import Clusters, Estimate, estimates, rms_of, rms_ratio_of
from phibench.estimator.bench.rates import rate
from phibench.estimator.bench.rules import Rules
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


def _squares(column: pl.Series) -> Array:
    return np.square(column.to_numpy())


def _first_status(rows: pl.DataFrame) -> str:
    return str(rows["status"][0]) if len(rows) else "there are none"
