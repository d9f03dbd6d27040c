"""Environment `phibench/ApproachTarget-v0` for `gymnasium`: `Simulator` with spaces, reward and seeds.

    from phibench.robot.loop.environment import register
    register()
    env = gymnasium.make("phibench/ApproachTarget-v0")

Reward: -0.01 a second, -0.01 for a command that is refused, +1 when the distance is stated right at the stand-off
distance, -1 when it is stated wrongly or the robot runs into something. `terminated` says the last three, `truncated`
that the time is over. `info` holds the outcome, what was refused, and the truth, which no policy may use.

The exact model observes spots with their noise; the other fidelities of `Setup` observe pixels of baked rooms.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

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
from phibench.scenes.validation import SceneError

try:
    import gymnasium
    from gymnasium import spaces
except ImportError as error:  # this module alone needs it
    raise SceneError("the environment needs gymnasium: pip install 'phibench[loop]'") from error

ENVIRONMENT = "phibench/ApproachTarget-v0"
SPOT_COLUMNS = ("u_px", "v_px", "sigma_px", "electrons")
"""Of the rows of `spots`; rows without a spot are 0."""
_COST_PER_S, _COST_REFUSED = 0.01, 0.01  # an episode of 90 s costs 0.9: less than what success gives
_FARTHEST_M = 20.0  # that may be stated: beyond every room


def register() -> None:
    """Make `ENVIRONMENT` known to `gymnasium`; again does nothing."""
    if ENVIRONMENT not in gymnasium.registry:
        gymnasium.register(ENVIRONMENT, entry_point=f"{__name__}:ApproachTarget")


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
            If a number of the action is not finite, or the episode is over.
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
    """Action of a dict of the action space; keys that are missing keep their defaults."""
    numbers: dict[str, Any] = {
        name: float(np.asarray(values[name]).reshape(-1)[0])
        for name in Action._fields
        if name in values and name not in ("exposure", "code")
    }
    chosen = {name: int(np.asarray(values[name]).reshape(-1)[0]) for name in ("exposure", "code") if name in values}
    return Action(**numbers, **chosen)


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
