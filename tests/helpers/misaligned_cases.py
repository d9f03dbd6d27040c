"""Drawn misaligned rigs and what must hold for each."""

from __future__ import annotations

import dataclasses
from functools import cached_property

import numpy as np
from helpers.oracles import random_spot

from phibench.render.optics.certificate import certify
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import spot_truth
from phibench.scenes.camera import Camera
from phibench.scenes.form_error import HARMONICS
from phibench.scenes.frames import Pose
from phibench.scenes.laser import LaserSpot, beam_diameter_m
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.rig import POSITIONS, Rig, View
from phibench.scenes.room import c310_camera
from phibench.scenes.validation import SceneError


@dataclasses.dataclass(frozen=True)
class Case:
    """A nominal rig, what it deviates by, a stroke and a spot."""

    nominal: Rig
    misalignment: Misalignment
    nominal_stroke_m: float
    spot: LaserSpot

    @cached_property
    def rig(self) -> Rig:
        return self.nominal.perturbed(self.misalignment)

    def view(self, position: str) -> View:
        return self.rig.at({"down": 0.0, "up": self.misalignment.stroke_m(self.nominal_stroke_m)}[position])


def draw_misalignment(rng: np.random.Generator, size: float, *, form: bool) -> Misalignment:
    """All parameters, uniform within `size` times their study magnitudes; roughness not below 0; form on demand."""
    names = [name for name in PARAMETERS if form or name not in HARMONICS]
    values = {name: rng.uniform(-size, size) * PARAMETERS[name].study for name in names}
    return Misalignment(**{**values, "roughness_alpha": abs(values["roughness_alpha"]) / size})


def draw_case(rng: np.random.Generator, *, form: bool = False) -> Case:
    """Default or C310 lens, z_c 0.26 to 0.4 m, stroke 0.1 to 1.2 m, a spot on a wall that faces the axis."""
    z_c = rng.uniform(0.26, 0.40)
    camera = (Camera(), c310_camera())[rng.integers(2)]
    camera = dataclasses.replace(camera, focus_distance_m=rng.uniform(0.2, 0.5), blur_sigma_px=rng.uniform(0.4, 1.2))
    nominal = Rig(camera=camera, T_camera_sphere=Pose("camera", "sphere", (0.0, 0.0, z_c)))
    position = random_spot(rng)
    inward = -position * [1, 1, 0] / np.hypot(*position[:2]) + rng.uniform(-0.3, 0.3, 3)
    spot = LaserSpot(tuple(position), tuple(inward), beam_diameter_m(float(np.hypot(*position[:2]))))
    while True:
        case = Case(nominal, draw_misalignment(rng, 2.0, form=form), rng.uniform(0.1, 1.2), spot)
        try:
            case.rig  # noqa: B018
        except SceneError:  # three coefficients at twice their usual size may fold the image
            continue
        return case


def check(case: Case) -> int:
    """Number of visible views of a case, each of which passed its certificate."""
    visible = 0
    for position in POSITIONS:
        view = case.view(position)
        truth = spot_truth(view, case.spot, ())
        if truth.visible:
            certificate = certify(view, case.spot, (), truth, spot_layer(view, case.spot, ()))
            assert certificate.passed, (case, position, certificate)
            visible += 1
    return visible
