"""Metrics of a dense score (`DENSE_METRICS`): what each is, and its value over records, with an interval over samples.

A metric is a mean over pairs of what a pair's pixels give, so that every pair counts alike; of mean squares the root is
taken last. Intervals resample samples, as those of spots do (`scores.intervals`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import polars as pl

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.intervals import Clusters, Statistic, estimates, mean_of, rms_of
from phibench.benchmark.scores.metrics import MetricEstimate
from phibench.scenes.random_streams import Name, generator


@dataclass(frozen=True)
class DenseMetric:
    """One number of a dense score.

    Attributes
    ----------
    column : str
        Of the records.
    better : "lower", "higher" or "none"
    root : bool
        Of the mean of squares.
    """

    column: str
    unit: str
    better: Literal["lower", "higher", "none"]
    text: str
    root: bool = False


def _share(column: str, better: Literal["lower", "higher", "none"], text: str) -> DenseMetric:
    return DenseMetric(column, "1", better, text)


DENSE_METRICS: dict[str, DenseMetric] = {
    "recall": _share("recall", "higher", "pixels within 0.5, 1, 2, 5, 10 and 20 % of D, averaged over these"),
    "answered": _share("answered", "none", "pixels that are answered"),
    "hidden_answered": _share("hidden_answered", "none", "pixels hidden from the up image that are answered"),
    "median_relative": _share("median", "lower", "median |error of D| / D over a pair's answers"),
    "mean_relative": _share("mean", "lower", "mean |error of D| / D; MARE of Helvipad"),
    "rms_relative": DenseMetric("square", "1", "lower", "root of the mean squared error of D / D", root=True),
    "p90_relative": _share("p90", "lower", "90 % of a pair's answers are below"),
    "bias_relative": _share("bias", "none", "median error of D / D, with its sign"),
    "above_2": _share("above_2", "lower", "answers off by more than 2 %"),
    "above_5": _share("above_5", "lower", "answers off by more than 5 %"),
    "above_10": _share("above_10", "lower", "answers off by more than 10 %"),
    "mae_m": DenseMetric("mae_m", "m", "lower", "mean |error of D|; MAE of Helvipad"),
    "rmse_m": DenseMetric(
        "square_m2", "m", "lower", "root of the mean squared error of D; RMSE of Helvipad", root=True
    ),
    "disparity_mae_deg": DenseMetric("disparity_mae_deg", "deg", "lower", "mean |error of the disparity angle|"),
    "disparity_rmse_deg": DenseMetric(
        "disparity_square_deg2", "deg", "lower", "root of the mean squared error of the disparity angle", root=True
    ),
    "disparity_mare": _share("disparity_mare", "lower", "mean |error of the disparity angle| over the angle"),
    "seam_m": DenseMetric("seam_m", "m", "lower", "left-right consistency error of D; LRCE of Helvipad"),
    "ause": _share("ause", "lower", "area between sparsification by the claimed sigma and by the error"),
    "coverage": _share("coverage", "none", "answers within 1.96 claimed sigma; 0.95 is right"),
    "matching": _share("matching", "lower", "median |answer - perfect match through the given rig| / D"),
    "matching_central": _share("matching_central", "none", "the same, and perfect matches by the central model"),
    "central": _share("central", "none", "median |central model - given rig| / D of perfect matches"),
    "central_p90": _share("central_p90", "none", "90 % of these differences are below"),
    "calibration": _share("calibration", "none", "median |given rig - truth| / D of perfect matches"),
    "seconds": DenseMetric("seconds", "s", "none", "inside the method, a pair"),
}
"""Metrics of a dense score by name."""


def measure_dense(rows: pl.DataFrame, rules: Rules, *stream: Name) -> dict[str, MetricEstimate]:
    """Metrics of rows of pairs, each over those that have a value, with intervals over samples."""
    found: dict[str, MetricEstimate] = {}
    groups: dict[bytes, tuple[Clusters, list[str], list[Statistic], int]] = {}
    for name, metric in DENSE_METRICS.items():
        known = rows[metric.column].is_not_null().to_numpy()
        part = rows.filter(pl.Series(known))
        if known.tobytes() not in groups:
            groups[known.tobytes()] = (Clusters.of(part["sample_id"].to_list()), [], [], len(part))
        clusters, names, statistics, _ = groups[known.tobytes()]
        names.append(name)
        statistics.append(statistic_of_dense(metric, clusters, part))
    for clusters, names, statistics, count in groups.values():
        # one set of resamples for all metrics of the same pairs
        drawn = estimates(statistics, clusters.n, rules, generator(*stream))
        found |= {n: MetricEstimate(e, count, clusters.n) for n, e in zip(names, drawn, strict=True)}
    return {name: found[name] for name in DENSE_METRICS}


def statistic_of_dense(metric: DenseMetric, clusters: Clusters, rows: pl.DataFrame) -> Statistic:
    """Statistic of a metric over rows without nulls."""
    values = rows[metric.column].to_numpy().astype(float)
    return rms_of(clusters, values) if metric.root else mean_of(clusters, values)
