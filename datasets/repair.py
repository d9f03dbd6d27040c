"""Repair: what is damaged or missing is rendered again, nothing else."""

from __future__ import annotations

import json
from pathlib import Path

from rich.console import Console

from phibench.datasets import layout
from phibench.datasets.errors import DatasetError
from phibench.datasets.info import recipe_sha256
from phibench.datasets.journal import Head
from phibench.datasets.make import make_from_plan
from phibench.datasets.output import held_head
from phibench.datasets.plan import make_plan
from phibench.datasets.provenance import provenance
from phibench.datasets.recipe import Recipe
from phibench.datasets.recipe_file import parse_recipe
from phibench.datasets.shard import shard_plan


def repair(
    folder: str | Path, workers: int | None = None, console: Console | None = None, scheduler: str | None = None
) -> list[str]:
    """Make a data set whole again; return what was done: tasks by name, small files by theirs.

    Damage is found by the hashes of the journal, which `SHA256SUMS` cannot belie. Without a journal, or with lines of
    it damaged, the tasks that it does not vouch for are done again.

    Raises
    ------
        DatasetError If the folder holds no data set, if neither its journal nor its other files say what it should
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


def _recipe(folder: Path, head: Head, info: dict[str, object]) -> Recipe:
    if not head.recipe:
        raise DatasetError(f"{folder / layout.RECIPE} is missing; put the right one back")
    recipe = parse_recipe(head.recipe, f"{folder / layout.RECIPE}")
    if recipe_sha256(recipe) != info["recipe_sha256"]:
        raise DatasetError(
            f"{folder / layout.RECIPE} is not the recipe that {layout.INFO} names; put the right one back"
        )
    return recipe


def _refuse_other_code(folder: Path, made_by: dict[str, object]) -> None:
    here = provenance()
    for key in ("code_sha256", "packages", "python", "machine"):
        if here[key] != made_by[key]:
            what = key.removesuffix("_sha256")
            text = f"{folder} was made with other {what}: what is repaired here would not fit the rest"
            raise DatasetError(f"{text}; use that one, or `phibench dataset make` to make all of it again")
