"""Numbers of the study `noise`: rows per base case, preset, factor, level and method, elasticities, findings.

The bound is that of one image. The reference method fits each image by itself with the model of its noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.intervals import Estimate, Statistic, estimates
from phibench.benchmark.scores.metrics import metric_estimates, prepared_records
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator
from phibench.studies.framework import Finding, Row, ends_text, text_table
from phibench.studies.noise.conditions import BASE, FACTORS, NAMES, rms_by_place, within_place_px

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
    low, high : levels
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
    # a place of the spot is called SAMPLE-k: intervals resample the places of a sample
    return pl.concat([records, *copies]).with_columns(sample=pl.col("sample_id").str.replace(r"-\d+$", ""))


def table_of(records: pl.DataFrame, rules: Rules) -> pl.DataFrame:
    """One row per case and method: every metric with its interval, scatter and bias of the position apart."""
    rows = [
        {**dict(zip(CASE, key, strict=True)), **_row(group, rules, key)}
        for key, group in sorted(records.group_by(*CASE), key=lambda item: tuple(map(str, item[0])))
    ]
    return pl.DataFrame(rows, infer_schema_length=None).sort(*CASE)


def elasticities(records: pl.DataFrame, rules: Rules) -> list[Elasticity]:
    """Elasticities of every method on every factor that has levels on one side of the base, or on both."""
    rows = []
    for key, group in sorted(records.group_by("sample", "preset", "factor", "method"), key=lambda item: item[0]):
        sample, preset, factor, method = (str(x) for x in key)
        if factor == BASE:
            continue  # the base case has no slope
        span = around_base(sorted(group["level"].unique()), FACTORS[factor].base)
        if span is None:
            continue  # no level on both sides of the base
        estimate, bound = _slope(group, span, rules, (sample, preset, factor))
        rows.append(Elasticity(sample, preset, factor, method, *span, estimate, bound))
    return rows


def around_base(levels: Sequence[float], base: float) -> tuple[float, float] | None:
    """Levels beside the base, or the base itself where it is the last; of a base at 0 all positive levels' ends."""
    positive = [x for x in levels if x > 0.0]
    if base <= 0.0:
        low, high = (positive[0], positive[-1]) if positive else (0.0, 0.0)
    else:
        # the base itself, despite rounding, is no neighbour
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
    measured = metric_estimates(prepared_records(records), rules, *NAMES, *map(str, key[:-1]), names=METRICS)
    scatter, bias = scatter_and_bias_px(records)
    row: dict[str, Any] = {"places": records["sample_id"].n_unique(), "images": len(records)}
    for name, metric in measured.items():
        row |= dict(zip((name, f"{name}_low", f"{name}_high"), metric.estimate.ends, strict=True))
    return {**row, "scatter_px": scatter, "bias_px": bias, "saturated": records["saturated"].mean()}


def _slope(
    records: pl.DataFrame, span: tuple[float, float], rules: Rules, key: tuple[str, ...]
) -> tuple[Estimate, float]:
    # a level as a file printed it
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


REFERENCE = {"bayer-raw": "raw_maximum_likelihood", "srgb8": "chain_fit", "mjpeg": "chain_fit"}
"""Reference method by preset."""
FLOOR = 2.0
"""A method has a floor where its error is surely above so many times the bound with the strongest signal."""
FEW = 0.9
"""Detection rate below which a local bound says little."""
BELOW = 0.9
"""Errors that are surely below so many times the bound speak against the bound."""
ABOVE = 1.25
"""The reference method leaves the bound where it is surely so many times above it."""


def base_findings(table: pl.DataFrame, sample: str, preset: str) -> Iterator[Finding]:
    """Error of the reference method in the base case beside the bound."""
    lead, method = f"{preset}, {sample}", REFERENCE[preset]
    row = _one(table, sample, preset, BASE, method)
    if row is None or not _is_number(row["rms_px"]):
        yield Finding(f"{lead}: {method}, rms distance", None, unit="mpx")
        return
    yield Finding(f"{lead}: {method}, rms distance", *_ends(row, "rms_px", 1e3), "mpx")
    yield Finding(f"{lead}: {method}, scatter", 1e3 * row["scatter_px"], unit="mpx")
    yield Finding(f"{lead}: {method}, bias", 1e3 * row["bias_px"], unit="mpx")
    yield Finding(f"{lead}: bound of the distance", 1e3 * row["bound_px"], unit="mpx")
    yield Finding(f"{lead}: {method}, rms / bound", *ratio_of(row))
    yield Finding(f"{lead}: {method}, error of phi, rms", *_ends(row, "rms_phi_rad", 1e3), "mrad")
    yield Finding(f"{lead}: {method}, error of D, rms", *_ends(row, "rms_depth_relative", 100.0), "%")
    bound = row["bound_depth_relative"]
    yield Finding(f"{lead}: bound of D", 100.0 * bound if _is_number(bound) else None, unit="%")


