"""Misaligned rigs, all parameters but the form drawn at once: closed form, spot layer and truth against other
mathematics. With the form: `test_accuracy_form.py`."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from helpers.misaligned_cases import Case, check, draw_case
from helpers.oracles import alhazen_quartic, fermat_path, true_pixel
from scipy.spatial.transform import Rotation

from phibench.render.optics.certificate import CENTROID_TOLERANCE_PX, CHIEF_TOLERANCE_PX
from phibench.render.optics.truth import SpotTruth, depth_m, spot_truth
from phibench.scenes.camera import Camera
from phibench.scenes.form_error import HARMONICS
from phibench.scenes.mirror import OF_REVOLVED
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.rig import POSITIONS


def test_the_tolerances_are_those_that_are_claimed() -> None:
    assert (CHIEF_TOLERANCE_PX, CENTROID_TOLERANCE_PX) == (1e-6, 2e-3)


def test_accuracy_forward_model_against_quartic_and_fermat_path() -> None:
    """<= 1e-6 px for 200 rigs, both positions. The oracles are good to 1e-12 px; they compose poses on their own."""
    rng, checked = np.random.default_rng(1), 0
    for _ in range(200):
        case = draw_case(rng)
        for position in POSITIONS:
            view = case.view(position)
            truth = spot_truth(view, case.spot, ())
            if truth.cause in ("no_reflection", "mirror_edge"):
                continue
            for solve in (alhazen_quartic, fermat_path):
                uv = true_pixel(case.rig, view.offset_m, np.array(case.spot.position_world_m), solve)
                assert np.linalg.norm(uv - [truth.u_px, truth.v_px]) <= 1e-6
            checked += 1
    assert checked > 350


def expected_pixel(case: Case, position: str) -> np.ndarray:
    """Pixel from the misalignment's numbers alone: SciPy's rotations, Alhazen's quartic, OpenCV's camera."""
    m, nominal = case.misalignment, case.nominal
    lens, axes = nominal.T_world_camera.t, nominal.T_world_camera.R
    to_sphere = axes @ nominal.T_camera_sphere.t + [m.decentre_x_m, m.decentre_y_m, m.axial_m]
    axes = Rotation.from_euler("xy", [m.tilt_x_rad, m.tilt_y_rad]).as_matrix() @ axes
    if position == "up":
        stroke = (1.0 + m.stroke_relative) * case.nominal_stroke_m + m.stroke_offset_m
        axis = Rotation.from_euler("xy", [m.stroke_tilt_x_rad, m.stroke_tilt_y_rad]).apply([0.0, 0.0, 1.0])
        turn = Rotation.from_euler("xyz", [m.roll_rad, m.pitch_rad, m.yaw_rad]).as_matrix()
        lens = lens + stroke * axis + [m.shift_x_m, m.shift_y_m, m.shift_z_m]
        axes, to_sphere = turn @ axes, turn @ to_sphere
    centre, spot = lens + to_sphere, np.array(case.spot.position_world_m)
    on_mirror = centre + alhazen_quartic(lens - centre, spot - centre, 0.06 + m.radius_m)
    return _project(nominal.camera, m, axes.T @ (on_mirror - lens))


def _project(camera: Camera, m: Misalignment, point: np.ndarray) -> np.ndarray:
    """OpenCV's projection with the numbers added by hand, pixels (u, v)."""
    import cv2

    f = camera.fx_px * (1.0 + m.focal_relative)
    matrix = np.array([[f, 0, camera.cx_px + m.cx_px], [0, f, camera.cy_px + m.cy_px], [0, 0, 1.0]])
    names = ("k1", "k2", "p1", "p2", "k3")
    brown = np.array([getattr(camera, name) + getattr(m, name) for name in names])
    return cv2.projectPoints(point.reshape(1, 1, 3), np.zeros(3), np.zeros(3), matrix, brown)[0].ravel()


def test_accuracy_from_the_numbers_alone() -> None:
    """<= 1e-6 px for 100 rigs: neither `Rig.perturbed` nor `View` is asked, so that a wrong sign would show."""
    rng, checked = np.random.default_rng(2), 0
    for _ in range(100):
        case = draw_case(rng)
        for position in POSITIONS:
            truth = spot_truth(case.view(position), case.spot, ())
            if truth.cause in ("no_reflection", "mirror_edge"):
                continue
            assert np.linalg.norm(expected_pixel(case, position) - [truth.u_px, truth.v_px]) <= 1e-6
            checked += 1
    assert checked > 170


@pytest.mark.parametrize(
    "name", [n for n in PARAMETERS if n not in ("focus_distance_m", "roughness_alpha", *HARMONICS, *OF_REVOLVED)]
)
def test_a_wrong_sign_of_any_parameter_is_noticed(name: str) -> None:
    """The comparison above with one sign turned is off by more than 1e-3 px in one of the two images."""
    rng = np.random.default_rng(3)
    case = draw_case(rng)
    while not all(spot_truth(case.view(position), case.spot, ()).visible for position in POSITIONS):
        case = draw_case(rng)
    turned = dataclasses.replace(case.misalignment, **{name: -getattr(case.misalignment, name)})
    wrong = dataclasses.replace(case, misalignment=turned)
    off = [math.dist(expected_pixel(wrong, p), _uv(spot_truth(case.view(p), case.spot, ()))) for p in POSITIONS]
    assert max(off) > 1e-3


def _uv(truth: SpotTruth) -> tuple[float, float]:
    return truth.u_px, truth.v_px


def test_accuracy_chief_ray_and_centroid_of_misaligned_rigs() -> None:
    """Short form of the next: chief ray <= 1e-6 px, centroid <= 0.002 px, flux <= 0.3 %, rays traced the other way."""
    rng = np.random.default_rng(4)
    assert sum(check(draw_case(rng)) for _ in range(10)) > 14


@pytest.mark.slow
@pytest.mark.study
def test_accuracy_chief_ray_and_centroid_of_500_misaligned_rigs() -> None:
    """All parameters at once, to twice their study magnitudes: every visible view passes."""
    rng = np.random.default_rng(5)
    assert sum(check(draw_case(rng)) for _ in range(500)) > 850


def test_depth_is_that_of_the_true_sphere_when_down() -> None:
    rng, checked = np.random.default_rng(6), 0
    for _ in range(50):
        case = draw_case(rng)
        m, spot = case.misalignment, np.array(case.spot.position_world_m)
        expected = math.hypot(spot[0] - m.decentre_x_m, spot[1] - m.decentre_y_m)  # the nominal sphere is on the z axis
        assert float(depth_m(spot, case.view("down").sphere_centre_m)) == pytest.approx(expected, rel=1e-14)
        checked += 1
    assert checked == 50
