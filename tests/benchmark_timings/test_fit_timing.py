"""Times of the limits and fits, `pytest --benchmark-enable --benchmark-only`; targets are stated, not asserted."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.chain_scenes import COLLECTED, MIDDLE, SQUARE, UNITS, scene
from helpers.sensor_light import spot_at

from phibench.datasets.exposures.expected_electrons import expected_of_light
from phibench.datasets.frames.sensor_card import card_of
from phibench.estimator.geometry.status import Status
from phibench.estimator.limits.position_bound import NOISE_MODELS, spot_limit
from phibench.estimator.limits.processed_bound import chain_limit
from phibench.estimator.processed.fit_processed_images import fit_jpeg, fit_srgb
from phibench.estimator.spots.fit_raw import fit_raw
from phibench.estimator.spots.gaussian_spot import LASER_RESPONSE, SpotBlur, SpotModel
from phibench.estimator.spots.raw_pixels import PixelNoise
from phibench.estimator.spots.simple_spots import SIMPLE_METHODS
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light
from phibench.render.sensor.settings import sensor
from phibench.scenes.random_streams import generator

SPOTS = 256
LIGHT = Light(np.full((3, 48, 48), 6e3), spot_at(24.3, 23.8, 0.7, 3e5))
REGION = expected_of_light(LIGHT, sensor("bayer-raw"))


def noisy() -> np.ndarray:
    """256 regions of 13 x 13 pixels around the same spot."""
    v, u = 24 - REGION.v0_px, 24 - REGION.u0_px
    mean = REGION.mean_e[v - 6 : v + 7, u - 6 : u + 7]
    return generator("fit benchmark").poisson(mean, (SPOTS, 13, 13)).astype(float)


@pytest.mark.benchmark(group="fit")
@pytest.mark.parametrize("case", ["mono", "bayer", "bayer, known background", "bayer, free width"])
def test_benchmark_fit_of_256_spots(benchmark, case: str) -> None:
    """Target: <= 2 ms per spot on one core, so 0.5 s for the call."""
    response = None if case == "mono" else LASER_RESPONSE
    background = np.full((13, 13), 100.0) if "known" in case else None
    x, noise = noisy(), PixelNoise(16.0)
    model = SpotModel(response, background, "free" in case)
    fit = benchmark(lambda: fit_raw(x, (18, 18), noise, SpotBlur(0.7), model))
    assert (fit.status == Status.OK).mean() > 0.99


@pytest.mark.benchmark(group="fit")
@pytest.mark.parametrize("name", SIMPLE_METHODS)
def test_benchmark_simple_method_on_256_spots(benchmark, name: str) -> None:
    x = noisy()
    assert (benchmark(lambda: SIMPLE_METHODS[name](x)).status == Status.OK).mean() > 0.9


@pytest.mark.benchmark(group="limit")
@pytest.mark.parametrize("model", NOISE_MODELS)
def test_benchmark_limit_of_one_spot(benchmark, model: str) -> None:
    card = card_of(sensor("bayer-raw"))
    assert benchmark(lambda: spot_limit(REGION, card, model=model).rms_px) > 0


@pytest.mark.benchmark(group="chain")
@pytest.mark.parametrize("preset", ["srgb8", "mjpeg"])
def test_benchmark_fit_through_the_chain_of_a_pair(benchmark, preset: str) -> None:
    """Two spots, 5000 collected electrons over 100 e-; target: <= 100 ms on one core."""
    s = sensor(preset)
    box = UNITS if preset == "mjpeg" else SQUARE
    light = scene(MIDDLE, 0.7, 5000.0 / COLLECTED, 100.0, s)
    frames = np.stack([Chain(s).frame(light, NoiseStream(("benchmark", k)), box) for k in range(2)])
    fit = fit_jpeg if preset == "mjpeg" else fit_srgb
    fit(frames, (box.u0_px, box.v0_px), card_of(s), SpotBlur(0.7))  # tables of the card are computed once
    assert (benchmark(lambda: fit(frames, (box.u0_px, box.v0_px), card_of(s), SpotBlur(0.7)).status) == Status.OK).all()


@pytest.mark.benchmark(group="chain")
@pytest.mark.parametrize("preset", ["srgb8", "mjpeg"])
def test_benchmark_chain_limit(benchmark, preset: str) -> None:
    card = card_of(sensor(preset))
    levels = (100.0, 90.0, 60.0)
    assert benchmark(lambda: chain_limit(card, (48.3, 32.2), SpotBlur(0.7), 5000.0 / COLLECTED, levels).rms_px) > 0
