"""The camera's rays in Dr.Jit against `ray_tracer`, with distortion, whose first Newton steps are float32."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from phibench.render.optics.ray_tracer import lens_rays
from phibench.render.room.camera_plugin import camera_plugin_dict, undistort_steps
from phibench.render.room.surfaces import aligned
from phibench.render.setup.variant import activate
from phibench.scenes.room import c310_rig


@pytest.mark.parametrize(
    "lens", [{}, {"k1": -0.3, "k2": 0.1, "k3": 0.0, "p1": 2e-3, "p2": -1e-3}, {"k1": 1e-4, "k2": 0.0, "k3": 0.0}]
)
def test_rays_through_the_middle_of_a_distorting_lens(lens: dict[str, float]) -> None:
    """Within 1e-11 rad (1.4e-8 px) over the film and its margin; float32 alone leaves 1e-7."""
    mi = activate()
    rig = c310_rig()
    view = dataclasses.replace(rig, camera=dataclasses.replace(rig.camera, **lens)).at(0.2)
    assert undistort_steps(view.rig.camera)[1] == 1
    uv = np.random.default_rng(1).uniform((-4.0, -4.0), (1284.0, 724.0), (500, 2))
    u, v = (mi.Float64(aligned(column, np.float64)) for column in uv.T)
    _, direction, _ = mi.load_dict(camera_plugin_dict(mi, view)).film_ray(u, v, mi.Point2f(0.0))
    assert np.abs(np.array(direction).T - lens_rays(view, uv)[1]).max() < 1e-11
