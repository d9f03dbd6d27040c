"""Settings of the study `isotropy`.

What the study `isotropy` says: sentences from numbers.

Study: the error of D against the azimuth, for the vertical stroke and for a horizontal baseline; epipolar lines.

The horizontal baseline is the competitor that the paper names: the same sensor moved sideways by the same length, or
two of them. D counts from the vertical through the first position, in both cases.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import polars as pl
from pydantic import BeforeValidator, Field

from phibench.datasets.errors import DatasetError
from phibench.datasets.read import Dataset, Sample
from phibench.estimator.benchmark.answer_errors import Rules
from phibench.estimator.geometry.panorama import (
    Grid,
    SeenEdge,
    pixels_by_model,
    seen_edge,
    track,
    unrolled,
    vertical_edges,
)
from phibench.estimator.geometry.phi import outline_circle
from phibench.estimator.studies.framework import Material, Result, Row, Settings, Study
from phibench.estimator.studies.isotropy.drawings import lines_drawing, misaligned_drawing, noise_drawing
from phibench.estimator.studies.isotropy.lines import Line, epipolar_line, half_width_rad, hidden_share
from phibench.estimator.studies.isotropy.noise import (
    AzimuthNoise,
    Isotropy,
    Pair,
    azimuth_noise,
    bounds,
    bounds_over_grid,
    circle,
    isotropy,
    pairs_of,
    sideways,
)
from phibench.estimator.studies.misaligned_rigs import Places, errors
from phibench.render.sensor.settings import sensor
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig


def _tuples(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


Height = Annotated[float, Field(ge=0.0, le=3.0)]
Depth = Annotated[float, Field(gt=0.2, le=50.0)]


class IsotropySettings(Settings):
    """Numbers of the study."""

    preset: Literal["bayer-raw"] = Field(description="sensor whose frames are drawn")
    draws: int = Field(ge=5, le=100000, description="frame pairs per spot and baseline")
    false_alarm: float = Field(gt=0.0, lt=0.5, description="probability of a false 'not isotropic'")
    bound_azimuths: int = Field(ge=4, le=720, description="of the bound's curve")
    grid_azimuths: int = Field(ge=4, le=720, description="of the bound averaged over the pixel grid")
    occlusion_heights_m: Annotated[tuple[Height, ...], BeforeValidator(_tuples)] = Field(min_length=1)
    occlusion_azimuths: int = Field(ge=36, le=100000)
    line_azimuths: int = Field(ge=2, le=360, description="epipolar lines, evenly around")
    line_depths_m: Annotated[tuple[Depth, ...], BeforeValidator(_tuples)] = Field(min_length=3)
    panorama_width_px: int = Field(ge=360, le=16384)
    edges: Annotated[tuple[str, ...], BeforeValidator(_tuples)] = Field(description="shapes with upright edges")
    confidence: float = Field(gt=0.5, lt=1.0)
    resamples: int = Field(ge=100, le=100000, description="of the bootstrap")


_LEAST_P = 1e-9  # smaller ones say no more
_STRAIGHT_PX = 0.1  # a tenth of a pixel matters, less does not


def noise_sentence(name: str, noise: Sequence[AzimuthNoise], test: Isotropy) -> str:
    """Scatter of one baseline, and whether it depends on the azimuth."""
    least = min(noise, key=lambda one: one.scatter_m.value)
    most = max(noise, key=lambda one: one.scatter_m.value)
    if not test.tested:
        return f"{name}: too few azimuths for a test of isotropy; the scatter of D is {_scatter(least)}."
    verdict = "isotropic" if test.isotropic else "not isotropic"
    follows = "is the same everywhere" if test.explained else "still differs"
    over_bound = _probability(test.p_value_over_bound)
    return (
        f"{name}: at D = {least.depth_m:.3g} m the noise of D is {verdict} ({_probability(test.p_value)}, "
        f"false alarms {100.0 * test.false_alarm:g} %): {_scatter(least)} to {_scatter(most)}, a factor of "
        f"{test.ratio:.2g}; as a multiple of each spot's own bound it {follows} ({over_bound})."
    )


def bias_sentence(name: str, noise: Sequence[AzimuthNoise]) -> str:
    """Largest systematic error of the likelihood fits."""
    usable = [one for one in noise if one.errors_m.size > 1]
    if not usable:
        return f"{name}: too few estimates for a mean error."
    worst = max(usable, key=lambda one: abs(one.bias_m))
    share = abs(worst.bias_m) / worst.scatter_m.value
    return (
        f"{name}: the mean error is at most {1e3 * abs(worst.bias_m):.2g} +- {1e3 * worst.bias_sigma_m:.1g} mm, "
        f"{share:.2g} of the scatter there (azimuth {worst.azimuth_deg:.0f} degrees)."
    )


def grid_sentence(single: Array, averaged: Array) -> str:
    """What the mosaic does to the isotropy of the vertical stroke."""
    one, mean = ratio(single), ratio(averaged)
    cause = "the mosaic's grid makes the difference" if mean - 1.0 < 0.5 * (one - 1.0) else "the grid is not the cause"
    return (
        f"On an even background the vertical stroke's bound varies by a factor of {one:.2f} with the azimuth, and of "
        f"{mean:.3f} once averaged over places in a Bayer cell: {cause}."
    )


def baseline_sentence(
    azimuths_deg: Array, vertical: Array, horizontal: Array, depth_m: float, baseline_m: float
) -> str:
    """Where each baseline is better."""
    seen = np.isfinite(horizontal) & np.isfinite(vertical)
    better = float(np.mean(horizontal[seen] < vertical[seen]))
    from_it = np.degrees(np.arcsin(np.abs(np.sin(np.radians(azimuths_deg)))))
    near, across = (int(np.argmin(np.where(seen, each, np.inf))) for each in (from_it, -from_it))
    return (
        f"At the same length ({baseline_m:.3g} m) and D = {depth_m:.3g} m the horizontal baseline's bound is "
        f"{1e3 * horizontal[across]:.2g} mm at {from_it[across]:.2g} degrees from its direction and "
        f"{1e3 * horizontal[near]:.2g} mm at {from_it[near]:.2g} degrees, against "
        f"{1e3 * np.sqrt(np.mean(vertical[seen] ** 2)):.2g} mm (rms) of the vertical stroke; it is the smaller one at "
        f"{100.0 * better:.0f} % of the azimuths."
    )


def misaligned_sentence(vertical: Array, horizontal: Array, words: str) -> str:
    """What a misalignment does to isotropy; relative errors over azimuths."""
    return (
        f"With {words} the exact estimator's error with nominal numbers runs from {_percent(np.nanmin(vertical))} to "
        f"{_percent(np.nanmax(vertical))} % of D around the vertical stroke, and from "
        f"{_percent(np.nanmin(horizontal))} to {_percent(np.nanmax(horizontal))} % around the horizontal baseline "
        f"({np.count_nonzero(np.isfinite(horizontal))} of {horizontal.size} azimuths have an estimate)."
    )


def occlusion_sentence(heights_m: Sequence[float], pair: Sequence[float], own: Sequence[float], apart_m: float) -> str:
    """Who hides whom."""
    parts = ", ".join(f"{100.0 * share:.2g} % at {height:g} m" for height, share in zip(heights_m, pair, strict=True))
    single = max(own)
    moving = "nothing" if single == 0.0 else f"up to {100.0 * single:.2g} %"
    return (
        f"Two fixed sensors {apart_m:.3g} m apart hide from each other these shares of all azimuths, by height of the "
        f"spot: {parts}; one sensor that moves hides {moving} from itself."
    )


def line_sentence(aligned: Sequence[Line], tilted: Sequence[Line]) -> str:
    """Whether epipolar lines are radial, and vertical in the panorama."""
    exact = max(line.beside_radius_px for line in aligned)
    rendered = max(line.rendered_beside_px for line in aligned)
    bend = max(line.bend_px for line in aligned)
    verdict = "radial" if max(exact, rendered) < _STRAIGHT_PX else "not radial"
    off, straight = max(line.beside_radius_px for line in tilted), max(line.beside_line_px for line in tilted)
    column = max(line.bend_px for line in tilted)
    return (
        f"Epipolar lines of the aligned rig are {verdict} in the image: exact points lie within {exact:.1e} px and "
        f"rendered spots within {rendered:.1e} px of the down pixel's radius, and in the panorama within {bend:.1e} "
        f"columns; of the misaligned rig they leave it by up to {off:.2g} px and {column:.2g} columns, and lie within "
        f"{straight:.2g} px of a straight line."
    )


def edge_sentence(name: str, edges: Sequence[SeenEdge]) -> str:
    """Whether upright edges of the room are vertical in the panorama."""
    if not edges:
        return f"No upright edge was measured in the panorama of the {name} rig."
    worst = max(edges, key=lambda edge: abs(edge.lean_px))
    miss = max(abs(edge.lean_px - edge.expected_lean_px) for edge in edges)
    upright = "vertical" if abs(worst.lean_px) < _STRAIGHT_PX else "not vertical"
    return (
        f"In the panorama of the {name} rig upright edges are {upright}: the largest lean is "
        f"{worst.lean_px:+.2f} +- {1.96 * worst.lean_sigma_px:.2f} columns over {worst.rows} rows ({worst.name}), "
        f"and the leans differ from the predicted ones by at most {miss:.2f}."
    )


def noise_rows(noise: Mapping[str, Sequence[AzimuthNoise]]) -> tuple[Row, ...]:
    """Table: scatter, interval, bound and bias per baseline and azimuth."""
    heads = ("baseline", "azimuth, degrees", "bound, mm", "scatter, mm (95 %)", "bias, mm", "fits missing")
    return (
        heads,
        *(
            (
                name,
                f"{one.azimuth_deg:.0f}",
                f"{1e3 * one.bound_m:.2f}",
                _interval(one),
                f"{1e3 * one.bias_m:+.2f} +- {1e3 * one.bias_sigma_m:.2f}",
                str(one.missing),
            )
            for name, rows in noise.items()
            for one in rows
        ),
    )


def edge_rows(edges: Mapping[str, Sequence[SeenEdge]]) -> tuple[Row, ...]:
    """Table: upright edges in the panorama."""
    heads = ("rig", "edge", "azimuth, degrees", "rows", "lean, columns", "predicted", "offset, columns")
    return (
        heads,
        *(
            (
                name,
                edge.name,
                f"{edge.azimuth_deg:.1f}",
                str(edge.rows),
                f"{edge.lean_px:+.3f} +- {edge.lean_sigma_px:.3f}",
                f"{edge.expected_lean_px:+.3f}",
                f"{edge.offset_px:+.3f}",
            )
            for name, rows in edges.items()
            for edge in rows
        ),
    )


def ratio(values: Array) -> float:
    """Largest over smallest; NaN without any."""
    known = values[np.isfinite(values)]
    return float(known.max() / known.min()) if known.size else math.nan


def _probability(p: float) -> str:
    return f"p = {p:.2g}" if p >= _LEAST_P else f"p below {_LEAST_P:g}"


def _scatter(one: AzimuthNoise) -> str:
    return f"{_interval(one)} mm at {one.azimuth_deg:.0f} degrees"


def _interval(one: AzimuthNoise) -> str:
    s = one.scatter_m
    return f"{1e3 * s.value:.2f} ({1e3 * s.low:.2f} to {1e3 * s.high:.2f})"


def _percent(relative: float) -> str:
    return f"{100.0 * relative:+.2g}"


VERTICAL, HORIZONTAL = "vertical stroke", "horizontal baseline"
_LOW_RAD, _HIGH_RAD = math.radians(-20.0), math.radians(20.0)


@dataclass(frozen=True)
class _Scene:
    """What all parts share: the aligned rig, the spots' circle, the light under the spots."""

    rig: Rig
    baseline_m: float
    depth_m: float
    height_m: float
    background: Array


