"""What the numbers of the study `noise` say, in sentences and small tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import polars as pl

from phibench.estimator.studies.noise_factors import BASE, FACTORS
from phibench.estimator.studies.noise_table import Elasticity
from phibench.estimator.studies.result import Row

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
