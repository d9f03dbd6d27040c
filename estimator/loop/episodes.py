"""Episodes of a policy: one row each, however the policy ends."""

from __future__ import annotations

import ast
import math
import multiprocessing
import runpy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, cast

import polars as pl

from phibench.estimator.geometry.rig_parameters import drawn_deviation
from phibench.estimator.loop.belief import Belief, require_filter
from phibench.estimator.loop.policies import BELIEVING, POLICIES, Policy
from phibench.estimator.loop.simulator import REACHED, RUNNING, Action, Known, Observation, Setup, Simulator
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.validation import SceneError, nearest

LOST = "policy failed"
_STARTUP_S = 60.0  # a process that imports on a busy machine


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


def episodes_of(setup: Setup, policy: str, count: int, *stream: Name, own_rigs: bool = False) -> Iterator[Episode]:
    """Episodes of a built-in policy, in this process, one after the other.

    Parameters
    ----------
    setup : Setup
    policy : str
    count : int
    *stream : names
    own_rigs : bool
        Every episode has a true rig of its own, drawn from the covariance of the setup.

    Raises
    ------
    SceneError
        If there is no such policy, or it needs a package that is not installed.
    """
    if policy not in POLICIES:
        raise SceneError(f"policy '{policy}': {nearest(policy, POLICIES)}")
    if policy in BELIEVING:
        require_filter()  # else each episode would count as one that the policy has lost
    return (
        run_episode(simulator, POLICIES[policy](setup.known, simulator), observation, number)
        for number, simulator, observation in _started(setup, count, stream, own_rigs)
    )


def with_own_rig(setup: Setup, *stream: Name) -> Setup:
    """Setup whose true rig is drawn from its covariance; as it is without one."""
    if setup.rig_covariance is None:
        return setup
    return replace(setup, misalignment=drawn_deviation(setup.rig_covariance, generator(*stream, "rig")))


def _started(
    setup: Setup, count: int, stream: Sequence[Name], own_rigs: bool
) -> Iterator[tuple[int, Simulator, Observation]]:
    """Number, simulator and first observation of each episode."""
    simulator = Simulator(setup)
    for number in range(count):
        if own_rigs:
            simulator = Simulator(with_own_rig(setup, *stream, number))
        yield number, simulator, simulator.start(*stream, number)


def episode_frame(episodes: Sequence[Episode]) -> pl.DataFrame:
    """A row per episode."""
    return pl.DataFrame([asdict(episode) for episode in episodes])


# -- policies of others, in a process of their own -------------------------------------------------------------------


@dataclass(frozen=True)
class PolicyFile:
    """Function of a Python file that makes a policy of what is known.

    Parameters
    ----------
    path : Path
    name : str
    """

    path: Path
    name: str

    @classmethod
    def of(cls, text: str) -> PolicyFile:
        """From FILE.py:NAME.

        Raises
        ------
        SceneError
            If there is no such file, or no name is given.
        """
        path, _, name = text.rpartition(":")
        if not path.endswith(".py") or not name.isidentifier():
            raise SceneError(
                f"policy '{text}': give FILE.py:NAME, NAME being a function from what is known to a policy"
            )
        if not Path(path).is_file():
            raise SceneError(f"policy '{text}': there is no file {path}; give the path of a Python file")
        if name not in (there := _names(Path(path))):
            raise SceneError(f"policy '{text}': {Path(path).name} has no {name}; {nearest(name, sorted(there))}")
        return cls(Path(path).resolve(), name)

    def __call__(self, known: Known) -> Policy:
        """Policy for an episode; the file is run in the process of the policy."""
        content = runpy.run_path(str(self.path))
        if not callable(content.get(self.name)):
            raise SceneError(f"{self.path.name} has no function {self.name}")
        policy = content[self.name](known)
        if not callable(getattr(policy, "act", None)):
            raise SceneError(f"{self.name} gave {type(policy).__name__}, which has no function act(observation)")
        return cast(Policy, policy)


def _names(path: Path) -> set[str]:
    """Names that a Python file defines or imports; it is read, not run.

    Raises
    ------
    SceneError
        If it is no Python.
    """
    try:
        tree = ast.parse(path.read_bytes())
    except (SyntaxError, ValueError) as error:
        raise SceneError(f"{path} is no Python file: {error}") from error
    found: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            found |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found |= {target.id for target in targets if isinstance(target, ast.Name)}
    return found


class PolicyProcess:
    """Policy that runs in a process of its own, which is ended when an answer takes too long.

    Parameters
    ----------
    factory : callable
        From `Known` to a policy; importable, because it is named to the process.
    known : Known
    limit_s : float
        Time for one answer.
    """

    def __init__(self, factory: Callable[[Known], Policy], known: Known, limit_s: float = 5.0) -> None:
        context = multiprocessing.get_context("spawn")
        self._limit_s = limit_s
        self._end, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, factory, known), daemon=True)
        self._process.start()
        other.close()
        self._receive(_STARTUP_S, "start")

    def act(self, observation: Observation) -> Action:
        """Command of the next step.

        Raises
        ------
        SceneError
            If the policy raised, ended its process, or did not answer in time.
        """
        self._end.send(observation)
        answer = self._receive(self._limit_s, "answer")
        return Action(*answer)

    def close(self) -> None:
        """End the process."""
        if not self._end.closed:
            self._process.kill()
            self._process.join()
            self._end.close()

    def _receive(self, limit_s: float, what: str) -> Any:
        if not self._end.poll(limit_s):
            self.close()
            raise SceneError(f"the policy did not {what} within {limit_s:g} s: its process was ended")
        try:
            kind, content = self._end.recv()
        except (EOFError, OSError) as error:
            self.close()
            raise SceneError("the policy ended its own process") from error
        if kind == "raised":
            raise SceneError(f"the policy raised {content}")
        return content


def _serve(end: Connection, factory: Callable[[Known], Policy], known: Known) -> None:
    """Answer observations until the other end closes."""
    try:
        policy = factory(known)
        end.send(("ready", ()))
        while True:
            action = policy.act(end.recv())
            if not isinstance(action, tuple) or len(action) != len(Action._fields):
                raise SceneError(f"act answered {type(action).__name__}, not an Action; give simulator.Action(...)")
            end.send(("action", tuple(action)))
    except (EOFError, BrokenPipeError):
        return
    except Exception as error:  # told to the other side, in one line
        end.send(("raised", f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"))


def run_foreign(
    setup: Setup,
    factory: Callable[[Known], Policy],
    count: int,
    *stream: Name,
    limit_s: float = 5.0,
    own_rigs: bool = False,
) -> Iterator[Episode]:
    """Episodes of a policy of others: a process for each, so that what it does to one episode stays there."""
    for number, simulator, observation in _started(setup, count, stream, own_rigs):
        policy = _Started(factory, setup.known, limit_s)
        try:
            yield run_episode(simulator, policy, observation, number)
        finally:
            policy.close()


class _Started:
    """Policy whose process starts with the first observation, so that a faulty start loses the episode alone."""

    def __init__(self, factory: Callable[[Known], Policy], known: Known, limit_s: float) -> None:
        self._factory, self._known, self._limit_s = factory, known, limit_s
        self._process: PolicyProcess | None = None

    def act(self, observation: Observation) -> Action:
        """Command of the next step."""
        if self._process is None:
            self._process = PolicyProcess(self._factory, self._known, self._limit_s)
        return self._process.act(observation)

    def close(self) -> None:
        """End the process, if there is one."""
        if self._process is not None:
            self._process.close()
