"""Vehicle ESCALADE360: parameters, motion and odometry of its two tracks, obstacles, and the sensor's pose on it.

Frames: `base` has its origin midway between the contacts of both tracks, at their underside, x ahead, y left, z up.
`rig` is the frame in which a `Rig` is written: its origin lies `sensor_x_m` ahead, below the stroke axis.

Drive: with the distances l and r of the tracks, slip f and skid factor k, the base moves on an arc of the length
s = (1 - f) (l + r) / 2 and turns by a = (1 - f) (r - l) / (k b), b the gauge. In the old base the end of the arc is
(s sin(a) / a, s (1 - cos(a)) / a). A tracked vehicle turns less than its gauge says, because its tracks slide sideways:
k > 1 (J. L. Martinez et al., Int. J. Robotics Research 24, 867, 2005).

Odometry: the distance that a track covers has a random part with the variance n^2 |distance|; parts of disjoint ways
are independent. Slip and skid stay as they are over a run, and are not known exactly.

Stance, without physics: the flippers, turned down, lift the front until the common tangent of rear roller and tip
roller is the ground. An obstacle lifts each roller's ground; the four heights give pitch and roll. No force is
computed, so that the paper's mass, 31 kg, has no use here. Its overall size is that of the solids in `scenes/room.py`.
All numbers of `PARAMETERS` are ours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from phibench.scenes.frames import Array, Pose, as_matrix, as_vector, rotation_xyz
from phibench.scenes.validation import SceneError, finite, positive, within

_SMALL_TURN_RAD = 1e-4  # below it the series' next term is 1e-17 of the first


@dataclass(frozen=True)
class VehicleParameter:
    """Range, unit and meaning of one number of the vehicle."""

    name: str
    unit: str
    low: float
    high: float
    meaning: str


_ROUNDING_RAD = 1e-9  # of sums of steps


def _number(default: float, unit: str, low: float, high: float, meaning: str) -> Any:
    """Field of one parameter: all of its `VehicleParameter` but the name."""
    return field(default=default, metadata={"unit": unit, "low": low, "high": high, "meaning": meaning})


@dataclass(frozen=True)
class Vehicle:
    """The vehicle; `PARAMETERS` has unit, range and meaning of each number.

    Raises
    ------
    SceneError
        If a number is beyond its range.
    """

    gauge_m: float = _number(0.42, "m", 0.36, 0.48, "between the middles of both tracks")
    contact_m: float = _number(0.58, "m", 0.40, 0.70, "between the axles of front and rear rollers")
    roller_m: float = _number(0.10, "m", 0.06, 0.15, "radius of the tracks' rollers")
    flipper_m: float = _number(0.20, "m", 0.12, 0.45, "from the front axle, the pivot, to the axle at the tip")
    tip_m: float = _number(0.04, "m", 0.02, 0.06, "radius of the roller at the flipper's tip")
    flipper_low_rad: float = _number(-1.4, "rad", -1.5, 0.0, "lowest angle of the flippers; 0 is ahead, up counts")
    flipper_high_rad: float = _number(1.6, "rad", 0.0, 2.5, "highest angle of the flippers")
    flipper_speed_rad_per_s: float = _number(1.0, "rad/s", 0.2, 3.0, "angular speed of the flippers")
    sensor_x_m: float = _number(0.06, "m", -0.15, 0.20, "stroke axis ahead of the middle of the tracks")
    top_speed_m_per_s: float = _number(0.5, "m/s", 0.1, 2.0, "largest speed of a track")
    slip: float = _number(0.03, "1", 0.0, 0.3, "part of a track's way that is lost")
    slip_sigma: float = _number(0.02, "1", 0.0, 0.1, "standard deviation of the slip from run to run")
    skid: float = _number(1.5, "1", 1.0, 2.5, "gauge that turns follow, over the tracks' gauge")
    skid_sigma: float = _number(0.08, "1", 0.0, 0.3, "standard deviation of the skid factor from run to run")
    track_noise: float = _number(0.01, "m^0.5", 0.0, 0.05, "random part of a track's way, per root of its length")

    def __post_init__(self) -> None:
        for entry in PARAMETERS.values():
            number = within("Vehicle", entry.name, getattr(self, entry.name), entry.low, entry.high)
            object.__setattr__(self, entry.name, float(number))

    def check_flipper(self, flipper_rad: float) -> float:
        """Return the angle; steps that add up to an end of the range, to their rounding, are at that end.

        Raises
        ------
        SceneError
            If it is beyond the flippers' range.
        """
        inside = min(max(flipper_rad, self.flipper_low_rad), self.flipper_high_rad)
        if not abs(flipper_rad - inside) < _ROUNDING_RAD:
            raise SceneError(
                f"flipper_rad = {flipper_rad:g}: the flippers turn from {self.flipper_low_rad:g} to "
                f"{self.flipper_high_rad:g} rad; ask for an angle in between"
            )
        return float(inside)

    def arc(self, left_m: float, right_m: float, slip: float | None = None, skid: float | None = None) -> Arc:
        """Arc of the base when the tracks run these distances at constant speeds; nominal slip and skid by default."""
        kept = 1.0 - (self.slip if slip is None else slip)
        turning = (self.skid if skid is None else skid) * self.gauge_m
        return Arc(0.5 * kept * (left_m + right_m), kept * (right_m - left_m) / turning)

    def track_variance_m2(self, track_m: float) -> float:
        """Variance of the random part of a track's way."""
        return self.track_noise**2 * abs(track_m)


