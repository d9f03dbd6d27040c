"""Tables and findings of the study `mirror`: one row per mirror, and the table from which a mirror is picked."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from phibench.estimator.studies.findings import Finding, Row, number
from phibench.estimator.studies.mirror.field import DiscShares, Meridian
from phibench.estimator.studies.mirror.measured_places import (
    DIRECTIONS,
    UNCALIBRATED,
    PlaceBound,
    together,
    unit,
    usual,
)
from phibench.scenes.frames import Array, BoolArray

ALL_KINDS = tuple(DIRECTIONS)
_NONE = "-"
_SHOWN_UNITS = {"m": ("mm", 1e3), "rad": ("deg", math.degrees(1.0)), "px": ("px", 1.0), "1": ("", 1.0)}


class Asked(Protocol):
    """Settings that the tables read."""

    @property
    def depths_m(self) -> tuple[float, ...]: ...
    @property
    def presets(self) -> tuple[str, ...]: ...
    @property
    def spot_height_m(self) -> float: ...
    @property
    def stroke_m(self) -> float: ...
    @property
    def cost(self) -> float: ...


@dataclass(frozen=True)
class PlaceMap:
    """Places that pairs measure.

    Attributes
    ----------
    depths_m : shape (d,)
    heights_m : shape (z,)
    measured : bool, shape (z, d)
    """

    depths_m: Array
    heights_m: Array
    measured: BoolArray

    @property
    def share(self) -> float:
        """Share of the map's area."""
        return float(self.measured.mean())

    def floor_from_m(self) -> float:
        """Least distance from which on every spot on the floor is measured; NaN where the last one is not."""
        row = self.measured[0]
        if not row[-1]:
            return math.nan
        last_gap = np.flatnonzero(~row)
        return float(self.depths_m[last_gap[-1] + 1 if last_gap.size else 0])

    def heights_at(self, depth_m: float) -> tuple[float, float]:
        """Lowest and highest measured height at the map's nearest distance; NaN where there is none."""
        column = self.measured[:, int(np.argmin(np.abs(self.depths_m - depth_m)))]
        if not column.any():
            return math.nan, math.nan
        seen = self.heights_m[column]
        return float(seen[0]), float(seen[-1])


@dataclass(frozen=True)
class Compared:
    """All that the study says of one mirror.

    Attributes
    ----------
    rays : Meridian
    field_deg : (least, largest) theta, up to the margin inside the outline
    rim_deg : largest theta, at the outline
    outline_px : radius of the mirror's image
    spread_m : of the viewpoints
    down, up : DiscShares
    places : PlaceMap
    bounds : by preset, height and distance
    costs : by distance and kind of deviation, relative error of D per unit
    """

    rays: Meridian
    field_deg: tuple[float, float]
    rim_deg: float
    outline_px: float
    spread_m: float
    down: DiscShares
    up: DiscShares
    places: PlaceMap
    bounds: Mapping[tuple[str, float, float], PlaceBound]
    costs: Mapping[float, Mapping[str, float]]


# -- tables ------------------------------------------------------------------------------------------------------------


def field_table(found: Mapping[str, Compared], asked: Asked) -> tuple[Row, ...]:
    """Field of view, use of the image, and viewpoints."""
    heads = (
        "mirror",
        "theta seen, deg",
        "to the outline, deg",
        "outline, px",
        "pixels on the robot, %",
        "below the horizon, %",
        "above, %",
        "robot up to theta, down, deg",
        f"at h = {asked.stroke_m:g} m, deg",
        "viewpoints, mm",
    )
    return heads, *(
        (
            name,
            f"{c.field_deg[0]:.0f} to {c.field_deg[1]:.0f}",
            f"{c.rim_deg:.0f}",
            f"{c.outline_px:.0f}",
            *(f"{100.0 * x:.1f}" for x in (c.down.robot, c.down.below_horizon, c.down.above_horizon)),
            *(_pair(shares.robot_theta_deg) for shares in (c.down, c.up)),
            _cell(1e3 * c.spread_m, ".1f"),
        )
        for name, c in found.items()
    )


