"""General depth against minimisation in pixels, simulation and its own false alarms."""

from __future__ import annotations

import numpy as np
import pytest
import scipy
from helpers.oracles import random_rig, random_spot, true_pixel
from scipy import optimize

from phibench.estimator.geometry.least_squares_depth import GeneralDepth, depth_general
from phibench.estimator.geometry.rig_parameters import PARAMETERS, changed_rig, prior_sigmas, stroke_of
from phibench.estimator.geometry.status import Status
from phibench.estimator.geometry.triangulate import meeting, meeting_gradients
from phibench.scenes.rig import Rig

RIG, SPOT, STROKE = Rig(), np.array([1.9, 1.1, 0.5]), 0.5
C1, C2 = np.array([[0.01, 0.002], [0.002, 0.02]]), np.array([[0.015, -0.004], [-0.004, 0.01]])


def depth_of(rig: Rig, point: np.ndarray) -> float:
    return float(np.linalg.norm((point - rig.at(0.0).sphere_centre_m)[:2]))


@pytest.mark.slow
def test_exact_pixels_of_misaligned_rigs_give_the_exact_depth() -> None:
    """Rounding of pixels, 1e-13, times at most 2 m per pixel and some sums."""
    rng = np.random.default_rng(5)
    checked = 0
    for _ in range(24):
        rig, spot, h = random_rig(rng), random_spot(rng), rng.uniform(0.1, 1.4)
        result = depth_general(rig, h, true_pixel(rig, 0.0, spot), true_pixel(rig, h, spot), C1, C2)
        assert abs(result.depth_m / depth_of(rig, spot) - 1.0) < 1e-9
        assert result.chi2 < 1e-12
        checked += 1
    assert checked == 24


def test_against_minimisation_in_pixels() -> None:
    """The point that scipy finds by projecting candidates, by Alhazen's quartic; pixels 0.15 px wrong.

    Both are least squares; the condition's curvature is used by both, so what is left is the search's precision
    (1e-6 of the depth) and Gauss-Newton's second order, (0.15 px / 340 px)^2.
    """
    rng, checked = np.random.default_rng(6), 0
    L1, L2 = (np.linalg.inv(np.linalg.cholesky(C)) for C in (C1, C2))
    for _ in range(3):
        rig = random_rig(rng)
        down, up = (true_pixel(rig, h, SPOT) + rng.normal(0.0, 0.15, 2) for h in (0.0, STROKE))

        def misfit(X, rig=rig, down=down, up=up):
            return np.concatenate([L1 @ (true_pixel(rig, 0.0, X) - down), L2 @ (true_pixel(rig, STROKE, X) - up)])

        found = optimize.least_squares(misfit, SPOT, x_scale=[0.1, 0.1, 0.1], xtol=1e-14, ftol=1e-14, gtol=1e-14)
        ours = depth_general(rig, STROKE, down, up, C1, C2)
        assert ours.depth_m == pytest.approx(depth_of(rig, found.x), rel=1e-5)
        assert ours.chi2 == pytest.approx(2.0 * found.cost, rel=1e-2, abs=1e-6)
        J = found.jac
        point_covariance = np.linalg.inv(J.T @ J)
        g = (found.x - rig.at(0.0).sphere_centre_m)[:2] / depth_of(rig, found.x)
        assert ours.sigma_m == pytest.approx(np.sqrt(g @ point_covariance[:2, :2] @ g), rel=1e-3)
        checked += 1
    assert checked == 3


def test_pixel_gradient_against_differences() -> None:
    """Five-point differences; the closed form is exact, the differences are good to 1e-8."""
    y = np.concatenate([true_pixel(RIG, 0.0, SPOT), true_pixel(RIG, STROKE, SPOT) + [0.3, -0.2]])
    e_y, D_y = meeting_gradients(RIG, STROKE, y[:2], y[2:])
    for i in range(4):
        step = 1e-3 * np.eye(4)[i]

        def values(k, step=step):
            at = meeting(RIG, STROKE, *np.split(y + k * step, 2))
            return np.array([at.gap_m, at.depth_m])

        slope = (8.0 * (values(1) - values(-1)) - (values(2) - values(-2))) / (12.0 * 1e-3)
        assert [e_y[i], D_y[i]] == pytest.approx(slope, rel=1e-7, abs=1e-9)


