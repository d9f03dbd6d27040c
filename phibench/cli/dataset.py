"""Commands `phibench dataset ...`: make, repair, merge, check, show data sets; frames, panoramas, sensitivities."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Parameter

from phibench.cli.options import (
    DEFAULT_PRESET,
    START,
    DataFolder,
    Flag,
    OneSample,
    OutFolder,
    OwnOrPreset,
    Scheduler,
    Variant,
    Whole,
    Workers,
    pictures,
    recipes,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from phibench.datasets.frames.frame_request import FrameOptions
    from phibench.datasets.read import Sample

dataset = App(name="dataset", group=START, help="Make, check and show data sets; draw frames and panoramas.")


@Parameter(name="*")
@dataclass(frozen=True)
class ProcessOptions:
    """Processes that render.

    Parameters
    ----------
    wait_for_workers
        With --scheduler: wait so many seconds at most until its file is there and a worker has come.
    """

    workers: Workers = None
    scheduler: Scheduler = None
    wait_for_workers: Whole | None = None

    def wait(self) -> None:
        """Wait for a scheduler's workers.

        Raises
        ------
        DatasetError
            If none comes in time.
        """
        if self.wait_for_workers is not None and self.scheduler is not None:
            from phibench.datasets.build.workers import wait_for_workers as wait

            wait(self.scheduler, self.wait_for_workers)


@Parameter(name="*")
@dataclass(frozen=True)
class RecipeOptions:
    """Part of a recipe that is made.

    Parameters
    ----------
    shard
        Part of the recipe for job arrays, such as 1/8; put the parts together with `merge`.
    samples
        How many samples to draw, instead of the recipe's number.
    seed
        Root of all random streams, instead of the recipe's. Other users of the machine see it in the list of processes.
    secret_seed
        File of a root of 128 bits, for a set that is to be sealed; it is drawn if the file is not there.
    replace
        Delete or make again finished work that does not fit, of another seed or recipe; what fits is kept.
    room_files
        Folder of the panoramas and meshes that the recipe names; the recipe's own by default.
    leave_out_refused
        Finish the data set without the samples that are refused; dataset.json lists them with their causes.
    """

    shard: str | None = None
    samples: Whole | None = None
    seed: Whole | None = None
    secret_seed: Path | None = None
    replace: Flag = False
    room_files: Path | None = None
    leave_out_refused: Flag = False

    def keywords(self, *, make_seed: bool) -> Any:
        """Keywords of `make`; the seed of a file, which is made if it is not there and may be."""
        given = dict(vars(self))
        if (secret := given.pop("secret_seed")) is not None:
            given["seed"] = _secret(secret, self.seed, make_seed)
        return given


_PROCESSES, _WHOLE_RECIPE = ProcessOptions(), RecipeOptions()


@dataset.command
def make(
    recipe: Annotated[str, Parameter(completer=recipes(films=False))],
    *,
    out: Path,
    processes: ProcessOptions = _PROCESSES,
    wanted: RecipeOptions = _WHOLE_RECIPE,
    dry_run: bool = False,
    variant: Variant = None,  # its converter sets PHIBENCH_VARIANT
) -> int:
    """Render a data set; what is finished already is kept. Sensitivities of D come last, sensitivities.parquet.

    Parameters
    ----------
    recipe
        TOML file, or the name of a shipped recipe ("paper", "paper-misaligned", "random", "smoke", ...).
    out
        Folder to write; one with finished work that would be lost is refused, and one with more samples keeps them.
    dry_run
        Say what will be seen, where and why not, how many tasks, bytes and seconds it takes; render nothing.
    """
    given = wanted.keywords(make_seed=not dry_run)
    if processes.wait_for_workers is not None and processes.scheduler is None:
        from phibench.datasets.common.errors import DatasetError

        raise DatasetError("--wait-for-workers is about workers of a scheduler: give --scheduler too")
    if dry_run:
        from phibench.datasets.make import dry_run as dry_run_text

        print(dry_run_text(recipe, out, processes.workers, **given))
        return 0
    from phibench.benchmark.make_dataset import make as make_dataset

    processes.wait()
    make_dataset(recipe, out, processes.workers, scheduler=processes.scheduler, **given)
    return 0


def _secret(path: Path, seed: int | None, make_it: bool) -> int | None:
    """Seed of a file; a dry run draws none, and takes the recipe's."""
    from phibench.benchmark.sealed.sealed_set import secret_seed as seed_of
    from phibench.datasets.common.errors import DatasetError

    if seed is not None:
        raise DatasetError("--seed and --secret-seed are two seeds: give one of them")
    return seed_of(path, make_it)