def run(settings: IsotropySettings, material: Material) -> Result:
    """Run the study."""
    upright, moved, tilted = (
        material.dataset(name) for name in ("study-isotropy", "study-isotropy-sideways", "study-isotropy-tilted")
    )
    pairs = {VERTICAL: tuple(pairs_of(upright)), HORIZONTAL: tuple(pairs_of(moved))}
    for name, each in pairs.items():
        if not each:
            raise DatasetError(
                f"{name}: the data set has no spot that both images show; render it again from its recipe"
            )
    scene = _scene(pairs[VERTICAL])
    noise = _noise(settings, pairs)
    tests = {name: isotropy(rows, settings.false_alarm) for name, rows in noise.items()}
    azimuths, curves, few, grid = _curves(settings, scene)
    true = _misalignment(tilted)
    wrong = _misaligned(scene, true, azimuths)
    hidden = _occlusion(settings, scene)
    lines = _lines(settings, scene, true)
    edges = {"aligned": _edges(settings, upright), "misaligned": _edges(settings, tilted)}
    words = f"tilt_y {math.degrees(true.tilt_y_rad):.2g} deg and decentre_y {1e3 * true.decentre_y_m:.2g} mm"
    findings = (
        *(noise_sentence(name, noise[name], tests[name]) for name in noise),
        *(bias_sentence(name, noise[name]) for name in noise),
        grid_sentence(curves[VERTICAL], grid),
        baseline_sentence(azimuths, curves[VERTICAL], curves[HORIZONTAL], scene.depth_m, scene.baseline_m),
        misaligned_sentence(wrong[VERTICAL], wrong[HORIZONTAL], words),
        occlusion_sentence(
            settings.occlusion_heights_m, hidden["pair"].to_list(), hidden["own"].to_list(), scene.baseline_m
        ),
        line_sentence(*lines),
        *(edge_sentence(name, found) for name, found in edges.items()),
    )
    return Result(
        {
            "table": _noise_table(noise),
            "bounds": pl.DataFrame(
                {"azimuth_deg": azimuths, **_columns(curves, "bound_m"), **_columns(wrong, "error")}
            ),
            "occlusion": hidden,
            "edges": pl.DataFrame([{"rig": name, **vars(e)} for name, found in edges.items() for e in found]),
            "lines": _line_table(lines),
        },
        findings,
        (
            noise_drawing(
                {
                    **{name: (azimuths, curve) for name, curve in curves.items()},
                    f"{VERTICAL}, mean over pixels": (few, grid),
                },
                noise,
            ),
            misaligned_drawing(azimuths, wrong, words),
            lines_drawing(*lines, outline_circle(scene.rig)[0]),
        ),
        {"Noise of D by azimuth": noise_rows(noise), "Upright edges in the panorama": edge_rows(edges)},
        _notes(noise),
    )


