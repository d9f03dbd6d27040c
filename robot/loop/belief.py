"""Belief over a target's place seen from the robot: prior, motion model, and an unscented Kalman filter of `filterpy`.

State, in the rig's frame made level: the azimuth a, the rise k = (z - z0) / D and the inverse distance q = 1 / D, z0
the height of the sphere centre at the down position; then the slip and the skid factor of the tracks, and the velocity
of a target that moves, divided by D (modified polar coordinates, V. J. Aidala and S. E. Hammel, IEEE Trans. Automatic
Control 28, 283, 1983). The robot's own place is no part of it: what odometry does not know moves the target.
The rig is exact here; one that is known to a covariance has a `smoothing.SmoothedBelief`.

A spot's pixel counts as the direction (azimuth, rise) of the ray that leaves the mirror. From a mirror raised by h the
target's rise is k - h q but for the mirror's radius: nearly linear in the state, so that a filter stays consistent
where D is hardly known. In pixels, or with D in place of q, the first stroke would make it overconfident.

`filterpy` is the filter because it needs nothing that the base install lacks and takes any measurement function. Stone
Soup has more, data association above all, for nine more packages.
"""

from __future__ import annotations

import abc
import copy
import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from phibench.estimator.geometry.sphere_image import SphereImager
from phibench.robot.loop.sensing import Direction, wrapped_angle
from phibench.scenes.frames import Array
from phibench.scenes.motion.vehicle import PlanarPose, Stance, Vehicle, arc_covariance, rig_placement
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError, finite, positive

LEAST_Q = 0.02  # states at 50 m and beyond count as there
PLACE = 3  # first entries of the state
SLIP, SKID = 3, 4  # entries of the state
VELOCITY = slice(5, 8)  # of a target that moves, over D
_ALPHA, _BETA, _KAPPA = 0.6, 2.0, 0.0  # of Merwe's sigma points: 1.3 deviations away for 5 states


@dataclass(frozen=True)
class TargetPrior:
    """Target as it is expected before its first frame.

    Attributes
    ----------
    distances_m : 2 floats
        Range of D: its ends are those of q at about 1.5 standard deviations.
    acceleration_m2_per_s3 : float
        Density of the target's acceleration per axis; 0 is a target at rest.
    speed_m_per_s : float
        Standard deviation of the first velocity per axis, of a target that moves.

    Raises
    ------
    SceneError
        If a number is beyond its range.
    """

    distances_m: tuple[float, float] = (0.8, 6.0)
    acceleration_m2_per_s3: float = 0.0
    speed_m_per_s: float = 0.3

    def __post_init__(self) -> None:
        near, far = (positive("prior", "distances_m", D) for D in self.distances_m)
        if near >= far:
            raise SceneError(f"prior.distances_m = {self.distances_m}: the first must be below the second")
        if finite("prior", "acceleration_m2_per_s3", self.acceleration_m2_per_s3) < 0.0:
            raise SceneError(f"prior.acceleration_m2_per_s3 = {self.acceleration_m2_per_s3}: must be 0 or above")
        positive("prior", "speed_m_per_s", self.speed_m_per_s)

    @property
    def moves(self) -> bool:
        """True for a target that may move."""
        return self.acceleration_m2_per_s3 > 0.0

    @property
    def q(self) -> float:
        """Mean of 1 / D."""
        near, far = self.distances_m
        return 0.5 * (1.0 / near + 1.0 / far)

    @property
    def q_sigma(self) -> float:
        """Standard deviation of 1 / D."""
        near, far = self.distances_m
        return (1.0 / near - 1.0 / far) / 3.0


ANY_TARGET = TargetPrior()
"""Target at rest in a room."""


