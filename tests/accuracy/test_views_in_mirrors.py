"""Views of the lab in a mirror of each shape, one window of the plain east wall, against Mitsuba's path tracer.

`pytest --study -s tests/accuracy/test_views_in_mirrors.py`; some 2 CPU-min.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.mirror_fits import MIRRORS, rig_of
from helpers.path_ambient import path_runs
from helpers.path_windows import independent_bake

from phibench.render.optics.truth import spot_truth
from phibench.render.room.ambient_layer import render_ambient
from phibench.render.room.light_map import BakeSettings, LightMap
from phibench.scenes.laser import LaserSpot
from phibench.scenes.room import lab

SETTINGS = BakeSettings(texel_m=0.1, indirect_texel_m=0.1, lamp_rays=32, bounces=12, bounce_rays=32, final_rays=192)
HEIGHT_M = {"cone": 1.5, "polynomial": 0.3}  # of the place on the wall: a cone looks up, a polynomial down; 0.8 m else
SIDE_PX, SAMPLES, RUNS, DEPTH = 16, 96, 6, 30
SIGMAS = 3.3


@cache
def baked(number: int) -> LightMap:
    return independent_bake(lab(), SETTINGS, number)


@pytest.mark.slow
@pytest.mark.study
@pytest.mark.parametrize("shape", MIRRORS)
def test_accuracy_of_a_view_in_a_mirror_against_path_tracing(shape: str) -> None:
    """Mean of a window within 3.3 standard errors: 1e-3 of false alarms, 6e-3 for all shapes; 1 % of bias is rejected.

    The error is that of the tracer's mean, from 6 runs, and that of the light map, from two bakes: half of their
    difference, and 0.1 % at least, which is what texels of a tenth of a metre cost on a plain wall.
    """
    view, room = rig_of(shape).at(0.3), lab()
    place = LaserSpot((4.99, -1.5, HEIGHT_M.get(shape, 0.8)), (-1.0, 0.0, 0.0), 5e-3)
    truth = spot_truth(view, place, room.shapes(view))
    assert truth.visible, truth.cause
    crop = (round(truth.u_px) - SIDE_PX // 2, round(truth.v_px) - SIDE_PX // 2, SIDE_PX, SIDE_PX)
    layers = [render_ambient(view, room, baked(k), SETTINGS, 4, 0, crop).electrons_per_s for k in (0, 1)]
    ours = np.array([layer.mean(axis=(1, 2), dtype=float) for layer in layers])
    traced = path_runs(view, room, SAMPLES, DEPTH, RUNS, crop).mean(axis=(2, 3), dtype=float)
    mean = traced.mean(axis=0)
    difference = float(np.mean(ours.mean(axis=0) / mean) - 1.0)
    path_error = float((traced / mean).mean(axis=1).std(ddof=1) / np.sqrt(RUNS))
    map_error = max(0.5 * abs(float(np.mean((ours[0] - ours[1]) / mean))), 1e-3)
    error = float(np.hypot(path_error, map_error))
    print(f"{shape}: {100 * difference:+.2f} +- {100 * error:.2f} % (path {100 * path_error:.2f}), {crop}", flush=True)
    assert abs(difference) < SIGMAS * error
    assert abs(difference + np.copysign(0.01, difference)) > SIGMAS * error
