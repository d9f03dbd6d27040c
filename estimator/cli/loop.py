"""Commands `phibench loop ...`: rooms for a robot that drives, and episodes of a policy."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cyclopts import App

from phibench.estimator.cli.options import SENSOR, Whole

if TYPE_CHECKING:
    from phibench.estimator.loop.episodes import Episode
    from phibench.estimator.loop.simulator import Setup

loop = App(name="loop", group=SENSOR, help="A robot that finds a target and drives up to it: rooms, episodes, films.")

Fidelity = Literal["exact", "windows", "frames"]


@loop.command
def bake(*, out: Path, rooms: Whole = 5, seed: str = "rooms", workers: Whole | None = None) -> int:
    """Bake the light of generated rooms, so that a robot's camera can stand anywhere in them.

    Parameters
    ----------
    out
        Folder to write.
    rooms
        Number of rooms; one takes some 20 CPU-s.
    seed
        Name of the stream that the rooms are drawn from.
    workers
        Number of processes; one for each core by default.
    """
    from phibench.datasets.film.moving_camera import bake_rooms

    print(f"{out}: {bake_rooms(out, rooms, seed, workers=workers)} rooms")
    return 0


@loop.command
def run(
    policy: str = "paper",
    *,
    episodes: Whole = 10,
    rooms: Path | None = None,
    fidelity: Fidelity = "exact",
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
    rooms
        Folder of `phibench loop bake`; without it each episode has a plain room of its own.
    fidelity
        Spots by the exact measurement model, or read in pixels: windows around spots, or whole frames.
    seed
        Name of the stream that targets, lights and noise are drawn from.
    seconds
        Time that a policy of yours has for one answer.
    out
        Parquet file for the rows.
    """
    from phibench.datasets.store.files import require_writable
    from phibench.estimator.loop.episodes import LOST, PolicyFile, episode_frame, run_episodes, run_foreign

    if out is not None:
        require_writable(out)
    setup = _setup(rooms, fidelity)
    if ".py" in policy:
        rows = list(run_foreign(setup, PolicyFile.of(policy), episodes, seed, limit_s=seconds))
    else:
        rows = run_episodes(setup, policy, episodes, seed)
    _print(rows)
    if out is not None:
        episode_frame(rows).write_parquet(out)
        print(f"{out}: {len(rows)} rows")
    return 1 if any(row.outcome == LOST for row in rows) else 0


@loop.command
def show(
    policy: Literal["paper", "greedy", "drive-only"] = "paper",
    *,
    out: Path,
    rooms: Path | None = None,
    fidelity: Fidelity = "exact",
    seed: str = "show",
    episode: Whole = 0,
) -> int:
    """Write an episode as an MP4: what the camera sees, the room from above, and what the robot believes.

    Parameters
    ----------
    policy
        Of the robot.
    out
        MP4 to write.
    rooms
        Folder of `phibench loop bake`; without it the episode has a plain room, in which only spots are seen.
    fidelity
        With --rooms: windows around spots, or whole frames, which take 2 CPU-s each.
    seed
        Name of the stream that targets, lights and noise are drawn from.
    episode
        Number of the episode in that stream.
    """
    from phibench.datasets.store.files import require_writable
    from phibench.estimator.studies.loop.drawings import show_episode

    require_writable(out)
    print(f"{out}: {show_episode(_setup(rooms, fidelity), out, policy, seed, episode)}")
    return 0


def _setup(rooms: Path | None, fidelity: Fidelity) -> Setup:
    from phibench.estimator.loop.arena import baked_arenas
    from phibench.estimator.loop.simulator import Setup

    return Setup(arenas=() if rooms is None else baked_arenas(rooms), fidelity=fidelity)


def _print(rows: list[Episode]) -> None:
    print(f"{'episode':>7s} {'outcome':18s} {'s':>5s} {'m':>5s} {'strokes':>7s} {'D m':>6s} {'stated m':>8s} cause")
    for row in rows:
        print(
            f"{row.number:7d} {row.outcome:18s} {row.time_s:5.1f} {row.driven_m:5.2f} {row.strokes:7d} "
            f"{row.distance_m:6.3f} {row.stated_m:8.3f} {row.cause}"
        )
    for row in rows:
        if row.refused:
            print(f"episode {row.number}: refused {row.refused}")
    print(f"reached: {sum(row.reached for row in rows)} of {len(rows)}")
