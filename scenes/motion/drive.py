"""Drive of the robot in a film: arcs and flipper turns in time, encoder readings of its tracks, and the rig's pose.

A leg starts and ends at rest, on a level floor. A leg that drives is an arc of the base of a given length and turn; the
faster track follows the trapezoidal speed of `carriage.Leg`. A leg may turn the flippers instead. At any time the state
of the robot is (x, y, heading, flipper), a closed form: part f of an arc of the length s and the turn a, from a heading
h, ends at the distance s f sinc(a f / 2) in the direction h + a f / 2.

The path is the true one. Slip and skid say how far the tracks ran on it. Their readings also have the random part of
`vehicle`: a random walk whose variance grows with the track's way. A robot that knows the nominal slip and skid alone
finds its pose by `reckoned_poses`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from phibench.scenes.frames import Array, Pose, as_matrix, as_vector
from phibench.scenes.motion.carriage import Leg, Times
from phibench.scenes.motion.vehicle import PlanarPose, Vehicle, flipper_pitch_rad
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.rig import RobotPose
from phibench.scenes.room import FLIPPER_RAD
from phibench.scenes.validation import SceneError, finite, positive

_FLIPPER_RAD_PER_S2 = 5.0  # ours: a fifth of a second to full speed
_SLIP, _SKID = (0.0, 0.3), (1.0, 2.5)  # ranges of `Vehicle`


@dataclass(frozen=True)
class DriveLeg:
    """One leg.

    Parameters
    ----------
    length_m, turn_rad : float
        Of the arc of the base; ahead and to the left count.
    flipper_rad : float or None
        Angle of the flippers at the end of a leg that does not drive.
    speed_m_per_s, acceleration_m_per_s2 : float
        Of the faster track, largest.
    """

    start_s: float
    length_m: float = 0.0
    turn_rad: float = 0.0
    flipper_rad: float | None = None
    speed_m_per_s: float = 0.2
    acceleration_m_per_s2: float = 0.5

    def __post_init__(self) -> None:
        for name in ("start_s", "length_m", "turn_rad"):
            finite("DriveLeg", name, getattr(self, name))
        for name in ("speed_m_per_s", "acceleration_m_per_s2"):
            positive("DriveLeg", name, getattr(self, name))
        if self.drives == (self.flipper_rad is not None):
            what = "drives and turns the flippers" if self.drives else "neither drives nor turns the flippers"
            raise SceneError(f"a leg of the drive {what}: give each leg one of the two")

    @property
    def drives(self) -> bool:
        """False for a leg that turns the flippers."""
        return self.length_m != 0.0 or self.turn_rad != 0.0


@dataclass(frozen=True)
class Drive:
    """Legs of a vehicle whose stroke axis starts at the world's, heading along x, flippers as they are drawn.

    Parameters
    ----------
    vehicle : Vehicle
        With its nominal slip and skid.
    legs : tuple of DriveLeg
        In order of time; they must not overlap.
    slip, skid : float
        True ones.

    Raises
    ------
    SceneError
        If a leg will not do.
    """

    vehicle: Vehicle
    legs: tuple[DriveLeg, ...]
    slip: float
    skid: float

    def __post_init__(self) -> None:
        for number, leg in enumerate(self.legs):
            if leg.speed_m_per_s > self.vehicle.top_speed_m_per_s:
                raise SceneError(
                    f"leg {number + 1} of the drive: the tracks run {self.vehicle.top_speed_m_per_s:g} m/s at most, "
                    f"not {leg.speed_m_per_s:g}; lower speed_m_per_s"
                )
            if leg.flipper_rad is not None:
                self.vehicle.check_flipper(leg.flipper_rad)
        ends = [profile.start_s + profile.duration_s for profile in self.profiles]
        for number, leg in enumerate(self.legs[1:], 1):
            if leg.start_s < ends[number - 1] - 1e-9:  # a leg may start at the printed end of the one before
                raise SceneError(
                    f"leg {number + 1} of the drive starts at {leg.start_s:g} s and leg {number} ends at "
                    f"{ends[number - 1]:.3f} s: start it then or later"
                )

    @classmethod
    def drawn(cls, vehicle: Vehicle, legs: Sequence[DriveLeg], *names: Name) -> Drive:
        """Drive whose true slip and skid are drawn from a named stream, within the ranges of `Vehicle`."""
        z = generator("drive", *names).standard_normal(2)
        slip = float(np.clip(vehicle.slip + vehicle.slip_sigma * z[0], *_SLIP))
        skid = float(np.clip(vehicle.skid + vehicle.skid_sigma * z[1], *_SKID))
        return cls(vehicle, tuple(legs), slip, skid)

    @cached_property
    def profiles(self) -> tuple[Leg, ...]:
        """Way of the faster track (m), or angle of the flippers (rad), against time, for each leg."""
        result, flipper = [], FLIPPER_RAD
        for leg in self.legs:
            if leg.flipper_rad is None:
                way = float(np.abs(self._tracks_m(leg)).max())
                result.append(Leg(leg.start_s, 0.0, way, leg.speed_m_per_s, leg.acceleration_m_per_s2))
                continue
            speed = self.vehicle.flipper_speed_rad_per_s
            result.append(Leg(leg.start_s, flipper, leg.flipper_rad, speed, _FLIPPER_RAD_PER_S2))
            flipper = leg.flipper_rad
        return tuple(result)

    @property
    def end_s(self) -> float:
        """Time at which the last leg has ended; 0 without legs."""
        return max((profile.start_s + profile.duration_s for profile in self.profiles), default=0.0)

    @cached_property
    def starts(self) -> Array:
        """States (x, y, heading, flipper) at which the legs start, and the last one's end, shape (legs + 1, 4)."""
        states = [np.array([-self.vehicle.sensor_x_m, 0.0, 0.0, FLIPPER_RAD])]
        for leg, profile in zip(self.legs, self.profiles, strict=True):
            states.append(_on_leg(leg, states[-1], profile, np.array(profile.end_m)))
        return np.stack(states)

    def state(self, times_s: Times) -> Array:
        """State (x, y, heading, flipper), shape (..., 4): metres of the base on the floor, radians."""
        return self._each(times_s, lambda n, t: _on_leg(self.legs[n], self.starts[n], self.profiles[n], t[0]))

    def state_on_leg(self, number: int, place: Array) -> Array:
        """State at a place of a leg: way of the faster track, or angle of the flippers; shape (..., 4)."""
        return _on_leg(self.legs[number], self.starts[number], self.profiles[number], np.asarray(place, float))

    def rate(self, times_s: Times) -> Array:
        """Derivative of `state`, per second."""

        def slope(number: int, t: tuple[Array, Array, Array]) -> Array:
            leg, profile = self.legs[number], self.profiles[number]
            if leg.flipper_rad is not None:
                return np.stack([*np.zeros((3, *t[0].shape)), t[1]], axis=-1)
            share = t[1] / profile.end_m
            heading = _on_leg(leg, self.starts[number], profile, t[0])[..., 2]
            along, still = leg.length_m * share, np.zeros(t[0].shape)
            return np.stack([along * np.cos(heading), along * np.sin(heading), leg.turn_rad * share, still], axis=-1)

        return self._each(times_s, slope, at_rest=np.zeros(4))

    def bends_s(self, number: int) -> tuple[float, ...]:
        """Times within a leg at which the way of the rig bends: the flippers' tips come to the floor, or leave it."""
        leg, profile = self.legs[number], self.profiles[number]
        if leg.flipper_rad is None:
            return ()
        low, high = profile.start_s, profile.start_s + profile.duration_s

        def lifts(time_s: float) -> bool:
            return flipper_pitch_rad(self.vehicle, float(profile.state(np.array(time_s))[0])) > 0.0

        if lifts(low) == lifts(high):
            return ()
        for _ in range(60):  # halvings: to the last digit of a double
            middle = 0.5 * (low + high)
            low, high = (middle, high) if lifts(middle) == lifts(low) else (low, middle)
        return (high,)

    def tracks_m(self, times_s: Times) -> tuple[Array, Array]:
        """Ways of the left and the right track since the time 0, ahead counts, and without regard to sign; (..., 2)."""
        times = np.asarray(times_s, float)
        net, gross = np.zeros((*times.shape, 2)), np.zeros((*times.shape, 2))
        for leg, profile in zip(self.legs, self.profiles, strict=True):
            if leg.drives:
                share = profile.state(times)[0][..., None] / profile.end_m * self._tracks_m(leg)
                net, gross = net + share, gross + np.abs(share)
        return net, gross

    def readings_m(self, times_s: Array, *names: Name) -> Array:
        """Readings of both tracks' encoders, metres since the time 0, shape (N, 2), at rising times.

        Reading k is the same whatever N.
        """
        net, gross = self.tracks_m(times_s)
        z = generator("tracks", *names).standard_normal(net.shape)
        steps = np.diff(gross, axis=0, prepend=np.zeros((1, 2)))
        return np.asarray(net + self.vehicle.track_noise * np.cumsum(np.sqrt(steps) * z, axis=0))

    def _tracks_m(self, leg: DriveLeg) -> Array:
        """True ways of the left and the right track over a leg: `Vehicle.arc` the other way round."""
        lever = 0.5 * self.skid * self.vehicle.gauge_m * leg.turn_rad
        return np.array([leg.length_m - lever, leg.length_m + lever]) / (1.0 - self.slip)

    def _each(self, times_s: Times, function: Any, at_rest: Array | None = None) -> Array:
        """Values of a function of leg and its profile's state, the leg being the last that has started."""
        times = np.asarray(times_s, float)
        result = np.broadcast_to(self.starts[0] if at_rest is None else at_rest, (*times.shape, 4)).copy()
        number = np.searchsorted([leg.start_s for leg in self.legs], times, side="right") - 1
        for n in np.unique(number[number >= 0]):
            chosen = number == n
            result[chosen] = function(int(n), self.profiles[n].state(times[chosen]))
        return result


