"""A data set being made (`Build`): its tasks, the guarded folder, the run, and the small files at the end (`finish`).

The second part guards the output folder: it must hold no other data set, and have room on its disk. The last gives
the small files as bytes, from plan and journal, so that each can be checked and written anew.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console

from phibench.datasets.build.bake_task import bake_room, bake_settings
from phibench.datasets.build.forecast import Pace, TaskProgress, forecast, megabytes, slowdown
from phibench.datasets.build.journal import Entry, FolderHead, Journal
from phibench.datasets.build.sample_task import finish_sample
from phibench.datasets.build.spot_task import make_spot
from phibench.datasets.build.task_runner import log_outcome, run_tasks
from phibench.datasets.build.tasks import BuildTask, Done, Failed, task_key
from phibench.datasets.build.view_task import render_view
from phibench.datasets.build.workers import Environment, WorkerPool, versions
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.common.progress import Steps
from phibench.datasets.plan.plan import PairPlan, Plan, PosePlan
from phibench.datasets.rooms.room_files import RoomFiles, checked_data
from phibench.datasets.rooms.room_sources import EXPORTED, ONLY_ROOM
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import differing_documents, filling, with_checksums, write_documents
from phibench.datasets.store.croissant import dataset_croissant
from phibench.datasets.store.files import sha256, write_bytes
from phibench.datasets.store.json_forms import to_json
from phibench.datasets.store.metadata import (
    dataset_info,
    info_text,
    manifest_documents,
    parse_info,
    read_info,
    rigs_text,
    same_content,
)
from phibench.datasets.store.parquet_tables import to_table
from phibench.datasets.store.provenance import code_behind
from phibench.datasets.store.schema import DatasetInfo, ManifestRow, RoomInfo
from phibench.scenes.rig import POSITIONS

# List of the tasks of a plan, in the order of the recipe, each with its key.
#
# A light map depends on the room and its settings; a view on rig, room, pose, settings and light map; a spot on rig,
# room, laser and stroke; a sample (picture, noise budget) on its two views and its spot. A task stands before those
# that name it in `needs`. The tasks of a room follow each other, so that a worker builds it once; all spots come first
# where they share one room: they are quick and find faults of the recipe.


Tasks = dict[str, BuildTask]
P = TypeVar("P", PairPlan, PosePlan)


def plan_tasks(plan: Plan, versions: Mapping[str, Any]) -> Tasks:
    """Tasks by name; `versions` says what they run on (Python, packages, renderer)."""
    makers = _Makers(plan, versions)
    pairs, poses = _by_room(plan.pairs), _by_room(plan.poses)
    tasks: Tasks = {}
    for room_id in plan.rooms:
        spots = [makers.spot(pair) for pair in pairs[room_id]]
        bake = makers.bake(room_id)
        views = {pose.pose_id: makers.view(pose, bake) for pose in poses[room_id]}
        samples = [makers.sample(pair, spot, views) for pair, spot in zip(pairs[room_id], spots, strict=True)]
        tasks |= {task.name: task for task in (*spots, bake, *views.values(), *samples)}
    return tasks


def _by_room(entries: Iterable[P]) -> dict[str, list[P]]:
    """Pairs or poses by the id of their room."""
    by_room: dict[str, list[P]] = defaultdict(list)
    for entry in entries:
        by_room[entry.room].append(entry)
    return by_room


def task_names(plan: Plan) -> list[str]:
    """Names of all tasks in the order of `plan_tasks`, without their keys."""
    return list(plan_tasks(plan, {}))


def bake_task_name(room_id: str) -> str:
    """Name of the task whose result is a room's line."""
    return f"bake {room_id}"


def spot_task_name(pair: PairPlan) -> str:
    """Name of the task whose result is a sample's row, but for the noise."""
    return f"spot {pair.sample_id}"


def sample_task_name(pair: PairPlan) -> str:
    """Name of the task whose result is the noise of a sample."""
    return f"sample {pair.sample_id}"


