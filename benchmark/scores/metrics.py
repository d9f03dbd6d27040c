"""Metrics of a score: the table of all (`METRICS`), and their values over the records of images and pairs.

`METRICS` says what each metric is, over which records (`FAMILIES`), in which unit, and which way is better. Units in
`METRICS` and in files are SI; `Metric.shown` gives the unit of tables.

An rms error of positions is that of the distance, sqrt(mean(du^2 + dv^2)): for equal errors of u and v, sqrt(2) times
the error of one coordinate. The bound is the trace of its matrix, so that an efficiency does not depend on that choice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Literal

import numpy as np
import polars as pl

from phibench.benchmark.scores.answer_errors import MATCH_PX, Rules
from phibench.benchmark.scores.intervals import (
    FEW,
    Clusters,
    Estimate,
    Statistic,
    best_constant_of,
    deviation_of,
    estimates,
    geometric_of,
    mean_of,
    quantile_of,
    rate,
    ratio_of,
    rms_of,
    rms_ratio_of,
)
from phibench.benchmark.scores.record_columns import LOCALISED, track_columns
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import Name, generator

FAR_SIGMAS = 5.0
"""Claimed standard deviations beyond which an answer is wrong: 4e-6 of normal errors in two dimensions are."""
LEAST_FOR_P95 = 50
"""Samples below which a 95th percentile has no interval."""
Better = Literal["lower", "higher", "none"]
Kind = Literal[
    "rate",
    "mean",
    "rms",
    "rms of each",
    "median",
    "p95",
    "efficiency",
    "deviation",
    "rank",
    "constant",
    "geometric",
    "ratio",
]
_DOWN, _DETECTED = pl.col("image") == "down", pl.col("detected")
_FOUND = _DOWN & pl.col("depth_found")
# where the bound is not small against what counts as found, the cut at `match_px` makes errors smaller than the bound
_SHARP = pl.col("bound_px2") < (MATCH_PX / 3.0) ** 2
_DEEP = pl.col("bound_depth_m2").sqrt() < 0.1 * pl.col("depth_m")

FAMILIES: dict[str, pl.Expr] = {
    "image": pl.lit(True),
    "visible": pl.col("visible"),
    "detected": _DETECTED & pl.col("distance_px").is_not_null(),
    "radial": _DETECTED & pl.col("radial_px").is_not_null(),
    "phi": _DETECTED & pl.col("phi_error_rad").is_not_null(),
    "phi bound": _DETECTED & pl.col("phi_error_rad").is_not_null() & pl.col("bound_phi_rad2").is_not_null() & _SHARP,
    "bound": _DETECTED & pl.col("bound_px2").is_not_null() & _SHARP,
    "raw bound": _DETECTED & pl.col("raw_bound_px2").is_not_null() & _SHARP,
    "pull": _DETECTED & pl.col("pull_u").is_not_null(),
    "any pair": _DOWN,
    "pair": _DOWN & pl.col("pair_visible"),
    "depth": _FOUND,
    "depth bound": _FOUND & pl.col("bound_depth_m2").is_not_null() & _DEEP,
    "depth pull": _FOUND & pl.col("depth_pull").is_not_null(),
    "timed": _DOWN & pl.col("seconds").is_not_null(),
    "pair bound": _DETECTED & pl.col("pair_bound_px2").is_not_null() & _SHARP,
    "pair phi bound": _DETECTED
    & pl.col("phi_error_rad").is_not_null()
    & pl.col("pair_bound_phi_rad2").is_not_null()
    & _SHARP,
    "pair depth bound": _FOUND & pl.col("pair_bound_depth_m2").is_not_null() & _DEEP,
    # of a real pair nobody has measured where the spots are
    "placed": pl.col("visible") & pl.col("counted_px").is_not_null(),
    "ranked phi": pl.col("rank_phi2_rad2").is_not_null(),
    "claimed": pl.col("visible") & pl.col("mahalanobis2").is_not_null(),
    "localised": LOCALISED,
    "localised pair": LOCALISED & pl.col("perfect_pair_log").is_not_null(),
    "empty": ~pl.col("visible"),
    "interval": _FOUND & pl.col("interval_score").is_not_null(),
}
"""Which records enter a metric; those of pairs take each pair once, by its row "down"."""

_RELATIVE = ("depth_relative", "depth_counted", "root_bound_depth", "rank_depth2", "inverse_depth", "root_pair_depth")
CHOSEN = (
    *("bound", "raw bound", "phi bound", "depth bound", "pair bound", "pair phi bound", "pair depth bound"),
    *("pull", "depth pull", "claimed", "interval"),
)
"""Families whose records a method chooses by what it answers and claims: their metrics are given with their share."""
OF_PAIRS = ("any pair", "pair", "depth", "depth bound", "depth pull", "timed", "pair depth bound", "interval")

WHY_EMPTY = {
    "detected": "no spot detected",
    "radial": "no spot detected off the centre",
    "phi": "no detected spot has a phi",
    "phi bound": "no bound for these images, or none below a third of 3 px",
    "bound": "no bound for these images, or none below a third of 3 px",
    "raw bound": "no bound for these images, or none below a third of 3 px",
    "pull": "no covariance claimed",
    "visible": "no visible spot",
    "any pair": "no pair",
    "pair": "no pair with both spots visible",
    "depth": "no depth found",
    "depth bound": "no bound for these images, or none below 10 % of D",
    "depth pull": "no uncertainty of depth claimed",
    "timed": "no pair came back",
    "image": "no image",
    "pair bound": "no bound for these pairs, or none below a third of 3 px",
    "pair phi bound": "no bound for these pairs, or none below a third of 3 px",
    "pair depth bound": "no bound for these pairs, or none below 10 % of D",
    "placed": "no visible spot whose place is known",
    "ranked phi": "no image whose phi is known",
    "claimed": "no covariance claimed",
    "localised": "no visible spot has a bound below 1 px",
    "localised pair": "no visible spot has a bound below 1 px, and one of its pair",
    "empty": "every image shows the spot",
    "interval": "no uncertainty of depth claimed",
}
"""Why a metric has no value, by family."""


@dataclass(frozen=True)
class Metric:
    """One metric.

    Parameters
    ----------
    family : key of `FAMILIES`
    kind : how the columns become a number
    columns : of the records; "mean" and "rate" take one, "median" and "p95" one by its absolute value, "rms" the root
        of the mean of the sum of squares, "rms of each" of the mean of all squares, "deviation" is about each column's
        mean, "efficiency" divides: variances, then errors; "rank" is the root of a sum of squares by a number of spots;
        "constant" is the relative rms error of the best constant, of inverse values; "geometric" is the exponential of
        the mean of a logarithm, "ratio" that of two sums
    better : "lower", "higher" or "none"
    text : what it is
    """

    family: str
    kind: Kind
    columns: tuple[str, ...]
    unit: str
    better: Better
    text: str

    @property
    def shown(self) -> tuple[float, str]:
        """Factor and unit of every table and figure: mrad for phi, % for rates and relative errors, else the unit."""
        if self.unit == "rad":
            return 1e3, "mrad"
        return (100.0, "%") if self.kind == "rate" or self.columns[0] in _RELATIVE else (1.0, self.unit)


def _errors(family: str, columns: tuple[str, ...], size: str, unit: str, stem: str, what: str) -> dict[str, Metric]:
    """Rms of columns, median and 95th percentile of their size."""
    return {
        f"rms_{stem}": Metric(family, "rms", columns, unit, "lower", f"rms {what}"),
        f"median_{stem}": Metric(family, "median", (size,), unit, "lower", f"median {what}"),
        f"p95_{stem}": Metric(family, "p95", (size,), unit, "lower", f"95th percentile, {what}"),
    }


RANKS = {"phi": "rank_phi_rad", "depth": "rank_depth"}
"""What a rank can go by, and its metric."""

# the order is that of the families' random streams: a new metric of a new family goes to the end
METRICS: dict[str, Metric] = {
    "detection_rate": Metric("visible", "rate", ("detected",), "1", "higher", "visible spots found"),
    "false_rate": Metric("image", "rate", ("false_detection",), "1", "lower", "images with a false detection"),
    "bias_u_px": Metric("detected", "mean", ("du_px",), "px", "none", "mean error of u"),
    "bias_v_px": Metric("detected", "mean", ("dv_px",), "px", "none", "mean error of v"),
    "bias_radial_px": Metric("radial", "mean", ("radial_px",), "px", "none", "mean radial error, outwards"),
    "bias_tangential_px": Metric("radial", "mean", ("tangential_px",), "px", "none", "mean tangential error"),
    "rms_counted_px": Metric("placed", "rms", ("counted_px",), "px", "lower", "rms distance, missed counted"),
    **_errors("detected", ("du_px", "dv_px"), "distance_px", "px", "px", "distance"),
    "rms_radial_px": Metric("radial", "rms", ("radial_px",), "px", "lower", "rms radial error"),
    "rms_tangential_px": Metric("radial", "rms", ("tangential_px",), "px", "lower", "rms tangential error"),
    "bound_px": Metric("bound", "rms", ("root_bound_px",), "px", "none", "rms distance at the bound"),
    "efficiency_px": Metric(
        "bound", "efficiency", ("bound_px2", "du_px", "dv_px"), "1", "higher", "rms at the bound / rms distance"
    ),
    "efficiency_raw_px": Metric(
        "raw bound",
        "efficiency",
        ("raw_bound_px2", "du_px", "dv_px"),
        "1",
        "higher",
        "the same, bound of the raw pixels",
    ),
    "pull_deviation": Metric("pull", "deviation", ("pull_u", "pull_v"), "1", "none", "deviation of pulls, 1 is right"),
    "pull_rms": Metric("pull", "rms of each", ("pull_u", "pull_v"), "1", "none", "rms of pulls, 1 is right"),
    "bias_phi_rad": Metric("phi", "mean", ("phi_error_rad",), "rad", "none", "mean error of phi"),
    **_errors("phi", ("phi_error_rad",), "phi_error_rad", "rad", "phi_rad", "error of phi"),
    "efficiency_phi": Metric(
        "phi bound", "efficiency", ("bound_phi_rad2", "phi_error_rad"), "1", "higher", "phi: rms at the bound / rms"
    ),
    "depth_rate": Metric("pair", "rate", ("depth_found",), "1", "higher", "visible pairs with a depth"),
    "bias_depth_m": Metric("depth", "mean", ("depth_error_m",), "m", "none", "mean error of D"),
    **_errors("depth", ("depth_error_m",), "depth_error_m", "m", "depth_m", "error of D"),
    "bias_depth_relative": Metric("depth", "mean", ("depth_relative",), "1", "none", "mean relative error of D"),
    "rms_depth_counted": Metric(
        "pair", "rms", ("depth_counted",), "1", "lower", "rms relative error of D, missed counted"
    ),
    **_errors("depth", ("depth_relative",), "depth_relative", "1", "depth_relative", "relative error of D"),
    "bound_depth_relative": Metric(
        "depth bound", "rms", ("root_bound_depth",), "1", "none", "D: relative rms at the bound"
    ),
    "efficiency_depth": Metric(
        "depth bound", "efficiency", ("bound_depth_m2", "depth_error_m"), "1", "higher", "D: rms at the bound / rms"
    ),
    "pull_depth": Metric(
        "depth pull", "deviation", ("depth_pull",), "1", "none", "deviation of error / sigma of D; 1 is right"
    ),
    "coverage_depth": Metric(
        "depth pull",
        "rate",
        ("depth_within",),
        "1",
        "none",
        "D within its 95 % interval, else 1.96 sigma; 0.95 is right",
    ),
    "seconds": Metric("timed", "mean", ("seconds",), "s", "lower", "mean time per pair"),
    "rank_phi_rad": Metric(
        "ranked phi",
        "rank",
        ("rank_phi2_rad2", "visible"),
        "rad",
        "lower",
        "rms error of phi, missed and false counted",
    ),
    "rank_depth": Metric(
        "any pair",
        "rank",
        ("rank_depth2", "pair_visible"),
        "1",
        "lower",
        "rms relative error of D, missed and false counted",
    ),
    "constant_depth": Metric(
        "pair", "constant", ("inverse_depth",), "1", "none", "rms relative error of D of the best constant answer"
    ),
    "bound_pair_px": Metric("pair bound", "rms", ("root_pair_px",), "px", "none", "rms distance at the pair's bound"),
    "efficiency_pair_px": Metric(
        "pair bound",
        "efficiency",
        ("pair_bound_px2", "du_px", "dv_px"),
        "1",
        "higher",
        "rms at the pair's bound / rms distance",
    ),
    "efficiency_pair_phi": Metric(
        "pair phi bound",
        "efficiency",
        ("pair_bound_phi_rad2", "phi_error_rad"),
        "1",
        "higher",
        "phi: rms at the pair's bound / rms",
    ),
    "bound_pair_depth_relative": Metric(
        "pair depth bound", "rms", ("root_pair_depth",), "1", "none", "D: relative rms at the pair's bound"
    ),
    "efficiency_pair_depth": Metric(
        "pair depth bound",
        "efficiency",
        ("pair_bound_depth_m2", "depth_error_m"),
        "1",
        "higher",
        "D: rms at the pair's bound / rms",
    ),
    "beyond_5_sigma": Metric("claimed", "rate", ("beyond_5",), "1", "lower", "answers beyond 5 claimed sigma"),
    "localise": Metric(
        "localised", "geometric", ("localise_log",), "1", "lower", "error / bound, geometric mean; none counts 3 px"
    ),
    "median_localise": Metric("localised", "median", ("localise_ratio",), "1", "lower", "error / bound, median"),
    "p95_localise": Metric("localised", "p95", ("localise_ratio",), "1", "lower", "error / bound, 95th percentile"),
    "perfect_localise": Metric(
        "localised", "geometric", ("perfect_image_log",), "1", "none", "error / bound of a perfect method for one image"
    ),
    "perfect_localise_pair": Metric(
        "localised pair", "geometric", ("perfect_pair_log",), "1", "none", "the same for both images as one point"
    ),
    "find": Metric("image", "ratio", ("detected", "visible_or_false"), "1", "higher", "Jaccard index of found spots"),
    "false_per_empty": Metric(
        "empty", "rate", ("false_detection",), "1", "lower", "images without the spot that have an answer"
    ),
    "average_recall": Metric("pair", "mean", ("depth_recall",), "1", "higher", "average recall of D, 0.5 to 20 %"),
    "interval_score": Metric(
        "interval", "mean", ("interval_score",), "1", "lower", "95 % interval score / 3.92 sigma of the bound"
    ),
}

PAIR_TWINS = {
    "efficiency_px": "efficiency_pair_px",
    "efficiency_phi": "efficiency_pair_phi",
    "efficiency_depth": "efficiency_pair_depth",
}
"""Efficiencies against the bound of each image, and the same against that of both images together."""


def applies(name: str, sees: str) -> bool:
    """Tell whether an efficiency is against the bound that holds for a method.

    Parameters
    ----------
    name : key of `METRICS`
    sees : "image", "pair" or ""
        Whether the method takes each image by itself, or both as one point of the room; "" if that is not known: both.
    """
    return not (sees == "pair" and name in PAIR_TWINS) and not (sees == "image" and name in PAIR_TWINS.values())


@dataclass(frozen=True)
class MetricEstimate:
    """An estimate with its numbers of records and samples.

    `share` is that of the visible spots, or pairs, which the records are; NaN of metrics that are of all of them.
    """

    estimate: Estimate
    n: int
    samples: int
    share: float = math.nan


def prepared_records(records: pl.DataFrame) -> pl.DataFrame:
    """Records with what the metrics take besides: roots of the bounds, samples as numbers, which bounds are sharp."""
    return track_columns(records).with_columns(
        root_bound_px=pl.col("bound_px2").sqrt(),
        root_bound_depth=pl.col("bound_depth_m2").sqrt() / pl.col("depth_m"),
        root_pair_px=pl.col("pair_bound_px2").sqrt(),
        root_pair_depth=pl.col("pair_bound_depth_m2").sqrt() / pl.col("depth_m"),
        inverse_depth=1.0 / pl.col("depth_m"),
        beyond_5=pl.col("mahalanobis2") > FAR_SIGMAS**2,
        sharp_pair=(_DETECTED & _SHARP).fill_null(value=False).min().over("number"),
        sharp_depth=(pl.col("depth_found") & _DEEP).fill_null(value=False),
        sample_code=pl.col("sample_id").rank("dense").cast(pl.Int64),
    )


def metric_estimates(
    records: pl.DataFrame, rules: Rules, *stream: Name, names: tuple[str, ...] | None = None
) -> dict[str, MetricEstimate]:
    """All metrics of some records, or those of `names`.

    Parameters
    ----------
    records : `prepared_records`
    *stream : names of the random stream of the resamples
    """
    wanted = {name: METRICS[name] for name in names or METRICS}
    estimates_by_name: dict[str, MetricEstimate] = {}
    groups: dict[bytes, dict[str, _Ready]] = {}
    for family in dict.fromkeys(metric.family for metric in wanted.values()):
        part = {name: metric for name, metric in wanted.items() if metric.family == family}
        chosen = records.filter(FAMILIES[family])
        clusters = Clusters.of(chosen["sample_code"].to_numpy())
        estimates_by_name |= _rates(part, chosen, clusters, rules)
        # families of the same samples are resampled together: one set of resamples for nearly everything
        groups.setdefault(clusters.key, {}).update(_statistics(part, chosen, clusters))
    for number, ready in enumerate(groups.values()):
        estimates_by_name |= _resampled(ready, rules, generator(*stream, number))
    every = {name: len(records.filter(FAMILIES[name])) for name in ("pair", "visible")}
    return {name: _with_share(metric, estimates_by_name[name], every) for name, metric in wanted.items()}


def _with_share(metric: Metric, measured: MetricEstimate, every: Mapping[str, int]) -> MetricEstimate:
    """The estimate with its share of `every`, the numbers of pairs and of visible spots."""
    if metric.family not in CHOSEN:
        return measured
    count = every["pair" if metric.family in OF_PAIRS else "visible"]
    return replace(measured, share=measured.n / count if count else math.nan)


def trusted_estimate(metric: Metric, estimate: Estimate, samples: int) -> Estimate:
    """The estimate, without its interval where that would not hold what it says.

    With two images of each of n samples the interval of a 95th percentile covers in 56 % of the cases at n = 10, 88 %
    at 25, 93 % at 50: below 50 samples the percentile hangs on the last few records, which resampling cannot vary.
    """
    if metric.kind != "p95" or samples >= LEAST_FOR_P95:
        return estimate
    return Estimate(estimate.value, math.nan, math.nan, FEW.format(LEAST_FOR_P95))


@dataclass(frozen=True)
class _Ready:
    metric: Metric
    statistic: Statistic
    n: int
    samples: int


def _rates(
    metrics: dict[str, Metric], records: pl.DataFrame, clusters: Clusters, rules: Rules
) -> dict[str, MetricEstimate]:
    """Rates, and every metric that has no records."""
    if clusters.n == 0:
        why = {name: WHY_EMPTY[metric.family] for name, metric in metrics.items()}
        return {name: MetricEstimate(Estimate(math.nan, math.nan, math.nan, note), 0, 0) for name, note in why.items()}
    rates = {name: _column(records, metric.columns[0]) for name, metric in metrics.items() if metric.kind == "rate"}
    return {name: MetricEstimate(rate(clusters, hits, rules), len(records), clusters.n) for name, hits in rates.items()}


def _statistics(metrics: dict[str, Metric], records: pl.DataFrame, clusters: Clusters) -> dict[str, _Ready]:
    """Every metric that is resampled."""
    return {
        name: _Ready(metric, statistic_of(metric, clusters, records), len(records), clusters.n)
        for name, metric in metrics.items()
        if clusters.n and metric.kind != "rate"
    }


def _resampled(ready: dict[str, _Ready], rules: Rules, rng: np.random.Generator) -> dict[str, MetricEstimate]:
    if not ready:
        return {}
    samples = next(iter(ready.values())).samples
    numbers = estimates([item.statistic for item in ready.values()], samples, rules, rng)
    return {
        name: MetricEstimate(trusted_estimate(item.metric, number, item.samples), item.n, item.samples)
        for (name, item), number in zip(ready.items(), numbers, strict=True)
    }


def statistic_of(metric: Metric, clusters: Clusters, records: pl.DataFrame) -> Statistic:
    """A metric as a function of the samples' weights."""
    return STATISTICS[metric.kind](clusters, [_column(records, column) for column in metric.columns])