class Belief(abc.ABC):
    """Belief over one target: mean and covariance of its state, and how a robot's moves change that.

    Parameters
    ----------
    rig : Rig
        The nominal one.
    """

    def __init__(self, rig: Rig, vehicle: Vehicle, prior: TargetPrior) -> None:
        self.rig, self.vehicle, self.prior = rig, vehicle, prior
        self._z0 = float(rig.at(0.0).sphere_centre_m[2])

    @property
    @abc.abstractmethod
    def mean(self) -> Array:
        """State, shape (5,) or (8,), and as many more as the rig has deviations."""

    @property
    @abc.abstractmethod
    def covariance(self) -> Array:
        """Of the state."""

    @abc.abstractmethod
    def pixel(self, stroke_m: float, held: Stance | None = None) -> tuple[float, float] | None:
        """Pixel at which the mean is seen; None where the mirror does not show it."""

    @abc.abstractmethod
    def predict(self, left_m: float, right_m: float, step_s: float) -> None:
        """Take in a step of the tracks, as their encoders count it, and the time that it took."""

    @abc.abstractmethod
    def update(self, seen: Direction, stroke_m: float, held: Stance | None = None) -> None:
        """Take in a direction, after `predict`; `held` is the robot's attitude, level by default."""

    @abc.abstractmethod
    def imagine(self, stroke_m: float, covariance: Array) -> None:
        """Take in a direction where it is expected, with a covariance, shape (2, 2): what a frame would be worth."""

    @abc.abstractmethod
    def copied(self) -> Self:
        """Copy that changes on its own."""

    @abc.abstractmethod
    def distance2(self, seen: Direction, stroke_m: float, held: Stance | None = None) -> float:
        """Squared Mahalanobis distance of a direction from what is expected: chi squared of 2 for the target's own."""

    @property
    def distance_m(self) -> float:
        """D from the stroke axis, the mean of 1 / q to second order."""
        q, variance = self.mean[2], self.covariance[2, 2]
        return float((1.0 + min(variance / q**2, 0.25)) / q)  # the series holds for small variances only

    @property
    def distance_sigma_m(self) -> float:
        """Standard deviation of D."""
        return float(math.sqrt(self.covariance[2, 2]) / self.mean[2] ** 2)

    @property
    def bearing_rad(self) -> float:
        """Azimuth, ahead is 0, to the left counts."""
        return wrapped_angle(float(self.mean[0]))

    def nees(self, point_m: Array) -> float:
        """Normalised estimation error squared of azimuth, rise and inverse distance: chi squared of 3.

        Parameters
        ----------
        point_m : shape (3,)
            True place in the rig's frame made level.
        """
        D = math.hypot(point_m[0], point_m[1])
        truth = np.array([math.atan2(point_m[1], point_m[0]), (point_m[2] - self._z0) / D, 1.0 / D])
        error = self.mean[:PLACE] - truth
        error[0] = wrapped_angle(error[0])
        return float(error @ np.linalg.solve(self.covariance[:PLACE, :PLACE], error))

    def point_m(self, x: Array) -> Array:
        """Place of a state in the rig's frame made level, shape (3,)."""
        D = 1.0 / max(float(x[2]), LEAST_Q)
        return np.array([D * math.cos(x[0]), D * math.sin(x[0]), self._z0 + D * x[1]])

    def _standing(self, x: Array, held: Stance | None) -> Array:
        """Place of a state in the rig's frame of the robot as it stands."""
        R, t = self._tilt(held)
        return np.asarray((self.point_m(x) - t) @ R)

    def _tilt(self, held: Stance | None) -> tuple[Array, Array]:
        """Rotation and origin of the rig's frame as the robot stands, in that frame made level."""
        if held is None:
            return np.eye(3), np.zeros(3)
        R, t = rig_placement(self.vehicle, PlanarPose(), held)
        return R, t - np.array([self.vehicle.sensor_x_m, 0.0, 0.0])

    def _moved(self, x: Array, left_m: float, right_m: float, step_s: float, about_rad: float) -> Array:
        """State after a step."""
        after, point = x.copy(), self.point_m(x)
        if self.prior.moves:
            point = point + step_s * x[VELOCITY] / max(float(x[2]), LEAST_Q)
        arc = self.vehicle.arc(left_m, right_m, float(x[SLIP]), float(x[SKID]))
        (cx, cy), c, s = arc.chord_m, math.cos(arc.turn_rad), math.sin(arc.turn_rad)
        dx, dy = point[0] + self.vehicle.sensor_x_m - cx, point[1] - cy
        X, Y = c * dx + s * dy - self.vehicle.sensor_x_m, c * dy - s * dx
        D = math.hypot(X, Y)
        expected = about_rad - arc.turn_rad
        after[:3] = expected + wrapped_angle(math.atan2(Y, X) - expected), (point[2] - self._z0) / D, 1.0 / D
        if self.prior.moves:
            vx, vy, vz = x[VELOCITY] / (D * max(float(x[2]), LEAST_Q))
            after[VELOCITY] = c * vx + s * vy, c * vy - s * vx, vz
        return after

    def _process_noise(self, x: Array, left_m: float, right_m: float, step_s: float) -> Array:
        """Covariance that a step adds: random parts of the tracks' ways, and the target's acceleration."""
        n = len(x)
        Q, D, k = np.zeros((n, n)), 1.0 / max(float(x[2]), LEAST_Q), float(x[1])
        c, s = math.cos(x[0]), math.sin(x[0])
        # d(azimuth, rise, q) by the place
        J = np.array([[-s / D, c / D, 0.0], [-k * c / D, -k * s / D, 1.0 / D], [-c / D**2, -s / D**2, 0.0]])
        C = arc_covariance(self.vehicle, left_m, right_m)
        if np.any(C):
            # a way ahead moves the target back; a turn moves it about the base
            G = np.array([[-1.0, D * s], [0.0, -(D * c + self.vehicle.sensor_x_m)], [0.0, 0.0]])
            Q[:3, :3] = J @ G @ C @ G.T @ J.T
        if self.prior.moves:
            a, t = self.prior.acceleration_m2_per_s3, step_s
            Q[:3, :3] += a * t**3 / 3.0 * J @ J.T
            Q[:3, VELOCITY] = a * t**2 / 2.0 * J / D
            Q[VELOCITY, :3] = Q[:3, VELOCITY].T
            Q[VELOCITY, VELOCITY] = a * t / D**2 * np.eye(3)
        return Q


