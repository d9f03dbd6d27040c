"""Commands `phibench film ...` and `phibench loop ...`: films of the stroke, and episodes of a robot that drives."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from phibench.cli.options import (
    DATA,
    SENSOR,
    FilmFolder,
    Flag,
    OutFolder,
    Preset,
    Variant,
    Whole,
    Workers,
    policies,
    recipes,
)

if TYPE_CHECKING:
    from phibench.robot.loop.episodes import Episode
    from phibench.robot.loop.simulator import Setup

film = App(name="film", group=DATA, help="Make, check and show films of the stroke.")


@film.command
def make(
    recipe: Annotated[str, Parameter(completer=recipes(films=True))],
    *,
    out: OutFolder,
    workers: Workers = None,
    dry_run: bool = False,
    variant: Variant = None,
) -> int:
    """Make the films of a recipe with [film]; what is finished already is kept.

    Parameters
    ----------
    recipe
        TOML file, or the name of a shipped recipe.
    dry_run
        Say what will be made, how many bytes and how long it takes; render nothing.
    """
    if dry_run:
        from phibench.datasets.film.film_forecast import dry_run as lines

        for line in lines(recipe, out, workers):
            print(line)
        return 0
    from phibench.datasets.film.film_make import make_films

    made = make_films(recipe, out, workers)
    print(f"{out}: films made: {len(made.made)}, kept: {len(made.kept)}")
    return 0


@film.command
def verify(directory: FilmFolder) -> int:
    """Check every file of a data set of films; exit code 1 if there is a fault."""
    from phibench.datasets.film.film_store import verify as verify_films

    faults = verify_films(directory)
    for fault in faults:
        print(fault)
    print(f"{directory}: faults: {len(faults)}")
    return 1 if faults else 0


@film.command
def show(
    directory: FilmFolder, *, name: str | None = None, preset: Preset = "mjpeg", draw: int = 0, out: Path | None = None
) -> int:
    """Print a table of films and write one of them as an MP4 with overlays.

    Parameters
    ----------
    name
        Id of the film; the first one by default.
    preset
        Sensor preset of its frames.
    draw
        Draw of the noise.
    out
        MP4 to write; the film's id with .mp4 in the folder by default.
    """
    from phibench.datasets.film.film_read import open_films
    from phibench.datasets.film.film_show import show_film

    films = open_films(directory)
    print(f"{'film':32s} {'frames':>6s} {'region px':>11s} {'key views':>9s} {'of noise':>8s}")
    for one in films:
        info, ratios = one.info, (one.info.pixel_ratio or 0.0, one.info.position_ratio or 0.0)
        size = f"{info.width_px} x {info.height_px}"
        print(f"{info.film:32s} {info.frames:6d} {size:>11s} {len(info.keys_m):9d} {max(ratios):8.3f}")
    chosen = films[name or next(iter(films.plans))]
    path = show_film(chosen, out or directory / f"{chosen.info.film}.mp4", preset, draw)
    print(f"{path}: {len(chosen)} frames, preset {preset}; the green cross is around the exact place of the spot")
    return 0


@Parameter(name="*")
@dataclass(frozen=True)
class FilmOptions:
    """Frames that the experiments take.

    Parameters
    ----------
    preset
        Sensor preset.
    on
        Most frames of a burst, at each end, with the laser on.
    off
        Most frames of a burst, at each end, with the laser off.
    cameras
        Cameras, each with a fixed pattern that nobody knows.
    jpeg_quality
        Of mjpeg.
    stroke
        Fit the whole stroke as well.
    """

    preset: Literal["bayer-raw", "mjpeg"] = "bayer-raw"
    on: Whole = 30
    off: Whole = 30
    cameras: Whole = 1
    jpeg_quality: Whole = 76
    stroke: bool = True


_BURSTS = FilmOptions()


@film.command
def experiments(
    directory: FilmFolder, *, calibration: Path, bursts: FilmOptions = _BURSTS, out: Path | None = None
) -> int:
    """Depth of every film with rigs that calibrate themselves: bursts at both ends, and the whole stroke.

    Parameters
    ----------
    calibration
        Data set of the same rigs with an experiment "calibration", as the recipe paper-misaligned has it.
    out
        Parquet file for the rows.
    """
    from phibench.datasets.common.progress import Steps, progress_console
    from phibench.datasets.film.film_read import open_films
    from phibench.datasets.read import open_finished
    from phibench.datasets.store.files import require_writable, write_atomic
    from phibench.studies.paper.film_experiments import FilmProcedure, closure_interval, run_film_experiments, summary

    if out is not None:
        require_writable(out)
    numbers = {"jpeg_quality": bursts.jpeg_quality} if bursts.preset == "mjpeg" else None
    procedure = FilmProcedure(bursts.preset, bursts.on, bursts.off, bursts.cameras, bursts.stroke, numbers)
    films = open_films(directory)
    with Steps(progress_console(), "films", len(films)) as steps:
        rows = run_film_experiments(films, open_finished(calibration), procedure, told=steps.advance)
    print(
        f"{'way':8s} {'films':>5s} {'rms':>8s} {'predicted':>9s} {'pixels':>8s} {'ratio':>6s} {'95 % if right':>14s} "
        f"{'one lower end':>14s} {'pull':>6s} {'within 95 %':>11s} {'gain':>6s}"
    )
    for row in summary(rows).iter_rows(named=True):
        mine = rows.filter(rows["way"] == row["way"])
        apart, together = ("{:.2f} to {:.2f}".format(*closure_interval(mine, common)) for common in (False, True))
        print(
            f"{row['way']:8s} {row['films']:5d} {row['rms']:8.3%} {row['predicted']:9.3%} {row['pixels']:8.3%} "
            f"{row['rms'] / row['predicted']:6.2f} {apart:>14s} {together:>14s} "
            f"{row['pull']:6.2f} {row['within_95']:11.1%} {row['gain']:6.2f}"
        )
    if out is not None:
        write_atomic(out, rows.write_parquet)
        print(f"{out}: {len(rows)} rows")
    return 0


@film.command
def track(
    directory: Path,
    *,
    preset: Preset = "bayer-raw",
    draw: int = 0,
    camera_seed: Whole = 0,
    phase: Literal["known", "unknown"] = "known",
) -> int:
    """Find the target of every film among all lights of the whole images, by its blink code.

    D and its standard deviation are those of a target that rests before a robot that stands and moves its carriage;
    nan where its frames do not give them. Exit code 1 if a target was not found.

    Parameters
    ----------
    directory
        Folder of films with view = "full".
    preset
        Sensor preset of the frames.
    draw
        Draw of the noise.
    camera_seed
        Of the fixed pattern.
    phase
        "known" if the robot switches the laser itself; "unknown" takes longer.
    """
    from phibench.datasets.film.film_read import open_films
    from phibench.robot.film.film_estimates import found_rows, track_film

    missed = 0
    heads = ("lock s", "u px", "v px", "off px", "lost", "lights", "D m", "+- m")
    head = f"{'film':32s} {'target':12s} " + " ".join(f"{head:>8s}" for head in heads)
    for one in open_films(directory):
        rows = found_rows(one, track_film(one, preset, draw, camera_seed, phase == "known"))
        if head:
            print(head)  # not before a film that can be searched
        head = ""
        for row in rows:
            missed += row.fault != ""  # for the exit code: the other films are tracked all the same
            if row.fault:
                print(f"{one.info.film:32s} {row.target:12s} {row.fault}")
                continue
            print(
                f"{one.info.film:32s} {row.target:12s} {row.lock_s:8.2f} {row.uv_px[0]:8.2f} {row.uv_px[1]:8.2f} "
                f"{row.error_px:8.2f} {row.losses:8d} {row.lights:8d} {row.depth_m:8.3f} {row.sigma_m:8.3f}"
            )
    return 1 if missed else 0


@film.command
def frames(
    directory: Path,
    *,
    out: OutFolder,
    preset: Literal["mjpeg", "yuyv"] = "mjpeg",
    draws: Whole = 1,
    camera_seed: Whole = 0,
    container: Literal["avi", "mkv", "mp4"] = "mkv",
    lerobot: Flag = False,
    workers: Workers = None,
) -> int:
    """Write the camera's own frames of whole images, one video per film and draw; the frames' bytes are untouched.

    Parameters
    ----------
    directory
        Folder of films with view = "full".
    preset
        What the camera sends.
    draws
        Draws of the noise, each a video.
    camera_seed
        Videos of one seed share the fixed pattern.
    container
        Format of the file.
    lerobot
        Lay videos, a Parquet row a frame and info.json out as a LeRobot data set (v3.0): an episode a film and draw.
    """
    from phibench.datasets.common.errors import DatasetError
    from phibench.datasets.film.film_video import write_lerobot, write_videos

    if lerobot:
        if preset != "mjpeg":
            raise DatasetError("--lerobot writes the camera's JPEGs: leave --preset out")
        written = write_lerobot(directory, out, draws, camera_seed, workers)
        print(f"{written}: read it with LeRobotDataset('phibench/films', root='{out}')")
        return 0

    paths = write_videos(directory, out, preset, draws, camera_seed, f".{container}", workers=workers)
    print(f"{out}: {len(paths)} videos")
    return 0


# -- episodes of a robot ----------------------------------------------------------------------------------------------

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
    from phibench.benchmark.isolation.method_references import RunLimits
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
            setup,
            PolicyFile.of(policy),
            episodes,
            seed,
            limits=limits,
            hidden=hidden,
            told=isolations.add,
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
    from phibench.benchmark.isolation.method_references import RunLimits
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