PARAMETERS = {entry.name: VehicleParameter(entry.name, **entry.metadata) for entry in fields(Vehicle)}
"""All numbers of `Vehicle` by name, in order."""


# -- drive -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Arc:
    """Arc of a circle: its length, ahead counts, and the turn, to the left counts."""

    length_m: float
    turn_rad: float

    @property
    def chord_m(self) -> tuple[float, float]:
        """End of the arc in the base at its start, x and y."""
        s, a = self.length_m, self.turn_rad
        if abs(a) < _SMALL_TURN_RAD:
            return s * (1.0 - a * a / 6.0), s * a * (0.5 - a * a / 24.0)  # series of the next line, which is 0 / 0 at 0
        return s * math.sin(a) / a, 2.0 * s * math.sin(0.5 * a) ** 2 / a

    def jacobian(self) -> Array:
        """Derivative of (x, y, heading) at the end, in the base at the start, by length and turn: shape (3, 2)."""
        s, a = self.length_m, self.turn_rad
        if abs(a) < _SMALL_TURN_RAD:
            along, across = (1.0 - a * a / 6.0, 0.5 * a), (-s * a / 3.0, s * (0.5 - a * a / 8.0))
        else:
            sine, bow = math.sin(a) / a, 2.0 * math.sin(0.5 * a) ** 2 / a
            along, across = (sine, bow), (s * (math.cos(a) - sine) / a, s * (math.sin(a) - bow) / a)
        return np.array([[along[0], across[0]], [along[1], across[1]], [0.0, 1.0]])


@dataclass(frozen=True)
class PlanarPose:
    """Place of the base on the floor, world frame."""

    x_m: float = 0.0
    y_m: float = 0.0
    heading_rad: float = 0.0

    def after(self, arc: Arc) -> PlanarPose:
        """Pose at the end of an arc."""
        (x, y), c, s = arc.chord_m, math.cos(self.heading_rad), math.sin(self.heading_rad)
        return PlanarPose(self.x_m + c * x - s * y, self.y_m + s * x + c * y, self.heading_rad + arc.turn_rad)


def arc_covariance(vehicle: Vehicle, left_m: float, right_m: float) -> Array:
    """Covariance of (length, turn) of an arc by the random parts of both tracks, shape (2, 2)."""
    kept, turning = 1.0 - vehicle.slip, vehicle.skid * vehicle.gauge_m
    H = kept * np.array([[0.5, 0.5], [-1.0 / turning, 1.0 / turning]])
    variances = [vehicle.track_variance_m2(left_m), vehicle.track_variance_m2(right_m)]
    return np.asarray(H @ np.diag(variances) @ H.T)


