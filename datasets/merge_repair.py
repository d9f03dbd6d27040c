"""Merging of shards into one data set, and repair of a damaged one.

A merged data set has the bytes of a run that was never divided. A repair renders what is damaged or missing, and
nothing else.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from phibench.datasets.build.journal import Entry, FolderHead, Journal
from phibench.datasets.build.run_tasks import (
    assemble,
    claimed,
    held_head,
    is_intact,
    remove_files,
    stale_files,
    write_documents,
)
from phibench.datasets.build.task_list import task_names
from phibench.datasets.errors import DatasetError
from phibench.datasets.make import make_from_plan
from phibench.datasets.plan.plan import make_plan, parse_shard, shard_plan
from phibench.datasets.progress import Steps
from phibench.datasets.recipe.load import parse_recipe
from phibench.datasets.recipe.tables import Recipe
from phibench.datasets.store import schema
from phibench.datasets.store.documents import dataset_info, info_text, parse_info, recipe_sha256, same_content
from phibench.datasets.store.files import WriteError, sha256, write_atomic
from phibench.datasets.store.provenance import provenance
from phibench.datasets.store.schema import CHECKSUMS, DatasetInfo


def merge(out: str | Path, shards: Sequence[str | Path], console: Console | None = None) -> Path:
    """Put finished shards together.

    Raises
    ------
    DatasetError
        If a shard is missing, given twice, unfinished, damaged, or of another recipe, code or environment than the
        rest.
    """
    out, folders, console = Path(out), [Path(shard) for shard in shards], console or Console(stderr=True)
    head, info, entries = _collect(folders)
    plan = make_plan(parse_recipe(head.recipe))
    names = task_names(plan)
    if missing := [name for name in names if name not in entries]:
        raise DatasetError(f"the shards lack {len(missing)} tasks, such as {missing[0]}; finish or add their shards")
    with claimed(out, info.name), Journal(out) as journal:
        (out / CHECKSUMS).unlink(missing_ok=True)
        journal.begin(head, [])  # says what the folder is, should this be interrupted
        _copy(out, [entries[name] for name in names], console)
        journal.entries = {name: entries[name][0] for name in names}
        journal.begin(head, names)
        wanted = assemble(plan, head, journal.entries)
        remove_files(out, stale_files(out, [file for entry in journal.entries.values() for file in entry.files]))
        write_documents(out, wanted, wanted)
    return out


def _collect(folders: list[Path]) -> tuple[FolderHead, DatasetInfo, dict[str, tuple[Entry, Path]]]:
    """Head and info of the whole, and every task's entry with the folder that has its files."""
    if not folders:
        raise DatasetError("give the folders of the shards")
    heads = [_finished(folder) for folder in folders]
    infos = [parse_info(head.info) for head in heads]
    whole = [_whole(info, head) for info, head in zip(infos, heads, strict=True)]
    for folder, info in zip(folders, whole, strict=True):
        if not same_content(info, whole[0]):
            raise DatasetError(f"{folder} and {folders[0]} are of different recipes, code or environments")
    _all_there(folders, infos)
    entries: dict[str, tuple[Entry, Path]] = {}
    for folder in folders:
        for name, entry in Journal(folder).entries.items():
            if entries.setdefault(name, (entry, folder))[0].files != entry.files:
                raise DatasetError(f"{name} has other bytes in {folder} than in {entries[name][1]}; repair one of them")
    return FolderHead(info_text(whole[0]), heads[0].recipe), whole[0], entries


def _finished(folder: Path) -> FolderHead:
    head = Journal(folder).head
    if head is None or not (folder / CHECKSUMS).is_file():
        raise DatasetError(f"{folder} is not a finished shard; run its `phibench dataset make` again")
    return head


def _whole(info: DatasetInfo, head: FolderHead) -> DatasetInfo:
    """Description of the data set that a shard is a part of."""
    plan = make_plan(parse_recipe(head.recipe))
    if recipe_sha256(plan.recipe) != info.recipe_sha256:
        raise DatasetError(f"the recipe of shard {info.shard} is not the one it was made from")
    return dataset_info(plan, info.provenance)


def _all_there(folders: list[Path], infos: list[DatasetInfo]) -> None:
    parts = [parse_shard(info.shard or "1/1") for info in infos]
    counts = {n for _, n in parts}
    if len(counts) > 1:
        raise DatasetError(f"these are shards of different divisions: {', '.join(f'{i}/{n}' for i, n in parts)}")
    for i in range(1, max(counts) + 1):
        found = [folder for folder, (j, _) in zip(folders, parts, strict=True) if i == j]
        if len(found) != 1:
            what = "is missing" if not found else "is given more than once"
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
    try:
        write_atomic(target, write)
    except WriteError as error:
        raise DatasetError(str(error)) from error


def repair(
    folder: str | Path, workers: int | None = None, console: Console | None = None, scheduler: str | None = None
) -> list[str]:
    """Make a data set whole again; return what was done: tasks by name, small files by theirs.

    Damage is found by the hashes of the journal, which `SHA256SUMS` cannot belie. Without a journal, or with lines of
    it damaged, the tasks that it does not vouch for are done again.

    Raises
    ------
    DatasetError
        If the folder holds no data set, if neither its journal nor its other files say what it should
        hold, or if this code or these packages are not those that made it: the parts would not fit together.
    """
    folder, console = Path(folder), console or Console(stderr=True)
    head = held_head(folder) if folder.is_dir() else None
    if head is None:
        raise DatasetError(f"{folder} is not a data set: there is nothing to repair")
    info = json.loads(head.info)
    _refuse_other_code(folder, info["provenance"])
    recipe = _recipe(folder, head, info)
    plan = shard_plan(make_plan(recipe), info["shard"])
    return make_from_plan(plan, head.recipe, folder, workers, console, scheduler)


def _recipe(folder: Path, head: FolderHead, info: dict[str, object]) -> Recipe:
    if not head.recipe:
        raise DatasetError(f"{folder / schema.RECIPE} is missing; put the right one back")
    recipe = parse_recipe(head.recipe, f"{folder / schema.RECIPE}")
    if recipe_sha256(recipe) != info["recipe_sha256"]:
        raise DatasetError(
            f"{folder / schema.RECIPE} is not the recipe that {schema.INFO} names; put the right one back"
        )
    return recipe


def _refuse_other_code(folder: Path, made_by: dict[str, object]) -> None:
    here = provenance()
    for key in ("code_sha256", "packages", "python", "machine"):
        if here[key] != made_by[key]:
            what = key.removesuffix("_sha256")
            text = f"{folder} was made with other {what}: what is repaired here would not fit the rest"
            raise DatasetError(f"{text}; use that one, or `phibench dataset make` to make all of it again")
