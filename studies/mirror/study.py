"""Study `mirror`: mirrors of several shapes: field of view, resolution, bound of D, cost of misalignment; a drawing.

The drawing comes last: resolution, bound of D, measured places, and cost of deviations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError
from phibench.studies.framework import (
    COLOURS,
    LINES,
    MARKERS,
    Drawing,
    Study,
    StudyDatasets,
    StudyResult,
    canvas,
    finished_drawing,
)
from phibench.studies.mirror import misalignment_costs, place_bounds, tables, visible_places
from phibench.studies.mirror.field import disc_shares, meridian, outline_radius_px

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FINDINGS = (tables.criteria_findings, tables.place_findings, tables.ratio_findings, tables.cost_findings)


def run(settings: tables.MirrorSettings, datasets: StudyDatasets) -> StudyResult:
    """Run the study; it renders nothing."""
    rigs = _rigs(settings)
    first = next(iter(rigs.values()))
    presets: tuple[str, ...] = settings.presets
    by_preset = {p: _bounds_of_spots(settings, p, first) for p in datasets.each(presets, "mirror, bounds")}
    compared = {
        name: mirror_comparison(settings, rigs[name], by_preset)
        for name in datasets.each(list(rigs), "mirror, mirrors")
    }
    heights = list(dict.fromkeys((*settings.heights_m, settings.spot_height_m)))
    percent, spot = f"{100.0 * settings.cost:g} %", f"spots at {settings.spot_height_m:g} m"
    shown = {
        "Pick a mirror": tables.pick_table(compared, settings),
        "Field of view and use of the image": tables.field_table(compared),
        "Resolution, pixels per degree of theta": tables.resolution_table(compared, settings.angles_deg),
        "Places that both images show": tables.reach_table(compared, settings),
        **{
            f"Bound of D, %, {preset}": tables.bound_table(compared, preset, heights, settings.depths_m)
            for preset in presets
        },
        f"Error of D, %, by deviations of usual size, {spot}": tables.cost_table(compared, settings),
        f"Deviation that costs {percent} of D at the costliest distance, {spot}": tables.tolerance_table(compared),
        f"Error of D, %, by one deviation of usual size, {spot}": tables.single_table(compared, settings),
    }
    return StudyResult(
        {
            "table": bound_frame(compared),
            "rays": _below_each_other(compared, ray_columns),
            "costs": cost_frame(compared),
            "map": _below_each_other(compared, map_columns),
        },
        tuple(row for findings_of in _FINDINGS for row in findings_of(compared, settings)),
        (comparison_drawing(compared, settings),),
        shown,
        _notes(settings),
    )


def _rigs(settings: tables.MirrorSettings) -> dict[str, Rig]:
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


def _bounds_of_spots(settings: tables.MirrorSettings, preset: str, rig: Rig) -> place_bounds.BlurBounds:
    card = sensor_card(preset, exposure_s=settings.exposure_s)
    r, g, b = rig.camera.detector.laser_filter_response
    return place_bounds.blur_bounds(card, (r, g, b), settings.blurs_px)


def mirror_comparison(
    settings: tables.MirrorSettings, rig: Rig, by_preset: Mapping[str, place_bounds.BlurBounds]
) -> tables.MirrorComparison:
    """All that the study says of one mirror."""
    rays = meridian(rig)
    places = place_map(settings, rig)
    heights = dict.fromkeys((*settings.heights_m, settings.spot_height_m))
    depths = sorted({*settings.depths_m, *settings.misaligned_m, *(settings.curve_depths_m.tolist())})
    seen = _seen(settings, rig, [(d, h) for h in heights for d in depths])
    bounds = {
        (preset, h, d): place_bounds.place_bound(rig, table, d, h, settings.stroke_m)
        if seen[d, h]
        else place_bounds.NOTHING
        for preset, table in by_preset.items()
        for h in heights
        for d in (depths if h == settings.spot_height_m else settings.depths_m)
    }
    nothing = dict.fromkeys(misalignment_costs.DIRECTIONS, math.nan)
    at, h = settings.spot_height_m, settings.stroke_m
    wrong = [d for d in settings.misaligned_m if seen[d, at]]
    spots = np.array([(d, 0.0, at) for d in wrong])
    costs = (
        {
            kind: misalignment_costs.errors(rig, kind, misalignment_costs.usual_size(kind), spots, h)
            for kind in misalignment_costs.DIRECTIONS
        }
        if wrong
        else {}
    )
    sides = (0.0, 0.5 * math.pi, math.pi)
    return tables.MirrorComparison(
        rays=rays,
        field_deg=rays.field_deg(settings.edge_px),
        rim_deg=rays.field_deg()[1],
        outline_px=outline_radius_px(rig),
        spread_m=rays.viewpoint_spread_m(settings.viewpoints_deg, settings.edge_px),
        down=disc_shares(rig, rays, 0.0, settings.azimuths_rad),
        up=disc_shares(rig, rays, settings.stroke_m, settings.azimuths_rad),
        places=places,
        bounds=bounds,
        floor_m=tuple(visible_places.floor_from_m(rig, h, settings.edge_px, a, settings.curve_m[1]) for a in sides),
        costs=dict.fromkeys(settings.misaligned_m, nothing)
        | {d: {kind: float(column[i]) for kind, column in costs.items()} for i, d in enumerate(wrong)},
        tolerances={
            k: misalignment_costs.tolerance(rig, k, spots, h, settings.cost) if wrong else math.nan
            for k in misalignment_costs.DIRECTIONS
        },
    )


def _seen(
    settings: tables.MirrorSettings, rig: Rig, places: list[tuple[float, float]]
) -> dict[tuple[float, float], bool]:
    """Distances and heights that a pair measures, from all azimuths."""
    points = np.array([(d, 0.0, h) for d, h in places])
    fine = visible_places.measured_places(rig, points, settings.stroke_m, settings.edge_px, settings.azimuths_rad)
    return dict(zip(places, fine.tolist(), strict=True))


def place_map(settings: tables.MirrorSettings, rig: Rig) -> tables.PlaceMap:
    """Map of the places that pairs measure from all azimuths."""
    depths = settings.curve_depths_m
    heights = np.arange(0.0, settings.map_height_m + 0.5 * settings.map_step_m, settings.map_step_m)
    D, Z = np.meshgrid(depths, heights)
    points = np.stack([D.ravel(), np.zeros(D.size), Z.ravel()], axis=-1)
    fine = visible_places.measured_places(rig, points, settings.stroke_m, settings.edge_px, settings.azimuths_rad)
    return tables.PlaceMap(depths, heights, fine.reshape(D.shape))


# -- tables of numbers -------------------------------------------------------------------------------------------------


def bound_frame(found: Mapping[str, tables.MirrorComparison]) -> pl.DataFrame:
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


def _below_each_other(
    found: Mapping[str, tables.MirrorComparison], columns: Callable[[tables.MirrorComparison], dict[str, Any]]
) -> pl.DataFrame:
    return pl.concat([pl.DataFrame({"mirror": name, **columns(c)}) for name, c in found.items()])


def ray_columns(compared: tables.MirrorComparison) -> dict[str, Any]:
    """A row per ray of the meridian."""
    rays = compared.rays
    return {
        "radius_px": rays.radius_px,
        "theta_deg": np.degrees(rays.theta_rad),
        "px_per_deg": np.radians(1.0) * rays.px_per_rad,
        "px_per_deg_of_azimuth": np.radians(1.0) * rays.radius_px,
        "viewpoint_m": rays.viewpoint_m,
    }


def cost_frame(found: Mapping[str, tables.MirrorComparison]) -> pl.DataFrame:
    """A row per mirror, distance and kind of deviation: error of D at the usual size, and tolerance."""
    rows = [
        {
            "mirror": name,
            "depth_m": d,
            "deviation": kind,
            "parameters": ", ".join(misalignment_costs.DIRECTIONS[kind]),
            "usual": misalignment_costs.usual_size(kind),
            "error_relative": error,
            "tolerance": compared.tolerances[kind],
        }
        for name, compared in found.items()
        for d, by_kind in compared.costs.items()
        for kind, error in by_kind.items()
    ]
    return pl.DataFrame(rows)


def map_columns(compared: tables.MirrorComparison) -> dict[str, Any]:
    """A row per place of the map."""
    places = compared.places
    return {
        "depth_m": np.tile(places.depths_m, len(places.heights_m)),
        "height_m": np.repeat(places.heights_m, len(places.depths_m)),
        "measured": places.measured.ravel(),
    }


def _notes(settings: tables.MirrorSettings) -> tuple[str, ...]:
    return (
        "Bounds are for a 1 mW spot on a flat white wall that faces the axis, the rig known exactly. They leave full "
        f"pixels out, and are those of frames with {1e3 * settings.exposure_s:g} ms.",
        "Places count where spots are seen in both images from all azimuths, and robot, mast and camera's housing hide "
        "none; a dash is a place that is not measured.",
        "Errors of D by deviations are those of the costlier direction and sign, one deviation at a time, in a rig "
        "that is not calibrated; together they are roots of sums of squares. A pair is lost where the lens folds, too.",
    )


# -- drawing -----------------------------------------------------------------------------------------------------------

_LEAST = 1e-2  # per cent: what costs less is not drawn


def comparison_drawing(found: Mapping[str, tables.MirrorComparison], settings: tables.MirrorSettings) -> Drawing:
    """The four panels."""
    from matplotlib.lines import Line2D

    with canvas(10.0, 8.0) as figure:
        (left, right), (low, last) = figure.subplots(2, 2)
        _resolution(left, found)
        _bounds(right, found, settings)
        _places(low, found)
        _costs(last, found, settings)
        handles = [Line2D([], [], label=n, marker=MARKERS[i], **_style(i)) for i, n in enumerate(found)]
        left.legend(handles=handles, frameon=False)
        far = settings.misaligned_m[-1]
        parts = "; ".join(
            f"{name} {100.0 * value:.2g} %"
            for name, c in found.items()
            if np.isfinite(value := c.bounds[settings.presets[0], settings.spot_height_m, far].relative)
        )
        alt = (
            "Four panels: pixels per degree against theta; bound of D against D; outlines of the places that are "
            f"measured; error of D by deviations of the usual size. Bounds at {far:g} m: {parts}."
        )
        return finished_drawing("mirror", figure, alt, "png")


def _style(i: int) -> dict[str, Any]:
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": LINES[i % len(LINES)]}


def _resolution(ax: Axes, found: Mapping[str, tables.MirrorComparison]) -> None:
    for i, c in enumerate(found.values()):
        inside = np.degrees(c.rays.theta_rad) <= c.field_deg[1]
        ax.plot(np.degrees(c.rays.theta_rad)[inside], np.radians(1.0) * c.rays.px_per_rad[inside], **_style(i))
    ax.axvline(90.0, color="grey", linewidth=0.8)
    ax.set_yscale("log")
    ax.set_xlabel("theta from straight down, deg (90: horizon)")
    ax.set_ylabel("resolution, px/deg")


def _bounds(ax: Axes, found: Mapping[str, tables.MirrorComparison], settings: tables.MirrorSettings) -> None:
    preset = settings.presets[0]
    for i, c in enumerate(found.values()):
        depths = sorted(d for p, h, d in c.bounds if (p, h) == (preset, settings.spot_height_m))
        sigma = [100.0 * c.bounds[preset, settings.spot_height_m, d].relative for d in depths]
        ax.plot(depths, sigma, **_style(i))
    ax.set_yscale("log")
    ax.set_xlabel("distance D, m")
    ax.set_ylabel(f"bound of D, %, {preset}, spots at {settings.spot_height_m:g} m")


def _places(ax: Axes, found: Mapping[str, tables.MirrorComparison]) -> None:
    for i, c in enumerate(found.values()):
        padded = np.pad(c.places.measured.astype(float), 1)
        D, Z = (
            np.concatenate([[2 * x[0] - x[1]], x, [2 * x[-1] - x[-2]]]) for x in (c.places.depths_m, c.places.heights_m)
        )
        ax.contour(D, Z, padded, levels=[0.5], colors=[COLOURS[i]], linestyles=[LINES[i % len(LINES)]], linewidths=1.5)
    ax.set_xlabel("distance D, m")
    ax.set_ylabel("height of the spot, m: measured inside")


def _costs(ax: Axes, found: Mapping[str, tables.MirrorComparison], settings: tables.MirrorSettings) -> None:
    middle = settings.misaligned_m[len(settings.misaligned_m) // 2]
    kinds = list(misalignment_costs.DIRECTIONS)
    for i, c in enumerate(found.values()):
        cost = np.array([100.0 * c.costs[middle][kind] for kind in kinds])
        cost = np.where((cost >= _LEAST) & np.isfinite(cost), cost, np.nan)
        ax.plot(cost, np.arange(len(kinds)), MARKERS[i], color=COLOURS[i], markersize=5, linestyle="")
    ax.set_yticks(np.arange(len(kinds)), kinds, fontsize=7)
    ax.invert_yaxis()
    ax.set_xscale("log")
    ax.set_xlabel(f"error of D at {middle:g} m by a deviation of usual size, %")


STUDY = Study(
    "mirror",
    "Which mirror",
    "For equal rim, camera and stroke: which mirror sees what, how well does it measure D there, and how exactly must "
    "it be mounted?",
    tables.MirrorSettings,
    run,
)
