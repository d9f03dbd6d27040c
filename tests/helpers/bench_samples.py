"""Data sets of many samples that share the rendered layers of one, and a method and a harness for tests."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from phibench.datasets.read import Dataset, open_dataset
from phibench.datasets.recipe.tables import Recipe
from phibench.estimator.interface import Answer, Outcome, Pair, Spot
from phibench.estimator.pair_set import PairSet


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


def guess(pair: Pair) -> Answer:
    """Brightest pixel: deterministic, and of this pair."""
    image = pair.down if pair.down.ndim == 2 else pair.down[..., 0]
    v, u = np.unravel_index(int(image.argmax()), image.shape)
    found = Spot((float(u), float(v)), ((0.1, 0.01), (0.01, 0.2)), 0.5, "normal")
    return Answer(found, Spot.missing("not looked for"), 2.0, math.inf)


def run(_: str, pairs: PairSet) -> Sequence[Outcome]:
    """Harness of these tests: in this process; pair 1 fails."""
    outcomes = [Outcome(i, guess(pairs.pair(i)), 0.25) for i in range(len(pairs)) if i != 1]
    return [*outcomes, Outcome(1, None, math.nan, "error", "ValueError: no spot")]


def describe(reference: str) -> dict[str, str | None]:
    """Outcomes of a method in a file."""
    place, _, function = reference.rpartition(":")
    digest = hashlib.sha256(Path(place).read_bytes()).hexdigest() if place else None
    return {"name": Path(place).stem, "kind": "file", "place": place, "function": function, "sha256": digest}
