"""The sharpness by which one focuses is largest where the lens is focused on the mirror's virtual image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from phibench.calibration.outline.first_circle import rig_circle
from phibench.calibration.rig.align import sharpness
from phibench.datasets.build.bake_task import light_map
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.render.room.ambient_layer import render_ambient
from phibench.render.room.light_map import BakeSettings
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light
from phibench.render.sensor.settings import sensor
from phibench.scenes.rig import Rig
from phibench.scenes.room import lab

FOCUS_M = (0.18, 0.235, 0.30, 0.46)
"""The virtual image of far walls lies at z_c - R/2 = 0.23 m on the axis; 0.46 m is the factory's focus."""


@pytest.mark.slow
def test_sharpness_is_largest_on_the_virtual_image() -> None:
    """A lens at 0.18 m or 0.30 m has discs of defocus of 1.5 px radius there; noise and JPEG change the order nowhere.

    Steps of 0.005 are seen: neighbours of the best differ by 0.02 and more in frames.
    """
    room, settings, rig = lab(), BakeSettings(), Rig()
    light = light_map(rig.at(0.0), room, settings)
    found: dict[str, list[float]] = {"layers": [], "mjpeg": []}
    for focus_m in FOCUS_M:
        focused = replace(rig, camera=replace(rig.camera, focus_distance_m=focus_m))
        layer = render_ambient(focused.at(0.0), room, light, settings, 2, 1, rounds=1).electrons_per_s
        frame = Chain(sensor("mjpeg"), 0, rig.camera).frame(Light(layer), NoiseStream(("focus", 0)))
        found["layers"].append(sharpness(layer, None, rig_circle(rig)))
        found["mjpeg"].append(sharpness(frame, sensor_card("mjpeg"), rig_circle(rig)))
    print("sharpness at", FOCUS_M, found)
    for values in found.values():
        assert int(np.argmax(values)) == 1
        assert min(values[1] - values[0], values[1] - values[2]) > 0.005
        assert values[3] == min(values)