class TargetBelief(Belief):
    """Belief over one target of a rig that is known exactly.

    Parameters
    ----------
    rig : Rig
        The nominal one.
    first : Direction
        Of the target, seen with the mirror raised by `stroke_m` and the robot level.

    Raises
    ------
    SceneError
        If `filterpy` is not installed.
    """

    def __init__(
        self, rig: Rig, vehicle: Vehicle, first: Direction, stroke_m: float, prior: TargetPrior = ANY_TARGET
    ) -> None:
        super().__init__(rig, vehicle, prior)
        self._imager = SphereImager(rig)
        self._axis = np.array(rig.stroke_axis_world)
        n, q, spread = 8 if prior.moves else 5, prior.q, prior.q_sigma
        self._filter = _unscented(n, self._residual)
        x, P = np.zeros(n), np.zeros((n, n))
        # the direction's rise is k - h q, but for the radius: k goes with q
        x[:5] = first.azimuth_rad, first.rise + stroke_m * q, q, vehicle.slip, vehicle.skid
        P[:2, :2] = first.covariance
        to_q = np.array([0.0, stroke_m, 1.0])
        P[:3, :3] += spread**2 * np.outer(to_q, to_q)
        P[1, 1] += (2.0 * rig.sphere.radius_m * spread) ** 2  # what the radius does to the first rise
        # a vehicle may be exact
        P[SLIP, SLIP], P[SKID, SKID] = vehicle.slip_sigma**2 + 1e-12, vehicle.skid_sigma**2 + 1e-12
        if prior.moves:
            P[VELOCITY, VELOCITY] = (prior.speed_m_per_s * q) ** 2 * np.eye(3)
        self._filter.x, self._filter.P = x, P

    # -- what is believed ------------------------------------------------------------------------------------------

    @property
    def mean(self) -> Array:
        """State, shape (5,) or (8,)."""
        return np.asarray(self._filter.x)

    @property
    def covariance(self) -> Array:
        """Of the state."""
        return np.asarray(self._filter.P)

    def expected(self, stroke_m: float, held: Stance | None = None) -> tuple[float, float]:
        """Azimuth and rise at which the mean is seen."""
        azimuth, rise = self._seen(self.mean[np.newaxis], stroke_m, held)[0]
        return float(azimuth), float(rise)

    def pixel(self, stroke_m: float, held: Stance | None = None) -> tuple[float, float] | None:
        """Pixel at which the mean is seen; None where the mirror does not show it."""
        image = self._imager.image(*self._lowered(self.mean, stroke_m, held).tolist())
        return None if image is None else (image.u_px, image.v_px)

    # -- what changes it -------------------------------------------------------------------------------------------

    def predict(self, left_m: float, right_m: float, step_s: float) -> None:
        """Take in a step of the tracks, as their encoders count it, and the time that it took."""
        mean = self.mean
        Q = self._process_noise(mean, left_m, right_m, step_s)
        self._filter.Q = Q + 1e-16 * np.eye(len(mean))  # the root of the covariance needs it positive
        self._filter.predict(fx=lambda x, _: self._moved(x, left_m, right_m, step_s, float(mean[0])))
        self._filter.P = 0.5 * (self._filter.P + self._filter.P.T)

    def update(self, seen: Direction, stroke_m: float, held: Stance | None = None) -> None:
        """Take in a direction, after `predict`; `held` is the robot's attitude, level by default."""
        expected = iter(self._seen(self._filter.sigmas_f, stroke_m, held))
        self._filter.update(seen.values, R=seen.covariance, hx=lambda _: next(expected))
        self._filter.P = 0.5 * (self._filter.P + self._filter.P.T)
        self._filter.x[2] = max(self._filter.x[2], LEAST_Q)

    def distance2(self, seen: Direction, stroke_m: float, held: Stance | None = None) -> float:
        """Squared Mahalanobis distance of a direction from what is expected: chi squared of 2 for the target's own."""
        values = self._seen(self._filter.sigmas_f, stroke_m, held)
        values[:, 0] = [wrapped_angle(a - seen.azimuth_rad) for a in values[:, 0]]
        values[:, 1] -= seen.rise
        mean = self._filter.Wm @ values
        S = (values - mean).T @ np.diag(self._filter.Wc) @ (values - mean) + seen.covariance
        return float(mean @ np.linalg.solve(S, mean))

    def imagine(self, stroke_m: float, covariance: Array) -> None:
        """Take in a direction where it is expected."""
        nowhere = np.full(2, np.nan)
        self.update(Direction(*self.expected(stroke_m), covariance, nowhere, np.diag(nowhere)), stroke_m)

    def copied(self) -> Self:
        """Copy that changes on its own."""
        return copy.deepcopy(self)

    # -- model -----------------------------------------------------------------------------------------------------

    def _seen(self, states: Array, stroke_m: float, held: Stance | None) -> Array:
        """Directions of the images of N states, shape (N, 2); their own where the mirror does not show them."""
        return np.array([self._seen_exactly(x, stroke_m, held) for x in states])

    def _seen_exactly(self, x: Array, stroke_m: float, held: Stance | None) -> Array:
        lowered = self._lowered(x, stroke_m, held)
        image = self._imager.image(*lowered.tolist())
        d = lowered - np.array([0.0, 0.0, self._z0]) if image is None else np.array(image.ray)
        return np.array([math.atan2(d[1], d[0]), d[2] / math.hypot(d[0], d[1])])

    def _lowered(self, x: Array, stroke_m: float, held: Stance | None) -> Array:
        """Place of a state in the rig's frame of the robot as it stands, less the stroke."""
        return np.asarray(self._standing(x, held) - stroke_m * self._axis)

    @staticmethod
    def _residual(a: Array, b: Array) -> Array:
        difference = np.subtract(a, b)
        difference[0] = wrapped_angle(difference[0])
        return np.asarray(difference)


def require_filter() -> None:
    """Make sure of the package that beliefs need.

    Raises
    ------
    SceneError
        If `filterpy` is not installed.
    """
    try:
        import filterpy.kalman  # noqa: F401
    except ImportError as error:
        raise SceneError("beliefs need filterpy: pip install 'phibench[loop]'") from error


def _unscented(n: int, residual_z: Any) -> Any:
    """Filter of `filterpy` with n states, and directions as measurements."""
    require_filter()
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    points = MerweScaledSigmaPoints(n, _ALPHA, _BETA, _KAPPA)
    return UnscentedKalmanFilter(n, 2, 1.0, None, None, points, residual_z=residual_z, z_mean_fn=_direction_mean)


def _direction_mean(values: Array, weights: Array) -> Array:
    """Weighted mean of directions, shape (m, 2), about the first one's azimuth."""
    first = values[0, 0]
    turned = np.array([wrapped_angle(a - first) for a in values[:, 0]])
    return np.array([first + weights @ turned, weights @ values[:, 1]])