def floor_findings(table: pl.DataFrame, sample: str, preset: str) -> Iterator[Finding]:
    """Every method with the strongest laser that fills no pixel: a floor is an error that light does not lower.

    Nothing is found where the power was not changed, or pixels are full at every power.
    """
    strong = table.filter(_case(sample, preset), pl.col("factor") == "power_mw", pl.col("saturated") == 0.0)
    top = strong.filter(pl.col("level") == pl.col("level").max())
    for row in top.sort("rms_px").iter_rows(named=True):
        # a method without a detection, or a spot without a bound, has no ratio
        if math.isfinite(ratio_of(row)[0]):
            lead = f"{preset}, {sample}, {row['level']:g} mW: {row['method']}"
            yield Finding(f"{lead}, rms distance", *_ends(row, "rms_px", 1e3), "mpx")
            yield Finding(f"{lead}, rms / bound", *ratio_of(row)).judged("<=", FLOOR)


def limit_findings(table: pl.DataFrame, sample: str, preset: str) -> Iterator[Finding]:
    """Levels at which the bound says little: pixels are full, spots are missed, errors surely lie below it."""
    rows, lead = _levels(table, sample, preset), f"{preset}, {sample}: {REFERENCE[preset]}"
    held = 0
    for row in rows:
        where, ratio = _where(row), Finding("", *ratio_of(row))
        if row["saturated"] > 0.0:
            yield replace(ratio, label=f"{lead}, rms / bound with full pixels, {where}")
        if row["detection_rate"] < FEW:
            share = Finding(f"{lead}, spots found, {where}", 100.0 * row["detection_rate"], unit="%")
            yield share.judged(">=", 100.0 * FEW)
        elif row["saturated"] == 0.0:
            low = replace(ratio, label=f"{lead}, rms / bound, {where}").judged(">=", BELOW)
            high = replace(ratio, label=f"{lead}, rms / bound, {where}").judged("<=", ABOVE)
            if "missed" in (low.verdict, high.verdict):
                yield low if low.verdict == "missed" else high
            else:
                held += 1
            if high.verdict == "missed":
                yield Finding(f"{lead}, scatter, {where}", 1e3 * row["scatter_px"], unit="mpx")
                yield Finding(f"{lead}, bias, {where}", 1e3 * row["bias_px"], unit="mpx")
    yield Finding(f"{lead}, levels not surely off the bound", held, unit=f"of {len(rows)}")


def ranking_findings(found: Sequence[Elasticity], sample: str, preset: str) -> Iterator[Finding]:
    """Elasticities of the reference method about the base, largest first, and the lead of the first factor."""
    lead, mine = f"{preset}, {sample}", ranked_elasticities(found, sample, preset, REFERENCE[preset])
    for e in mine:
        yield Finding(f"{lead}: d ln rms / d ln {name_of(e)}", *e.estimate.ends).judged("!=", 0.0)
    if len(mine) > 1:
        first, second = mine[:2]
        label = f"{lead}: size of the slope for {name_of(first)} less that for {name_of(second)}"
        ahead = Finding(label, abs(first.estimate.value) - abs(second.estimate.value), relation=">=", threshold=0.0)
        yield replace(ahead, verdict="met" if _apart(first, second) else "undecided")


def ranked_elasticities(found: Sequence[Elasticity], sample: str, preset: str, method: str) -> list[Elasticity]:
    """Elasticities of one method, largest size first, without those that have no value or an optimum at the base."""
    mine = [e for e in found if (e.sample, e.preset, e.method) == (sample, preset, method) and FACTORS[e.factor].ranked]
    return sorted((e for e in mine if math.isfinite(e.estimate.value)), key=lambda e: -abs(e.estimate.value))


