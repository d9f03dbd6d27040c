"""Export of a data set's pairs for other tools or as frames sets, in shards with index, card, hashes; and its check.

Each shard is a part of the folder (`datasets.build.task_runner`), so that a run that ended early goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from phibench.benchmark.export.dataset_card import card, croissant
from phibench.benchmark.export.pair_rows import (
    INDEX,
    SPLITS,
    DrawnPair,
    ExportRequest,
    drawn_pair,
    pair_key,
    pair_table,
    splits,
)
from phibench.benchmark.export.shard_files import NEEDS_PYARROW, image_name, shard_name, write_shard
from phibench.benchmark.pair_sets.dataset_pairs import DatasetPairs, dataset_pairs
from phibench.benchmark.pair_sets.frames_set import frames_row, frames_set_documents
from phibench.benchmark.sealed.dense_set import DENSE_SEAL, DENSE_TRUTH
from phibench.benchmark.sealed.sealed_set import SEAL
from phibench.datasets.build.task_runner import BroughtParts, bring_all
from phibench.datasets.build.tasks import BuildTask, TaskResult
from phibench.datasets.common.errors import DatasetError, whole_number
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.common.progress import progress_console
from phibench.datasets.exposures.draw_frames import require_outside, sample_key
from phibench.datasets.frames.frame_request import FrameOptions
from phibench.datasets.frames.frame_source import FrameSource, has_place
from phibench.datasets.read import Dataset, open_dataset, open_finished
from phibench.datasets.recipe.tables import FramesTable
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import (
    checksums_text,
    differing_files,
    filling,
    read_checksums,
    with_checksums,
    write_documents,
)
from phibench.datasets.store.croissant import LICENSE_TEXT
from phibench.datasets.store.files import sha256, write_text
from phibench.datasets.store.parquet_tables import parquet_bytes
from phibench.datasets.store.provenance import code_behind
from phibench.scenes.rig import POSITIONS

INFO = schema.TruthFolder.EXPORT.value
_COPIED = (schema.RIGS, schema.ROOMS, schema.RECIPE)
_AGAIN = "run the same `phibench export` again"
_KINDS = schema.TruthFolder
_INDICES = (INFO, _KINDS.FRAMES_SET, _KINDS.DENSE_EXPORT, _KINDS.DENSE_SET, SEAL, DENSE_SEAL)  # one in each export


@dataclass(frozen=True)
class ShardResult:
    """Sample id of each pair and what its draw adds, in order; and the lines of the pairs of a frames set."""

    drawn: list[tuple[str, dict[str, Any]]]
    scored: list[dict[str, Any]]


@dataclass(frozen=True)
class Shard:
    """One shard to be made: its pairs, as (sample id, draw), in order."""

    dataset: Path
    request: ExportRequest
    split: str
    name: str
    pairs: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class ExportOutcome:
    """Outcome: the folder, pairs by split, shards written and kept, and notes on what was left out."""

    folder: Path
    pairs: Mapping[str, int]
    made: int
    kept: int
    notes: tuple[str, ...]


def export(
    folder: str | Path,
    request: ExportRequest,
    out: str | Path,
    *,
    workers: int | None = None,
    console: Console | None = None,
) -> ExportOutcome:
    """Write the pairs of a data set for other tools; what is there and undamaged is kept.

    Raises
    ------
    DatasetError
        If the data set, the request or the folder will not do, or the disk is full; in one sentence.
    """
    dataset, console, out = request.part_of(open_finished(folder)), console or progress_console(), Path(out)
    if request.samples:  # ids, however they were named
        request = replace(request, samples=tuple(row.sample_id for row in dataset.rows))
    count = whole_number("workers", os.cpu_count() or 1 if workers is None else workers, 1)
    _check_folder(out, Path(folder))
    _versions(request)  # a missing package is said before anything is written
    with filling(out):
        _claim(out, dataset, request)
        shards, notes = _shards(dataset, request)
        tasks = _tasks(dataset, request, shards)
        (out / schema.CHECKSUMS).unlink(missing_ok=True)  # until all is there the export is not finished
        brought = bring_all(tasks, out, count, console, "shards")
        _finish(dataset, request, out, shards, brought)
    counts = {name: sum(len(shard.pairs) for shard in shards if shard.split == name) for name in SPLITS}
    return ExportOutcome(out, counts, len(brought.made), len(shards) - len(brought.made), tuple(notes))


def export_frames_sets(
    folder: Path, pairs: Mapping[str, int], out: Path, *, workers: int | None = None, console: Console | None = None
) -> Path:
    """Write frames sets of a data set's first samples, a folder for each preset, and a list of all their files.

    Parameters
    ----------
    folder : Path
        Of the finished data set.
    pairs : mapping
        Samples by preset, at most: a smaller data set has fewer.
    out : Path
        Folder of the frames sets.

    Raises
    ------
    DatasetError
        As `export`.
    """
    names = tuple(row.sample_id for row in open_finished(folder).rows)
    laser_off, hashes = scored_with_laser_off(folder), dict[str, str]()
    for preset, count in pairs.items():
        request = ExportRequest(
            "frames", FrameOptions(preset), 1, laser_off, validation=0.0, test=0.0, samples=names[:count], scored=True
        )
        made = export(folder, request, out / preset, workers=workers, console=console).folder
        listed = read_checksums(made) | {schema.CHECKSUMS: sha256(made / schema.CHECKSUMS)}
        hashes |= {f"{preset}/{name}": digest for name, digest in listed.items()}
    write_text(out / schema.CHECKSUMS, checksums_text(hashes))
    return out


def make_shard(out: Path, shard: Shard) -> TaskResult:
    """Task: make one shard; the result is a `ShardResult`."""
    dataset = shard.request.part_of(open_dataset(shard.dataset))
    pairs, scored = _scored_pairs(dataset, shard) if shard.request.scored else (_drawn_pairs(dataset, shard), [])
    drawn = [(pair.sample_id, {"key": pair.key, "split": shard.split, **pair.added}) for pair in pairs]
    files = write_shard(out, shard.name, shard.request, pairs, pair_table(dataset.rows, drawn))
    return TaskResult(tuple(files), {"drawn": drawn, "scored": scored})


def _drawn_pairs(dataset: Dataset, shard: Shard) -> list[DrawnPair]:
    pairs, source, last = [], None, ""
    for sample_id, draw in shard.pairs:
        sample = dataset[sample_id]
        if source is None or sample_id != last:
            source, last = FrameSource.from_request(sample, sample.frame_request(shard.request.frames)), sample_id
        pairs.append(drawn_pair(source, sample.row, draw, shard.request))
    return pairs


def _scored_pairs(dataset: Dataset, shard: Shard) -> tuple[list[DrawnPair], list[dict[str, Any]]]:
    """Pairs as they are scored, with the lines of a frames set: the frames of `ScoredDataset.pairs`."""
    request, pairs, lines = shard.request, [], []
    taken = scored_pairs(dataset, request)
    for sample_id, draw in shard.pairs:
        number = taken.number_of(sample_id, draw)
        pair, frames = taken.pair_and_frames(number)
        source = taken.drawn_from(number)[2]
        pairs.append(drawn_pair(source, dataset[sample_id].row, draw, request, frames))
        names = {column: image_name(request, pairs[-1].key, column) for column in pairs[-1].images}
        files = {column.removeprefix("image_"): f"{shard.name}/{name}" for column, name in names.items()}
        lines.append(frames_row(pair, taken.truth(number), files))
    return pairs, lines


def scored_with_laser_off(folder: Path) -> bool:
    """True if the pairs that `score` shows of a data set have frames with the laser off."""
    return (open_finished(folder).recipe.frames or FramesTable()).laser_off


def scored_pairs(dataset: Dataset, request: ExportRequest) -> DatasetPairs:
    """Pairs of a data set as `score` numbers them, with or without frames with the laser off."""
    taken = dataset_pairs(dataset, request.frames.preset, request.draws)
    draws = (replace(draw, laser_off=request.laser_off) for draw in taken.pair_draws)
    return DatasetPairs(dataset, tuple(draws))


def is_export(folder: Path) -> bool:
    """True of an export, of a set of frames, dense or sealed ones, too, and of a folder of several exports."""
    is_data_set = (folder / schema.INFO).is_file()
    signs_exports = (folder / schema.CHECKSUMS).is_file() and any(folder.glob(f"*/{INFO}"))
    return any((folder / name).is_file() for name in _INDICES) or (signs_exports and not is_data_set)


def verify_export(folder: str | Path) -> list[str]:
    """One sentence per fault of an export: files that are missing, changed or not listed.

    Raises
    ------
    DatasetError
        If the folder is no export, or one that was not finished.
    """
    folder = Path(folder)
    if not is_export(folder):
        raise DatasetError(f"{folder} is no export: it has no {INFO}")
    if not (folder / schema.CHECKSUMS).is_file():
        raise DatasetError(f"{folder} has no {schema.CHECKSUMS}: it was not finished; {_AGAIN}")
    listed = read_checksums(folder)
    paths = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())  # pipes and sockets, too
    there = {path.relative_to(folder).as_posix() for path in paths}
    state = {schema.CHECKSUMS, schema.JOURNAL, schema.LOCK, schema.TruthFile.SHARDS.value, DENSE_TRUTH}
    strange = sorted(there - set(listed) - state)
    return differing_files(folder, listed) + [f"{name} is not of the export" for name in strange]


def _shards(dataset: Dataset, request: ExportRequest) -> tuple[list[Shard], list[str]]:
    split_of, notes, shards = splits(dataset, request), [], []
    for split in SPLITS:
        pairs = []
        for sample in dataset.samples:
            if split_of[sample.row.sample_id] != split:
                continue  # of another split
            size = sample.rig.camera.height_px, sample.rig.camera.width_px
            if request.frames.region is not None and not all(has_place(sample.truth_row(p), size) for p in POSITIONS):
                notes.append(f"{sample.row.sample_id} is left out: no image of the spot to put a region around")
            else:
                pairs += [(sample.row.sample_id, draw) for draw in range(request.draws)]
        parts = [pairs[k : k + request.pairs_per_shard] for k in range(0, len(pairs), request.pairs_per_shard)]
        for number, part in enumerate(parts):
            name = shard_name(request.form, split, number, len(parts))
            shards.append(Shard(dataset.folder, request, split, name, tuple(part)))
    return shards, notes


def _tasks(dataset: Dataset, request: ExportRequest, shards: Sequence[Shard]) -> dict[str, BuildTask]:
    listed = read_checksums(dataset.folder)
    modules = ["export.pair_rows", "export.shard_files", *(["pair_sets.frames_set"] if request.scored else [])]
    code = [code_behind(f"phibench.benchmark.{name}") for name in modules]
    tasks = [
        BuildTask(f"shard {shard.name}", _key(dataset, listed, code, shard), make_shard, (shard,)) for shard in shards
    ]
    return {task.name: task for task in tasks}


def _key(dataset: Dataset, listed: Mapping[str, str], code: Sequence[str], shard: Shard) -> str:
    samples = dict.fromkeys(sample_id for sample_id, _ in shard.pairs)
    keys = [sample_key(dataset[sample_id], shard.request.frames, listed) for sample_id in samples]
    parts = [shard.name, shard.split, shard.pairs, shard.request.document(), keys, code, _versions(shard.request)]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def _versions(request: ExportRequest) -> list[str]:
    """Packages that the bytes depend on.

    Raises
    ------
    DatasetError
        If Parquet files are wanted and pyarrow is not installed.
    """
    from importlib.metadata import PackageNotFoundError, version

    if request.form != "parquet":
        return []
    try:
        return [f"pyarrow {version('pyarrow')}"]
    except PackageNotFoundError as error:
        raise DatasetError(NEEDS_PYARROW) from error


def _check_folder(out: Path, dataset: Path) -> None:
    require_outside(out, dataset)
    if out.is_dir() and not (out / INFO).is_file() and any(not path.name.startswith(".") for path in out.iterdir()):
        raise DatasetError(f"{out} holds other files: give an empty folder, `--out FOLDER`")


def _claim(out: Path, dataset: Dataset, request: ExportRequest) -> None:
    """Write down what the folder is for; refuse one that has an export of something else."""
    meant = {
        "dataset": dataset.info.name,
        "dataset_sha256": sha256(dataset.folder / schema.CHECKSUMS),
        **request.document(),
    }
    path = out / INFO
    if path.is_file():
        held = InputFile(path, "give another folder, `--out FOLDER`").json()
        words = {"form": "--to"}
        if other := [words.get(name, name) for name in meant if held.get(name) != meant[name]]:
            raise DatasetError(
                f"{out} holds an export that differs in {', '.join(other)}: give another folder, `--out FOLDER`"
            )
        return  # the same export goes on
    write_text(path, json.dumps(meant, indent=1, allow_nan=False) + "\n")


def _finish(
    dataset: Dataset, request: ExportRequest, out: Path, shards: Sequence[Shard], brought: BroughtParts
) -> None:
    """Write index, card, Croissant and hashes."""
    results = brought.results(ShardResult)
    table = pair_table(dataset.rows, [pair for result in results for pair in result.drawn])
    for column, _, _ in request.images:
        table = table.with_columns(_names(request, shards, column))
    hashes, index, again = brought.hashes, parquet_bytes(table), "run `phibench dataset repair`"
    documents = {
        INFO: (out / INFO).read_bytes(),
        INDEX: index,
        schema.CROISSANT: croissant(dataset, request, table, hashlib.sha256(index).hexdigest(), hashes).encode(),
        "README.md": card(dataset, request, table).encode(),
        "LICENSE": LICENSE_TEXT.encode(),
        **{name: _used_lines(dataset, name, InputFile(dataset.folder / name, again).read()) for name in _COPIED},
    }
    if request.scored:
        lines = [line for result in results for line in result.scored]
        taken = scored_pairs(dataset, request)
        documents |= frames_set_documents(taken, request.frames.preset, request.draws, lines)
    write_documents(out, with_checksums(documents, hashes))


def _used_lines(dataset: Dataset, name: str, data: bytes) -> bytes:
    """Lines of the rigs and rooms that the exported samples have; any other file as it is."""
    ids = {
        schema.RIGS: ("rig", {rig for row in dataset.rows for rig in (row.rig, row.nominal_rig)}),
        schema.ROOMS: ("room", {row.room for row in dataset.rows}),
    }
    if name not in ids:
        return data
    key, used = ids[name]
    return b"".join(line for line in data.splitlines(keepends=True) if json.loads(line)[key] in used)


def _names(request: ExportRequest, shards: Sequence[Shard], column: str) -> Any:
    """Column with the place of every image: a file, or shard and member."""
    import polars

    places = [
        f"{shard.name}/{image_name(request, pair_key(sample_id, draw), column)}"
        for shard in shards
        for sample_id, draw in shard.pairs
    ]
    return polars.Series(column, places)
