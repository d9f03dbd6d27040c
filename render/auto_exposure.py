"""Auto exposure: the exposure time and gain at which the expected image has the level that the camera aims at.

It looks at the expectation, never at a draw, so that two draws, or laser on and off, have the same exposure. The light
of the room alone decides: the spot is too small to count.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from phibench.render.electrons import mono, stop_factor
from phibench.render.isp import colour_corrected, srgb_encoded, white_balanced
from phibench.render.light import Light
from phibench.render.sensor import Sensor
from phibench.scenes.frames import Array

LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601, the Y of JPEG
_STEP_PX = 8


def auto_exposed(sensor: Sensor, light: Light) -> Sensor:
    """Return the sensor with the exposure time and the gain that auto exposure chooses for this light.

    The time goes first, from `exposure_min_s` to `exposure_max_s`; the gain rises from 1 to `gain_max` where the
    longest time is not enough. What no setting reaches ends at the limit.
    """
    rates = light.ambient_electrons_per_s[:, ::_STEP_PX, ::_STEP_PX].astype(float)
    rates *= light.lamp_level * stop_factor(sensor, light)

    def excess(log_gain_s: float) -> float:
        return mean_level(rates * np.exp(log_gain_s), sensor) - sensor.auto_exposure_level

    low, high = np.log(sensor.exposure_min_s), np.log(sensor.exposure_max_s * sensor.gain_max)
    if excess(low) >= 0.0:
        product = sensor.exposure_min_s
    elif excess(high) <= 0.0:
        product = sensor.exposure_max_s * sensor.gain_max
    else:
        product = float(np.exp(brentq(excess, low, high, xtol=1e-6)))
    seconds = min(product, sensor.exposure_max_s)
    return sensor.replace(exposure_s=seconds, analogue_gain=min(max(product / seconds, 1.0), sensor.gain_max))


def mean_level(electrons: Array, sensor: Sensor) -> float:
    """Mean 8-bit luma, 0 to 255, of expected electrons behind R, G, B, shape (3, h, w), at gain 1.

    The converter's upper end cuts, as it does in a frame; noise, dark current, full well, extra vignetting, the Bayer
    pattern and sharpening are left out. A sensor without filters shows its one plane as grey.
    """
    full_scale_e = (sensor.top_dn - sensor.black_level_dn) / sensor.gain_dn_per_e
    if sensor.mosaic == "mono":
        grey = np.minimum(mono(electrons, sensor.mono_weights) / full_scale_e, 1.0)
        return 255.0 * float(srgb_encoded(grey).mean())
    planes = np.minimum(electrons / full_scale_e, 1.0)
    encoded = srgb_encoded(colour_corrected(white_balanced(planes, sensor.white_balance), sensor.colour_matrix))
    return 255.0 * float(np.average(encoded.mean(axis=(1, 2)), weights=LUMA))
