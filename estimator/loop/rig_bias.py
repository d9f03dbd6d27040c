"""Deviations of a rig that is not known exactly, as a few numbers, and the directions that it then sees.

A rig's covariance P over the parameters p of `rig_parameters.PARAMETERS` becomes a few constant states: with
p = L theta, theta of unit covariance, the columns of L are the principal directions of J P J^T, J the derivatives of
the pixels of points around the robot. Directions that move no pixel by `LEAST_PX` are left out.

Pixels count as directions by the nominal rig. A rig as built by hand shifts them by some 8 degrees, of which a tenth is
not linear in theta, and more than the noise. So every sigma point has a rig of its own, and shifts are exact.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from phibench.estimator.geometry.reflection import reflect
from phibench.estimator.geometry.rig_parameters import PARAMETERS, changed, moves_rays, stroke_of
from phibench.estimator.geometry.sphere_image import SphereImage, SphereImager
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError

LEAST_PX = 0.001
"""Rms shift of the pixels below which a direction is left out: a fiftieth of a frame's noise."""
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
        self._view = rig.at(0.0)
        self._centre = self._view.sphere_centre_m
        self._rigs: dict[bytes, _Deviated] = {}
        self.deviations = np.zeros((len(PARAMETERS), 0)) if covariance is None else self._principal(covariance)
        """Columns L, shape (p, m): deviations of one standard deviation."""

    @property
    def count(self) -> int:
        """Number of states m."""
        return self.deviations.shape[1]

    def shifts(self, point_m: Array, stroke_m: float) -> Array:
        """Shifts of azimuth and rise by one standard deviation of each state, shape (2, m): half of differences.

        Parameters
        ----------
        point_m : shape (3,)
            In the rig's frame of the robot as it stands, the carriage being down.
        stroke_m : float
        """
        m = self.count
        thetas = np.concatenate([np.eye(m), -np.eye(m)])
        seen = self.directions(np.tile(point_m, (2 * m, 1)), stroke_m, thetas)
        difference = seen[:m] - seen[m:]
        difference[:, 0] = np.arctan2(np.sin(difference[:, 0]), np.cos(difference[:, 0]))
        return np.asarray(0.5 * difference.T)

    def pixel(self, point_m: Array, stroke_m: float, theta: Array) -> tuple[float, float]:
        """Pixel of a point in the rig with the deviations L theta; NaN where the mirror does not show it."""
        if (rig := self._rigs.get(key := theta.tobytes())) is None:
            if len(self._rigs) >= _RIGS:
                self._rigs.clear()
            rig = self._rigs[key] = self._deviated(self.deviations @ theta)
        image = rig.image(point_m, stroke_m)
        return (math.nan, math.nan) if image is None else (image.u_px, image.v_px)

    def directions(self, points_m: Array, stroke_m: float, thetas: Array) -> Array:
        """Directions that the nominal rig gives to the pixels of points in deviated rigs, shape (N, 2).

        Parameters
        ----------
        points_m, thetas : shapes (N, 3), (N, m)
            A point's own direction counts where its mirror does not show it.
        """
        uv = np.array([self.pixel(p, stroke_m, t) for p, t in zip(points_m, thetas, strict=True)])
        d = reflect(self._view, uv).direction_world
        own = points_m - stroke_m * self._axis - self._centre
        d = np.where(np.isfinite(d).all(axis=1, keepdims=True), d, own)
        return np.stack([np.arctan2(d[:, 1], d[:, 0]), d[:, 2] / np.hypot(d[:, 0], d[:, 1])], axis=1)

    def _deviated(self, values: Array) -> _Deviated:
        rig = changed(self._rig, values)
        return _Deviated(SphereImager(rig), np.array(rig.stroke_axis_world), values)

    def _principal(self, covariance: Array) -> Array:
        """Deviations of one standard deviation along the directions that move pixels most, shape (p, m)."""
        P, n = np.asarray(covariance, float), len(PARAMETERS)
        if P.shape != (n, n) or not np.isfinite(P).all():
            raise SceneError(f"rig covariance: must be finite and of shape ({n}, {n}), one row for each of PARAMETERS")
        P = np.where(np.outer(moves_rays(self._rig), moves_rays(self._rig)), P, 0.0)
        sigma = np.sqrt(np.maximum(np.diag(P), 0.0))
        held = sigma == 0.0
        scale = np.where(held, 1.0, sigma)
        values, vectors = np.linalg.eigh(P / np.outer(scale, scale))
        if values[0] < -1e-9:
            raise SceneError("rig covariance: must have no negative eigenvalue; give the covariance of a calibration")
        factor = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
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
