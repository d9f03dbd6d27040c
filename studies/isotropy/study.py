"""Study `isotropy`: error of D against azimuth, baseline upright or sideways; lines and edges in panoramas; findings.

The horizontal baseline is the competitor that the paper names: the same sensor moved sideways by the same length, or
two of them. D counts from the vertical through the first position, in both cases. Epipolar lines and upright edges of
the room are followed in the image and in the panorama. The run comes first, then findings, then tables of the report.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
import polars as pl
from pydantic import Field

from phibench.benchmark.scores.answer_errors import Rules
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Dataset, Sample
from phibench.estimator.geometry.panorama import PanoramaGrid, pixels_by_model, unrolled_values
from phibench.estimator.geometry.phi import outline_circle
from phibench.render.sensor.settings import sensor
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig
from phibench.studies.framework import (
    Drawing,
    Finding,
    Heights,
    Names,
    Row,
    Settings,
    Study,
    StudyDatasets,
    StudyResult,
    canvas,
    finished_drawing,
    line_style,
    text_table,
)
from phibench.studies.isotropy.azimuth_errors import (
    NORMAL_95,
    AzimuthNoise,
    BaselinePair,
    azimuth_noise,
    bias_findings,
    bounds,
    bounds_over_grid,
    circle,
    isotropy,
    noise_drawing,
    noise_rows,
    noise_table,
    pairs_of,
    scatter_findings,
    sideways_rig,
)
from phibench.studies.isotropy.binocular import Binocular, Laws, binocular_results
from phibench.studies.isotropy.lines import (
    STRAIGHT_PX,
    Line,
    epipolar_line,
    half_width_rad,
    hidden_share,
    line_findings,
    line_table,
    lines_drawing,
    occlusion_findings,
)
from phibench.studies.isotropy.room_edges import SeenEdge, seen_edge, track, vertical_edges
from phibench.studies.misaligned_rigs import Places, errors

Depths = Annotated[tuple[Annotated[float, Field(gt=0.2, le=50.0)], ...], Field(min_length=3)]


class IsotropySettings(Settings):
    """Numbers of the study."""

    preset: Literal["bayer-raw"] = Field(description="sensor whose frames are drawn")
    draws: int = Field(ge=5, le=100000, description="frame pairs per spot and baseline")
    false_alarm: float = Field(gt=0.0, lt=0.5, description="probability of a false 'not isotropic'")
    bound_azimuths: int = Field(ge=4, le=720, description="of the bound's curve")
    grid_azimuths: int = Field(ge=4, le=720, description="of the bound averaged over the pixel grid")
    occlusion_heights_m: Heights
    occlusion_azimuths: int = Field(ge=36, le=100000)
    line_azimuths: int = Field(ge=2, le=360, description="epipolar lines, evenly around")
    line_depths_m: Depths
    panorama_width_px: int = Field(ge=360, le=16384)
    edges: Names = Field(description="shapes with upright edges")
    confidence: float = Field(gt=0.5, lt=1.0)
    resamples: int = Field(ge=100, le=100000, description="of the bootstrap")


VERTICAL, HORIZONTAL = "vertical stroke", "horizontal baseline"
_LOW_RAD, _HIGH_RAD = math.radians(-20.0), math.radians(20.0)  # elevations of the walls of a room


@dataclass(frozen=True)
class _Scene:
    """Shared by all parts: the aligned rig, the spots' circle, the light under the spots."""

    rig: Rig
    baseline_m: float
    depth_m: float
    height_m: float
    background: Array


