"""Writer of a folder of frame files with an index (`dataset frames`); hash of all that a sample's frames depend on.

Files that are there with the right bytes are kept. A file is known by the hash of all that it depends on: names,
request, layers, code, and the versions of the libraries that draw and compress.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

from rich.console import Console

from phibench.datasets.common.errors import DatasetError, whole_number
from phibench.datasets.common.parallel import parallel_map
from phibench.datasets.common.progress import Steps, progress_console
from phibench.datasets.frames.frame_files import (
    PREVIEW,
    TRUTH,
    VALUES,
    FrameRow,
    claim,
    has_preview,
    read_index,
    suffix,
    write_frame,
    write_index,
    write_preview,
)
from phibench.datasets.frames.frame_request import FrameOptions, FrameRequest
from phibench.datasets.frames.frame_source import Frame, FrameSource, has_place
from phibench.datasets.read import Dataset, Sample, open_dataset, open_finished
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import filling, read_checksums, require_files
from phibench.datasets.store.files import sha256
from phibench.datasets.store.folder_lock import working
from phibench.datasets.store.provenance import code_behind
from phibench.datasets.store.schema import ManifestRow, row_line
from phibench.scenes.rig import POSITIONS

_FILES_PER_JOB = 16  # a few seconds of work; reading the layers again takes half a second
_SAVE_EVERY_S = 2.0  # or twenty times what saving takes


@dataclass(frozen=True)
class DrawnFrames:
    """Outcome of a run: the folder, the numbers of files written and kept, and notes on what was left out."""

    folder: Path
    made: int
    kept: int
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Item:
    """One file of a sample."""

    position: str
    laser: bool
    draw: int
    preview: bool = False

    def file(self, sample_id: str, end: str) -> str:
        """Name, relative to the folder of the frames."""
        name = f"{sample_id}-{self.position}-{'on' if self.laser else 'off'}"
        return f"previews/{name}.png" if self.preview else f"{name}-{self.draw:04d}{end}"


@dataclass(frozen=True)
class SampleJob:
    """Some files of one sample, for one process; `known` are their rows in the index, if they have any."""

    dataset: Path
    out: Path
    sample_id: str
    options: FrameOptions
    items: tuple[Item, ...]
    known: Mapping[str, FrameRow] = field(default_factory=dict)

    def file(self, item: Item) -> str:
        """Name of one of them."""
        return item.file(self.sample_id, suffix(self.options.sensor(), self.options.region is None))


def draw_frames(
    folder: str | Path,
    options: FrameOptions,
    draws: int = 1,
    *,
    out: str | Path | None = None,
    samples: Sequence[str] | None = None,
    laser_off: bool = False,
    workers: int | None = None,
    console: Console | None = None,
) -> DrawnFrames:
    """Write frames of a data set as files; what is there and undamaged is kept.

    Parameters
    ----------
    folder : data set
    options : FrameOptions
        What they do not give is the recipe's `[frames]` of each sample.
    draws : draws 0 to draws - 1 of every image
    out : folder to write; by default beside the data set, `<folder>-frames`
    samples : ids or numbers; all by default
    laser_off : also draw every image without the spot
    workers : processes; by default one per core
    console : where progress goes; by default the standard error

    Raises
    ------
    DatasetError
        If the data set, the options or the folder will not do; in one sentence.
    """
    dataset, console = open_finished(folder), console or progress_console()
    target = Path(out) if out is not None else Path(f"{Path(folder).resolve()}-frames")
    whole_number("draws", draws, 1)
    count = whole_number("workers", os.cpu_count() or 1 if workers is None else workers, 1)
    _check_folder(target, Path(folder))
    jobs, notes = _jobs(dataset, target, options, _items(options, draws, laser_off), samples)
    with filling(target):
        made, kept = _draw(jobs, dataset, target, options, count, console)
    return DrawnFrames(target, made, kept, tuple(notes))


def perform_job(job: SampleJob) -> tuple[list[FrameRow], int]:
    """Do a job: rows of all its files, and how many were written."""
    sample = _opened(job.dataset, sha256(job.dataset / schema.CHECKSUMS))[job.sample_id]
    base, source = sample_key(sample, job.options, read_checksums(job.dataset)), None
    rows, made = [], 0
    with working(job.out):
        for item in job.items:
            name, key = job.file(item), _hash([base, repr(item)])
            row = job.known.get(name)
            if row is None or row.key != key or not _is_whole(job.out / name, row.sha256):
                source = source or FrameSource.from_request(sample, sample.frame_request(job.options))
                row = _written(job, sample.row, source, item, name, key)
                made += 1
            rows.append(row)
    return rows, made


@lru_cache(maxsize=1)
def _opened(folder: Path, _checksums_sha256: str) -> Dataset:
    """Data set of the next jobs, too: reading a long manifest takes longer than a small frame."""
    return open_dataset(folder)


def _draw(
    jobs: list[SampleJob], dataset: Dataset, out: Path, options: FrameOptions, count: int, console: Console
) -> tuple[int, int]:
    rows = read_index(out)
    claim(out, _names(dataset), options.document())
    jobs = [_knowing(part, rows) for job in jobs for part in _parts(job)]
    made, total, due = 0, 0, time.monotonic() + _SAVE_EVERY_S
    try:
        with Steps(console, "frames", len(jobs)) as steps:
            for done, written in parallel_map(perform_job, jobs, count, in_order=False):
                rows |= {row.file: row for row in done}
                made, total = made + written, total + len(done)
                steps.advance()
                if (now := time.monotonic()) > due:
                    write_index(out, rows.values())
                    # writing the index takes a twentieth of the time at most
                    due = now + max(_SAVE_EVERY_S, 20.0 * (time.monotonic() - now))
    finally:  # what an interrupted run has drawn is found by the next one
        write_index(out, rows.values())
    names = [job.file(item) for job in jobs for item in job.items]
    require_files(out, names)
    return made, total - made


def _parts(job: SampleJob) -> Iterator[SampleJob]:
    """Jobs short enough that an interrupted run loses little."""
    for first in range(0, len(job.items), _FILES_PER_JOB):
        yield replace(job, items=job.items[first : first + _FILES_PER_JOB])


def _knowing(job: SampleJob, rows: Mapping[str, FrameRow]) -> SampleJob:
    names = (job.file(item) for item in job.items)
    return replace(job, known={name: rows[name] for name in names if name in rows})


def _written(job: SampleJob, sample: ManifestRow, source: FrameSource, item: Item, name: str, key: str) -> FrameRow:
    frame, path = source.frame(item.position, item.draw, item.laser), job.out / name
    if item.preview:
        write_preview(path, frame)
    else:
        write_frame(path, frame, source.names)
    return _row(job, sample, source, item, frame, name, key)


def _row(
    job: SampleJob, sample: ManifestRow, source: FrameSource, item: Item, frame: Frame, name: str, key: str
) -> FrameRow:
    height, width = frame.region.shape
    dataset, seed, sample_id = source.names
    spot = sample.position(item.position)
    return FrameRow(
        file=name,
        sha256=sha256(job.out / name),
        kind="preview" if item.preview else "frame",
        values=PREVIEW if item.preview else VALUES[frame.sensor.output],
        dataset=dataset,
        dataset_seed=seed,
        sample_id=sample_id,
        position="down" if item.position == "down" else "up",
        laser="on" if item.laser else "off",
        draw=item.draw,
        preset=source.request.preset,
        exposure_s=frame.sensor.exposure_s,
        analogue_gain=frame.sensor.analogue_gain,
        jpeg_quality=source.jpeg_quality,
        laser_level=source.request.laser_level,
        lamp_level=source.request.lamp_level,
        u0_px=frame.region.u0_px,
        v0_px=frame.region.v0_px,
        width_px=width,
        height_px=height,
        depth_m=sample.centre_depth_m,
        stroke_m=sample.stroke_m,
        **{name: spot.at_centre(name) for name in TRUTH},
        sensor=frame.sensor.model_dump(mode="json"),
        request=_document(source.request),
        key=key,
    )


def _items(options: FrameOptions, draws: int, laser_off: bool) -> tuple[Item, ...]:
    images = [(position, laser) for position in POSITIONS for laser in ((True, False) if laser_off else (True,))]
    items = [Item(*image, draw) for image in images for draw in range(draws)]
    if has_preview(options.sensor()):
        items += [Item(*image, 0, preview=True) for image in images]
    return tuple(items)


def _jobs(
    dataset: Dataset, out: Path, options: FrameOptions, items: tuple[Item, ...], samples: Sequence[str] | None
) -> tuple[list[SampleJob], list[str]]:
    """One job per sample; a region needs a place of the spot in both images."""
    jobs, notes = [], []
    for sample in dataset if samples is None else dataset.chosen(samples):
        size = sample.rig.camera.height_px, sample.rig.camera.width_px
        hidden = [p for p in POSITIONS if not has_place(sample.truth_row(p), size)]
        if isinstance(options.region, int) and hidden:
            notes.append(f"{sample.row.sample_id} is left out: no image of the spot to put a region around")
        else:
            jobs.append(SampleJob(dataset.folder, out, sample.row.sample_id, options, items))
    return jobs, notes


def require_outside(out: Path, dataset: Path) -> None:
    """Refuse to write into a data set, or over a file.

    Raises
    ------
    DatasetError
        In one sentence.
    """
    where = out.resolve()
    if out.exists() and not out.is_dir():
        raise DatasetError(f"{out} is a file: give a folder, `--out`")
    if where == dataset.resolve() or dataset.resolve() in where.parents:
        raise DatasetError(f"{out} lies inside the data set, whose files are signed: give a folder outside, `--out`")


def _check_folder(out: Path, dataset: Path) -> None:
    require_outside(out, dataset)
    if (out / schema.INFO).exists():
        raise DatasetError(f"{out} is a data set: give a folder of its own for the frames, `--out`")


def _names(dataset: Dataset) -> tuple[str, int]:
    return dataset.info.name, dataset.recipe.dataset.seed


def _document(request: FrameRequest) -> dict[str, object]:
    """The request as it comes back out of the index."""
    document: dict[str, object] = json.loads(json.dumps(request.document()))
    return document


def sample_key(sample: Sample, options: FrameOptions, listed: Mapping[str, str]) -> str:
    """Hash of all that the frames of a sample depend on: names, numbers, layers, code, libraries.

    `listed` is SHA256SUMS of its data set.
    """
    request = sample.frame_request(options)
    layers = [listed.get(schema.RIGS), listed.get(schema.ROOMS)]
    for position in POSITIONS:
        row = sample.truth_row(position)
        layers += [listed.get(row.view_ambient_file), listed.get(row.spot_file or "")]
    libraries = [f"{name} {version(name)}" for name in ("numpy", "scipy", "pillow", "OpenEXR")]
    code = [code_behind(f"phibench.datasets.frames.{name}") for name in ("frame_source", "frame_files")]
    numbers = request.sensor().model_dump(mode="json")
    lights = [table.model_dump(mode="json") for table in sample.dataset.recipe.distractors]
    parts = [sample.stream_names, row_line(sample.row), _document(request), numbers, lights, layers, libraries, code]
    return _hash(parts)


def _hash(parts: object) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def _is_whole(path: Path, digest: str) -> bool:
    return path.is_file() and sha256(path) == digest
