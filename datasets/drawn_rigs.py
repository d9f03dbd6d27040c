"""The rigs of `[rigs]`: misalignments that are drawn once per rig, and seen by all experiments.

Rig k is a function of the recipe's seed and distributions, and of k: more rigs change none. A rig that is impossible,
or cannot make one of the strokes, is drawn again from streams of its own (`sampling.further_points`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from phibench.datasets.distribution import DistributionTable, quantile
from phibench.datasets.errors import RecipeError
from phibench.datasets.random_samples import TRIES, Value, drawn_misalignment, rig_fault
from phibench.datasets.recipe import Recipe, RigsTable
from phibench.datasets.recipe_places import Boards
from phibench.datasets.recipe_scene import build_target, ceiling_m, true_stroke_m
from phibench.datasets.sampling import first_points, further_points
from phibench.scenes.checks import SceneError
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig
from phibench.scenes.room import Room

_PREFIX = "misalignment."


@dataclass(frozen=True)
class DrawnRig:
    """A drawn rig.

    Attributes
    ----------
    rig_id : str
        Such as ``r000002``, the third one.
    tries : int
        Which draw was the first possible one.
    drawn : tuple of (parameter, value)
        Parameters as in `sampling.PARAMETERS`.
    misalignment : Misalignment
    rig : Rig, the true one
    """

    rig_id: str
    tries: int
    drawn: tuple[tuple[str, Value], ...]
    misalignment: Misalignment
    rig: Rig


def draw_rigs(recipe: Recipe, table: RigsTable, nominal: Rig, room: Room) -> tuple[DrawnRig, ...]:
    """All rigs of a recipe with `[rigs]`.

    Raises
    ------
    RecipeError
        If a rig stays impossible after `TRIES` draws, with the reason of the last one.
    """
    chosen = _distributions(table)
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
        strokes_m = {true_stroke_m(misalignment, h) for one in recipe.experiments for h in one.strokes_m}
    except SceneError as error:
        return str(error)
    faults = (rig_fault(rig, stroke_m, top_m, boards) for stroke_m in sorted(strokes_m))
    why = next((fault for fault in faults if fault), None)
    return why or DrawnRig(f"r{number:06d}", tries, tuple(drawn.items()), misalignment, rig)


def _distributions(table: RigsTable) -> dict[str, DistributionTable]:
    """Distribution by parameter, in the order of `[misalignment]`."""
    given = ((key, getattr(table.misalignment, key)) for key in type(table.misalignment).model_fields)
    return {_PREFIX + key: one for key, one in given if isinstance(one, DistributionTable)}


def _row(values: Mapping[str, Array], k: int) -> dict[str, Value]:
    return {name: float(np.asarray(column)[k]) for name, column in values.items()}
