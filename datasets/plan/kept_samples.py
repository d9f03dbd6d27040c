"""Samples that were drawn before, made again from what took long to find.

To find the draw of a sample that is possible, its room is built and rays are traced in it. The number of that draw and
its spot are kept; rig and stroke follow from the draw's numbers in a millisecond, to the same bits, without a room.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from phibench.datasets.plan.sampling import (
    RandomSample,
    draw_values,
    drawn_parameters,
    drawn_rigs,
    first_points,
    points_of,
    rows_of,
)
from phibench.datasets.recipe.build import make_spot
from phibench.datasets.recipe.tables import RandomTable, Recipe
from phibench.scenes.frames import Vector
from phibench.scenes.laser import LaserSpot
from phibench.scenes.validation import SceneError

Causes = tuple[str, str]
"""Causes of both views, down and up, as in `render.optics.truth`."""


@dataclass(frozen=True)
class KeptSample:
    """Outcome of a sample's draws; the vectors are those of its spot."""

    tries: int
    surface: str
    position_world_m: Vector
    normal_world: Vector
    diameter_m: float
    beam_direction_world: Vector | None
    causes: Causes


Kept = Mapping[int, KeptSample | str]
"""Outcome by number of a sample; of one that stays impossible its reason."""


def rebuilt(
    recipe: Recipe, table: RandomTable, rooms: Sequence[str], kept: Kept, wanted: range
) -> dict[int, RandomSample]:
    """Kept samples of the wanted numbers; `rooms` are the ids of all rooms. One that is no draw of this is left out."""
    first = first_points(
        table.sequence, recipe.dataset.name, recipe.dataset.seed, table.samples, drawn_parameters(table)
    )
    by_draw: dict[int, list[int]] = defaultdict(list)
    for number in wanted:
        if isinstance(sample := kept.get(number), KeptSample):
            by_draw[sample.tries].append(number)
    targets, samples = [target.name for target in recipe.targets], dict[int, RandomSample]()
    for tries, numbers in by_draw.items():
        points = points_of(recipe, table, first, numbers, tries - 1)
        rows = rows_of(draw_values(table, targets, points), len(numbers))
        for number, drawn in zip(numbers, rows, strict=True):
            sample = kept[number]
            assert isinstance(sample, KeptSample)
            try:
                rigs, spot = drawn_rigs(recipe, dict(drawn)), _spot(recipe, sample)
            except SceneError:  # of an older draw: it is drawn anew
                continue
            place = (rooms[number % len(rooms)], rigs.rig, sample.surface, spot)
            numbers_of = (rigs.stroke_m, rigs.nominal_rig, rigs.nominal_stroke_m)
            samples[number] = RandomSample(number, tries, drawn, *place, *numbers_of, sample.causes)
    return samples


def _spot(recipe: Recipe, one: KeptSample) -> LaserSpot:
    vectors = (one.position_world_m, one.normal_world, one.diameter_m, one.beam_direction_world)
    spot = make_spot(recipe.laser, *vectors)
    # both are of unit length already, and dividing by it again would change their last bit
    object.__setattr__(spot, "normal_world", one.normal_world)
    object.__setattr__(spot, "beam_direction_world", one.beam_direction_world)
    return spot
