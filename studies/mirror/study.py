"""Study `mirror`: mirrors of other shapes beside each other, for the choice of one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
import polars as pl
from pydantic import BaseModel, ConfigDict, Field

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.progress import Steps
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.datasets.recipe.build import build_rig, idle_mirror_keys
from phibench.datasets.recipe.mirror_tables import MirrorTable
from phibench.datasets.recipe.tables import RigTable
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError
from phibench.studies.framework import Settings, Study, StudyDatasets, StudyResult
from phibench.studies.mirror.drawings import comparison_drawing
from phibench.studies.mirror.field import disc_shares, meridian, outline_radius_px
from phibench.studies.mirror.measured_places import (
    DIRECTIONS,
    NOTHING,
    BlurBounds,
    blur_bounds,
    errors,
    floor_from_m,
    measured,
    place_bound,
    tolerance,
    usual,
)
from phibench.studies.mirror.tables import (
    Compared,
    PlaceMap,
    bound_table,
    cost_findings,
    cost_table,
    criteria_findings,
    field_table,
    pick_table,
    place_findings,
    ratio_findings,
    reach_table,
    resolution_table,
    single_table,
    tolerance_table,
)

_Angles = Annotated[tuple[Annotated[float, Field(ge=0.0, le=180.0)], ...], Field(strict=False, min_length=1)]
_Metres = Annotated[tuple[Annotated[float, Field(ge=0.2, le=20.0)], ...], Field(strict=False, min_length=1)]
_Heights = Annotated[tuple[Annotated[float, Field(ge=0.0, le=3.0)], ...], Field(strict=False, min_length=1)]
_Blurs = Annotated[tuple[Annotated[float, Field(ge=0.3, le=10.0)], ...], Field(strict=False, min_length=2)]
_Presets = Annotated[tuple[Literal["bayer-raw", "srgb8", "mjpeg"], ...], Field(strict=False, min_length=1)]


class MirrorEntry(BaseModel):
    """A mirror; keys as in `[rig.mirror]` of a recipe, and a sphere, whose rim is its equator."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    shape: Literal["sphere", "ellipsoid", "paraboloid", "hyperboloid", "cone", "polynomial"]
    vertex_radius_m: float | None = Field(default=None, gt=0.0, le=1.0)
    conic: float | None = Field(default=None, ge=-100.0, le=100.0)
    half_angle_deg: float | None = Field(default=None, ge=3.0, le=87.0)
    even_terms: tuple[float, ...] | None = Field(default=None, max_length=8, strict=False)

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
        if faults := idle_mirror_keys("", table):
            raise SceneError("; ".join(f"{fault.path.removeprefix('.')} {fault.text}" for fault in faults))
        return build_rig(RigTable(mirror=table))


