"""Times of the sensor chain, `pytest --benchmark-enable --benchmark-only`; targets are stated, not asserted."""

from __future__ import annotations

import itertools

import pytest
from sensor_light import room

from phibench.render.chain import Chain
from phibench.render.electrons import _pattern
from phibench.render.region import Region
from phibench.render.sensor import sensor
from phibench.render.tiles import NoiseStream

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
