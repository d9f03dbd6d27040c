"""Methods on pairs of several frames per position: claims that fall and hold, and a method that knows of one frame."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from helpers.chain_scenes import COLLECTED, ROOM
from helpers.sensor_light import spot_at

from phibench.benchmark.isolation.example_method import extract
from phibench.datasets.frames.sensor_card import card_of
from phibench.estimator.interface import Box, Pair, Spot
from phibench.estimator.methods.chain_fit import chain_fit
from phibench.estimator.methods.raw_likelihood import raw_maximum_likelihood
from phibench.estimator.methods.spot_search import each_spot_twice
from phibench.estimator.processed.quasi_score import shared_covariance
from phibench.estimator.spots.detect import detect
from phibench.estimator.spots.raw_pixels import GaussLaw, PixelNoise
from phibench.estimator.spots.spot_prediction import spot_blur
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light
from phibench.render.sensor.settings import sensor
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig
from phibench.studies.image_cutout import cut_region, cut_rig

PART = cut_region([(430.3, 300.2), (470.6, 320.8)], (720, 1280), 48)
RIG = cut_rig(Rig(), PART)
PLACES = {p: np.array(uv) - [PART.u0_px, PART.v0_px] for p, uv in (("down", (430.3, 300.2)), ("up", (470.6, 320.8)))}
PRESETS = ("bayer-raw", "srgb8", "yuyv", "mjpeg")
SPOT_E, ROOM_E = 6000.0, 400.0


@lru_cache
def pair_of(preset: str, count: int) -> Pair:
    """Spots over a flat room, on a part of the image, `count` frames on and as many off."""
    s = sensor(preset)
    room = ROOM[:, None, None] * np.full(PART.shape, ROOM_E / s.exposure_s)
    frames = {}
    for position, uv in PLACES.items():
        light = Light(room, spot_at(*uv, spot_blur(RIG, uv).sigma_px, SPOT_E / COLLECTED / s.exposure_s))
        for name, kind in ((position, light), (f"{position}_off", light.laser_off())):
            frames[name] = [Chain(s).frame(kind, NoiseStream(("several", name, k))) for k in range(count)]
    boxes = {f"box_{p}": Box(int(uv[0]) - 12, int(uv[1]) - 9, 21, 21) for p, uv in PLACES.items()}
    return Pair.of_frames(0, frames, rig=RIG, stroke_m=0.5, card=card_of(s), **boxes)


def spots_of(preset: str, count: int) -> dict[str, Spot]:
    method = each_spot_twice(raw_maximum_likelihood) if preset == "bayer-raw" else chain_fit
    answer = method(pair_of(preset, count))
    return {"down": answer.down, "up": answer.up}


@pytest.mark.parametrize("preset", PRESETS)
def test_claims_fall_with_the_frames_and_hold(preset: str) -> None:
    """Six frames: 0.41 of one's claims but for what frames share; PRNU and a JPEG's steps leave 0.65 at most."""
    one, many = spots_of(preset, 1), spots_of(preset, 6)
    for position, uv in PLACES.items():
        claims = []
        for spot in (one[position], many[position]):
            assert spot.uv_px is not None, spot.status
            sigma = np.sqrt(np.diag(np.array(spot.covariance_px2)))
            assert (np.abs(np.array(spot.uv_px) - uv) < 4.5 * sigma).all()  # 16 coordinates: 1e-4 by chance
            claims.append(float(np.hypot(*sigma)))
        assert 0.3 < claims[1] / claims[0] < 0.65


@pytest.mark.parametrize("preset", PRESETS)
def test_a_method_for_one_frame_works_on_means(preset: str) -> None:
    """The example knows images alone; on six frames' means it is within half a pixel, as on single ones."""
    if preset == "yuyv":  # its red plane is the bytes' first: what a stranger's method makes of yuyv is its own affair
        pytest.skip("the example is for R, G, B and raw pixels")
    answer = extract(pair_of(preset, 6))
    for position, uv in PLACES.items():
        spot = getattr(answer, position)
        assert spot.uv_px is not None, spot.status
        assert np.hypot(*(np.array(spot.uv_px) - uv)) < 0.5


def test_raw_significance_rises_with_the_frames() -> None:
    """6 frames: 2.45 times the significance, less what a misfit of the spot's shape takes off a strong spot."""
    one, many = (detect(pair_of("bayer-raw", count)).down for count in (1, 6))
    assert one is not None
    assert many is not None
    assert 1.7 < many.significance / one.significance < 2.6


def test_law_of_a_mean_keeps_what_frames_share() -> None:
    """Means of 4 frames of pixels with a pattern, drawn: 20 000 variances are good to 1 %, asserted to 4 %."""
    rng, frames, prnu, room = generator("frames", "law"), 4, 0.05, 500.0
    law = GaussLaw(PixelNoise(16.0), 9.0, frames, prnu, room)
    for mean in (600.0, 3000.0):
        own = rng.normal(size=(frames, 20_000)) * np.sqrt(mean + 16.0)
        shared = rng.normal(size=(2, 20_000)) * [[3.0], [prnu * (mean - room)]]
        drawn = own.mean(axis=0) + shared.sum(axis=0)
        assert 1.0 / float(law.information(np.array(mean))) == pytest.approx(np.var(drawn), rel=0.04)


@pytest.mark.parametrize(("own", "shared"), [(0.05, 0.4), (0.2, 0.4), (0.2, 0.15), (0.5, 0.3)])
def test_covariance_of_two_quantised_frames(own: float, shared: float) -> None:
    """Against drawn pairs of frames, places spread evenly over the step; the largest gap of the formula is 8 %."""
    rng, n = generator("frames", "steps"), 400_000
    place = rng.uniform(-0.5, 0.5, n)
    common = place + rng.normal(size=n) * shared
    first, second = (np.rint(common + rng.normal(size=n) * own) - place for _ in range(2))
    drawn = float(np.mean(first * second))
    one = np.ones(1)
    found = shared_covariance(np.full((1, 1), shared), np.zeros(1), np.hypot(own, shared) * one, one, one)
    # places spread evenly: the error of the expected output over them is in the drawn product, and no random error
    over_places = float(np.mean(first) ** 2)
    expected = float(found[0, 0]) + over_places + _bias_square(np.hypot(own, shared))
    assert drawn == pytest.approx(expected, rel=0.08)


def _bias_square(sigma: float) -> float:
    """Mean square over places of the expected error of a rounded Gaussian, steps squared."""
    k = np.arange(1, 60)
    return float(np.sum(np.exp(-4.0 * np.pi**2 * k**2 * sigma**2) / k**2) / (2.0 * np.pi**2))
