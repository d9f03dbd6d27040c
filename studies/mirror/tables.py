"""Settings, tables and findings of the study `mirror`: one row per mirror, and the table from which one is picked."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from phibench.datasets.recipe.mirror_tables import SHAPES, MirrorTable
from phibench.datasets.recipe.recipe_scene import build_rig, idle_mirror_faults
from phibench.datasets.recipe.tables import RigTable
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError
from phibench.studies.framework import Finding, Heights, Metres, Presets, Row, Settings, number, text_table
from phibench.studies.mirror.field import DiscShares, Meridian
from phibench.studies.mirror.misalignment_costs import (
    DIRECTIONS,
    UNCALIBRATED,
    root_of_squares,
    unit_of_kind,
    usual_size,
)
from phibench.studies.mirror.place_bounds import PlaceBound

ALL_KINDS = tuple(DIRECTIONS)
_NONE, _LOST = "-", "lost"
_FEW = 2  # names that a cell holds
# as people state tolerances
_SHOWN_UNITS = {"m": ("mm", 1e3), "rad": ("deg", math.degrees(1.0)), "px": ("px", 1.0), "1": ("", 1.0)}
_Angles = Annotated[tuple[Annotated[float, Field(ge=0.0, le=180.0)], ...], Field(min_length=1)]
_Blurs = Annotated[tuple[Annotated[float, Field(ge=0.3, le=10.0)], ...], Field(min_length=2)]


if TYPE_CHECKING:
    ShapeOrSphere = str
else:
    ShapeOrSphere = Literal[("sphere", *SHAPES)]


class MirrorEntry(Settings):
    """A mirror; keys as in `[rig.mirror]` of a recipe, and a sphere, whose rim is its equator."""

    shape: ShapeOrSphere
    vertex_radius_m: float | None = Field(default=None, gt=0.0, le=1.0)
    conic: float | None = Field(default=None, ge=-100.0, le=100.0)
    half_angle_deg: float | None = Field(default=None, ge=3.0, le=87.0)
    even_terms: tuple[float, ...] | None = Field(default=None, max_length=8)

    def rig(self, rim_radius_m: float) -> Rig:
        """Default rig with this mirror.

        Raises
        ------
        SceneError
            If there is no such mirror, or a key does not belong to its shape.
        """
        given = self.model_dump(exclude_none=True, exclude={"shape"})
        if self.shape == "sphere":
            if given:
                raise SceneError(f'{next(iter(given))} has no effect on shape = "sphere"; remove it')
            return build_rig(RigTable(radius_m=rim_radius_m))
        table = MirrorTable(shape=self.shape, rim_radius_m=rim_radius_m, **given)
        if faults := idle_mirror_faults("", table):
            raise SceneError("; ".join(f"{fault.path.removeprefix('.')} {fault.text}" for fault in faults))
        return build_rig(RigTable(mirror=table))


class MirrorSettings(Settings):
    """Numbers of the study."""

    rim_radius_m: float = Field(gt=0.0, le=0.1, description="of every mirror")
    stroke_m: float = Field(gt=0.0, le=3.0, description="of every pair")
    presets: Presets = Field(description="sensors of the bounds; the first is that of the comparison")
    exposure_s: float = Field(gt=0.0, le=10.0, description="of the frames")
    blurs_px: _Blurs = Field(description="rising blurs for which bounds are tabulated")
    heights_m: Heights = Field(description="of the spots, for the bounds")
    depths_m: Metres = Field(description="distances of the tables, rising")
    curve_m: tuple[float, float, float] = Field(description="first, last, step")
    spot_height_m: float = Field(ge=0.0, le=3.0, description="of the curves and of the misalignments")
    misaligned_m: Metres = Field(description="distances of the misalignments, rising")
    angles_deg: _Angles = Field(description="theta of the resolution")
    viewpoints_deg: tuple[float, float] = Field(description="theta of the viewpoints")
    azimuths_deg: Annotated[tuple[float, ...], Field(min_length=1)] = Field(
        description="of places that the robot may hide; even steps from front to rear"
    )
    map_step_m: float = Field(ge=0.01, le=0.5, description="of the map of places")
    map_height_m: float = Field(ge=0.5, le=5.0, description="of the map of places")
    edge_px: float = Field(ge=0.0, le=50.0, description="least distance of a spot from the mirror's edge")
    cost: float = Field(gt=0.0, lt=1.0, description="relative error of D that a tolerance allows")
    mirrors: dict[str, MirrorEntry] = Field(min_length=2, description="by name; the first is the reference")

    @property
    def azimuths_rad(self) -> Array:
        """Azimuths of places."""
        return np.radians(self.azimuths_deg)

    @property
    def curve_depths_m(self) -> Array:
        """Distances of the curves and of the map's columns."""
        first, last, step = self.curve_m
        return np.arange(first, last + 0.5 * step, step)


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

    def heights_at(self, depth_m: float) -> tuple[float, float]:
        """Lowest and highest measured height at the map's nearest distance; NaN where there is none."""
        column = self.measured[:, int(np.argmin(np.abs(self.depths_m - depth_m)))]
        if not column.any():
            return math.nan, math.nan
        seen = self.heights_m[column]
        return float(seen[0]), float(seen[-1])


