"""The central model: its formula against OpenCV, and what one viewpoint costs under a sphere."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from helpers.oracles import true_pixel

from phibench.estimator.calibration.central_model import (
    CentralModel,
    depth_central,
    error_by_distance,
    fit_central,
    unified,
)
from phibench.scenes.rig import Rig

RIG = Rig()
POINTS = np.random.default_rng(41).uniform([-1, -1, 0.5], [1, 1, 2], (50, 3))


def test_without_xi_it_is_opencvs_pinhole() -> None:
    model = CentralModel(0.0, 500.0, 320.0, 240.0, -0.1, 0.02, np.zeros(3))
    K = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])
    expected, _ = cv2.projectPoints(POINTS.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, np.array([-0.1, 0.02, 0, 0]))
    assert model.project(POINTS * [1, 1, -1]) == pytest.approx(expected.reshape(-1, 2), abs=1e-9)


@pytest.mark.skipif(not hasattr(cv2, "omnidir"), reason="this OpenCV has no omnidir")
def test_against_opencvs_omnidir() -> None:
    model = CentralModel(1.2, 500.0, 320.0, 240.0, -0.1, 0.02, np.zeros(3))
    K, D = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]), np.array([[-0.1, 0.02, 0.0, 0.0]])
    expected, _ = cv2.omnidir.projectPoints(POINTS.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, 1.2, D)
    assert model.project(POINTS * [1, 1, -1]) == pytest.approx(expected.reshape(-1, 2), abs=1e-9)


def test_unified_is_stereographic_for_xi_one() -> None:
    """xi = 1 is the stereographic projection, tan(theta / 2)."""
    theta = np.radians([10.0, 80.0, 130.0])
    points = np.stack([np.sin(theta), 0.0 * theta, np.cos(theta)], axis=-1)
    assert unified(7.0 * points, 1.0)[:, 0] == pytest.approx(np.tan(theta / 2))


def test_its_own_pixels_give_its_own_depth() -> None:
    model = fit_central(RIG)
    point = model.viewpoint_world_m + [2.5, 0.0, -0.2]
    shift = np.array([0.0, 0.0, 0.5])
    depth = depth_central(model, 0.5, model.project(point), model.project(point - shift))
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
    assert depth_central(model, 0.5, down, up) / 3.0 - 1.0 == pytest.approx(error, abs=1e-9)
