"""Rig parameters as a vector: changed rigs, priors, covariances, the derivatives of D, and principal deviations.

Names, steps, priors, limits and effects are those of `scenes.misalignment.PARAMETERS`. A vector holds the values of
`PARAMETERS` here, in this order: what a calibration fits. Values are deviations from the nominal rig, in metres,
radians, pixels, or relative. True strokes follow from nominal ones: h_true = (1 + stroke_relative) h + stroke_offset_m.

A covariance P of them becomes a few numbers for a belief (`RigBias`): with p = L theta, theta of unit covariance, the
columns of L are the principal directions of J P J^T, J the derivatives of the pixels of points around the robot.
Directions that move no pixel by `LEAST_PX` are left out. A rig as built by hand shifts directions by some 8 degrees, of
which a tenth is not linear in theta, and more than the noise: so shifts are exact, by a rig for each theta.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.sphere_image import SphereImage, SphereImager
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
LEAST_PX = 0.001
"""Rms shift of the pixels below which a direction is left out: a fiftieth of a frame's noise."""
# all around, not in steps that a symmetry would repeat; from the floor to above the mirror, near and far
_AZIMUTHS_RAD = (-2.0, -1.0, 0.0, 1.0, 2.0, math.pi)
_RISES = (-0.4, 0.0, 0.4)
_DISTANCES_M = (1.0, 3.0)
_STROKES_M = (0.0, 0.4)
_RIGS = 200  # kept: those of the sigma points of a step or two


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
    values, vectors = _scaled_eigen(covariance)
    drawn = vectors @ (np.sqrt(values) * rng.standard_normal(len(values)))
    return Misalignment(**{name: float(value) for name, value in zip(PARAMETERS, drawn, strict=True) if value})


def _scaled_eigen(covariance: Array) -> tuple[Array, Array]:
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


# -- principal deviations ----------------------------------------------------------------------------------------------


class _Deviated(NamedTuple):
    """A rig with a deviation: its imager and axis, and the values it deviates by."""

    imager: SphereImager
    axis: Array
    values: Array

    def image(self, point_m: Array, stroke_m: float) -> SphereImage | None:
        """Image of a point from a mirror that was raised by a nominal stroke."""
        true_m = float(stroke_of(np.array(stroke_m), self.values))
        return self.imager.image(*(point_m - true_m * self.axis).tolist())


class RigBias:
    """Shifts of directions by the principal deviations of a rig.

    Parameters
    ----------
    rig : Rig
        The nominal one.
    covariance : shape (p, p), or None
        Of the true rig's deviations, in the order of `rig_parameters.PARAMETERS`; None is an exact rig.

    Raises
    ------
    SceneError
        If the covariance has another shape, is not finite or not positive, or if a rig with a deviation of one
        standard deviation cannot exist.
    """

    def __init__(self, rig: Rig, covariance: Array | None) -> None:
        self._rig, self._axis = rig, np.array(rig.stroke_axis_world)
        self._rigs: dict[bytes, _Deviated] = {}
        self.deviations = np.zeros((len(PARAMETERS), 0)) if covariance is None else self._principal(covariance)
        """Columns L, shape (p, m): deviations of one standard deviation."""

    @property
    def count(self) -> int:
        """Number of states m."""
        return self.deviations.shape[1]

    def pixel(self, point_m: Array, stroke_m: float, theta: Array) -> tuple[float, float]:
        """Pixel of a point in the rig with the deviations L theta; NaN where the mirror does not show it."""
        if (rig := self._rigs.get(key := theta.tobytes())) is None:
            if len(self._rigs) >= _RIGS:
                self._rigs.clear()
            rig = self._rigs[key] = self._deviated(self.deviations @ theta)
        image = rig.image(point_m, stroke_m)
        return (math.nan, math.nan) if image is None else (image.u_px, image.v_px)

    def _deviated(self, values: Array) -> _Deviated:
        rig = changed_rig(self._rig, values)
        return _Deviated(SphereImager(rig), np.array(rig.stroke_axis_world), values)

    def _principal(self, covariance: Array) -> Array:
        """Deviations of one standard deviation along the directions that move pixels most, shape (p, m)."""
        moving, n = moves_rays(self._rig), len(PARAMETERS)
        P = np.asarray(covariance, float)
        if P.shape == (n, n):
            P = np.where(np.outer(moving, moving), P, 0.0)
        values, vectors = _scaled_eigen(P)
        sigma, factor = np.sqrt(np.maximum(np.diag(P), 0.0)), vectors * np.sqrt(values)
        held = sigma == 0.0
        slopes = np.zeros((2 * len(_points()), n))
        for k in np.flatnonzero(~held):
            step = np.where(np.arange(n) == k, sigma, 0.0)
            pair = self._deviated(step), self._deviated(-step)
            slopes[:, k] = np.concatenate([_half(*pair, *place) for place in _points()]) / sigma[k]
        _, sizes, ways = np.linalg.svd(slopes @ factor, full_matrices=False)
        kept = sizes > LEAST_PX * math.sqrt(len(slopes))
        return np.asarray(factor @ ways[kept].T)


def _points() -> list[tuple[Array, float]]:
    """Points around the robot, about the height of the mirror, with strokes."""
    return [
        # 0.7 m: the default rig's mirror above the floor
        (np.array([D * math.cos(a), D * math.sin(a), 0.7 + D * k]), h)
        for a in _AZIMUTHS_RAD
        for k in _RISES
        for D in _DISTANCES_M
        for h in _STROKES_M
    ]


def _half(plus: _Deviated, minus: _Deviated, point_m: Array, stroke_m: float) -> Array:
    """Half of the pixel's difference between two rigs, shape (2,); 0 where one does not show the point."""
    one, other = plus.image(point_m, stroke_m), minus.image(point_m, stroke_m)
    if one is None or other is None:
        return np.zeros(2)
    return 0.5 * np.array([one.u_px - other.u_px, one.v_px - other.v_px])
