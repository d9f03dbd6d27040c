"""Rig parameters as a vector: changed rigs, priors, covariances, drawn deviations, true strokes, derivatives of D.

Names, steps, priors, limits and effects are those of `scenes.misalignment.PARAMETERS`. A vector holds the values of
`PARAMETERS` here, in this order: what a calibration fits. Values are deviations from the nominal rig, in metres,
radians, pixels, or relative. True strokes follow from nominal ones: h_true = (1 + stroke_relative) h + stroke_offset_m.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.mirror import OF_REVOLVED
from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError, nearest

RIG_PARAMETERS = (
    "stroke_offset_m",
    "axial_m",
    "radius_m",
    "focal_relative",
    "cx_px",
    "cy_px",
    "decentre_x_m",
    "decentre_y_m",
    "tilt_x_rad",
    "tilt_y_rad",
    "stroke_tilt_x_rad",
    "stroke_tilt_y_rad",
    *OF_REVOLVED,
)
"""Order of `rig_gradient` and `rig_covariance`: one stroke tells its offset and its scale not apart."""
PARAMETERS = (*RIG_PARAMETERS, "stroke_relative")
"""Order of values and covariances of a calibration."""
STROKE_PARAMETERS = ("stroke_offset_m", "stroke_relative")
PRIOR_SIGMA: Mapping[str, float] = {name: MISALIGNMENT[name].prior_sigma for name in PARAMETERS}
"""Standard deviations of independent errors of a rig whose numbers were read off a drawing and a ruler."""
RENAMED = {
    "stroke_m": "stroke_offset_m",
    "stroke_scale": "stroke_relative",
    "z_c_m": "axial_m",
    "f_px": "focal_relative",
}
"""Names of version 0.1. `f_px` was in pixels, added to fx and fy; `focal_relative` is relative to them."""


def has_effect(rig: Rig) -> BoolArray:
    """True for the parameters that mean something for a rig's mirror, shape (p,).

    A sphere has neither axis nor rim, and a cone no vertex radius.
    """
    return np.array([name not in rig.mirror.without_effect for name in PARAMETERS])


def moves_rays(rig: Rig) -> BoolArray:
    """True for the parameters that change a reflected ray or a stroke, shape (p,): the rim ends the mirror, no more."""
    return has_effect(rig) & np.array([name != "rim_radius_m" for name in PARAMETERS])


def changed_rig(rig: Rig, values: Array) -> Rig:
    """Rig with every parameter larger by its value, shape (p,); the strokes' own are left to `stroke_of`.

    Raises
    ------
    SceneError
        If a value is beyond its limit, or the rig cannot exist.
    """
    # all at once: `Misalignment` defines the order in which they act
    given = zip(PARAMETERS, np.asarray(values, float).tolist(), strict=True)
    return rig.perturbed(Misalignment(**{name: value for name, value in given if name not in STROKE_PARAMETERS}))


def drawn_deviation(covariance: Array, rng: np.random.Generator) -> Misalignment:
    """Deviation of a true rig from the nominal one, drawn from a covariance, shape (p, p).

    Raises
    ------
    SceneError
        If the covariance is no such matrix, or a value is beyond its limit.
    """
    values, vectors = scaled_eigen(covariance)
    drawn = vectors @ (np.sqrt(values) * rng.standard_normal(len(values)))
    return Misalignment(**{name: float(value) for name, value in zip(PARAMETERS, drawn, strict=True) if value})


def scaled_eigen(covariance: Array) -> tuple[Array, Array]:
    """Eigenvalues of the correlations, shape (p,), none below 0, and their vectors times the standard deviations."""
    P, n = np.asarray(covariance, float), len(PARAMETERS)
    if P.shape != (n, n) or not np.isfinite(P).all():
        raise SceneError(f"rig covariance: must be finite and of shape ({n}, {n}), one row for each of PARAMETERS")
    sigma = np.sqrt(np.maximum(np.diag(P), 0.0))
    scale = np.where(sigma == 0.0, 1.0, sigma)
    values, vectors = np.linalg.eigh(P / np.outer(scale, scale))
    if values[0] < -1e-9:  # of a correlation's eigenvalues: rounding of a file's digits stays far below
        raise SceneError("rig covariance: must have no negative eigenvalue; give the covariance of a calibration")
    return np.maximum(values, 0.0), sigma[:, None] * vectors


def stroke_of(stroke_m: Array, values: Array) -> Array:
    """Strokes with scale and offset applied, shape of `stroke_m`, metres."""
    offset, scale = (values[PARAMETERS.index(name)] for name in STROKE_PARAMETERS)
    return np.asarray(stroke_m, float) * (1.0 + scale) + offset


def difference_steps() -> Array:
    """Steps for differences, shape (p,), about the size of a real error."""
    return np.array([MISALIGNMENT[name].step for name in PARAMETERS])


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
            raise DatasetError(_unknown(name, PARAMETERS))
        if not (sigma >= 0.0 and math.isfinite(sigma)):
            raise DatasetError(f"sigma of {name} = {sigma:g}: must be 0 or above")
        sigmas[name] = sigma
    return np.array([sigmas[name] for name in PARAMETERS])


def rig_covariance(sigmas: Mapping[str, float]) -> Array:
    """Covariance, shape (p, p), of independent errors; parameters that are not named are exact.

    Raises
    ------
    ValueError
        If a name is not one of `RIG_PARAMETERS`, or a sigma is below 0.
    """
    for name, sigma in sigmas.items():
        if name not in RIG_PARAMETERS:
            raise ValueError(_unknown(name, RIG_PARAMETERS))
        if not sigma >= 0.0:
            raise ValueError(f"sigma of {name} = {sigma:g}: must be 0 or above")
    return np.diag([sigmas.get(name, 0.0) ** 2 for name in RIG_PARAMETERS])


def rig_gradient(rig: Rig, stroke_m: ArrayLike, uv_down_px: Array, uv_up_px: Array, step: float = 1.0) -> Array:
    """dD by each of `RIG_PARAMETERS`, shape (..., p), metres per unit of the parameter.

    The pixels stay as they are: the nominal rig changes, not the true one. Differences of the exact estimator by
    five-point stencils: the error is fourth order in the step. `step` multiplies all steps. NaN where D is.
    """
    h = np.asarray(stroke_m, float)

    def depth(name: str, by: float) -> Array:
        if name == "stroke_offset_m":
            return depth_exact(rig, h + by, uv_down_px, uv_up_px).depth_m
        return depth_exact(MISALIGNMENT[name].apply(rig, by), h, uv_down_px, uv_up_px).depth_m

    # f' = (8 (f1 - f-1) - (f2 - f-2)) / 12 step
    slopes, moving = [], dict(zip(PARAMETERS, moves_rays(rig).tolist(), strict=True))
    still = 0.0 * depth("stroke_offset_m", 0.0)
    for name in RIG_PARAMETERS:
        if not moving[name]:
            slopes.append(still)
            continue
        f, size = partial(depth, name), step * MISALIGNMENT[name].step
        near, far = f(size) - f(-size), f(2.0 * size) - f(-2.0 * size)
        slopes.append((8.0 * near - far) / (12.0 * size))  # five points: the error is of the fourth order
    return np.stack(slopes, axis=-1)


def _unknown(name: str, names: tuple[str, ...]) -> str:
    if name in RENAMED:
        return f"the rig parameter '{name}' is now called '{RENAMED[name]}'"
    return f"no rig parameter '{name}'; {nearest(name, names)}"