def run(settings: IsotropySettings, datasets: StudyDatasets) -> StudyResult:
    """Run the study."""
    upright, moved, tilted = (
        datasets.dataset(name) for name in ("study-isotropy", "study-isotropy-sideways", "study-isotropy-tilted")
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
        *(row for name in noise for row in scatter_findings(name, noise[name], tests[name])),
        *(row for name in noise for row in bias_findings(name, noise[name])),
        *grid_findings(curves[VERTICAL], grid),
        *baseline_findings(azimuths, curves[VERTICAL], curves[HORIZONTAL], scene.baseline_m),
        *misaligned_findings(wrong, words),
        *occlusion_findings(hidden, scene.baseline_m),
        *binocular_results(
            Binocular(scene.rig, scene.baseline_m, scene.depth_m, scene.height_m),
            settings.occlusion_heights_m,
            Laws(draws=settings.draws),
            scene.background,
            sensor(settings.preset),
        ),
        *line_findings(*lines),
        *(row for name, found in edges.items() for row in edge_findings(name, found)),
    )
    return StudyResult(
        {
            "table": noise_table(noise),
            "bounds": pl.DataFrame(
                {"azimuth_deg": azimuths, **_columns(curves, "bound_m"), **_columns(wrong, "error")}
            ),
            "occlusion": hidden,
            "edges": pl.DataFrame([{"rig": name, **vars(e)} for name, found in edges.items() for e in found]),
            "lines": line_table(lines),
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


def _scene(pairs: Sequence[BaselinePair]) -> _Scene:
    first = pairs[0]
    light, (u, v) = first.lights[0], np.rint(first.uv_px[0]).astype(int)
    # the level under a spot: its median leaves edges out
    around = light.ambient_electrons_per_s[:, v - 4 : v + 5, u - 4 : u + 5]
    level = np.median(np.asarray(around, float), axis=(1, 2))
    return _Scene(first.rig, first.baseline_m, first.depth_m, float(first.point_m[2]), level)


def _noise(
    settings: IsotropySettings, pairs: dict[str, tuple[BaselinePair, ...]]
) -> dict[str, tuple[AzimuthNoise, ...]]:
    card, rules = sensor(settings.preset), Rules(confidence=settings.confidence, resamples=settings.resamples)
    return {
        name: tuple(azimuth_noise(pair, card, settings.draws, name, rules) for pair in each)
        for name, each in pairs.items()
    }


def _curves(settings: IsotropySettings, scene: _Scene) -> tuple[Array, dict[str, Array], Array, Array]:
    """Azimuths in degrees and bounds by baseline; azimuths and the vertical bound averaged over the pixel grid."""
    card = sensor(settings.preset)
    points = circle(scene.depth_m, scene.height_m, settings.bound_azimuths)
    rigs = {VERTICAL: scene.rig, HORIZONTAL: sideways_rig(scene.rig)}
    curves = {name: bounds(rig, scene.baseline_m, points, scene.background, card) for name, rig in rigs.items()}
    few = circle(scene.depth_m, scene.height_m, settings.grid_azimuths)
    averaged = bounds_over_grid(scene.rig, scene.baseline_m, few, scene.background, card)
    return _azimuths_deg(points), curves, _azimuths_deg(few), averaged


def _azimuths_deg(points_m: Array) -> Array:
    return np.asarray(np.degrees(np.arctan2(points_m[:, 1], points_m[:, 0])) % 360.0)


def _misalignment(dataset: Dataset) -> Misalignment:
    return Misalignment(**dataset.recipe.misalignment.model_dump())


def _misaligned(scene: _Scene, true: Misalignment, azimuths_deg: Array) -> dict[str, Array]:
    """Relative errors of the exact estimator with the aligned rig as nominal."""
    spots = Places(np.array([scene.depth_m]), np.radians(azimuths_deg), scene.height_m, scene.baseline_m)
    rigs = {VERTICAL: scene.rig, HORIZONTAL: sideways_rig(scene.rig)}
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
    grid = PanoramaGrid(settings.panorama_width_px, _LOW_RAD, _HIGH_RAD)
    points = circle(scene.depth_m, scene.height_m, settings.line_azimuths)
    depths = np.array(settings.line_depths_m)
    lines = []
    for m in (Misalignment(), true):
        rig, h = scene.rig.perturbed(m), m.stroke_m(scene.baseline_m)
        lines.append(tuple(epipolar_line(scene.rig, rig, h, point, depths, grid, True) for point in points))
    return lines[0], lines[1]


def _edges(settings: IsotropySettings, dataset: Dataset) -> tuple[SeenEdge, ...]:
    """Upright edges in the down view's noise-free panorama, unrolled with the nominal rig."""
    sample: Sample = dataset.samples[0]
    grid = PanoramaGrid(settings.panorama_width_px, _LOW_RAD, _HIGH_RAD)
    nominal = sample.nominal_rig.at(0.0)
    image = unrolled_values(np.asarray(sample.ambient("down"), float).sum(axis=0), pixels_by_model(nominal, grid))
    edges = vertical_edges(dataset.room, settings.edges)
    edges_seen = (seen_edge(image, grid, e.name, track(sample.rig.at(0.0), nominal, grid, e)) for e in edges)
    return tuple(edge for edge in edges_seen if edge is not None)


def _columns(values: dict[str, Array], what: str) -> dict[str, Array]:
    return {f"{name.split()[0]}_{what}": each for name, each in values.items()}


def _notes(noise: dict[str, tuple[AzimuthNoise, ...]]) -> tuple[str, ...]:
    lost = {name: sum(row.missing for row in rows) for name, rows in noise.items()}
    missing = [f"{name}: {n} fits found no spot and are left out" for name, n in lost.items() if n]
    return (
        *missing,
        "the horizontal data set keeps 1 mm of stroke, which the estimator knows; no board lies nearer than 15 degrees "
        "to the baseline's direction",
    )


# -- findings ------------------------------------------------------------------------------------------------------


def grid_findings(single: Array, averaged: Array) -> Iterator[Finding]:
    """Largest over smallest bound of the vertical stroke, for one place in a Bayer cell and averaged over places.

    The mosaic's grid makes the difference where averaging takes away more than half of the excess over 1.
    """
    of_single, mean = ratio(single), ratio(averaged)
    yield Finding("even background: largest over smallest bound", of_single)
    yield Finding("even background: the same, averaged over places in a Bayer cell", mean).judged(
        "<=", 1.0 + 0.5 * (of_single - 1.0)
    )


def baseline_findings(azimuths_deg: Array, vertical: Array, horizontal: Array, baseline_m: float) -> Iterator[Finding]:
    """Bounds of both baselines at the same length, and the share of azimuths at which the horizontal one is smaller."""
    seen = np.isfinite(horizontal) & np.isfinite(vertical)
    from_it = np.degrees(np.arcsin(np.abs(np.sin(np.radians(azimuths_deg)))))
    yield Finding("length of both baselines", baseline_m, unit="m")
    yield Finding(f"bound, {VERTICAL}, rms over azimuths", 1e3 * np.sqrt(np.mean(vertical[seen] ** 2)), unit="mm")
    for word, each in (("across it", -from_it), ("nearest to its direction", from_it)):
        i = int(np.argmin(np.where(seen, each, np.inf)))
        yield Finding(f"bound, {HORIZONTAL}, {word}", 1e3 * horizontal[i], unit="mm")
        yield Finding(f"bound, {HORIZONTAL}, {word}: angle from its direction", from_it[i], unit="deg")
    better = 100.0 * float(np.mean(horizontal[seen] < vertical[seen]))
    yield Finding("azimuths at which the horizontal baseline has the smaller bound", better, unit="%")


def misaligned_findings(errors_by_baseline: Mapping[str, Array], words: str) -> Iterator[Finding]:
    """Ends of the relative error over azimuths, with nominal numbers of a misaligned rig."""
    for name, values in errors_by_baseline.items():
        for word, value in (("smallest", np.nanmin(values)), ("largest", np.nanmax(values))):
            yield Finding(f"{name}, {words}: {word} error of D", 100.0 * value, unit="%")
        count = int(np.count_nonzero(np.isfinite(values)))
        yield Finding(f"{name}, {words}: azimuths with an estimate", count, unit=f"of {values.size}")


def edge_findings(name: str, edges: Sequence[SeenEdge]) -> Iterator[Finding]:
    """Largest lean of the room's upright edges in the panorama, and its largest difference from the prediction."""
    if edges:
        worst = max(edges, key=lambda edge: abs(edge.lean_px))
        lean, half = worst.lean_px, NORMAL_95 * worst.lean_sigma_px
        size = Finding("", abs(lean), max(abs(lean) - half, 0.0), abs(lean) + half).judged("<=", STRAIGHT_PX)
        label = f"upright edges, {name} rig: largest lean (threshold: of its size)"
        yield replace(size, label=label, value=lean, low=lean - half, high=lean + half, unit="columns")
        yield Finding(f"upright edges, {name} rig: rows of the edge with the largest lean", worst.rows)
        miss = max(abs(edge.lean_px - edge.expected_lean_px) for edge in edges)
        yield Finding(f"upright edges, {name} rig: largest difference from the prediction", miss, unit="columns")


# -- small tables of the report ----------------------------------------------------------------------------------------


def edge_rows(edges: Mapping[str, Sequence[SeenEdge]]) -> tuple[Row, ...]:
    """Table: upright edges in the panorama."""
    return text_table(
        ((name, edge) for name, rows in edges.items() for edge in rows),
        {
            "rig": lambda row: row[0],
            "edge": lambda row: row[1].name,
            "azimuth, degrees": lambda row: f"{row[1].azimuth_deg:.1f}",
            "rows": lambda row: str(row[1].rows),
            "lean, columns": lambda row: f"{row[1].lean_px:+.3f} +- {row[1].lean_sigma_px:.3f}",
            "predicted": lambda row: f"{row[1].expected_lean_px:+.3f}",
            "offset, columns": lambda row: f"{row[1].offset_px:+.3f}",
        },
    )


def ratio(values: Array) -> float:
    """Largest over smallest; NaN without any."""
    known = values[np.isfinite(values)]
    return float(known.max() / known.min()) if known.size else math.nan


# -- drawing -----------------------------------------------------------------------------------------------------------


def misaligned_drawing(azimuths_deg: Array, errors: dict[str, Array], words: str) -> Drawing:
    """Relative error of the exact estimator with nominal numbers against azimuth."""
    with canvas(9.0, 3.6) as figure:
        ax = figure.subplots()
        for i, (name, values) in enumerate(errors.items()):
            ax.plot(azimuths_deg, 100.0 * values, label=name, **{**line_style(i), "marker": ""})
        ax.set(xlabel="azimuth of the spot, degrees", ylabel="error of D, %", title=words)
        ax.set_yscale("symlog", linthresh=1.0)
        ax.set_xticks(range(0, 361, 45))
        ax.legend()
        parts = "; ".join(f"{k} {100 * np.nanmin(v):+.2g} to {100 * np.nanmax(v):+.2g} %" for k, v in errors.items())
        return finished_drawing("misaligned", figure, f"Error of D of a misaligned rig against the azimuth: {parts}.")


STUDY = Study(
    "isotropy",
    "Isotropy and epipolar geometry",
    "Is the error of D the same at all azimuths, does a sensor hide itself, and are epipolar lines radial?",
    IsotropySettings,
    run,
)