def resolution_table(found: Mapping[str, Compared], angles_deg: Sequence[float]) -> tuple[Row, ...]:
    """Pixels per degree by theta."""
    heads = ("mirror", *(f"{angle:g} deg" for angle in angles_deg))
    return heads, *(
        (name, *(_cell(np.radians(1.0) * c.rays.at(a, c.rays.px_per_rad), ".1f") for a in angles_deg))
        for name, c in found.items()
    )


def reach_table(found: Mapping[str, Compared], asked: Asked) -> tuple[Row, ...]:
    """Nearest spot on the floor, and lowest and highest spot by distance."""
    heads = ("mirror", "floor from, m", *(f"heights at {d:g} m, m" for d in asked.depths_m), "share of the map, %")
    return heads, *(
        (
            name,
            _cell(c.places.floor_from_m(), ".1f"),
            *(_pair(c.places.heights_at(d), ".2f") for d in asked.depths_m),
            f"{100.0 * c.places.share:.0f}",
        )
        for name, c in found.items()
    )


def bound_table(
    found: Mapping[str, Compared], preset: str, heights_m: Sequence[float], depths_m: Sequence[float]
) -> tuple[Row, ...]:
    """Bound of D in % by height of the spot and distance."""
    heads = ("mirror, height of the spot", *(f"{d:g} m" for d in depths_m))
    return heads, *(
        (f"{name}, {h:g} m", *(_cell(100.0 * c.bounds[preset, h, d].relative, ".3g") for d in depths_m))
        for h in heights_m
        for name, c in found.items()
    )


def cost_table(found: Mapping[str, Compared], asked: Asked) -> tuple[Row, ...]:
    """Errors of D of all deviations together and of those that no calibration knows, by distance."""
    heads = ("mirror, deviations", *(f"{d:g} m" for d in asked.depths_m))
    groups = {"all": ALL_KINDS, "not calibrated": UNCALIBRATED}
    return heads, *(
        (f"{name}, {label}", *(_cell(100.0 * together(c.costs[d], kinds), ".2g") for d in asked.depths_m))
        for label, kinds in groups.items()
        for name, c in found.items()
    )


def tolerance_table(found: Mapping[str, Compared], depth_m: float, cost: float) -> tuple[Row, ...]:
    """Value of every kind that costs so much of D, and the usual size."""
    heads = ("deviation", "usual", *found)
    return heads, *(
        (kind, _sized(kind, usual(kind)), *(_sized(kind, tolerance(c, depth_m, kind, cost)) for c in found.values()))
        for kind in ALL_KINDS
    )


def tolerance(compared: Compared, depth_m: float, kind: str, cost: float) -> float:
    """Value of a kind that costs so much of D by its slope; NaN where it costs nothing or D is not measured."""
    per_unit = compared.costs[depth_m][kind]
    return cost / per_unit if per_unit > 1e-12 else math.nan


def _sized(kind: str, value: float) -> str:
    name, scale = _SHOWN_UNITS[unit(kind)]
    return f"{scale * value:.2g} {name}".strip() if math.isfinite(value) else _NONE


