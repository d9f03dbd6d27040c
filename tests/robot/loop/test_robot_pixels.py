"""Pixels of the loop: spots are read where the exact model has them; environments of pixels pass all checks."""

from __future__ import annotations

import time
import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from phibench.datasets.film.moving_camera import BakedRoom
from phibench.render.optics.faces import TexelGrid
from phibench.render.optics.room_tracer import own_geometry
from phibench.robot.loop.arena import Arena, arena_of, baked_arenas, plain_arena
from phibench.robot.loop.environment import ENVIRONMENT, ApproachTarget, flat_observation, register
from phibench.robot.loop.episodes import run_episodes
from phibench.robot.loop.sensing import SEEN, SpotOnSurface
from phibench.robot.loop.simulator import Action, Setup, Simulator, Task
from phibench.scenes.room import Room
from phibench.scenes.shapes import cuboid
from phibench.scenes.validation import SceneError


@pytest.fixture(scope="module")
def arena() -> Arena:
    """Room of 8 x 7 m with two cupboards, under even light of 1 W/m^2, as if it had been baked."""
    walls = [("n", (0.0, 3.6, 1.3), (8.4, 0.2, 2.6)), ("s", (0.0, -3.6, 1.3), (8.4, 0.2, 2.6))]
    walls += [("e", (4.1, 0.0, 1.3), (0.2, 7.4, 2.6)), ("w", (-4.1, 0.0, 1.3), (0.2, 7.4, 2.6))]
    walls += [("one", (2.4, 1.8, 0.6), (0.8, 0.5, 1.2)), ("two", (-2.0, -2.2, 0.5), (0.9, 0.6, 1.0))]
    walls += [("floor", (0.0, 0.0, -0.1), (8.4, 7.4, 0.2))]
    room = Room("plain", (), tuple(cuboid(*wall, (0.4, 0.5, 0.6)) for wall in walls), robot=False)
    texels = TexelGrid.of(own_geometry(room).table, 0.5).count
    return replace(arena_of(room), baked=BakedRoom("plain", room, 0.5, np.full((texels, 3), 1.0, np.float32)))


def pixels(arena: Arena, **options) -> Setup:
    return Setup(arenas=(arena,), **{"fidelity": "windows"} | options)


@pytest.mark.slow
def test_spots_in_windows_lie_where_the_exact_model_has_them(arena) -> None:
    """Errors over what the fit states have a mean square of 1: 240 numbers, standard error 9 %.

    The camera's fixed pattern is the same in all frames of one place: 12 independent places. A sum of squares of 24
    numbers is above 2.2 or below 0.3 times its mean in 1e-3 of all cases.
    """
    simulator, pulls = Simulator(pixels(arena, task=Task(lights=0))), []
    for episode in range(12):
        simulator.start("test pixels", episode)
        light = [SpotOnSurface(*simulator.target, 1.0)]
        (at,) = simulator._sensing.unhidden(light, simulator.placement, 0.0, arena)
        if isinstance(at, str):
            continue
        for _ in range(10):
            spots = simulator.act(Action()).spots
            assert simulator.unseen_cause == SEEN, (episode, simulator.distance_m)
            assert len(spots) == 1
            pulls += [(spots[0].u_px - at[0]) / spots[0].sigma_px, (spots[0].v_px - at[1]) / spots[0].sigma_px]
    assert len(pulls) > 160
    assert 0.3 < np.mean(np.square(pulls)) < 2.2


def test_hidden_lights_have_no_window(arena) -> None:
    simulator = Simulator(pixels(arena, task=Task(lights=0)))
    simulator.start("test pixels", 1)
    assert simulator.act(Action(code=0)).windows == ()  # laser off
    assert len(simulator.act(Action()).windows) == 1
    behind = SpotOnSurface(
        simulator.target.point_m + 3.0 * (simulator.target.point_m - [0, 0, 0.8]), simulator.target.normal, 1.0
    )
    (cause,) = simulator._sensing.unhidden([behind], simulator.placement, 0.0, arena)
    assert cause == "hidden"


def test_environments_of_pixels_pass_the_checks_of_gymnasium(arena) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("error", category=UserWarning)
        warnings.filterwarnings("ignore", message=".*recommend using a symmetric and normalized space.*")
        check_env(ApproachTarget(pixels(arena)), skip_render_check=True)


def test_pixels_of_a_seed_are_the_same_bits(arena) -> None:
    def rows(seed: int) -> list[np.ndarray]:
        env = ApproachTarget(pixels(arena))
        env.action_space.seed(seed)
        found = [flat_observation(env.reset(seed=seed)[0])]
        return [*found, *(flat_observation(env.step(env.action_space.sample() | {"state": 0})[0]) for _ in "123")]

    first, again, other = rows(5), rows(5), rows(6)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], other[0])


def test_the_vector_version_holds_pixels(arena) -> None:
    register()
    vector = gymnasium.make_vec(ENVIRONMENT, num_envs=2, vectorization_mode="sync", setup=pixels(arena))
    observations, _ = vector.reset(seed=[11, 12])
    assert observations["windows"].shape[:2] == (2, 6)
    assert observations["windows"].dtype == np.uint16
    vector.close()


def test_pixels_need_baked_rooms_and_codes(arena, tmp_path) -> None:
    with pytest.raises(SceneError, match="phibench loop bake"):
        Setup(fidelity="windows")
    with pytest.raises(SceneError, match="baked"):
        Setup(fidelity="frames", arenas=(plain_arena("loop", 4),))
    with pytest.raises(SceneError, match="one of exact, windows, frames"):
        Setup(fidelity="all")  # type: ignore[arg-type]
    with pytest.raises(SceneError, match="raw pixels"):
        Simulator(pixels(arena, preset="mjpeg"))
    with pytest.raises(SceneError, match="codes"):
        pixels(arena, preset="ideal")
    with pytest.raises(ValueError, match=r"no rooms.json; make them with `phibench loop bake`"):
        baked_arenas(tmp_path)


@pytest.mark.slow
def test_frames_are_whole_images_and_the_target_is_read_in_them(arena) -> None:
    simulator = Simulator(pixels(arena, fidelity="frames", task=Task(lights=1)))
    simulator.start("test pixels", 2)
    observation = simulator.act(Action())
    (frame,) = observation.windows
    assert (frame.u0_px, frame.v0_px, frame.pixels.shape) == (0, 0, (720, 1280))
    assert simulator.unseen_cause == SEEN


@pytest.mark.slow
def test_the_process_reaches_its_target_by_pixels(arena) -> None:
    episodes = run_episodes(pixels(arena), "paper", 3, "test pixels")
    assert [episode.outcome for episode in episodes] == ["reached"] * 3


@pytest.mark.slow
@pytest.mark.parametrize(("fidelity", "steps", "required"), [("windows", 60, 20.0), ("frames", 3, 0.5)])
def test_steps_per_second_of_pixels(arena, capsys, fidelity: str, steps: int, required: float) -> None:
    """Three lights beside the target, a random action at every step, one core."""
    env = ApproachTarget(pixels(arena, fidelity=fidelity))
    env.action_space.seed(1)
    env.reset(seed=1)
    env.step(env.action_space.sample() | {"state": 0})
    start = time.process_time()
    for _ in range(steps):
        _, _, over, late, _ = env.step(env.action_space.sample() | {"state": 0})
        if over or late:
            env.reset()
    rate = steps / (time.process_time() - start)
    with capsys.disabled():
        print(f"{fidelity}: {rate:.2f} steps per CPU second")
    assert rate >= required
