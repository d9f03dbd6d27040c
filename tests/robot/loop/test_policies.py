"""Policies: the process reaches its target and is calibrated; policies that fail lose their episode alone."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy
from helpers.target_approach import rig_covariance

from phibench.benchmark.isolation.run_limits import RunLimits
from phibench.cli import loop
from phibench.cli import main as cli
from phibench.robot.loop.arena import generated_arena
from phibench.robot.loop.episodes import (
    LOST,
    Episode,
    episode_frame,
    loop_score,
    run_episode,
    run_episodes,
    run_foreign,
)
from phibench.robot.loop.foreign_policies import PolicyFile, policy_of
from phibench.robot.loop.policies import CODED, POLICIES, ApproachPlan, Identifier
from phibench.robot.loop.sensing import SEEN, SpotReading
from phibench.robot.loop.simulator import CODES, COLLISION, REACHED, Action, Observation, Setup, Simulator, Task
from phibench.scenes.motion.vehicle import PlanarPose
from phibench.scenes.validation import SceneError
from phibench.studies.loop.study import rig_deviation, summary


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["paper", "greedy", "oracle"])
def test_policies_reach_their_targets(policy: str) -> None:
    episodes = run_episodes(Setup(), policy, 3, "policies")
    assert [episode.outcome for episode in episodes] == ["reached"] * 3
    for episode in episodes:
        assert abs(episode.distance_m - 1.0) <= 0.05
        assert abs(episode.stated_m / episode.distance_m - 1) <= 0.02
    frame = episode_frame(episodes)
    assert frame["time_s"].max() < 40.0
    if policy == "paper":
        assert frame["strokes"].min() >= 1
        assert frame["locked_s"].to_list() == [1.5] * 3  # one code of 15 steps


def test_chance_reaches_nothing() -> None:
    assert not any(episode.reached for episode in run_episodes(Setup(), "random", 5, "policies"))


def test_the_same_stream_gives_the_same_episodes() -> None:
    one, other = (run_episodes(Setup(), "random", 2, "policies") for _ in range(2))
    assert repr(one) == repr(other)


def frame(step: int, lit: bool, *places: float) -> Observation:
    spots = tuple(SpotReading(u, 100.0, 0.1, 1e4, SEEN) for u in places)
    return Observation(step, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, lit, spots)


def test_the_target_is_the_spot_that_blinks_with_the_laser() -> None:
    found, code = Identifier(), CODES[CODED]
    for k, bit in enumerate(code):
        assert found.target() is None
        places = [300.0, *([200.0] if bit == "1" else []), *([400.0] if k % 2 else [])]
        found.add(frame(k, bit == "1", *places))
    target = found.target()
    assert target is not None
    assert target.u_px == 200.0


def test_no_target_is_found_where_nothing_blinks_with_the_laser() -> None:
    found = Identifier()
    for k, bit in enumerate(CODES[CODED] * 2):
        found.add(frame(k, bit == "1", 300.0, *([400.0] if k % 3 else [])))
    assert found.target() is None


def test_greedy_plans_a_stroke_because_driving_leaves_the_slip_unknown() -> None:
    simulator = Simulator(Setup())
    policy = POLICIES["greedy"](simulator.setup.known, simulator)
    observation = simulator.start("greedy", 1)
    while policy.belief is None:
        observation = simulator.act(policy.act(observation))
    policy._track(policy.belief, observation)
    none, some = (policy.expected(ApproachPlan(*plan)) for plan in ((0.0, 0.0), (0.0, 0.2)))
    slip = simulator.setup.vehicle.slip_sigma
    assert none.sigma_m > 0.5 * slip  # of a metre
    assert some.sigma_m < 0.5 * none.sigma_m
    assert some.time_s > none.time_s


# -- policies that fail ------------------------------------------------------------------------------------------------


class Raises:
    def act(self, observation: Observation) -> Action:
        raise ValueError("no idea")


class AnswersNan:
    def act(self, observation: Observation) -> Action:
        return Action(drive_m_per_s=math.nan)


class Stands:
    def act(self, observation: Observation) -> Action:
        return Action()


@pytest.mark.parametrize(
    ("policy", "words"),
    [(Raises(), "ValueError in step 0: no idea"), (AnswersNan(), "action drive_m_per_s = nan: must be finite")],
)
def test_a_policy_that_fails_loses_its_episode_in_one_sentence(policy, words: str) -> None:
    simulator = Simulator(Setup())
    episode = run_episode(simulator, policy, simulator.start("fails"))
    assert episode.outcome == LOST
    assert words in episode.cause
    assert "\n" not in episode.cause
    assert run_episode(
        simulator, POLICIES["oracle"](simulator.setup.known, simulator), simulator.start("fails")
    ).reached


class Strokes:
    def act(self, observation: Observation) -> Action:
        return Action(drive_m_per_s=0.1, stroke_m_per_s=0.1)


def test_refused_commands_stay_with_the_episode() -> None:
    simulator = Simulator(Setup(task=Task(longest_s=0.3)))
    episode = run_episode(simulator, Strokes(), simulator.start("refused"))
    assert episode.refused.startswith("in step 1: stroke_m_per_s = 0.1 while the tracks run")
    assert run_episodes(Setup(), "oracle", 1, "refused")[0].refused == ""


def test_policies_of_files_are_named_in_one_sentence(tmp_path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "class P:\n    act = staticmethod(lambda seen: None)\nmake = lambda known: P()\nthree = lambda known: 3\n"
    )
    assert PolicyFile.of(f"{file}:make").reference().function == "make"
    for text in ("make, other = P, 1", "if True:\n    make = P", "from elsewhere import *", "for make in [P]: pass"):
        (tmp_path / "bound.py").write_text(f"class P: pass\n{text}\n")
        assert PolicyFile.of(f"{tmp_path / 'bound.py'}:make").name == "make"
    (tmp_path / "bound.py").write_text("x = [make for make in ()]\ndef other():\n    make = 1\n")
    with pytest.raises(SceneError, match=r"bound.py has no make; .*known: other, x"):
        PolicyFile.of(f"{tmp_path / 'bound.py'}:make")
    with pytest.raises(SceneError, match="three gave int"):
        policy_of(lambda known: 3, Setup().known, "three")
    with pytest.raises(SceneError, match="four is int, no function"):
        policy_of(4, Setup().known, "four")
    (tmp_path / "broken.py").write_text("def make(known)\n")
    for text, words in (
        (f"{file}", "give FILE.py:NAME"),
        ("nowhere.py:make", "no file nowhere.py"),
        (f"{file}:mke", r"mine.py has no mke; did you mean 'make'\? known: P, make, three"),
        (f"{tmp_path / 'broken.py'}:make", "Python cannot read the file"),
    ):
        with pytest.raises(SceneError, match=words):
            PolicyFile.of(text)


def test_a_target_that_is_never_seen_is_said() -> None:
    setup = Setup(task=Task(power=1e-3, longest_s=1.0, lights=0))
    (episode,) = run_episodes(setup, "paper", 1, "dark")
    assert "the target was never seen (too faint)" in episode.cause


def test_unknown_policies_are_refused() -> None:
    with pytest.raises(SceneError, match="papr"):
        run_episodes(Setup(), "papr", 1, "x")


def test_a_policy_without_its_package_is_no_policy_that_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    """No episode counts as lost; policies without a belief run."""
    monkeypatch.setitem(sys.modules, "filterpy.kalman", None)
    for policy in sorted(set(POLICIES) - {"random", "oracle"}):
        with pytest.raises(SceneError, match=r"need filterpy: pip install 'phibench\[loop\]'"):
            run_episodes(Setup(), policy, 1, "x")
    assert len(run_episodes(Setup(), "random", 1, "x")) == 1


def test_a_table_of_episodes_has_a_dash_where_nothing_was_stated(capsys: pytest.CaptureFixture[str]) -> None:
    [episode] = run_episodes(Setup(), "random", 1, "x")
    loop._print([replace(episode, stated_m=math.nan, cause="ran into something")])
    row = capsys.readouterr().out.splitlines()[1]
    assert "nan" not in row
    assert row.endswith(" -  ran into something")


FOREIGN = """
import time
from phibench.robot.loop.simulator import Action