@dataset.command
def repair(directory: DataFolder, *, workers: Workers = None, scheduler: Scheduler = None) -> int:
    """Render again what is damaged or missing in a data set."""
    from phibench.benchmark.make_dataset import repair as repair_dataset

    for name in repair_dataset(directory, workers, scheduler=scheduler):
        print(f"made again: {name}")
    return 0


@dataset.command
def merge(*shards: Path, out: OutFolder) -> int:
    """Put the shards of a data set together.

    Parameters
    ----------
    shards
        Folders of all shards.
    """
    from phibench.benchmark.make_dataset import merge as merge_shards

    merge_shards(out, shards)
    return 0


@dataset.command
def verify(
    directory: Path,
    *,
    mitsuba: Whole | None = None,
    workers: Workers = None,
    json: Annotated[bool, Parameter(negative="", help="The outcome as one JSON document.")] = False,
) -> int:
    """Check every file, hash, row and certificate of a data set; exit code 1 if there is a fault.

    Parameters
    ----------
    directory
        Folder of a data set, of an export, of a frames set, dense or sealed ones, too, or of several exports.
    mitsuba
        Also compare so many samples with Mitsuba's path tracer: light, outline, and the spot's flux and centroid.
    """
    from dataclasses import replace
    from json import dumps

    from phibench.benchmark.export.export_make import is_export, verify_export
    from phibench.datasets.common.parallel import worker_count
    from phibench.datasets.verify import verify as verify_dataset

    count = worker_count(workers)
    if is_export(directory):
        if mitsuba is not None:
            from phibench.datasets.common.errors import DatasetError

            raise DatasetError(
                f"{directory} is an export: --mitsuba renders the samples of a data set; name its folder"
            )
        wrong = verify_export(directory)
        closing = f"{directory}: {len(wrong)} fault{'s' * (len(wrong) != 1)}"
        print(dumps({"faults": list(wrong), "valid": not wrong}) if json else "\n".join([*wrong, closing]))
        return 1 if wrong else 0
    report = verify_dataset(directory, workers=count)
    if mitsuba is not None and report.ok:
        faults, notes = _by_mitsuba(directory, mitsuba, silent=json)
        report = replace(report, faults=faults, notes=(*report.notes, *notes))
    if json:
        print(dumps({**vars(report), "valid": report.ok}))
        return 0 if report.ok else 1
    for fault in report.faults:
        print(fault)
    for note in report.notes:
        print(f"note: {note}")
    found = len(report.faults)
    print(f"{directory}: {report.files} files, {report.samples} samples, {found} fault{'s' * (found != 1)}")
    return 0 if report.ok else 1


def _by_mitsuba(directory: Path, count: int, *, silent: bool) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Faults and notes by Mitsuba's path tracer; a line is printed for each view as it is done."""
    from phibench.datasets.read import open_dataset
    from phibench.datasets.scene.scene_check import check_sample, chosen_samples

    faults, notes = list[str](), list[str]()
    for sample in chosen_samples(open_dataset(directory), count):
        for checked in check_sample(sample):
            faults += checked.faults
            notes.append(f"Mitsuba: {checked}")
            if not silent:
                print(checked, flush=True)
    return tuple(faults), tuple(notes) if silent else ()


