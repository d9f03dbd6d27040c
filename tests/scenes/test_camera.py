"""scenes.Camera against OpenCV, and the pixel convention at the corners."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.oracles import project_cv2, undistort_cv2
from hypothesis import given, settings
from hypothesis import strategies as st

from phibench.scenes.camera import Camera
from phibench.scenes.room import c310_camera
from phibench.scenes.validation import SceneError

FULL = Camera(fx_px=1430.0, fy_px=1402.0, cx_px=650.3, cy_px=351.7, k1=-0.05, k2=0.31, k3=-0.4, p1=1.3e-3, p2=-0.7e-3)
CAMERAS = {"plain": Camera(), "c310": c310_camera(), "full": FULL}


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_project_against_opencv(camera):
    rng = np.random.default_rng(61)
    points = np.stack([rng.uniform(-0.3, 0.3, 1000), rng.uniform(-0.2, 0.2, 1000), rng.uniform(0.5, 1.5, 1000)], -1)
    # a polynomial of a dozen terms of at most 1000 px: some ulp (1e-13)
    np.testing.assert_allclose(camera.project(points), project_cv2(camera, points), rtol=0, atol=2e-12)


def test_every_coefficient_counts_as_in_opencv():
    """Each coefficient alone moves the image, and as OpenCV moves it: none is ignored or swapped."""
    points = np.array([[0.21, -0.13, 1.0], [-0.17, 0.05, 1.0]])
    for name, value in (("k1", 0.1), ("k2", 0.2), ("k3", 0.5), ("p1", 0.01), ("p2", 0.01)):
        camera = replace(Camera(), **{name: value})
        assert np.abs(camera.project(points) - Camera().project(points)).max() > 1e-3, name
        np.testing.assert_allclose(camera.project(points), project_cv2(camera, points), rtol=0, atol=2e-12)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_normalised_against_opencv(camera):
    rng = np.random.default_rng(62)
    uv = np.array([camera.cx_px, camera.cy_px]) + rng.uniform(-340, 340, (1000, 2)) / math.sqrt(2)
    # OpenCV iterates a fixed point until 1e-15 or 200 times; both then agree to rounding of the polynomial
    np.testing.assert_allclose(camera.normalised(uv), undistort_cv2(camera, uv), rtol=0, atol=1e-13)


def test_pixel_convention_at_the_corners():
    """Integers are pixel centres: the default principal point is the centre of the image [-0.5, W - 0.5]."""
    camera = Camera()
    tan = np.array([[-640.0, -360.0], [640.0, -360.0], [-640.0, 360.0], [640.0, 360.0]]) / 1430.0
    corners = camera.project(np.concatenate([tan, np.ones((4, 1))], axis=1))
    expected = [[-0.5, -0.5], [1279.5, -0.5], [-0.5, 719.5], [1279.5, 719.5]]
    np.testing.assert_allclose(corners, expected, rtol=0, atol=1e-12)


def test_contains_spans_half_a_pixel_beyond_the_outer_centres():
    uv = np.array([[-0.5, -0.5], [1279.5, 719.5], [-0.501, 0], [1279.501, 0], [0, -0.501], [0, 719.501], [np.nan, 0]])
    assert list(Camera().contains(uv)) == [True, True, False, False, False, False, False]


def test_camera_axes_are_right_down_forward():
    u, v = Camera().project(np.array([0.1, 0.05, 1.0])) - [639.5, 359.5]
    assert u > 0  # x to the right
    assert v > 0  # y down the rows


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_rays_and_project_are_inverse(camera):
    rng = np.random.default_rng(63)
    uv = np.array([camera.cx_px, camera.cy_px]) + rng.uniform(-300, 300, (40, 25, 2))
    rays = camera.rays(uv)
    assert rays.shape == (40, 25, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, rtol=0, atol=1e-15)
    # Newton stops at 1e-14 of normalised coordinates: 1.4e-11 px
    np.testing.assert_allclose(camera.project(rays * 3.7), uv, rtol=0, atol=2e-11)


@settings(derandomize=True, deadline=None, max_examples=200)
@given(st.floats(-300, 300), st.floats(-300, 300), st.floats(-0.1, 0.1), st.floats(-0.3, 0.3), st.floats(-2e-3, 2e-3))
def test_undistorting_inverts_distorting(du, dv, k1, k2, p1):
    camera = Camera(k1=k1, k2=k2, p1=p1)
    uv = np.array([639.5 + du, 359.5 + dv])
    np.testing.assert_allclose(camera.to_pixel(camera.normalised(uv)), uv, rtol=0, atol=2e-11)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_distortion_jacobian_against_differences(camera):
    xy, step = np.random.default_rng(64).uniform(-0.25, 0.25, (500, 2)), 1e-5
    analytic = camera.distort_jacobian(xy)
    for axis in (0, 1):
        e = step * np.eye(2)[axis]
        numeric = (camera.distort(xy + e) - camera.distort(xy - e)) / (2 * step)
        # rounding 5e-17 / 2e-5 = 3e-12; truncation 1e-10 f''' / 6 with f''' about 20 (k2, k3): 3e-10
        np.testing.assert_allclose(analytic[..., axis], numeric, rtol=0, atol=2e-9)


def test_solid_angle_density_is_the_area_of_a_pixel():
    camera, uv = FULL, np.array([812.0, 240.0])
    corners = camera.normalised(uv + 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    (x, y), (x1, y1) = corners.T, np.roll(corners, -1, axis=0).T
    area = 0.5 * abs(np.sum(x * y1 - x1 * y))
    # the density varies by second order over the pixel: (1 / 1430)^2
    assert camera.solid_angle_density(camera.normalised(uv)) == pytest.approx(area, rel=1e-6)


def test_points_behind_the_camera_have_no_image():
    pixels = Camera().project(np.array([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [0.1, 0.1, 1.0]]))
    assert np.isnan(pixels[:2]).all()
    assert np.isfinite(pixels[2]).all()


def test_pixel_beyond_the_distortion_polynomial_is_nan_alone():
    uv = np.array([[700.0, 300.0], [5e6, 0.0]])
    normalised = c310_camera().normalised(uv)
    assert np.isfinite(normalised[0]).all()
    assert np.isnan(normalised[1]).all()
    assert np.isnan(c310_camera().normalised(uv[1])).all()


def test_input_is_not_changed():
    uv = np.array([[700.0, 300.0], [500.0, 400.0]])
    before = uv.copy()
    Camera().normalised(uv)
    c310_camera().normalised(uv)
    assert np.array_equal(uv, before)


def test_aperture_radius_of_the_default_lens():
    # 1430 px x 2.8 um = 4.004 mm; f / 2.4 has a radius of 0.834 mm
    assert Camera().aperture_radius_m == pytest.approx(0.834e-3, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("width_px", 0),
        ("fx_px", -1.0),
        ("fy_px", math.nan),
        ("f_number", 0.0),
        ("focus_distance_m", math.inf),
        ("pixel_pitch_um", -2.8),
        ("k1", math.nan),
        ("cx_px", math.inf),
        ("blur_sigma_px", 0.0),
        ("blur_sigma_px", 30.0),
    ],
)
def test_impossible_cameras_are_refused_by_name(name, value):
    with pytest.raises(SceneError, match=f"Camera.{name}"):
        replace(Camera(), **{name: value})


@pytest.mark.parametrize(
    "coefficients",
    [
        {"k1": -1.5},
        {"k1": -5.0},
        {"k1": -50.0},
        {"k1": -0.12, "k2": 0.03, "k3": -3.4},
        {"k1": -0.3, "p1": 0.5},
    ],
)
def test_distortion_that_folds_inside_the_image_is_refused(coefficients):
    with pytest.raises(SceneError, match="folds near pixel"):
        Camera(**coefficients)


@pytest.mark.parametrize("coefficients", [{}, {"k1": -0.12}, {"k1": -0.026, "k2": 1.06, "k3": -3.40}, {"k1": 5.0}])
def test_distortion_that_is_one_to_one_is_accepted(coefficients):
    """A brute-force count: along the diagonal the distorted radius rises to the corner's."""
    camera = Camera(**coefficients)
    corner = camera.normalised(np.array([-0.5, -0.5]))
    way = camera.distort(np.linspace(0.0, 1.0, 500)[:, None] * corner)
    assert np.all(np.diff(np.linalg.norm(way, axis=-1)) > 0.0)
