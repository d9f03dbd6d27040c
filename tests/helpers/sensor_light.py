"""Light for the tests of the sensor: a textured room and a pixel-integrated Gaussian spot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.store.layers import SpotWindow
from phibench.render.optics.spot_layer import SpotLayer, splat
from phibench.render.optics.spot_samples import FilmCloud
from phibench.render.sensor.light import Light, moved_spot
from phibench.render.sensor.processing import _ALPHA, _BETA, colour_corrected, white_balanced
from phibench.render.sensor.settings import Sensor
from phibench.render.sensor.srgb import srgb_decoded
from phibench.scenes.frames import Array

FILTERS = np.array([1.0, 0.10, 0.03])


def spot_at(u: float, v: float, sigma_px: float = 0.8, electrons_per_s: float = 9e5) -> SpotLayer:
    """Spot layer of a point, blurred: exact values and derivatives."""
    return splat(FilmCloud(np.array([[u, v]]), np.array([1.0])), sigma_px, electrons_per_s * FILTERS)


def room(size: tuple[int, int], seed: int = 7) -> Light:
    """Textured room of (height, width) with a spot right of the middle; some pixels saturate at 1/60 s."""
    rates = np.random.default_rng(seed).uniform(0.0, 8e5, (3, *size)).astype(np.float32)
    return Light(rates, spot_at(0.6 * size[1] + 0.3, 0.5 * size[0] - 0.2))


def moving(light: Light, velocity_px_per_s: tuple[float, float], sensor: Sensor) -> Light:
    """The same view with its spot as the sensor's rolling shutter sees it."""
    assert light.spot is not None
    u0, v0, planes = moved_spot(light.spot, velocity_px_per_s, sensor.exposure_s, sensor.readout_s, light.size[0])
    return replace(light, spot=SpotWindow(u0, v0, planes, 0.0 * planes, 0.0 * planes))


def tone_decoded(encoded: Array, sensor: Sensor) -> Array:
    """Linear light of encoded values: the inverse of `processing.tone_encoded`."""
    if sensor.transfer_function == "srgb":
        return srgb_decoded(encoded)
    if sensor.transfer_points is not None:
        return np.interp(encoded, *np.transpose(sensor.transfer_points)[::-1])
    return np.where(encoded < 4.5 * _BETA, encoded / 4.5, ((encoded + _ALPHA - 1.0) / _ALPHA) ** (1.0 / 0.45))


def electrons_from_srgb(image: NDArray[np.uint8], sensor: Sensor) -> Array:
    """Electrons behind R, G, B, shape (..., 3, H, W): the inverse for flat, unclipped, unsharpened light."""
    inverse = tuple(map(tuple, np.linalg.inv(sensor.colour_matrix)))
    balanced = colour_corrected(tone_decoded(np.moveaxis(image, -1, -3) / 255.0, sensor), inverse)
    gains = sensor.white_balance
    full_scale_e = (sensor.top_dn - sensor.black_level_dn) / sensor.dn_per_e
    return white_balanced(balanced, (1.0 / gains[0], 1.0 / gains[1], 1.0 / gains[2])) * full_scale_e
