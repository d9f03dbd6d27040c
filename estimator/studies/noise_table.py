"""Numbers of the study `noise`: a row per base case, preset, factor, level and method, and elasticities."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from phibench.estimator.bench.bootstrap import Estimate, Statistic, estimates
from phibench.estimator.bench.metrics import Measured, measure, prepared
from phibench.estimator.bench.rules import Rules
from phibench.estimator.studies.noise_cells import NAMES, rms_by_place, within_place_px
from phibench.estimator.studies.noise_factors import BASE, FACTORS
from phibench.scenes.frames import Array
from phibench.scenes.streams import generator

METRICS = (
    "detection_rate",
    "rms_px",
    "bound_px",
    "efficiency_px",
    "bias_radial_px",
    "rms_phi_rad",
    "bias_phi_rad",
    "rms_depth_relative",
    "bias_depth_relative",
    "bound_depth_relative",
    "efficiency_depth",
)
CASE = ("sample", "preset", "factor", "level", "method")


@dataclass(frozen=True)
class Elasticity:
    """d ln rms / d ln factor of one method, between the levels beside the base.

    Attributes
    ----------
    sample, preset, factor, method : str
    low, high : levels
    estimate : Estimate
    bound : the same of the bound, which has no noise
    """

    sample: str
    preset: str
    factor: str
    method: str
    low: float
    high: float
    estimate: Estimate
    bound: float


def with_levels(records: pl.DataFrame, levels: Mapping[str, Sequence[float]]) -> pl.DataFrame:
    """Records in which the base case also stands among the levels of every factor that acts on its preset."""
    base = records.filter(pl.col("factor") == BASE)
    copies = []
    for name in levels:
        of = base.filter(pl.col("preset").is_in(FACTORS[name].presets))
        copies.append(of.with_columns(factor=pl.lit(name), level=pl.lit(float(FACTORS[name].base))))
    return pl.concat([records, *copies]).with_columns(sample=pl.col("sample_id").str.replace(r"-\d+$", ""))


def table_of(records: pl.DataFrame, rules: Rules) -> pl.DataFrame:
    """One row per case and method: every metric with its interval, scatter and bias of the position apart."""
    rows = [
        {**dict(zip(CASE, key, strict=True)), **_row(part, rules, key)}
        for key, part in sorted(records.group_by(*CASE), key=lambda item: tuple(map(str, item[0])))
    ]
    return pl.DataFrame(rows, infer_schema_length=None).sort(*CASE)


def elasticities(records: pl.DataFrame, rules: Rules) -> list[Elasticity]:
    """Elasticities of every method on every factor that has levels on one side of the base, or on both."""
    found = []
    for key, part in sorted(records.group_by("sample", "preset", "factor", "method"), key=lambda item: item[0]):
        sample, preset, factor, method = (str(x) for x in key)
        if factor == BASE:
            continue
        span = around_base(sorted(part["level"].unique()), FACTORS[factor].base)
        if span is None:
            continue
        estimate, bound = _slope(part, span, rules, (sample, preset, factor))
        found.append(Elasticity(sample, preset, factor, method, *span, estimate, bound))
    return found


def around_base(levels: Sequence[float], base: float) -> tuple[float, float] | None:
    """Levels beside the base, or the base itself where it is the last; of a base at 0 all positive levels' ends."""
    positive = [x for x in levels if x > 0.0]
    if base <= 0.0:
        low, high = (positive[0], positive[-1]) if positive else (0.0, 0.0)
    else:
        low = max((x for x in positive if x < base * (1.0 - 1e-9)), default=base)
        high = min((x for x in positive if x > base * (1.0 + 1e-9)), default=base)
    return (low, high) if high > low else None


def scatter_and_bias_px(records: pl.DataFrame) -> tuple[float, float]:
    """Scatter between the draws of a place, and what stays: sqrt(rms^2 - scatter^2), rms distances."""
    square, count = rms_by_place(records)
    scatter = within_place_px(records)
    if not count.sum() > 0.0:
        return math.nan, math.nan
    return scatter, math.sqrt(max(float(square.sum() / count.sum()) - scatter**2, 0.0))


def _row(records: pl.DataFrame, rules: Rules, key: tuple[Any, ...]) -> dict[str, Any]:
    # one stream for all methods of a case: they are resampled alike
    measured = measure(prepared(records), rules, *NAMES, *map(str, key[:-1]), names=METRICS)
    scatter, bias = scatter_and_bias_px(records)
    row: dict[str, Any] = {"places": records["sample_id"].n_unique(), "images": len(records)}
    for name, value in measured.items():
        row |= _columns(name, value)
    return {**row, "scatter_px": scatter, "bias_px": bias, "saturated": records["saturated"].mean()}


def _columns(name: str, measured: Measured) -> dict[str, float]:
    value = measured.estimate
    return {name: value.value, f"{name}_low": value.low, f"{name}_high": value.high}


def _slope(
    records: pl.DataFrame, span: tuple[float, float], rules: Rules, key: tuple[str, ...]
) -> tuple[Estimate, float]:
    ends = [records.filter((pl.col("level") - level).abs() <= 1e-9 * level) for level in span]
    sums = [rms_by_place(end) for end in ends]
    width = math.log(span[1] / span[0])
    if any(len(count) == 0 or count.sum() == 0.0 for _, count in sums):
        return Estimate(math.nan, math.nan, math.nan, "no spot detected"), math.nan
    (estimate,) = estimates([_slope_of(sums, width)], len(sums[0][0]), rules, generator(*NAMES, "slope", *key))
    bounds = [float(end.filter("visible")["bound_px2"].mean() or math.nan) for end in ends]  # type: ignore[arg-type]
    return estimate, 0.5 * math.log(bounds[1] / bounds[0]) / width


def _slope_of(sums: list[tuple[Array, Array]], width: float) -> Statistic:
    """Slope of ln rms between two levels as a function of the places' weights: both levels share their places."""

    def slope(weights: Array) -> Array:
        with np.errstate(divide="ignore", invalid="ignore"):
            low, high = (np.log((weights @ square) / (weights @ count)) for square, count in sums)
        return np.asarray(0.5 * (high - low) / width)

    return slope
