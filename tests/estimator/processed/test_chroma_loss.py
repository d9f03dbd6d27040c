"""Raw pixels behind averaged chroma, against the simulator's own chain."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.chain_scenes import ROOM
from helpers.sensor_light import spot_at
from scipy.ndimage import gaussian_filter

from phibench.datasets.frames.sensor_card import card_of
from phibench.estimator.processed.inverse_processing import electrons_before_chroma_loss, unprocessed_electrons
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import NoiseStream
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.settings import Sensor, sensor
from phibench.scenes.frames import Array

PART = Region(400, 296, 464, 328)


def striped_room(s: Sensor) -> Light:
    """Oblique stripes, 5 px wide, of 150 and 2800 e-, with the lens's blur of 0.8 px."""
    v, u = np.mgrid[:720, :1280]
    edges = gaussian_filter(np.where((u + v) // 7 % 2 == 0, 2800.0, 150.0), 0.8)
    return Light(ROOM[:, None, None] * edges / s.exposure_s, spot_at(430.3, 310.2, 0.8, 1.0)).laser_off()


@pytest.mark.parametrize(("preset", "subsampling"), [("yuyv", "4:2:2"), ("mjpeg", "4:2:2"), ("mjpeg", "4:2:0")])
def test_raw_pixels_come_back_from_averaged_chroma(preset: str, subsampling: str) -> None:
    """The simulator's own chain without noise: less than half of the error is left, that of rounding.

    R, G, B are rounded, Y', Cb and Cr twice, R, G, B again: of R some 8 times the variance of
    `unprocessed_electrons`. What gives an own colour 0.7 of its change back makes 1.4 times of it, 4
    deviations in all; 4:2:0 5. The loss is 6 to 14.
    """
    quiet = {"shot_noise": False, "read_noise_e": 0.0, "prnu": 0.0, "dsnu_e": 0.0, "jpeg_quality": 100}
    s = sensor(preset, jpeg_subsampling=subsampling, **quiet)
    light = striped_room(s)
    origin = np.array([[PART.u0_px, PART.v0_px]])
    seen, rounding = unprocessed_electrons(
        Chain(s).frame(light, NoiseStream(("loss",)), PART)[None], origin, card_of(s)
    )
    photo = Chain(s.replace(output="raw")).photo_electrons(light, PART)
    inner = (slice(6, -6), slice(6, -6))

    def rms(x: Array) -> float:
        return float(np.sqrt(np.mean(((x[0] - photo) / np.sqrt(rounding[0]))[inner] ** 2)))

    assert rms(electrons_before_chroma_loss(seen, origin, card_of(s))) < 0.5 * rms(seen)


def test_other_outputs_lose_nothing() -> None:
    x = np.ones((1, 8, 8))
    assert electrons_before_chroma_loss(x, np.zeros((1, 2), np.int64), card_of(sensor("srgb8"))) is x
    assert (
        electrons_before_chroma_loss(x, np.zeros((1, 2), np.int64), card_of(sensor("mjpeg", jpeg_subsampling="4:4:4")))
        is x
    )
