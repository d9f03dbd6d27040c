"""The central model: its formula against OpenCV, and what one viewpoint costs under a sphere."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from helpers.central_model import (
    CentralModel,
    depth_central,
    error_by_distance,
    fit_central,
    unified,
)
from helpers.oracles import true_pixel

from phibench.scenes.frames import Pose
from phibench.scenes.revolved_mirror import RevolvedMirror
from phibench.scenes.revolved_profile import Profile, hyperboloid, paraboloid
from phibench.scenes.rig import Rig

RIG = Rig()
POINTS = np.random.default_rng(41).uniform([-1, -1, 0.5], [1, 1, 2], (50, 3))


def test_without_xi_it_is_opencvs_pinhole() -> None:
    model = CentralModel(0.0, 500.0, 320.0, 240.0, -0.1, 0.02, np.zeros(3))
    K = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])
    expected, _ = cv2.projectPoints(POINTS.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, np.array([-0.1, 0.02, 0, 0]))
    assert model.project(POINTS * [1, 1, -1]) == pytest.approx(expected.reshape(-1, 2), abs=1e-9)


def test_against_opencvs_omnidir() -> None:
    """Projection with all parameters, and the way back."""
    model = CentralModel(1.2, 500.0, 320.0, 240.0, -0.1, 0.02, np.zeros(3), p1=0.003, p2=-0.002)
    K, D = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]), np.array([[-0.1, 0.02, 0.003, -0.002]])
    points = POINTS.reshape(-1, 1, 3)
    expected, _ = cv2.omnidir.projectPoints(points, np.zeros((3, 1)), np.zeros((3, 1)), K, 1.2, D)
    uv = model.project(POINTS * [1, 1, -1])
    assert uv == pytest.approx(expected.reshape(-1, 2), abs=1e-9)
    ray = POINTS * [1, 1, -1] / np.linalg.norm(POINTS, axis=1, keepdims=True)
    assert model.ray(uv) == pytest.approx(ray, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("profile", "off_m", "rms_px", "error"),
    [
        (hyperboloid(0.22, 1.25, 0.06), 0.0, (0.0, 1e-5), (0.0, 1e-6)),
        (hyperboloid(0.22, 1.25, 0.06), 0.001, (0.002, 0.01), (2e-4, 2e-3)),
        (paraboloid(0.06, 0.06), 0.0, (1e-4, 1e-3), (2e-3, 8e-3)),
    ],
    ids=["lens in the focus", "1 mm beside it", "paraboloid"],
)
def test_one_viewpoint_is_a_hyperboloids_alone(
    profile: Profile, off_m: float, rms_px: tuple[float, float], error: tuple[float, float]
) -> None:
    """Only with the lens in the focus nothing is left; what is left elsewhere is measured, in halves and doubles."""
    rig = Rig(mirror=RevolvedMirror(profile), T_camera_sphere=Pose("camera", "sphere", (off_m, 0.0, 0.22)))
    model = fit_central(rig, is_round=off_m == 0.0)
    assert rms_px[0] <= model.rms_px <= rms_px[1]
    worst = np.abs(error_by_distance(rig, model, 0.5, 0.69, np.array([1.0, 2.0, 4.2]))).max()
    assert error[0] <= worst <= error[1]


def test_unified_is_stereographic_for_xi_one() -> None:
    """xi = 1 is the stereographic projection, tan(theta / 2)."""
    theta = np.radians([10.0, 80.0, 130.0])
    points = np.stack([np.sin(theta), 0.0 * theta, np.cos(theta)], axis=-1)
    assert unified(7.0 * points, 1.0)[:, 0] == pytest.approx(np.tan(theta / 2))


def test_its_own_pixels_give_its_own_depth() -> None:
    model = fit_central(RIG)
    point = model.viewpoint_world_m + [2.5, 0.0, -0.2]
    shift = np.array([0.0, 0.0, 0.5])
    depth = depth_central(RIG, model, 0.5, model.project(point), model.project(point - shift))
    assert depth == pytest.approx(2.5, rel=1e-9)


def test_one_viewpoint_costs_more_than_the_exact_rays() -> None:
    """The fit is good to 0.02 px, yet depths at other distances are some tenths of a per cent off, of both signs."""
    model = fit_central(RIG, 2.0)
    assert 0.005 < model.rms_px < 0.05
    errors = error_by_distance(RIG, model, 0.5, 0.5, np.array([1.0, 2.0, 4.2]))
    assert -0.01 < errors[0] < -0.002
    assert abs(errors[1]) < 0.001
    assert 0.002 < errors[2] < 0.01


def test_error_uses_the_exact_pixels() -> None:
    """The same error with Alhazen's quartic for the pixels."""
    model = fit_central(RIG, 2.0)
    point = np.array([3.0, 0.0, 0.5])
    down, up = true_pixel(RIG, 0.0, point), true_pixel(RIG, 0.5, point)
    (error,) = error_by_distance(RIG, model, 0.5, 0.5, np.array([3.0]))
    assert depth_central(RIG, model, 0.5, down, up) / 3.0 - 1.0 == pytest.approx(error, abs=1e-9)
