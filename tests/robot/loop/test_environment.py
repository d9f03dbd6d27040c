"""Environment: it is what `gymnasium` asks for, the same seed gives the same bits, and faults end in a sentence."""

from __future__ import annotations

import math
import re
import time
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from phibench.robot.loop.environment import (
    ENVIRONMENT,
    FLAT,
    ApproachTarget,
    action_of,
    action_of_scaled,
    flat_observation,
    register,
    scaled_observation,
)
from phibench.robot.loop.simulator import (
    COLLISION,
    LATE,
    REACHED,
    WRONG,
    Action,
    Setup,
    Simulator,
)
from phibench.scenes.validation import SceneError


@pytest.fixture(scope="module")
def env() -> ApproachTarget:
    register()
    register()
    made = gymnasium.make(ENVIRONMENT).unwrapped
    assert isinstance(made, ApproachTarget)
    return made


def drive(env, seed: int, steps: int) -> list[np.ndarray]:
    """Flat observations under actions of the action space's own seed."""
    env.action_space.seed(seed)
    rows = [flat_observation(env.reset(seed=seed)[0])]
    for _ in range(steps):
        action = env.action_space.sample()
        action["state"] = 0
        observation, reward, over, late, _ = env.step(action)
        rows.append(np.append(flat_observation(observation), reward))
        if over or late:
            rows.append(flat_observation(env.reset()[0]))
    return rows


def test_it_passes_the_checks_of_gymnasium(env) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("error", category=UserWarning)
        warnings.filterwarnings("ignore", message=".*recommend using a symmetric and normalized space.*")
        check_env(env, skip_render_check=True)


def test_the_same_seed_gives_the_same_bits_and_another_does_not(env) -> None:
    first, again, other = drive(env, 5, 40), drive(env, 5, 40), drive(env, 6, 40)
    assert len(first) == len(again)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], other[0])


def test_the_vector_version_is_the_single_ones_side_by_side(env) -> None:
    register()
    vector = gymnasium.make_vec(ENVIRONMENT, num_envs=3, vectorization_mode="sync")
    observations, _ = vector.reset(seed=[11, 12, 13])
    for k, seed in enumerate((11, 12, 13)):
        single, _ = env.reset(seed=seed)
        assert np.array_equal(observations["spots"][k], single["spots"])
    _, rewards, _, _, _ = vector.step(vector.action_space.sample())
    assert rewards.shape == (3,)
    vector.close()


def still(env, **numbers) -> tuple[float, bool, bool, dict]:
    action = {name: np.zeros(1) for name in env.action_space if name not in ("exposure", "code", "state")}
    states = int("stated_m" in numbers)
    _, reward, over, late, info = env.step(action | {"exposure": 4, "code": 1, "state": states} | numbers)
    return reward, over, late, info


def test_reward_and_ends(env) -> None:
    """-0.01 a second; 1 for D stated right where the robot shall stand, -1 for the same elsewhere or another D."""
    env.reset(seed=1)
    assert still(env)[0] == pytest.approx(-0.001)
    reward, over, late, info = still(env, stated_m=np.array([env.simulator.distance_m]))
    assert (reward, over, late, info["outcome"]) == (pytest.approx(-1.001), True, False, WRONG)
    with pytest.raises(SceneError, match="no episode is running"):
        still(env)

    near = ApproachTarget(distances_m=(1.0, 1.04))
    near.reset(seed=2)
    true = near.simulator.distance_m
    assert abs(true - 1.0) < 0.05
    reward, over, _, info = still(near, stated_m=np.array([1.019 * true]))
    assert (reward, over, info["outcome"]) == (pytest.approx(0.999), True, REACHED)
    near.reset(seed=2)
    assert still(near, stated_m=np.array([1.021 * true]))[3]["outcome"] == WRONG

    short = ApproachTarget(longest_s=0.2)
    short.reset(seed=3)
    assert still(short)[1:3] == (False, False)
    assert still(short)[1:3] == (False, True)
    assert short.simulator.outcome == LATE


def test_walls_end_an_episode(env) -> None:
    env.reset(seed=4)
    for _ in range(400):
        reward, over, _, info = still(env, drive_m_per_s=np.array([0.5]))
        if over:
            break
    assert (info["outcome"], reward) == (COLLISION, pytest.approx(-1.001))


