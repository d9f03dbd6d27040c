"""Errors of outlines over their stated sigmas, on frames of drawn rigs in drawn rooms. Not a test file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from helpers.limb_frames import drawn_revolved, drawn_rig, drawn_room, drawn_tint, limb_light

from phibench.calibration.outline.contour import place_of_rig
from phibench.calibration.outline.limb_image import planes_of
from phibench.calibration.outline.outline import find_outline, fit_outline, outline_at
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.spots.image_planes import ImageError
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light
from phibench.render.sensor.settings import sensor
from phibench.scenes.frames import Pose
from phibench.scenes.random_streams import generator

SCRATCH_EVERY = 8
"""One rig in so many begins from a mirror straight above, as a user does; the others 0.02 mm and 0.3 mm off."""


@dataclass(frozen=True)
class Case:
    """One frame's outline: error and sigma, metres, shape (3,), x, y across and z along the axis."""

    name: str
    rig: int
    error_m: np.ndarray
    sigma_m: np.ndarray


def rim_cases(shape: str, rigs: range, *presets: str) -> Iterator[Case]:
    """The same of a mirror of revolution: its vertex, from 0.02 mm and 0.3 mm beside it."""
    for k in rigs:
        rng = generator("test", "rim pulls", shape, k)
        rig = drawn_revolved(rng, shape)
        tint, level = drawn_tint(rng), rng.uniform(0.8e5, 2.5e5)
        light = Light(limb_light(rig, rng, level, drawn_room(rng), tint))
        off = rng.choice([-1.0, 1.0], 5) * [2e-5, 2e-5, 3e-4, 0.0, 0.0]
        for preset in presets:
            frame = Chain(sensor(preset), 0, rig.camera).frame(light, NoiseStream(("pulls", k)))
            card = sensor_card(preset)
            again = (frame, card) if preset == "mjpeg" else None
            try:
                start = outline_at(planes_of(frame, card), rig, place_of_rig(rig) + off)
                found = fit_outline(start, again)
            except ImageError as error:
                print(f"{shape} {k} {preset}: {error}")
                continue
            yield Case(preset, k, found.sphere_in_camera_m - rig.sphere_in_camera_m, found.sigma_m)


def cases(rigs: range, *kinds: tuple[str, dict]) -> Iterator[Case]:
    """Outlines of frames of kinds such as ("mjpeg", {"jpeg_quality": 60}); light is drawn once for all of them."""
    for k in rigs:
        rng = generator("test", "outline pulls", k)
        rig = drawn_rig(rng)
        tint, level = drawn_tint(rng), rng.uniform(0.8e5, 2.5e5)
        light = Light(limb_light(rig, rng, level, drawn_room(rng), tint))
        off = rng.choice([-1.0, 1.0], 3) * [2e-5, 2e-5, 3e-4]
        for preset, changes in kinds:
            frame = Chain(sensor(preset, **changes), 0, rig.camera).frame(light, NoiseStream(("pulls", k)))
            card = sensor_card(preset, **changes)
            try:
                if k % SCRATCH_EVERY == 0:
                    start = Pose("camera", "sphere", (0.0, 0.0, 0.26))
                    found = find_outline(frame, replace(rig, T_camera_sphere=start), card)
                else:
                    again = (frame, card) if preset == "mjpeg" else None
                    start_at = outline_at(planes_of(frame, card), rig, rig.sphere_in_camera_m + off)
                    found = fit_outline(start_at, again)
            except ImageError as error:
                print(f"rig {k} {preset} {changes}: {error}")
                continue
            name = preset + str(changes.get("jpeg_quality", ""))
            yield Case(name, k, found.sphere_in_camera_m - rig.sphere_in_camera_m, found.sigma_m)
