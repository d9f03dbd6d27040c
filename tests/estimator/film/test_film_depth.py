"""Depth of a film: bundle and filter against drawn errors, the pattern's covariance against drawn cameras."""

from functools import cache

import numpy as np
import pytest
from scipy import stats

from phibench.datasets.errors import DatasetError
from phibench.datasets.frames.sensor_card import card_of
from phibench.estimator.film.film_bundle import expected_sigma_m, film_depth
from phibench.estimator.film.film_positions import FilmPositions, fit_positions, stepped_positions
from phibench.estimator.film.recursive_filter import FilterState, first_state, updated
from phibench.estimator.geometry.rig_parameters import PARAMETERS
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.render.film.moving_rows import chief_uv_px
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.noise_tiles import NoiseStream
from phibench.render.sensor.settings import sensor
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.motion.carriage import Carriage
from phibench.scenes.motion.film_scene import FilmScene
from phibench.scenes.motion.film_times import FilmTimes
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig

FRAMES, FILMS, FILTERS = 24, 60, 20
NOISE_PX, ENCODER_M = 0.05, 3e-4
SPOT = LaserSpot((2.0, 1.0, 0.5), (-0.894427191, -0.447213595, 0.0), 5e-3)
SCENE = FilmScene(Rig(), SPOT, FilmTimes(FRAMES, 20.0, 1 / 60, 0.03, 720), Carriage((0.0, 0.5), (0.1, 0.1), 0.6, 4.0))
DEPTH_M = float(np.hypot(2.0, 1.0))
POINT = np.array(SPOT.position_world_m)


@cache
def exact() -> tuple[Array, Array]:
    """Offsets and exact positions by the simulator: its own solver of the reflection."""
    times = SCENE.times.frame_s
    return SCENE.offset_m(times), chief_uv_px(SCENE, times)


def drawn(number: int, noise_px: float = NOISE_PX, encoder_m: float = ENCODER_M) -> tuple[FilmPositions, Array]:
    offsets, uv = exact()
    rng = generator("film depth", number)
    each = np.broadcast_to(NOISE_PX**2 * np.eye(2), (FRAMES, 2, 2))
    noisy = uv + noise_px * rng.standard_normal(uv.shape)
    return FilmPositions(noisy, each, np.zeros((FRAMES, 2, FRAMES, 2))), offsets + encoder_m * rng.standard_normal(
        FRAMES
    )


def test_exact_positions_give_the_exact_point() -> None:
    offsets, uv = exact()
    positions = FilmPositions(uv, drawn(0)[0].noise_px2, drawn(0)[0].pattern_px2)
    found = film_depth(SCENE.rig, positions, offsets, ENCODER_M)
    # positions are good to 1e-9 px, and a pixel is about 0.1 m of depth
    np.testing.assert_allclose(found.point_world_m, POINT, atol=1e-8)
    assert found.chi2 < 1e-9


@pytest.mark.parametrize("understated", [False, True])
def test_bundle_errors_are_within_their_covariance(understated: bool) -> None:
    """60 films: mean of squared pulls, and of chi2, within the bands of 1e-5; noise twice as large is noticed."""
    pulls, chi2, offsets = [], [], []
    for number in range(FILMS):
        positions, readings = drawn(number, NOISE_PX * (2.0 if understated else 1.0))
        found = film_depth(SCENE.rig, positions, readings, ENCODER_M)
        error = found.point_world_m - POINT
        pulls.append(error @ np.linalg.solve(found.covariance_m2, error))
        offsets.append((found.offsets_m - exact()[0]) / found.offset_sigma_m)
        chi2.append(found.chi2)
    dof = 2 * FRAMES - 3
    low, high = stats.chi2.ppf([5e-6, 1 - 5e-6], 3 * FILMS) / FILMS
    ratio = np.sum(chi2) / (dof * FILMS)
    band = stats.chi2.ppf([5e-6, 1 - 5e-6], dof * FILMS) / (dof * FILMS)
    if understated:
        assert ratio > band[1]
        assert np.mean(pulls) > high
        return
    assert low < np.mean(pulls) < high
    assert band[0] < ratio < band[1]
    # offsets of one film share the point: at least 24 independent ones in 60 films
    assert np.mean(np.square(offsets)) == pytest.approx(1.0, abs=5 * np.sqrt(2.0 / (24 * 60)) + 0.1)
    assert (found.offset_sigma_m < ENCODER_M).all()


def test_filter_follows_the_bundle_and_is_consistent() -> None:
    """Normalised squared errors of D of 20 filters: chi-square with 20 degrees, band of 1e-5; the same information."""
    squares, differences = [], []
    nothing = 1e-12 * np.eye(2)
    for number in range(FILTERS):
        positions, readings = drawn(number)
        state: FilterState | None = None
        for k in range(FRAMES):
            uv, noise = positions.uv_px[k], positions.noise_px2[k]
            if state is None:
                state = first_state(SCENE.rig, uv, noise, nothing, readings[k])
            else:
                state = updated(SCENE.rig, state, uv, noise, nothing, readings[k], ENCODER_M)
        assert state is not None
        depth, sigma = state.depth(SCENE.rig)
        squares.append(((depth - DEPTH_M) / sigma) ** 2)
        if number < 6:
            joint = film_depth(SCENE.rig, positions, readings, ENCODER_M)
            differences.append((depth - joint.depth_m) / joint.sigma_m)
            assert sigma == pytest.approx(joint.sigma_m, rel=0.1)
    low, high = stats.chi2.ppf([5e-6, 1 - 5e-6], FILTERS) / FILTERS
    assert low < np.mean(squares) < high
    # linearised in another order: a part of sigma
    assert np.abs(differences).max() < 0.3


