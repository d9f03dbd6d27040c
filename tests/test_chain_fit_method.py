"""The seat method `chain_fit` on whole frames of a default rig, and the blur that it takes."""

from __future__ import annotations

import numpy as np
import pytest
from chain_scenes import COLLECTED, ROOM
from sensor_light import spot_at

from phibench.datasets.sensor_card import card_of
from phibench.estimator.methods.chain_fit import chain_fit
from phibench.estimator.seat.pair import Box, Pair
from phibench.estimator.spot_blur import spot_blur
from phibench.render.chain import Chain
from phibench.render.light import Light
from phibench.render.sensor import sensor
from phibench.render.tiles import NoiseStream
from phibench.scenes.rig import Rig

RIG = Rig()
PLACES = {"down": np.array([430.3, 300.2]), "up": np.array([470.6, 320.8])}


def pair_of(preset: str, off: bool, stripes: bool = False) -> Pair:
    """Spots of 5000 collected electrons over a room of 100 e-, flat or with vertical stripes of 8 and 400 e-."""
    s = sensor(preset)
    room = np.full((720, 1280), 100.0 / s.exposure_s)
    if stripes:
        room[:, np.arange(1280) // 5 % 2 == 0] *= 4.0
    images = {}
    for position, uv in PLACES.items():
        spot = spot_at(*uv, spot_blur(RIG, uv)[0], 5000.0 / COLLECTED / s.exposure_s)
        light = Light(ROOM[:, None, None] * room, spot)
        images[position] = Chain(s).frame(light, NoiseStream(("method", position, stripes)))
        if off:
            dark = NoiseStream(("method", position, "off", stripes))
            images[f"{position}_off"] = Chain(s).frame(light.laser_off(), dark)
    boxes = {f"box_{p}": Box(int(uv[0]) - 12, int(uv[1]) - 9, 21, 21) for p, uv in PLACES.items()}
    return Pair(number=0, rig=RIG, stroke_m=0.5, card=card_of(s), **images, **boxes)


@pytest.mark.parametrize("off", [False, True])
@pytest.mark.parametrize("preset", ["srgb8", "mjpeg"])
def test_both_spots_are_found(preset: str, off: bool) -> None:
    """Within 6 of its own standard deviations, and those below 0.06 px."""
    answer = chain_fit(pair_of(preset, off))
    for position, spot in (("down", answer.down), ("up", answer.up)):
        assert spot.status == "ok"
        assert spot.uv_px is not None
        sd = np.sqrt(np.diag(np.array(spot.covariance_px2)))
        assert (np.abs(np.array(spot.uv_px) - PLACES[position]) < 6.0 * sd).all()
        assert (sd < 0.06).all()


@pytest.mark.parametrize("preset", ["srgb8", "mjpeg"])
def test_a_striped_room_behind_the_spot_is_taken_from_the_off_frame(preset: str) -> None:
    """Stripes of 5 px and 300 e-: with the off frame within 0.15 px."""
    answer = chain_fit(pair_of(preset, off=True, stripes=True))
    for position, spot in (("down", answer.down), ("up", answer.up)):
        assert spot.uv_px is not None, spot.status
        assert np.abs(np.array(spot.uv_px) - PLACES[position]).max() < 0.15


def test_raw_images_are_refused() -> None:
    raw = np.zeros((720, 1280), np.uint16)
    answer = chain_fit(Pair(0, raw, raw, RIG, 0.5, card_of(sensor("bayer-raw"))))
    assert "needs srgb8 or mjpeg" in answer.down.status


def test_blur_grows_with_defocus_across_the_radius() -> None:
    """Spot layers at 4 m have the axes 0.703 and 0.761 px, 0.2 px of spot at 2 m left out, the long one tangential."""
    sigma_u, ratio = spot_blur(RIG, (430.0, 359.5))  # left of the centre: the radius runs along u
    assert sigma_u == pytest.approx(0.70, abs=0.01)
    assert sigma_u * ratio == pytest.approx(0.76, abs=0.015)
    assert spot_blur(RIG, (639.5, 150.0))[1] < 0.95
    assert spot_blur(RIG, (5.0, 5.0)) == (RIG.camera.blur_sigma_px, 1.0)