class _Makers:
    """Makes tasks; what many keys share is hashed once."""

    def __init__(self, plan: Plan, versions: Mapping[str, Any]) -> None:
        self._plan, self._versions = plan, dict(versions)
        self._rooms = {name: _digest(to_json(source)) for name, source in plan.rooms.items()}
        self._rigs = {name: _digest(to_json(rig)) for name, rig in plan.rigs.items()}
        self._spots = {name: to_json(spot) for name, spot in plan.spots.items()}

    def spot(self, pair: PairPlan) -> BuildTask:
        plan = self._plan
        name, rig, spot = plan.recipe.dataset.name, plan.rigs[pair.rig], plan.spots[pair.spot]
        key = self._key(
            ["spot", name, self._rigs[pair.rig], self._rooms[pair.room], self._spots[pair.spot], asdict(pair)],
            make_spot,
        )
        return BuildTask(spot_task_name(pair), key, make_spot, (name, rig, plan.rooms[pair.room], spot, pair))

    def bake(self, room_id: str) -> BuildTask:
        plan, ambient = self._plan, self._plan.recipe.ambient
        scene = [_digest(to_json(plan.rig)), room_id, self._rooms[room_id]]
        key = self._key(["bake", *scene, asdict(bake_settings(ambient))], bake_room)
        return BuildTask(bake_task_name(room_id), key, bake_room, (plan.rig, room_id, plan.rooms[room_id], ambient))

    def view(self, pose: PosePlan, bake: BuildTask) -> BuildTask:
        plan = self._plan
        name, ambient = plan.recipe.dataset.name, plan.recipe.ambient
        inputs = ["view", name, self._rigs[pose.rig], self._rooms[pose.room], asdict(pose), ambient.model_dump()]
        key = self._key(inputs, render_view, (bake.key,))
        arguments = (name, plan.rigs[pose.rig], plan.rooms[pose.room], pose, ambient)
        return BuildTask(f"view {pose.pose_id}", key, render_view, arguments, (bake.name,))

    def sample(self, pair: PairPlan, spot: BuildTask, views: Mapping[str, BuildTask]) -> BuildTask:
        needs = list(
            {views[pair.pose_id(position)].name: views[pair.pose_id(position)] for position in POSITIONS}.values()
        )
        keys = tuple(task.key for task in (spot, *needs))
        key = self._key(["sample", pair.sample_id], finish_sample, keys)
        names = tuple(task.name for task in (spot, *needs))
        quality = self._plan.recipe.ambient.quality
        plan = self._plan
        arguments = (pair, plan.rigs[pair.rig], plan.rooms[pair.room], plan.spots[pair.spot], quality)
        return BuildTask(sample_task_name(pair), key, finish_sample, arguments, names)

    def _key(self, inputs: Any, function: Any, needs: tuple[str, ...] = ()) -> str:
        return task_key(inputs, code_behind(function.__module__), self._versions, needs)


def _digest(document: Any) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True, allow_nan=False).encode()).hexdigest()


_OWN = ".phibench-"  # locks, and temporary files that a killed run left


def claimed_folder(out: Path, name: str | None) -> contextlib.AbstractContextManager[None]:
    """Hold a folder to be filled; one of another data set than `name` (None for any), or of others, is refused."""
    return filling(out, lambda: refuse_other(out, name), (schema.DRAWS,))


def check_disk(out: Path, needed: int, replaced: Collection[str]) -> None:
    """Refuse when the disk has no room; files that will be replaced count as free."""
    held = sum(path.stat().st_size for name in replaced if (path := out / name).is_file())
    free = shutil.disk_usage(out).free + held
    if needed > free:
        text = f"about {megabytes(needed)} are needed and {megabytes(free)} are free at {out}"
        raise DatasetError(f"{text}; free some space or give a folder on another disk")


def missing_room_files(files: RoomFiles, out: Path) -> list[str]:
    """Names of files of rooms of which a folder has no copy, or one with other bytes."""
    held = {name: out / schema.room_file(name) for name in files.digests}
    return [name for name, path in held.items() if not path.is_file() or sha256(path) != files.digests[name]]


def copy_room_files(files: RoomFiles, out: Path) -> None:
    """Copy files of rooms into a folder, for its tasks and readers; those that are there stay.

    Raises
    ------
    RoomError
        If one is missing in its own folder, too large, or another one than it must be.
    """
    for name in missing_room_files(files, out):
        write_bytes(out / schema.room_file(name), checked_data(files.folder, name, files.digests[name]))


def stale_files(out: Path, expected: Collection[str]) -> list[str]:
    """Files that are called like a task's and that no task of now writes: of removed samples and poses."""
    below = (path for top in ("views", "spots", "previews", "lightmaps") for path in (out / top).rglob("*"))
    names = [path.relative_to(out).as_posix() for path in (*out.glob(schema.light_map_file(ONLY_ROOM)), *below)]
    wanted = set(expected)
    return sorted(name for name in names if schema.is_task_file(name) and name not in wanted)


def stale_exports(out: Path, files: RoomFiles) -> list[str]:
    """Exported files of a folder that no room has: of another seed or other settings, before `--replace`."""
    names = (path.relative_to(out).as_posix() for path in (out / schema.ROOM_FILES / EXPORTED).glob("*"))
    wanted = {schema.room_file(name) for name in files.digests}
    return sorted(name for name in names if name not in wanted)


