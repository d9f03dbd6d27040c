"""Making a data set: recipe in, folder out. One function; every step is in a module of its own."""

from __future__ import annotations

import json
import os
import time
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

from phibench.datasets import layout
from phibench.datasets.errors import DatasetError
from phibench.datasets.files import WriteError, remove_temporary, write_bytes, write_text
from phibench.datasets.info import dataset_info, info_text, recipe_sha256
from phibench.datasets.manifest import write_manifest
from phibench.datasets.output import bytes_needed, check_disk, claim, is_complete
from phibench.datasets.plan import Plan, make_plan
from phibench.datasets.progress import Steps
from phibench.datasets.recipe_checks import warnings
from phibench.datasets.recipe_file import find_recipe, load_recipe
from phibench.datasets.sample_preview import write_preview
from phibench.datasets.schema import DatasetInfo, ManifestRow
from phibench.datasets.spot_task import make_rows
from phibench.datasets.sums import write_sums
from phibench.datasets.view_task import render_view, start_renderer
from phibench.datasets.visibility import visibility_line
from phibench.datasets.workers import Pool, Task


def make(recipe: str | Path, out: str | Path, workers: int | None = None, console: Console | None = None) -> Path:
    """Render the data set of a recipe into a folder.

    Parameters
    ----------
    recipe : path of a TOML file, or the name of a shipped recipe
    out : folder; made if need be. A finished one of the same recipe and code is left alone, an unfinished one redone.
    workers : processes; by default one per core
    console : where progress goes; by default the standard error

    Returns
    -------
    out : Path

    Raises
    ------
    DatasetError
        If recipe, folder or disk will not do, a sample is refused, or a worker fails. Nothing is then half-written
        under a final name, and `SHA256SUMS` is missing.
    """
    console, out = console or Console(stderr=True), Path(out)
    count = workers if workers is not None else os.cpu_count() or 1
    if count < 1:
        raise DatasetError(f"--workers: workers = {count}, at least 1 is needed")
    plan = make_plan(load_recipe(recipe))
    for warning in warnings(plan.recipe):
        console.print(f"warning: {warning}", highlight=False, soft_wrap=True)
    claim(out, plan.recipe.dataset.name, recipe_sha256(plan.recipe))
    try:
        _make(plan, find_recipe(recipe).read_bytes(), out, count, console)
    except OSError as error:
        text = str(error) if isinstance(error, WriteError) else f"could not write to {out}: {error}"
        raise DatasetError(f"{text}; then run the same command again") from error
    finally:
        remove_temporary(out)
    return out


def _make(plan: Plan, recipe: bytes, out: Path, count: int, console: Console) -> None:
    started, began = time.monotonic(), datetime.now(UTC)
    with Pool(min(count, len(plan.poses))) as pool:
        [(_, environment)] = pool.run([Task("starting Mitsuba", start_renderer)])
        info = dataset_info(plan, environment)
        if is_complete(out, info):
            console.print(f"{out} is complete, nothing to do", highlight=False)
            return
        check_disk(out, bytes_needed(plan))
        _begin(out, info, recipe)
        rows = _spots(plan, out, console)
        write_manifest(out, rows)
        _views(plan, out, pool, console)
        _previews(out, rows, pool, console)
    _write_run(out, count, began, time.monotonic() - started)
    write_sums(out)
    console.print(f"{out}: {visibility_line(rows)}", highlight=False, soft_wrap=True)


def _begin(out: Path, info: DatasetInfo, recipe: bytes) -> None:
    """Mark the folder as this data set's, and as unfinished."""
    (out / layout.SUMS).unlink(missing_ok=True)
    write_text(out / layout.INFO, info_text(info))
    write_bytes(out / layout.RECIPE, recipe)


def _spots(plan: Plan, out: Path, console: Console) -> list[ManifestRow]:
    with Steps(console, "spots", len(plan.pairs)) as steps:
        return make_rows(plan, out, steps.advance)


def _views(plan: Plan, out: Path, pool: Pool, console: Console) -> None:
    recipe = plan.recipe
    tasks = [
        Task(f"view {pose.pose_id}", render_view, (recipe.dataset.name, plan.rig, plan.room, pose, recipe.ambient, out))
        for pose in plan.poses
    ]
    _run(pool, tasks, "views", console)


def _previews(out: Path, rows: list[ManifestRow], pool: Pool, console: Console) -> None:
    tasks = [Task(f"preview {row.sample_id}", write_preview, (out, row.sample_id)) for row in rows]
    _run(pool, tasks, "previews", console)


def _run(pool: Pool, tasks: list[Task], title: str, console: Console) -> None:
    with Steps(console, title, len(tasks)) as steps:
        for _ in pool.run(tasks):
            steps.advance()


def _write_run(out: Path, count: int, began: datetime, seconds: float) -> None:
    """Write what differs between two equal runs; SHA256SUMS leaves this file out."""
    document = {
        "began": began.isoformat(timespec="seconds"),
        "seconds": round(seconds, 3),
        "workers": count,
        "cores": os.cpu_count(),
    }
    write_text(out / layout.RUN, json.dumps(document, indent=1) + "\n")
