"""Settings, statistics over rooms, findings and tables of the study `dense`: by stroke, rig, part of the pairs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from typing import Annotated, Literal

import numpy as np
import polars as pl
from pydantic import Field

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.intervals import Clusters, Estimate, Statistic, estimates, mean_of, quantile_of, ratio_of
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator
from phibench.studies.dense.perfect_matches import (
    CENTRAL,
    CENTRAL_90,
    IN_FOCUS,
    NEAR,
    SIGMA,
    SPHERE,
    STREAM,
    THROUGH,
    TWICE,
    Numbers,
    bands,
    rigs,
)
from phibench.studies.dense.rendered_pairs import ANSWERS, METHODS, RenderedRoom
from phibench.studies.framework import Finding, Metres, Row, Settings, ends_text
from phibench.studies.framework import Numbers as Values

AS_BUILT, CALIBRATED = "as built", "calibrated"
_Strokes = Annotated[tuple[Annotated[float, Field(ge=0.05, le=3.0)], ...], Field(min_length=2)]
Geometry = Mapping[tuple[str, float, str], Estimate]
Bounds = Mapping[tuple[float, str], Estimate]
Parts = Mapping[tuple[str, str, str], Estimate]
_BOUNDS = {
    "both images show": "twice",
    "sigma of D, median": "median",
    "sigma of D, 90 %": "p90",
    "sigma of D, median over all pixels": "over_all",
    "near space within the bound": "near",
}
_SHARES = {"twice", "near"}
ALL_PAIRS = "all pairs"


class DenseSettings(Settings):
    """Numbers of the study."""

    strokes_m: _Strokes = Field(description="strokes, rising")
    near_m: float = Field(gt=0.3, le=20.0, description="where the near space ends")
    right_m: float = Field(gt=0.0, le=1.0, description="largest error or sigma of D that is right")
    rooms: int = Field(ge=2, le=10000, description="generated rooms of the perfect matches")
    divisor: float = Field(ge=1.0, le=16.0, description="of the pixels along each side, for perfect matches")
    bands_m: Metres = Field(description="ends of the bands of D, rising")
    matching_px: float = Field(gt=0.0, le=10.0, description="error of a match along its curve, pixels")
    outline_sigma_um: tuple[float, float, float] = Field(
        description="sphere centre from the outline: across, across, along the axis"
    )
    samples: int = Field(ge=2, le=500, description="rendered pairs of `bench-dev`, in a room each")
    preset: Literal["bayer-raw", "srgb8", "mjpeg"] = Field(description="sensor of the rendered pairs")
    stroke_ends_m: Values = Field(description="ends of the parts by a pair's own stroke, rising")
    spot_depths_m: Metres = Field(description="distances of a spot, for its best stroke")
    resamples: int = Field(ge=100, le=100000, description="of the bootstrap over rooms")


@dataclass(frozen=True)
class RoomStatistics:
    """Statistics over rooms, with intervals that resample rooms."""

    rules: Rules

    def mean(self, values: Array) -> Estimate:
        """Mean of a number per room; rooms without one are left out."""
        kept = values[~np.isnan(values)]
        return self._of(mean_of(_each(kept), kept), kept)

    def median(self, values: Array) -> Estimate:
        """Median of a number per room, which may be infinite."""
        kept = values[~np.isnan(values)]
        return self._of(quantile_of(_each(kept), kept, Fraction(1, 2)), kept)

    def ratio(self, above: Array, below: Array) -> Estimate:
        """Ratio of two means."""
        return self._of(ratio_of(_each(above), above, below), above)

    def _of(self, statistic: Statistic, values: Array) -> Estimate:
        return estimates([statistic], len(values), self.rules, generator(STREAM, "resamples"))[0]


def _each(values: Array) -> Clusters:
    return Clusters(np.arange(len(values)), len(values))


def geometry_of(over: RoomStatistics, perfect: Sequence[Numbers]) -> Geometry:
    """Means over rooms of all numbers of the perfect matches."""
    return {key: over.mean(np.array([room[key] for room in perfect])) for key in perfect[0]}


def bounds_of(over: RoomStatistics, rendered: Sequence[RenderedRoom]) -> Bounds:
    """Shares as means over rooms, sigma as medians over rooms, %, by stroke."""
    found = {}
    for k, first in enumerate(rendered[0].bounds):
        for what, name in _BOUNDS.items():
            values = 100.0 * np.array([getattr(room.bounds[k], name) for room in rendered])
            found[first.stroke_m, what] = (over.mean if name in _SHARES else over.median)(values)
    return found


def parts_of(rendered: Sequence[RenderedRoom], ends_m: Sequence[float]) -> dict[str, list[RenderedRoom]]:
    """Rooms by their pair's own stroke, all of them first; empty parts are left out."""
    parts = {f"h {label}": inside for label, inside in bands(ends_m).items()} if ends_m else {}
    found = {ALL_PAIRS: list(rendered)}
    for name, (low, high) in parts.items():
        if some := [room for room in rendered if low <= room.stroke_m < high]:
            found[name] = some
    return found