def remove_files(out: Path, names: Collection[str]) -> None:
    """Delete files, and the folders that this empties."""
    for name in names:
        path = out / name
        path.unlink(missing_ok=True)
        if not any(path.parent.iterdir()):
            path.parent.rmdir()


def refuse_other(out: Path, name: str | None) -> None:
    """Raise `DatasetError` if a folder is a file, or holds another data set or something else."""
    if out.exists() and not out.is_dir():
        raise DatasetError(f"{out} is a file; give a folder")
    head = held_head(out)
    if name is not None and head is not None and (held := parse_info(head.info).name) != name:
        count = len(Journal(out).entries)
        what = f"{count} finished task{'s' * (count != 1)} of another data set" if count else "another data set"
        remedy = "give another folder, or add `--replace` to delete it"
        raise DatasetError(f"{out} holds {what} ('{held}'); {remedy}")


def held_head(out: Path) -> FolderHead | None:
    """Description that a folder has of itself, by its journal or its `dataset.json`; None for an empty one.

    Raises
    ------
    DatasetError
        If it holds something else.
    """
    # a run that ended while it exported rooms has left their folder alone
    if not out.is_dir() or all(path.name.startswith(_OWN) or path.name == schema.ROOM_FILES for path in out.iterdir()):
        return None  # nothing of a data set is there
    head = Journal(out).head
    if head is not None:
        return head
    if not (out / schema.INFO).is_file():
        raise DatasetError(f"{out} is not empty and holds no data set; give an empty or a new folder")
    read_info(out)
    info, recipe = (InputFile(out / name, "put the right one back") for name in (schema.INFO, schema.RECIPE))
    return FolderHead(info.text(), recipe.text() if recipe.path.is_file() else "")


@dataclass(frozen=True)
class Build:
    """A data set that is being made.

    Attributes
    ----------
    plan : what the folder is to hold
    recipe : text
    out, journal : folder, held by `claimed_folder`
    environment : what tasks run on
    """

    plan: Plan
    recipe: str
    out: Path
    journal: Journal
    environment: Environment

    @cached_property
    def tasks(self) -> dict[str, BuildTask]:
        """All tasks by name."""
        return plan_tasks(self.plan, versions(self.environment))

    @cached_property
    def head(self) -> FolderHead:
        """Description of the folder."""
        info = dataset_info(self.plan, self.environment)
        return FolderHead(_info_text(info, self.journal, self.out), self.recipe)

    def without(self, left_out: Mapping[str, str]) -> Build:
        """The same without some samples, whose causes are given."""
        return replace(self, plan=self.plan.without(left_out)) if left_out else self

    def run(self, todo: list[str], pool: WorkerPool, console: Console) -> None:
        """Run the tasks of `todo`; say beforehand what that takes.

        Raises
        ------
        DatasetError
            If the disk has no room, or, when all others are done, with the tasks that failed and why. The journal has
            those that were refused; if nothing else has failed they are no error here.
        """
        tasks, journal, out = self.tasks, self.journal, self.out
        chosen = [tasks[name] for name in todo]
        cost = forecast(self.plan, chosen)
        before = {name: journal.entries[name] for name in todo if name in journal.entries}
        check_disk(out, cost.size, [name for entry in before.values() for name in entry.files])
        factor = slowdown(pool.width)
        kept = f", {len(tasks) - len(todo)} of {len(tasks)} tasks are done" if len(todo) < len(tasks) else ""
        if chosen:
            console.print(cost.text(pool.width, factor) + kept, highlight=False, soft_wrap=True)
        left = set(todo)
        journal.begin(self.head, [name for name in tasks if name not in left])
        copy_room_files(self.plan.files, out)  # tasks see this folder alone
        failures = _run(chosen, Pace(cost.seconds, factor, pool.width), journal, pool, console) if chosen else {}
        for name, entry in before.items():
            if name in journal.entries and journal.entries[name] != entry and journal.entries[name].key == entry.key:
                console.print(f"warning: {name} came out with other bytes than the first time", highlight=False)
        if any(not failed.refused for failed in failures.values()):
            raise DatasetError(_report(failures, len(todo)))


def _run(tasks: list[BuildTask], pace: Pace, journal: Journal, pool: WorkerPool, console: Console) -> dict[str, Failed]:
    progress = TaskProgress(tasks, pace)

    def settle(task: BuildTask, outcome: Done | Failed) -> None:
        log_outcome(journal.folder, task, outcome)
        progress.settle(task)

    steps = Steps(console, "tasks", len(tasks), progress.left_s, progress.running_text)
    return run_tasks(tasks, journal, progress.watch(pool.executor(len(tasks))), steps, settle)


