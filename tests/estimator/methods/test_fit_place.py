"""Fits begin where the spot was detected, and say nothing of a place that they left it for."""

from dataclasses import replace

import numpy as np
import pytest

from phibench.benchmark.isolation.easy_pairs import EasyPairs
from phibench.estimator.interface import Answer, Pair, Spot
from phibench.estimator.methods.registry import METHODS
from phibench.estimator.methods.spot_search import SharedPair, at_detection, left_px, pair_detection, red_peak
from phibench.estimator.spots.detect import Detection
from phibench.estimator.spots.fit_raw import fit_law
from phibench.estimator.spots.gaussian_spot import SpotBlur, SpotModel
from phibench.estimator.spots.raw_pixels import GaussLaw, PixelNoise, spot_regions

DIM = 0.04  # of the easy spots' light
LAMP_E, LAMP_PX, BESIDE_PX = 9000.0, 9, 9  # a lamp's light, its side, and how far its middle is from the spot


def beside_a_lamp(number: int) -> tuple[Pair, dict[str, np.ndarray]]:
    """Easy pair whose spots are dim, each beside a lamp that is on in both frames, with the true places.

    A lamp's pixel has a noise of sqrt(2 x 9000) = 134 e in on - off, a spot's brightest pixel some 100 e: in electrons
    the lamp's noise stands out, over its noise the spot does.
    """
    pairs = EasyPairs("bayer-raw")
    pair, truth, random = pairs.pair(number), pairs.truth(number), np.random.default_rng(number)
    images = {}
    for position in ("down", "up"):
        off = pair.images[f"{position}_off"].astype(float)
        on = off + DIM * (pair.images[position].astype(float) - off)
        u, v = (round(x) for x in getattr(truth, position).uv_px)
        low = u + BESIDE_PX - LAMP_PX // 2, v - LAMP_PX // 2
        lamp = slice(low[1], low[1] + LAMP_PX), slice(low[0], low[0] + LAMP_PX)
        for image in (on, off):
            light_e = random.normal(LAMP_E, np.sqrt(LAMP_E), (LAMP_PX, LAMP_PX))
            image[lamp] += pair.card.dn_per_e * light_e
        images |= {position: on, f"{position}_off": off}
    whole = {name: np.clip(np.rint(image), 0, pair.card.top_dn).astype(np.uint16) for name, image in images.items()}
    return replace(pair, **whole), {p: np.array(getattr(truth, p).uv_px) for p in ("down", "up")}


@pytest.mark.parametrize("number", range(3))
def test_a_lamps_noise_draws_no_fit_away(number: int) -> None:
    """0.5 px: three times the bound of 900 electrons behind a mosaic, 0.15 px."""
    pair, truth = beside_a_lamp(number)
    shared, drawn = SharedPair.of(pair), 0
    found = pair_detection(shared)
    for method in ("raw_maximum_likelihood", "joint_fit"):
        answer: Answer = METHODS[method](shared)
        for position, true in truth.items():
            assert np.hypot(*(getattr(found, position).uv_px - true)) < 1.0
            assert np.hypot(*(getattr(answer, position).uv_px - true)) < 0.5
    for position, true in truth.items():  # the trap is one: the brightest place in electrons is the lamp's
        red = pair.images[position].astype(float)[::2, ::2] - pair.images[f"{position}_off"].astype(float)[::2, ::2]
        u, v = (int(x) // 2 for x in true)
        peak = red_peak(red[v - 7 : v + 8, u - 7 : u + 8])
        drawn += peak is not None and np.hypot(2.0 * (peak[0] - 7), 2.0 * (peak[1] - 7)) > 3.0
    assert drawn >= 1


def test_a_fit_begins_near_the_place_that_it_is_given() -> None:
    """Two spots 8 px apart, the other one four times as bright; noise-free, so that only rounding is left."""
    v, u = np.indices((21, 21))
    one, other = np.array([6.3, 9.8]), np.array([14.1, 10.4])

    def light(flux: float, place: np.ndarray) -> np.ndarray:
        return flux / (2.0 * np.pi) * np.exp(-0.5 * ((u - place[0]) ** 2 + (v - place[1]) ** 2))

    x = (50.0 + light(2000.0, one) + light(8000.0, other))[None]
    regions, law = spot_regions(x, (100, 200)), GaussLaw(PixelNoise(16.0))
    blur, model = SpotBlur(1.0), SpotModel(None)
    near = fit_law(regions, law, blur, model, one + (100.8, 199.3)).uv_px[0]
    assert np.hypot(*(near - one - (100, 200))) < 0.5  # the other one's light pulls
    assert np.hypot(*(fit_law(regions, law, blur, model).uv_px[0] - other - (100, 200))) < 0.5


@pytest.mark.parametrize(
    ("apart", "sigma", "z", "left"),
    [
        (0.9, 0.01, 60.0, False),  # a detection on interpolated pixels is up to 0.9 px off
        (1.3, 0.01, 60.0, True),  # 1 + 4 hypot(0.01, 1 / 60) = 1.08
        (1.3, 0.1, 20.0, False),  # 1 + 4 hypot(0.1, 0.05) = 1.45
        (1.9, 3.0, 5.0, False),
        (2.1, 3.0, 5.0, True),  # whatever is claimed
    ],
)
def test_a_fit_that_left_its_detection_is_not_answered(apart: float, sigma: float, z: float, left: bool) -> None:
    found = Detection((640.0, 360.0), 1000.0, z)
    spot = Spot((640.0 + apart, 360.0), ((sigma**2, 0.0), (0.0, sigma**2)))
    assert (left_px(found, spot) is not None) == left
    answer = at_detection(found, spot)
    assert answer == (Spot(found.uv_px) if left else spot)
    assert at_detection(found, Spot.missing("not converged")) == Spot(found.uv_px)
    assert at_detection(None, spot) == spot
