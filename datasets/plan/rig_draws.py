"""Random rigs of a recipe with `[rigs]`: misalignments that are drawn, again where a rig is impossible.

Impossible is a rig that cannot exist, or cannot make one of the strokes in its room.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from phibench.datasets.common.errors import RecipeError
from phibench.datasets.plan.sampling import (
    PREFIX,
    TRIES,
    Value,
    drawn_misalignment,
    first_points,
    further_points,
    rig_fault,
)
from phibench.datasets.recipe.build import build_target, by_keys, ceiling_m, true_stroke_m
from phibench.datasets.recipe.distributions import DistributionTable, quantile
from phibench.datasets.recipe.spot_placement import Boards
from phibench.datasets.recipe.tables import DrawnRigsTable, Recipe
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig
from phibench.scenes.room import Room
from phibench.scenes.validation import SceneError


@dataclass(frozen=True)
class DrawnRig:
    """A drawn rig.

    Attributes
    ----------
    rig_id : str
        Such as ``r000002``, the third one.
    tries : int
        Number of the first draw that was possible.
    drawn : tuple of (parameter, value)
        Parameters as in `PARAMETERS`.
    misalignment : Misalignment
    rig : Rig, the true one
    """

    rig_id: str
    tries: int
    drawn: tuple[tuple[str, Value], ...]
    misalignment: Misalignment
    rig: Rig


def draw_rigs(recipe: Recipe, table: DrawnRigsTable, nominal: Rig, room: Room) -> tuple[DrawnRig, ...]:
    """All rigs of a recipe with `[rigs]`.

    Raises
    ------
    RecipeError
        If a rig stays impossible after `TRIES` draws, with the reason of the last one.
    """
    chosen = _rig_distributions(table)
    first = first_points("independent", recipe.dataset.name, recipe.dataset.seed, table.count, chosen)
    values = {name: quantile(chosen[name], u) for name, u in first.items()}
    top_m, boards = ceiling_m(room), Boards([build_target(target) for target in recipe.targets])
    return tuple(_possible(recipe, chosen, _row(values, k), k, nominal, top_m, boards) for k in range(table.count))


def _possible(
    recipe: Recipe,
    chosen: Mapping[str, DistributionTable],
    drawn: dict[str, Value],
    number: int,
    nominal: Rig,
    top_m: float,
    boards: Boards,
) -> DrawnRig:
    for attempt in range(TRIES):
        if attempt:
            points = further_points(recipe.dataset.name, recipe.dataset.seed, chosen, [number], attempt)
            drawn = _row({name: quantile(chosen[name], u) for name, u in points.items()}, 0)
        made = _made(recipe, drawn, number, attempt + 1, nominal, top_m, boards)
        if isinstance(made, DrawnRig):
            return made
    text = f"rig {number} stays impossible in {TRIES} draws; the last: {made}"
    raise RecipeError(f"rigs: {text}; narrow the distributions, move the boards or shorten the strokes")


def _made(
    recipe: Recipe, drawn: dict[str, Value], number: int, tries: int, nominal: Rig, top_m: float, boards: Boards
) -> DrawnRig | str:
    """The rig, or why it is impossible."""
    try:
        misalignment = drawn_misalignment(recipe.misalignment, drawn)
        rig = nominal.perturbed(misalignment)
        strokes_m = {true_stroke_m(misalignment, h) for experiment in recipe.experiments for h in experiment.strokes_m}
    except SceneError as error:
        return by_keys(str(error))
    faults = (rig_fault(rig, stroke_m, top_m, boards) for stroke_m in sorted(strokes_m))
    why = next((fault for fault in faults if fault), None)
    return why or DrawnRig(f"r{number:06d}", tries, tuple(drawn.items()), misalignment, rig)


def _rig_distributions(table: DrawnRigsTable) -> dict[str, DistributionTable]:
    """Distribution by parameter, in the order of `[misalignment]`."""
    given = ((key, getattr(table.misalignment, key)) for key in type(table.misalignment).model_fields)
    return {PREFIX + key: distribution for key, distribution in given if isinstance(distribution, DistributionTable)}


def _row(values: Mapping[str, Array], k: int) -> dict[str, Value]:
    return {name: float(np.asarray(column)[k]) for name, column in values.items()}