def _cell(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else _NONE


def _pair(ends: tuple[float, float], form: str = ".0f") -> str:
    if not all(map(math.isfinite, ends)):
        return _NONE
    low, high = (format(end, form) for end in ends)
    return low if low == high else f"{low} to {high}"


# -- the choice --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Criterion:
    """One row of the table from which a mirror is picked.

    Attributes
    ----------
    label, unit : str
    value : callable
        Of a mirror; NaN where it has none.
    small : bool
        The smallest is the best.
    """

    label: str
    unit: str
    value: Callable[[Compared], float]
    small: bool = True


def criteria(asked: Asked) -> tuple[Criterion, ...]:
    """What mirrors are compared by."""
    near, far = asked.depths_m[1 if len(asked.depths_m) > 1 else 0], asked.depths_m[-1]
    middle, preset, z = asked.depths_m[len(asked.depths_m) // 2], asked.presets[0], asked.spot_height_m

    def bound(depth_m: float) -> Callable[[Compared], float]:
        return lambda c: 100.0 * c.bounds[preset, z, depth_m].relative

    def resolution(angle: float) -> Callable[[Compared], float]:
        return lambda c: math.radians(1.0) * c.rays.at(angle, c.rays.px_per_rad)

    return (
        Criterion("seen above the horizon", "deg", lambda c: c.field_deg[1] - 90.0, small=False),
        Criterion("floor measured from", "m", lambda c: c.places.floor_from_m()),
        Criterion(f"highest spot at {middle:g} m", "m", lambda c: c.places.heights_at(middle)[1], small=False),
        Criterion("places measured, of the map", "%", lambda c: 100.0 * c.places.share, small=False),
        Criterion("resolution at 60 deg", "px/deg", resolution(60.0), small=False),
        Criterion("resolution at 85 deg", "px/deg", resolution(85.0), small=False),
        Criterion(f"bound of D at {near:g} m", "%", bound(near)),
        Criterion(f"bound of D at {middle:g} m", "%", bound(middle)),
        Criterion(f"bound of D at {far:g} m", "%", bound(far)),
        Criterion(
            f"mirror aside, {100.0 * asked.cost:g} % of D at {middle:g} m",
            "mm",
            lambda c: 1e3 * tolerance(c, middle, "mirror aside", asked.cost),
            small=False,
        ),
        Criterion(f"usual deviations at {middle:g} m", "%", lambda c: 100.0 * together(c.costs[middle], ALL_KINDS)),
        Criterion(
            f"of these not calibrated, at {middle:g} m", "%", lambda c: 100.0 * together(c.costs[middle], UNCALIBRATED)
        ),
        Criterion("pixels that show the robot", "%", lambda c: 100.0 * c.down.robot),
        Criterion("radial blur of the spot, largest", "px", lambda c: _largest_blur(c, preset, z)),
        Criterion("spread of the viewpoints", "mm", lambda c: 1e3 * c.spread_m),
    )


def _largest_blur(compared: Compared, preset: str, height_m: float) -> float:
    found = [one.radial_blur_px for (p, h, _), one in compared.bounds.items() if (p, h) == (preset, height_m)]
    known = [value for value in found if math.isfinite(value)]
    return max(known) if known else math.nan


def pick_table(found: Mapping[str, Compared], asked: Asked) -> tuple[Row, ...]:
    """Criteria as rows, mirrors as columns, and the best and the worst of them."""
    rows: list[Row] = [("criterion", "unit", *found, "best", "worst")]
    for one in criteria(asked):
        values = {name: one.value(c) for name, c in found.items()}
        rows.append((one.label, one.unit, *(_short(x) for x in values.values()), *_ends(values, one.small)))
    return tuple(rows)


def _short(value: float) -> str:
    return number(value) if abs(value) >= 1e-3 else "0" if math.isfinite(value) else _NONE


def _ends(values: Mapping[str, float], small: bool) -> tuple[str, str]:
    """Names of the best and the worst; a mirror without a value is the worst where there is only one."""
    known = sorted((x if small else -x, name) for name, x in values.items() if math.isfinite(x))
    without = [name for name, x in values.items() if not math.isfinite(x)]
    if not known:
        return _NONE, _NONE
    return known[0][1], " and ".join(without) if without else known[-1][1]


# -- findings ----------------------------------------------------------------------------------------------------------


def criteria_findings(found: Mapping[str, Compared], asked: Asked) -> Iterator[Finding]:
    """Every cell of the table from which a mirror is picked."""
    for one in criteria(asked):
        for name, compared in found.items():
            yield Finding(f"{one.label}: {name}", one.value(compared), unit=one.unit)


def ratio_findings(found: Mapping[str, Compared], asked: Asked) -> Iterator[Finding]:
    """Bounds and costs of the other mirrors over those of the first."""
    first, preset, z = next(iter(found)), asked.presets[0], asked.spot_height_m
    for name in list(found)[1:]:
        for d in asked.depths_m:
            ratio = found[first].bounds[preset, z, d].relative / found[name].bounds[preset, z, d].relative
            yield Finding(f"bound of D at {d:g} m, {first} over {name}", ratio)
        for d in asked.depths_m:
            mine, theirs = (found[n].costs[d]["mirror aside"] for n in (name, first))
            yield Finding(f"error by a mirror aside at {d:g} m, {name} over {first}", mine / theirs)
