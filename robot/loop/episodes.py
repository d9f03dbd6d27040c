"""Episodes of a policy: one row each, however the policy ends."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import polars as pl

from phibench.benchmark.isolation.resolve import RunLimits
from phibench.robot.loop.belief import Belief, require_filter
from phibench.robot.loop.foreign_policies import ANSWER_S, PolicyFile, PolicyProcess
from phibench.robot.loop.policies import BELIEVING, POLICIES, Policy
from phibench.robot.loop.simulator import REACHED, RUNNING, Action, Known, Observation, Setup, Simulator
from phibench.scenes.random_streams import Name
from phibench.scenes.validation import SceneError, nearest

LOST = "policy failed"


@dataclass(frozen=True)
class Episode:
    """Result of one episode.

    Attributes
    ----------
    number : int
    outcome : str
        Of `simulator`, or `LOST` where the policy failed.
    cause : str
        One sentence for an episode that was not reached; empty for one that was.
    time_s, driven_m : float
    strokes : int
    shortest_m : float
        Straight way from the start to the stand-off distance.
    distance_m, stated_m, sigma_m : float
        True D at the end, what was stated, and the belief's standard deviation; NaN where there is none.
    locked_s : float
        Time of the first lock; NaN without one.
    pull : float
        Error of the inverse distance over its standard deviation, at the end; NaN without a belief.
    nees : float
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
    setup : Setup
    policy : str
    count : int
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
    file : PolicyFile
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