def outcomes_of(over: RoomStatistics, rendered: Sequence[RenderedRoom], ends_m: Sequence[float]) -> Parts:
    """Numbers of each answer over the rooms of each part: means, and medians of the relative error."""
    words = {"answered": "answered", "median": "median error of D", "near": "near space right", "floor": "floor right"}
    found = {}
    for part, rooms in parts_of(rendered, ends_m).items():
        for name in ANSWERS:
            for key, what in words.items():
                values = 100.0 * _values(rooms, name, key)
                found[name, part, what] = (over.median if key == "median" else over.mean)(values)
    return found


def _values(rooms: Sequence[RenderedRoom], name: str, key: str) -> Array:
    return np.array([getattr(room.outcomes[name], key) for room in rooms])


def geometry_findings(geometry: Geometry) -> Iterator[Finding]:
    """Findings of the perfect matches by rig and stroke; by bands of D the cost of the sphere's model alone."""
    for (rig, h, what), estimate in geometry.items():
        if ", " not in what or what == CENTRAL_90 or (rig == SPHERE and what.startswith(CENTRAL)):
            yield Finding.ranged(f"{rig}, h = {h:g} m: {what}", estimate.ends, "%")


def mirror_findings(over: RoomStatistics, perfect: Sequence[Numbers], settings: DenseSettings) -> Iterator[Finding]:
    """Sigma of D of the sphere over that of the hyperboloid in its focus, at the same error of a match."""
    for h in settings.strokes_m:
        for band in bands(settings.bands_m):
            sphere, other = (
                np.array([room[name, h, f"{SIGMA}, {band}"] for room in perfect]) for name in (SPHERE, IN_FOCUS)
            )
            kept = np.isfinite(sphere) & np.isfinite(other)
            label = f"sigma of D, sphere over {IN_FOCUS}, h = {h:g} m, {band}"
            yield Finding.ranged(label, over.ratio(sphere[kept], other[kept]).ends).judged(">=", 1.0)


def best_findings(rendered: Sequence[RenderedRoom], strokes_m: Sequence[float]) -> Iterator[Finding]:
    """Rooms in which each stroke is best, by the median sigma over all pixels, and by the near space."""
    over_all = np.array([[bound.over_all for bound in room.bounds] for room in rendered])
    near = np.array([[bound.near for bound in room.bounds] for room in rendered])
    for what, best in (("median sigma", over_all.argmin(axis=1)), ("near space", near.argmax(axis=1))):
        for k, h in enumerate(strokes_m):
            yield Finding(f"rooms whose best stroke by {what} is {h:g} m", int(np.sum(best == k)), unit="rooms")


