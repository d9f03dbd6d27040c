"""Data sets of many samples that share the rendered layers of one: for tests of what is drawn per sample."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from phibench.datasets.read import Dataset, open_dataset
from phibench.datasets.recipe import Recipe


def many(folder: Path, count: int, /, **tables: Any) -> Dataset:
    """`count` copies of the first sample under other names, with depths that rise; `tables` replace the recipe's."""
    dataset = with_tables(open_dataset(folder), **tables)
    first = dataset.rows[0]
    rows = (first.model_copy(update={"sample_id": f"random-{i:06d}", "depth_m": 1.0 + i}) for i in range(count))
    return replace(dataset, rows=tuple(rows))


def with_tables(dataset: Dataset, /, **tables: Any) -> Dataset:
    """The data set as if its recipe had other tables that are not rendered; None takes a table away."""
    recipe = {**dataset.info.recipe, **tables}
    Recipe.model_validate(recipe)
    return replace(dataset, info=dataset.info.model_copy(update={"recipe": recipe}))


def hidden(dataset: Dataset, *positions: str) -> Dataset:
    """The data set as if the first sample's spot were behind a crate."""
    row = dataset.rows[0]
    spots = {p: row.position(p).model_copy(update={"visible": False, "cause": "occluded:crate"}) for p in positions}
    return replace(dataset, rows=(row.model_copy(update=spots), *dataset.rows[1:]))
