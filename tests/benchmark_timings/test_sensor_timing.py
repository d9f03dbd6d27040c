"""Times of the sensor chain, `pytest --benchmark-enable --benchmark-only`; targets are stated, not asserted."""

from __future__ import annotations

import itertools

import pytest
from helpers.sensor_light import moving, room

from phibench.datasets.frames.frame_request import FrameRequest
from phibench.datasets.frames.frame_source import FrameSource, PositionLight
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream, _pattern
from phibench.render.sensor.light import Region
from phibench.render.sensor.settings import sensor

LIGHT = room((720, 1280))
STREAM = NoiseStream(("benchmark", 0))
REGION = Region.around(768.3, 359.8, LIGHT.size)


@pytest.mark.benchmark(group="sensor")
@pytest.mark.parametrize("preset", ["bayer-raw", "srgb8", "mjpeg"])
def test_benchmark_pair_of_whole_frames(benchmark, preset: str) -> None:
    """Target: <= 0.4 s on one core for the two frames 1280 x 720 of a pair, mjpeg."""
    chain, draws = Chain(sensor(preset)), itertools.count()

    def pair() -> int:
        k = next(draws)
        return sum(int(chain.frame(LIGHT, STREAM.stage(position, k)).max()) for position in ("down", "up"))

    assert benchmark(pair) > 0


@pytest.mark.benchmark(group="sensor")
@pytest.mark.parametrize("preset", ["bayer-raw", "srgb8", "mjpeg"])
def test_benchmark_region(benchmark, preset: str) -> None:
    """Target: <= 3 ms on one core for 64 x 64 pixels, JPEG included; the camera's pattern there is known already."""
    chain, draws = Chain(sensor(preset)), itertools.count()
    assert benchmark(lambda: chain.frame(LIGHT, STREAM.stage(next(draws)), REGION).max()) > 0


@pytest.mark.benchmark(group="sensor")
def test_benchmark_region_of_a_new_camera(benchmark) -> None:
    """As above, the fixed pattern drawn anew each time."""
    chain, draws = Chain(sensor("mjpeg")), itertools.count()

    def region() -> int:
        _pattern.cache_clear()
        return int(chain.frame(LIGHT, STREAM.stage(next(draws)), REGION).max())

    assert benchmark(region) > 0


def source(region: Region, preset: str = "mjpeg", velocity: tuple[float, float] = (0.0, 0.0), **changes) -> FrameSource:
    """Source of a pair whose layers are read already."""
    s = sensor(preset, **changes)
    side = PositionLight(Chain(s), moving(LIGHT, velocity, s), region)
    return FrameSource(FrameRequest(preset, overrides=changes), ("benchmark", 0, "s"), {"down": side, "up": side})


def rounds(benchmark, pair: FrameSource) -> None:
    draws = itertools.count()
    assert len(benchmark(lambda: pair.frames(next(draws))).by_name) == 2


@pytest.mark.benchmark(group="frames")
def test_benchmark_frames_of_a_pair(benchmark) -> None:
    """Target: <= 0.4 s on one core for `source.frames(k)`, 1280 x 720, mjpeg, file and decoded image of both."""
    rounds(benchmark, source(Region.whole(LIGHT.size)))


CASES = {
    "bayer-raw": {"preset": "bayer-raw"},
    "srgb8": {"preset": "srgb8"},
    "mjpeg": {},
    "4:2:0": {"jpeg_subsampling": "4:2:0"},
    "sharpened": {"sharpen_amount": 0.5},
    "moving": {"velocity": (100.0, -50.0)},
}


@pytest.mark.benchmark(group="frames")
@pytest.mark.parametrize("case", CASES)
def test_benchmark_region_frames_of_a_pair(benchmark, case: str) -> None:
    """Target: <= 6 ms on one core for `source.frames(k)`, two squares of 64 x 64 pixels: 3 ms each."""
    rounds(benchmark, source(REGION, **CASES[case]))