def test_what_is_refused_is_said_in_one_sentence(env) -> None:
    env.reset(seed=1)
    reward, _, _, info = still(env, drive_m_per_s=np.array([0.2]), stroke_m_per_s=np.array([0.2]))
    assert "only while the robot stands" in info["refused"]
    assert env.simulator.stroke_m == 0.0
    assert reward == pytest.approx(-0.011)
    for _ in range(20):
        info = still(env, flipper_rad_per_s=np.array([1.0]))[3]
    assert "flippers turn from -1.4 to 1.6 rad" in info["refused"]
    assert env.simulator.flipper_rad == 1.6
    assert "carriage goes from 0 to 0.8 m" in still(env, stroke_m_per_s=np.array([-0.1]))[3]["refused"]
    assert still(env)[3]["refused"] == ""
    with pytest.raises(SceneError, match=r"action drive_m_per_s = nan: must be finite"):
        still(env, drive_m_per_s=np.array([math.nan]))
    with pytest.raises(SceneError, match="exposure = 9"):
        still(env, exposure=9)


def test_a_raised_front_moves_the_spot_and_is_reported(env) -> None:
    """Flippers down by 1.2 rad tilt the rig by some 10 degrees: the spot moves by many pixels."""
    simulator = Simulator(Setup())
    simulator.start("flippers")
    level = simulator.act(Action())
    for _ in range(12):
        raised = simulator.act(Action(flipper_rad_per_s=-1.0))
    assert raised.flipper_rad == pytest.approx(-1.2)
    held = raised.attitude(simulator.setup.vehicle)
    assert held is not None
    assert math.degrees(held.raised_rad) > 5.0
    assert level.spots != raised.spots


def test_actions_take_defaults_for_what_is_left_out() -> None:
    assert action_of({"drive_m_per_s": [0.2], "code": 2}) == Action(drive_m_per_s=0.2, code=2)


def test_a_number_alone_states_nothing(env) -> None:
    env.reset(seed=1)
    assert not env.step({"stated_m": np.array([2.0])})[2]
    assert action_of({"state": 1, "stated_m": [2.0]}) == Action(stated_m=2.0)


@pytest.mark.parametrize(
    ("action", "words"),
    [
        ({"drive": 0.1}, "action 'drive': did you mean 'drive_m_per_s'?"),
        ({"state": 1}, "give the distance, stated_m, in metres and above 0"),
        ({"state": 2, "stated_m": 1.0}, "action state = 2"),
    ],
)
def test_a_strange_action_is_one_sentence(action: dict[str, float], words: str) -> None:
    with pytest.raises(SceneError, match=re.escape(words)) as caught:
        action_of(action)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_the_name_with_its_module_is_enough(python) -> None:
    code = "import gymnasium; print(gymnasium.make('phibench.robot.loop.environment:phibench/ApproachTarget-v0'))"
    child = python(code)
    assert "ApproachTarget" in child.stdout, child.stderr


@pytest.fixture(scope="module")
def vectors() -> gymnasium.Env:
    return gymnasium.make(FLAT).unwrapped


def test_the_flat_one_passes_the_checks_of_gymnasium(vectors) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("error", category=UserWarning)
        check_env(vectors, skip_render_check=True)


def test_vectors_are_the_dicts_scaled(env, vectors) -> None:
    """The ends of each range, and the same episode as the other environment's."""
    space = env.action_space
    low, high = (action_of_scaled(np.full(len(space), x), space) for x in (-1.0, 1.0))
    assert low["drive_m_per_s"] == -high["drive_m_per_s"] == space["drive_m_per_s"].low[0]
    assert (low["state"], high["state"], high["exposure"]) == (0, 1, space["exposure"].n - 1)
    assert vectors.reset(seed=7)[0] == pytest.approx(
        scaled_observation(env.reset(seed=7)[0], env.observation_space), abs=0.0
    )
    action = np.array([0.3, -0.2, 0.0, 0.0, 0.1, 0.5, -1.0, 0.0], np.float32)
    seen, reward, *_ = vectors.step(action)
    other, expected, *_ = env.step(action_of_scaled(action, space))
    assert reward == expected
    assert np.array_equal(seen, scaled_observation(other, env.observation_space))
    assert seen.dtype == np.float32
    assert np.abs(seen).max() <= 1.0
    with pytest.raises(SceneError, match=r"action \w+ = 1.1: give a number from -1 to 1"):
        action_of_scaled(np.full(8, 1.1), space)
    with pytest.raises(SceneError, match="action of 3 numbers: give 8 from -1 to 1"):
        action_of_scaled(np.zeros(3), space)


