"""Truth layer of a rig that moves sideways with its stroke: D counts from the mirror's place when it is down."""

import dataclasses
import math

import numpy as np

from phibench.render.optics.truth import truth_layer
from phibench.scenes.catalog import default_rig, lab
from phibench.scenes.misalignment import Misalignment


def test_depth_counts_from_the_mirrors_place_when_down() -> None:
    """D of every pixel from the stored world points and a centre composed by hand.

    The axis leans by 0.02 rad and the rig is shifted by 7 mm: at h = 0.8 m the mirror stands 23 mm aside, so that a D
    from its present place would be off by up to that. Tolerance: rounding of metres in float64.
    """
    small = dataclasses.replace(
        default_rig().camera, width_px=64, height_px=36, fx_px=71.5, fy_px=71.5, cx_px=31.5, cy_px=17.5
    )
    tilt, aside = 0.02, 7e-3
    nominal = dataclasses.replace(default_rig(), camera=small)
    rig = nominal.perturbed(Misalignment(decentre_x_m=2e-3, stroke_tilt_y_rad=tilt, shift_x_m=aside))
    view = rig.at(0.8)
    planes = truth_layer(view, lab(()).shapes(view))
    seen = np.isfinite(planes["depth_m"])
    assert np.count_nonzero(seen) > 300
    centre = nominal.T_world_camera.t + nominal.T_camera_sphere.t + [2e-3, 0.0, 0.0]
    expected = np.hypot(planes["x_m"] - centre[0], planes["y_m"] - centre[1])
    assert np.abs(planes["depth_m"] - expected)[seen].max() < 1e-12
    present = centre[0] + 0.8 * math.sin(tilt) + aside
    other = np.hypot(planes["x_m"] - present, planes["y_m"] - centre[1])
    assert np.abs(planes["depth_m"] - other)[seen].max() > 0.02
