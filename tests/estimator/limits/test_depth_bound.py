"""Limits of phi and D: gradients against differences, variances against draws of pixels and of rigs."""

from __future__ import annotations

import numpy as np
import pytest
import scipy
from helpers.oracles import alhazen_quartic, paper_cases, random_rig, random_spot, true_pixel

from phibench.estimator.geometry.phi import estimate_phi
from phibench.estimator.geometry.rig_parameters import RIG_PARAMETERS, rig_covariance, rig_gradient
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.limits.position_bound import SpotLimit, depth_limit, phi_limit
from phibench.scenes.misalignment import PARAMETERS
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig

RIG = Rig()
SIGMAS = {
    **{
        "stroke_offset_m": 5e-4,
        "axial_m": 2e-4,
        "radius_m": 2e-5,
        "focal_relative": 1.4e-3,
        "cx_px": 0.5,
        "cy_px": 0.5,
    },
    **{"decentre_x_m": 5e-5, "decentre_y_m": 5e-5, "tilt_x_rad": 3e-4, "tilt_y_rad": 3e-4},
    **{"stroke_tilt_x_rad": 1e-3, "stroke_tilt_y_rad": 1e-3},
}
C_DOWN, C_UP = 1e-4 * np.array([[9.0, 2.0], [2.0, 4.0]]), 1e-4 * np.array([[6.0, -2.0], [-2.0, 8.0]])


