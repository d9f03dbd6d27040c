"""Strata of a score by depth, signal, place and more, with metrics; median and range of exposure, gain, light shift.

A stratum takes images; its metrics of pairs take pairs. By signal an image counts with its own electrons, a pair with
those of its fainter spot; by azimuth a pair counts with its "down" image. Signal to noise ("sigmas"), Bayer phase and
image position belong to images alone: their strata have no metrics of pairs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import polars as pl

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.metrics import METRICS, OF_PAIRS, MetricEstimate, metric_estimates, prepared_records
from phibench.datasets.store.schema import Document
from phibench.scenes.random_streams import Name

_EDGES: dict[str, tuple[str, tuple[float, ...], str]] = {
    "depth": ("depth_m", (0.0, 1.5, 2.5, 3.5, math.inf), "m"),
    "stroke": ("stroke_m", (0.0, 0.3, 0.6, 0.9, math.inf), "m"),
    "signal": ("electrons", (0.0, 300.0, 1e3, 3e3, 1e4, 3e4, math.inf), "e-"),
    "sigmas": ("snr", (0.0, 3.0, 5.0, 10.0, 30.0, math.inf), "sigma"),
    "shift": ("shift_px", (0.0, 0.001, 0.01, 0.04, math.inf), "px"),
    "azimuth": ("azimuth_deg", tuple(float(x) for x in range(-180, 181, 45)), "deg"),
}
CLEAR_SIGMAS = 10.0
"""Signal to noise of a spot that a search of the whole image has to find."""
_VALUES = {
    **{"hint": "hint", "image": "image", "bayer": "bayer", "quality": "jpeg_quality", "preset": "preset"},
    "spot": "shown",
    "saturation": "full",
}
_OF_IMAGES = ("sigmas", "shift", "image", "bayer", "spot", "saturation")
_IMAGE_METRICS = tuple(name for name, metric in METRICS.items() if metric.family not in OF_PAIRS)
STRATA = ("all", *_EDGES, *_VALUES)


@dataclass(frozen=True)
class Stratum:
    """One part of the records.

    Attributes
    ----------
    by : one of `STRATA`
    low, high : float or None
        Edges, low <= x < high; None where the stratum is a value; high may be infinite.
    mean : float or None
        Mean of x over the images.
    images : records of images
    pairs : records from which pairs are taken; None where pairs do not belong to it
    """

    by: str
    label: str
    low: float | None
    high: float | None
    mean: float | None
    images: pl.DataFrame
    pairs: pl.DataFrame | None


def strata(records: pl.DataFrame) -> Iterator[Stratum]:
    """The whole, then all strata that hold some of the images, but not all."""
    hint = pl.when(pl.col("hinted")).then(pl.lit("boxes")).otherwise(pl.lit("no boxes"))
    clear = pl.when(pl.col("snr") >= CLEAR_SIGMAS).then(pl.lit(f"from {CLEAR_SIGMAS:g} sigma"))
    shown = (
        pl.when(~pl.col("visible")).then(pl.lit("not visible")).otherwise(clear.otherwise(pl.lit("visible, fainter")))
    )
    full = pl.when(~pl.col("visible")).then(None).when(pl.col("saturated")).then(pl.lit("saturated"))
    table = prepared_records(records).with_columns(
        azimuth_deg=pl.col("azimuth_rad").degrees(),
        hint=hint,
        shown=shown,
        full=full.otherwise(pl.lit("not saturated")),
        shift_px=light_shift(),
    )
    yield Stratum("all", "all", None, None, None, table, table)
    for by in _EDGES:
        yield from _by_edges(by, table)
    for by, column in _VALUES.items():
        for value in table[column].drop_nulls().unique().sort():
            rows = table.filter(pl.col(column) == value)
            if len(rows) == len(table):
                continue  # the whole again
            yield Stratum(by, str(value), None, None, None, rows, None if by in _OF_IMAGES else rows)


def light_shift() -> pl.Expr:
    """Distance of the light's centre from the image of the beam's axis, px; null where one is not known."""
    du, dv = (pl.col(f"{x}_true_px") - pl.col(f"{x}_axis_px") for x in "uv")
    return (du**2 + dv**2).sqrt()


def stratum_metrics(stratum: Stratum, rules: Rules, *stream: Name) -> dict[str, MetricEstimate]:
    """Metrics of a stratum, resampled from a stream of its own."""
    names = (*stream, stratum.by, stratum.label)
    if stratum.pairs is None:
        return metric_estimates(stratum.images, rules, *names, names=_IMAGE_METRICS)
    if stratum.pairs is stratum.images:
        return metric_estimates(stratum.images, rules, *names)
    pair_metrics = tuple(name for name in METRICS if name not in _IMAGE_METRICS)
    both = metric_estimates(stratum.images, rules, *names, names=_IMAGE_METRICS)
    both |= metric_estimates(stratum.pairs, rules, *names, names=pair_metrics)
    return {name: both[name] for name in METRICS}


def count_pairs(stratum: Stratum) -> int:
    """Pairs of a stratum."""
    return 0 if stratum.pairs is None else stratum.pairs["number"].n_unique()


def _by_edges(by: str, table: pl.DataFrame) -> Iterator[Stratum]:
    column, edges, unit = _EDGES[by]
    for low, high in pairwise(edges):
        images = table.filter(_within(column, low, high, edges[-1]))
        if 0 < len(images) < len(table):
            pairs = _pairs(by, table, images, low, high, edges[-1])
            mean = float(images[column].cast(pl.Float64).to_numpy().mean())
            yield Stratum(by, _label(low, high, unit), low, high, mean, images, pairs)


def _pairs(
    by: str, table: pl.DataFrame, images: pl.DataFrame, low: float, high: float, last: float
) -> pl.DataFrame | None:
    if by in _OF_IMAGES:
        return None  # a pair has no pixel or image of its own
    if by == "signal":
        return table.filter(_within("pair_electrons", low, high, last))
    if by == "azimuth":
        return images.filter(pl.col("image") == "down")
    return images


def _within(column: str, low: float, high: float, last: float) -> pl.Expr:
    """low <= x < high, and x = high in the last stratum, where the azimuth of 180 degrees belongs."""
    above = pl.col(column) >= low
    return above & ((pl.col(column) <= high) if high == last else (pl.col(column) < high))


def _label(low: float, high: float, unit: str) -> str:
    if math.isinf(high):
        return f"from {low:g} {unit}"
    return f"{low:g} to {high:g} {unit}"


class PairRange(Document):
    """Least, median and greatest of a number over the pairs."""

    low: float
    median: float
    high: float

    @classmethod
    def of(cls, values: pl.Series) -> PairRange | None:
        """Of the values that are known; None where there are none."""
        known = values.drop_nulls().cast(pl.Float64)
        if not len(known):
            return None
        return cls.model_validate({"low": known.min(), "median": known.median(), "high": known.max()})

    def text(self, factor: float = 1.0, unit: str = "") -> str:
        """Median, with the range where there is one."""
        low, median, high = (f"{factor * x:.3g}" for x in (self.low, self.median, self.high))
        end = f" {unit}" if unit else ""
        return f"{median}{end}" if low == high else f"{median}{end} ({low} to {high})"


FRAME_COLUMNS = ("exposure_s", "analogue_gain", "jpeg_quality", "laser_level", "lamp_level")
"""Columns of the records that say how frames were taken."""


def frame_numbers(records: pl.DataFrame) -> dict[str, PairRange | None]:
    """Numbers of a score's frames: each of `FRAME_COLUMNS` over its pairs."""
    pairs = records.filter(pl.col("image") == "down")
    return {name: PairRange.of(pairs[name]) for name in FRAME_COLUMNS}


def light_distances(records: pl.DataFrame) -> dict[str, PairRange | None]:
    """Distances of the light from the beam's axis: in visible images, pixels; of D, metres."""
    seen = records.filter("visible").select(shift=light_shift())["shift"]
    pairs = records.filter((pl.col("image") == "down") & pl.col("pair_visible"))
    return {"shift_px": PairRange.of(seen), "depth_m": PairRange.of((pairs["depth_m"] - pairs["axis_depth_m"]).abs())}