@dataclass(frozen=True)
class MirrorComparison:
    """All that the study says of one mirror.

    Attributes
    ----------
    field_deg : (least, largest) theta, up to the margin inside the outline
    rim_deg : largest theta, at the outline
    outline_px : radius of the mirror's image
    spread_m : of the viewpoints
    floor_m : least distance from which on the floor is measured: before, beside and behind the robot
    bounds : by preset, height and distance
    costs : by distance and kind of deviation, relative error of D at the usual size; infinite where the pair is lost
    tolerances : by kind, size that costs the allowed error at the costliest distance; NaN where none does
    """

    rays: Meridian
    field_deg: tuple[float, float]
    rim_deg: float
    outline_px: float
    spread_m: float
    down: DiscShares
    up: DiscShares
    places: PlaceMap
    floor_m: tuple[float, ...]
    bounds: Mapping[tuple[str, float, float], PlaceBound]
    costs: Mapping[float, Mapping[str, float]]
    tolerances: Mapping[str, float]


# -- tables ------------------------------------------------------------------------------------------------------------


def field_table(found: Mapping[str, MirrorComparison]) -> tuple[Row, ...]:
    """Field of view, use of the image down, theta up to which the robot is seen down and up, and viewpoints."""
    return text_table(
        found.items(),
        {
            "mirror": lambda m: m[0],
            "theta, deg": lambda m: f"{m[1].field_deg[0]:.0f} to {m[1].field_deg[1]:.0f}",
            "outline, deg": lambda m: f"{m[1].rim_deg:.0f}",
            "outline, px": lambda m: f"{m[1].outline_px:.0f}",
            "robot, % of pixels": lambda m: f"{100.0 * m[1].down.robot:.1f}",
            "below horizon, %": lambda m: f"{100.0 * m[1].down.below_horizon:.1f}",
            "above, %": lambda m: f"{100.0 * m[1].down.above_horizon:.1f}",
            "robot to, deg": lambda m: _pair(m[1].down.robot_theta_deg),
            "the same up, deg": lambda m: _pair(m[1].up.robot_theta_deg),
            "viewpoints, mm": lambda m: _cell(1e3 * m[1].spread_m, ".1f"),
        },
    )


def resolution_table(found: Mapping[str, MirrorComparison], angles_deg: Sequence[float]) -> tuple[Row, ...]:
    """Pixels per degree by theta."""
    heads = ("mirror", *(f"{angle:g} deg" for angle in angles_deg))
    return heads, *(
        (name, *(_cell(np.radians(1.0) * c.rays.at(a, c.rays.px_per_rad), ".1f") for a in angles_deg))
        for name, c in found.items()
    )


def reach_table(found: Mapping[str, MirrorComparison], settings: MirrorSettings) -> tuple[Row, ...]:
    """Nearest spot on the floor before, beside and behind the robot; lowest and highest spot by distance."""
    heads = (
        "mirror",
        "floor before, m",
        "beside, m",
        "behind, m",
        *(f"heights at {d:g} m, m" for d in settings.depths_m),
        "share of the map, %",
    )
    return heads, *(
        (
            name,
            *(_cell(nearest, ".2f") for nearest in c.floor_m),
            *(_pair(c.places.heights_at(d), ".2f") for d in settings.depths_m),
            f"{100.0 * c.places.share:.0f}",
        )
        for name, c in found.items()
    )


def bound_table(
    found: Mapping[str, MirrorComparison], preset: str, heights_m: Sequence[float], depths_m: Sequence[float]
) -> tuple[Row, ...]:
    """Bound of D in % by height of the spot and distance."""
    heads = ("mirror, height of the spot", *(f"{d:g} m" for d in depths_m))
    return heads, *(
        (f"{name}, {h:g} m", *(_cell(100.0 * c.bounds[preset, h, d].relative, ".3g") for d in depths_m))
        for h in heights_m
        for name, c in found.items()
    )


