"""Numbers of the study `noise`: a row per base case, preset, factor, level and method, and elasticities.

What the numbers of the study `noise` say, in sentences and small tables.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from phibench.estimator.benchmark.answer_errors import Rules
from phibench.estimator.benchmark.intervals import Estimate, Statistic, estimates
from phibench.estimator.benchmark.metrics import Measured, measure, prepared
from phibench.estimator.studies.framework import Row
from phibench.estimator.studies.noise.cells import BASE, FACTORS, NAMES, rms_by_place, within_place_px
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator

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


REFERENCE = {"bayer-raw": "raw_maximum_likelihood", "srgb8": "chain_fit", "mjpeg": "chain_fit"}
"""The method that fits each image by itself with the model of its noise: what the bound of one image is for."""
FLOOR = 2.0
"""A method has a floor where its error is surely above so many times the bound with the strongest signal."""
FEW = 0.9
"""Detection rate below which a local bound says little."""
BELOW = 0.9
"""Errors that are surely below so many times the bound speak against the bound."""
ABOVE = 1.25
"""The reference method leaves the bound where it is surely so many times above it."""


def base_sentence(table: pl.DataFrame, sample: str, preset: str) -> str:
    """Error of the reference method in the base case beside the bound."""
    row = _one(table, sample, preset, BASE, REFERENCE[preset])
    if row is None or not _is_number(row["rms_px"]):
        return f"{preset}, {sample}: {REFERENCE[preset]} finds no spot in the base case."
    return (
        f"{preset}, {sample}: {REFERENCE[preset]} places the spot to {_with(row, 'rms_px', 1e3, 'mpx rms')}, the bound "
        f"being {1e3 * row['bound_px']:.3g} mpx (rms / bound {_ratio(row)}); phi to "
        f"{_with(row, 'rms_phi_rad', 1e3, 'mrad')}, D to {_with(row, 'rms_depth_relative', 100.0, '%')} "
        f"(bound {_percent(row['bound_depth_relative'])})."
    )


def floor_sentence(table: pl.DataFrame, sample: str, preset: str) -> str:
    """Which methods leave the bound with the strongest signal."""
    strong = table.filter(_case(sample, preset), pl.col("factor") == "power_mw")
    if strong.is_empty():
        return f"{preset}, {sample}: the laser's power was not changed, so that nothing is said of floors."
    strong = strong.filter(pl.col("saturated") == 0.0)
    if strong.is_empty():
        return f"{preset}, {sample}: pixels are full at every power tried, so that nothing is said of floors."
    top = strong.filter(pl.col("level") == strong["level"].max())
    left, kept, unsure = [], [], []
    for row in top.sort("rms_px").iter_rows(named=True):
        ratio, low, high = ratio_of(row)
        text = f"{row['method']} {_count(ratio)}"
        if not math.isfinite(ratio):
            continue
        if math.isfinite(low) and low > FLOOR:
            left.append(f"{row['method']} {1e3 * row['rms_px']:.3g} mpx")
        elif math.isfinite(high) and high < FLOOR:
            kept.append(text)
        else:
            unsure.append(text)
    power = f"{top['level'][0]:g} mW (the strongest without full pixels)"
    parts = []
    if left:
        parts.append(f"a floor above {FLOOR:g} times the bound have {', '.join(left)}")
    if kept:
        parts.append(f"within {FLOOR:g} times the bound stay {', '.join(kept)}")
    if unsure:
        parts.append(f"undecided with these draws are {', '.join(unsure)} (rms / bound)")
    return f"{preset}, {sample}, {power}: " + ("; ".join(parts) if parts else "no method finds the spot") + "."


def useless_sentence(table: pl.DataFrame, sample: str, preset: str) -> str:
    """Where the bound stops to say anything: pixels are full, spots are missed, or errors surely fall below it."""
    rows = _levels(table, sample, preset)
    full = [r for r in rows if r["saturated"] > 0.0]
    missed = [r for r in rows if r["detection_rate"] < FEW]
    below = [r for r in rows if r not in missed and r not in full and ratio_of(r)[2] < BELOW]
    text = []
    if full:
        text.append("pixels are full, which the bound leaves out, at " + ", ".join(map(_with_ratio, full)))
    if missed:
        text.append("spots are missed, so that the local bound means little, at " + ", ".join(map(_missed, missed)))
    if below:
        text.append(
            f"errors are by their intervals below {BELOW:g} times the bound, which is then no bound of the frames, at "
            + ", ".join(map(_with_ratio, below))
            + " (levels share their draws and go together)"
        )
    if not text:
        return (
            f"{preset}, {sample}: at every level {REFERENCE[preset]} finds {100 * FEW:g} % of the spots or more in "
            f"their boxes and is nowhere by its interval below {BELOW:g} times the bound, which therefore holds over "
            "all ranges tried."
        )
    return f"{preset}, {sample}: " + "; ".join(text) + "."


def leaving_sentence(table: pl.DataFrame, sample: str, preset: str) -> str:
    """Where the reference method itself leaves the bound while the spot is seen and no pixel is full."""
    rows = [r for r in _levels(table, sample, preset) if r["saturated"] == 0.0 and r["detection_rate"] >= FEW]
    lead = f"{preset}, {sample}: {REFERENCE[preset]}"
    left = [r for r in rows if ratio_of(r)[1] > ABOVE]
    if not left:
        return f"{lead} is at no level by its interval above {ABOVE:g} times the bound."
    listed = ", ".join(
        f"{_with_ratio(r)}, scatter {1e3 * r['scatter_px']:.3g} and bias {1e3 * r['bias_px']:.3g} mpx" for r in left
    )
    return f"{lead} leaves the bound (by its interval above {ABOVE:g} times) at {listed}."


def ranking_sentence(found: Sequence[Elasticity], sample: str, preset: str) -> str:
    """Which factor matters most about the base: elasticities of the reference method, largest first."""
    mine = ranked(found, sample, preset, REFERENCE[preset])
    if not mine:
        return f"{preset}, {sample}: no factor has two levels at which {REFERENCE[preset]} finds the spot."
    listed = ", ".join(f"{name_of(e)} {_signed(e)}" for e in mine)
    first = mine[0]
    sure = [e for e in mine if _sure(e)]
    tail = f" Only {len(sure)} of {len(mine)} are surely not 0." if len(sure) < len(mine) else ""
    second = mine[1] if len(mine) > 1 else None
    lead = f"{name_of(first)} matters most" + (
        "" if second is None or _apart(first, second) else f", though not surely more than {name_of(second)}"
    )
    return f"{preset}, {sample}: {lead}; d ln rms / d ln factor about the base: {listed}.{tail}"


def ranked(found: Sequence[Elasticity], sample: str, preset: str, method: str) -> list[Elasticity]:
    """Elasticities of one method, largest size first, without those that have no value or an optimum at the base."""
    mine = [e for e in found if (e.sample, e.preset, e.method) == (sample, preset, method) and FACTORS[e.factor].ranked]
    return sorted((e for e in mine if math.isfinite(e.estimate.value)), key=lambda e: -abs(e.estimate.value))


def name_of(e: Elasticity) -> str:
    """Name of a factor without its unit."""
    return FACTORS[e.factor].label.split(",")[0]


def base_table(table: pl.DataFrame, sample: str, preset: str) -> tuple[Row, ...]:
    """Small table of the base case, best method first."""
    head = ("method", "found", "rms, mpx", "scatter", "bias", "rms / bound", "phi, mrad", "D, %", "bias of D, %")
    rows = table.filter(_case(sample, preset), pl.col("factor") == BASE).sort("rms_px")
    return (head, *(_base_row(row) for row in rows.iter_rows(named=True)))


def ranking_table(found: Sequence[Elasticity], sample: str, preset: str) -> tuple[Row, ...]:
    """Elasticities of the reference method beside those of the bound."""
    head = ("factor", "from", "to", "d ln rms / d ln factor", "of the bound")
    mine = ranked(found, sample, preset, REFERENCE[preset])
    return (head, *((name_of(e), f"{e.low:.3g}", f"{e.high:.3g}", _signed(e), f"{e.bound:+.2f}") for e in mine))


def ratio_of(row: dict[str, Any]) -> tuple[float, float, float]:
    """Rms over bound with its interval: the reciprocal of the efficiency."""
    value, low, high = (row[f"efficiency_px{end}"] for end in ("", "_low", "_high"))
    return _reciprocal(value), _reciprocal(high), _reciprocal(low)


def _base_row(row: dict[str, Any]) -> Row:
    return (
        row["method"],
        f"{100 * row['detection_rate']:.0f} %",
        _with(row, "rms_px", 1e3, ""),
        _number(1e3 * row["scatter_px"]),
        _number(1e3 * row["bias_px"]),
        _ratio(row),
        _with(row, "rms_phi_rad", 1e3, ""),
        _with(row, "rms_depth_relative", 100.0, ""),
        _with(row, "bias_depth_relative", 100.0, ""),
    )


def _missed(row: dict[str, Any]) -> str:
    return f"{_where(row)} ({100 * row['detection_rate']:.0f} % found)"


def _where(row: dict[str, Any]) -> str:
    return "the base case" if row["factor"] == BASE else f"{FACTORS[row['factor']].label} {row['level']:.3g}"


def _with_ratio(row: dict[str, Any]) -> str:
    return f"{_where(row)} (rms / bound {_ratio(row)})"


def _levels(table: pl.DataFrame, sample: str, preset: str) -> list[dict[str, Any]]:
    """Rows of the reference method: the base case once, and every level that is not the base's."""
    rows = table.filter(_case(sample, preset), pl.col("method") == REFERENCE[preset]).iter_rows(named=True)
    return [r for r in rows if r["factor"] == BASE or abs(r["level"] - FACTORS[r["factor"]].base) > 1e-9]