def _scene(pairs: Sequence[Pair]) -> _Scene:
    first = pairs[0]
    light, (u, v) = first.lights[0], np.rint(first.uv_px[0]).astype(int)
    around = light.ambient_electrons_per_s[:, v - 4 : v + 5, u - 4 : u + 5]
    level = np.median(np.asarray(around, float), axis=(1, 2))
    return _Scene(first.rig, first.baseline_m, first.depth_m, float(first.point_m[2]), level)


def _noise(settings: IsotropySettings, pairs: dict[str, tuple[Pair, ...]]) -> dict[str, tuple[AzimuthNoise, ...]]:
    card, rules = sensor(settings.preset), Rules(confidence=settings.confidence, resamples=settings.resamples)
    return {
        name: tuple(azimuth_noise(pair, card, settings.draws, name, rules) for pair in each)
        for name, each in pairs.items()
    }


def _curves(settings: IsotropySettings, scene: _Scene) -> tuple[Array, dict[str, Array], Array, Array]:
    """Azimuths in degrees and bounds by baseline; azimuths and the vertical bound averaged over the pixel grid."""
    card = sensor(settings.preset)
    points = circle(scene.depth_m, scene.height_m, settings.bound_azimuths)
    rigs = {VERTICAL: scene.rig, HORIZONTAL: sideways(scene.rig)}
    curves = {name: bounds(rig, scene.baseline_m, points, scene.background, card) for name, rig in rigs.items()}
    few = circle(scene.depth_m, scene.height_m, settings.grid_azimuths)
    averaged = bounds_over_grid(scene.rig, scene.baseline_m, few, scene.background, card)
    return _azimuths_deg(points), curves, _azimuths_deg(few), averaged


