"""Runs the unfinished tasks of a folder, with a journal entry and a log line for each, and assembles its small files.

The first part guards the output folder: it must be writable, hold no other data set, and have room on its disk. The
last part gives the small files as bytes, from plan and journal, so that each can be checked and written anew.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

from phibench.datasets.build.forecast import Pace, TaskProgress, forecast, megabytes, slowdown
from phibench.datasets.build.journal import Entry, FolderHead, Journal, Refusal
from phibench.datasets.build.refusals import listed
from phibench.datasets.build.scheduler import schedule
from phibench.datasets.build.task_list import bake_task_name, sample_task_name, spot_task_name
from phibench.datasets.build.tasks import BuildTask, Done, Failed, log_entry
from phibench.datasets.build.workers import WorkerPool
from phibench.datasets.errors import DatasetError
from phibench.datasets.input_files import InputFile
from phibench.datasets.plan.plan import PairPlan, Plan
from phibench.datasets.progress import Steps
from phibench.datasets.rooms.room_files import RoomFiles, checked_data
from phibench.datasets.rooms.room_sources import ONLY_ROOM
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import checksums_text
from phibench.datasets.store.croissant import dataset_croissant
from phibench.datasets.store.documents import manifest_documents, parse_info, read_info, rigs_text, to_table
from phibench.datasets.store.files import only_run, remove_temporary, sha256, write_bytes
from phibench.datasets.store.leftovers import TEMPORARY_PREFIX, folder_for_work
from phibench.datasets.store.schema import ManifestRow, RoomInfo
from phibench.scenes.rig import POSITIONS

_OWN = ".phibench-"  # locks, and temporary files that a killed run left


@contextlib.contextmanager
def claimed(out: Path, name: str | None) -> Iterator[None]:
    """Make the folder, refuse one that holds something else, and hold it: of two that start together one is refused.

    Parameters
    ----------
    out : folder
    name : that of the data set that the folder may hold; None for any

    Raises
    ------
    DatasetError
        With one sentence that says what to do.
    """
    refuse_other(out, name)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(folder_for_work(out, (schema.DRAWS,)))
        except OSError as error:
            raise _not_writable(out, error) from error
        stack.enter_context(only_run(out))
        refuse_other(out, name)  # again: now nobody else can write
        try:
            write_bytes(out / f"{TEMPORARY_PREFIX}probe", b"").unlink()
        except OSError as error:
            raise _not_writable(out, error) from error
        remove_temporary(out)
        try:
            yield
        finally:
            remove_temporary(out)


def _not_writable(out: Path, error: OSError) -> DatasetError:
    return DatasetError(f"cannot write to {out}: {error.strerror or error}; give another folder")


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
        return None
    head = Journal(out).head
    if head is not None:
        return head
    if not (out / schema.INFO).is_file():
        raise DatasetError(f"{out} is not empty and holds no data set; give an empty or a new folder")
    read_info(out)
    info, recipe = (InputFile(out / name, "put the right one back") for name in (schema.INFO, schema.RECIPE))
    return FolderHead(info.text(), recipe.text() if recipe.path.is_file() else "")


def unfinished(tasks: Mapping[str, BuildTask], journal: Journal, out: Path) -> list[str]:
    """Names of the tasks whose entry is missing, of another key, or belies the files."""
    known = [name for name, task in tasks.items() if (e := journal.entries.get(name)) is not None and e.key == task.key]
    with ThreadPoolExecutor(2) as pool:  # hashing lets go of the interpreter
        good = dict(zip(known, pool.map(lambda name: is_intact(journal.entries[name], out), known), strict=True))
    return [name for name in tasks if not good.get(name)]


def is_intact(entry: Entry, out: Path) -> bool:
    """Return True if all files of an entry are there with their bytes."""
    return all((out / name).is_file() and sha256(out / name) == digest for name, digest in entry.files.items())


def run_tasks(
    plan: Plan,
    tasks: Mapping[str, BuildTask],
    todo: list[str],
    journal: Journal,
    head: FolderHead,
    out: Path,
    pool: WorkerPool,
    console: Console,
) -> None:
    """Run the tasks of `todo`; say beforehand what that takes, and what will not be seen.

    Raises
    ------
    DatasetError
        If the disk has no room, or, when all others are done, with the tasks that failed and why. The journal has
        those that were refused; if nothing else has failed they are no error here.
    """
    chosen = [tasks[name] for name in todo]
    cost, before = forecast(plan, chosen), {name: journal.entries[name] for name in todo if name in journal.entries}
    check_disk(out, cost.size, [name for entry in before.values() for name in entry.files])
    factor = slowdown(pool.width)
    kept = f", {len(tasks) - len(todo)} of {len(tasks)} tasks are done" if len(todo) < len(tasks) else ""
    if chosen:
        console.print(cost.text(pool.width, factor) + kept, highlight=False, soft_wrap=True)
    left = set(todo)
    journal.begin(head, [name for name in tasks if name not in left])
    copy_room_files(plan.files, out)  # tasks see this folder alone
    failures = _run(chosen, Pace(cost.seconds, factor, pool.width), journal, out, pool, console) if chosen else {}
    for name, entry in before.items():
        if name in journal.entries and journal.entries[name] != entry and journal.entries[name].key == entry.key:
            console.print(f"warning: {name} came out with other bytes than the first time", highlight=False)
    if any(not failed.refused for failed in failures.values()):
        raise DatasetError(_report(failures, len(todo)))


def _run(
    tasks: list[BuildTask], pace: Pace, journal: Journal, out: Path, pool: WorkerPool, console: Console
) -> dict[str, Failed]:
    failures: dict[str, Failed] = {}
    progress = TaskProgress(tasks, pace)
    steps = Steps(console, "tasks", len(tasks), progress.left_s, progress.running_text)
    with steps, (out / schema.LOG).open("a", encoding="utf-8") as log:
        for task, outcome in schedule(tasks, progress.watch(pool.executor(len(tasks)))):
            journal.require()  # what tasks write to a folder that is gone is lost, whatever they return
            if isinstance(outcome, Done):
                journal.add(Entry(task.name, task.key, outcome.files, outcome.result))
            else:
                if outcome.refused and not any(need in failures for need in task.needs):
                    journal.add(Refusal(task.name, task.key, outcome.cause))
                failures[task.name] = outcome
            log.write(json.dumps({"time": datetime.now(UTC).isoformat(), **log_entry(task, outcome)}) + "\n")
            log.flush()
            progress.settle(task)
            steps.advance()
    return failures


def _report(failures: dict[str, Failed], count: int) -> str:
    lines = [f"{name}: {failed.cause}" for name, failed in failures.items()]
    first = (
        f"{len(failures)} of {count} tasks failed; what is finished is kept, run the same command again for the rest:"
    )
    return listed(first, lines)


# The small files, when all tasks are done.


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
    hashes |= {name: hashlib.sha256(data).hexdigest() for name, data in small.items()}
    types = {name: str(dtype) for name, dtype in to_table(rows).schema.items()}
    small[schema.CROISSANT] = dataset_croissant(parse_info(head.info), types, hashes).encode()
    hashes[schema.CROISSANT] = hashlib.sha256(small[schema.CROISSANT]).hexdigest()
    hashes |= {schema.room_file(name): digest for name, digest in plan.files.digests.items()}
    return {**small, schema.CHECKSUMS: checksums_text(hashes).encode()}


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


def differing(out: Path, wanted: Mapping[str, bytes]) -> list[str]:
    """Names of files that are missing or have other bytes."""
    return [name for name, data in wanted.items() if not (out / name).is_file() or (out / name).read_bytes() != data]


def write_documents(out: Path, wanted: Mapping[str, bytes], names: Iterable[str]) -> None:
    """Write some of the small files, in their order. Without SHA256SUMS the folder does not pass for finished.

    Raises
    ------
    DatasetError
        If a file that SHA256SUMS names is not there: it is then not written, or removed.
    """
    names = set(names)
    if names:
        (out / schema.CHECKSUMS).unlink(missing_ok=True)
        names.add(schema.CHECKSUMS)
    for name, data in wanted.items():
        if name in names:
            if name == schema.CHECKSUMS:
                _require_all(out, data)
            write_bytes(out / name, data)
    try:
        _require_all(out, wanted[schema.CHECKSUMS])  # again: a folder may go while its last file is written
    except DatasetError:
        (out / schema.CHECKSUMS).unlink(missing_ok=True)
        raise


def _require_all(out: Path, checksums: bytes) -> None:
    """Look for every file that the text of SHA256SUMS names."""
    listed = [line.split("  ", 1)[1] for line in checksums.decode().splitlines()]
    if missing := [name for name in listed if not (out / name).is_file()]:
        what = f"{len(missing)} of {len(listed)} files are gone from {out}, such as {missing[0]}"
        raise DatasetError(f"{what}: something else removed them during the run; run the same command again")


def visibility_line(rows: Sequence[ManifestRow]) -> str:
    """Say how many pairs are visible in both images, and the causes for the others with their numbers."""
    hidden = [row for row in rows if not (row.down.visible and row.up.visible)]
    text = f"{len(rows) - len(hidden)} of {len(rows)} pairs are visible in both images"
    if not hidden:
        return text
    spots = ((position, row.position(position)) for row in hidden for position in POSITIONS)
    causes = Counter(f"{position} {spot.cause}" for position, spot in spots if not spot.visible)
    return f"{text}; not visible: " + ", ".join(f"{cause} ({count})" for cause, count in causes.items())
