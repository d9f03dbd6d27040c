"""Simulator of the loop, its setup and task: robot, room, target, actions and observations; without `gymnasium`.

A step lasts `Task.step_s` and ends with a frame. An episode ends when the policy states the distance, when the robot
runs into something, or when the time is over. Stated well is: D true to `Task.depth_share`, and the robot at the
stand-off distance to `Task.reach_m`, D being measured from the stroke axis at the level robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from phibench.estimator.geometry.rig_parameters import drawn_deviation
from phibench.estimator.spots.spot_prediction import Laser
from phibench.robot.loop.arena import Arena, Target, plain_arena
from phibench.robot.loop.robot_pixels import FIDELITIES, Fidelity, RobotCamera, SpotReader, Window, pixel_form
from phibench.robot.loop.sensing import DARK, EXPOSURES_S, FAINT, SEEN, Sensing, SpotOnSurface, SpotReading
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.motion.vehicle import Obstacle, PlanarPose, Stance, Vehicle, rig_placement, stance
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError, printable_line, within

CODES = ("0", "1", "111100010011010")
"""Laser codes, a bit per step: off, on, and a maximal sequence that no light imitates by chance."""
NOT_STARTED, RUNNING, REACHED, WRONG, COLLISION, LATE = (
    "not started",
    "running",
    "reached",
    "stated wrongly",
    "ran into something",
    "time is over",
)
LIGHT_ROWS = 6
"""Most lights of an episode, the target among them."""
_NEAR_PX = 4.0  # of a spot that counts as the target's
_OTHER_CODES = ("1", "1", "10", "1100101")  # lamps and red objects; other lasers


class Action(NamedTuple):
    """Command of one step.

    Attributes
    ----------
    drive_m_per_s, turn_rad_per_s : float
        By the vehicle's nominal slip and skid factor.
    flipper_rad_per_s, stroke_m_per_s : float
        Rates of the flipper and of the stroke.
    exposure : int
        Index of `sensing.EXPOSURES_S`.
    code : int
        Index of `CODES`.
    stated_m : float
        Distance D that ends the episode; 0 goes on.
    """

    drive_m_per_s: float = 0.0
    turn_rad_per_s: float = 0.0
    flipper_rad_per_s: float = 0.0
    stroke_m_per_s: float = 0.0
    exposure: int = 4
    code: int = 1
    stated_m: float = 0.0


class Observation(NamedTuple):
    """Report of one step.

    Attributes
    ----------
    step : int
        Number of the step.
    left_m, right_m : float
        Ways of the tracks by their encoders.
    flipper_rad, pitch_rad, roll_rad, stroke_m : float
        Pitch and roll by the ground alone, from an inclinometer; all four are exact.
    lit : bool
        The robot's laser was on.
    spots : tuple of SpotReading
        Spots that were seen, by rising u; measured in the pixels where there are any.
    windows : tuple of Window
        Pixels around spots, by rising u, or the whole frame; none of the exact model.
    """

    step: int
    left_m: float
    right_m: float
    flipper_rad: float
    pitch_rad: float
    roll_rad: float
    stroke_m: float
    lit: bool
    spots: tuple[SpotReading, ...]
    windows: tuple[Window, ...] = ()

    def attitude(self, vehicle: Vehicle) -> Stance | None:
        """Attitude of the robot; None where it is level."""
        held = stance(vehicle, PlanarPose(), self.flipper_rad)
        if held.raised_rad == 0.0 and self.pitch_rad == 0.0 and self.roll_rad == 0.0:
            return None
        return replace(held, pitch_rad=self.pitch_rad, roll_rad=self.roll_rad)


@dataclass(frozen=True)
class Task:
    """Task, and what it is judged by.

    Parameters
    ----------
    distances_m : 2 floats
        Between which targets are drawn, from the stroke axis at the start.
    stand_off_m, reach_m, depth_share : float
        Where the robot is to stop, how far from it is still there, and how far a stated D may be off, as a share.
    step_s, longest_s : float
        Length of a step and of an episode.
    stroke_m : float
        Longest stroke; the carriage starts down.
    stroke_speed_m_per_s, turn_rad_per_s : float
        Largest speeds.
    lights : int
        Other lights in the room, at most 5.
    obstacle_m, obstacle_run_m : float
        Height of a block across the way, half of it, and length of its ramps; a height of 0 is a level floor, a run of
        0 a step. Robots whose target is near start on it: 3 m suffice for the default.
    power : float
        Of the laser, relative to `laser`.
    """

    distances_m: tuple[float, float] = (1.5, 4.5)
    stand_off_m: float = 1.0
    reach_m: float = 0.05
    depth_share: float = 0.02
    step_s: float = 0.1
    longest_s: float = 90.0
    stroke_m: float = 0.8
    stroke_speed_m_per_s: float = 0.4
    turn_rad_per_s: float = 0.8
    lights: int = 3
    power: float = 1.0
    obstacle_m: float = 0.0
    obstacle_run_m: float = 0.4
    laser: Laser = field(default_factory=Laser)

    def __post_init__(self) -> None:
        within("Task", "lights", self.lights, 0, LIGHT_ROWS - 1)
        near, far = self.distances_m
        if not near <= far:
            raise SceneError(f"Task.distances_m = {near:g}, {far:g}: the nearest target comes first")
        within("Task", "stand_off_m", self.stand_off_m, 0.7, near)
        within("Task", "step_s", self.step_s, 0.01, 1.0)
        within("Task", "power", self.power, 1e-3, 5.0)
        within("Task", "obstacle_m", self.obstacle_m, 0.0, 0.3)
        within("Task", "obstacle_run_m", self.obstacle_run_m, 0.0, 5.0)

    @property
    def steps(self) -> int:
        """Most steps of an episode."""
        return round(self.longest_s / self.step_s)


@dataclass(frozen=True)
class Known:
    """Knowledge of a policy: nominal vehicle and rig, the task, and the covariance of the rig; None is an exact rig."""

    vehicle: Vehicle
    rig: Rig
    task: Task
    rig_covariance: Array | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Setup:
    """Robot, rig, sensor and rooms of an environment.

    Parameters
    ----------
    vehicle : Vehicle
        Robot that drives.
    rig : Rig
        The nominal one, which policies know.
    misalignment : Misalignment
        Deviations of the true rig from it, which they do not know.
    rig_covariance : shape (p, p), or None
        Of such deviations, in the order of `rig_parameters.PARAMETERS`, which they know; None tells them that the rig
        is exact.
    preset : str
        Sensor whose bound is the noise, or whose pixels are drawn.
    own_rigs : bool
        Every episode has a true rig of its own, drawn from `rig_covariance`, in place of `misalignment`.
    task : Task
        What it is to do.
    arenas : tuple of Arena
        Rooms, of which each episode draws one; without any each episode has a plain room of its own.
    fidelity : "exact", "windows" or "frames"
        Spots by the measurement model, or pixels of rooms that are baked: windows around spots, or whole frames.

    Raises
    ------
    SceneError
        If there is no such fidelity, pixels are asked for and a room is not baked, or rigs are to be drawn from no
        covariance.
    """

    vehicle: Vehicle = field(default_factory=Vehicle)
    rig: Rig = field(default_factory=Rig)
    misalignment: Misalignment = field(default_factory=Misalignment)
    preset: str = "bayer-raw"
    task: Task = field(default_factory=Task)
    arenas: tuple[Arena, ...] = ()
    fidelity: Fidelity = "exact"
    rig_covariance: Array | None = field(default=None, compare=False)
    own_rigs: bool = False

    def __post_init__(self) -> None:
        if self.own_rigs and self.rig_covariance is None:
            raise SceneError("Setup.own_rigs: rigs are drawn from rig_covariance; give it, or leave own_rigs")
        if self.fidelity not in FIDELITIES:
            raise SceneError(f"Setup.fidelity = '{self.fidelity}': must be one of {', '.join(FIDELITIES)}")
        if self.fidelity == "exact":
            return
        pixel_form(self.preset)
        if not self.arenas or any(arena.baked is None for arena in self.arenas):
            raise SceneError(
                f"Setup.fidelity = '{self.fidelity}' needs rooms whose light is baked: run `phibench loop bake --out "
                "DIR`, and give Setup(arenas=baked_arenas('DIR'))"
            )

    @property
    def known(self) -> Known:
        """Knowledge that policies may have."""
        return Known(self.vehicle, self.rig, self.task, self.rig_covariance)


@dataclass(frozen=True)
class _Light:
    """A spot in the room that is not the target's."""

    spot: SpotOnSurface
    bits: str


