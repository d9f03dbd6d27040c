"""Episodes of a built-in or foreign policy, run and scored, one row each; and the named setups of the loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import polars as pl

from phibench.benchmark.isolation.run_limits import RunLimits
from phibench.benchmark.scores.intervals import clopper_pearson
from phibench.estimator.geometry.rig_parameters import prior_sigmas
from phibench.robot.loop.arena import generated_arena
from phibench.robot.loop.belief import Belief, require_filter
from phibench.robot.loop.foreign_policies import ANSWER_S, PolicyFile, PolicyProcess
from phibench.robot.loop.policies import BELIEVING, POLICIES, Policy
from phibench.robot.loop.simulator import REACHED, RUNNING, Action, Known, Observation, Setup, Simulator, Task
from phibench.scenes.motion.vehicle import Vehicle
from phibench.scenes.random_streams import Name
from phibench.scenes.validation import SceneError, nearest

# Named settings of the loop, easy, default and hard, and what a policy's episodes in one of them are worth.
#
# | setting | other lights | target, m | rig | power | rooms | slip from run to run |
# |---|---|---|---|---|---|---|
# | easy | none | 1.5 to 3 | exact | 1 | four walls, some cupboards | 0.02 |
# | default | 3 | 1.5 to 4.5 | exact | 1 | the same | 0.02 |
# | hard | 5 | 1.5 to 4.5 | as built by hand, told as such | 0.1 | generated, furnished | 0.05 |


Setting = Literal["easy", "default", "hard"]
SETTINGS: tuple[str, ...] = get_args(Setting)
_ROOMS = 20  # of `hard`: each of a hundred episodes meets every room some five times


def named_setup(name: str) -> Setup:
    """Setup of a named setting.

    Raises
    ------
    SceneError
        If there is none of that name.
    """
    if name == "easy":
        return Setup(task=Task(distances_m=(1.5, 3.0), lights=0))
    if name == "default":
        return Setup()
    if name != "hard":
        raise SceneError(f"setting '{name}': {nearest(name, SETTINGS)}")
    return Setup(
        vehicle=Vehicle(slip_sigma=0.05),
        task=Task(lights=5, power=0.1),
        arenas=tuple(generated_arena("loop hard", number) for number in range(_ROOMS)),
        rig_covariance=np.diag(prior_sigmas() ** 2),
        own_rigs=True,
    )


@dataclass(frozen=True)
class LoopScore:
    """Numbers of a policy over episodes.

    Attributes
    ----------
    count, reached : int
        Episodes, and successes among them.
    share_low, share_high : float
        Interval of 95 % of the share of successes (Clopper and Pearson 1934).
    spl : float
        Success weighted by path length, the mean of s l / max(p, l): s is 1 for a success, l the straight way to the
        stand-off distance, p the way driven (P. Anderson et al., arXiv:1807.06757, 2018).
    time_s : float
        Median time of successes; NaN without any.
    pull : float
        Rms error of the inverse distance over its stated standard deviation; NaN where no policy states one.
    pulls : int
        Episodes that have one.
    """

    count: int
    reached: int
    share_low: float
    share_high: float
    spl: float
    time_s: float
    pull: float
    pulls: int

    def sentence(self) -> str:
        """All of it in one line."""
        share = f"reached: {self.reached} of {self.count} (95 %: {100 * self.share_low:.0f} to "
        share += f"{100 * self.share_high:.0f} %); SPL {self.spl:.2f}"
        time = f"; median time {self.time_s:.1f} s" if math.isfinite(self.time_s) else ""
        pull = f"; pull of 1/D {self.pull:.2f} (n {self.pulls})" if self.pulls else ""
        return share + time + pull


def loop_score(episodes: Sequence[Episode]) -> LoopScore:
    """Score of episodes.

    Raises
    ------
    SceneError
        If there are none.
    """
    if not episodes:
        raise SceneError("score of a policy: there are no episodes; run at least one")
    reached = np.array([episode.reached for episode in episodes])
    way = np.array([(episode.shortest_m, episode.driven_m) for episode in episodes])
    # a start at the stand-off distance has no way: to stay there is the straight one
    weight = np.maximum(way[:, 0], 1e-9) / np.maximum(way.max(axis=1), 1e-9)
    times = [episode.time_s for episode in episodes if episode.reached]
    pulls = np.array([episode.pull for episode in episodes if math.isfinite(episode.pull)])
    low, high = clopper_pearson(int(reached.sum()), len(episodes), 0.95)
    return LoopScore(
        len(episodes),
        int(reached.sum()),
        low,
        high,
        float(np.mean(reached * weight)),
        float(np.median(times)) if times else math.nan,
        float(np.sqrt(np.mean(pulls**2))) if len(pulls) else math.nan,
        len(pulls),
    )


LOST = "policy failed"


@dataclass(frozen=True)
class Episode:
    """Result of one episode.

    Attributes
    ----------
    outcome : str
        Of `simulator`, or `LOST` where the policy failed.
    cause : str
        One sentence for an episode that was not reached; empty for one that was.
    shortest_m : float
        Straight way from the start to the stand-off distance.
    distance_m, stated_m, sigma_m : float
        True D at the end, what was stated, and the belief's standard deviation; NaN where there is none.
    locked_s : float
        Time of the first lock; NaN without one.
    pull : float
        Error of the inverse distance over its standard deviation, at the end; NaN without a belief.
    refused : str
        First command that was refused, in one sentence; empty where none was.
    """

    number: int
    outcome: str
    cause: str
    time_s: float
    driven_m: float
    shortest_m: float
    strokes: int
    distance_m: float
    stated_m: float
    sigma_m: float
    locked_s: float
    pull: float
    nees: float
    refused: str = ""

    @property
    def reached(self) -> bool:
        """True for a success."""
        return self.outcome == REACHED


def run_episode(simulator: Simulator, policy: Policy, observation: Observation, number: int = 0) -> Episode:
    """Run one episode, which has begun, to its end; a policy that raises or answers nonsense loses it."""
    stated, failure, refused, was_seen = math.nan, "", "", False
    while simulator.outcome == RUNNING:
        try:
            action = policy.act(observation)
            observation = simulator.act(Action(*action))
        except Exception as error:  # whatever a policy does, its episode alone is lost
            named = "" if isinstance(error, SceneError) else f"{type(error).__name__} "
            failure = f"{named}in step {simulator.step}: {' '.join(str(error).split())[:200]}"
            break
        was_seen = was_seen or simulator.unseen_cause == ""
        refused = refused or (simulator.refused and f"in step {simulator.step}: {simulator.refused}")
        stated = action.stated_m if action.stated_m > 0.0 else stated
    belief = getattr(policy, "belief", None)
    locked = getattr(policy, "locked_step", -1)
    pull, nees, sigma = _judged(simulator, belief)
    return Episode(
        number,
        LOST if failure else simulator.outcome,
        failure or _cause(simulator, stated, was_seen),
        simulator.time_s,
        simulator.driven_m,
        simulator.shortest_m,
        simulator.strokes,
        simulator.distance_m,
        stated,
        sigma,
        locked * simulator.setup.task.step_s if locked >= 0 else math.nan,
        pull,
        nees,
        refused,
    )


def _judged(simulator: Simulator, belief: Belief | None) -> tuple[float, float, float]:
    """Pull, NEES and standard deviation of D of a belief at the end."""
    if not isinstance(belief, Belief):
        return math.nan, math.nan, math.nan
    error = belief.mean[2] - 1.0 / simulator.distance_m
    pull = float(error / math.sqrt(belief.covariance[2, 2]))
    return pull, belief.nees(simulator.target_in_rig_m()), belief.distance_sigma_m


def _cause(simulator: Simulator, stated_m: float, was_seen: bool) -> str:
    if simulator.outcome == REACHED:
        return ""
    if not was_seen:
        return f"the target was never seen ({simulator.unseen_cause}): change exposure, laser or distances"
    if math.isfinite(stated_m):
        return f"stated {stated_m:.3f} m at {simulator.distance_m:.3f} m"
    return f"{simulator.outcome} at D = {simulator.distance_m:.2f} m after {simulator.time_s:.1f} s"


def run_episodes(setup: Setup, policy: str, count: int, *stream: Name) -> list[Episode]:
    """Episodes of a built-in policy, in this process; parameters as for `episodes_of`."""
    return list(episodes_of(setup, policy, count, *stream))


def episodes_of(setup: Setup, policy: str, count: int, *stream: Name) -> Iterator[Episode]:
    """Episodes of a built-in policy, in this process, one after the other.

    Parameters
    ----------
    *stream : names

    Raises
    ------
    SceneError
        If there is no such policy, or it needs a package that is not installed.
    """
    made = built_in_policy(policy)
    return (
        run_episode(simulator, made(setup.known, simulator), observation, number)
        for number, simulator, observation in _started(setup, count, stream)
    )


def built_in_policy(name: str) -> Callable[[Known, Simulator], Policy]:
    """Function that makes a built-in policy.

    Raises
    ------
    SceneError
        If there is none of that name, or it needs a package that is not installed.
    """
    if name not in POLICIES:
        raise SceneError(f"policy '{name}': {nearest(name, POLICIES)}")
    if name in BELIEVING:
        require_filter()  # else each episode would count as one that the policy has lost
    return POLICIES[name]


def _started(setup: Setup, count: int, stream: Sequence[Name]) -> Iterator[tuple[int, Simulator, Observation]]:
    """Number, simulator and first observation of each episode."""
    simulator = Simulator(setup)
    for number in range(count):
        yield number, simulator, simulator.start(*stream, number)


def episode_frame(episodes: Sequence[Episode]) -> pl.DataFrame:
    """A row per episode."""
    return pl.DataFrame([asdict(episode) for episode in episodes])


# -- policies of others, in a process of their own -------------------------------------------------------------------


def run_foreign(
    setup: Setup,
    file: PolicyFile,
    count: int,
    *stream: Name,
    limits: RunLimits | None = None,
    hidden: Sequence[Path] = (),
    told: Callable[[str], None] = lambda sentence: None,
) -> Iterator[Episode]:
    """Episodes of a policy of others: a process for each, so that what it does to one episode stays there.

    Parameters
    ----------
    setup, count, *stream : as for `episodes_of`
    limits : RunLimits, optional
        `seconds` are those of one answer.
    hidden : sequence of Path
        Folders that it cannot read, wherever they lie.
    told : callable
        Given the isolation of each process in a sentence.

    Raises
    ------
    SceneError
        If the file lies in a hidden folder.
    """
    start = partial(PolicyProcess, file, setup.known, limits or RunLimits(seconds=ANSWER_S), hidden)
    for number, simulator, observation in _started(setup, count, stream):
        policy = _Started(start, told)
        try:
            yield run_episode(simulator, policy, observation, number)
        finally:
            policy.close()


class _Started:
    """Policy whose process starts with the first observation, so that a faulty start loses the episode alone."""

    def __init__(self, start: Callable[[], PolicyProcess], told: Callable[[str], None]) -> None:
        self._start, self._told = start, told
        self._process: PolicyProcess | None = None

    def act(self, observation: Observation) -> Action:
        """Command of the next step."""
        if self._process is None:
            self._process = self._start()
            self._told(self._process.isolation.sentence())
        return self._process.act(observation)

    def close(self) -> None:
        """End the process, if there is one."""
        if self._process is not None:
            self._process.close()
