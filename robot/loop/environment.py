"""Environments `phibench/ApproachTarget-v0` and `-Flat-v0` for `gymnasium`: `Simulator` with spaces, reward, seeds.

    import phibench.robot.loop.environment  # its import makes them known
    env = gymnasium.make("phibench/ApproachTarget-v0")

`gymnasium.make("phibench.robot.loop.environment:phibench/ApproachTarget-v0")` does both. The flat one has a vector of
-1 to 1 for actions and one of float32 for observations, as most learners ask for.

Reward: -0.01 a second, -0.01 for a command that is refused, +1 when the distance is stated right at the stand-off
distance, -1 when it is stated wrongly or the robot runs into something. `terminated` says the last three, `truncated`
that the time is over. `info` holds the outcome, what was refused, and the truth, which no policy may use.

The exact model observes spots with their noise; the other fidelities of `Setup` observe pixels of baked rooms.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from phibench.robot.loop.robot_pixels import WINDOW_PX, pixel_form
from phibench.robot.loop.sensing import EXPOSURES_S
from phibench.robot.loop.simulator import (
    CODES,
    COLLISION,
    LATE,
    LIGHT_ROWS,
    REACHED,
    RUNNING,
    WRONG,
    Action,
    Observation,
    Setup,
    Simulator,
)
from phibench.scenes.random_streams import Name
from phibench.scenes.validation import SceneError, nearest

try:
    import gymnasium
    from gymnasium import spaces
except ImportError as error:  # this module alone needs it
    raise SceneError("the environment needs gymnasium: pip install 'phibench[loop]'") from error

ENVIRONMENT, FLAT = "phibench/ApproachTarget-v0", "phibench/ApproachTargetFlat-v0"
SPOT_COLUMNS = ("u_px", "v_px", "sigma_px", "electrons")
"""Of the rows of `spots`; rows without a spot are 0."""
_COST_PER_S, _COST_REFUSED = 0.01, 0.01  # an episode of 90 s costs 0.9: less than what success gives
_FARTHEST_M = 20.0  # that may be stated: beyond every room


def register() -> None:
    """Make `ENVIRONMENT` and `FLAT` known to `gymnasium`; again does nothing."""
    for name, place in ((ENVIRONMENT, "ApproachTarget"), (FLAT, "ApproachTargetFlat")):
        if name not in gymnasium.registry:
            gymnasium.register(name, entry_point=f"{__name__}:{place}")


class ApproachTarget(gymnasium.Env[dict[str, Any], dict[str, Any]]):
    """Robot that has to find a laser spot, drive up to it and say how far away it is.

    Parameters
    ----------
    setup : Setup, optional
        Vehicle, rig, sensor, rooms and task.
    **task : Any
        Numbers of `Task`, in place of the setup's.

    Attributes
    ----------
    simulator : Simulator
        Holds the truth; for scoring, not for policies.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - gymnasium reads it from the class

    def __init__(self, setup: Setup | None = None, **task: Any) -> None:
        given = setup or Setup()
        self.setup = replace(given, task=replace(given.task, **task)) if task else given
        self.simulator = Simulator(self.setup, reads=False)
        self.action_space = _action_space(self.setup)
        self.observation_space = _observation_space(self.setup)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode; the same seed gives the same episode, to the bit. `options["stream"]` names it instead."""
        super().reset(seed=seed)
        stream: tuple[Name, ...] = tuple((options or {}).get("stream", ()))
        observation = self.simulator.start(*(stream or ("episode", int(self.np_random.integers(2**62)))))
        return as_arrays(observation, self.setup), self._info()

    def step(self, action: dict[str, Any]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Perform one step.

        Raises
        ------
        SceneError
            If a key or a number of the action is none, or the episode is over.
        """
        observation = self.simulator.act(action_of(action))
        outcome = self.simulator.outcome
        reward = -_COST_PER_S * self.setup.task.step_s - (_COST_REFUSED if self.simulator.refused else 0.0)
        reward += {REACHED: 1.0, WRONG: -1.0, COLLISION: -1.0}.get(outcome, 0.0)
        over = outcome not in (RUNNING, LATE)
        return as_arrays(observation, self.setup), reward, over, outcome == LATE, self._info()

    def _info(self) -> dict[str, Any]:
        s = self.simulator
        return {"outcome": s.outcome, "refused": s.refused, "distance_m": s.distance_m, "unseen": s.unseen_cause}


