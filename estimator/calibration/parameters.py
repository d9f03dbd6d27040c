"""The numbers of a rig that a calibration may change, their names, and what is known of them beforehand.

The names and their meaning are those of `phibench.estimator.rig_errors`: decentre and z_c move the sphere centre along
world axes, a tilt turns the camera about its lens while the sphere stays in the world. `stroke_m` is an offset of every
stroke and `stroke_scale` its relative error: h_true = (1 + stroke_scale) h + stroke_m.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from phibench.datasets.errors import DatasetError
from phibench.estimator.rig_errors import RIG_PARAMETERS, changed_rig
from phibench.scenes.frames import Array
from phibench.scenes.names import nearest
from phibench.scenes.rig import Rig

STROKE_SCALE = "stroke_scale"
PARAMETERS = (*RIG_PARAMETERS, STROKE_SCALE)
"""Order of values and covariances."""
STROKE_PARAMETERS = ("stroke_m", STROKE_SCALE)
_STEPS = {
    "stroke_m": 1e-3,
    "z_c_m": 2e-4,
    "radius_m": 1e-4,
    "f_px": 2.0,
    "cx_px": 0.5,
    "cy_px": 0.5,
    "decentre_x_m": 1e-4,
    "decentre_y_m": 1e-4,
    "tilt_x_rad": 5e-4,
    "tilt_y_rad": 5e-4,
    "stroke_tilt_x_rad": 1e-3,
    "stroke_tilt_y_rad": 1e-3,
    STROKE_SCALE: 1e-3,
}
# A rig put together with care and measured by hand: the errors that DESIGN's budget looks at.
PRIOR_SIGMA: Mapping[str, float] = {
    "stroke_m": 5e-4,
    "z_c_m": 2e-3,
    "radius_m": 2.5e-4,
    "f_px": 4.3,
    "cx_px": 5.0,
    "cy_px": 5.0,
    "decentre_x_m": 1e-3,
    "decentre_y_m": 1e-3,
    "tilt_x_rad": math.radians(0.5),
    "tilt_y_rad": math.radians(0.5),
    "stroke_tilt_x_rad": math.radians(0.2),
    "stroke_tilt_y_rad": math.radians(0.2),
    STROKE_SCALE: 5e-4,
}
"""Standard deviations of independent errors of a rig whose numbers were read off a drawing and a ruler."""


LIMITS: Mapping[str, float] = {
    "stroke_m": 1.0,
    "z_c_m": 0.1,
    "radius_m": 0.1,
    "f_px": 1000.0,
    "cx_px": 2000.0,
    "cy_px": 2000.0,
    "decentre_x_m": 0.1,
    "decentre_y_m": 0.1,
    "tilt_x_rad": 0.5,
    "tilt_y_rad": 0.5,
    "stroke_tilt_x_rad": 0.5,
    "stroke_tilt_y_rad": 0.5,
    STROKE_SCALE: 0.5,
}
"""Largest size of a correction: those of a recipe's `[misalignment]`."""


def steps() -> Array:
    """Steps for differences, shape (p,), about the size of a real error."""
    return np.array([_STEPS[name] for name in PARAMETERS])


def prior_sigmas(changes: Mapping[str, float] | None = None) -> Array:
    """Standard deviations beforehand, shape (p,), with changes by name; 0 holds a parameter.

    Raises
    ------
    DatasetError
        If a name is unknown or a value below 0.
    """
    sigmas = dict(PRIOR_SIGMA)
    for name, sigma in (changes or {}).items():
        if name not in sigmas:
            raise DatasetError(f"no rig parameter '{name}'; {nearest(name, PARAMETERS)}")
        if not (sigma >= 0.0 and math.isfinite(sigma)):
            raise DatasetError(f"sigma of {name} = {sigma:g}: must be 0 or above")
        sigmas[name] = sigma
    return np.array([sigmas[name] for name in PARAMETERS])


def changed(rig: Rig, values: Array) -> Rig:
    """Rig with every parameter larger by its value, shape (p,); the stroke's own are left to `stroke_of`."""
    for name, value in zip(PARAMETERS, values, strict=True):
        if value != 0.0 and name not in STROKE_PARAMETERS:
            rig = changed_rig(rig, name, float(value))
    return rig


def stroke_of(stroke_m: Array, values: Array) -> Array:
    """Strokes with scale and offset applied, shape of `stroke_m`, metres."""
    offset, scale = (values[PARAMETERS.index(name)] for name in STROKE_PARAMETERS)
    return np.asarray(stroke_m, float) * (1.0 + scale) + offset
