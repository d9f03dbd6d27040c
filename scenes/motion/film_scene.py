"""Moving parts of a film: the rig with its carriage and vibration, and the laser spot on its path, at any time.

`FilmScene.view_at` and `spot_at` give the still of any instant: what holds for stills holds for every row of a film.
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
from phibench.scenes.motion.film_times import BlinkCode, FilmTimes
from phibench.scenes.rig import Rig, View
from phibench.scenes.validation import SceneError, finite


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
        for one in self.waypoints:
            for name in ("time_s", "across_m", "up_m"):
                finite("Waypoint", name, getattr(one, name))
        times = [one.time_s for one in self.waypoints]
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
        rows = np.array([(one.time_s, one.across_m, one.up_m) for one in self.waypoints])
        return rows[:, 0], rows[:, 1:]


def across_and_up(spot: LaserSpot) -> Array:
    """Unit vectors in the plane of a spot, shape (2, 3): to the right seen from its front, and up."""
    n = np.array(spot.normal_world)
    up = np.array([0.0, 0.0, 1.0]) - n[2] * n
    if np.linalg.norm(up) < 1e-9:
        up = np.array([0.0, 1.0, 0.0]) - n[1] * n
    up = up / np.linalg.norm(up)
    return np.stack([np.cross(up, n), up])


@dataclass(frozen=True)
class FilmLight:
    """Another light of a film: a lamp, a reflection, another laser or target.

    Parameters
    ----------
    name : str
    spot : LaserSpot
        At the start of its path; a disc.
    path : SpotPath
    code : BlinkCode
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
    rig : Rig
        Without a motion between images: a film has vibration instead.
    spot : LaserSpot
        At the start of its path.
    times : FilmTimes
    carriage : Carriage
    vibrations : tuple of Vibration
    path : SpotPath
    code : BlinkCode
    lights : tuple of FilmLight
        Other lights.
    """

    rig: Rig
    spot: LaserSpot
    times: FilmTimes
    carriage: Carriage
    vibrations: tuple[Vibration, ...] = ()
    path: SpotPath = SpotPath()
    code: BlinkCode = BlinkCode()
    lights: tuple[FilmLight, ...] = ()

    def __post_init__(self) -> None:
        if self.rig.motion is not None:
            raise SceneError("FilmScene.rig moves between two images: a film has vibration, leave that motion out")
        if self.spot.beam_direction_world is not None and self.path.waypoints:
            raise SceneError("FilmScene.path: the spot of a beam stays where its beam ends; give a spot without beam")
        if self.code.duration_s > self.times.duration_s * (1.0 + 1e-9):
            raise SceneError(
                f"FilmScene.code takes {self.code.duration_s:g} s and the film {self.times.duration_s:g} s: a film "
                "must hold the whole code; give more frames or a shorter code"
            )
        for light in self.lights:
            if light.code.duration_s > self.times.duration_s * (1.0 + 1e-9):
                raise SceneError(
                    f"light '{light.name}': its code takes {light.code.duration_s:g} s and the film "
                    f"{self.times.duration_s:g} s: a film must hold the whole code; give more frames or a shorter code"
                )

    def of_light(self, number: int) -> FilmScene:
        """Same film with another light in place of the target's spot."""
        one = self.lights[number]
        return replace(self, spot=one.spot, path=one.path, code=one.code, lights=())

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

    def view_at(self, time_s: float) -> View:
        """View of an instant."""
        return moved_view(self.rig, float(self.offset_m(time_s)), self.sway_m(time_s))

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


def moved_view(rig: Rig, offset_m: float, sway_m: Array) -> View:
    """View of a rig with its carriage at an offset, shifted by `sway_m`, shape (3,), in world axes."""
    still = not np.any(sway_m)
    return View(rig, offset_m, None if still else Motion(as_vector(np.asarray(sway_m, float))))


def frames_of(carriage: Carriage, rate_hz: float) -> int:
    """Number of frames that show the whole motion of a carriage, the first one at the time 0."""
    return math.floor(carriage.duration_s * rate_hz + 1e-9) + 1