@pytest.mark.slow
def test_steps_per_second_of_the_exact_model(capsys) -> None:
    """At least 2000 steps of one environment in a second of one core, four lights in a room."""
    env = ApproachTarget()
    env.reset(seed=1)
    actions = [env.action_space.sample() | {"state": 0} for _ in range(500)]
    best = 0.0
    for _ in range(3):
        start = time.process_time()
        for action in actions:
            _, _, over, late, _ = env.step(action)
            if over or late:
                env.reset()
        best = max(best, len(actions) / (time.process_time() - start))
    with capsys.disabled():
        print(f"exact model: {best:.0f} steps per CPU second")
    assert best >= 2000


@pytest.mark.slow
def test_named_settings_are_environments_of_gymnasium() -> None:
    """What the page says of each; `hard` draws a rig of its own for every episode."""
    for place in ("ApproachTarget", "ApproachTargetFlat"):
        easy = gymnasium.make(f"phibench/{place}-easy-v0").unwrapped
        setup = easy.setup if isinstance(easy, ApproachTarget) else easy.inner.setup  # type: ignore[attr-defined]
        assert (setup.task.lights, setup.task.distances_m, setup.own_rigs) == (0, (1.5, 3.0), False)
    hard = ApproachTarget("hard")
    assert (hard.setup.task.lights, hard.setup.task.power, hard.setup.own_rigs) == (5, 0.1, True)
    rigs = []
    for seed in (1, 2, 1):
        hard.reset(seed=seed)
        rigs.append(hard.simulator.misalignment)
    assert rigs[0] == rigs[2] != rigs[1]
    with pytest.raises(SceneError, match="setting 'hrad': did you mean 'hard'"):
        ApproachTarget("hrad")


def test_shaping_adds_what_a_potential_gains(env) -> None:
    """Over an episode the additions sum to the potential's difference: the best policy stays the best."""
    shaped, plain = ApproachTarget(shaped=True), ApproachTarget()
    gained = 0.0
    for one in (shaped, plain):
        one.reset(seed=7)
    begin = shaped._potential()
    for _ in range(30):
        action = {"drive_m_per_s": 0.2, "turn_rad_per_s": 0.3}
        more, less = shaped.step(action), plain.step(action)
        gained += more[1] - less[1]
    assert gained == pytest.approx(shaped._potential() - begin, abs=1e-12)
    assert abs(gained) > 1e-3
    assert more[4]["shaped"] is True
    assert "shaped" not in less[4]


def test_a_picture_shows_robot_and_target(env) -> None:
    """Room from above: the target's red disc lies where its place is, 40 px a metre about the middle; y is up."""
    made = ApproachTarget(render_mode="rgb_array")
    made.reset(seed=5)
    picture = made.render()
    assert picture.shape == (400, 400, 3)
    x, y, _ = made.simulator.target.point_m
    u, v = round(200 + 40 * x), round(200 - 40 * y)
    assert picture[v, u].tolist() == [204, 51, 17]
    pose = made.simulator.pose
    assert picture[round(200 - 40 * pose.y_m) + 0, round(200 + 40 * pose.x_m)].tolist() in ([153, 153, 68], [0, 0, 0])
    assert ApproachTarget().render() is None
    with pytest.raises(SceneError, match="render_mode 'human'"):
        ApproachTarget(render_mode="human")


def test_a_belief_is_enough_to_reach_the_target() -> None:
    """Some rules, no pixel: turn, stroke until D is known to 0.5 %, drive, state. The inner belief does the rest.

    Seeds are fixed: the same episodes each time.
    """
    env = gymnasium.make("phibench.robot.loop.belief_environment:phibench/ApproachTargetBelief-easy-v0")
    check_env(env.unwrapped, skip_render_check=True)
    for seed in range(3):
        observation, info = env.reset(seed=seed)
        over = late = False
        while not (over or late):
            sin, _, left, enlarged, sigma, stroke, _, _ = observation
            there = abs(enlarged) < 0.2
            if abs(sin) > 0.05 and not there:
                action = [0.0, np.clip(2 * sin, -1, 1), 0.0, -1.0]
            elif sigma > -0.15 and stroke < 0.99:
                action = [0.0, 0.0, 0.6, -1.0]
            else:
                action = [np.clip(8 * left, -1, 1), 0.0, 0.0, 1.0 if there else -1.0]
            observation, reward, over, late, info = env.step(np.array(action, np.float32))
        assert (info["outcome"], reward) == (REACHED, pytest.approx(1.0 - 0.001))
    env.reset(seed=1)
    assert env.step(np.array([0, 0, 0, 1], np.float32))[1] == pytest.approx(-0.011)  # far from the stand-off distance
    with pytest.raises(SceneError, match="action of 3 numbers: give 4 from -1 to 1, drive, turn, stroke, state"):
        env.unwrapped.step(np.zeros(3))