def _on_leg(leg: DriveLeg, start: Array, profile: Leg, place: Array) -> Array:
    if leg.flipper_rad is not None:
        return np.stack([*(np.full(place.shape, x) for x in start[:3]), place], axis=-1)
    share = place / profile.end_m
    half = 0.5 * leg.turn_rad * share
    chord, towards = leg.length_m * share * np.sinc(half / np.pi), start[2] + half
    x, y = start[0] + chord * np.cos(towards), start[1] + chord * np.sin(towards)
    return np.stack([x, y, start[2] + 2.0 * half, np.full(place.shape, start[3])], axis=-1)


def placement(vehicle: Vehicle, states: Array) -> tuple[Array, Array]:
    """Rotations (..., 3, 3) and origins (..., 3) of the rig's frame at states (..., 4): `vehicle.rig_placement`.

    Angles of the flippers beyond their range, as differences at its ends need them, count as its ends.
    """
    x, y, heading, flipper = np.moveaxis(np.asarray(states, float), -1, 0)
    flipper = np.clip(flipper, vehicle.flipper_low_rad, vehicle.flipper_high_rad)
    angles, where = np.unique(flipper, return_inverse=True)
    pitch = np.array([flipper_pitch_rad(vehicle, float(angle)) for angle in angles])[where].reshape(flipper.shape)
    c, s, nil, one = np.cos(heading), np.sin(heading), np.zeros(x.shape), np.ones(x.shape)
    cp, sp = np.cos(pitch), np.sin(pitch)
    ground = np.moveaxis(np.array([[c, -s, nil], [s, c, nil], [nil, nil, one]]), (0, 1), (-2, -1))
    raised = np.moveaxis(np.array([[cp, nil, -sp], [nil, one, nil], [sp, nil, cp]]), (0, 1), (-2, -1))
    axle = np.array([-0.5 * vehicle.contact_m, 0.0, vehicle.roller_m])
    foot = axle + raised @ (np.array([vehicle.sensor_x_m, 0.0, 0.0]) - axle)
    origin = np.stack([x, y, nil], axis=-1) + (ground @ foot[..., None])[..., 0]
    return ground @ raised, origin


def robot_pose(vehicle: Vehicle, state: Array) -> RobotPose:
    """Place of the robot at a state (4,)."""
    R, t = placement(vehicle, state)
    return RobotPose(Pose("world", "rig", as_vector(t), as_matrix(R)), float(state[3]))


def reckoned_poses(vehicle: Vehicle, readings_m: Array) -> list[PlanarPose]:
    """Poses that the tracks' readings (N, 2) give a robot that takes slip and skid for nominal, from the start."""
    pose, poses, before = PlanarPose(-vehicle.sensor_x_m), [], np.zeros(2)
    for now in readings_m:
        pose = pose.after(vehicle.arc(*(float(way) for way in now - before)))
        poses.append(pose)
        before = now
    return poses
