"""Time of a detection, `pytest --benchmark-enable --benchmark-only`; the target is stated, not asserted."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.sensor_light import spot_at

from phibench.datasets.frames.sensor_card import card_of
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.interface import Pair
from phibench.estimator.spots.detect import detect
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light
from phibench.render.sensor.settings import sensor
from phibench.scenes.rig import Rig


@pytest.mark.benchmark(group="detect")
@pytest.mark.parametrize("off", [True, False], ids=["off frame", "one frame"])
@pytest.mark.parametrize("preset", ["bayer-raw", "mono-raw", "srgb8", "mjpeg"])
def test_benchmark_detection_in_a_pair(benchmark, preset: str, off: bool) -> None:
    """Target: <= 0.3 s for a pair of 1280 x 720 pixels on one core."""
    rig, s = Rig(), sensor(preset)
    images = {}
    for name, offset in (("down", 0.0), ("up", 0.5)):
        u, v = image_of(rig.at(offset), np.array([1.6, 1.2, 0.5])).uv_px
        light = Light(np.full((3, 720, 1280), 5e4), spot_at(u, v, 0.7, 1e6))
        for laser in (True, False):
            stream = NoiseStream(("detect benchmark", name, str(laser)))
            images[name, laser] = Chain(s).frame(light if laser else light.laser_off(), stream)
    dark = [images[name, False] if off else None for name in ("down", "up")]
    pair = Pair(0, images["down", True], images["up", True], rig, 0.5, card_of(s), dark[0], dark[1])
    found = benchmark(lambda: detect(pair))
    assert found.down is not None
    assert found.up is not None
