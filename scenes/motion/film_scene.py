"""Scene of a film at any time: rig on robot and carriage, vibration, the laser spot on its path, and other lights.

`FilmScene.view_at` and `spot_at` give the still of any instant: what holds for stills holds for every row of a film.
`FilmScene.camera_at` is the same pose for many times at once.

A misalignment may turn and shift the rig between two images. In a film that grows with the carriage's offset, in
proportion, and is complete at the pair's stroke.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from phibench.scenes.frames import Array, as_vector
from phibench.scenes.laser import LaserSpot
from phibench.scenes.misalignment import Motion
from phibench.scenes.motion.carriage import Carriage, Times, Vibration
from phibench.scenes.motion.drive import Drive, placement, robot_pose
from phibench.scenes.motion.film_times import BlinkCode, FilmTimes
from phibench.scenes.rig import Rig, View
from phibench.scenes.validation import SceneError, finite, positive


@dataclass(frozen=True)
class Waypoint:
    """Place of the spot at a time: metres across (to the right, seen from its front) and up from where it starts."""

    time_s: float
    across_m: float
    up_m: float


@dataclass(frozen=True)
class SpotPath:
    """Path of a spot in the plane of its surface: straight, at constant speed, from waypoint to waypoint.

    Before the first waypoint and after the last one the spot rests. No waypoint is a spot that stands still.
    """

    waypoints: tuple[Waypoint, ...] = ()

    def __post_init__(self) -> None:
        for waypoint in self.waypoints:
            for name in ("time_s", "across_m", "up_m"):
                finite("Waypoint", name, getattr(waypoint, name))
        times = [waypoint.time_s for waypoint in self.waypoints]
        if any(after <= before for before, after in itertools.pairwise(times)):
            raise SceneError(f"SpotPath: times {times} of the waypoints must rise")

    def place_m(self, times_s: Times) -> Array:
        """Across and up, shape (..., 2)."""
        times = np.asarray(times_s, float)
        if not self.waypoints:
            return np.zeros((*times.shape, 2))
        when, where = self._table
        return np.stack([np.interp(times, when, column) for column in where.T], axis=-1)

    def velocity_m_per_s(self, times_s: Times) -> Array:
        """Derivative of `place_m`, shape (..., 2); at a waypoint, that of what follows."""
        times = np.asarray(times_s, float)
        if len(self.waypoints) < 2:
            return np.zeros((*times.shape, 2))
        when, where = self._table
        slopes = np.vstack([np.zeros(2), np.diff(where, axis=0) / np.diff(when)[:, None], np.zeros(2)])
        return slopes[np.searchsorted(when, times, side="right")]

    @property
    def _table(self) -> tuple[Array, Array]:
        rows = np.array([(waypoint.time_s, waypoint.across_m, waypoint.up_m) for waypoint in self.waypoints])
        return rows[:, 0], rows[:, 1:]


def across_and_up(spot: LaserSpot) -> Array:
    """Unit vectors in the plane of a spot, shape (2, 3): to the right seen from its front, and up."""
    n = np.array(spot.normal_world)
    up = np.array([0.0, 0.0, 1.0]) - n[2] * n
    if np.linalg.norm(up) < 1e-9:  # a spot on floor or ceiling has no "up" of its own
        up = np.array([0.0, 1.0, 0.0]) - n[1] * n
    up = up / np.linalg.norm(up)
    return np.stack([np.cross(up, n), up])


@dataclass(frozen=True)
class FilmLight:
    """Another light of a film: a lamp, a reflection, another laser or target.

    Parameters
    ----------
    spot : LaserSpot
        At the start of its path; a disc.
    colour : 3 floats or None
        Electrons behind R, G, B over those of the laser behind red; None is the laser's own colour.
    follows_laser : bool
        It goes out with the laser, as a reflection does.
    is_target : bool
        It is looked for by its code, beside the target.
    """

    name: str
    spot: LaserSpot
    path: SpotPath = SpotPath()
    code: BlinkCode = BlinkCode()
    colour: tuple[float, ...] | None = None
    follows_laser: bool = False
    is_target: bool = False


@dataclass(frozen=True)
class FilmScene:
    """Rig, spot and their motions over the times of a film.

    Parameters
    ----------
    spot : LaserSpot
        At the start of its path.
    vibrations : tuple of Vibration
    lights : tuple of FilmLight
        Other lights.
    drive : Drive or None
        The carriage rests while the robot drives.
    stroke_m : float
        Offset at which the rig's own motion between two images is complete; needed where it has one.
    """

    rig: Rig
    spot: LaserSpot
    times: FilmTimes
    carriage: Carriage
    vibrations: tuple[Vibration, ...] = ()
    path: SpotPath = SpotPath()
    code: BlinkCode = BlinkCode()
    lights: tuple[FilmLight, ...] = ()
    drive: Drive | None = None
    stroke_m: float = 0.0

    def __post_init__(self) -> None:
        if self.rig.motion is not None:
            positive("FilmScene", "stroke_m", self.stroke_m)
        if self.spot.beam_direction_world is not None and self.path.waypoints:
            raise SceneError("FilmScene.path: the spot of a beam stays where its beam ends; give a spot without beam")
        if self.code.duration_s > self.times.duration_s * (1.0 + 1e-9):  # a film of just so many frames holds it
            raise SceneError(
                f"the code takes {self.code.duration_s:g} s and the film {self.times.duration_s:g} s: a film "
                "must hold the whole code; give more frames or a shorter code"
            )
        for light in self.lights:
            if light.code.duration_s > self.times.duration_s * (1.0 + 1e-9):
                raise SceneError(
                    f"light '{light.name}': its code takes {light.code.duration_s:g} s and the film "
                    f"{self.times.duration_s:g} s: a film must hold the whole code; give more frames or a shorter code"
                )
        for number, way in enumerate(() if self.drive is None else self.drive.profiles, 1):
            start, end = way.start_s, way.start_s + way.duration_s
            for leg in self.carriage.legs:
                if leg.start_m != leg.end_m and start < leg.start_s + leg.duration_s and end > leg.start_s:
                    raise SceneError(
                        f"leg {number} of the drive goes from {start:.3f} to {end:.3f} s, and the carriage moves from "
                        f"{leg.start_s:.3f} to {leg.start_s + leg.duration_s:.3f} s: the robot makes a stroke only "
                        "while it stands; change start_s of the leg, or stops and pauses_s of the carriage"
                    )

    def of_light(self, number: int) -> FilmScene:
        """Same film with another light in place of the target's spot."""
        light = self.lights[number]
        return replace(self, spot=light.spot, path=light.path, code=light.code, lights=())

    def offset_m(self, times_s: Times) -> Array:
        """Carriage and vibration along the stroke axis."""
        along = [one.displacement_m(times_s) for one in self.vibrations if one.axis == "stroke"]
        return np.asarray(self.carriage.position_m(times_s) + sum(along, np.zeros(np.shape(times_s))))

    def offset_velocity_m_per_s(self, times_s: Times) -> Array:
        """Derivative of `offset_m`."""
        along = [one.velocity_m_per_s(times_s) for one in self.vibrations if one.axis == "stroke"]
        return np.asarray(self.carriage.velocity_m_per_s(times_s) + sum(along, np.zeros(np.shape(times_s))))

    def sway_m(self, times_s: Times) -> Array:
        """Vibration along world x, y, z, shape (..., 3)."""
        return self._sway(times_s, "displacement_m")

    def sway_velocity_m_per_s(self, times_s: Times) -> Array:
        """Derivative of `sway_m`."""
        return self._sway(times_s, "velocity_m_per_s")

    def spot_m(self, times_s: Times) -> Array:
        """Centre of the spot in the world, shape (..., 3)."""
        return np.array(self.spot.position_world_m) + self.path.place_m(times_s) @ across_and_up(self.spot)

    def spot_velocity_m_per_s(self, times_s: Times) -> Array:
        """Derivative of `spot_m`."""
        return self.path.velocity_m_per_s(times_s) @ across_and_up(self.spot)

    def robot_state(self, times_s: Times) -> Array:
        """State (x, y, heading, flipper) of the robot, shape (..., 4); 0 in a film without a drive."""
        return np.zeros((*np.shape(times_s), 4)) if self.drive is None else self.drive.state(times_s)

    def robot_rate(self, times_s: Times) -> Array:
        """Derivative of `robot_state`."""
        return np.zeros((*np.shape(times_s), 4)) if self.drive is None else self.drive.rate(times_s)

    def view_at(self, time_s: float) -> View:
        """View of an instant."""
        return self.view_of(float(self.offset_m(time_s)), self.sway_m(time_s), self.robot_state(time_s))

    def view_of(self, offset_m: float, sway_m: Array, robot_state: Array) -> View:
        """View with the carriage at an offset, the rig shifted by `sway_m` (3,) in world axes, the robot in a state."""
        motion = None if self.rig.motion is None else self.rig.motion.part(offset_m / self.stroke_m)
        if np.any(sway_m):
            sway = Motion(as_vector(np.asarray(sway_m, float)))
            motion = sway if motion is None else motion.then(sway)
        if self.drive is None or np.array_equal(robot_state, self.drive.starts[0]):
            return View(self.rig, offset_m, motion)
        return View(self.rig, offset_m, motion, robot_pose(self.drive.vehicle, robot_state))

    def camera_at(self, times_s: Array) -> tuple[Array, Array]:
        """Turns of the rig (N, 3, 3), from its axes as written to the world's, and lens centres (N, 3), at N times."""
        times = np.asarray(times_s, float)
        offsets = self.offset_m(times)
        lens = self.rig.T_world_camera.t + offsets[:, None] * np.array(self.rig.stroke_axis_world)
        turns = np.broadcast_to(np.eye(3), (len(times), 3, 3))
        if self.drive is not None:
            turns, origins = placement(self.drive.vehicle, self.robot_state(times))
            lens = (turns @ lens[..., None])[..., 0] + origins
        if (motion := self.rig.motion) is not None:
            shares = offsets / self.stroke_m
            turns = motion.turns(shares) @ turns
            lens = lens + shares[:, None] * np.array(motion.translation_m)
        return turns, lens + self.sway_m(times)

    def spot_at(self, time_s: float) -> LaserSpot:
        """Spot of an instant."""
        if not self.path.waypoints:
            return self.spot
        return replace(self.spot, position_world_m=as_vector(self.spot_m(time_s)))

    def _sway(self, times_s: Times, what: str) -> Array:
        result = np.zeros((*np.shape(times_s), 3))
        for one in self.vibrations:
            if one.axis != "stroke":
                result[..., "xy".index(one.axis)] += getattr(one, what)(times_s)
        return result


def frame_count(carriage: Carriage, rate_hz: float, drive: Drive | None = None) -> int:
    """Number of frames that show the whole motion of carriage and robot, the first one at the time 0."""
    end_s = max(carriage.duration_s, 0.0 if drive is None else drive.end_s)
    return math.floor(end_s * rate_hz + 1e-9) + 1  # a product that rounds below its whole number