@dataset.command
def show(
    directory: DataFolder,
    *,
    out: Path | None = None,
    sample: str | None = None,
    html: Path | None = None,
    json: Annotated[bool, Parameter(negative="", help="Numbers and rows as one JSON document; no sheet.")] = False,
) -> int:
    """Print a table of a data set and write its contact sheet; or write the interactive page of a sample.

    Parameters
    ----------
    out
        PNG file for the contact sheet; by default contact_sheet.png in the folder.
    sample
        Sample of the page: its number, counted from 0, or its id; the first one by default.
    html
        HTML file for the page of a sample: frames, truth of every pixel, epipolar lines, room and rays in 3-D. Nothing
        else is done then.
    """
    from json import dumps

    from phibench.datasets.common.errors import DatasetError
    from phibench.datasets.show import show as show_dataset
    from phibench.datasets.show import summary

    if json:
        if html is not None or sample is not None or out is not None:
            raise DatasetError("--json prints the data set and writes no file: leave --out, --sample and --html out")
        print(dumps(summary(directory), allow_nan=False))
        return 0
    if html is not None:
        from phibench.datasets.read import open_finished
        from phibench.datasets.sample_page import sample_of, write_sample_page

        page = write_sample_page(sample_of(open_finished(directory), sample), html)
        print(f"{page}: {page.stat().st_size / 1e6:.1f} MB; open it in a browser")
        return 0
    if sample is not None:
        raise DatasetError("--sample is for the page of one sample: name its file too, for example --html sample.html")
    show_dataset(directory, out=out)
    return 0


@Parameter(name="*")
@dataclass(frozen=True)
class DrawOptions:
    """Frames that are drawn, and how they are taken.

    Parameters
    ----------
    draws
        Draws of the noise of every image.
    sample
        Samples: numbers, counted from 0, or ids; all by default.
    exposure
        Seconds, "auto", or "preset" for the preset's time; by default that of the recipe's [frames], else "auto".
    region
        Side in pixels of a square around the spot, instead of the whole image.
    camera_seed
        Names the camera whose fixed pattern the frames share; by default the recipe's cameras.
    """

    draws: Whole = 1
    sample: Annotated[tuple[str, ...], Parameter(consume_multiple=True, negative="")] = ()
    exposure: str | None = None
    region: Whole | None = None
    camera_seed: Whole | None = None
    workers: Workers = None

    def options(self, preset: str, numbers: Mapping[str, Any]) -> FrameOptions:
        """Options of frames; what is not given is the recipe's."""
        from phibench.datasets.frames.frame_request import FrameOptions, exposure_of

        asked: dict[str, Any] = {"region": self.region, "camera_seed": self.camera_seed}
        given = {key: value for key, value in asked.items() if value is not None}
        if self.exposure is not None:
            given["exposure"] = exposure_of(self.exposure)
        return FrameOptions(preset, {**numbers, **given})


_ALL_ONCE = DrawOptions()


@dataset.command
def frames(
    directory: DataFolder,
    *,
    preset: OwnOrPreset = None,
    sensor: Path | None = None,
    out: Path | None = None,
    laser_off: bool = False,
    drawing: DrawOptions = _ALL_ONCE,
) -> int:
    """Draw camera frames with noise, as PNG, JPEG or EXR files with an index; what is there already is kept.

    Parameters
    ----------
    preset
        Where the chain ends: "ideal" (EXR, expected electrons), "mono-raw", "bayer-raw" (PNG of 16 bits that holds
        10-bit DN, not scaled), "srgb8" (PNG), "yuyv" (PNG of Y' and chroma) or "mjpeg" (JPEG; PNG with
        --region). By default that of --sensor, the first that the data set's recipe names, or "mjpeg".
    sensor
        Sensor file of `phibench sensor fit`: its numbers stand for the preset's.
    out
        Folder to write; by default beside the data set, with "-frames" added to its name.
    laser_off
        Also every image without the spot.
    """
    from phibench.datasets.exposures.draw_frames import draw_frames
    from phibench.datasets.frames.sensor_file import read_sensor_file

    file = None if sensor is None else read_sensor_file(sensor)
    named = () if preset or file else _presets_named(directory)
    preset = preset or (file.preset if file else (*named, DEFAULT_PRESET)[0])
    options = drawing.options(preset, {} if file is None else file.numbers)
    given: Any = {"samples": drawing.sample or None, "laser_off": laser_off, "workers": drawing.workers}
    done = draw_frames(directory, options, drawing.draws, out=out, **given)
    others = [f"one that the recipe also names has a folder of its own: --preset {name}" for name in named[1:]]
    for note in (*done.notes, *others):
        print(f"note: {note}")
    print(f"{done.folder}: {done.made} files written, {done.kept} kept, index frames.jsonl and frames.parquet")
    return 0


