"""Noise streams: what a frame depends on, and on nothing else."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from helpers.sensor_light import room

from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import TILE_PX, NoiseStream, frame_stream, normal, poisson, speckle_gain
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.settings import sensor
from phibench.scenes.random_streams import philox_key

SIZE = (128, 128)
PIXELS = SIZE[0] * SIZE[1]
LIGHT = Light.flat((2e4, 2e4, 2e4), SIZE)  # 1000 e- at 1/60 s in a pixel without filter
# 6 sigma of a correlation of PIXELS pairs: false alarm 2e-9 each
LIMIT = 6.0 / np.sqrt(PIXELS)


def names(seed: int = 0, position: str = "down", laser: str = "on", draw: int = 0) -> NoiseStream:
    return frame_stream("paper", seed, "table2-d3.180-h0.425", position, laser == "on", draw)


def residual(stream: NoiseStream, camera_seed: int = 0, **changes: float) -> np.ndarray:
    chain = Chain(sensor("mono-raw", analogue_gain=4.0, **changes), camera_seed)
    frame = chain.frame(LIGHT, stream).astype(float).ravel()
    return frame - frame.mean()


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a, b)[0, 1])


def test_frames_of_different_names_are_independent() -> None:
    """Down and up, on and off, draws 0, 1, 2, seeds 0 and 1; fixed pattern off."""
    streams = [names(), names(position="up"), names(laser="off"), names(draw=1), names(draw=2), names(seed=1)]
    frames = [residual(stream, prnu=0.0, dsnu_e=0.0) for stream in streams]
    pairs = list(itertools.combinations(frames, 2))
    assert len(pairs) == 15
    assert max(abs(correlation(a, b)) for a, b in pairs) < LIMIT
    # and shifted by whole tiles, where counters that overlap would show
    shifted = [np.roll(frame.reshape(SIZE), TILE_PX, axis=axis).ravel() for frame in frames for axis in (0, 1)]
    assert max(abs(correlation(a, b)) for a in frames for b in shifted) < LIMIT


def test_the_same_names_give_the_same_frame() -> None:
    first = residual(names())
    residual(names(draw=5))
    np.testing.assert_array_equal(residual(names()), first)
    assert correlation(residual(names()), first) > LIMIT  # the measure itself sees dependence


def test_the_same_names_give_the_same_flicker() -> None:
    """Speckle is drawn once per frame, from the frame's own stream."""
    chosen = sensor("mono-raw", speckle_m=4.0)
    gains = [speckle_gain(chosen, names(draw=draw)) for draw in range(8)]
    assert gains == [speckle_gain(chosen, names(draw=draw)) for draw in range(8)]
    assert len(set(gains)) == 8


def test_another_process_draws_the_same(python) -> None:
    code = """
import hashlib
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.light import Light
from phibench.render.sensor.settings import sensor
from phibench.render.sensor.electrons import NoiseStream
light = Light.flat((6e4, 6e4, 6e4), (48, 48))
frame = Chain(sensor("mjpeg")).frame(light, NoiseStream(("paper", 0, "s", "up", "on", 3)))
print(hashlib.sha256(frame.tobytes()).hexdigest())
"""
    digests = {python(code, PYTHONHASHSEED=seed).stdout for seed in ("1", "2")}
    assert len(digests) == 1
    assert len(digests.pop().strip()) == 64


def test_the_fixed_pattern_belongs_to_the_camera() -> None:
    """At 1000 e- it has the variance 10^2 + 1.5^2 of 1000 + 16 + 1 + 102 e-^2: a correlation of 0.0914."""
    same = correlation(residual(names()), residual(names(draw=1)))
    assert same == pytest.approx(0.0914, abs=LIMIT)
    assert abs(correlation(residual(names()), residual(names(draw=1), camera_seed=1))) < LIMIT
    assert abs(correlation(residual(names(), prnu=0.2), residual(names(draw=1), dsnu_e=500.0, prnu=0.0))) < LIMIT


def test_switching_a_stage_off_leaves_the_others_alone() -> None:
    quiet = residual(names(), read_noise_e=0.0)
    loud = residual(names())
    # read noise 4 e- beside sqrt(1000): the shot noise is the same draw
    assert correlation(quiet, loud) > 0.97


def test_seed_0_and_draw_0_are_streams_like_others() -> None:
    keys = [tuple(philox_key(*names(seed, draw=draw).names)) for seed in range(20) for draw in range(20)]
    assert len(set(keys)) == 400
    assert len({word for key in keys for word in key}) == 800
    assert residual(names(0, draw=0)).std() > 0


def test_a_tile_does_not_care_what_its_neighbour_holds() -> None:
    """Poisson draws take a variable number of random numbers; a neighbour's mean must not shift them."""
    region, mean = Region(0, 0, 96, 64), np.full((64, 96), 30.0)
    before = poisson(names(), mean, region)
    mean[:, :32] = 2000.0
    after = poisson(names(), mean, region)
    np.testing.assert_array_equal(before[:, 32:], after[:, 32:])
    assert (before[:, :32] != after[:, :32]).all()


def test_no_two_tiles_are_alike() -> None:
    image = normal(names(), Region.whole((256, 256)))
    tiles = image.reshape(8, 32, 8, 32).swapaxes(1, 2).reshape(64, -1)
    matrix = np.corrcoef(tiles) - np.eye(64)
    # 2016 pairs, 6.5 sigma: 2016 x 8e-11
    assert np.abs(matrix).max() < 6.5 / TILE_PX


def test_laser_off_is_the_room_alone() -> None:
    light = room((64, 96))
    ideal = Chain(sensor("ideal"))
    on, off = (ideal.frame(x, names()) for x in (light, light.laser_off()))
    flux = (on - off).sum(axis=(1, 2))
    # all of the spot is inside; rounding of sums of 6144 values of 1e4
    np.testing.assert_allclose(flux, np.array([1.0, 0.1, 0.03]) * 9e5 / 60.0, rtol=1e-6)
    np.testing.assert_allclose(off, light.ambient_electrons_per_s.astype(float) / 60.0, rtol=1e-12)