def name_of(e: Elasticity) -> str:
    """Name of a factor without its unit."""
    return FACTORS[e.factor].label.split(",")[0]


def base_table(table: pl.DataFrame, sample: str, preset: str) -> tuple[Row, ...]:
    """Small table of the base case, best method first."""
    return text_table(
        table.filter(_case(sample, preset), pl.col("factor") == BASE).sort("rms_px").to_dicts(),
        {
            "method": lambda row: row["method"],
            "found": lambda row: f"{100 * row['detection_rate']:.0f} %",
            "rms, mpx": lambda row: ends_text(_ends(row, "rms_px", 1e3)),
            "scatter": lambda row: ends_text((1e3 * row["scatter_px"],)),
            "bias": lambda row: ends_text((1e3 * row["bias_px"],)),
            "rms / bound": lambda row: ends_text(ratio_of(row)),
            "phi, mrad": lambda row: ends_text(_ends(row, "rms_phi_rad", 1e3)),
            "D, %": lambda row: ends_text(_ends(row, "rms_depth_relative", 100.0)),
            "bias of D, %": lambda row: ends_text(_ends(row, "bias_depth_relative", 100.0)),
        },
    )


def ranking_table(found: Sequence[Elasticity], sample: str, preset: str) -> tuple[Row, ...]:
    """Elasticities of the reference method beside those of the bound."""
    return text_table(
        ranked_elasticities(found, sample, preset, REFERENCE[preset]),
        {
            "factor": name_of,
            "from": lambda e: f"{e.low:.3g}",
            "to": lambda e: f"{e.high:.3g}",
            "d ln rms / d ln factor": _signed,
            "of the bound": lambda e: f"{e.bound:+.2f}",
        },
    )


def ratio_of(row: dict[str, Any]) -> tuple[float, float, float]:
    """Rms over bound with its interval: the reciprocal of the efficiency."""
    value, low, high = (row[f"efficiency_px{end}"] for end in ("", "_low", "_high"))
    return _reciprocal(value), _reciprocal(high), _reciprocal(low)


def _ends(row: dict[str, Any], name: str, scale: float) -> tuple[float, float, float]:
    """Value and ends of the interval, scaled; NaN where there is none."""
    value, low, high = (row[f"{name}{end}"] for end in ("", "_low", "_high"))
    return tuple(scale * x if _is_number(x) else math.nan for x in (value, low, high))  # type: ignore[return-value]


def _where(row: dict[str, Any]) -> str:
    return "the base case" if row["factor"] == BASE else f"{FACTORS[row['factor']].label} {row['level']:.3g}"


def _levels(table: pl.DataFrame, sample: str, preset: str) -> list[dict[str, Any]]:
    """Rows of the reference method: the base case once, and every level that is not the base's."""
    rows = table.filter(_case(sample, preset), pl.col("method") == REFERENCE[preset]).iter_rows(named=True)
    # the base's level, despite rounding
    return [r for r in rows if r["factor"] == BASE or abs(r["level"] - FACTORS[r["factor"]].base) > 1e-9]


def _one(table: pl.DataFrame, sample: str, preset: str, factor: str, method: str) -> dict[str, Any] | None:
    rows = table.filter(_case(sample, preset), pl.col("factor") == factor, pl.col("method") == method)
    return None if rows.is_empty() else rows.row(0, named=True)


def _case(sample: str, preset: str) -> pl.Expr:
    return (pl.col("sample") == sample) & (pl.col("preset") == preset)


def _sure(e: Elasticity) -> bool:
    low, high = e.estimate.low, e.estimate.high
    return bool(low > 0.0 or high < 0.0)  # False without an interval


def _apart(first: Elasticity, second: Elasticity) -> bool:
    """Decide if the interval of the first's size lies above that of the second's."""
    ends = [sorted((abs(e.estimate.low), abs(e.estimate.high))) for e in (first, second)]
    return _sure(first) and all(map(math.isfinite, (*ends[0], *ends[1]))) and ends[0][0] > ends[1][1]


def _signed(e: Elasticity) -> str:
    return ends_text(e.estimate.ends, "+.2f") + ("" if math.isfinite(e.estimate.low) else " (no interval)")


def _is_number(value: Any) -> bool:
    return value is not None and math.isfinite(value)


def _reciprocal(value: Any) -> float:
    return 1.0 / value if _is_number(value) and value > 0.0 else math.nan
