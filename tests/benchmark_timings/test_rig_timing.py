"""Times of what misaligned rigs need, `pytest --benchmark-enable --benchmark-only`: ratios within one run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from helpers.revolved_rigs import revolved

from phibench.datasets.frames.sensor_card import card_of
from phibench.estimator.geometry.panorama import PanoramaGrid, pixels_by_model, unrolled_values
from phibench.estimator.limits.best_stroke import best_stroke, spot_bound
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.room.ambient_layer import render_ambient
from phibench.render.room.light_map import BakeSettings, bake
from phibench.render.sensor.settings import sensor
from phibench.scenes.form_error import Form
from phibench.scenes.laser import Beam, LaserSpot, beam_diameter_m
from phibench.scenes.rig import Rig
from phibench.scenes.room import default_rig, lab

SPOT = LaserSpot((2.0, 0.5, 0.5), (-2.0, -0.5, 0.0), beam_diameter_m(2.06))
FORMS = {"sphere": None, "form error": Form(form_20_m=2e-5, form_31c_m=-1e-5)}


@pytest.mark.benchmark(group="form")
@pytest.mark.parametrize("mirror", FORMS)
def test_benchmark_spot_layer(benchmark, mirror: str) -> None:
    rig = Rig()
    view = replace(rig, mirror=replace(rig.mirror, form=FORMS[mirror])).at(0.0)
    assert benchmark(lambda: spot_layer(view, SPOT, ())).electrons_per_s.sum() > 0.0


def ratio(ours: Callable[[], object], sphere: Callable[[], object], rounds: int) -> float:
    """Median ratio of CPU times, taken alternately after a first round."""
    seconds = np.zeros((rounds + 1, 2))
    for row in seconds:
        for i, function in enumerate((ours, sphere)):
            began = time.process_time()
            function()
            row[i] = time.process_time() - began
    return float(np.median(seconds[1:, 0] / seconds[1:, 1]))


@pytest.mark.benchmark(group="mirrors")
@pytest.mark.parametrize("shape", ["sphere", "paraboloid", "hyperboloid", "cone", "polynomial"])
def test_benchmark_price_of_a_mirror_of_revolution(benchmark, shape: str) -> None:
    """Spot layer and view against the default sphere's: at most 1.5 times.

    Both views are of the same room, by a coarse light map.
    """
    if benchmark.disabled:
        pytest.skip("a benchmark")
    # a cone of 90 degrees sees what is above its tip
    spot = replace(SPOT, position_world_m=(2.0, 0.5, 1.2)) if shape == "cone" else SPOT
    view, sphere = revolved(shape).at(0.3), default_rig().at(0.3)
    room = lab()
    settings = BakeSettings(texel_m=0.5, lamp_rays=4, bounces=2, bounce_rays=8, final_rays=8)
    light = bake(sphere, room, settings)
    benchmark(lambda: spot_layer(view, spot, ()))
    spots = ratio(lambda: spot_layer(view, spot, ()), lambda: spot_layer(sphere, SPOT, ()), 30)
    views = ratio(
        lambda: render_ambient(view, room, light, settings, 2, 0),
        lambda: render_ambient(sphere, room, light, settings, 2, 0),
        3,
    )
    print(f"\n{shape}: spot layer {spots:.2f}, view {views:.2f} of the sphere's")
    assert spots <= 1.5
    assert views <= 1.5


@pytest.mark.benchmark(group="panorama")
def test_benchmark_panorama_by_the_model(benchmark) -> None:
    """1440 x 360 pixels, geometry and interpolation."""
    view, grid = Rig().at(0.0), PanoramaGrid(1440, math.radians(-60.0), math.radians(30.0))
    image = np.ones((720, 1280, 3))
    found = benchmark.pedantic(lambda: unrolled_values(image, pixels_by_model(view, grid)), rounds=3)
    assert found.shape == (grid.height_px, 1440, 3)


@pytest.mark.benchmark(group="planning")
def test_benchmark_blur_with_the_beam(benchmark) -> None:
    rig, beam = Rig(), Beam()
    assert benchmark(lambda: spot_blur(rig, (430.0, 300.0), 2.0, beam)).sigma_px > 0.7


@pytest.mark.benchmark(group="planning")
@pytest.mark.parametrize("preset", ["bayer-raw", "mjpeg"])
def test_benchmark_bound_by_the_light(benchmark, preset: str) -> None:
    rig, card = Rig(), card_of(sensor(preset))
    assert benchmark.pedantic(lambda: spot_bound(rig, card), rounds=1).sigma_px[-1] > 0.0


@pytest.mark.benchmark(group="planning")
def test_benchmark_best_stroke_without_its_bound(benchmark) -> None:
    rig, card = Rig(), card_of(sensor("bayer-raw"))
    spot = spot_bound(rig, card)
    assert benchmark.pedantic(lambda: best_stroke(2.0, rig, card=card, spot=spot), rounds=1).stroke_m > 0.1
