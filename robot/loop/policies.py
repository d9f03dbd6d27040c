"""Policies of the loop, and what a policy is: the paper's process, drive only, greedy information, random, an oracle.

The paper's process (its Fig. 4) is detection and identification, orientation, depth estimation by a stroke, servoing.
All policies that look for the target share the first part, a belief, and the way to the stand-off distance. They
differ in when they stroke, and how far. `GreedyInformation` asks its belief: of all strokes before and after the drive
it takes the plan that is quickest among those whose expected standard deviation of D is small enough.
"""

from __future__ import annotations

import abc
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from phibench.robot.loop.belief import Belief
from phibench.robot.loop.rig_bias import RigBias
from phibench.robot.loop.sensing import Direction, SpotReading, direction_read
from phibench.robot.loop.simulator import CODES, Action, Known, Observation, Simulator
from phibench.robot.loop.smoothing import belief_of
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator

PAPER_STROKE_M = 0.425
"""Stroke of the paper's table 4."""
CODED, STEADY = 2, 1  # of an action's `code`
_SAME_PX = 4.0  # a spot at rest stays within this
_AGREEMENT = 0.9  # of frames with the code; a light that is always on agrees in 8 of 15
_GATE = 25.0  # chi squared of 2: 4e-6 of the target's own spots lie beyond
_NEAR_PX = 60.0  # spots farther from what is expected are not asked: a target's own never are
_LOST_STEPS = 15  # a second and a half without the target: it is searched again
_HIDDEN_STEPS = 2  # missed in a row: noise hides a spot for one
_STROKE_SPEED = 0.2  # m/s: a frame every 2 cm
_LEVEL_RAD, _LEVEL_M = 1e-3, 0.01  # of the robot's lean and lift: what is below counts as level
_ALIGNED_RAD = 0.03  # of the bearing: the drive turns the rest
_SEARCH_RAD_PER_S, _SEARCH_STEPS = 0.8, 15  # 1.2 rad between two looks
_EXPOSURES = (4, 5, 3, 2)  # in the order in which they are tried
_GOAL_SHARE = 0.3  # of the tolerances, for the standard deviation of D


class Policy(Protocol):
    """Anything that answers an observation with an action."""

    def act(self, observation: Observation) -> Action:
        """Command of the next step."""


@dataclass
class Identifier:
    """Spots over frames of a robot at rest, and the one that blinks as the laser does."""

    lit: list[bool] = field(default_factory=list)
    places: list[tuple[float, float]] = field(default_factory=list)
    seen: list[list[bool]] = field(default_factory=list)
    latest: list[SpotReading] = field(default_factory=list)

    def add(self, observation: Observation) -> None:
        """Take in a frame."""
        for row in self.seen:
            row.append(False)
        for spot in observation.spots:
            k = self._place_of(spot, len(self.lit))
            self.seen[k][-1], self.latest[k] = True, spot
        self.lit.append(observation.lit)

    def _place_of(self, spot: SpotReading, before: int) -> int:
        for k, (u, v) in enumerate(self.places):
            if math.hypot(spot.u_px - u, spot.v_px - v) < _SAME_PX:
                return k
        self.places.append((spot.u_px, spot.v_px))
        self.seen.append([False] * (before + 1))
        self.latest.append(spot)
        return len(self.places) - 1

    def target(self) -> SpotReading | None:
        """Latest reading of the spot that agrees with the code; None before a whole code, or where none does."""
        if len(self.lit) < len(CODES[CODED]) or not self.places:
            return None
        agreement = [np.mean(np.array(row) == np.array(self.lit)) for row in self.seen]
        best = int(np.argmax(agreement))
        return self.latest[best] if agreement[best] >= _AGREEMENT else None


