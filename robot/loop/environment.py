"""Environments `phibench/ApproachTarget-v0` and `-Flat-v0` for `gymnasium`: spaces, reward, seeds, a view from above.

    import phibench.robot.loop.environment  # its import makes them known
    env = gymnasium.make("phibench/ApproachTarget-v0")

`gymnasium.make("phibench.robot.loop.environment:phibench/ApproachTarget-v0")` does both. The flat one has a vector of
-1 to 1 for actions and one of float32 for observations, as most learners ask for.

Settings `-easy-v0` and `-hard-v0` of both stand beside them (`robot.loop.episodes`).

Reward: -0.01 a second, -0.01 for a command that is refused, +1 when the distance is stated right at the stand-off
distance, -1 when it is stated wrongly or the robot runs into something. `terminated` says the last three, `truncated`
that the time is over. `info` holds the outcome, what was refused, and the truth, which no policy may use.
`shaped=True` adds what a step brings the true state nearer to its end, for training only; `info["shaped"]` says so.

The exact model observes spots with their noise; the other fidelities of `Setup` observe pixels of baked rooms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from phibench.robot.loop.episodes import SETTINGS, named_setup
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
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import Name
from phibench.scenes.room import ROBOT_SIZE_M
from phibench.scenes.validation import SceneError, nearest

# Picture of an episode from above: room, robot, its heading, the way so far, the target and its stand-off circle.


SIDE_PX = 400
_HALF_M = 5.0  # from the start to each side: targets are drawn within 4.5 m
_CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
_THIN_M = 0.02  # half of what walls, thin as they are, are drawn with


def room_view(simulator: Simulator, way_m: Sequence[tuple[float, float]] = ()) -> NDArray[np.uint8]:
    """Room from above, shape (SIDE_PX, SIDE_PX, 3): x to the right, y up, the start in the middle.

    Parameters
    ----------
    simulator : Simulator
        Of an episode that has begun.
    way_m : sequence of (x, y)
        Places of the robot so far, world.
    """
    picture = Image.new("RGB", (SIDE_PX, SIDE_PX), "white")
    draw = ImageDraw.Draw(picture)
    boxes = simulator.arena.floor
    for centre, axes, half in zip(boxes.centre_m, boxes.axes, boxes.half_m, strict=True):
        _polygon(draw, centre[:2] + (_CORNERS * np.maximum(half[:2], _THIN_M)) @ axes[:2, :2].T, "#bbbbbb")
    target = simulator.target.point_m[:2]
    low, high = _pixels(
        np.stack([target - simulator.setup.task.stand_off_m, target + simulator.setup.task.stand_off_m])
    )
    draw.ellipse((low[0], high[1], high[0], low[1]), outline="#cc3311")
    u, v = _pixels(target[None])[0]
    draw.ellipse((u - 4, v - 4, u + 4, v + 4), fill="#cc3311")
    if len(way_m) > 1:
        draw.line([tuple(place) for place in _pixels(np.array(way_m)).tolist()], fill="#0072b2", width=2)
    pose = simulator.pose
    c, s = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    place, ahead = np.array([pose.x_m, pose.y_m]), np.array([c, s])
    _polygon(draw, place + 0.5 * _CORNERS * ROBOT_SIZE_M[:2] @ np.array([[c, s], [-s, c]]), "#999944")
    ends = _pixels(np.stack([place, place + 0.5 * ROBOT_SIZE_M[0] * ahead]))
    draw.line([tuple(end) for end in ends.tolist()], fill="black", width=2)
    return np.asarray(picture)


def _pixels(points_m: Array) -> Array:
    """Pixels (u, v) of places on the floor, shape (n, 2)."""
    scale = 0.5 * SIDE_PX / _HALF_M
    return np.stack([0.5 * SIDE_PX + scale * points_m[:, 0], 0.5 * SIDE_PX - scale * points_m[:, 1]], axis=-1)


def _polygon(draw: ImageDraw.ImageDraw, corners_m: Array, colour: str) -> None:
    draw.polygon([tuple(corner) for corner in _pixels(corners_m).tolist()], fill=colour)


try:
    import gymnasium
    from gymnasium import spaces
except ImportError as error:  # this module alone needs it
    raise SceneError("the environment needs gymnasium: pip install 'phibench[loop]'") from error

ENVIRONMENT, FLAT = "phibench/ApproachTarget-v0", "phibench/ApproachTargetFlat-v0"
SPOT_COLUMNS = ("u_px", "v_px", "sigma_px", "electrons")
"""Of the rows of `spots`; rows without a spot are 0."""
COST_PER_S, COST_REFUSED = 0.01, 0.01  # an episode of 90 s costs 0.9: less than what success gives
_FARTHEST_M = 20.0  # that may be stated: beyond every room


def register() -> None:
    """Make both environments in every setting known to `gymnasium`; again does nothing."""
    for place in ("ApproachTarget", "ApproachTargetFlat"):
        for setting in SETTINGS:
            name = f"phibench/{place}-v0" if setting == "default" else f"phibench/{place}-{setting}-v0"
            if name not in gymnasium.registry:
                gymnasium.register(name, entry_point=f"{__name__}:{place}", kwargs={"setup": setting})


class ApproachTarget(gymnasium.Env[dict[str, Any], dict[str, Any]]):
    """Robot that has to find a laser spot, drive up to it and say how far away it is.

    Parameters
    ----------
    setup : Setup, or "easy", "default" or "hard"
        Vehicle, rig, sensor, rooms and task.
    render_mode : "rgb_array" or None
        `render` then gives the room from above (`room_view`).
    shaped : bool
        Reward with shaping, for training only.
    **task : Any
        Numbers of `Task`, in place of the setup's.

    Attributes
    ----------
    simulator : Simulator
        Holds the truth; for scoring, not for policies.
    observation : Observation
        The latest one.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - gymnasium reads it

    def __init__(
        self, setup: Setup | str = "default", *, render_mode: str | None = None, shaped: bool = False, **task: Any
    ) -> None:
        given = named_setup(setup) if isinstance(setup, str) else setup
        if render_mode not in (None, "rgb_array"):
            raise SceneError(f"render_mode '{render_mode}': this environment has 'rgb_array'; give it, or None")
        self.render_mode, self.shaped = render_mode, shaped
        self._way_m: list[tuple[float, float]] = []
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
        self.observation = self.simulator.start(*(stream or ("episode", int(self.np_random.integers(2**62)))))
        self._way_m = [(self.simulator.pose.x_m, self.simulator.pose.y_m)]
        return as_arrays(self.observation, self.setup), self.info()

    def step(self, action: dict[str, Any]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Perform one step.

        Raises
        ------
        SceneError
            If a key or a number of the action is none, or the episode is over.
        """
        reward, over, late = self.perform(action_of(action))
        return as_arrays(self.observation, self.setup), reward, over, late, self.info()

    def perform(self, action: Action) -> tuple[float, bool, bool]:
        """Perform one step: reward, over, late; `observation` then holds what is seen."""
        before = self._potential() if self.shaped else 0.0
        self.observation = self.simulator.act(action)
        self._way_m.append((self.simulator.pose.x_m, self.simulator.pose.y_m))
        outcome = self.simulator.outcome
        reward = -COST_PER_S * self.setup.task.step_s - (COST_REFUSED if self.simulator.refused else 0.0)
        reward += {REACHED: 1.0, WRONG: -1.0, COLLISION: -1.0}.get(outcome, 0.0)
        reward += self._potential() - before if self.shaped else 0.0
        return reward, outcome not in (RUNNING, LATE), outcome == LATE

    def render(self) -> NDArray[np.uint8] | None:
        """Room from above, shape (400, 400, 3), where `render_mode` is "rgb_array", else None."""
        return room_view(self.simulator, self._way_m) if self.render_mode == "rgb_array" else None

    def _potential(self) -> float:
        """Minus what is left: metres to the stand-off distance, and the share of half a turn to the target.

        Its differences leave the best policy as it is (A. Y. Ng, D. Harada and S. Russell, ICML 1999).
        """
        x, y, _ = self.simulator.target_in_rig_m()
        return -0.3 * abs(np.hypot(x, y) - self.setup.task.stand_off_m) - 0.3 * abs(np.arctan2(y, x)) / np.pi

    def info(self) -> dict[str, Any]:
        """Outcome, what was refused, and the truth, which no policy may use."""
        s = self.simulator
        told = {"outcome": s.outcome, "refused": s.refused, "distance_m": s.distance_m, "unseen": s.unseen_cause}
        return told | ({"shaped": True} if self.shaped else {})


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
    setup, **options : as for `ApproachTarget`
        Of the exact model.

    Attributes
    ----------
    inner : ApproachTarget
        The environment behind it, with dicts; for scoring.
    """

    metadata = ApproachTarget.metadata

    def __init__(self, setup: Setup | str = "default", **options: Any) -> None:
        self.inner = ApproachTarget(setup, **options)
        self.render_mode = self.inner.render_mode
        if self.inner.setup.fidelity != "exact":
            raise SceneError("the flat environment is that of the exact model: pixels make no vector of float32")
        size = len(scaled_observation(self.inner.reset(seed=0)[0], self._bounds))
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
        return scaled_observation(observation, self._bounds), info

    def step(self, action: NDArray[Any]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Perform one step.

        Raises
        ------
        SceneError
            If the action has another length or a number outside, or the episode is over.
        """
        observation, reward, over, late, info = self.inner.step(action_of_scaled(action, self._actions))
        return scaled_observation(observation, self._bounds), reward, over, late, info

    def render(self) -> NDArray[np.uint8] | None:
        """Picture of `ApproachTarget`."""
        return self.inner.render()


def numbers_of_action(action: NDArray[Any], names: tuple[str, ...]) -> NDArray[np.float64]:
    """Numbers of an action of a vector, one for each name.

    Raises
    ------
    SceneError
        If there are more or fewer, or one is not within -1 to 1.
    """
    numbers = np.asarray(action, float).reshape(-1)
    if len(numbers) != len(names):
        raise SceneError(f"action of {len(numbers)} numbers: give {len(names)} from -1 to 1, {', '.join(names)}")
    for name, number in zip(names, numbers.tolist(), strict=True):
        if not abs(number) <= 1.0:
            raise SceneError(f"action {name} = {number:g}: give a number from -1 to 1")
    return numbers


def action_of_scaled(vector: NDArray[Any], space: spaces.Dict) -> dict[str, Any]:
    """Action of a vector of -1 to 1.

    Raises
    ------
    SceneError
        If it has another length, or a number outside.
    """
    numbers = numbers_of_action(vector, tuple(space))
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


def scaled_observation(observation: dict[str, Any], space: spaces.Dict) -> NDArray[np.float32]:
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
