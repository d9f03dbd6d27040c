"""The samples of `[random]`: a rig, a spot and a stroke for each.

Sample i is a function of the recipe without its number of samples, and of i. Where rig, spot and stroke do not go
together (or with the room), the sample is drawn again from streams of its own (`sampling.further_points`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from phibench.datasets.distribution import DistributionTable, pick, quantile
from phibench.datasets.errors import RecipeError
from phibench.datasets.random_spot import Placed, place
from phibench.datasets.recipe import RandomTable, Recipe, RigTable
from phibench.datasets.recipe_places import Boards
from phibench.datasets.recipe_scene import build_rig, build_target, ceiling_m
from phibench.datasets.sampling import first_points, further_points
from phibench.scenes.checks import SceneError
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import Rig
from phibench.scenes.room import Room

TRIES = 100
_NANOMETRE = 9  # decimals of a stroke: a pose's name then says its offset exactly

Value = float | str


@dataclass(frozen=True)
class RandomSample:
    """A drawn sample.

    Attributes
    ----------
    number : int
        Place in the sequence, from 0.
    tries : int
        Which draw was the first possible one; 1 is the sequence's own.
    drawn : tuple of (parameter, value)
        In the order of `sampling.PARAMETERS`.
    surface : str
        Name of the target, or of what carries the spot.
    """

    number: int
    tries: int
    drawn: tuple[tuple[str, Value], ...]
    rig: Rig
    surface: str
    spot: LaserSpot
    stroke_m: float


def draw_samples(recipe: Recipe, table: RandomTable, room: Room) -> tuple[RandomSample, ...]:
    """All samples of a recipe with `[random]`.

    Raises
    ------
    RecipeError
        If a sample stays impossible after `TRIES` draws, with the reason of the last one.
    """
    makers, found = _Makers(recipe, room), dict[int, RandomSample]()
    left = list(range(table.samples))
    for attempt in range(TRIES):
        outcomes = dict(makers.draw(table, np.array(left), attempt))
        found |= {number: sample for number, sample in outcomes.items() if isinstance(sample, RandomSample)}
        left = [number for number in left if number not in found]
        if not left:
            return tuple(found[number] for number in range(table.samples))
    text = f"sample {left[0]} has no possible rig, spot and stroke in {TRIES} draws; the last: {outcomes[left[0]]}"
    raise RecipeError(f"random: {text}; narrow the distributions or move the boards")


def rig_table(table: RigTable, values: Mapping[str, Value]) -> RigTable:
    """`[rig]` with drawn numbers, by parameter; a drawn `fx_px` is `fy_px` as well where nothing else gives it."""
    drawn = {key.removeprefix("rig."): value for key, value in values.items() if key.startswith("rig.")}
    if "fx_px" in drawn and table.fy_px is None:
        drawn.setdefault("fy_px", drawn["fx_px"])
    return table.model_copy(update=drawn)


class _Makers:
    """What all draws of a recipe share."""

    def __init__(self, recipe: Recipe, room: Room) -> None:
        self._recipe, self._room = recipe, room
        self._targets = {target.name: target for target in recipe.targets}
        self._boards = Boards([build_target(target) for target in recipe.targets])
        self._ceiling_m = ceiling_m(room)

    def draw(self, table: RandomTable, numbers: Array, attempt: int) -> Iterator[tuple[int, RandomSample | str]]:
        """Draw some samples once; the reason instead of a sample that is impossible."""
        dataset = self._recipe.dataset
        if attempt == 0:
            points = first_points(table.sequence, dataset.name, dataset.seed, table.samples)
        else:
            points = further_points(dataset.name, dataset.seed, numbers, attempt)
        values = draw_values(table, list(self._targets), points)
        spots = place(self._recipe.laser, self._room, self._targets, values)
        for k, (number, spot) in enumerate(zip(numbers, spots, strict=True)):
            drawn = tuple((name, _plain(column[k])) for name, column in values.items())
            yield int(number), self._sample(int(number), attempt + 1, drawn, spot)

    def _sample(
        self, number: int, tries: int, drawn: tuple[tuple[str, Value], ...], placed: Placed
    ) -> RandomSample | str:
        if isinstance(placed, str):
            return placed
        values = dict(drawn)
        stroke_m = float(values["stroke_m"])
        try:
            rig = build_rig(rig_table(self._recipe.rig, values))
        except SceneError as error:
            return str(error)
        if fault := self._rig_fault(rig, stroke_m):
            return fault
        return RandomSample(number, tries, drawn, rig, placed[0], placed[1], stroke_m)

    def _rig_fault(self, rig: Rig, stroke_m: float) -> str | None:
        sphere_m = rig.T_world_camera.points(rig.sphere_in_camera_m)  # `rig.at` takes ten times as long
        top_m = sphere_m[2] + stroke_m * rig.stroke_axis_world[2] + rig.mirror.radius_m
        if top_m >= self._ceiling_m:
            return f"the mirror's top at {top_m:.3f} m is above the ceiling's lamps at {self._ceiling_m:.2f} m"
        return self._boards.cut_by(rig, stroke_m)


def draw_values(table: RandomTable, targets: list[str], points: Mapping[str, Array]) -> dict[str, Any]:
    """Values of all samples by parameter, for the points in [0, 1) of each."""
    chosen = dict(_distributions(table))
    values: dict[str, Any] = {}
    for name, u in points.items():
        if name == "spot.target" and not table.spot.by_ray:
            values[name] = pick(targets if table.spot.target is None else table.spot.target.choice, u)
        elif name in chosen:
            values[name] = quantile(chosen[name], u)
    values["stroke_m"] = np.round(values["stroke_m"], _NANOMETRE)
    return values


def _distributions(table: RandomTable) -> Iterator[tuple[str, DistributionTable]]:
    """Parameter and distribution of every number that is drawn."""
    yield "stroke_m", table.stroke_m
    for prefix, group in (("rig", table.rig), ("spot", table.spot)):
        for key in type(group).model_fields:
            if isinstance(value := getattr(group, key), DistributionTable):
                yield f"{prefix}.{key}", value


def _plain(value: Any) -> Value:
    return value if isinstance(value, str) else float(value)