def simulate(n: int) -> tuple[np.ndarray, GeneralDepth]:
    """Pulls of n rigs drawn from the calibration's covariance, and all results."""
    rng = np.random.default_rng(7)
    sigmas, noise = 0.05 * prior_sigmas(), 1e-2 * np.eye(2)
    downs, ups, truth = [], [], []
    for _ in range(n):
        true = changed_rig(RIG, values := rng.normal(0.0, sigmas))
        h = float(stroke_of(STROKE, values)) + rng.normal(0.0, 2e-4)
        downs.append(true_pixel(true, 0.0, SPOT) + rng.multivariate_normal([0, 0], noise))
        ups.append(true_pixel(true, h, SPOT) + rng.multivariate_normal([0, 0], noise))
        truth.append(depth_of(true, SPOT))
    result = depth_general(RIG, STROKE, np.array(downs), np.array(ups), noise, noise, np.diag(sigmas**2), 2e-4)
    return (result.depth_m - truth) / result.sigma_m, result


@pytest.mark.slow
def test_sigma_and_false_alarms_by_simulation() -> None:
    """1000 rigs: the pull's variance within the chi-square interval of false alarm rate 1e-5, which is +-20 %.

    A sigma wrong by 25 % (variance by 56 %) is noticed. p values: rejections at 5 % are binomial, rate 1e-5.
    """
    n = 1000
    pulls, result = simulate(n)
    ps = result.p_value
    parts = np.array([result.sigma_spot_m, result.sigma_calibration_m, result.sigma_stroke_m])
    low, high = scipy.stats.chi2.ppf([5e-6, 1 - 5e-6], n - 1) / (n - 1)
    ratio = np.var(pulls, ddof=1)
    assert low < ratio < high
    assert not low < ratio / 1.25**2 < high
    assert not low < ratio * 1.25**2 < high
    alarms = int(np.sum(ps < 0.05))
    assert scipy.stats.binom.ppf(5e-6, n, 0.05) <= alarms <= scipy.stats.binom.isf(5e-6, n, 0.05)
    assert np.sqrt(np.sum(parts**2, axis=0)) == pytest.approx(result.sigma_m, rel=1e-12)
    assert np.all(parts > 0.0)


def test_a_broken_rig_is_noticed() -> None:
    """A mirror 5 mm beside its place: seen across, at right angles to the shift, the rays miss each other."""
    broken = changed_rig(RIG, np.where(np.array(PARAMETERS) == "decentre_x_m", 5e-3, 0.0))
    spot = np.array([0.3, 2.0, 0.5])
    down, up = true_pixel(broken, 0.0, spot), true_pixel(broken, STROKE, spot)
    small = 1e-4 * np.eye(2)
    assert depth_general(RIG, STROKE, down, up, small, small).p_value < 1e-6
    assert depth_general(broken, STROKE, down, up, small, small).p_value > 0.99


def test_bad_pixels_get_nan_and_a_status() -> None:
    centre = np.array([639.5, 359.5])
    down, up = centre + [[180.0, 60.0], [600.0, 0.0]], centre + [[162.0, 54.0]] * 2
    result = depth_general(RIG, 0.5, down, up, C1, C2)
    assert [Status(s) for s in result.status] == [Status.OK, Status.MISSES_MIRROR]
    assert np.isfinite(result.depth_m[0])
    assert np.isnan([result.depth_m[1], result.sigma_m[1], result.p_value[1]]).all()


def test_a_covariance_of_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match="parameters"):
        depth_general(RIG, 0.5, np.zeros(2), np.zeros(2), C1, C2, np.eye(3))