def _one(table: pl.DataFrame, sample: str, preset: str, factor: str, method: str) -> dict[str, Any] | None:
    found = table.filter(_case(sample, preset), pl.col("factor") == factor, pl.col("method") == method)
    return None if found.is_empty() else found.row(0, named=True)


def _case(sample: str, preset: str) -> pl.Expr:
    return (pl.col("sample") == sample) & (pl.col("preset") == preset)


def _sure(e: Elasticity) -> bool:
    low, high = e.estimate.low, e.estimate.high
    return bool(low > 0.0 or high < 0.0)  # False without an interval


def _apart(first: Elasticity, second: Elasticity) -> bool:
    """Whether the interval of the first's size lies above that of the second's."""
    ends = [sorted((abs(e.estimate.low), abs(e.estimate.high))) for e in (first, second)]
    return _sure(first) and all(map(math.isfinite, (*ends[0], *ends[1]))) and ends[0][0] > ends[1][1]


def _signed(e: Elasticity) -> str:
    value = e.estimate
    interval = f" ({value.low:+.2f} to {value.high:+.2f})" if math.isfinite(value.low) else " (no interval)"
    return f"{value.value:+.2f}{interval}"


def _with(row: dict[str, Any], name: str, scale: float, unit: str) -> str:
    """Value with its interval."""
    value, low, high = (row[f"{name}{end}"] for end in ("", "_low", "_high"))
    if not _is_number(value):
        return "-"
    text = f"{scale * value:.3g} {unit}".rstrip()
    return f"{text} ({scale * low:.3g} to {scale * high:.3g})" if _is_number(low) else text


def _ratio(row: dict[str, Any]) -> str:
    value, low, high = ratio_of(row)
    if not math.isfinite(value):
        return "-"
    return f"{_count(value)} ({_count(low)} to {_count(high)})" if math.isfinite(low) else _count(value)


def _percent(value: Any) -> str:
    return f"{100.0 * value:.3g} %" if _is_number(value) else "none"


def _count(value: float) -> str:
    return f"{value:.3g}"


def _number(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "-"


def _is_number(value: Any) -> bool:
    return value is not None and math.isfinite(value)


def _reciprocal(value: Any) -> float:
    return 1.0 / value if _is_number(value) and value > 0.0 else math.nan
