"""Truth of spots and pixels: the three phi by the law of cosines, what hides a spot, and where D counts from."""

import dataclasses
import math

import numpy as np
import pytest
from helpers.oracles import alhazen_quartic

from phibench.render.optics.truth import spot_truth, truth_layer
from phibench.scenes.laser import LaserSpot
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.room import default_rig, lab
from phibench.scenes.shapes import rectangle


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


@pytest.mark.parametrize("height_m", [0.1, 0.5, 0.71, 1.5])
def test_the_three_phi_of_a_spot(height_m: float) -> None:
    """From the quartic's reflection point by arccos; to 1e-9 rad, as arccos loses digits only near 0 and pi."""
    view, spot = default_rig().at(0.3), LaserSpot((1.2, 1.6, height_m), (-0.6, -0.8, 0.0), 4e-3)
    point, eye, centre = np.array(spot.position_world_m), view.camera_centre_m, view.sphere_centre_m
    mirror = centre + alhazen_quartic(eye - centre, point - centre, 0.06)
    normal, leaving = (mirror - centre) / 0.06, (point - mirror) / np.linalg.norm(point - mirror)
    truth = spot_truth(view, spot, ())
    assert truth.phi_ray_rad == pytest.approx(0.5 * math.acos(-leaving[2]), abs=1e-9)
    assert truth.phi_normal_rad == pytest.approx(math.acos(-normal[2]), abs=1e-9)
    assert truth.phi_incidence_rad == pytest.approx(math.acos(normal @ leaving), abs=1e-9)
    assert truth.azimuth_rad == pytest.approx(math.atan2(1.6, 1.2), abs=1e-9)
    assert abs(truth.phi_ray_rad - truth.phi_normal_rad) > 5e-3  # the lens is not at infinity


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_what_stands_in_either_half_of_the_path_hides_the_spot(share: float) -> None:
    """A card across the middle of one half of the path is named; beside the path it hides nothing."""
    view, spot = default_rig().at(0.0), LaserSpot((0.0, 2.0, 0.6), (0.0, -1.0, 0.0), 4e-3)
    seen = spot_truth(view, spot, ())
    assert seen.visible
    mirror = np.array(seen.reflection_point_world_m)
    for end in (np.array(spot.position_world_m), view.camera_centre_m):
        place, way = mirror + share * (end - mirror), end - mirror
        normal = tuple(way / np.linalg.norm(way))
        assert spot_truth(view, spot, (rectangle("card", tuple(place), normal, (0.02, 0.02)),)).cause == "occluded:card"
        aside = (place[0] + 0.05, place[1], place[2])
        assert spot_truth(view, spot, (rectangle("card", aside, normal, (0.02, 0.02)),)).visible
