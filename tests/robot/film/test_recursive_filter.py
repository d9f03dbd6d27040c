"""Recursive filter of a film against the bundle, with drawn errors; at rest, and where a fit went astray."""

from dataclasses import replace

import numpy as np
import pytest
import scipy
from helpers.stroke_film import DEPTH_M, ENCODER_M, FRAMES, SCENE, drawn, exact

from phibench.robot.film.film_bundle import film_depth
from phibench.robot.film.film_positions import FilmPositions
from phibench.robot.film.recursive_filter import FilterState, first_state, updated
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator

FILTERS = 20


def last_state(positions: FilmPositions, readings: Array, pattern_px2: Array) -> FilterState:
    """Belief of the filter after all frames."""
    uv, noise = positions.uv_px, positions.noise_px2
    state = first_state(SCENE.rig, uv[0], noise[0], pattern_px2, readings[0], ENCODER_M)
    for k in range(1, FRAMES):
        state = updated(SCENE.rig, state, uv[k], noise[k], pattern_px2, readings[k], ENCODER_M)
    return state


def test_filter_leaves_a_fit_astray_out() -> None:
    """A frame late in the stroke whose fit settled 30 deviations away leaves the belief as without it."""
    positions, readings = drawn(0)
    nothing = 1e-12 * np.eye(2)
    astray = positions.uv_px.copy()
    astray[-2] += 30.0 * np.sqrt(np.diag(positions.noise_px2[-2]))
    right = last_state(positions, readings, nothing)
    left_out = last_state(replace(positions, uv_px=astray), readings, nothing)
    assert left_out.frames == right.frames - 1
    (depth, sigma), (other, _) = (state.depth(SCENE.rig) for state in (right, left_out))
    assert abs(depth - other) < 0.5 * sigma


def test_filter_keeps_the_patterns_error_at_rest() -> None:
    """Frames of one place average their noise, not the pattern's error, however far noise moves their fits."""
    pattern = 0.05**2 * np.eye(2)
    noise = 0.2**2 * np.eye(2)
    uv = exact()[1][0] + np.random.default_rng(5).normal(0.0, 0.2, (400, 2))
    state = first_state(SCENE.rig, uv[0], noise, pattern, 0.0, 0.0)
    per_px2 = state.covariance[:2, :2] / (0.2**2 + 0.05**2)
    for place in uv[1:]:
        state = updated(SCENE.rig, state, place, noise, pattern, 0.0, 0.0)
    variance_px2 = 0.5 * np.trace(np.linalg.solve(per_px2, state.covariance[:2, :2]))
    # 200 frames leave the pattern's variance and a 200th of the noise's; the map of a and b is that of the first frame,
    # whose place is off by 0.2 px: to some percent
    assert variance_px2 == pytest.approx(0.05**2 + 0.2**2 / 200, rel=0.1)


def test_readings_at_rest_tell_the_filter_nothing_of_the_distance() -> None:
    """Sharp positions at rest, readings that differ by their noise: the image follows none, as that of a far point."""
    rng, nothing = generator("film depth", "rest"), 1e-12 * np.eye(2)
    sharp = 0.005**2 * np.eye(2)
    readings = ENCODER_M * rng.standard_normal(200)
    uv = exact()[1][0] + 0.005 * rng.standard_normal((200, 2))
    state = first_state(SCENE.rig, uv[0], sharp, nothing, readings[0], ENCODER_M)
    before = state.mean[2], state.covariance[2, 2]
    for place, reading in zip(uv[1:], readings[1:], strict=True):
        state = updated(SCENE.rig, state, place, sharp, nothing, reading, ENCODER_M)
    assert (state.mean[2], state.covariance[2, 2]) == pytest.approx(before, rel=1e-9)
    assert state.frames > 190


def test_filter_follows_the_bundle_and_is_consistent() -> None:
    """Normalised squared errors of D of 20 filters: chi-square with 20 degrees, band of 1e-5; the same information."""
    squares, differences = [], []
    nothing = 1e-12 * np.eye(2)
    for number in range(FILTERS):
        positions, readings = drawn(number)
        depth, sigma = last_state(positions, readings, nothing).depth(SCENE.rig)
        squares.append(((depth - DEPTH_M) / sigma) ** 2)
        if number < 6:
            joint = film_depth(SCENE.rig, positions, readings, ENCODER_M)
            differences.append((depth - joint.depth_m) / joint.sigma_m)
            assert sigma == pytest.approx(joint.sigma_m, rel=0.1)
    low, high = scipy.stats.chi2.ppf([5e-6, 1 - 5e-6], FILTERS) / FILTERS
    assert low < np.mean(squares) < high
    # linearised in another order: a part of sigma
    assert np.abs(differences).max() < 0.3