class SearchingPolicy(abc.ABC):
    """Identification, tracking and servoing; what follows the first lock is `plan`, a generator of actions."""

    def __init__(self, known: Known) -> None:
        self.known = known
        self._bias = RigBias(known.rig, known.rig_covariance)
        self.belief: Belief | None = None
        self.observation: Observation
        self.exposure = _EXPOSURES[0]
        self.locked_step = -1
        self.locks = 0
        self._missed, self._seen_stroke_m, self._lift_m = 0, 0.0, 0.0
        self._run = self._process()

    def act(self, observation: Observation) -> Action:
        """Command of the next step."""
        self.observation = observation
        if self.belief is not None:
            self._track(self.belief, observation)
        return next(self._run)

    @abc.abstractmethod
    def plan(self) -> Iterator[Action]:
        """Actions from the first lock to the statement."""

    def _process(self) -> Iterator[Action]:
        while True:
            yield from self._identify()
            for action in self.plan():
                yield action
                if self._missed > _LOST_STEPS and self.target.distance_sigma_m > 0.5 * self.known.task.reach_m:
                    break
            self.belief = None

    # -- detection and identification ------------------------------------------------------------------------------

    def _identify(self) -> Iterator[Action]:
        """Stand with the blinking laser until one spot agrees with its code.

        Where none does, furniture may hide the target: the robot turns, which moves the sensor by centimetres, and the
        carriage goes to its other end. Every other time another exposure is tried.
        """
        for attempt in itertools.count():
            self.exposure = _EXPOSURES[attempt // 2 % len(_EXPOSURES)]
            if attempt:
                yield from itertools.repeat(Action(turn_rad_per_s=_SEARCH_RAD_PER_S), _SEARCH_STEPS)
            if attempt % 2:
                yield from self.stroke(0.0 if self.observation.stroke_m > 0.5 * PAPER_STROKE_M else PAPER_STROKE_M)
            identifier = Identifier()
            for _ in range(2 * len(CODES[CODED])):
                yield Action(exposure=self.exposure, code=CODED)
                identifier.add(self.observation)
                if (spot := identifier.target()) is not None and self._lock(spot):
                    return

    def _lock(self, spot: SpotReading) -> bool:
        first = direction_read(self.known.rig, spot)
        if first is None:
            return False
        rig, vehicle, stroke_m = self.known.rig, self.known.vehicle, self.observation.stroke_m
        self.belief = belief_of(rig, vehicle, first, stroke_m, self._bias)
        self.locked_step, self._missed = self.observation.step, 0
        self.locks, self._seen_stroke_m = self.locks + 1, self.observation.stroke_m
        return True

    def _track(self, belief: Belief, seen: Observation) -> None:
        """Take the step in, and the spot that lies nearest to what is expected; a hidden target is reckoned on."""
        belief.predict(seen.left_m, seen.right_m, self.known.task.step_s)
        if self._climbs(seen):
            return
        held = seen.attitude(self.known.vehicle)
        best: tuple[float, Direction] | None = None
        place = belief.pixel(seen.stroke_m, held)
        for spot in seen.spots:
            if place is not None and math.hypot(spot.u_px - place[0], spot.v_px - place[1]) > _NEAR_PX:
                continue
            direction = direction_read(self.known.rig, spot)
            if direction is not None:
                far = belief.distance2(direction, seen.stroke_m, held)
                if far < _GATE and (best is None or far < best[0]):
                    best = (far, direction)
        self._missed = 0 if best is not None or not seen.lit else self._missed + 1
        if best is not None:
            self._seen_stroke_m = seen.stroke_m
            belief.update(best[1], seen.stroke_m, held)

    def _climbs(self, seen: Observation) -> bool:
        """True on an obstacle: how high the robot stands there is known to a centimetre, which is 50 times the noise.

        Pitch and way give the height roughly, so that a level robot on top of something does not pass for one on the
        floor.
        """
        way_m = 0.5 * (seen.left_m + seen.right_m) * (1.0 - self.known.vehicle.slip)
        self._lift_m += way_m * math.tan(seen.pitch_rad)
        leans = max(abs(seen.pitch_rad), abs(seen.roll_rad)) > _LEVEL_RAD
        if not leans and abs(self._lift_m) < _LEVEL_M:
            self._lift_m = 0.0
        return leans or self._lift_m != 0.0

    # -- moves -----------------------------------------------------------------------------------------------------

    @property
    def target(self) -> Belief:
        """Belief over the target that is locked."""
        assert self.belief is not None
        return self.belief

    def command(self, **numbers: Any) -> Action:
        """Action with the laser on."""
        return Action(**numbers)._replace(exposure=self.exposure, code=STEADY)

    def orient(self) -> Iterator[Action]:
        """Turn towards the target."""
        while abs(self.target.bearing_rad) > _ALIGNED_RAD:
            yield self.command(turn_rad_per_s=2.0 * self.target.bearing_rad)

    def stroke(self, to_m: float) -> Iterator[Action]:
        """Move the carriage, a frame every few centimetres; back to where the target was seen last if it is hidden."""
        step_s, was_seen = self.known.task.step_s, self._missed == 0
        while abs(way := to_m - self.observation.stroke_m) > 1e-6:  # rounding of the carriage's steps
            if self.belief is not None and was_seen and self._missed > _HIDDEN_STEPS:
                to_m = self._seen_stroke_m
                way = to_m - self.observation.stroke_m
            yield self.command(stroke_m_per_s=float(np.clip(way / step_s, -_STROKE_SPEED, _STROKE_SPEED)))

    def approach(self) -> Iterator[Action]:
        """Drive to the stand-off distance and stop."""
        task = self.known.task
        fastest = 0.8 * self.known.vehicle.top_speed_m_per_s
        while abs(off := self.target.distance_m - task.stand_off_m) > 0.2 * task.reach_m:
            bearing = self.target.bearing_rad
            drive = float(np.clip(1.5 * off, -fastest, fastest)) * max(math.cos(bearing), 0.0)
            yield self.command(drive_m_per_s=drive, turn_rad_per_s=1.0 * bearing if off > 0.1 else 0.0)

    def state(self) -> Iterator[Action]:
        """State D, once the last frame is in."""
        yield self.command(stated_m=self.target.distance_m)

    def is_sure(self) -> bool:
        """True where the standard deviation of D is a small part of what is tolerated."""
        return self.target.distance_sigma_m <= goal_sigma_m(self.known)


def goal_sigma_m(known: Known) -> float:
    """Standard deviation of D that is aimed at, at the stand-off distance."""
    task = known.task
    return _GOAL_SHARE * min(task.depth_share * task.stand_off_m, task.reach_m)


class PaperProcess(SearchingPolicy):
    """Identify, orient, stroke, estimate, servo: always one stroke before the drive, and another only if unsure."""

    def plan(self) -> Iterator[Action]:
        """Actions from the first lock to the statement."""
        if self.locks > 1:  # the target hides when the robot faces it: measure first
            yield from self.stroke(PAPER_STROKE_M if self.observation.stroke_m < 0.5 * PAPER_STROKE_M else 0.0)
        yield from self.orient()
        yield from self.stroke(PAPER_STROKE_M)
        while True:
            yield from self.approach()
            if self.is_sure():
                break
            yield from self.stroke(0.0 if self.observation.stroke_m > 0.5 * PAPER_STROKE_M else PAPER_STROKE_M)
        yield from self.state()


class DriveOnly(SearchingPolicy):
    """No stroke at all: depth from the drive alone (motion stereo), stated at the stand-off distance."""

    def plan(self) -> Iterator[Action]:
        """Actions from the first lock to the statement."""
        yield from self.orient()
        yield from self.approach()
        yield from self.state()


@dataclass(frozen=True)
class ApproachPlan:
    """Stroke before the drive, stroke after it, metres; and what is expected: time and standard deviation of D."""

    before_m: float
    after_m: float
    time_s: float = math.nan
    sigma_m: float = math.nan


class GreedyInformation(SearchingPolicy):
    """Quickest plan of strokes and drive whose expected standard deviation of D is small enough."""

    strokes_m = (0.0, 0.1, 0.2, 0.4, 0.8)

    def plan(self) -> Iterator[Action]:
        """Actions from the first lock to the statement."""
        yield from self.orient()
        chosen = self.best()
        yield from self.stroke(chosen.before_m)
        while True:
            yield from self.approach()
            if self.is_sure():
                break
            after = self.best(arrived=True).after_m
            here = self.observation.stroke_m
            yield from self.stroke(here + after if here + after <= self.known.task.stroke_m else here - after)
        yield from self.state()

    def best(self, arrived: bool = False) -> ApproachPlan:
        """Quickest plan that is sure enough; the surest one where none is."""
        if arrived:
            plans = [self.expected(ApproachPlan(0.0, h)) for h in self.strokes_m[1:]]
        else:
            plans = [self.expected(ApproachPlan(a, b)) for a in self.strokes_m for b in (0.0, 0.1, 0.2)]
        enough = [plan for plan in plans if plan.sigma_m <= goal_sigma_m(self.known)]
        if enough:
            return min(enough, key=lambda plan: plan.time_s)
        return min(plans, key=lambda plan: plan.sigma_m)

    def expected(self, plan: ApproachPlan) -> ApproachPlan:
        """The plan with its expected time and standard deviation: the belief's own filter, fed with its own mean."""
        belief, task = self.target.copied(), self.known.task
        noise = self._frame_noise()
        here = self.observation.stroke_m
        here = self._imagine_stroke(belief, here, plan.before_m, noise)
        way = belief.distance_m - task.stand_off_m
        fastest = 0.8 * self.known.vehicle.top_speed_m_per_s
        steps = 4
        if abs(way) > 0.2 * task.reach_m:
            each = way / steps / (1.0 - self.known.vehicle.slip)
            frames = max(abs(way) / fastest / task.step_s / steps, 1.0)  # of a quarter of the way, whose noise averages
            for _ in range(steps):
                belief.predict(each, each, task.step_s)
                belief.imagine(here, noise / frames)
        self._imagine_stroke(belief, here, plan.after_m, noise)
        time_s = (plan.before_m + plan.after_m) / _STROKE_SPEED + abs(way) / fastest
        return ApproachPlan(plan.before_m, plan.after_m, time_s, belief.distance_sigma_m)

    def _imagine_stroke(self, belief: Belief, from_m: float, way_m: float, noise: Array) -> float:
        if way_m == 0.0:
            return from_m
        to_m = from_m + way_m if from_m + way_m <= self.known.task.stroke_m else from_m - way_m
        frames = max(way_m / _STROKE_SPEED / self.known.task.step_s / 3.0, 1.0)  # of a third of the stroke
        for share in (1 / 3, 2 / 3, 1.0):
            belief.predict(0.0, 0.0, 0.0)
            belief.imagine(from_m + share * (to_m - from_m), noise / frames)
        return to_m

    def _frame_noise(self) -> Array:
        """Covariance of a direction in one frame, that of the latest spot near the target; shape (2, 2)."""
        for spot in self.observation.spots:
            seen = direction_read(self.known.rig, spot)
            if seen is not None and self.target.distance2(seen, self.observation.stroke_m) < _GATE:
                return seen.covariance
        return 1e-6 * np.eye(2)  # of a spot that is not seen: a milliradian


class RandomPolicy:
    """Actions drawn at random, a statement once in a hundred steps: what chance reaches.

    Parameters
    ----------
    rng : Generator
    """

    def __init__(self, known: Known, rng: np.random.Generator) -> None:
        self.known, self._rng = known, rng

    def act(self, observation: Observation) -> Action:
        """Command of the next step."""
        rng, task = self._rng, self.known.task
        drive, turn = rng.uniform(-0.5, 0.5), rng.uniform(-0.8, 0.8)
        stated = float(rng.uniform(0.5, task.distances_m[1])) if rng.uniform() < 0.01 else 0.0
        if rng.uniform() < 0.3:
            return Action(stroke_m_per_s=float(rng.uniform(-0.4, 0.4)), stated_m=stated)
        return Action(float(drive), float(turn), stated_m=stated)


class Oracle:
    """Knows the truth: no time goes into finding out, so that no policy can be much quicker."""

    def __init__(self, known: Known, simulator: Simulator) -> None:
        self.known, self.simulator = known, simulator

    def act(self, observation: Observation) -> Action:
        """Command of the next step."""
        x, y, _ = self.simulator.target_in_rig_m()
        bearing, off = math.atan2(y, x), math.hypot(x, y) - self.known.task.stand_off_m
        if abs(bearing) > _ALIGNED_RAD and off > 0.1:
            return Action(turn_rad_per_s=2.0 * bearing)
        if abs(off) > 0.2 * self.known.task.reach_m:
            fastest = 0.8 * self.known.vehicle.top_speed_m_per_s
            return Action(float(np.clip(1.5 * off, -fastest, fastest)))
        return Action(stated_m=math.hypot(x, y))


POLICIES: dict[str, Callable[[Known, Simulator], Policy]] = {
    "paper": lambda known, _: PaperProcess(known),
    "greedy": lambda known, _: GreedyInformation(known),
    "drive-only": lambda known, _: DriveOnly(known),
    "random": lambda known, simulator: RandomPolicy(known, generator(*simulator.stream, "random policy")),
    "oracle": Oracle,
}
"""Policies by name; only the oracle uses the simulator's truth."""
BELIEVING = ("paper", "greedy", "drive-only")
"""Policies that keep a belief, for which they need `filterpy`."""
