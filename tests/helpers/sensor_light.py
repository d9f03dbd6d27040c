"""Light for the tests of the sensor: a textured room and a pixel-integrated Gaussian spot."""

from __future__ import annotations

import numpy as np

from phibench.render.optics.spot_layer import SpotLayer, splat
from phibench.render.optics.spot_samples import FilmCloud
from phibench.render.sensor.light import Light

FILTERS = np.array([1.0, 0.10, 0.03])


def spot_at(u: float, v: float, sigma_px: float = 0.8, electrons_per_s: float = 9e5) -> SpotLayer:
    """Spot layer of a point, blurred: exact values and derivatives."""
    return splat(FilmCloud(np.array([[u, v]]), np.array([1.0])), sigma_px, electrons_per_s * FILTERS)


def room(size: tuple[int, int], seed: int = 7) -> Light:
    """Textured room of (height, width) with a spot right of the middle; some pixels saturate at 1/60 s."""
    rates = np.random.default_rng(seed).uniform(0.0, 8e5, (3, *size)).astype(np.float32)
    return Light(rates, spot_at(0.6 * size[1] + 0.3, 0.5 * size[0] - 0.2))
