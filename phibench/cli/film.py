"""Commands `phibench film ...`: make, check and show films of the stroke, measure D, track targets, write videos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from phibench.cli.options import DATA, FilmFolder, Flag, OutFolder, Preset, Variant, Whole, Workers, recipes

film = App(name="film", group=DATA, help="Make, check and show films of the stroke.")


@film.command
def make(
    recipe: Annotated[str, Parameter(completer=recipes(films=True))],
    *,
    out: OutFolder,
    workers: Workers = None,
    dry_run: bool = False,
    variant: Variant = None,  # its converter sets PHIBENCH_VARIANT
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
        from phibench.datasets.film.film_forecast import forecast_lines as lines

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
    from phibench.datasets.film.film_store import verify_films as verify_films

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
    from phibench.datasets.film.film_preview import show_film
    from phibench.datasets.film.film_read import open_films

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