def pixels(rig: Rig, spot: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    return true_pixel(rig, 0.0, spot, alhazen_quartic), true_pixel(rig, h, spot, alhazen_quartic)


def test_accuracy_depth_limit_against_draws() -> None:
    """Pixels and rig drawn together: the variance of D is the sum of both parts, and not of one alone."""
    row, spot = paper_cases()[10]
    h = row.baseline_m
    down, up = pixels(RIG, spot, h)
    limit = depth_limit(RIG, h, down, up, C_DOWN, C_UP, rig_covariance(SIGMAS))
    n, rng = 1000, generator("limits", "depth")
    draws = [SIGMAS.get(name, 0.0) * rng.standard_normal(n) for name in RIG_PARAMETERS]
    uv = (rng.multivariate_normal(down, C_DOWN, n), rng.multivariate_normal(up, C_UP, n))
    depths = np.empty(n)
    for k in range(n):
        rig = RIG
        for name, values in zip(RIG_PARAMETERS[1:], draws[1:], strict=True):
            rig = PARAMETERS[name].apply(rig, values[k])
        depths[k] = depth_exact(rig, h + draws[0][k], uv[0][k], uv[1][k]).depth_m
    variance = depths.var(ddof=1)
    # false alarm 1e-6: +-22 % of the variance, and each part alone is further below; sigma / D is 0.4 %, second order
    # 1e-3 of it
    low, high = scipy.stats.chi2.ppf([5e-7, 1 - 5e-7], n - 1) / (n - 1)
    parts = 1e3 * np.array([limit.sigma_spot_m, limit.sigma_calibration_m, limit.sigma_m, np.sqrt(variance)])
    print(f"D = {row.real_depth_m} m; spot, calibration, both, drawn: {np.round(parts, 2)} mm")
    assert low < variance / limit.sigma_m**2 < high
    assert not low < variance / limit.sigma_calibration_m**2 < high
    assert not low < variance / limit.sigma_spot_m**2 < high


def test_parts_stay_apart() -> None:
    row, spot = paper_cases()[3]
    down, up = pixels(RIG, spot, row.baseline_m)
    exact = depth_limit(RIG, row.baseline_m, down, up, C_DOWN, C_UP, rig_covariance({}))
    assert exact.sigma_calibration_m == 0.0
    direct = depth_exact(RIG, row.baseline_m, down, up, C_DOWN, C_UP).sigma_m
    assert exact.sigma_m == pytest.approx(float(direct), rel=1e-12)
    one = depth_limit(RIG, row.baseline_m, down, up, C_DOWN, C_UP, rig_covariance({"cx_px": 2.0}))
    assert one.sigma_calibration_m == pytest.approx(2.0 * abs(one.gradient[RIG_PARAMETERS.index("cx_px")]), rel=1e-12)


@pytest.mark.slow
def test_rig_gradient_does_not_depend_on_its_steps() -> None:
    """Five-point stencils: half the steps change nothing but rounding, for aligned and misaligned rigs."""
    rng, checked = np.random.default_rng(91), 0
    for case in range(12):
        rig = RIG if case < 3 else random_rig(rng)
        spot, h = random_spot(rng), rng.uniform(0.4, 1.2)
        down, up = pixels(rig, spot, h)
        whole, half = rig_gradient(rig, h, down, up), rig_gradient(rig, h, down, up, 0.5)
        # fourth order: tilts of 1 mrad against disparities of 0.1 rad, (1e-2)^4, some tens of times; cancellation 1e-11
        np.testing.assert_allclose(half, whole, rtol=1e-4, atol=1e-5 * np.abs(whole).min())
        checked += 1
    assert checked == 12


def test_rig_gradient_predicts_what_a_wrong_rig_gives() -> None:
    """Pixels of a true rig, estimated with the nominal one: D is off by minus the gradient times the error."""
    row, spot = paper_cases()[12]
    h = row.baseline_m
    steps = {name: 0.02 * sigma for name, sigma in SIGMAS.items() if name != "stroke_offset_m"}
    g = rig_gradient(RIG, h, *pixels(RIG, spot, h))
    for name, step in steps.items():
        true_rig = PARAMETERS[name].apply(RIG, step)
        true_depth = np.linalg.norm((spot - true_rig.at(0.0).sphere_centre_m)[:2])
        error = depth_exact(RIG, h, *pixels(true_rig, spot, h)).depth_m - true_depth
        # D's second derivative: 1e-2 of the first for 2 % of a sigma; a decentred sphere moves the reference of D
        assert error == pytest.approx(-g[RIG_PARAMETERS.index(name)] * step, rel=0.02), name
    assert len(steps) == 11


def test_vectorised_over_spots_and_nan_for_bad_ones() -> None:
    cases = paper_cases()[:4]
    h = np.array([row.baseline_m for row, _ in cases])
    down, up = (np.array(x) for x in zip(*(pixels(RIG, spot, row.baseline_m) for row, spot in cases), strict=True))
    down[2] = [2.0, 3.0]  # beside the mirror
    limit = depth_limit(RIG, h, down, up, C_DOWN, C_UP, rig_covariance(SIGMAS))
    assert limit.gradient.shape == (4, len(RIG_PARAMETERS)) == (4, 15)
    assert np.isnan(limit.sigma_m).tolist() == [False, False, True, False]
    single = depth_limit(RIG, h[1], down[1], up[1], C_DOWN, C_UP, rig_covariance(SIGMAS))
    assert limit.sigma_m[1] == pytest.approx(float(single.sigma_m), rel=1e-9)


def test_phi_limit_against_differences() -> None:
    view, uv, step = RIG.at(0.0), np.array([800.0, 300.0]), 1e-3
    phi = [
        float(estimate_phi("ray", view, uv + step * np.array(e)).phi_rad) for e in ((1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    g = np.array([phi[0] - phi[1], phi[2] - phi[3]]) / (2 * step)
    limit = phi_limit(view, uv, SpotLimit(C_DOWN, np.eye(2)))
    # step^2 / 6 phi''' / phi' is 1e-11, rounding 1e-16 / 1e-3 / 4e-3 = 1e-11
    assert float(limit.variance_rad2) == pytest.approx(g @ C_DOWN @ g, rel=1e-7)


def test_messages() -> None:
    with pytest.raises(ValueError, match=r"no rig parameter 'axial'.*axial_m"):
        rig_covariance({"axial": 1e-3})
    with pytest.raises(ValueError, match="'z_c_m' is now called 'axial_m'"):
        rig_covariance({"z_c_m": 1e-3})
    with pytest.raises(ValueError, match="sigma of radius_m = -1"):
        rig_covariance({"radius_m": -1.0})