# -- stance ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Obstacle:
    """Block on the floor, upright, with a ramp or a step at both ends of its length.

    Parameters
    ----------
    x_m, y_m, yaw_rad : float
        Middle on the floor and direction of the length, world.
    length_m, width_m, height_m : float
        Of the block.
    run_m : float
        Length of the ramps before and behind it; 0 is a step, over which rollers roll.
    """

    x_m: float
    y_m: float
    length_m: float
    width_m: float
    height_m: float
    run_m: float = 0.0
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        for name in ("x_m", "y_m", "yaw_rad"):
            finite("Obstacle", name, getattr(self, name))
        for name in ("length_m", "width_m", "height_m"):
            positive("Obstacle", name, getattr(self, name))
        within("Obstacle", "run_m", self.run_m, 0.0, 20.0)

    def lift_m(self, x_m: float, y_m: float, roller_m: float) -> float:
        """Rise of a roller's lowest point at a place.

        A roller of the radius r that meets a step of the height g at the edge e has its axle on a circle about the
        edge: it rises by g - r + sqrt(r^2 - (e - x)^2), where that is above 0.

        Raises
        ------
        SceneError
            If the step is higher than the roller's radius.
        """
        if self.run_m == 0.0 and self.height_m > roller_m:
            raise SceneError(
                f"Obstacle.height_m = {self.height_m:g}: a roller of {roller_m:g} m climbs no higher step; "
                "make the step lower or give it a ramp (run_m)"
            )
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        dx, dy = x_m - self.x_m, y_m - self.y_m
        if abs(c * dy - s * dx) > 0.5 * self.width_m:
            return 0.0
        beyond = abs(c * dx + s * dy) - 0.5 * self.length_m
        if beyond <= 0.0:
            return self.height_m
        if self.run_m > 0.0:
            return self.height_m * max(1.0 - beyond / self.run_m, 0.0)
        if beyond >= roller_m:
            return 0.0
        return max(self.height_m - roller_m + math.sqrt(roller_m**2 - beyond**2), 0.0)


@dataclass(frozen=True)
class Stance:
    """Attitude of the base: what flippers and ground do to it.

    Parameters
    ----------
    lift_m : float
        Of the middle between the four rollers' contacts, by the ground.
    pitch_rad, roll_rad : float
        By the ground; nose up and left side up count.
    raised_rad : float
        Pitch by the flippers, on the plane that the ground gives.
    """

    lift_m: float = 0.0
    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    raised_rad: float = 0.0


def flipper_pitch_rad(vehicle: Vehicle, flipper_rad: float) -> float:
    """Pitch, nose up, when the flippers are at an angle; 0 while their tips do not reach the ground.

    The line that touches rear roller (radius R) and tip roller (radius t) from below is the ground. With d between
    their axles and e the angle of the line of axles in the base, sin(e + pitch) = (t - R) / d.
    """
    angle = vehicle.check_flipper(flipper_rad)
    x = vehicle.contact_m + vehicle.flipper_m * math.cos(angle)
    z = vehicle.flipper_m * math.sin(angle)
    pitch = math.asin((vehicle.tip_m - vehicle.roller_m) / math.hypot(x, z)) - math.atan2(z, x)
    return max(pitch, 0.0)


def stance(vehicle: Vehicle, pose: PlanarPose, flipper_rad: float, obstacles: Sequence[Obstacle] = ()) -> Stance:
    """Attitude of the base at a place, with the flippers at an angle."""
    raised = flipper_pitch_rad(vehicle, flipper_rad)
    if not obstacles:
        return Stance(raised_rad=raised)
    c, s = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    half, side = 0.5 * vehicle.contact_m, 0.5 * vehicle.gauge_m
    rise = {}
    for x in (-half, half):
        for y in (-side, side):
            place = (pose.x_m + c * x - s * y, pose.y_m + s * x + c * y)
            rise[x, y] = max(obstacle.lift_m(*place, vehicle.roller_m) for obstacle in obstacles)
    front, rear = (0.5 * (rise[x, side] + rise[x, -side]) for x in (half, -half))
    left, right = (0.5 * (rise[half, y] + rise[-half, y]) for y in (side, -side))
    pitch, roll = math.atan2(front - rear, vehicle.contact_m), math.atan2(left - right, vehicle.gauge_m)
    return Stance(0.5 * (front + rear), pitch, roll, raised)


def rig_pose(vehicle: Vehicle, pose: PlanarPose, held: Stance) -> Pose:
    """Pose of the frame in which the rig is written, in the world: `T_world_rig`."""
    R, t = rig_placement(vehicle, pose, held)
    return Pose("world", "rig", as_vector(t), as_matrix(R))


def rig_placement(vehicle: Vehicle, pose: PlanarPose, held: Stance) -> tuple[Array, Array]:
    """Rotation, shape (3, 3), and origin, shape (3,), of `rig_pose`, for many steps a second."""
    ground = np.array(rotation_xyz(held.roll_rad, -held.pitch_rad, pose.heading_rad))
    c, s = math.cos(held.raised_rad), math.sin(held.raised_rad)
    raised = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    axle = np.array([-0.5 * vehicle.contact_m, 0.0, vehicle.roller_m])  # of the rear rollers, which stay
    foot = axle + raised @ (np.array([vehicle.sensor_x_m, 0.0, 0.0]) - axle)
    return ground @ raised, np.array([pose.x_m, pose.y_m, held.lift_m]) + ground @ foot
