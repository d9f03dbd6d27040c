"""Transfer function of sRGB (IEC 61966-2-1), both ways: linear values to encoded ones, and back.

It is the simulator's only one, in a file of its own: rooms of photographs and meshes depend on it, not on the sensor.
"""

from __future__ import annotations

import numpy as np

from phibench.scenes.frames import Array

_KNEE, _SLOPE = 0.0031308, 12.92  # IEC 61966-2-1


def srgb_encoded(linear: Array) -> Array:
    """sRGB curve of values cut to [0, 1] (IEC 61966-2-1)."""
    x = np.clip(linear, 0.0, 1.0)
    # constants in the input's own type: float32 stays float32
    curve = x.dtype.type(1.055) * np.power(x, x.dtype.type(1.0 / 2.4)) - x.dtype.type(0.055)
    return np.where(x <= _KNEE, x * x.dtype.type(_SLOPE), curve)


def srgb_decoded(encoded: Array) -> Array:
    """Linear values of the sRGB curve, both in [0, 1]."""
    x = np.asarray(encoded)
    return np.where(x <= _KNEE * _SLOPE, x / _SLOPE, ((x + 0.055) / 1.055) ** 2.4)