class MirrorSettings(Settings):
    """Numbers of the study."""

    rim_radius_m: float = Field(gt=0.0, le=0.1, description="of every mirror")
    stroke_m: float = Field(gt=0.0, le=3.0, description="of every pair")
    presets: _Presets = Field(description="sensors of the bounds; the first is that of the comparison")
    exposure_s: float = Field(gt=0.0, le=10.0, description="of the frames")
    blurs_px: _Blurs = Field(description="rising blurs for which bounds are tabulated")
    heights_m: _Heights = Field(description="of the spots, for the bounds")
    depths_m: _Metres = Field(description="distances of the tables, rising")
    curve_m: Annotated[tuple[float, float, float], Field(strict=False)] = Field(description="first, last, step")
    spot_height_m: float = Field(ge=0.0, le=3.0, description="of the curves and of the misalignments")
    misaligned_m: _Metres = Field(description="distances of the misalignments, rising")
    angles_deg: _Angles = Field(description="theta of the resolution")
    viewpoints_deg: Annotated[tuple[float, float], Field(strict=False)] = Field(description="theta of the viewpoints")
    azimuths_deg: Annotated[tuple[float, ...], Field(strict=False, min_length=1)] = Field(
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


_FINDINGS = (criteria_findings, place_findings, ratio_findings, cost_findings)


def run(settings: MirrorSettings, datasets: StudyDatasets) -> StudyResult:
    """Run the study; it renders nothing."""
    rigs = _rigs(settings)
    with Steps(datasets.console, "mirror, bounds and mirrors", len(settings.presets) + len(rigs)) as steps:
        tables: dict[str, BlurBounds] = {}
        for preset in settings.presets:
            tables[preset] = _bounds_of_spots(settings, preset, next(iter(rigs.values())))
            steps.advance()
        compared = {}
        for name, rig in rigs.items():
            compared[name] = compare(settings, rig, tables)
            steps.advance()
    heights = list(dict.fromkeys((*settings.heights_m, settings.spot_height_m)))
    percent, spot = f"{100.0 * settings.cost:g} %", f"spots at {settings.spot_height_m:g} m"
    shown = {
        "Pick a mirror": pick_table(compared, settings),
        "Field of view and use of the image": field_table(compared),
        "Resolution, pixels per degree of theta": resolution_table(compared, settings.angles_deg),
        "Places that both images show": reach_table(compared, settings),
        **{f"Bound of D, %, {preset}": bound_table(compared, preset, heights, settings.depths_m) for preset in tables},
        f"Error of D, %, by deviations of usual size, {spot}": cost_table(compared, settings),
        f"Deviation that costs {percent} of D at the costliest distance, {spot}": tolerance_table(compared),
        f"Error of D, %, by one deviation of usual size, {spot}": single_table(compared, settings),
    }
    return StudyResult(
        {
            "table": bound_frame(compared),
            "rays": ray_frame(compared),
            "costs": cost_frame(compared),
            "map": map_frame(compared),
        },
        tuple(row for findings_of in _FINDINGS for row in findings_of(compared, settings)),
        (comparison_drawing(compared, settings),),
        shown,
        _notes(settings),
    )


def _rigs(settings: MirrorSettings) -> dict[str, Rig]:
    """Aligned rigs by name.

    Raises
    ------
    DatasetError
        If a mirror cannot be, or numbers are not in order.
    """
    first, last, step = settings.curve_m
    if not 0.2 <= first < last <= 20.0 or not 0.0 < step <= last - first:  # distances as in `_Metres`
        raise DatasetError(f"curve_m = {list(settings.curve_m)}: must be first < last, 0.2 to 20 m, and a step above 0")
    for name in ("blurs_px", "depths_m", "misaligned_m", "azimuths_deg", "viewpoints_deg"):
        values = getattr(settings, name)
        if list(values) != sorted(set(values)):
            raise DatasetError(f"{name} = {list(values)}: must rise")
    rigs = {}
    for name, entry in settings.mirrors.items():
        try:
            rigs[name] = entry.rig(settings.rim_radius_m)
        except SceneError as error:
            raise DatasetError(f"mirrors.{name}: {str(error).replace('rig.mirror.', '')}") from error
        if not rigs[name].fits_image():
            raise DatasetError(f"mirrors.{name}: its outline is cut by the image; give a smaller rim_radius_m")
    return rigs


def _bounds_of_spots(settings: MirrorSettings, preset: str, rig: Rig) -> BlurBounds:
    card = sensor_card(preset, exposure_s=settings.exposure_s)
    r, g, b = rig.camera.detector.laser_filter_response
    return blur_bounds(card, (r, g, b), settings.blurs_px)


def compare(settings: MirrorSettings, rig: Rig, tables: Mapping[str, BlurBounds]) -> Compared:
    """All that the study says of one mirror."""
    rays = meridian(rig)
    places = place_map(settings, rig)
    heights = dict.fromkeys((*settings.heights_m, settings.spot_height_m))
    depths = sorted({*settings.depths_m, *settings.misaligned_m, *(settings.curve_depths_m.tolist())})
    seen = _seen(settings, rig, [(d, h) for h in heights for d in depths])
    bounds = {
        (preset, h, d): place_bound(rig, table, d, h, settings.stroke_m) if seen[d, h] else NOTHING
        for preset, table in tables.items()
        for h in heights
        for d in (depths if h == settings.spot_height_m else settings.depths_m)
    }
    nothing = dict.fromkeys(DIRECTIONS, math.nan)
    at, h = settings.spot_height_m, settings.stroke_m
    wrong = [d for d in settings.misaligned_m if seen[d, at]]
    spots = np.array([(d, 0.0, at) for d in wrong])
    costs = {kind: errors(rig, kind, usual(kind), spots, h) for kind in DIRECTIONS} if wrong else {}
    sides = (0.0, 0.5 * math.pi, math.pi)
    return Compared(
        rays=rays,
        field_deg=rays.field_deg(settings.edge_px),
        rim_deg=rays.field_deg()[1],
        outline_px=outline_radius_px(rig),
        spread_m=rays.viewpoint_spread_m(settings.viewpoints_deg, settings.edge_px),
        down=disc_shares(rig, rays, 0.0, settings.azimuths_rad),
        up=disc_shares(rig, rays, settings.stroke_m, settings.azimuths_rad),
        places=places,
        bounds=bounds,
        floor_m=tuple(floor_from_m(rig, h, settings.edge_px, a, settings.curve_m[1]) for a in sides),
        costs=dict.fromkeys(settings.misaligned_m, nothing)
        | {d: {kind: float(column[i]) for kind, column in costs.items()} for i, d in enumerate(wrong)},
        tolerances={k: tolerance(rig, k, spots, h, settings.cost) if wrong else math.nan for k in DIRECTIONS},
    )


def _seen(settings: MirrorSettings, rig: Rig, places: list[tuple[float, float]]) -> dict[tuple[float, float], bool]:
    """Distances and heights that a pair measures, from all azimuths."""
    points = np.array([(d, 0.0, h) for d, h in places])
    fine = measured(rig, points, settings.stroke_m, settings.edge_px, settings.azimuths_rad)
    return dict(zip(places, fine.tolist(), strict=True))


def place_map(settings: MirrorSettings, rig: Rig) -> PlaceMap:
    """Map of the places that pairs measure from all azimuths."""
    depths = settings.curve_depths_m
    heights = np.arange(0.0, settings.map_height_m + 0.5 * settings.map_step_m, settings.map_step_m)
    D, Z = np.meshgrid(depths, heights)
    points = np.stack([D.ravel(), np.zeros(D.size), Z.ravel()], axis=-1)
    fine = measured(rig, points, settings.stroke_m, settings.edge_px, settings.azimuths_rad)
    return PlaceMap(depths, heights, fine.reshape(D.shape))


# -- tables of numbers -------------------------------------------------------------------------------------------------


def bound_frame(found: Mapping[str, Compared]) -> pl.DataFrame:
    """A row per mirror, sensor, height and distance."""
    rows: list[dict[str, Any]] = [
        {
            "mirror": name,
            "preset": preset,
            "height_m": h,
            "depth_m": d,
            "sigma_relative": bound.relative,
            "theta_down_deg": math.degrees(bound.theta_rad[0]),
            "theta_up_deg": math.degrees(bound.theta_rad[1]),
            "radial_blur_px": bound.radial_blur_px,
        }
        for name, compared in found.items()
        for (preset, h, d), bound in compared.bounds.items()
    ]
    return pl.DataFrame(rows)


def ray_frame(found: Mapping[str, Compared]) -> pl.DataFrame:
    """A row per mirror and ray of the meridian."""
    return pl.concat(
        [
            pl.DataFrame(
                {
                    "radius_px": c.rays.radius_px,
                    "theta_deg": np.degrees(c.rays.theta_rad),
                    "px_per_deg": np.radians(1.0) * c.rays.px_per_rad,
                    "px_per_deg_of_azimuth": np.radians(1.0) * c.rays.radius_px,
                    "viewpoint_m": c.rays.viewpoint_m,
                }
            ).select(pl.lit(name).alias("mirror"), pl.all())
            for name, c in found.items()
        ]
    )


def cost_frame(found: Mapping[str, Compared]) -> pl.DataFrame:
    """A row per mirror, distance and kind of deviation: error of D at the usual size, and tolerance."""
    rows = [
        {
            "mirror": name,
            "depth_m": d,
            "deviation": kind,
            "parameters": ", ".join(DIRECTIONS[kind]),
            "usual": usual(kind),
            "error_relative": error,
            "tolerance": compared.tolerances[kind],
        }
        for name, compared in found.items()
        for d, by_kind in compared.costs.items()
        for kind, error in by_kind.items()
    ]
    return pl.DataFrame(rows)


def map_frame(found: Mapping[str, Compared]) -> pl.DataFrame:
    """A row per mirror and place of the map."""
    return pl.concat(
        [
            pl.DataFrame(
                {
                    "depth_m": np.tile(c.places.depths_m, len(c.places.heights_m)),
                    "height_m": np.repeat(c.places.heights_m, len(c.places.depths_m)),
                    "measured": c.places.measured.ravel(),
                }
            ).select(pl.lit(name).alias("mirror"), pl.all())
            for name, c in found.items()
        ]
    )


def _notes(settings: MirrorSettings) -> tuple[str, ...]:
    return (
        "Bounds are for a 1 mW spot on a flat white wall that faces the axis, the rig known exactly. They leave full "
        f"pixels out, and are those of frames with {1e3 * settings.exposure_s:g} ms.",
        "Places count where spots are seen in both images from all azimuths, and robot, mast and camera's housing hide "
        "none; a dash is a place that is not measured.",
        "Errors of D by deviations are those of the costlier direction and sign, one deviation at a time, in a rig "
        "that is not calibrated; together they are roots of sums of squares. A pair is lost where the lens folds, too.",
    )


STUDY = Study(
    "mirror",
    "Which mirror",
    "For equal rim, camera and stroke: which mirror sees what, how well does it measure D there, and how exactly must "
    "it be mounted?",
    MirrorSettings,
    run,
)
