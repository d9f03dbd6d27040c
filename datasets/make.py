"""Rendering of a data set: `make` turns a recipe into a folder, `dry_run` only tells tasks, bytes and seconds."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TypedDict, Unpack

from rich.console import Console

from phibench.datasets.build.dataset_build import (
    Build,
    claimed_folder,
    copy_room_files,
    finish,
    missing_room_files,
    plan_tasks,
    refuse_other,
    remove_files,
    stale_exports,
    visibility_line,
)
from phibench.datasets.build.draws_file import draws_bytes, read_draws, seen_causes, write_draws
from phibench.datasets.build.earlier_runs import (
    OR_REPLACE,
    LostWorkError,
    forget_others,
    incomplete_text,
    kept_sample_count,
    left_out_line,
    left_out_sentence,
    left_out_text,
    lost_work_text,
    possible_tasks,
    refused_samples,
    settled_samples,
)
from phibench.datasets.build.forecast import Forecast, forecast, slowdown
from phibench.datasets.build.journal import Journal
from phibench.datasets.build.room_export import damaged_exports, export_lines, export_rooms, held_files, own_files
from phibench.datasets.build.task_runner import unfinished_tasks
from phibench.datasets.build.workers import Environment, NoRendererError, WorkerPool
from phibench.datasets.common.errors import DatasetError, IncompleteError
from phibench.datasets.common.parallel import worker_count
from phibench.datasets.common.progress import progress_console
from phibench.datasets.plan.draws import Causes, unexported_rooms
from phibench.datasets.plan.pair_forecasts import pair_forecasts, pair_table, rim_lines
from phibench.datasets.plan.plan import Plan, make_plan
from phibench.datasets.recipe.checks import warnings
from phibench.datasets.recipe.load import find_recipe, parse_recipe, recipe_files, recipe_text, with_numbers
from phibench.datasets.recipe.tables import Recipe
from phibench.datasets.rooms.room_files import RoomFiles
from phibench.datasets.store import schema
from phibench.datasets.store.files import write_text
from phibench.datasets.store.metadata import dataset_info, parse_info, read_manifest
from phibench.datasets.store.provenance import code_sha256, provenance
from phibench.render.optics.truth import VISIBLE
from phibench.render.setup.variant import ENVIRONMENT
from phibench.scenes.rig import POSITIONS


@dataclass(frozen=True)
class MakeOptions:
    """Part of a recipe that is made, and what may become of work that is there.

    Attributes
    ----------
    shard : part of the recipe, "i/n"
    samples, seed : numbers instead of the recipe's `[random].samples` and `[dataset].seed`
    replace : whether finished work that does not fit may be deleted or made again; what fits is kept
    room_files : folder of the files that the recipe names for rooms; by default the recipe's own
    leave_out_refused : whether the data set is finished without the samples that are refused, if others are not
    """

    shard: str | None = None
    samples: int | None = None
    seed: int | None = None
    replace: bool = False
    room_files: str | Path | None = None
    leave_out_refused: bool = False


_AS_IT_IS = MakeOptions()


class MakeKeywords(TypedDict, total=False):
    """`MakeOptions` as keywords of `make`."""

    shard: str | None
    samples: int | None
    seed: int | None
    replace: bool
    room_files: str | Path | None
    leave_out_refused: bool


def make(
    recipe: str | Path,
    out: str | Path,
    workers: int | None = None,
    console: Console | None = None,
    scheduler: str | None = None,
    **options: Unpack[MakeKeywords],
) -> Path:
    """Render the data set of a recipe into a folder; what is finished there is kept, whatever ended the last run.

    Finished work is never deleted: a finished data set with more samples than are asked for is kept whole, and what
    would make finished work invalid is refused.

    Parameters
    ----------
    recipe : path of a TOML file, or the name of a shipped recipe
    out : folder; made if need be. It may hold this data set, unfinished or with fewer samples.
    workers : processes; by default one per core
    console : where progress goes; by default the standard error
    scheduler : address or scheduler file of a running dask scheduler, whose workers are used instead
    **options : fields of `MakeOptions`

    Returns
    -------
    out : Path

    Raises
    ------
    DatasetError
        If finished work would be lost; the folder is then as it was.
    DatasetError
        If recipe, folder or disk will not do, or a task fails (the others are finished first). Nothing is then
        half-written under a final name, and `SHA256SUMS` is missing.
    IncompleteError
        If nothing but samples by themselves cannot be made; the others are finished first, and `SHA256SUMS` is
        missing. With `leave_out_refused`, if not one sample can be made.
    """
    console, out, wanted, exported = console or progress_console(), Path(out), MakeOptions(**options), list[str]()

    def export(asked: Recipe, files: RoomFiles) -> RoomFiles:
        return _export(asked, files, out, workers, console, scheduler, wanted.replace, exported)

    plan, text, note = _planned(recipe, out, wanted, export)
    causes = seen_causes(plan)
    for warning in [*warnings(plan.recipe), *_hidden(causes)]:
        console.print(f"warning: {warning}", highlight=False, soft_wrap=True)
    draws = draws_bytes(plan, causes) if plan.recipe.random is not None else b""
    try:
        make_from_plan(plan, text, out, workers, console, scheduler, wanted, draws)
    except LostWorkError:
        remove_files(out, exported)  # the folder is as it was
        raise
    remove_files(out, stale_exports(out, plan.files))
    if note:
        console.print(note, highlight=False, soft_wrap=True)
    return out


def dry_run(recipe: str | Path, out: str | Path, workers: int | None = None, **options: Unpack[MakeKeywords]) -> str:
    """Say what `make` would do, and render and write nothing: what will be seen, how many tasks, bytes, seconds.

    Raises
    ------
    DatasetError
        If recipe or folder will not do.
    """
    out, count, wanted = Path(out), worker_count(workers), MakeOptions(**options)
    leave_out = wanted.leave_out_refused
    plan, _, note = _planned(recipe, out, wanted, lambda _, files: held_files(files, out))
    refuse_other(out, None if wanted.replace else plan.recipe.dataset.name)
    pairs, journal = list(pair_forecasts(plan)), Journal(out)
    tasks, todo, told = plan_tasks(plan, {}), [], [note] if note else []
    if journal.entries:
        build = Build(plan, "", out, journal, _environment(WorkerPool(out, count), journal)[0])
        forget_others(journal, build.tasks)
        lost = None if wanted.replace else _lost(build, leave_out)
        told += [f"will be refused: {lost}"] if lost else []
        if leave_out:
            build = build.without(settled_samples(plan, build.tasks, journal))
            plan, pairs = build.plan, list(pair_forecasts(build.plan))
        tasks, todo = build.tasks, _todo(build, leave_out)
    chosen = [tasks[name] for name in (todo if journal.entries else tasks)]
    cost = forecast(plan, chosen).text(count, slowdown(count)) if chosen else "to make: nothing"
    seen = f"{sum(pair.visible for pair in pairs)} of {len(pairs)} pairs will be visible in both images"
    told += rim_lines(plan, pairs) + [f"warning: {warning}" for warning in warnings(plan.recipe)]
    verb = "left out" if leave_out else "refused"
    told += [f"will be {verb}: {name}: {reason}" for name, reason in {**plan.left_out, **plan.refused}.items()]
    told += export_lines(unexported_rooms(plan.recipe, plan.files))
    return "\n".join([*pair_table(pairs), seen, *told, f"{cost}, {len(tasks)} tasks in all; nothing was rendered"])


def cost(recipe: str | Path, out: str | Path, samples: int | None = None) -> Forecast:
    """Cost of a whole data set, whatever of it there is; nothing is rendered or written.

    Raises
    ------
    DatasetError
        If the recipe will not do.
    """
    out = Path(out)
    wanted = MakeOptions(samples=samples, replace=True)
    plan, _, _ = _planned(recipe, out, wanted, lambda _, files: held_files(files, out))
    return forecast(plan, plan_tasks(plan, {}).values())


def _hidden(causes: Mapping[str, Causes]) -> list[str]:
    """Warn of pairs that will not be visible in both images."""
    hidden = [name for name, both in causes.items() if both != (VISIBLE, VISIBLE)]
    if not hidden:
        return []  # every spot is seen twice
    told = zip(POSITIONS, causes[hidden[0]], strict=True)
    why = " and ".join(f"{position} {cause}" for position, cause in told if cause != VISIBLE)
    text = f"{len(hidden)} of {len(causes)} pairs will not be visible in both images, such as {hidden[0]}"
    return [f"{text} ({why}); --dry-run lists them all"]


def _planned(
    recipe: str | Path, out: Path, wanted: MakeOptions, exported: Callable[[Recipe, RoomFiles], RoomFiles]
) -> tuple[Plan, str, str]:
    """Plan, text of its recipe, and a line on samples that are kept although fewer are asked for.

    `exported` sees to the files that the data set makes itself, and gives those of all rooms.
    """
    text, source, note = recipe_text(recipe), str(find_recipe(recipe)), ""
    files = recipe_files(recipe) if wanted.room_files is None else RoomFiles(Path(wanted.room_files))
    if wanted.samples is not None or wanted.seed is not None:
        text = with_numbers(text, source, wanted.samples, wanted.seed)
    asked = parse_recipe(text, source)
    held = None if wanted.replace or wanted.shard is not None else kept_sample_count(out, asked)
    if held is not None and asked.random is not None:
        text, count = with_numbers(text, source, held, None), asked.random.samples
        note = f"{out} keeps its {held} samples; the first {count} of them are those that were asked for"
    parsed = parse_recipe(text, source, files)
    if parsed.rooms is not None and parsed.rooms.exported:
        files = exported(parsed, files)
    return make_plan(parsed, files, wanted.shard, read_draws(out, parsed, files)), text, note


def _export(
    recipe: Recipe,
    files: RoomFiles,
    out: Path,
    workers: int | None,
    console: Console,
    scheduler: str | None,
    replace: bool,
    made: list[str],
) -> RoomFiles:
    """Make the files of rooms that are missing in a folder, beside copies of the recipe's own; `made` gets their names.

    Samples are drawn from what the files hold, so that this comes before the plan.
    """
    with claimed_folder(out, None if replace else recipe.dataset.name):
        remove_files(out, damaged_exports(out))
        own = own_files(recipe, files)
        made += [schema.room_file(name) for name in missing_room_files(own, out)]
        copy_room_files(own, out)
        held = RoomFiles(out / schema.ROOM_FILES, own.digests)
        if todo := unexported_rooms(recipe, held):
            with WorkerPool(out, worker_count(workers), scheduler) as pool:
                pool.environment()  # tells where nothing can be rendered, and connects to a scheduler
                export_rooms(todo, recipe.ambient, pool, console, made)
    return held


def make_from_plan(
    plan: Plan,
    recipe: str,
    out: Path,
    workers: int | None,
    console: Console,
    scheduler: str | None = None,
    wanted: MakeOptions = _AS_IT_IS,
    draws: bytes = b"",
) -> list[str]:
    """Make what is unfinished or damaged of a plan; return the names of the tasks done and documents written.

    Of what is `wanted`, `replace` and `leave_out_refused` count. `draws` are kept for the next start.
    """
    with (
        claimed_folder(out, None if wanted.replace else plan.recipe.dataset.name),
        WorkerPool(out, worker_count(workers), scheduler) as pool,
        Journal(out) as journal,
    ):
        if draws:
            write_draws(out, draws)
        return _make(plan, recipe, out, pool, journal, console, wanted)


def _make(
    plan: Plan, recipe: str, out: Path, pool: WorkerPool, journal: Journal, console: Console, wanted: MakeOptions
) -> list[str]:
    leave = wanted.leave_out_refused
    started, began = time.monotonic(), datetime.now(UTC)
    environment, no_renderer = _environment(pool, journal)
    whole = Build(plan, recipe, out, journal, environment)
    forget_others(journal, whole.tasks)
    if not wanted.replace and (lost := _lost(whole, leave)):
        raise LostWorkError(lost)
    settled = settled_samples(plan, whole.tasks, journal) if leave else {}
    build = whole.without(settled)
    todo = _todo(build, leave)
    if todo and no_renderer is not None:
        what = f"{len(todo)} of {len(build.tasks)} tasks are to be done, such as '{todo[0]}'"
        raise DatasetError(f"{what}, and {no_renderer}") from no_renderer
    copies = missing_room_files(build.plan.files, out)
    if todo or (build.plan.refused and not leave):
        (out / schema.CHECKSUMS).unlink(missing_ok=True)
        build.run(todo, pool, console)
    refused = settled | refused_samples(build.plan, build.tasks, journal)
    if refused and not (leave and len(refused) < len(plan.sample_ids)):
        (out / schema.CHECKSUMS).unlink(missing_ok=True)
        raise IncompleteError(incomplete_text(plan, refused))
    if refused != settled:
        build = whole.without(refused)
    journal.keep_refusals(whole.tasks)
    left_out, pairs, was_written = (
        build.plan.left_out,
        len(build.plan.pairs),
        journal.is_written(build.head, build.tasks),
    )
    changed = finish(build.plan, build.head, journal, build.tasks, out)
    if not todo and not changed and not copies:
        told = "nothing to do" if was_written else "its journal is written anew"
        said = f"; {left_out_line(left_out, pairs)}" if left_out else ""
        console.print(f"{out} is complete, {told}{said}", highlight=False, soft_wrap=True)
        return [] if was_written else [schema.JOURNAL]
    _write_run(out, pool.width, began, time.monotonic() - started)
    console.print(f"{out}: {visibility_line(read_manifest(out))}", highlight=False, soft_wrap=True)
    if left_out:
        console.print(f"{out}: {left_out_text(left_out, pairs)}", highlight=False, soft_wrap=True, markup=False)
    return [*(name for name in todo if name in build.tasks), *(schema.room_file(name) for name in copies), *changed]


def _lost(build: Build, leave_out: bool) -> str | None:
    """Sentence on what a run would lose: finished work, or the end of a data set that leaves samples out."""
    keys = {name: task.key for name, task in build.tasks.items()}
    if lost := lost_work_text(build.out, keys, build.journal, dataset_info(build.plan, build.environment)):
        return f"{lost}; {OR_REPLACE}"
    return None if leave_out else left_out_sentence(build.out, build.journal)


def _todo(build: Build, leave_out: bool) -> list[str]:
    """Names of the tasks that are to be done: all that are not whole, without those that cannot be done."""
    todo = unfinished_tasks(build.tasks, build.journal, build.out)
    return possible_tasks(todo, build.tasks, build.journal) if leave_out else todo


def _environment(pool: WorkerPool, journal: Journal) -> tuple[Environment, NoRendererError | None]:
    """Environment of the workers; where they cannot render, that of the folder, and the reason.

    Nothing can be rendered then. `[frames]` may be changed all the same, and small files are written anew.
    """
    try:
        return pool.environment(), None
    except NoRendererError as error:
        if journal.head is None:
            raise
        try:
            held = parse_info(journal.head.info).provenance
        except ValueError:  # of another version
            raise error from None
        return {**held, "commit": provenance()["commit"], "code_sha256": code_sha256()}, error


def _write_run(out: Path, count: int, began: datetime, seconds: float) -> None:
    """Write what differs between two equal runs; SHA256SUMS leaves this file out."""
    document = {
        "began": began.isoformat(timespec="seconds"),
        "seconds": round(seconds, 3),
        "workers": count,
        "cores": os.cpu_count(),
    }
    write_text(out / schema.RUN, json.dumps(document, indent=1) + "\n")


def make_with_variant(variant: str, recipe: str, out: Path) -> Path:
    """Make a data set with a variant of Mitsuba, in a process of its own, with its own light maps; return the folder.

    Raises
    ------
    DatasetError
        With the last line that the process said, if it fails.
    """
    command = [sys.executable, "-m", "phibench", "dataset", "make", recipe, "--out", str(out), "--workers", "1"]
    environment = {**os.environ, ENVIRONMENT: variant, "XDG_CACHE_HOME": str(out.parent / f"{out.name}-cache")}
    child = subprocess.run(command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if child.returncode != 0:
        last = (child.stderr.strip().splitlines() or [f"exit status {child.returncode}"])[-1]
        raise DatasetError(f"{variant} does not render: {last.removeprefix('phibench: ')}")
    return out