def action_of(values: dict[str, Any]) -> Action:
    """Action of a dict of the action space; keys that are missing keep their defaults.

    `stated_m` counts where `state` is 1: a policy that draws its actions ends no episode by a number alone.

    Raises
    ------
    SceneError
        For a key that the action space does not have, with the nearest one.
    """
    known = (*Action._fields, "state")
    if strange := [name for name in values if name not in known]:
        raise SceneError(f"action '{strange[0]}': {nearest(strange[0], known)}")
    chosen = {name: int(np.asarray(values[name]).reshape(-1)[0]) for name in (*_CHOICES, "state") if name in values}
    states = chosen.pop("state", 0)
    if states not in (0, 1):
        raise SceneError(f"action state = {states}: give 1 to state the distance, else 0")
    numbers: dict[str, Any] = {
        name: float(np.asarray(values[name]).reshape(-1)[0])
        for name in Action._fields
        if name in values and name not in _CHOICES and (states or name != "stated_m")
    }
    if states and not numbers.get("stated_m", 0.0) > 0.0:
        raise SceneError("action state = 1: give the distance, stated_m, in metres and above 0")
    return Action(**numbers, **chosen)


_CHOICES = ("exposure", "code")


def as_arrays(observation: Observation, setup: Setup | None = None) -> dict[str, Any]:
    """Observation as a dict of the observation space; of the exact model by default."""
    given = setup or Setup()
    return {
        "step": np.array([observation.step], np.float64),
        "tracks_m": np.array([observation.left_m, observation.right_m]),
        "attitude_rad": np.array([observation.flipper_rad, observation.pitch_rad, observation.roll_rad]),
        "stroke_m": np.array([observation.stroke_m]),
        "lit": int(observation.lit),
        **{"exact": _spots, "windows": _windows, "frames": _frame}[given.fidelity](observation, given),
    }


def _spots(observation: Observation, setup: Setup) -> dict[str, Any]:
    spots = np.zeros((LIGHT_ROWS, len(SPOT_COLUMNS)))
    for row, spot in zip(spots, observation.spots, strict=False):
        row[:] = spot[:4]
    return {"spots": spots, "seen": _first(len(observation.spots))}


def _windows(observation: Observation, setup: Setup) -> dict[str, Any]:
    channels, kind, _ = pixel_form(setup.preset)
    pixels = np.zeros((LIGHT_ROWS, WINDOW_PX, WINDOW_PX, *channels), kind)
    corners = np.zeros((LIGHT_ROWS, 2), np.int64)
    for k, window in enumerate(observation.windows):
        pixels[k], corners[k] = window.pixels, (window.u0_px, window.v0_px)
    return {"windows": pixels, "corners_px": corners, "seen": _first(len(observation.windows))}


def _frame(observation: Observation, setup: Setup) -> dict[str, Any]:
    return {"frame": observation.windows[0].pixels}


def _first(count: int) -> NDArray[np.int8]:
    return np.array([k < count for k in range(LIGHT_ROWS)], np.int8)


def _box(low: float, high: float, shape: tuple[int, ...] = (1,)) -> spaces.Box:
    return spaces.Box(low, high, shape, np.float64)


def _action_space(setup: Setup) -> spaces.Dict:
    vehicle, task = setup.vehicle, setup.task
    return spaces.Dict(
        {
            "drive_m_per_s": _box(-vehicle.top_speed_m_per_s, vehicle.top_speed_m_per_s),
            "turn_rad_per_s": _box(-task.turn_rad_per_s, task.turn_rad_per_s),
            "flipper_rad_per_s": _box(-vehicle.flipper_speed_rad_per_s, vehicle.flipper_speed_rad_per_s),
            "stroke_m_per_s": _box(-task.stroke_speed_m_per_s, task.stroke_speed_m_per_s),
            "exposure": spaces.Discrete(len(EXPOSURES_S)),
            "code": spaces.Discrete(len(CODES)),
            "state": spaces.Discrete(2),
            "stated_m": _box(0.0, _FARTHEST_M),
        }
    )


def _observation_space(setup: Setup) -> spaces.Dict:
    task = setup.task
    way = setup.vehicle.top_speed_m_per_s * task.step_s
    bounds: dict[str, spaces.Space[Any]] = {
        "step": _box(0.0, float(task.steps)),
        "tracks_m": _box(-way, way, (2,)),
        "attitude_rad": _box(-np.pi, np.pi, (3,)),
        "stroke_m": _box(0.0, task.stroke_m),
        "lit": spaces.Discrete(2),
    }
    return spaces.Dict(bounds | (_spot_space(setup) if setup.fidelity == "exact" else _pixel_space(setup)))


def _spot_space(setup: Setup) -> dict[str, spaces.Space[Any]]:
    camera = setup.rig.camera
    # noise may put a spot a few pixels outside of the image; none of 9 standard deviations of at most 1 px
    low, high = np.zeros((LIGHT_ROWS, 4)), np.zeros((LIGHT_ROWS, 4))
    low[:, :2], high[:] = -9.5, (camera.width_px + 9.5, camera.height_px + 9.5, 1.0, 1e9)
    return {"spots": spaces.Box(low, high, dtype=np.float64), "seen": spaces.MultiBinary(LIGHT_ROWS)}