def _info_text(info: DatasetInfo, journal: Journal, out: Path) -> str:
    """Text of `dataset.json`: the journal's, or the one that is there, if it means the same."""
    held = [] if journal.head is None else [journal.head.info]
    with contextlib.suppress(DatasetError):  # none yet, or damaged: the journal's counts
        held.append(InputFile(out / schema.INFO, "run `phibench dataset repair`").text())
    for text in held:
        with contextlib.suppress(ValueError):  # of another version, or damaged
            if same_content(parse_info(text), info):
                return text
    return info_text(info)


def _report(failures: dict[str, Failed], count: int) -> str:
    lines = [f"{name}: {failed.cause}" for name, failed in failures.items()]
    first = (
        f"{len(failures)} of {count} tasks failed; what is finished is kept, run the same command again for the rest:"
    )
    return listed_text(first, lines)


# The small files, when all tasks are done.


def finish(plan: Plan, head: FolderHead, journal: Journal, tasks: Collection[str], out: Path) -> list[str]:
    """Write journal and documents where they differ; return the names of documents written and of files removed.

    Parameters
    ----------
    tasks : names of all tasks, each of which has an entry
    """
    if not journal.is_written(head, tasks):
        journal.begin(head, tasks)
    copy_room_files(plan.files, out)
    wanted = assemble(plan, head, journal.entries)
    changed = differing_documents(out, wanted)
    stale = stale_files(out, [file for entry in journal.entries.values() for file in entry.files])
    remove_files(out, stale)
    write_documents(out, wanted, changed)
    return [*changed, *stale]


def assemble(plan: Plan, head: FolderHead, entries: Mapping[str, Entry]) -> dict[str, bytes]:
    """All small files of a finished data set by name, SHA256SUMS last."""
    rows = [_row(pair, entries) for pair in plan.pairs]
    small = {
        schema.INFO: head.info.encode(),
        schema.RECIPE: head.recipe.encode(),
        schema.RIGS: rigs_text(plan.rigs).encode(),
        schema.ROOMS: "".join(_room_line(name, entries) for name in plan.rooms).encode(),
        **manifest_documents(rows),
    }
    hashes = {name: digest for entry in entries.values() for name, digest in entry.files.items()}
    types = {name: str(dtype) for name, dtype in to_table(rows).schema.items()}
    listed = hashes | {name: hashlib.sha256(data).hexdigest() for name, data in small.items()}
    small[schema.CROISSANT] = dataset_croissant(parse_info(head.info), types, listed).encode()
    return with_checksums(
        small, hashes | {schema.room_file(name): digest for name, digest in plan.files.digests.items()}
    )


def _room_line(room_id: str, entries: Mapping[str, Entry]) -> str:
    """Line of a room: the result of its light's task."""
    try:
        info = RoomInfo.model_validate_json(json.dumps(entries[bake_task_name(room_id)].result))
    except (LookupError, ValueError) as error:
        text = f"{schema.JOURNAL} has a damaged result of {room_id}"
        raise DatasetError(f"{text}; remove the file and run `phibench dataset make` again") from error
    return info.model_dump_json() + "\n"


def _row(pair: PairPlan, entries: Mapping[str, Entry]) -> ManifestRow:
    """Row of a sample: the result of its spot's task, and the noise from its sample's task."""
    try:
        row, noise = dict(entries[spot_task_name(pair)].result), entries[sample_task_name(pair)].result
        row |= {position: {**row[position], "noise": noise[position]} for position in POSITIONS}
        return ManifestRow.model_validate_json(json.dumps(row))
    except (TypeError, LookupError, ValueError) as error:
        text = f"{schema.JOURNAL} has a damaged result of sample {pair.sample_id}"
        raise DatasetError(f"{text}; remove the file and run `phibench dataset make` again") from error


def visibility_line(rows: Sequence[ManifestRow]) -> str:
    """Say how many pairs are visible in both images, and the causes for the others with their numbers."""
    hidden = [row for row in rows if not (row.down.visible and row.up.visible)]
    text = f"{len(rows) - len(hidden)} of {len(rows)} pairs are visible in both images"
    if not hidden:
        return text
    spots = ((position, row.position(position)) for row in hidden for position in POSITIONS)
    causes = Counter(f"{position} {spot.cause}" for position, spot in spots if not spot.visible)
    return f"{text}; not visible: " + ", ".join(f"{cause} ({count})" for cause, count in causes.items())


_TOLD = 20  # samples or failures that are told in full


def listed_text(first: str, lines: Sequence[str]) -> str:
    """A sentence, and some lines below it; of many the first ones."""
    more = [f"  and {len(lines) - _TOLD} more, see {schema.LOG}"] if len(lines) > _TOLD else []
    return "\n".join([first, *(f"  {line}" for line in lines[:_TOLD]), *more])
