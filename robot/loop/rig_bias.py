"""Shifts of pixels by the few deviations of a rig that matter most (`RigBias`), for beliefs of the robot.

A covariance P of `rig_parameters.PARAMETERS` becomes a few numbers: with p = L theta, theta of unit covariance, the
columns of L are the principal directions of J P J^T, J the derivatives of the pixels of points around the robot.
Directions that move no pixel by `LEAST_PX` are left out. A rig as built by hand shifts directions by some 8 degrees, of
which a tenth is not linear in theta, and more than the noise: so shifts are exact, by a rig for each theta.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from phibench.estimator.geometry.rig_parameters import PARAMETERS, changed_rig, moves_rays, scaled_eigen, stroke_of
from phibench.estimator.geometry.sphere_image import SphereImage, SphereImager
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

LEAST_PX = 0.001
"""Rms shift of the pixels below which a direction is left out: a fiftieth of a frame's noise."""
# all around, not in steps that a symmetry would repeat; from the floor to above the mirror, near and far
_AZIMUTHS_RAD = (-2.0, -1.0, 0.0, 1.0, 2.0, math.pi)
_RISES = (-0.4, 0.0, 0.4)
_DISTANCES_M = (1.0, 3.0)
_STROKES_M = (0.0, 0.4)
_RIGS = 200  # kept: those of the sigma points of a step or two


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
        values, vectors = scaled_eigen(P)
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