def _presets_named(directory: Path) -> tuple[str, ...]:
    """Presets of the recipe's `[frames]`."""
    from phibench.datasets.read import open_finished

    frames = open_finished(directory).recipe.frames
    return () if frames is None else tuple(frames.presets)


@Parameter(name="*")
@dataclass(frozen=True)
class ViewOptions:
    """A view of a data set, and the picture of it.

    Parameters
    ----------
    position
        Which of its two views.
    preset
        "layers" (noise-free), or the preset of a frame to draw: "mjpeg" or "srgb8".
    image
        PNG or JPEG to unroll in place of the sample's frame, taken with the same rig.
    """

    sample: OneSample = None
    position: Literal["down", "up"] = "down"
    preset: Annotated[str, Parameter(completer=pictures)] = DEFAULT_PRESET
    image: Path | None = None

    def picture(self, sample: Sample) -> NDArray[Any]:
        """Picture to unroll: a file's, or a frame of the sample."""
        from phibench.calibration.captures.picture_files import read_picture
        from phibench.estimator.geometry.panorama import view_picture

        return (
            view_picture(sample, self.position, self.preset) if self.image is None else read_picture(self.image).pixels
        )


_FIRST_VIEW = ViewOptions()


@dataset.command
def panorama(
    directory: DataFolder,
    *,
    out: Path,
    view: ViewOptions = _FIRST_VIEW,
    by: Literal["model", "truth"] = "model",
    width: Whole = 1440,
    elevation_deg: tuple[float, float] = (-60.0, 30.0),
    distance_m: float | None = None,
) -> int:
    """Unroll a view of a data set: columns are azimuths, rows elevations of the rays that leave the mirror.

    The middle is the robot's front (world x), left of it its left (world y). A pixel is the direction of a ray, or a
    point at --distance-m: a sphere has no single viewpoint.

    Parameters
    ----------
    out
        PNG file to write.
    by
        "model": closed form with the nominal rig. "truth": the truth layer of the true rig, no model of the mirror.
    width
        Columns for 360 degrees; rows are as far apart as columns are at the horizon.
    elevation_deg
        Lower and upper edge, degrees above the horizon.
    distance_m
        Of the scene from the mirror's centre; by default far away.
    """
    from phibench.datasets.read import open_finished
    from phibench.datasets.store.files import require_writable
    from phibench.datasets.store.pictures import save_png
    from phibench.estimator.geometry.panorama import FAR_M, PanoramaGrid
    from phibench.estimator.geometry.panorama import panorama as unroll

    grid = PanoramaGrid(width, *(math.radians(each) for each in elevation_deg))
    dataset = open_finished(directory)
    (chosen,) = dataset.chosen(["0" if view.sample is None else view.sample])  # the first, where none is named
    require_writable(out)
    distance = FAR_M if distance_m is None else distance_m  # of what is far, by direction alone
    result = unroll(chosen, view.position, grid, by, distance, view.picture(chosen))
    save_png(out, result.pixels)
    print(
        f"{out}: {grid.width_px} x {grid.height_px} pixels of {360.0 / grid.width_px:g} degrees, "
        f"{chosen.row.sample_id} {view.position}, by {by}; {100.0 * result.seen:.1f} % of it is in the image"
    )
    return 0


@dataset.command
def sensitivities(directory: DataFolder, *, out: Path | None = None) -> int:
    """Write dD/d(parameter) of every sample and estimator as a Parquet table.

    The estimate is made with the nominal rig, the parameter is one of the true rig: docs/misalignment.md has them all.

    Parameters
    ----------
    out
        Parquet file to write; by default sensitivities.parquet in the folder, as `dataset make` does.
    """
    from phibench.datasets.read import open_finished
    from phibench.datasets.store import schema
    from phibench.estimator.geometry.sensitivity_table import columns, write_sensitivities
    from phibench.estimator.geometry.triangulate import ESTIMATORS

    dataset = open_finished(directory)
    out = directory / schema.SENSITIVITIES if out is None else out
    write_sensitivities(dataset, out)
    print(f"{out}: {len(dataset)} samples x {len(ESTIMATORS)} estimators, {len(columns())} columns")
    return 0