def _azimuths_deg(points_m: Array) -> Array:
    return np.asarray(np.degrees(np.arctan2(points_m[:, 1], points_m[:, 0])) % 360.0)


def _misalignment(dataset: Dataset) -> Misalignment:
    return Misalignment(**dataset.recipe.misalignment.model_dump())


def _misaligned(scene: _Scene, true: Misalignment, azimuths_deg: Array) -> dict[str, Array]:
    """Relative errors of the exact estimator that believes the aligned rig."""
    spots = Places(np.array([scene.depth_m]), np.radians(azimuths_deg), scene.height_m, scene.baseline_m)
    rigs = {VERTICAL: scene.rig, HORIZONTAL: sideways(scene.rig)}
    return {name: errors(rig, true, spots, ("exact",))[0, 0] for name, rig in rigs.items()}


def _occlusion(settings: IsotropySettings, scene: _Scene) -> pl.DataFrame:
    rows = []
    for height in settings.occlusion_heights_m:
        points = circle(scene.depth_m, height, settings.occlusion_azimuths)
        pair, own = hidden_share(scene.rig, scene.baseline_m, points)
        half = half_width_rad(scene.rig, scene.baseline_m, scene.depth_m, height)
        rows.append({"height_m": height, "pair": pair, "own": own, "first_by_mirror_closed_form": half / math.pi})
    return pl.DataFrame(rows)