def cost_table(found: Mapping[str, MirrorComparison], settings: MirrorSettings) -> tuple[Row, ...]:
    """Errors of D of all deviations together and of those that no calibration knows, by distance."""
    heads = ("mirror, deviations", *(f"{d:g} m" for d in settings.misaligned_m))
    groups = {"all": ALL_KINDS, "beyond calibration": UNCALIBRATED}
    return heads, *(
        (f"{name}, {label}", *(_error(root_of_squares(c.costs[d], kinds)) for d in settings.misaligned_m))
        for label, kinds in groups.items()
        for name, c in found.items()
    )


def single_table(found: Mapping[str, MirrorComparison], settings: MirrorSettings) -> tuple[Row, ...]:
    """Error of D by each kind of deviation alone, by mirror and distance."""
    heads = ("deviation, mirror", *(f"{d:g} m" for d in settings.misaligned_m))
    return heads, *(
        (f"{kind}, {name}", *(_error(c.costs[d][kind]) for d in settings.misaligned_m))
        for kind in ALL_KINDS
        for name, c in found.items()
    )


def tolerance_table(found: Mapping[str, MirrorComparison]) -> tuple[Row, ...]:
    """Value of every kind that costs so much of D, and the usual size."""
    heads = ("deviation", "usual", *found)
    return heads, *(
        (kind, _sized(kind, usual_size(kind)), *(_sized(kind, c.tolerances[kind]) for c in found.values()))
        for kind in ALL_KINDS
    )


def _sized(kind: str, value: float) -> str:
    if not math.isfinite(value):
        return _NONE
    name, scale = _SHOWN_UNITS[unit_of_kind(kind)]
    return f"{_two_digits(scale * value)} {name}".strip()


def _two_digits(value: float) -> str:
    return f"{value:.0f}" if value >= 100.0 else f"{value:.2g}"


def _error(relative: float) -> str:
    """Error of D in %; what is below 0.001 % is 0."""
    percent = 100.0 * relative
    return _two_digits(percent if percent >= 1e-3 else 0.0) if math.isfinite(relative) else _cell(relative, "")