def test_a_rig_that_is_not_known_widens_the_claim() -> None:
    positions, readings = drawn(1)
    covariance = np.zeros((len(PARAMETERS),) * 2)
    covariance[PARAMETERS.index("tilt_x_rad")][PARAMETERS.index("tilt_x_rad")] = 2e-3**2
    covariance[PARAMETERS.index("stroke_relative")][PARAMETERS.index("stroke_relative")] = 1e-3**2
    plain, wide = (film_depth(SCENE.rig, positions, readings, ENCODER_M, c) for c in (None, covariance))
    assert wide.sigma_m > 1.1 * plain.sigma_m
    # a stroke that is too long by 1e-3 makes D too large by as much
    only = np.zeros_like(covariance)
    only[-1, -1] = 1e-3**2
    scale = film_depth(SCENE.rig, positions, readings, ENCODER_M, only)
    assert np.sqrt(scale.sigma_m**2 - plain.sigma_m**2) == pytest.approx(1e-3 * DEPTH_M, rel=0.15)


def test_the_bound_is_the_bundles_own_sigma() -> None:
    positions, readings = drawn(2)
    found = film_depth(SCENE.rig, positions, readings, ENCODER_M)
    bound = expected_sigma_m(SCENE.rig, POINT, exact()[0], positions, ENCODER_M)
    assert found.sigma_m == pytest.approx(bound, rel=0.02)  # derivatives at the estimate, 1 % off


def test_too_little_motion_is_a_sentence() -> None:
    positions, readings = drawn(3)
    with pytest.raises(DatasetError, match="two positions that are"):
        film_depth(SCENE.rig, positions.some(np.array([0, 1])), readings[:1].repeat(2), ENCODER_M)


def test_pattern_of_a_camera_is_the_claimed_covariance() -> None:
    """One place, 40 cameras of 6 frames: means of frames err by the pattern. 80 squares of pulls; band of 1e-5."""
    view = SCENE.rig.at(0.1)
    layer = spot_layer(view, SPOT, ())
    strong = sensor("bayer-raw", prnu=0.05, read_noise_e=1.0)
    card = card_of(strong)
    v0, u0 = layer.v0_px + 6, layer.u0_px + 6
    light = Light(np.full((3, 720, 1280), 4e3, np.float32), layer)
    box = Region(u0 - 14, v0 - 14, u0 + 14, v0 + 14)
    blur = spot_blur(SCENE.rig, np.array([u0, v0], float), DEPTH_M)
    squares, claims = [], []
    for seed in range(40):
        chain = Chain(strong, seed)
        frames = np.stack([chain.raw(light, NoiseStream(("pattern", seed, k)), box) for k in range(6)])
        found = fit_positions(frames, np.full((6, 2), (box.u0_px, box.v0_px)), card, SCENE.rig, blur)
        assert found.good.all()
        error = found.uv_px.mean(axis=0) - layer.centroid_uv_px
        total = found.covariance_px2().reshape(6, 2, 6, 2).mean(axis=(0, 2))
        squares.append(error @ np.linalg.solve(total, error))
        claims.append(found.pattern_px2.mean(axis=(0, 2))[0, 0] / total[0, 0])
    assert np.mean(claims) > 0.7  # most of it is pattern: six frames have averaged the noise
    low, high = stats.chi2.ppf([5e-6, 1 - 5e-6], 80) / 40
    assert low < np.mean(squares) < high


def test_one_step_from_a_near_place_is_the_fit() -> None:
    """Fits of bright spots, and one step from 0.05 px beside them: the step is linear to 0.05^2 px; 6 frames."""
    view, strong = SCENE.rig.at(0.1), sensor("bayer-raw")
    layer, card = spot_layer(view, SPOT, ()), card_of(strong)
    v0, u0 = layer.v0_px + 6, layer.u0_px + 6
    light = Light(np.full((3, 720, 1280), 4e3, np.float32), layer)
    box, chain = Region(u0 - 14, v0 - 14, u0 + 14, v0 + 14), Chain(strong, 1)
    frames = np.stack([chain.raw(light, NoiseStream(("step", k)), box) for k in range(6)])
    origins = np.full((6, 2), (box.u0_px, box.v0_px))
    blur = spot_blur(SCENE.rig, np.array([u0, v0], float), DEPTH_M)
    fit = fit_positions(frames, origins, card, SCENE.rig, blur)
    stepped = stepped_positions(frames, origins, card, SCENE.rig, blur, fit.uv_px + 0.05)
    np.testing.assert_allclose(stepped.uv_px, fit.uv_px, atol=5e-3)
    np.testing.assert_allclose(stepped.noise_px2, fit.noise_px2, rtol=0.2, atol=1e-6)