class Simulator:
    """One robot in one room at a time.

    Parameters
    ----------
    setup : Setup
        Room, robot, rig and task.
    reads : bool
        Measure the spots in pixels; False leaves that to the policy, and `Observation.spots` empty.

    Raises
    ------
    SceneError
        If the true rig's mirror is no perfect sphere, or spots are to be measured in other pixels than raw ones.
    """

    def __init__(self, setup: Setup, reads: bool = True) -> None:
        self.setup = setup
        self._reader: SpotReader | None = None
        if setup.fidelity != "exact" and reads:
            self._reader = SpotReader(setup.rig, setup.preset, setup.fidelity)
        self._stand_on(setup.misalignment)
        self.outcome = NOT_STARTED

    def _stand_on(self, misalignment: Misalignment) -> None:
        """Take a true rig."""
        setup, laser = self.setup, self.setup.task.laser
        self.misalignment, rig = misalignment, setup.rig.perturbed(misalignment)
        self._sensing = Sensing(rig, setup.preset, laser)
        exact = setup.fidelity == "exact"
        self._camera = None if exact else RobotCamera(rig, setup.preset, laser, setup.fidelity)

    def start(self, *stream: Name) -> Observation:
        """Begin an episode: the names decide on room, target, lights, rig, slip and noise."""
        if self.setup.own_rigs:
            assert self.setup.rig_covariance is not None  # `Setup` checks it
            self._stand_on(drawn_deviation(self.setup.rig_covariance, generator(*stream, "rig")))
        setup, task, rng = self.setup, self.setup.task, generator(*stream, "loop")
        self.stream, self._rng = stream, rng
        self.arena, self.target = self._place(rng, stream)
        self._lights = [
            _Light(
                SpotOnSurface(*self.arena.draw_distractor(rng), float(rng.uniform(0.3, 3.0))),
                str(rng.choice(_OTHER_CODES)),
            )
            for _ in range(task.lights)
        ]
        # a track that slips by more does not drive
        self.slip = float(np.clip(setup.vehicle.slip + setup.vehicle.slip_sigma * rng.standard_normal(), -0.2, 0.5))
        self.skid = max(setup.vehicle.skid + setup.vehicle.skid_sigma * float(rng.standard_normal()), 0.5)
        self.obstacles = self._obstacles()
        heading = float(rng.uniform(-math.pi, math.pi))
        ahead = setup.vehicle.sensor_x_m  # the stroke axis starts at the room's origin
        self.pose = PlanarPose(-ahead * math.cos(heading), -ahead * math.sin(heading), heading)
        self.flipper_rad, self.stroke_m, self.step, self.outcome = 0.0, 0.0, 0, RUNNING
        self.driven_m, self.strokes, self.refused = 0.0, 0, ""
        self.shortest_m = max(math.hypot(*self.target.point_m[:2]) - task.stand_off_m, 0.0)
        self._stroke_way = 0
        self.unseen_cause = SEEN
        return self._observe(Action(), 0.0, 0.0)

    def _place(self, rng: np.random.Generator, stream: Sequence[Name]) -> tuple[Arena, Target]:
        """Room and target: the next room is asked where one has no target that can be reached."""
        task, given = self.setup.task, self.setup.arenas
        for turn in range(max(20, len(given))):
            arena = given[int(rng.integers(len(given)))] if given else plain_arena(*stream, turn)
            try:
                return arena, arena.draw_target(rng, task.distances_m, task.stand_off_m)
            except SceneError:
                continue
        raise SceneError(
            f"no room has a target {task.distances_m[0]:g} to {task.distances_m[1]:g} m away that can be driven to; "
            "allow other distances, or give other rooms"
        )

    def _obstacles(self) -> tuple[Obstacle, ...]:
        """Block across the straight way to the stand-off distance, half of it; none on a level floor."""
        task, (x, y) = self.setup.task, self.target.point_m[:2].tolist()
        if task.obstacle_m == 0.0:
            return ()
        half = 0.5 * (1.0 - task.stand_off_m / math.hypot(x, y))
        block = Obstacle(half * x, half * y, 0.3, 2.0, task.obstacle_m, task.obstacle_run_m, math.atan2(y, x))
        block.lift_m(0.0, 0.0, self.setup.vehicle.roller_m)  # a step that is too high is said at once
        return (block,)

    # -- truth -----------------------------------------------------------------------------------------------------

    @property
    def placement(self) -> tuple[Array, Array]:
        """Rotation and origin of the rig's frame in the world."""
        return rig_placement(self.setup.vehicle, self.pose, self.stance)

    @property
    def stance(self) -> Stance:
        """Attitude by flippers and ground."""
        return stance(self.setup.vehicle, self.pose, self.flipper_rad, self.obstacles)

    def target_in_rig_m(self) -> Array:
        """True place of the target in the rig's frame of the level robot, shape (3,)."""
        R, t = rig_placement(self.setup.vehicle, self.pose, Stance())
        return np.asarray((self.target.point_m - t) @ R)

    @property
    def distance_m(self) -> float:
        """True D."""
        x, y, _ = self.target_in_rig_m()
        return math.hypot(x, y)

    @property
    def raised_m(self) -> float:
        """True place of the carriage, where `stroke_m` is what its encoder reads (`rig_parameters.stroke_of`)."""
        own = self.misalignment
        return (1.0 + own.stroke_relative) * self.stroke_m + own.stroke_offset_m

    @property
    def time_s(self) -> float:
        """Time since the episode began."""
        return self.step * self.setup.task.step_s

    # -- step ------------------------------------------------------------------------------------------------------

    def act(self, action: Action) -> Observation:
        """Perform one step.

        Raises
        ------
        SceneError
            If a number of the action is not finite, no such exposure or code exists, or the episode is over.
        """
        if self.outcome != RUNNING:
            raise SceneError(f"no episode is running ({self.outcome}): reset before the next step")
        _check(action)
        task, self.refused = self.setup.task, ""
        left, right = self._drive(action)
        self._turn_flippers(action.flipper_rad_per_s)
        self._stroke(action.stroke_m_per_s, moving=left != 0.0 or right != 0.0)
        self.step += 1
        if self.arena.collides(self.pose.x_m, self.pose.y_m):
            self.outcome = COLLISION
        elif action.stated_m > 0.0:
            self.outcome = REACHED if self._is_right(action.stated_m) else WRONG
        elif self.step >= task.steps:
            self.outcome = LATE
        return self._observe(action, left, right)

    def _is_right(self, stated_m: float) -> bool:
        task, true = self.setup.task, self.distance_m
        return abs(stated_m - true) <= task.depth_share * true and abs(true - task.stand_off_m) <= task.reach_m

    def _drive(self, action: Action) -> tuple[float, float]:
        """Ways of both tracks by their encoders; moves the robot by the true ones."""
        vehicle, dt = self.setup.vehicle, self.setup.task.step_s
        turn = float(np.clip(action.turn_rad_per_s, -self.setup.task.turn_rad_per_s, self.setup.task.turn_rad_per_s))
        kept, lever = 1.0 - vehicle.slip, 0.5 * vehicle.skid * vehicle.gauge_m
        speeds = [(action.drive_m_per_s + side * lever * turn) / kept for side in (-1.0, 1.0)]
        fastest = max(abs(speed) for speed in speeds)
        scale = min(1.0, vehicle.top_speed_m_per_s / fastest) if fastest > 0.0 else 0.0
        left, right = (scale * speed * dt for speed in speeds)
        if left == 0.0 and right == 0.0:
            return 0.0, 0.0
        noise = self._rng.standard_normal(2)
        true = [
            way + math.sqrt(vehicle.track_variance_m2(way)) * float(z)
            for way, z in zip((left, right), noise, strict=True)
        ]
        arc = vehicle.arc(true[0], true[1], self.slip, self.skid)
        self.pose = self.pose.after(arc)
        self.driven_m += abs(arc.length_m)
        return left, right

    def _turn_flippers(self, rate: float) -> None:
        vehicle, dt = self.setup.vehicle, self.setup.task.step_s
        limit = vehicle.flipper_speed_rad_per_s
        wanted = self.flipper_rad + float(np.clip(rate, -limit, limit)) * dt
        try:
            self.flipper_rad = vehicle.check_flipper(wanted)
        except SceneError as error:
            self.flipper_rad = float(np.clip(wanted, vehicle.flipper_low_rad, vehicle.flipper_high_rad))
            self.refused = str(error)

    def _stroke(self, rate: float, moving: bool) -> None:
        task = self.setup.task
        if rate == 0.0:
            self._stroke_way = 0
            return
        if moving:
            self.refused = (
                f"stroke_m_per_s = {rate:g} while the tracks run: the carriage moves only while the robot stands; "
                "stop, or leave the carriage"
            )
            return
        limit = task.stroke_speed_m_per_s
        wanted = self.stroke_m + float(np.clip(rate, -limit, limit)) * task.step_s
        self.stroke_m = float(np.clip(wanted, 0.0, task.stroke_m))
        if abs(wanted - self.stroke_m) > 1e-12:  # rounding of a step that ends at a stop
            self.refused = (
                f"stroke {wanted:.3f} m: the carriage goes from 0 to {task.stroke_m:g} m; stop before its end"
            )
        way = 1 if rate > 0.0 else -1
        if way != self._stroke_way:  # a stroke is a way up or down without a pause
            self._stroke_way, self.strokes = way, self.strokes + 1

    def _observe(self, action: Action, left_m: float, right_m: float) -> Observation:
        lit = CODES[action.code][self.step % len(CODES[action.code])] == "1"
        on = [light.spot for light in self._lights if light.bits[self.step % len(light.bits)] == "1"]
        lights = [SpotOnSurface(*self.target, self.setup.task.power), *on] if lit else on
        windows: tuple[Window, ...] = ()
        if self._camera is None:
            read = self._sensing.read(lights, self.placement, self.raised_m, action.exposure, self.arena, self._rng)
            self.unseen_cause = read[0].cause if lit else DARK
            spots = tuple(sorted(reading for reading in read if reading.cause == SEEN))
        else:
            windows, spots = self._look(self._camera, lights, action.exposure, lit)
        ground = self.stance
        held = self.flipper_rad, ground.pitch_rad, ground.roll_rad, self.stroke_m
        return Observation(self.step, left_m, right_m, *held, lit, spots, windows)

    def _look(
        self, camera: RobotCamera, lights: Sequence[SpotOnSurface], exposure: int, lit: bool
    ) -> tuple[tuple[Window, ...], tuple[SpotReading, ...]]:
        """Pixels, and the spots that are read in them."""
        room = self.arena.baked
        assert room is not None
        places = self._sensing.unhidden(lights, self.placement, self.raised_m, self.arena)
        shown = [(light, *at) for light, at in zip(lights, places, strict=True) if not isinstance(at, str)]
        stream = (*self.stream, "frame", self.step)
        windows = camera.take(room, shown, self.placement, self.raised_m, exposure, self._rng, *stream)
        spots = () if self._reader is None else self._reader.read(windows, exposure)
        self.unseen_cause = _cause_of(places[0], spots, self._reader is not None) if lit else DARK
        return windows, spots


def _cause_of(place: tuple[float, float] | str, spots: Sequence[SpotReading], read: bool) -> str:
    """Cause that the target is not among the spots."""
    if isinstance(place, str):
        return place
    near = any(math.hypot(spot.u_px - place[0], spot.v_px - place[1]) < _NEAR_PX for spot in spots)
    return SEEN if near or not read else FAINT


_LARGEST = 1e6  # of any number of an action: a whole one may have hundreds of digits


def _check(action: Action) -> None:
    for name, value in zip(Action._fields, action, strict=True):
        if not abs(value) <= _LARGEST:
            shown = printable_line(repr(value), 40)
            raise SceneError(f"action {name} = {shown}: must be finite, at most {_LARGEST:g}; the episode is lost")
    if not 0 <= action.exposure < len(EXPOSURES_S):
        raise SceneError(f"action exposure = {action.exposure}: must be 0 to {len(EXPOSURES_S) - 1}, see EXPOSURES_S")
    if not 0 <= action.code < len(CODES):
        raise SceneError(f"action code = {action.code}: must be 0 to {len(CODES) - 1}, see CODES")