class Stands:
    def act(self, seen):
        return Action()

class Hangs:
    def act(self, seen):
        time.sleep(3600)

stands, hangs = lambda known: Stands(), lambda known: Hangs()
"""


@pytest.mark.slow
def test_a_process_of_its_own_ends_policies_that_hang(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each episode has its own; what a policy may not do is told on the command line."""
    short, file = Setup(task=Task(longest_s=0.5)), tmp_path / "mine.py"
    file.write_text(FOREIGN)
    (stood,) = run_foreign(short, PolicyFile.of(f"{file}:stands"), 1, "foreign")
    assert stood.outcome == "time is over", stood.cause
    hung = list(run_foreign(short, PolicyFile.of(f"{file}:hangs"), 2, "foreign", limits=RunLimits(seconds=0.5)))
    assert [episode.outcome for episode in hung] == [LOST, LOST]
    assert "did not answer within 0.5 s" in hung[0].cause
    assert cli.main(["loop", "run", f"{file}:hangs", "--episodes", "1", "--seconds", "0.5"]) == 1
    assert "isolated: " in capsys.readouterr().out


@pytest.mark.study
@pytest.mark.parametrize("policy", ["paper", "greedy"])
def test_rigs_whose_covariance_is_stated(capsys, policy: str) -> None:
    """200 episodes in 20 rooms, each with a rig of its own as built by hand; without the covariance none is reached.

    The rms pull of 200 consistent beliefs is 1 +- 0.05: two of these are allowed. Rooms, rigs and episodes are none of
    those ("loop test 3") on which the belief was mended.
    """
    rooms = tuple(generated_arena("loop test 4", k) for k in range(20))
    setup, rows = Setup(arenas=rooms, rig_covariance=rig_covariance(1.0)), []
    for number in range(200):
        own = replace(setup, misalignment=rig_deviation(1.0, 6000 + number))
        rows += [replace(one, number=number) for one in run_episodes(own, policy, 1, "told rooms 2", number)]
    found = summary(rows)
    with capsys.disabled():
        print(f"{policy}: reached {found.reached}, pull {found.pull}, error of D {found.error}, time {found.time_s}")
    assert found.reached[0] >= 0.95
    assert 0.9 < found.pull[0] < 1.1


