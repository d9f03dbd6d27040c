"""Commands `phibench loop ...`: rooms baked for a robot that drives up to a target, and its episodes run and shown."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from phibench.cli.options import SENSOR, OutFolder, Whole, Workers, policies

if TYPE_CHECKING:
    from phibench.robot.loop.episodes import Episode
    from phibench.robot.loop.simulator import Setup

loop = App(name="loop", group=SENSOR, help="A robot that finds a target and drives up to it: rooms, episodes, films.")


@Parameter(name="*")
@dataclass(frozen=True)
class RobotOptions:
    """The robot: its rooms, its sight and its rig.

    Parameters
    ----------
    setting
        Lights, distances, power, rig, slip and rooms: easy, default or hard; what follows is put in its place.
    rooms
        Folder of `phibench loop bake`; without it each episode has a plain room of its own.
    fidelity
        Spots by the exact measurement model, or read in pixels: windows around spots, or whole frames, 2 CPU-s each.
    distance_m
        Least and largest distance of targets, in metres.
    calibration
        File of `phibench calibrate`: the robot knows this rig to its covariance, from which each episode's is drawn.
    as_built
        The same with a rig as built by hand: its errors are so many times those of `RigParameter.prior_sigma`.
    """

    setting: Literal["easy", "default", "hard"] = "default"
    rooms: Path | None = None
    fidelity: Literal["exact", "windows", "frames"] = "exact"
    distance_m: tuple[float, float] | None = None
    calibration: Path | None = None
    as_built: float | None = None

    def setup(self) -> Setup:
        """The same for the simulator.

        Raises
        ------
        DatasetError
            If a calibration is given together with `as_built`, or cannot be read.
        SceneError
            If `as_built` is not between 0 and 2, or a number of the task is out of range.
        """
        import numpy as np

        from phibench.calibration.rig.calibration_file import read_calibration
        from phibench.datasets.common.errors import DatasetError
        from phibench.estimator.geometry.rig_parameters import prior_sigmas
        from phibench.robot.loop.arena import baked_arenas
        from phibench.robot.loop.episodes import named_setup
        from phibench.scenes.validation import within

        chosen = named_setup(self.setting)
        nominal, covariance = chosen.rig, chosen.rig_covariance  # None: the rig is known exactly
        if self.calibration is not None:
            if self.as_built is not None:
                raise DatasetError("--calibration and --as-built: both say how well the rig is known; give one of them")
            read = read_calibration(self.calibration)
            nominal, covariance = read.rig, read.covariance
        elif self.as_built is not None:
            covariance = within("loop", "as_built", self.as_built, 0.0, 2.0) ** 2 * np.diag(prior_sigmas() ** 2)
        return replace(
            chosen,
            rig=nominal,
            arenas=chosen.arenas if self.rooms is None else baked_arenas(self.rooms),
            fidelity=self.fidelity,
            rig_covariance=covariance,
            own_rigs=covariance is not None,
            task=chosen.task if self.distance_m is None else replace(chosen.task, distances_m=self.distance_m),
        )


_ROBOT = RobotOptions()


@loop.command
def bake(*, out: OutFolder, rooms: Whole = 5, seed: str = "rooms", workers: Workers = None) -> int:
    """Bake the light of generated rooms, so that a robot's camera can stand anywhere in them.

    A room in which no target can be driven to is drawn again.

    Parameters
    ----------
    rooms
        Number of rooms; one takes some 20 CPU-s.
    seed
        Name of the stream that the rooms are drawn from.
    """
    from phibench.datasets.common.errors import whole_number
    from phibench.datasets.film.moving_camera import bake_rooms
    from phibench.robot.loop.arena import offers_targets

    whole_number("--rooms", rooms, 1)
    print(f"{out}: {bake_rooms(out, rooms, seed, fits=offers_targets, workers=workers)} rooms")
    return 0


@loop.command
def run(
    policy: Annotated[str, Parameter(completer=policies)] = "paper",
    *,
    episodes: Whole = 10,
    robot: RobotOptions = _ROBOT,
    seed: str = "run",
    seconds: float = 5.0,
    out: Path | None = None,
) -> int:
    """Run episodes of a policy and print a row for each; exit code 1 if the policy failed in any.

    Parameters
    ----------
    policy
        paper, greedy, drive-only, random or oracle; or FILE.py:NAME, a function from what is known to a policy.
    episodes
        Number of episodes.
    seed
        Name of the stream that targets, lights and noise are drawn from.
    seconds
        Time that a policy of yours has for one answer.
    out
        Parquet file for the rows.
    """
    from phibench.benchmark.isolation.run_limits import RunLimits
    from phibench.datasets.common.errors import whole_number
    from phibench.datasets.common.progress import Steps, progress_console
    from phibench.datasets.store.files import require_writable, write_atomic
    from phibench.robot.loop.episodes import LOST, episode_frame, episodes_of, run_foreign
    from phibench.robot.loop.foreign_policies import PolicyFile

    whole_number("--episodes", episodes, 1)
    if out is not None:
        require_writable(out)
    setup = robot.setup()
    isolations = set[str]()
    if ".py" in policy:
        # it must not look rooms up
        limits, hidden = RunLimits(seconds=seconds), [robot.rooms] if robot.rooms is not None else []
        running = run_foreign(
            setup, PolicyFile.of(policy), episodes, seed, limits=limits, hidden=hidden, told=isolations.add
        )
    else:
        running = episodes_of(setup, policy, episodes, seed)
    rows = []
    with Steps(progress_console(), "episodes", episodes) as steps:
        for row in running:
            rows.append(row)
            steps.advance()
    _print(rows)
    for sentence in sorted(isolations):
        print(sentence)
    if out is not None:
        write_atomic(out, episode_frame(rows).write_parquet)
        print(f"{out}: {len(rows)} rows")
    return 1 if any(row.outcome == LOST for row in rows) else 0  # LOST: the policy failed, not its episode


@loop.command(name="show")
def show_loop(
    policy: Annotated[str, Parameter(completer=policies)] = "paper",
    *,
    out: Path,
    robot: RobotOptions = _ROBOT,
    seed: str = "show",
    episode: Whole = 0,
    seconds: float = 5.0,
) -> int:
    """Write an episode as an MP4: what the camera sees, the room from above, and what the robot believes.

    Parameters
    ----------
    policy
        paper, greedy, drive-only, random or oracle; or FILE.py:NAME, as for `phibench loop run`.
    out
        MP4 to write.
    seed
        Name of the stream that targets, lights and noise are drawn from.
    episode
        Number of the episode in that stream.
    seconds
        Time that a policy of yours has for one answer.
    """
    from phibench.benchmark.isolation.run_limits import RunLimits
    from phibench.datasets.common.errors import whole_number
    from phibench.datasets.common.progress import Steps, progress_console
    from phibench.datasets.store.files import require_writable
    from phibench.robot.loop.foreign_policies import PolicyFile, PolicyProcess
    from phibench.studies.loop.drawings import show_episode

    whole_number("--episode", episode)
    require_writable(out)
    setup = robot.setup()
    with ExitStack() as ends:
        chosen: str | PolicyProcess = policy
        if ".py" in policy:
            limits, hidden = RunLimits(seconds=seconds), [robot.rooms] if robot.rooms is not None else []
            chosen = PolicyProcess(PolicyFile.of(policy), setup.known, limits, hidden)
            ends.callback(chosen.close)
        most = math.ceil(setup.task.longest_s / setup.task.step_s) + 1
        with Steps(progress_console(), "pictures, at most", most) as steps:
            outcome = show_episode(setup, out, chosen, seed, episode, told=steps.advance)
    print(f"{out}: {outcome}")
    return 0


def _print(rows: list[Episode]) -> None:
    from phibench.robot.loop.episodes import loop_score

    print(f"{'episode':>7s} {'outcome':18s} {'s':>5s} {'m':>5s} {'strokes':>7s} {'D m':>6s} {'stated m':>8s}  cause")
    for row in rows:
        stated = f"{row.stated_m:.3f}" if math.isfinite(row.stated_m) else "-"
        print(
            f"{row.number:7d} {row.outcome:18s} {row.time_s:5.1f} {row.driven_m:5.2f} {row.strokes:7d} "
            f"{row.distance_m:6.3f} {stated:>8s}  {row.cause}".rstrip()
        )
    for row in rows:
        if row.refused:
            print(f"episode {row.number}: refused {row.refused}")
    print(loop_score(rows).sentence())
