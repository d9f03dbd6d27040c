"""What a run will take: bytes and seconds, from what each kind of task took on one core.

CPU seconds on one core of a 2-core AMD EPYC virtual machine, llvm_ad_rgb, room `lab`, 1280 x 720; another machine
differs by its speed. `make benchmark` shows the forecast beside a run.
The light map is counted as if no cache held it.

The output folder: may it be written, does it hold another data set, is there room, what in it is of the past.

Which tasks of a folder are left, and doing them, with a journal entry and a log line for each.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

from phibench.datasets.build.journal import Entry, Head, Journal
from phibench.datasets.build.scheduler import dispatch
from phibench.datasets.build.tasks import Done, Failed, Task, log_entry
from phibench.datasets.build.workers import Crew
from phibench.datasets.errors import DatasetError
from phibench.datasets.plan.plan import Plan
from phibench.datasets.progress import Steps
from phibench.datasets.store import schema
from phibench.datasets.store.documents import read_info
from phibench.datasets.store.files import TEMPORARY_PREFIX, sha256, write_bytes
from phibench.render.room.light_map import fixed_shapes
from phibench.render.room.shading import cut, texel_count

# Seconds.
START_S = 6.0  # workers, Mitsuba in each, first kernels, hashes
VIEW_S = 0.8
VIEW_S_PER_MEGAPIXEL = 4.5  # refinement, truth, encoding, fsync
VIEW_S_PER_MEGASAMPLE = 0.1  # look-ups in the light map, a million of them
BAKE_S_PER_MEGARAY = 0.13  # of the light map; none where the user's cache has it
SPOT_S = 0.4  # two positions with their certificates
SAMPLE_S_PER_MEGAPIXEL = 0.7  # picture, noise budget

# Bytes.
_AMBIENT_BYTES_PX = 24.0  # six noisy float32 planes do not compress
_TRUTH_BYTES_PX = 13.5  # ten float32 planes; what is outside the mirror compresses to nothing
_PREVIEW_BYTES_PX = 2.8
_SPOT_BYTES = 8192
_TEXEL_BYTES = 25.0  # six float32 and a bool
_RESERVE = 1.1


@dataclass(frozen=True)
class Estimate:
    """How many tasks of each kind, how many bytes on the disk, how many seconds of one core, how many of them alone."""

    counts: dict[str, int]
    size: int
    core_s: float
    alone_s: float  # the light map: views wait for it, and it is one task

    def text(self, workers: int) -> str:
        """One sentence for the terminal."""
        counts = ", ".join(f"{n} {kind}{'s' * (n != 1)}" for kind, n in self.counts.items() if n)
        shared_s = (self.core_s - self.alone_s) / max(min(workers, sum(self.counts.values())), 1)
        seconds = START_S + self.alone_s + shared_s
        took = f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"
        return f"to make: {counts}; about {megabytes(self.size)}, {took} with {workers} worker{'s' * (workers != 1)}"


def estimate(plan: Plan, tasks: Collection[Task]) -> Estimate:
    """Cost of these tasks of a plan."""
    counts = {kind: sum(task.kind == kind for task in tasks) for kind in dict.fromkeys(task.kind for task in tasks)}
    pixels = plan.rig.camera.width_px * plan.rig.camera.height_px
    size = {
        "bake": _TEXEL_BYTES * _texels(plan),
        "view": pixels * (_AMBIENT_BYTES_PX + _TRUTH_BYTES_PX + _PREVIEW_BYTES_PX),
        "spot": 2.0 * _SPOT_BYTES,
        "sample": 0.5 * pixels * _PREVIEW_BYTES_PX,
    }
    seconds = _seconds(plan, pixels / 1e6)
    spent = {kind: count * seconds.get(kind, 0.0) for kind, count in counts.items()}
    total = sum(count * size.get(kind, 0.0) for kind, count in counts.items())
    return Estimate(counts, int(_RESERVE * total), sum(spent.values()), spent.get("bake", 0.0))


def megabytes(count: int) -> str:
    """Bytes for people."""
    return f"{count / 1e6:.0f} MB" if count < 5e9 else f"{count / 1e9:.0f} GB"


def _bake_rays(plan: Plan) -> float:
    """Rays of a light map: texels times rays per texel."""
    ambient, lamps = plan.recipe.ambient, sum(surface.emits for surface in plan.room.surfaces)
    rays = ambient.bounces * ambient.bounce_rays + 2 * (lamps * ambient.lamp_rays + ambient.final_rays)
    return float(rays * _texels(plan))


def _texels(plan: Plan) -> int:
    return texel_count(cut(fixed_shapes(plan.room), plan.recipe.ambient.texel_m))


def _seconds(plan: Plan, megapixels: float) -> dict[str, float]:
    ambient = plan.recipe.ambient
    samples = megapixels * 2 * ambient.cells_per_pixel**2 * VIEW_S_PER_MEGASAMPLE
    return {
        "bake": _bake_rays(plan) / 1e6 * BAKE_S_PER_MEGARAY,
        "view": VIEW_S + megapixels * VIEW_S_PER_MEGAPIXEL + samples,
        "spot": SPOT_S,
        "sample": megapixels * SAMPLE_S_PER_MEGAPIXEL,
    }


_OWN = ".phibench-"  # locks, and temporary files that a killed run left


def claim(out: Path, name: str) -> None:
    """Make the folder, refuse one that holds something else, try to write to it.

    Raises
    ------
    DatasetError
        With one sentence that says what to do.
    """
    if out.exists() and not out.is_dir():
        raise DatasetError(f"{out} is a file; give a folder")
    _refuse_other(out, name)
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_bytes(out / f"{TEMPORARY_PREFIX}probe", b"").unlink()
    except OSError as error:
        raise DatasetError(f"cannot write to {out}: {error.strerror or error}; give another folder") from error


def check_disk(out: Path, needed: int, replaced: Collection[str]) -> None:
    """Refuse when the disk has no room; files that will be replaced count as free."""
    held = sum(path.stat().st_size for name in replaced if (path := out / name).is_file())
    free = shutil.disk_usage(out).free + held
    if needed > free:
        text = f"about {megabytes(needed)} are needed and {megabytes(free)} are free at {out}"
        raise DatasetError(f"{text}; free some space or give a folder on another disk")


def stale_files(out: Path, expected: Collection[str]) -> list[str]:
    """Files that are called like a task's and that no task of now writes: of removed samples and poses."""
    below = (path for top in ("views", "spots", "previews") for path in (out / top).rglob("*"))
    names = [path.relative_to(out).as_posix() for path in (*out.glob(schema.LIGHT_MAP), *below)]
    wanted = set(expected)
    return sorted(name for name in names if schema.is_task_file(name) and name not in wanted)


