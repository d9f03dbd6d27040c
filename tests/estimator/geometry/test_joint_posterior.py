"""Posterior of both images against least squares, closed forms of two minima, and profiles of a quadratic misfit."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from phibench.estimator.geometry.epipolar_line import up_image
from phibench.estimator.geometry.joint_posterior import LikelihoodMap, joint_posterior, single_posterior
from phibench.estimator.geometry.least_squares_depth import combine
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.status import Status
from phibench.estimator.methods.likelihood_maps import SpotLikelihood, likelihood_map
from phibench.scenes.rig import Rig

RIG, STROKE = Rig(), 0.425
C_DOWN = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
C_UP = np.array([[8e-4, -2e-4], [-2e-4, 5e-4]])


def places(depth_m: float) -> tuple[np.ndarray, np.ndarray]:
    down = image_of(RIG.at(0.0), np.array([0.5 * depth_m, math.sqrt(0.75) * depth_m, 0.5])).uv_px
    return down, up_image(RIG, STROKE, down, 1.0 / depth_m).uv_px


def gaussian(mean: np.ndarray, covariance: np.ndarray, half_px: float = 0.2) -> LikelihoodMap:
    side = np.linspace(-half_px, half_px, 25)
    off = np.stack(np.meshgrid(side, side), axis=-1)
    misfit = np.einsum("...i,ij,...j->...", off, np.linalg.inv(covariance), off)
    return LikelihoodMap(mean[0] + side, mean[1] + side, misfit)


@pytest.mark.parametrize("depth_m", [1.5, 4.0])
def test_gaussian_images_give_the_least_squares_of_both(depth_m: float) -> None:
    down, up = places(depth_m)
    up = up + np.array([0.03, -0.02])  # a sigma off: the positions have to give way
    found = joint_posterior(RIG, STROKE, gaussian(down, C_DOWN), gaussian(up, C_UP))
    expected = combine(RIG, STROKE, down, C_DOWN, up, C_UP)
    assert found.status == Status.OK
    # the mean of D lies above 1 over the mean of 1 / D by sigma^2 / D; splines and sums are good to 1 % of a sigma
    mean_m = float(expected.depth_m + expected.sigma_m**2 / expected.depth_m)
    assert found.depth_m == pytest.approx(mean_m, abs=0.02 * float(expected.sigma_m))
    assert found.sigma_m == pytest.approx(float(expected.sigma_m), rel=0.02)
    assert found.misfit == pytest.approx(float(expected.chi2), abs=0.05)
    np.testing.assert_allclose(found.uv_down_px, expected.uv_down_px, atol=1e-3)
    np.testing.assert_allclose(found.uv_up_px, expected.uv_up_px, atol=1e-3)
    np.testing.assert_allclose(found.covariance_down_px2, expected.covariance_down_px2, rtol=0.03, atol=1e-5)
    np.testing.assert_allclose(found.covariance_up_px2, expected.covariance_up_px2, rtol=0.03, atol=1e-5)
    near, far = found.interval_m
    assert far - near == pytest.approx(2.0 * 1.96 * float(expected.sigma_m), rel=0.03)


def test_two_minima_along_the_epipolar_line_are_both_in_the_answer() -> None:
    down, first = places(3.0)
    second = up_image(RIG, STROKE, down, 1.0 / 3.3).uv_px
    side = np.linspace(-1.0, 1.0, 61)
    C = np.eye(2) * 0.05**2
    middle = 0.5 * (first + second)
    u, v = middle[0] + side, middle[1] + side
    at = np.stack(np.meshgrid(u, v), axis=-1)
    each = [np.einsum("...i,ij,...j->...", at - m, np.linalg.inv(C), at - m) for m in (first, second)]
    # the farther one is worth a quarter
    misfit = -2.0 * np.logaddexp(-0.5 * each[0], -0.5 * each[1] - math.log(3.0))
    found = joint_posterior(RIG, STROKE, gaussian(down, np.eye(2) * 0.01**2), LikelihoodMap(u, v, misfit))
    assert found.status == Status.OK
    # two peaks at 3.0 and 3.3 m with the weights 3 : 1, which their own widths of 0.03 m shift little
    assert found.depth_m == pytest.approx(3.075, abs=0.01)
    assert found.sigma_m == pytest.approx(math.hypot(0.3 * math.sqrt(3.0 / 16.0), 0.03), abs=0.015)
    assert found.interval_m[0] < 3.0 < 3.3 < found.interval_m[1]


def test_a_map_that_ends_at_the_minimum_is_no_answer() -> None:
    down, up = places(3.0)
    whole = gaussian(up, C_UP)
    cut = LikelihoodMap(whole.u_px[12:], whole.v_px, whole.misfit[:, 12:])
    assert joint_posterior(RIG, STROKE, gaussian(down, C_DOWN), cut).status == Status.NOT_CONVERGED


@pytest.mark.parametrize("sigma_px", [0.01, 0.2])
def test_map_of_a_quadratic_misfit_is_its_profile(sigma_px: float) -> None:
    """Flux and levels that are correlated with the place are at their best everywhere: Schur's complement is left."""
    random = np.random.default_rng(5)
    J = random.normal(size=(40, 5)) * np.array([1.0, 1.0, 1e-3, 0.1, 0.1])
    F = J.T @ J
    scale = np.sqrt(np.linalg.inv(F)[0, 0]) / sigma_px
    F[:2] *= scale
    F[:, :2] *= scale
    best = np.array([7.0, 8.0, 9000.0, 3.0, 4.0])

    def scores(theta: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        off = theta - best
        repeated = np.repeat(F[None, first:, first:], len(theta), axis=0)
        return 5.0 + np.einsum("mi,ij,mj->m", off, F, off), (-off @ F)[:, first:], repeated

    found = likelihood_map(SpotLikelihood(scores, best, np.array([100.0, 200.0]), 1.0))
    assert found is not None
    C = np.linalg.inv(F)[:2, :2]
    off = np.stack(np.meshgrid(found.u_px - 107.0, found.v_px - 208.0), axis=-1)
    expected = 5.0 + np.einsum("...i,ij,...j->...", off, np.linalg.inv(C), off)
    near = expected < 30.0
    assert near.sum() > 50
    np.testing.assert_allclose(found.misfit[near], expected[near], atol=1e-6)
    reach = min(float(np.ptp(found.u_px)), float(np.ptp(found.v_px)))
    assert reach > 8.0 * math.sqrt(float(np.linalg.eigvalsh(C)[0]))


def test_a_single_image_has_the_moments_of_its_own_posterior() -> None:
    mean = np.array([640.3, 250.7])
    found, covariance = single_posterior(gaussian(mean, C_DOWN)) or (None, None)
    # sums over a quarter of a step of a map that ends at 6 sigma; the spline is good to 1 %
    np.testing.assert_allclose(found, mean, atol=1e-4)
    np.testing.assert_allclose(covariance, C_DOWN, rtol=0.02, atol=2e-6)


def test_two_minima_of_a_single_image_are_both_in_its_moments() -> None:
    side, C = np.linspace(-1.0, 1.0, 61), np.eye(2) * 0.05**2
    at = np.stack(np.meshgrid(side, side), axis=-1)
    each = [np.einsum("...i,ij,...j->...", at - m, np.linalg.inv(C), at - m) for m in ([-0.4, 0.0], [0.4, 0.0])]
    misfit = -2.0 * np.logaddexp(-0.5 * each[0], -0.5 * each[1] - math.log(3.0))
    found, covariance = single_posterior(LikelihoodMap(side, side, misfit)) or (None, None)
    # weights 3 : 1 at -0.4 and 0.4: mean -0.2, variance 0.8^2 * 3 / 16 beside 0.05^2
    np.testing.assert_allclose(found, [-0.2, 0.0], atol=2e-3)
    np.testing.assert_allclose(covariance, np.diag([0.12 + 0.05**2, 0.05**2]), rtol=0.03, atol=1e-5)


def test_a_single_image_whose_map_ends_at_the_minimum_has_no_moments() -> None:
    whole = gaussian(np.array([640.3, 250.7]), C_DOWN)
    assert single_posterior(LikelihoodMap(whole.u_px[12:], whole.v_px, whole.misfit[:, 12:])) is None


def _two_minima(off: np.ndarray) -> np.ndarray:
    """The farther one is flatter and the deeper one, and reaches 2 px from the fit."""
    first = np.sum((off / 0.12) ** 2, axis=-1)
    second = np.sum(((off - [0.0, 1.33]) / [0.2, 0.35]) ** 2, axis=-1)
    return np.asarray(-2.0 * np.logaddexp(-0.5 * first, -0.5 * second + 0.7))


def _flat(off: np.ndarray) -> np.ndarray:
    """A place between red pixels: hardly any curvature, then walls up to the misfit of an image without a spot."""
    beyond = np.maximum(np.abs(off) - 0.5, 0.0)
    return np.asarray(60.0 * (1.0 - np.exp(-np.sum((off / 0.9) ** 2 + (beyond / 0.12) ** 2, axis=-1) / 60.0)))


@pytest.mark.parametrize(("misfit", "sigma_px"), [(_two_minima, 0.12), (_flat, 0.9)])
def test_a_faint_spot_has_all_of_its_posterior(misfit: Callable[[np.ndarray], np.ndarray], sigma_px: float) -> None:
    """What the curvature at the fit does not say: a minimum more than 1.25 px away, and walls within its own sigma."""

    def scores(theta: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        F = np.diag([sigma_px**-2, sigma_px**-2, 1.0])[first:, first:]
        score = np.column_stack([np.zeros((len(theta), 2)), 900.0 - theta[:, 2]])[:, first:]
        value = misfit(theta[:, :2] - [7.0, 8.0]) + (theta[:, 2] - 900.0) ** 2
        return value, score, np.repeat(F[None], len(theta), axis=0)

    places = likelihood_map(SpotLikelihood(scores, np.array([7.0, 8.0, 900.0]), np.array([100.0, 200.0]), 1.0))
    assert places is not None
    found, covariance = single_posterior(places) or (None, None)
    # by sums over a fine grid that holds everything
    side = np.arange(-4.0, 4.0, 0.02)
    off = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    weight = np.exp(-0.5 * misfit(off))
    mean = weight @ off / weight.sum()
    expected = ((off - mean).T * weight) @ (off - mean) / weight.sum()
    # splines between nodes 0.2 px apart follow a wall of 0.12 px to 5 % of the posterior's width
    np.testing.assert_allclose(found - [107.0, 208.0], mean, atol=0.05 * math.sqrt(np.trace(expected)))
    np.testing.assert_allclose(covariance, expected, rtol=0.05, atol=0.05 * np.trace(expected))
