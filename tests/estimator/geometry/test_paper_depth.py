"""The paper's equations against their printed form, plane geometry and differences."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import scipy
from helpers.oracles import alhazen_quartic, paper_cases
from hypothesis import given, settings
from hypothesis import strategies as st

from phibench.estimator.geometry.paper_depth import depth_approx, depth_paper, error_eq6, error_eq7
from phibench.estimator.geometry.status import Status

R = 0.06


def true_phi_ray(spot: np.ndarray, offset_m: float) -> float:
    centre = np.array([0, 0, 0.71 + offset_m])
    P = alhazen_quartic(np.array([0, 0, -0.26]), spot - centre, R)
    to_spot = spot - centre - P
    return math.atan2(math.hypot(to_spot[0], to_spot[1]), -to_spot[2]) / 2


def paper_geometry(depth_m: float, drop_m: float) -> float:
    """phi of eq. (1) by iteration, for a point `drop_m` below the sphere centre: tan 2phi = (D - R sin phi) / H."""
    phi = math.atan2(depth_m, drop_m) / 2
    for _ in range(200):
        phi = math.atan2(depth_m - R * math.sin(phi), drop_m - R * math.cos(phi)) / 2
    return phi


@settings(derandomize=True, deadline=None, max_examples=300)
@given(st.floats(0.3, 20.0), st.floats(-3.0, 3.0), st.floats(0.05, 2.0))
def test_eq4_inverts_eqs_1_to_3(depth_m, drop_m, stroke_m):
    """Points above and below the mirror: 2 phi on both sides of 90 degrees."""
    phi1, phi2 = paper_geometry(depth_m, drop_m), paper_geometry(depth_m, drop_m + stroke_m)
    estimate = depth_paper(phi1, phi2, stroke_m, R)
    assert estimate.status == Status.OK
    # phi to 2 ulp (2e-16), amplified by dD/dphi = 2 D^2 / (h S1 S2) over D: (2 D / (h S1 S2)) x 4e-16
    amplification = 2 * depth_m / (stroke_m * math.sin(2 * phi1) * math.sin(2 * phi2))
    assert abs(estimate.depth_m / depth_m - 1) < 1e-14 + 1e-15 * amplification


@settings(derandomize=True, deadline=None, max_examples=300)
@given(st.floats(0.05, 1.5), st.floats(0.01, 1.0), st.floats(0.1, 1.4))
def test_eq4_equals_the_printed_form(phi1, ratio, h):
    phi2 = phi1 * (1 - 0.5 * ratio)
    t1, t2 = math.tan(2 * phi1), math.tan(2 * phi2)
    lam = R * (math.cos(phi2) - math.cos(phi1))
    printed = R * (t2 * math.sin(phi1) - t1 * math.sin(phi2)) / (t2 - t1) + (h - lam) * t1 * t2 / (t1 - t2)
    estimate = depth_paper(phi1, phi2, h, R)
    if estimate.status == Status.OK and min(abs(math.cos(2 * phi1)), abs(math.cos(2 * phi2))) > 1e-3:
        # tangents up to 1000 lose three digits of 16, small disparities (2.5e-4 rad) four more
        assert estimate.depth_m == pytest.approx(printed, rel=1e-8)
    else:
        assert estimate.status in (Status.OK, Status.DIVERGING)


def covariance_of(sigma_1: float, sigma_2: float, correlation: float = 0.0) -> np.ndarray:
    cross = correlation * sigma_1 * sigma_2
    return np.array([[sigma_1**2, cross], [cross, sigma_2**2]])


def test_eq4_is_regular_where_the_tangent_is_infinite():
    h, theta2 = 0.5, math.radians(80)
    near = depth_paper(math.pi / 4 + np.array([-1e-9, 0.0, 1e-9]), theta2 / 2, h, R)
    assert np.all(near.status == Status.OK)
    # dD/dphi is about 30 m / rad here: 1e-9 rad gives 3e-8 m
    assert np.ptp(near.depth_m) < 1e-7
    # level ray: the drop H_1 is 0, so H_2 = h - lambda, D = R sin phi2 + H_2 tan 2phi2 by eq. (2)
    lam = R * (math.cos(theta2 / 2) - math.cos(math.pi / 4))
    assert near.depth_m[1] == pytest.approx(R * math.sin(theta2 / 2) + (h - lam) * math.tan(theta2), rel=1e-14)


def test_accuracy_eq4_with_true_phi_ray_within_a_millimetre():
    errors = []
    for row, spot in paper_cases():
        phi1, phi2 = true_phi_ray(spot, 0.0), true_phi_ray(spot, row.baseline_m)
        errors.append(float(depth_paper(phi1, phi2, row.baseline_m, R).depth_m) - row.real_depth_m)
    assert len(errors) == 25
    assert np.max(np.abs(errors)) < 1e-3
    # eq. (4) has R sin(phi) in place of R sin(phi_normal): its error is not zero, and a test that saw zero is broken
    assert np.min(np.abs(errors)) > 1e-4


def test_accuracy_eq5_is_eq4_without_the_mirror():
    """Reflection points taken as one: what eq. (5) leaves out is epsilon and lambda, up to two R of depth."""
    for row, spot in paper_cases():
        phi1, phi2 = true_phi_ray(spot, 0.0), true_phi_ray(spot, row.baseline_m)
        approx = depth_approx(phi1, phi2, row.baseline_m)
        assert approx.status == Status.OK
        assert approx.depth_m == pytest.approx(depth_paper(phi1, phi2, row.baseline_m, 0.0).depth_m, rel=1e-13)
        assert approx.depth_m > 0  # printed with a minus sign
        assert 1e-3 < abs(approx.depth_m - row.real_depth_m) < 2 * R


@pytest.mark.parametrize("radius_m", [0.0, 0.06, 0.3])
def test_gradient_against_differences(radius_m):
    rng, step = np.random.default_rng(31), 1e-6
    phi2 = rng.uniform(0.3, 0.8, 500)
    phi1 = phi2 + rng.uniform(0.03, 0.3, 500)
    h = rng.uniform(0.3, 1.4, 500)
    checked = 0
    for column in (0, 1):
        e = step * np.eye(2)[column]
        plus, minus = (depth_paper(phi1 + s * e[0], phi2 + s * e[1], h, radius_m).depth_m for s in (1, -1))
        numeric = np.abs(plus - minus) / (2 * step)
        unit = np.zeros((2, 2))
        unit[column, column] = 1.0  # sigma is then |dD/dphi_k|
        sigma = depth_paper(phi1, phi2, h, radius_m, unit).sigma_m
        good = np.isfinite(numeric)
        # truncation: (step / disparity)^2 = (1e-6 / 0.06)^2 = 3e-10; rounding 1e-15 x 25 / (2e-6 x 25) = 1e-9
        np.testing.assert_allclose(sigma[good], numeric[good], rtol=1e-8, atol=1e-7)
        checked += good.sum()
    assert checked > 800


def test_sigma_uses_the_correlation():
    """Errors that move both rays together cancel in part: correlation +1 gives |g1 s + g2 s|."""
    phi1, phi2, h, s = 0.62, 0.55, 0.5, 1e-4
    g = [depth_paper(phi1, phi2, h, R, covariance_of(*pair)).sigma_m for pair in ((1, 0), (0, 1))]
    together = depth_paper(phi1, phi2, h, R, covariance_of(s, s, 1.0)).sigma_m
    apart = depth_paper(phi1, phi2, h, R, covariance_of(s, s, -1.0)).sigma_m
    # g1 < 0 < g2: a larger phi1 means a larger disparity
    assert together == pytest.approx(s * abs(g[1] - g[0]), rel=1e-9)
    assert apart == pytest.approx(s * (g[0] + g[1]), rel=1e-9)


@pytest.mark.parametrize("depth", [partial(depth_paper, stroke_m=0.5, radius_m=R), partial(depth_approx, stroke_m=0.5)])
def test_covariance_against_monte_carlo(depth):
    mean, n = np.array([0.62, 0.52]), 40_000
    # 1e-5 rad on a disparity of 0.2 rad: second-order terms change the variance by (1e-4)^2
    covariance = covariance_of(1e-5, 2e-5, 0.4)
    draws = np.random.default_rng(32).multivariate_normal(mean, covariance, n)
    predicted = depth(*mean, covariance_rad2=covariance).sigma_m ** 2
    ratio = np.var(depth(draws[:, 0], draws[:, 1]).depth_m, ddof=1) / predicted
    # false alarm rate 1e-6; the interval is +-3.5 % of the variance, a sigma wrong by 10 % is 19 to 21 %
    low, high = scipy.stats.chi2.ppf([5e-7, 1 - 5e-7], n - 1) / (n - 1)
    assert low < ratio < high
    assert not low < ratio / 1.1**2 < high
    assert not low < ratio / 0.9**2 < high


def test_eq6_is_the_derivative_of_eq5_with_s_constant():
    """D = h s / sin(disparity), s held constant."""
    phi1, phi2, h, step = 0.62, 0.52, 0.5, 1e-6
    s = math.sin(2 * phi1) * math.sin(2 * phi2)
    disparity = 2 * (phi1 - phi2)
    D = h * s / math.sin(disparity)
    numeric = h * s * (1 / math.sin(disparity - step) - 1 / math.sin(disparity + step)) / (2 * step)
    # truncation (step / disparity)^2 = 2.5e-11, rounding 1e-15 / 1e-5
    assert error_eq6(D, phi1, phi2, h) == pytest.approx(numeric, rel=1e-9)
    # eq. (7) drops cos(disparity): larger by 1 / cos
    assert error_eq7(D, phi1, phi2, h) == pytest.approx(numeric / math.cos(disparity), rel=1e-9)


def test_eq6_has_no_value_beyond_a_disparity_of_90_degrees():
    assert np.isnan(error_eq6(0.1, 0.7, 0.6, 1.0))


def test_bad_angles_get_nan_and_a_status():
    cases = [
        ((0.62, 0.55, 0.5), Status.OK),
        ((0.55, 0.55, 0.5), Status.PARALLEL),
        ((0.55, 0.62, 0.5), Status.DIVERGING),
        ((0.0, 0.0, 0.5), Status.ON_AXIS),
        ((0.62, 0.0, 0.5), Status.ON_AXIS),
        ((math.pi / 2, 0.5, 0.5), Status.ON_AXIS),
        ((np.nan, 0.55, 0.5), Status.NOT_FINITE),
        ((0.62, np.inf, 0.5), Status.NOT_FINITE),
        ((0.62, -0.1, 0.5), Status.OUT_OF_RANGE),
        ((1.7, 0.5, 0.5), Status.OUT_OF_RANGE),
        ((0.62, 0.55, 0.0), Status.OUT_OF_RANGE),
        ((0.62, 0.55, -0.5), Status.OUT_OF_RANGE),
        ((0.62, 0.55, np.nan), Status.NOT_FINITE),
    ]
    phi1, phi2, h = np.array([values for values, _ in cases]).T
    for estimate in (depth_paper(phi1, phi2, h, R, np.eye(2)), depth_approx(phi1, phi2, h, np.eye(2))):
        assert [Status(s) for s in estimate.status] == [status for _, status in cases]
        assert np.isfinite([estimate.depth_m[0], estimate.sigma_m[0]]).all()
        assert np.isnan(estimate.depth_m[1:]).all()
        assert np.isnan(estimate.sigma_m[1:]).all()


def test_shapes_broadcast():
    estimate = depth_paper(np.full((3, 1), 0.62), 0.55, np.linspace(0.3, 0.6, 4), R, np.eye(2))
    assert estimate.depth_m.shape == estimate.sigma_m.shape == estimate.status.shape == (3, 4)
    assert np.isnan(depth_paper(0.62, 0.55, 0.5, R).sigma_m)
