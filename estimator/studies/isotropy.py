"""Study: the error of D against the azimuth, for the vertical stroke and for a horizontal baseline; epipolar lines.

The horizontal baseline is the competitor that the paper names: the same sensor moved sideways by the same length, or
two of them. D counts from the vertical through the first position, in both cases.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from phibench.datasets.errors import DatasetError
from phibench.datasets.read import Dataset, Sample
from phibench.estimator.bench.rules import Rules
from phibench.estimator.panorama import Grid, pixels_by_model, unrolled
from phibench.estimator.panorama_edges import SeenEdge, seen_edge, track, vertical_edges
from phibench.estimator.phi import outline_circle
from phibench.estimator.studies.baselines import Pair, pairs_of, sideways
from phibench.estimator.studies.isotropy_drawings import lines_drawing, misaligned_drawing, noise_drawing
from phibench.estimator.studies.isotropy_lines import Line, epipolar_line
from phibench.estimator.studies.isotropy_noise import (
    AzimuthNoise,
    azimuth_noise,
    bounds,
    bounds_over_grid,
    circle,
    isotropy,
)
from phibench.estimator.studies.isotropy_settings import IsotropySettings
from phibench.estimator.studies.isotropy_words import (
    baseline_sentence,
    bias_sentence,
    edge_rows,
    edge_sentence,
    grid_sentence,
    line_sentence,
    misaligned_sentence,
    noise_rows,
    noise_sentence,
    occlusion_sentence,
)
from phibench.estimator.studies.material import Material
from phibench.estimator.studies.misaligned import Places, errors
from phibench.estimator.studies.mutual_occlusion import half_width_rad, hidden_share
from phibench.estimator.studies.result import Result
from phibench.estimator.studies.study import Study
from phibench.render.sensor import sensor
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig

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
    believed = sample.nominal_rig.at(0.0)
    image = unrolled(np.asarray(sample.ambient("down"), float).sum(axis=0), pixels_by_model(believed, grid))
    edges = vertical_edges(dataset.room, settings.edges)
    found = (seen_edge(image, grid, e.name, track(sample.rig.at(0.0), believed, grid, e)) for e in edges)
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
