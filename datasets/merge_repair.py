"""Merging of shards into one data set, and repair of a damaged one.

A merged data set has the bytes of a run that was never divided. A repair renders what is damaged or missing, and
nothing else.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Sequence
from itertools import count
from pathlib import Path
from typing import Any

from rich.console import Console

from phibench.datasets.build.dataset_build import claimed_folder, copy_room_files, finish, held_head, task_names
from phibench.datasets.build.earlier_runs import lost_work_text
from phibench.datasets.build.journal import Entry, FolderHead, Journal, Refusal, is_intact
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.progress import Steps, progress_console
from phibench.datasets.make import MakeOptions, make_from_plan
from phibench.datasets.plan.plan import Plan, make_plan, parse_shard
from phibench.datasets.recipe.load import parse_recipe, recipe_text
from phibench.datasets.recipe.tables import Recipe
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import held_room_files
from phibench.datasets.store.files import sha256, write_atomic
from phibench.datasets.store.folder_lock import only_run
from phibench.datasets.store.layers import read_exr
from phibench.datasets.store.metadata import (
    dataset_info,
    info_text,
    parse_info,
    read_manifest,
    recipe_sha256,
    same_content,
)
from phibench.datasets.store.provenance import provenance
from phibench.datasets.store.schema import CHECKSUMS, DatasetInfo
from phibench.scenes.rig import POSITIONS


def merge(out: str | Path, shards: Sequence[str | Path], console: Console | None = None) -> Path:
    """Put finished shards together.

    Raises
    ------
    DatasetError
        If a shard is missing, given twice, unfinished, damaged, or of another recipe, code or environment than the
        rest.
    """
    out, folders, console = (Path(out), [Path(shard) for shard in shards], console or progress_console())
    head, whole, info, entries, refusals = _collect(folders)
    plan = whole.without(info.causes)
    names = task_names(plan)
    if missing := [name for name in names if name not in entries]:
        raise DatasetError(f"the shards lack {len(missing)} tasks, such as {missing[0]}; finish or add their shards")
    with claimed_folder(out, info.name), Journal(out) as journal:
        if lost := lost_work_text(out, {name: entries[name][0].key for name in names}, journal, info):
            raise DatasetError(f"{lost}; give another folder")
        (out / CHECKSUMS).unlink(missing_ok=True)
        journal.begin(head, [])  # says what the folder is, should this be interrupted
        copy_room_files(plan.files, out)
        _copy(out, [entries[name] for name in names], console)
        journal.entries, journal.refusals = {name: entries[name][0] for name in names}, refusals
        journal.keep_refusals(task_names(whole))
        finish(plan, head, journal, names, out)
    return out


_Entries = dict[str, tuple[Entry, Path]]


def _collect(folders: list[Path]) -> tuple[FolderHead, Plan, DatasetInfo, _Entries, dict[str, Refusal]]:
    """Head, plan and info of the whole, every task's entry with the folder that has its files, and the refusals.

    The plan has all samples; the info leaves out those that any shard does.
    """
    if not folders:
        raise DatasetError("give the folders of the shards")
    heads = [_finished(folder) for folder in folders]
    infos = [parse_info(head.info) for head in heads]
    plans: dict[str, Plan] = {}
    for folder, info, head in zip(folders, infos, heads, strict=True):
        if head.recipe not in plans:  # one for all shards that belong together
            plans[head.recipe] = make_plan(parse_recipe(head.recipe), held_room_files(folder))
        if recipe_sha256(plans[head.recipe].recipe) != info.recipe_sha256:
            raise DatasetError(f"the recipe of shard {info.shard} is not the one it was made from")
    causes = {name: cause for info in infos for name, cause in info.causes.items()}
    whole = [
        dataset_info(plans[head.recipe].without(causes), info.provenance)
        for info, head in zip(infos, heads, strict=True)
    ]
    for folder, info in zip(folders, whole, strict=True):
        if not same_content(info, whole[0]):
            raise DatasetError(f"{folder} and {folders[0]} are of different recipes, code or environments")
    _all_there(folders, infos)
    entries: _Entries = {}
    refusals: dict[str, Refusal] = {}
    for folder in folders:
        journal = Journal(folder)
        refusals |= journal.refusals
        for name, entry in journal.entries.items():
            if entries.setdefault(name, (entry, folder))[0].files != entry.files:
                raise DatasetError(f"{name} has other bytes in {folder} than in {entries[name][1]}; repair one of them")
    plan = plans[heads[0].recipe]
    return FolderHead(info_text(whole[0]), heads[0].recipe), plan, whole[0], entries, refusals


def _finished(folder: Path) -> FolderHead:
    head = Journal(folder).head
    if head is None or not (folder / CHECKSUMS).is_file():
        raise DatasetError(f"{folder} is not a finished shard; run its `phibench dataset make` again")
    return head


def _all_there(folders: list[Path], infos: list[DatasetInfo]) -> None:
    parts = [parse_shard(info.shard or "1/1") for info in infos]
    counts = {n for _, n in parts}
    if len(counts) > 1:
        raise DatasetError(f"these are shards of different divisions: {', '.join(f'{i}/{n}' for i, n in parts)}")
    for i in range(1, max(counts) + 1):
        of_shard = [folder for folder, (j, _) in zip(folders, parts, strict=True) if i == j]
        if len(of_shard) != 1:
            what = "is missing" if not of_shard else "is given more than once"
            raise DatasetError(f"shard {i}/{max(counts)} {what}")


def _copy(out: Path, entries: list[tuple[Entry, Path]], console: Console) -> None:
    """Copy the files of all tasks, checked on the way; those that are there with the right bytes stay."""
    with Steps(console, "merge", len(entries)) as steps:
        for entry, folder in entries:
            if not is_intact(entry, out):
                for name, digest in entry.files.items():
                    _copy_file(folder / name, out / name, digest)
            steps.advance()


def _copy_file(source: Path, target: Path, digest: str) -> None:
    def write(temporary: Path) -> None:
        shutil.copyfile(source, temporary)
        if sha256(temporary) != digest:
            raise DatasetError(f"{source} is damaged; run `phibench dataset repair` on its shard")

    if not source.is_file():
        raise DatasetError(f"{source} is missing; run `phibench dataset repair` on its shard")
    write_atomic(target, write)


def repair(
    folder: str | Path, workers: int | None = None, console: Console | None = None, scheduler: str | None = None
) -> list[str]:
    """Make a data set whole again; return what was done: tasks by name, small files by theirs.

    Damage is found by the hashes of the journal, which `SHA256SUMS` cannot belie. Without a journal, or with lines of
    it damaged, the tasks that it does not vouch for are done again. A `dataset.json` that is lost together with the
    journal's first line follows from `recipe.toml`, if the layers are of that recipe.

    Folders, FIFOs, sockets, devices and circular links in place of files give way; a folder that holds something is
    kept under another name.

    Raises
    ------
    DatasetError
        If the folder holds no data set, if neither its journal nor its other files say what it should
        hold, or if this code or these packages are not those that made it: the parts would not fit together.
    """
    folder, console = Path(folder), console or progress_console()
    plan, recipe, leave_out = _held_plan(folder)
    _clear(folder, [schema.LOCK], console)  # without it nobody can hold the folder
    with only_run(folder):
        _clear(folder, _places(plan), console)
    wanted = MakeOptions(leave_out_refused=leave_out)
    return make_from_plan(plan, recipe, folder, workers, console, scheduler, wanted)


def _held_plan(folder: Path) -> tuple[Plan, str, bool]:
    """Plan of what a folder should hold, the text of its recipe, and whether it leaves out refused samples."""
    try:
        head = held_head(folder) if folder.is_dir() else None
    except DatasetError as error:
        if (head := _lost_head(folder)) is None:
            raise error from None
        with only_run(folder), Journal(folder) as journal:
            journal.begin(head, list(journal.entries))
        return make_plan(parse_recipe(head.recipe), held_room_files(folder)), head.recipe, False
    if head is None:
        raise DatasetError(f"{folder} is not a data set: there is nothing to repair")
    info = parse_info(head.info)
    _refuse_other_code(folder, info.provenance)
    plan = make_plan(_recipe(folder, head, info), held_room_files(folder), info.shard)
    return plan, head.recipe, bool(info.left_out)


def _lost_head(folder: Path) -> FolderHead | None:
    """Description that follows from `recipe.toml`; None where it or the layers are missing.

    Raises
    ------
    DatasetError
        If the layers are not those of the recipe, or only a part of them.
    """
    path, layers = folder / schema.RECIPE, sorted(folder.glob(schema.view_file("*", "ambient")))
    if not (path.is_file() and layers):
        return None  # too little is left to tell what it was
    text = recipe_text(path)
    plan = make_plan(parse_recipe(text, f"{path}"), held_room_files(folder))
    expected = {pose.pose_id: pose.seed for pose in plan.poses}
    headers = [_header(layer) for layer in layers]
    held = {header["pose"]: header["seed"] for header in headers if header.get("dataset") == plan.recipe.dataset.name}
    if not held or not held.items() <= expected.items():
        raise DatasetError(f"{path} is not the recipe of the layers in {folder}; put the right one back")
    if (folder / schema.MANIFEST).is_file() and len(read_manifest(folder)) != len(plan.pairs):
        text = f"{folder} holds a shard, or leaves samples out, and which is lost with {schema.INFO}"
        raise DatasetError(f"{text}; put {schema.INFO} back, or render it into a new folder")
    return FolderHead(info_text(dataset_info(plan, {})), text)


def _header(layer: Path) -> dict[str, Any]:
    """Header of a layer; empty if the file is damaged."""
    try:
        return read_exr(layer).header
    except DatasetError:  # that it is damaged is told by its hash
        return {}


def _places(plan: Plan) -> list[str]:
    """Relative names of all files of a plan, those included that need not be there."""
    samples = [pair.sample_id for pair in plan.pairs]
    return [
        *(schema.INFO, schema.MANIFEST, schema.TABLE, schema.RECIPE, schema.RIGS, schema.ROOMS),
        *(schema.CROISSANT, *schema.NOT_DATA),
        *(schema.light_map_file(room) for room in plan.rooms),
        *(schema.room_file(name) for name in plan.files.digests),
        *(schema.view_file(pose.pose_id, kind) for pose in plan.poses for kind in ("ambient", "truth", "preview")),
        *(schema.spot_file(sample, position) for sample in samples for position in POSITIONS),
        *(schema.preview_file(sample) for sample in samples),
    ]


def _clear(folder: Path, names: Iterable[str], console: Console) -> None:
    """Take away what is no file in the place of a file, and what is no folder in the place of a folder."""
    folders = {parent for name in names for parent in Path(name).parents if parent.name}
    for parent in sorted(folders):
        if os.path.lexists(folder / parent) and not (folder / parent).is_dir():
            _set_aside(folder / parent, console)
    for name in names:
        path = folder / name
        if path.is_symlink() and not path.is_file():
            path.unlink()  # dangling, in a circle, or to something else: the link only
        elif path.is_dir():
            _set_aside(path, console)
        elif path.exists() and not path.is_file():
            path.unlink()  # a FIFO, socket or device holds nothing


def _set_aside(path: Path, console: Console) -> None:
    """Remove an empty folder; give anything else another name."""
    if path.is_dir() and not any(path.iterdir()):
        path.rmdir()
        return  # nothing in it that could be lost
    kept = next(other for k in count(1) if not os.path.lexists(other := path.with_name(f"{path.name}.aside-{k}")))
    path.rename(kept)
    console.print(f"{path} was no {'file' if kept.is_dir() else 'folder'}; it is kept as {kept.name}", highlight=False)


def _recipe(folder: Path, head: FolderHead, info: DatasetInfo) -> Recipe:
    if not head.recipe:
        raise DatasetError(f"{folder / schema.RECIPE} is missing; put the right one back")
    recipe = parse_recipe(head.recipe, f"{folder / schema.RECIPE}")
    if recipe_sha256(recipe) != info.recipe_sha256:
        raise DatasetError(
            f"{folder / schema.RECIPE} is not the recipe that {schema.INFO} names; put the right one back"
        )
    return recipe


def _refuse_other_code(folder: Path, made_by: dict[str, object]) -> None:
    here = provenance()
    for key in ("code_sha256", "packages", "python", "machine"):
        if here[key] != made_by.get(key):
            what = key.removesuffix("_sha256")
            text = f"{folder} was made with other {what}: what is repaired here would not fit the rest"
            raise DatasetError(f"{text}; use that one, or `phibench dataset make --replace` to make all of it again")
