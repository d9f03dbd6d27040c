"""Study isotropy: occlusion, lines, noise and findings against independent expectations; a tiny run of the whole."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
from rich.console import Console
from scipy.optimize import brentq

from phibench.benchmark.scores.intervals import Estimate
from phibench.datasets.read import Dataset, open_dataset
from phibench.datasets.recipe.load import find_recipe, load_recipe
from phibench.estimator.geometry.epipolar_line import up_image
from phibench.estimator.geometry.panorama import PanoramaGrid
from phibench.render.sensor.settings import sensor
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.random_streams import generator
from phibench.scenes.room import default_rig
from phibench.studies.framework import StudyDatasets, read_settings
from phibench.studies.isotropy import binocular
from phibench.studies.isotropy.azimuth_errors import (
    AzimuthNoise,
    bound_m,
    circle,
    flat_pair,
    isotropy,
    scatter_findings,
    sideways_rig,
)
from phibench.studies.isotropy.lines import (
    best_line_distances,
    epipolar_line,
    half_width_rad,
    hidden_flags,
    hidden_share,
    line_distances,
    moved_rig,
    occlusion_findings,
)
from phibench.studies.isotropy.room_edges import SeenEdge
from phibench.studies.isotropy.study import STUDY, edge_findings, grid_findings

RIG = default_rig()
GRID = PanoramaGrid(1440, -0.35, 0.35)
DEPTHS = np.array([0.8, 1.5, 4.0])
LIGHT = np.array([3e4, 3e4, 2e4])


@pytest.mark.parametrize(("depth_m", "height_m"), [(1.0, 0.65), (2.5, 0.71), (4.0, 0.8), (2.5, 0.5)])
def test_hidden_azimuths_by_rays_are_those_of_the_closed_form(depth_m: float, height_m: float) -> None:
    """The first sensor is hidden from within +- the half width; the count of a circle is good to one step."""
    count = 20000
    found = hidden_flags(RIG.at(0.0), moved_rig(RIG, 0.425).at(0.0), circle(depth_m, height_m, count)).mean()
    expected = half_width_rad(RIG, 0.425, depth_m, height_m) / math.pi
    assert found == pytest.approx(expected, abs=2.5 / count)
    if height_m == 0.5:
        assert expected == 0.0  # the ray has fallen below the other mirror
    else:
        assert expected > 0.02


def test_level_rays_from_afar_give_the_arcsine() -> None:
    """A far spot at the height at which its ray leaves the mirror: the other sphere is seen under asin(r / b)."""

    def climb(height_m: float) -> float:
        from phibench.estimator.geometry.reflection import image_of, reflect

        view = RIG.at(0.0)
        return float(reflect(view, image_of(view, np.array([1e4, 0.0, height_m])).uv_px).direction_world[2])

    height = brentq(climb, 0.3, 1.0)
    drop = 0.71 - height
    expected = math.asin(math.sqrt(0.06**2 - drop**2) / 0.425)
    assert half_width_rad(RIG, 0.425, 1e4, height) == pytest.approx(expected, abs=1e-5)


def test_a_moving_sensor_hides_nothing_and_a_pair_does() -> None:
    pair, own = hidden_share(RIG, 0.425, circle(2.5, 0.71, 720))
    assert own == 0.0
    assert 0.05 < pair < 0.1


def test_lines_agree_with_the_epipolar_module() -> None:
    """`epipolar.up_image` moves the point against the stroke instead of the rig along it."""
    point = np.array([1.5, -2.0, 0.5])
    line = epipolar_line(RIG, RIG, 0.425, point, DEPTHS, GRID, False)
    expected = up_image(RIG, 0.425, line.down_px, 1.0 / DEPTHS).uv_px
    assert np.allclose(line.uv_px, expected, rtol=0.0, atol=1e-7)


def test_lines_are_radial_only_for_the_aligned_rig() -> None:
    point = np.array([1.5, -2.0, 0.5])
    aligned = epipolar_line(RIG, RIG, 0.425, point, DEPTHS, GRID, True)
    assert aligned.beside_radius_px < 1e-9
    # the quadrature over spot and lens is symmetric about the plane of incidence to rounding and the pixels' sums
    assert aligned.rendered_beside_px < 1e-3
    assert aligned.bend_px < 1e-7
    tilted = epipolar_line(RIG, RIG.perturbed(Misalignment(tilt_y_rad=0.0087)), 0.425, point, DEPTHS, GRID, True)
    assert tilted.beside_radius_px > 1.0
    assert tilted.rendered_beside_px == pytest.approx(tilted.beside_radius_px, abs=1e-3)
    assert tilted.bend_px > 1.0
    assert tilted.beside_line_px < 0.05


def test_distances_from_lines_by_hand() -> None:
    points = np.array([[0.0, 0.0], [1.0, 1.5], [2.0, 2.0]])
    assert line_distances(points, np.zeros(2), np.array([3.0, 3.0])) == pytest.approx([0.0, 0.5 / math.sqrt(2.0), 0.0])
    rng = generator("test", "isotropy", "line")
    noisy = np.stack([np.arange(9.0), 2.0 * np.arange(9.0)], axis=-1) + rng.normal(0.0, 0.1, (9, 2))
    best = best_line_distances(noisy)
    for turn in (-0.01, 0.01):  # no neighbouring line has a smaller sum of squares
        centre, slope = noisy.mean(axis=0), math.atan(2.0) + turn
        other = line_distances(noisy, centre, centre + [math.cos(slope), math.sin(slope)])
        assert np.sum(best**2) < np.sum(other**2) + 0.02


def _noise(rng: np.random.Generator, sigmas: np.ndarray, bounds: np.ndarray, draws: int = 60) -> list[AzimuthNoise]:
    return [
        AzimuthNoise(
            30.0 * i, 2.5, bound, Estimate(s, 0.9 * s, 1.1 * s), 0.1 * s, 0.01 * s, rng.normal(0.0, s, draws), 0
        )
        for i, (s, bound) in enumerate(zip(sigmas, bounds, strict=True))
    ]


@pytest.mark.slow
def test_isotropy_is_denied_as_rarely_as_stated() -> None:
    """300 sets of equal scatter, false alarms 5 %: 15 +- 3.8 expected, 4 sigma allowed; Brown-Forsythe errs low."""
    rng = generator("test", "isotropy", "alarms")
    ones = np.ones(12)
    alarms = sum(isotropy(_noise(rng, ones, ones), 0.05).p_value < 0.05 for _ in range(300))
    assert 2 <= alarms <= 30


def test_isotropy_is_denied_where_scatter_differs_and_explained_by_the_bound() -> None:
    """Scatter of a factor of two, 60 draws: the ratio of variances has 18 % standard error, so it is 15 sigma."""
    rng = generator("test", "isotropy", "power")
    sigmas = np.linspace(1.0, 2.0, 12)
    with_bound = [isotropy(_noise(rng, sigmas, sigmas), 0.01) for _ in range(20)]
    assert not any(one.p_value >= one.false_alarm for one in with_bound)
    assert sum(one.p_value_over_bound >= one.false_alarm for one in with_bound) >= 18
    without = [isotropy(_noise(rng, sigmas, np.ones(12)), 0.01) for _ in range(20)]
    assert not any(one.p_value_over_bound >= one.false_alarm for one in without)
    assert without[0].ratio == pytest.approx(2.0)


def test_the_horizontal_bound_grows_as_one_over_the_sine() -> None:
    """Parallax at the angle a from a baseline b: sigma_D ~ D^2 sigma / (b sin a), besides the pixel grid."""
    card = sensor("bayer-raw", read_noise_e=2.0)
    angles = np.radians([90.0, 20.0, 6.0])
    points = [np.array([2.5 * math.cos(a), 2.5 * math.sin(a), 0.5]) for a in angles]
    pairs = [flat_pair(sideways_rig(RIG), 0.425, point, LIGHT) for point in points]
    found = np.array([bound_m(pair, card) for pair in pairs if pair is not None])
    assert found.size == 3
    # the grid's factor is up to 2 (p95 over median, docs/limits.md); the sines' are 2.9 and 9.6
    assert 1.4 < found[1] / found[0] < 6.0
    assert 4.0 < found[2] / found[0] < 25.0
    assert found[0] < found[1] < found[2]


def test_a_spot_that_an_image_does_not_show_has_no_pair() -> None:
    assert flat_pair(RIG, 0.425, np.array([0.0, 0.0, 8.0]), LIGHT) is None


# -- findings ------------------------------------------------------------------------------------------------------


def test_isotropy_is_judged_as_tested() -> None:
    rng = generator("test", "isotropy", "words")
    noise = _noise(rng, np.ones(6), np.ones(6))
    test = isotropy(noise, 0.01)
    label, bound = (f"A: p of the same {x} at all azimuths" for x in ("scatter", "multiple of the bound"))
    found = {f.label: f for f in scatter_findings("A", noise, replace(test, p_value=0.5, p_value_over_bound=0.5))}
    assert (found[label].verdict, found[bound].verdict) == ("met", "met")
    assert found["A: smallest scatter of D"].value == pytest.approx(1e3)
    found = {f.label: f for f in scatter_findings("A", noise, replace(test, p_value=1e-12, p_value_over_bound=1e-5))}
    assert (found[label].verdict, found[bound].verdict) == ("missed", "missed")
    assert found[label].value == 1e-9  # smaller ones say no more


def test_too_few_azimuths_are_no_verdict() -> None:
    rng = generator("test", "isotropy", "few")
    noise = _noise(rng, np.ones(1), np.ones(1))
    found = list(scatter_findings("A", noise, isotropy(noise, 0.01)))
    assert not any(f.verdict for f in found)
    assert not any("p of" in f.label for f in found)


def test_the_grid_is_blamed_only_where_averaging_helps() -> None:
    single = np.array([1.0, 2.0])
    assert list(grid_findings(single, np.array([1.0, 1.1])))[1].verdict == "met"
    assert list(grid_findings(single, np.array([1.0, 1.9])))[1].verdict == "missed"


def test_occlusion_has_its_shares() -> None:
    hidden = pl.DataFrame({"height_m": [0.5], "pair": [0.07], "own": [0.0]})
    pair, own = occlusion_findings(hidden, 0.4)
    assert pair.label == "hidden from each other, two sensors 0.4 m apart, spot at 0.5 m"
    assert (pair.value, own.verdict) == (pytest.approx(7.0), "met")
    assert list(occlusion_findings(hidden.with_columns(own=0.02), 0.4))[1].verdict == "missed"


def test_edges_are_vertical_below_a_tenth_of_a_column() -> None:
    edge = SeenEdge("door", 10.0, 30, 0.02, 0.01, 0.0, 0.0, 0.02)
    lean = next(edge_findings("aligned", [edge]))
    assert (lean.value, lean.verdict) == (0.02, "met")
    lean = next(edge_findings("aligned", [replace(edge, lean_px=-0.4)]))
    assert (lean.value, lean.verdict) == (-0.4, "missed")
    assert not list(edge_findings("aligned", []))


# -- the whole -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["study-isotropy", "study-isotropy-sideways", "study-isotropy-tilted"])
def test_recipes_are_valid_and_share_boards_and_light(name: str) -> None:
    recipe, first = (load_recipe(find_recipe(each)) for each in (name, "study-isotropy"))
    assert recipe.targets == first.targets
    assert recipe.ambient == first.ambient
    assert {target.depth_m for target in recipe.targets} == {2.5}


class _Held:
    """Three data sets that are there already."""

    def __init__(self, held: dict[str, Dataset]) -> None:
        self._held = held

    def dataset(self, recipe: str, samples: int | None = None) -> Dataset:
        return self._held[recipe]


def test_tiny_study(
    tiny_dataset: Path, misaligned_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tests' own small data sets in place of the study's: no more than that all parts fit together."""
    aligned, wrong = open_dataset(tiny_dataset), open_dataset(misaligned_dataset)
    held: Any = _Held({"study-isotropy": aligned, "study-isotropy-sideways": aligned, "study-isotropy-tilted": wrong})
    changes = {
        "draws": 6,
        "bound_azimuths": 4,
        "grid_azimuths": 4,
        "occlusion_azimuths": 36,
        "line_azimuths": 2,
        "line_depths_m": (1.0, 2.0, 4.0),
        "panorama_width_px": 360,
        "resamples": 100,
    }
    monkeypatch.setattr(binocular, "_PLACES_PX", (0.25,))  # one place in the mosaic's cell, for sixteen
    result = STUDY.run(read_settings(STUDY, True).model_copy(update=changes), held)
    assert set(result.tables) == {"table", "bounds", "occlusion", "edges", "lines"}
    assert result.tables["lines"].height == 4
    assert len(result.drawings) == 3
    found = {finding.label: finding for finding in result.findings}
    for words in ("exact points beside the radius", "rendered spots beside the radius"):
        assert found[f"epipolar lines, aligned rig: {words}"].verdict == "met"
        assert found[f"epipolar lines, misaligned rig: {words}"].verdict == "missed"


def test_data_sets_come_from_the_shipped_recipes(tmp_path: Path) -> None:
    """The study asks for its three recipes by name, and no other."""
    asked = []

    def dataset(recipe: str) -> None:
        asked.append(recipe)
        if len(asked) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        STUDY.run(read_settings(STUDY, True), SimpleNamespace(dataset=dataset))  # type: ignore[arg-type]
    assert asked == ["study-isotropy", "study-isotropy-sideways", "study-isotropy-tilted"]
    assert StudyDatasets(tmp_path, Console(quiet=True)).folder == tmp_path