def _lines(settings: IsotropySettings, scene: _Scene, true: Misalignment) -> tuple[tuple[Line, ...], tuple[Line, ...]]:
    """Epipolar lines of the aligned and of the misaligned rig."""
    grid = Grid(settings.panorama_width_px, _LOW_RAD, _HIGH_RAD)
    points = circle(scene.depth_m, scene.height_m, settings.line_azimuths)
    depths = np.array(settings.line_depths_m)
    found = []
    for m in (Misalignment(), true):
        rig, h = scene.rig.perturbed(m), m.stroke_m(scene.baseline_m)
        found.append(tuple(epipolar_line(scene.rig, rig, h, point, depths, grid, True) for point in points))
    return found[0], found[1]


def _edges(settings: IsotropySettings, dataset: Dataset) -> tuple[SeenEdge, ...]:
    """Upright edges in the down view's noise-free panorama, unrolled with the nominal rig."""
    sample: Sample = dataset.samples[0]
    grid = Grid(settings.panorama_width_px, _LOW_RAD, _HIGH_RAD)
    nominal = sample.nominal_rig.at(0.0)
    image = unrolled(np.asarray(sample.ambient("down"), float).sum(axis=0), pixels_by_model(nominal, grid))
    edges = vertical_edges(dataset.room, settings.edges)
    found = (seen_edge(image, grid, e.name, track(sample.rig.at(0.0), nominal, grid, e)) for e in edges)
    return tuple(edge for edge in found if edge is not None)


def _noise_table(noise: dict[str, tuple[AzimuthNoise, ...]]) -> pl.DataFrame:
    return pl.DataFrame(
        [
            {
                "baseline": name,
                "azimuth_deg": one.azimuth_deg,
                "depth_m": one.depth_m,
                "bound_m": one.bound_m,
                "scatter_m": one.scatter_m.value,
                "scatter_low_m": one.scatter_m.low,
                "scatter_high_m": one.scatter_m.high,
                "bias_m": one.bias_m,
                "bias_sigma_m": one.bias_sigma_m,
                "draws": len(one.errors_m),
                "missing": one.missing,
            }
            for name, rows in noise.items()
            for one in rows
        ]
    )


def _line_table(lines: tuple[tuple[Line, ...], tuple[Line, ...]]) -> pl.DataFrame:
    return pl.DataFrame(
        [
            {
                "rig": name,
                "down_u_px": float(line.down_px[0]),
                "down_v_px": float(line.down_px[1]),
                "beside_radius_px": line.beside_radius_px,
                "beside_line_px": line.beside_line_px,
                "rendered_beside_px": line.rendered_beside_px,
                "panorama_bend_px": line.bend_px,
            }
            for name, each in zip(("aligned", "misaligned"), lines, strict=True)
            for line in each
        ]
    )


def _columns(values: dict[str, Array], what: str) -> dict[str, Array]:
    return {f"{name.split()[0]}_{what}": each for name, each in values.items()}


def _notes(noise: dict[str, tuple[AzimuthNoise, ...]]) -> tuple[str, ...]:
    lost = {name: sum(one.missing for one in rows) for name, rows in noise.items()}
    missing = [f"{name}: {n} fits found no spot and are left out" for name, n in lost.items() if n]
    return (
        *missing,
        "the horizontal data set keeps 1 mm of stroke, which the estimator knows; no board lies nearer than 15 degrees "
        "to the baseline's direction",
    )


STUDY = Study(
    "isotropy",
    "Isotropy and epipolar geometry",
    "Is the error of D the same at all azimuths, does a sensor hide itself, and are epipolar lines radial?",
    IsotropySettings,
    run,
)