def gain_findings(over: RoomStatistics, rendered: Sequence[RenderedRoom]) -> Iterator[Finding]:
    """Sweep less block matching, paired by rooms."""
    sweep, published = METHODS
    for key, what in (("near", "near space"), ("floor", "floor")):
        gain = 100.0 * (_values(rendered, sweep, key) - _values(rendered, published, key))
        label = f"{what} right, {sweep} less {published}"
        yield Finding.ranged(label, over.mean(gain).ends, "%").judged(">=", 0.0)


# -- tables ------------------------------------------------------------------------------------------------------------


def outcome_frame(rendered: Sequence[RenderedRoom]) -> pl.DataFrame:
    """A row per pair and answer."""
    rows = [
        {"sample_id": room.sample_id, "room": room.room, "stroke_m": room.stroke_m, "answer": name, **asdict(each)}
        for room in rendered
        for name, each in room.outcomes.items()
    ]
    return pl.DataFrame(rows)


def bound_frame(rendered: Sequence[RenderedRoom]) -> pl.DataFrame:
    """A row per pair and stroke."""
    rows = [{"sample_id": room.sample_id, "room": room.room, **asdict(b)} for room in rendered for b in room.bounds]
    return pl.DataFrame(rows)


def perfect_frame(perfect: Sequence[Numbers]) -> pl.DataFrame:
    """A row per generated room, rig, stroke and quantity, %."""
    rows = [
        {"number": k, "rig": rig, "stroke_m": h, "quantity": what, "percent": value}
        for k, room in enumerate(perfect)
        for (rig, h, what), value in room.items()
    ]
    return pl.DataFrame(rows)


def stroke_rows(settings: DenseSettings, geometry: Geometry, bounds: Bounds) -> tuple[Row, ...]:
    """Table: bound, and what rigs cost, by stroke."""
    lines = {f"bound: {what}": [bounds[h, what] for h in settings.strokes_m] for what in _BOUNDS}
    for name, what in ((SPHERE, TWICE), (SPHERE, SIGMA), (SPHERE, NEAR), (IN_FOCUS, SIGMA), (IN_FOCUS, NEAR)):
        lines[f"{name}: {what}"] = [geometry[name, h, what] for h in settings.strokes_m]
    for name in (AS_BUILT, CALIBRATED):
        lines[f"rig {name}: error of D"] = [geometry[f"rig {name}", h, THROUGH] for h in settings.strokes_m]
    return _by_stroke("quantity", settings, lines)


def central_rows(settings: DenseSettings, geometry: Geometry) -> tuple[Row, ...]:
    """Table: cost of the central model by mirror, D and stroke."""
    lines = {}
    for name in rigs():
        lines[f"{name}, median"] = [geometry[name, h, CENTRAL] for h in settings.strokes_m]
        lines[f"{name}, 90 %"] = [geometry[name, h, CENTRAL_90] for h in settings.strokes_m]
    for band in bands(settings.bands_m):
        lines[f"{SPHERE}, D {band}"] = [geometry[SPHERE, h, f"{CENTRAL}, {band}"] for h in settings.strokes_m]
    return _by_stroke("mirror", settings, lines)


def _by_stroke(head: str, settings: DenseSettings, lines: Mapping[str, Sequence[Estimate]]) -> tuple[Row, ...]:
    heads = (head, *(f"h = {h:g} m" for h in settings.strokes_m))
    return (heads, *((name, *(_cell(each) for each in values)) for name, values in lines.items()))


def answer_rows(parts: Parts) -> tuple[Row, ...]:
    """Table: answers by the part of the pairs."""
    whats = list(dict.fromkeys(what for _, _, what in parts))
    cases = list(dict.fromkeys((name, part) for name, part, _ in parts))
    return (
        ("answer and pairs", *whats),
        *((f"{name}, {part}", *(_cell(parts[name, part, what]) for what in whats)) for name, part in cases),
    )


def _cell(estimate: Estimate) -> str:
    return "0" if abs(estimate.value) < 1e-6 else ends_text(estimate.ends)  # rounding, of the mirror without a cost