def remove_files(out: Path, names: Collection[str]) -> None:
    """Delete files, and the folders that this empties."""
    for name in names:
        path = out / name
        path.unlink(missing_ok=True)
        if not any(path.parent.iterdir()):
            path.parent.rmdir()


def held_head(out: Path) -> Head | None:
    """What the folder says it holds: by its journal, else by its `dataset.json`; None for an empty one.

    Raises
    ------
    DatasetError
        If it holds something else.
    """
    if not out.is_dir() or all(path.name.startswith(_OWN) for path in out.iterdir()):
        return None
    head = Journal(out).head
    if head is not None:
        return head
    if not (out / schema.INFO).is_file():
        raise DatasetError(f"{out} is not empty and holds no data set; give an empty or a new folder")
    read_info(out)
    recipe = (out / schema.RECIPE).read_text(encoding="utf-8") if (out / schema.RECIPE).is_file() else ""
    return Head((out / schema.INFO).read_text(encoding="utf-8"), recipe)


def _refuse_other(out: Path, name: str) -> None:
    head = held_head(out)
    if head is not None and (held := json.loads(head.info)["name"]) != name:
        raise DatasetError(f"{out} holds another data set ('{held}'); give another folder or delete it")


_TOLD = 20  # failures that are told in full


def unfinished(tasks: Mapping[str, Task], journal: Journal, out: Path) -> list[str]:
    """Names of the tasks whose entry is missing, of another key, or belies the files."""
    known = [name for name, task in tasks.items() if (e := journal.entries.get(name)) is not None and e.key == task.key]
    with ThreadPoolExecutor(2) as pool:  # hashing lets go of the interpreter
        good = dict(zip(known, pool.map(lambda name: is_intact(journal.entries[name], out), known), strict=True))
    return [name for name in tasks if not good.get(name)]


def is_intact(entry: Entry, out: Path) -> bool:
    """Whether all files of an entry are there with their bytes."""
    return all((out / name).is_file() and sha256(out / name) == digest for name, digest in entry.files.items())


def finish_tasks(
    plan: Plan,
    tasks: Mapping[str, Task],
    todo: list[str],
    journal: Journal,
    head: Head,
    out: Path,
    crew: Crew,
    console: Console,
) -> None:
    """Do the tasks of `todo`; say beforehand what that means.

    Raises
    ------
    DatasetError
        If the disk has no room, or, when all others are done, with the tasks that failed and why.
    """
    chosen = [tasks[name] for name in todo]
    cost, before = estimate(plan, chosen), {name: journal.entries[name] for name in todo if name in journal.entries}
    check_disk(out, cost.size, [name for entry in before.values() for name in entry.files])
    kept = f", {len(tasks) - len(todo)} of {len(tasks)} tasks are done" if len(todo) < len(tasks) else ""
    console.print(cost.text(crew.width) + kept, highlight=False, soft_wrap=True)
    left = set(todo)
    journal.begin(head, [name for name in tasks if name not in left])
    failures = _run(chosen, journal, out, crew, console)
    for name, entry in before.items():
        if name in journal.entries and journal.entries[name] != entry and journal.entries[name].key == entry.key:
            console.print(f"warning: {name} came out with other bytes than the first time", highlight=False)
    if failures:
        raise DatasetError(_report(failures, len(todo)))


def _run(tasks: list[Task], journal: Journal, out: Path, crew: Crew, console: Console) -> dict[str, Failed]:
    failures: dict[str, Failed] = {}
    with Steps(console, "tasks", len(tasks)) as steps, (out / schema.LOG).open("a", encoding="utf-8") as log:
        for task, outcome in dispatch(tasks, crew.executor(len(tasks))):
            if isinstance(outcome, Done):
                journal.add(Entry(task.name, task.key, outcome.files, outcome.result))
            else:
                failures[task.name] = outcome
            log.write(json.dumps({"time": datetime.now(UTC).isoformat(), **log_entry(task, outcome)}) + "\n")
            log.flush()
            steps.advance()
    return failures


def _report(failures: dict[str, Failed], count: int) -> str:
    lines = [f"  {name}: {failed.cause}" for name, failed in list(failures.items())[:_TOLD]]
    more = [f"  and {len(failures) - _TOLD} more, see {schema.LOG}"] if len(failures) > _TOLD else []
    first = (
        f"{len(failures)} of {count} tasks failed; what is finished is kept, run the same command again for the rest:"
    )
    return "\n".join([first, *lines, *more])
