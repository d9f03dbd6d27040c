"""Environment `phibench/ApproachTargetBelief-v0` for `gymnasium`: its observation is the belief over the target.

The flat environment asks a learner for a stereo method as well: to measure D to 2 % from pixels of two strokes. Here
the robot identifies its target and keeps a belief of it, as the policy `paper` does. What is left is to plan: when to
turn, how far to stroke, when to drive, when to state it. Settings, reward and ends are those of `ApproachTarget`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from phibench.robot.loop.environment import COST_REFUSED, ApproachTarget, numbers_of_action
from phibench.robot.loop.episodes import SETTINGS
from phibench.robot.loop.policies import SearchingPolicy
from phibench.robot.loop.simulator import LATE, RUNNING, Action, Known, Setup

FEATURES = ("sin bearing", "cos bearing", "way left", "way left, enlarged", "sigma", "stroke", "missed", "time")
ACTIONS = ("drive", "turn", "stroke", "state")
_STANDS = 0.5  # |stroke| above it: the robot stands and the carriage moves
_FAR_M, _NEAR_M = 4.0, 0.1  # of the way left that fills the range, and of the enlarged one


class Commanded(SearchingPolicy):
    """Identification and belief of `paper`; after the lock the action is what `commands` holds."""

    def __init__(self, known: Known) -> None:
        super().__init__(known)
        self.commands = Action()

    def plan(self) -> Iterator[Action]:
        """Whatever is commanded."""
        while True:
            yield self.commands

    @property
    def missed(self) -> int:
        """Frames in a row without the target."""
        return self._missed


class ApproachTargetBelief(gymnasium.Env[NDArray[Any], NDArray[Any]]):
    """`ApproachTarget` with the belief for an observation, float32 of -1 to 1 as `FEATURES`, and `ACTIONS` of -1 to 1.

    `drive` and `turn` are shares of the largest speeds. Where |stroke| exceeds 1/2 the robot stands and the carriage
    moves. `state` above 0 states the believed D; it is refused, at the price of a refused command, where the belief is
    farther from the stand-off distance than twice what is tolerated. Steps of identification are performed in between.

    Parameters
    ----------
    setup, **options : as for `ApproachTarget`
    """

    metadata = ApproachTarget.metadata

    def __init__(self, setup: Setup | str = "default", **options: Any) -> None:
        self.inner = ApproachTarget(setup, **options)
        self.render_mode = self.inner.render_mode
        self.action_space = spaces.Box(-1.0, 1.0, (len(ACTIONS),), np.float32)
        self.observation_space = spaces.Box(-1.0, 1.0, (len(FEATURES),), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode: that of `ApproachTarget` with the same seed, up to the first lock."""
        super().reset(seed=seed)
        self.inner.reset(seed=seed, options=options)
        self._robot = Commanded(self.inner.setup.known)
        self._following = self._robot.act(self.inner.observation)
        self._identify()
        return self._features(), self.inner.info()

    def step(self, action: NDArray[Any]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Perform one step, and those of a new identification where the target was lost.

        Raises
        ------
        SceneError
            If the action has another length or a number outside, or the episode is over.
        """
        numbers = numbers_of_action(action, ACTIONS)
        command, refused = self._command(*numbers.tolist())
        reward, over, late = self._perform(command)
        more = self._identify()
        outcome = self.inner.simulator.outcome
        over, late = (outcome not in (RUNNING, LATE), outcome == LATE) if more else (over, late)
        return self._features(), reward + more - refused, over, late, self.inner.info()

    def render(self) -> NDArray[np.uint8] | None:
        """Picture of `ApproachTarget`."""
        return self.inner.render()

    def _command(self, drive: float, turn: float, stroke: float, state: float) -> tuple[Action, float]:
        """Action, and the price of a statement that is refused."""
        setup, belief = self.inner.setup, self._robot.belief
        task = setup.task
        refused = state > 0.0 and (belief is None or abs(belief.distance_m - task.stand_off_m) > 2.0 * task.reach_m)
        numbers: dict[str, float] = {}
        if state > 0.0 and not refused:
            assert belief is not None
            numbers = {"stated_m": belief.distance_m}
        elif abs(stroke) > _STANDS:
            numbers = {"stroke_m_per_s": stroke * task.stroke_speed_m_per_s}
        else:
            top = setup.vehicle.top_speed_m_per_s
            numbers = {"drive_m_per_s": drive * top, "turn_rad_per_s": turn * task.turn_rad_per_s}
        return self._robot.command(**numbers), COST_REFUSED if refused else 0.0

    def _perform(self, action: Action) -> tuple[float, bool, bool]:
        """Perform an action and take what is seen into the belief."""
        reward, over, late = self.inner.perform(action)
        self._following = self._robot.act(self.inner.observation)
        return reward, over, late

    def _identify(self) -> float:
        """Perform the robot's own steps until it has a belief, or the episode ends; their reward."""
        reward = 0.0
        while self._robot.belief is None and self.inner.simulator.outcome == RUNNING:
            reward += self._perform(self._following)[0]
        return reward

    def _features(self) -> NDArray[np.float32]:
        task, belief, seen = self.inner.setup.task, self._robot.belief, self.inner.observation
        held = 2.0 * np.array([seen.stroke_m / task.stroke_m, seen.step / task.steps]) - 1.0
        if belief is None:  # the episode ended while the target was searched
            return np.array([0.0, 0.0, 1.0, 1.0, 1.0, held[0], 1.0, held[1]], np.float32)
        left = belief.distance_m - task.stand_off_m
        known = math.log10(max(belief.distance_sigma_m / belief.distance_m, 1e-9)) + 2.0  # 0 is 1 %
        bearing = belief.bearing_rad
        values = [math.sin(bearing), math.cos(bearing), left / _FAR_M, math.tanh(left / _NEAR_M), 0.5 * known, held[0]]
        values += [1.0 if self._robot.missed else -1.0, held[1]]
        return np.clip(values, -1.0, 1.0).astype(np.float32)


def register() -> None:
    """Make the environment in every setting known to `gymnasium`; again does nothing."""
    for setting in SETTINGS:
        name = "phibench/ApproachTargetBelief" + ("" if setting == "default" else f"-{setting}") + "-v0"
        if name not in gymnasium.registry:
            gymnasium.register(name, entry_point=f"{__name__}:ApproachTargetBelief", kwargs={"setup": setting})


register()