@pytest.mark.slow
def test_the_command_line_draws_rigs_from_what_is_known_of_them(tmp_path, capsys) -> None:
    setup = Setup(rig_covariance=rig_covariance(1.0), own_rigs=True)
    simulator, drawn = Simulator(setup), []
    for number in (0, 1, 0):
        simulator.start("x", number)
        drawn.append(simulator.misalignment)
    assert drawn[0] == drawn[2] != drawn[1]
    with pytest.raises(SceneError, match="own_rigs: rigs are drawn from rig_covariance"):
        Setup(own_rigs=True)
    assert cli.main(["loop", "run", "oracle", "--episodes", "1", "--as-built", "0.5"]) == 0
    assert "reached: 1 of 1" in capsys.readouterr().out
    both = ["--as-built", "1", "--calibration", str(tmp_path / "none.json")]
    for options, words in ((["--as-built", "3"], "as_built"), (both, "give one of them"), (both[2:], "none.json")):
        assert cli.main(["loop", "run", "oracle", *options]) == 2
        said = capsys.readouterr().err
        assert words in said
        assert said.count("\n") == 1


def test_obstacles_pitch_the_robot_and_too_high_steps_are_refused() -> None:
    """Ramps of 0.4 m for 0.05 m: both rollers on one ramp pitch by atan(0.05 / 0.4)."""
    simulator = Simulator(Setup(task=Task(obstacle_m=0.05, lights=0)))
    simulator.start("ramp", 1)
    (block,) = simulator.obstacles
    seen = []
    for along in np.linspace(0.0, 1.0, 41):
        simulator.pose = PlanarPose(along * 2.0 * block.x_m, along * 2.0 * block.y_m, block.yaw_rad)
        seen.append(simulator.act(Action()))
    pitches = np.array([one.pitch_rad for one in seen])
    assert 0.04 < pitches.max() <= math.atan(0.05 / 0.4) + 1e-9
    assert pitches.min() < -0.04
    assert max(abs(one.roll_rad) for one in seen) < 1e-12
    ramp = Setup(task=Task(obstacle_m=0.05, distances_m=(3.0, 4.5)))
    assert [one.reached for one in run_episodes(ramp, "paper", 1, "ramp")] == [True]
    with pytest.raises(SceneError, match="climbs no higher step"):
        Simulator(Setup(task=Task(obstacle_m=0.2, obstacle_run_m=0.0))).start("ramp", 1)