def _cell(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else _LOST if math.isinf(value) else _NONE


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
    value : callable
        Of a mirror; NaN where it has none.
    small : bool
        The smallest is the best.
    """

    label: str
    unit: str
    value: Callable[[MirrorComparison], float]
    small: bool = True


def criteria(settings: MirrorSettings) -> tuple[Criterion, ...]:
    """Criteria by which mirrors are compared."""
    near, far, last = settings.misaligned_m[0], settings.misaligned_m[-1], settings.depths_m[-1]
    preset, z = settings.presets[0], settings.spot_height_m
    return (
        Criterion("seen above the horizon", "deg", lambda c: c.field_deg[1] - 90.0, small=False),
        Criterion("floor beside the robot from", "m", lambda c: c.floor_m[1]),
        Criterion(f"highest spot at {far:g} m", "m", lambda c: c.places.heights_at(far)[1], small=False),
        Criterion("places measured, of the map", "%", lambda c: 100.0 * c.places.share, small=False),
        *(Criterion(f"resolution at {a:g} deg", "px/deg", _resolution(a), small=False) for a in (60.0, 85.0)),
        *(Criterion(f"bound of D at {d:g} m", "%", _bound(preset, z, d)) for d in dict.fromkeys((near, far, last))),
        Criterion(
            f"mirror aside that costs {100.0 * settings.cost:g} %",
            "mm",
            lambda c: 1e3 * c.tolerances["mirror aside"],
            small=False,
        ),
        *(Criterion(f"usual deviations at {d:g} m", "%", _together(d, ALL_KINDS)) for d in (near, far)),
        Criterion(f"beyond calibration, at {far:g} m", "%", _together(far, UNCALIBRATED)),
        Criterion(
            f"bound and beyond calibration, at {far:g} m",
            "%",
            lambda c: math.hypot(_bound(preset, z, far)(c), _together(far, UNCALIBRATED)(c)),
        ),
        Criterion("pixels that show the robot", "%", lambda c: 100.0 * c.down.robot),
        Criterion("radial blur of the spot, largest", "px", lambda c: _largest_blur(c, preset, z)),
        Criterion("spread of the viewpoints", "mm", lambda c: round(1e3 * c.spread_m, 6)),
    )


def _bound(preset: str, height_m: float, depth_m: float) -> Callable[[MirrorComparison], float]:
    return lambda c: 100.0 * c.bounds[preset, height_m, depth_m].relative


def _resolution(angle_deg: float) -> Callable[[MirrorComparison], float]:
    return lambda c: math.radians(1.0) * c.rays.at(angle_deg, c.rays.px_per_rad)


def _together(depth_m: float, kinds: Sequence[str]) -> Callable[[MirrorComparison], float]:
    return lambda c: 100.0 * root_of_squares(c.costs[depth_m], kinds)


def _largest_blur(compared: MirrorComparison, preset: str, height_m: float) -> float:
    blurs = [bound.radial_blur_px for (p, h, _), bound in compared.bounds.items() if (p, h) == (preset, height_m)]
    known = [value for value in blurs if math.isfinite(value)]
    return max(known) if known else math.nan


def pick_table(found: Mapping[str, MirrorComparison], settings: MirrorSettings) -> tuple[Row, ...]:
    """Criteria as rows, mirrors as columns, and the best and the worst of them."""
    rows: list[Row] = [("criterion", "unit", *found, "best", "worst")]
    for criterion in criteria(settings):
        values = {name: criterion.value(c) for name, c in found.items()}
        rows.append(
            (criterion.label, criterion.unit, *(_short(x) for x in values.values()), *_ends(values, criterion.small))
        )
    return tuple(rows)


def _short(value: float) -> str:
    return number(value) if abs(value) >= 1e-3 else _cell(value, ".0f")


def _ends(values: Mapping[str, float], small: bool) -> tuple[str, str]:
    """Names of the best and the worst; mirrors without a value are the worst. Of many that are equal, their number."""
    known = {name: float(_short(x)) for name, x in values.items() if math.isfinite(x)}
    without = [name for name in values if name not in known]
    if not known:
        return _NONE, _NONE
    best, worst = (min, max) if small else (max, min)
    ends = ([name for name, x in known.items() if x == end(known.values())] for end in (best, worst))
    first, last = ends
    return _names(first), _names(without or last)


def _names(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= _FEW else f"{len(names)} are equal"


# -- findings ----------------------------------------------------------------------------------------------------------


def criteria_findings(found: Mapping[str, MirrorComparison], settings: MirrorSettings) -> Iterator[Finding]:
    """Best and worst value of each criterion, of the mirrors that have one."""
    for criterion in criteria(settings):
        known = sorted((x, name) for name, c in found.items() if math.isfinite(x := criterion.value(c)))
        if known:
            ends = (known[0], known[-1]) if criterion.small else (known[-1], known[0])
            for word, (value, name) in zip(("best", "worst"), ends, strict=True):
                yield Finding(f"{criterion.label}, {word}: {name}", value, unit=criterion.unit)


def ratio_findings(found: Mapping[str, MirrorComparison], settings: MirrorSettings) -> Iterator[Finding]:
    """Bounds of the first mirror over those of the others, and its tolerance of being aside over theirs."""
    first, *others = found
    preset, z, far = settings.presets[0], settings.spot_height_m, settings.misaligned_m[-1]
    for name in others:
        bound = _bound(preset, z, far)
        ratio = bound(found[first]) / bound(found[name])
        if math.isfinite(ratio):
            yield Finding(f"bound of D at {far:g} m, {first} over {name}", ratio)
    for name in others:
        ratio = found[first].tolerances["mirror aside"] / found[name].tolerances["mirror aside"]
        if math.isfinite(ratio):
            yield Finding(f"allowed mirror aside, {first} over {name}", ratio)


def place_findings(found: Mapping[str, MirrorComparison], settings: MirrorSettings) -> Iterator[Finding]:
    """Nearest distance with a bound, and the pixels that are spent on what is above the horizon."""
    for name, c in found.items():
        seen = [
            d for (_, h, d), bound in c.bounds.items() if h == settings.spot_height_m and math.isfinite(bound.relative)
        ]
        yield Finding(f"nearest D of spots at {settings.spot_height_m:g} m: {name}", min(seen, default=None), unit="m")
    for name, c in found.items():
        yield Finding(f"pixels above the horizon: {name}", 100.0 * c.down.above_horizon, unit="%")


def cost_findings(found: Mapping[str, MirrorComparison], settings: MirrorSettings) -> Iterator[Finding]:
    """Allowed error, and errors that no calibration knows: least and largest of all mirrors."""
    yield Finding("error of D that a tolerance allows", 100.0 * settings.cost, unit="%")
    for d in settings.misaligned_m:
        known = [x for c in found.values() if math.isfinite(x := _together(d, UNCALIBRATED)(c))]
        if known:
            yield Finding(f"beyond calibration, at {d:g} m: least of all mirrors", min(known), unit="%")
            yield Finding(f"beyond calibration, at {d:g} m: largest of all mirrors", max(known), unit="%")