def _square(columns: list[Array]) -> Array:
    return np.sum(np.square(columns), axis=0)


# Shares of quantiles are fractions, because the rank share x n must be exact where it is a whole number.
STATISTICS: dict[str, Callable[[Clusters, list[Array]], Statistic]] = {
    "rate": lambda clusters, x: mean_of(clusters, x[0]),
    "mean": lambda clusters, x: mean_of(clusters, x[0]),
    "rms": lambda clusters, x: rms_of(clusters, _square(x)),
    "rms of each": lambda clusters, x: rms_of(clusters, _square(x) / len(x)),
    "median": lambda clusters, x: quantile_of(clusters, np.abs(x[0]), Fraction(1, 2)),
    "p95": lambda clusters, x: quantile_of(clusters, np.abs(x[0]), Fraction(19, 20)),
    "efficiency": lambda clusters, x: rms_ratio_of(clusters, x[0], _square(x[1:])),
    "deviation": lambda clusters, x: deviation_of(clusters, *x),
    "rank": lambda clusters, x: rms_ratio_of(clusters, x[0], x[1]),
    "constant": lambda clusters, x: best_constant_of(clusters, x[0]),
    "geometric": lambda clusters, x: geometric_of(clusters, x[0]),
    "ratio": lambda clusters, x: ratio_of(clusters, x[0], x[1]),
}


def _column(records: pl.DataFrame, name: str) -> Array:
    return records[name].cast(pl.Float64).to_numpy()
