"""Films of a recipe made in a folder (`make_films`), a task each, keyed by a hash of its inputs; finished ones kept.

`build.task_runner` runs the tasks. A killed run loses the view that it was at: `film_task` makes a film view by view.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import polars
from rich.console import Console

from phibench.datasets.build.journal import Journal
from phibench.datasets.build.task_runner import bring_all, unfinished_tasks
from phibench.datasets.build.tasks import BuildTask
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.progress import progress_console
from phibench.datasets.film.drive_collisions import check_drives
from phibench.datasets.film.film_plan import FilmPlan, film_plans
from phibench.datasets.film.film_store import (
    FILM,
    INFO,
    RECIPE,
    SCHEMA_VERSION,
    FilmFolder,
    SetInfo,
    document_text,
    read_document,
)
from phibench.datasets.film.film_task import make_film
from phibench.datasets.plan.plan import Plan
from phibench.datasets.recipe.load import find_recipe, parse_recipe, recipe_files, recipe_text
from phibench.datasets.store.checksums import filling, with_checksums, write_documents
from phibench.datasets.store.croissant import films_croissant
from phibench.datasets.store.provenance import code_behind, code_sha256
from phibench.datasets.store.schema import CROISSANT, TruthFolder


@dataclass(frozen=True)
class FilmsMade:
    """Outcome: the folder, and the films made and kept."""

    folder: Path
    made: tuple[str, ...]
    kept: tuple[str, ...]


def make_films(
    recipe: str | Path, out: str | Path, workers: int | None = None, console: Console | None = None
) -> FilmsMade:
    """Make the films of a recipe in a folder; films that are there and unchanged are kept.

    Raises
    ------
    DatasetError
        If recipe, folder or disk will not do, or no number of key views is enough; in one sentence.
    """
    out, console = Path(out), console or progress_console()
    text = recipe_text(recipe)
    parsed = parse_recipe(text, str(find_recipe(recipe)), recipe_files(recipe))
    plan, films = film_plans(parsed, recipe_files(recipe))
    check_drives(plan, films)
    dataset, tasks = plan.recipe.dataset, film_tasks(plan, films)
    with filling(out, lambda: _refuse_other(out, dataset.name)):
        brought = bring_all(tasks, out, workers, console, "films", diary=True)
        names = tuple(film.film_id for film in films)
        info = SetInfo(
            schema_version=SCHEMA_VERSION, name=dataset.name, seed=dataset.seed, code_sha256=code_sha256(), films=names
        )
        types = polars.read_parquet_schema(FilmFolder.of(out, names[0]).path / FILM)
        kinds = {column: str(dtype) for column, dtype in types.items()}
        documents = {
            RECIPE: text.encode(),
            INFO: document_text(info).encode(),
            CROISSANT: films_croissant(dataset.name, version("phibench"), len(names), kinds).encode(),
        }
        write_documents(out, with_checksums(documents, brought.hashes))
    made = tuple(film.film_id for film, name in zip(films, tasks, strict=True) if name in brought.made)
    return FilmsMade(out, made, tuple(name for name in names if name not in made))


def unfinished_films(plan: Plan, films: Sequence[FilmPlan], out: Path) -> list[FilmPlan]:
    """Films that `make_films` would make in a folder; nothing is written.

    Raises
    ------
    DatasetError
        If the folder holds something else.
    """
    _refuse_other(out, plan.recipe.dataset.name)
    tasks = film_tasks(plan, films)
    todo = unfinished_tasks(tasks, Journal(out), out)
    return [film for film, name in zip(films, tasks, strict=True) if name in todo]


def film_tasks(plan: Plan, films: Sequence[FilmPlan]) -> dict[str, BuildTask]:
    """Tasks by name, in the order of the films."""
    code = code_behind("phibench.datasets.film.film_task")
    keys = {film.film_id: film_key(plan, film, code) for film in films}
    tasks = [
        BuildTask(f"film {film.film_id}", keys[film.film_id], make_film, (plan, keys[film.film_id], film))
        for film in films
    ]
    return {task.name: task for task in tasks}


def film_key(plan: Plan, film: FilmPlan, code: str) -> str:
    """SHA-256 over all that a film depends on."""
    ambient = plan.recipe.ambient.model_dump(mode="json")
    document = [repr(film), plan.room(film.pair.room).digest, ambient, code]
    return hashlib.sha256(json.dumps(document).encode()).hexdigest()


def _refuse_other(out: Path, name: str) -> None:
    """Raise `DatasetError` for a folder of something else."""
    if out.is_file():
        raise DatasetError(f"{out} is a file; give a folder")
    if not out.is_dir():
        return  # a new folder
    if (out / TruthFolder.DATASET).exists():
        raise DatasetError(f"{out} holds a data set of pairs; give another folder for its films")
    if (out / INFO).is_file() and (held := read_document(out / INFO, SetInfo).name) != name:
        raise DatasetError(f"{out} holds the films of '{held}', not of '{name}'; give another folder")