def _pixel_space(setup: Setup) -> dict[str, spaces.Space[Any]]:
    camera, (channels, kind, top) = setup.rig.camera, pixel_form(setup.preset)
    if setup.fidelity == "frames":
        return {"frame": spaces.Box(0, top, (camera.height_px, camera.width_px, *channels), kind)}
    return {
        "windows": spaces.Box(0, top, (LIGHT_ROWS, WINDOW_PX, WINDOW_PX, *channels), kind),
        "corners_px": spaces.Box(0, max(camera.width_px, camera.height_px), (LIGHT_ROWS, 2), np.int64),
        "seen": spaces.MultiBinary(LIGHT_ROWS),
    }


def flat_observation(observation: dict[str, Any]) -> NDArray[np.float64]:
    """Observation as one vector, for learners that want one."""
    return np.concatenate([np.atleast_1d(np.asarray(value, float)).ravel() for value in observation.values()])


# -- for learners that want vectors ------------------------------------------------------------------------------------

_ELECTRONS = 3  # column of `spots` whose range is of powers of ten


class ApproachTargetFlat(gymnasium.Env[NDArray[Any], NDArray[Any]]):
    """`ApproachTarget` with actions and observations of -1 to 1, float32, in the order of the spaces' keys.

    A choice of n takes its n-th of the range; `state` is 1 above 0.

    Parameters
    ----------
    setup : Setup, optional
        Of the exact model.
    **task : Any
        Numbers of `Task`, in place of the setup's.

    Attributes
    ----------
    inner : ApproachTarget
        The environment behind it, with dicts; for scoring.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - gymnasium reads it from the class

    def __init__(self, setup: Setup | None = None, **task: Any) -> None:
        self.inner = ApproachTarget(setup, **task)
        if self.inner.setup.fidelity != "exact":
            raise SceneError("the flat environment is that of the exact model: pixels make no vector of float32")
        size = len(scaled(self.inner.reset(seed=0)[0], self._bounds))
        self.action_space = spaces.Box(-1.0, 1.0, (len(self._actions),), np.float32)
        self.observation_space = spaces.Box(-1.0, 1.0, (size,), np.float32)

    @property
    def _bounds(self) -> spaces.Dict:
        return cast(spaces.Dict, self.inner.observation_space)

    @property
    def _actions(self) -> spaces.Dict:
        return cast(spaces.Dict, self.inner.action_space)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode: that of `ApproachTarget` with the same seed."""
        super().reset(seed=seed)
        observation, info = self.inner.reset(seed=seed, options=options)
        return scaled(observation, self._bounds), info

    def step(self, action: NDArray[Any]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Perform one step.

        Raises
        ------
        SceneError
            If the action has another length or a number outside, or the episode is over.
        """
        observation, reward, over, late, info = self.inner.step(unscaled(action, self._actions))
        return scaled(observation, self._bounds), reward, over, late, info


def unscaled(vector: NDArray[Any], space: spaces.Dict) -> dict[str, Any]:
    """Action of a vector of -1 to 1.

    Raises
    ------
    SceneError
        If it has another length, or a number outside.
    """
    numbers = np.asarray(vector, float).reshape(-1)
    if len(numbers) != len(space) or not np.all(np.abs(numbers) <= 1.0):
        raise SceneError(f"action of {len(numbers)} numbers: give {len(space)} from -1 to 1, {', '.join(space)}")
    values: dict[str, Any] = {}
    for (name, own), number in zip(space.items(), numbers, strict=True):
        if isinstance(own, spaces.Discrete):
            values[name] = min(int(0.5 * (number + 1.0) * int(own.n)), int(own.n) - 1)
        else:
            box = cast(spaces.Box, own)
            low, high = float(box.low[0]), float(box.high[0])
            values[name] = np.array([low + 0.5 * (number + 1.0) * (high - low)])
    values["stated_m"] = np.maximum(values["stated_m"], 1e-6)  # 0 m is no distance
    return values


def scaled(observation: dict[str, Any], space: spaces.Dict) -> NDArray[np.float32]:
    """Vector of -1 to 1 of an observation of the exact model; electrons by their logarithm."""
    parts = []
    for name, own in space.items():
        values = np.asarray(observation[name], float)
        if isinstance(own, spaces.Box):
            low, high = own.low.astype(float), own.high.astype(float)
            if name == "spots":
                values, high = values.copy(), high.copy()
                values[:, _ELECTRONS], high[:, _ELECTRONS] = (np.log1p(x[:, _ELECTRONS]) for x in (values, high))
            values = (values - low) / np.maximum(high - low, 1e-12) * 2.0 - 1.0
        parts.append(values.ravel())
    return np.clip(np.concatenate(parts), -1.0, 1.0).astype(np.float32)


register()