def test_distances_in_the_wrong_order() -> None:
    with pytest.raises(SceneError, match="distances_m = 3, 1: the nearest target comes first"):
        Task(distances_m=(3.0, 1.0))


@pytest.mark.study
def test_the_process_reaches_its_target_in_twenty_rooms(capsys) -> None:
    """200 episodes: at least 95 % reached; pull of 1 / D over all beliefs 0.9 to 1.1.

    Rooms and episodes are none of those ("loop", "loop test") on which policies were mended.
    """
    setup = Setup(arenas=tuple(generated_arena("loop test 2", k) for k in range(20)))
    frame = episode_frame(run_episodes(setup, "paper", 200, "test rooms 2"))
    reached = int((frame["outcome"] == "reached").sum())
    pull = float(np.sqrt(np.mean(frame["pull"].drop_nans().to_numpy() ** 2)))
    low, high = scipy.stats.binomtest(reached, 200).proportion_ci()
    with capsys.disabled():
        print(f"reached {reached} of 200 ({low:.3f} to {high:.3f}), pull {pull:.2f}")
    assert reached >= 190
    assert 0.9 <= pull <= 1.1


def episode(outcome: str, driven_m: float, shortest_m: float, pull: float = math.nan) -> Episode:
    nan = math.nan
    return Episode(0, outcome, "", 10.0, driven_m, shortest_m, 1, 1.0, 1.0, nan, nan, pull, nan)


def test_score_of_episodes() -> None:
    """SPL by hand: (1 + 2/4 + 0) / 3; 2 of 3 by Clopper and Pearson are 9.4 to 99.2 %."""
    rows = [episode(REACHED, 1.9, 2.0, 1.0), episode(REACHED, 4.0, 2.0, -2.0), episode(COLLISION, 1.0, 2.0)]
    score = loop_score(rows)
    assert (score.count, score.reached, score.pulls) == (3, 2, 2)
    assert score.spl == pytest.approx(0.5)
    assert score.pull == pytest.approx(math.sqrt(2.5))
    assert (score.share_low, score.share_high) == pytest.approx((0.0943, 0.9916), abs=1e-4)
    assert "reached: 2 of 3 (95 %: 9 to 99 %); SPL 0.50" in score.sentence()
    with pytest.raises(SceneError, match="there are no episodes"):
        loop_score([])


def test_settings_and_distances_of_the_command_line(tmp_path, capsys) -> None:
    assert cli.main(["loop", "run", "oracle", "--episodes", "2", "--setting", "easy", "--distance-m", "2", "2.1"]) == 0
    assert "reached: 2 of 2 (95 %: 16 to 100 %); SPL 1.00" in capsys.readouterr().out
    assert cli.main(["loop", "run", "oracle", "--distance-m", "0.2", "2"]) == 2
    assert "stand_off_m" in capsys.readouterr().err
    assert cli.main(["loop", "show", "papr", "--out", str(tmp_path / "x.mp4")]) == 2
    assert "did you mean 'paper'" in capsys.readouterr().err
