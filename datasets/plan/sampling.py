"""Random rigs, spots and strokes of `[random]`, by Sobol or independent points, drawn again where impossible.

`draws` draws the misalignments of `[rigs]` likewise.

The number of sample i for parameter p, in [0, 1), is a function of (data set, seed, sequence, p, i) and of nothing
else. It depends neither on how many samples there are nor on which other parameters are drawn. The distributions turn
it into a value (`distributions.quantile`).

A sample may be impossible: rig, spot and stroke do not go together, or not with the room. It is then drawn again, with
numbers of streams of its own (`further_points`), so that no other sample moves. A sample that stays impossible is
refused alone, if others are possible. Whether a sample's spot is to be hidden in one image is dealt once and stays,
however often the sample is drawn: the share of hidden ones is that of the recipe.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from collections.abc import Sequence as Sequence_
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from phibench.datasets.common.errors import RecipeError
from phibench.datasets.recipe.distributions import DistributionTable, pick, quantile
from phibench.datasets.recipe.mirror_tables import DRAWN_OF_MIRROR, OF_SHAPES, SHAPES, HolderTable, MirrorTable
from phibench.datasets.recipe.recipe_scene import (
    build_misalignment,
    build_rig,
    build_target,
    ceiling_m,
    text_by_keys,
    true_stroke_m,
)
from phibench.datasets.recipe.spot_placement import Placed, causes_or_fault, place
from phibench.datasets.recipe.tables import DRAWABLE, MisalignmentTable, RandomTable, Recipe, RigTable
from phibench.datasets.rooms.room_sources import ONLY_ROOM, MeshRoom, PanoramaRoom, RoomSource, is_exported, room_of
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.mirror import OF_REVOLVED
from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig
from phibench.scenes.room import Boards, Room
from phibench.scenes.validation import SceneError

Sequence = Literal["sobol", "independent"]

_OFTEN = (
    *("stroke_m", "spot.target", "spot.across_m", "spot.up_m", "rig.z_c_m", "rig.fx_px", "rig.cx_px", "rig.cy_px"),
    *("rig.radius_m", "rig.decentre_x_m", "rig.decentre_y_m", "rig.tilt_x_rad", "rig.tilt_y_rad"),
    *("rig.stroke_tilt_x_rad", "rig.stroke_tilt_y_rad", "rig.blur_sigma_px", "spot.azimuth_deg", "spot.height_m"),
)
PARAMETERS = (
    *_OFTEN,
    *(name for key in DRAWABLE if (name := f"rig.{key}") not in _OFTEN),
    *(f"misalignment.{key}" for key in MISALIGNMENT if key not in OF_REVOLVED),
    "spot.elevation_deg",  # later than the others, which keep their dimensions
    "spot.hidden",
    *(f"rig.holder.{key}" for key in HolderTable.model_fields),
    *(f"misalignment.{key}" for key in OF_REVOLVED),
    *(f"rig.mirror.{key}" for key in DRAWN_OF_MIRROR),
)
"""Everything that can be drawn; the place in this list is the dimension in Sobol's sequence, whose first ones are the
best: 16 of them correlate by at most 0.25 at 100 samples, where independent ones reach 0.38 (12 seeds each)."""


def first_points(
    sequence: Sequence, dataset: str, seed: int, count: int, names: Iterable[str] = PARAMETERS
) -> dict[str, Array]:
    """Numbers of the first try of samples 0 to `count` - 1, shape (count,), for some parameters.

    "sobol": Sobol's points, each dimension scrambled by the parameter's own stream (Matousek, J. Complexity 14, 527,
    1998), so that longer sequences begin with the shorter ones. Shifts modulo 1 do the same, but leave twice the
    correlation between dimensions at some hundred samples.
    "independent": the parameter's own stream.
    """
    streams = {name: generator(dataset, seed, "random", sequence, name) for name in names}
    if sequence == "independent":
        return {name: stream.random(count) for name, stream in streams.items()}
    from scipy.stats import qmc  # takes a second, and recipes without `[random]` need none

    power = max(count - 1, 0).bit_length()  # scipy warns about numbers that are no power of two
    sequences = (qmc.Sobol(PARAMETERS.index(name) + 1, rng=stream) for name, stream in streams.items())
    return {name: points.random_base2(power)[:count, -1] for name, points in zip(streams, sequences, strict=True)}


def further_points(
    dataset: str, seed: int, names: Iterable[str], numbers: Iterable[int], attempt: int
) -> dict[str, Array]:
    """Numbers of a later try, 1 and up, of some samples for some parameters: independent, whatever the sequence."""

    def one(name: str, number: int) -> float:
        return float(generator(dataset, seed, "random", name, number, attempt).random())

    return {name: np.array([one(name, i) for i in numbers]) for name in names}


# Samples of `[random]`.

TRIES = 100  # of a sample: one in a hundred that can be is found, and the next one waits no longer
HIDDEN_TRIES = 1000
"""Of samples whose spot one image is to hide: in the worst rooms one draw in some 50 does."""
UNDRAWN = "has no possible rig, spot and stroke"
HIDDEN, SHOWN = "in one image", "in none"
"""Values of "spot.hidden"."""
_PILOT = 8  # samples
_NANOMETRE = 9  # decimals of a stroke: a pose's name then says its offset exactly

PREFIX, _HOLDER, _MIRROR = "misalignment.", "holder.", "mirror."

Value = float | str


@dataclass(frozen=True)
class RandomSample:
    """A drawn sample.

    Attributes
    ----------
    number : int
        Place in the sequence, from 0.
    tries : int
        Number of the first draw that was possible; 1 is the sequence's own.
    drawn : tuple of (parameter, value)
        In the order of `PARAMETERS`.
    room : str
        Id of the room.
    surface : str
        Name of the target, or of what carries the spot.
    rig, stroke_m
        The true ones.
    nominal_rig, nominal_stroke_m
        Those that an estimator is given.
    causes : tuple of str
        Of both views, down and up; empty where nobody has asked yet.
    """

    number: int
    tries: int
    drawn: tuple[tuple[str, Value], ...]
    room: str
    rig: Rig
    surface: str
    spot: LaserSpot
    stroke_m: float
    nominal_rig: Rig
    nominal_stroke_m: float
    causes: tuple[str, ...] = ()


def draw_samples(
    recipe: Recipe,
    table: RandomTable,
    rooms: Mapping[str, RoomSource],
    folder: Path | None = None,
    wanted: range | None = None,
    held: Mapping[int, RandomSample | str] | None = None,
) -> tuple[tuple[RandomSample, ...], dict[int, str]]:
    """Samples of a recipe with `[random]`, dealt to its rooms in turn; `folder` has the files of the rooms.

    Of the `wanted` numbers, in a row, or all; those of `held` are taken from there, the reason of a refused one too.
    Rooms without such a sample, or with held ones alone, are not built.

    Returns
    -------
    samples : tuple of RandomSample
    refused : dict of number and reason
        Samples that stay impossible after `TRIES` draws (`HIDDEN_TRIES` of a hidden spot), or whose generated room
        cannot be built.

    Raises
    ------
    RecipeError
        If a panorama or mesh cannot be used, or if none of the first samples is possible, of all or of one of these.
    """
    dataset, held = recipe.dataset, held or {}
    first = first_points(table.sequence, dataset.name, dataset.seed, table.samples, drawn_parameters(table))
    wanted = range(table.samples) if wanted is None else wanted
    samples = {
        number: sample_or_cause for number in wanted if isinstance(sample_or_cause := held.get(number), RandomSample)
    }
    refused = {number: sample_or_cause for number in wanted if isinstance(sample_or_cause := held.get(number), str)}
    for k, room_id in enumerate(rooms):  # a room is built once, and let go before the next
        every = range(wanted.start + (k - wanted.start) % len(rooms), wanted.stop, len(rooms))
        if numbers := [number for number in every if number not in held]:
            stated = isinstance(rooms[room_id], PanoramaRoom | MeshRoom) and not is_exported(rooms[room_id])
            try:
                room = room_of(rooms[room_id], folder)
            except SceneError as error:
                fault = f"{room_id} cannot be built: {error}"
                if stated or room_id == ONLY_ROOM:
                    raise RecipeError(f"rooms: {fault}") from error
                refused |= dict.fromkeys(numbers, fault)
                _require_some(refused, samples, table.samples)
                continue  # the others of the set are made
            makers = _Makers(recipe, table, room_id, room, first)
            for batch in (numbers[:_PILOT], numbers[_PILOT:]):  # whether it is possible at all is known after a few
                drawn, lost = makers.draw(batch)
                samples |= {sample.number: sample for sample in drawn}
                refused |= lost
                _require_some(refused, samples, table.samples)
                if stated:  # it is the recipe that names it
                    of_room = len(range(k, table.samples, len(rooms)))
                    _require_some(lost, [number for number in every if number in samples], of_room)
    return tuple(samples[number] for number in sorted(samples)), dict(sorted(refused.items()))


def _require_some(refused: Mapping[int, str], found: Collection[int], count: int) -> None:
    """Raise `RecipeError` if all of the first few samples are refused: it is then the recipe that is impossible."""
    if refused and not found and len(refused) >= min(_PILOT, count):
        number = min(refused)
        raise RecipeError(f"random: sample {number} {refused[number]}")


_OF_STROKE = ("stroke_relative", "stroke_offset_m")


def have_own_rigs(recipe: Recipe, table: RandomTable) -> bool:
    """Tell whether what a sample's rigs are called depends on no other sample.

    Equal rigs are called after the first sample that has them. No two are equal where a number that every rig has is
    drawn from an interval; and the recipe's own rig has a name of its own.
    """
    drawn = dict(_sample_distributions(table))
    spread = {
        name
        for name, distribution in drawn.items()
        if isinstance(distribution, DistributionTable) and distribution.choice is None
    }
    if spread & {f"rig.{key}" for key in DRAWABLE}:
        return True
    if any(name.startswith("rig.") for name in drawn):
        return False  # choices of a few rigs, which samples share
    if not any(name.startswith(PREFIX) for name in drawn):
        return build_misalignment(recipe.misalignment) == Misalignment()
    return bool(spread & {PREFIX + key for key in MISALIGNMENT if key not in (*OF_REVOLVED, *_OF_STROKE)})


def rig_table(table: RigTable, values: Mapping[str, Value]) -> RigTable:
    """`[rig]` with drawn numbers, by parameter."""
    drawn = {key.removeprefix("rig."): value for key, value in values.items() if key.startswith("rig.")}
    of_holder = {key.removeprefix(_HOLDER): drawn.pop(key) for key in [*drawn] if key.startswith(_HOLDER)}
    if of_holder:
        drawn["holder"] = table.holder.model_copy(update=of_holder)  # type: ignore[assignment]
    of_mirror = {key.removeprefix(_MIRROR): drawn.pop(key) for key in [*drawn] if key.startswith(_MIRROR)}
    if of_mirror and table.mirror is not None:
        drawn["mirror"] = _drawn_mirror(table.mirror, of_mirror)  # type: ignore[assignment]
    return table.model_copy(update=drawn)


def _drawn_mirror(table: MirrorTable, drawn: Mapping[str, Value]) -> MirrorTable:
    """`[rig.mirror]` with drawn values, without what the drawn shape does not have."""
    shape = str(drawn.get("shape", table.shape))
    idle = dict.fromkeys((key for key in OF_SHAPES if key not in SHAPES[shape].keys), None)
    return table.model_copy(update={**drawn, **idle})


def drawn_misalignment(table: MisalignmentTable, values: Mapping[str, Value]) -> Misalignment:
    """Misalignment with drawn numbers, by parameter, in place of those of `[misalignment]`."""
    drawn = {key.removeprefix(PREFIX): value for key, value in values.items() if key.startswith(PREFIX)}
    return build_misalignment(table.model_copy(update=drawn))


class _Makers:
    """Drawing of samples, with all that the draws of a recipe share."""

    def __init__(
        self, recipe: Recipe, table: RandomTable, room_id: str, room: Room, first: Mapping[str, Array]
    ) -> None:
        self._recipe, self._table, self._room_id, self._room, self._first = recipe, table, room_id, room, first
        self._targets = {target.name: target for target in recipe.targets}
        self._boards = Boards([build_target(target) for target in recipe.targets])
        self._ceiling_m = ceiling_m(room)

    def draw(self, numbers: Sequence_[int]) -> tuple[list[RandomSample], dict[int, str]]:
        """Draw some samples, those that are impossible again until they are not; the reason where they stay so."""
        samples: dict[int, RandomSample] = {}
        refused: dict[int, str] = {}
        left = list(numbers)
        for attempt in range(HIDDEN_TRIES):
            outcomes = self._once(left, attempt)
            samples |= {number: sample for number, sample in outcomes.items() if isinstance(sample, RandomSample)}
            left = [number for number in left if number not in samples]
            lost = [number for number in left if attempt + 1 == self._tries(number)]
            refused |= {number: self._reason(attempt + 1, str(outcomes[number])) for number in lost}
            left = [number for number in left if number not in refused]
            if not left:
                return [samples[number] for number in numbers if number in samples], refused
        raise AssertionError("every sample is found or lost")

    def _reason(self, tries: int, last: str) -> str:
        where = "" if self._room_id == ONLY_ROOM else f" in {self._room_id}"
        boards = " or move the boards" if self._targets else ""
        spreads = [
            name for name, distribution in _sample_distributions(self._table) if len(set(_support(distribution))) > 1
        ]
        drawn = f"narrow the distributions ({', '.join(spreads[:4])}{', ...' * (len(spreads) > 4)})" if spreads else ""
        advice = " or ".join(filter(None, ("change the numbers that are fixed", drawn)))
        why = f"{UNDRAWN}{where} in {tries} draws; the last: {last}"
        return f"{why}; {advice}{boards}"

    def _tries(self, number: int) -> int:
        share = self._table.spot.hidden
        return TRIES if share is None or self._first["spot.hidden"][number] >= share else HIDDEN_TRIES

    def _once(self, numbers: list[int], attempt: int) -> dict[int, RandomSample | str]:
        """Draw some samples once; the reason instead of a sample that is impossible."""
        points = points_of(self._recipe, self._table, self._first, numbers, attempt)
        values = draw_values(self._table, list(self._targets), points)
        spots = place(self._recipe.laser, self._room, self._targets, values)
        rows = rows_of(values, len(numbers))
        return {
            number: self._sample(number, attempt + 1, drawn, spot)
            for number, drawn, spot in zip(numbers, rows, spots, strict=True)
        }

    def _sample(
        self, number: int, tries: int, drawn: tuple[tuple[str, Value], ...], placed: Placed
    ) -> RandomSample | str:
        if isinstance(placed, str):
            return placed
        if (solid := self._room.solid_around(placed[1].position_world_m)) is not None:
            return f"the spot lies inside {solid}"
        values = dict(drawn)
        try:
            rigs = drawn_rigs(self._recipe, values)
        except SceneError as error:
            return text_by_keys(str(error))
        if fault := rig_fault(rigs.rig, rigs.stroke_m, self._ceiling_m, self._boards):
            return fault
        causes: tuple[str, ...] | str = ()
        if "spot.hidden" in values:
            causes = causes_or_fault(values["spot.hidden"] == HIDDEN, rigs.rig, rigs.stroke_m, placed[1], self._room)
        if isinstance(causes, str):
            return causes
        place = (self._room_id, rigs.rig, *placed)
        return RandomSample(
            number, tries, drawn, *place, rigs.stroke_m, rigs.nominal_rig, rigs.nominal_stroke_m, causes
        )


@dataclass(frozen=True)
class DrawnRigs:
    """Rigs and strokes of a draw: the true ones, and those that an estimator is given."""

    rig: Rig
    stroke_m: float
    nominal_rig: Rig
    nominal_stroke_m: float


def drawn_rigs(recipe: Recipe, values: Mapping[str, Value]) -> DrawnRigs:
    """Rigs and strokes of drawn values, by parameter; `SceneError` where there can be no such rig."""
    nominal_stroke_m = float(values["stroke_m"])
    nominal_rig = build_rig(rig_table(recipe.rig, values))
    misalignment = drawn_misalignment(recipe.misalignment, values)
    rig, stroke_m = nominal_rig.perturbed(misalignment), true_stroke_m(misalignment, nominal_stroke_m)
    return DrawnRigs(rig, stroke_m, nominal_rig, nominal_stroke_m)


def points_of(
    recipe: Recipe, table: RandomTable, first: Mapping[str, Array], numbers: list[int], attempt: int
) -> dict[str, Array]:
    """Numbers of a try, 0 and up, of some samples, by parameter; `first` are those of try 0 of all samples."""
    drawn = drawn_parameters(table)
    if attempt == 0:
        return {name: first[name][numbers] for name in drawn}
    dataset, dealt = recipe.dataset, [name for name in drawn if name == "spot.hidden"]
    points = further_points(dataset.name, dataset.seed, [n for n in drawn if n not in dealt], numbers, attempt)
    return points | {name: first[name][numbers] for name in dealt}


def rows_of(values: Mapping[str, Any], count: int) -> list[tuple[tuple[str, Value], ...]]:
    """Drawn values of each of so many samples, from columns."""
    return [tuple((name, _plain(column[k])) for name, column in values.items()) for k in range(count)]


def rig_fault(rig: Rig, stroke_m: float, ceiling_m: float, boards: Boards) -> str | None:
    """Say why a rig cannot make a stroke in its room: lamps or a board are in the way; None if it can."""
    if not rig.in_image():
        return "the mirror is outside of the image"
    sphere_m = rig.T_world_camera.points(rig.sphere_in_camera_m)  # `rig.at` takes ten times as long
    if rig.motion is None:
        top_m = sphere_m[2] + stroke_m * rig.stroke_axis_world[2] + rig.top_m
    else:
        top_m = rig.at(stroke_m).sphere_centre_m[2] + rig.top_m
    if top_m >= ceiling_m:
        above = f"is above the ceiling or what hangs from it, at {ceiling_m:.2f} m"
        return f"the {rig.top_part}'s top at {top_m:.3f} m {above}"
    return boards.cut_by(rig, stroke_m)


def drawn_parameters(table: RandomTable) -> list[str]:
    """Names of the parameters that a recipe draws, in the order of `PARAMETERS`."""
    chosen = dict(_sample_distributions(table))
    others = {
        "spot.target": not table.spot.by_ray,
        "spot.hidden": table.spot.hidden is not None,
        "spot.elevation_deg": table.spot.hidden_elevation_deg is not None,
    }
    return [name for name in PARAMETERS if name in chosen or others.get(name, False)]


def draw_values(table: RandomTable, targets: list[str], points: Mapping[str, Array]) -> dict[str, Any]:
    """Values of all samples by parameter, for the points in [0, 1) of each."""
    chosen = dict(_sample_distributions(table))
    values: dict[str, Any] = {name: _values(chosen[name], u) for name, u in points.items() if name in chosen}
    values["stroke_m"] = np.round(values["stroke_m"], _NANOMETRE)
    if "spot.target" in points:
        names = targets if table.spot.target is None else table.spot.target.choice
        values["spot.target"] = pick(names, points["spot.target"])
    if "spot.hidden" in points and table.spot.hidden is not None:
        hidden = points["spot.hidden"] < table.spot.hidden
        values["spot.hidden"] = [HIDDEN if is_hidden else SHOWN for is_hidden in hidden]
        if table.spot.hidden_elevation_deg is not None:
            there = quantile(table.spot.hidden_elevation_deg, points["spot.elevation_deg"])
            values["spot.elevation_deg"] = np.where(hidden, there, values.get("spot.elevation_deg", 0.0))
    return {name: values[name] for name in points}


_NAMES = ("rig.holder.kind", "rig.mirror.shape")  # drawn from a choice of names


def _sample_distributions(table: RandomTable) -> Iterator[tuple[str, Any]]:
    """Parameter and distribution of every number, and of every name but the board's, that is drawn."""
    yield "stroke_m", table.stroke_m
    rig, holder = table.rig, table.rig.holder  # type: ignore[attr-defined]
    groups = (
        *(("rig", rig), ("spot", table.spot), ("misalignment", table.misalignment), ("rig.holder", holder)),
        ("rig.mirror", table.rig.mirror),  # type: ignore[attr-defined]
    )
    for prefix, group in groups:
        for key in () if group is None else type(group).model_fields:
            value, name = getattr(group, key), f"{prefix}.{key}"
            if isinstance(value, DistributionTable) or (value is not None and name in _NAMES):
                yield name, value


def _support(chosen: Any) -> tuple[Any, ...]:
    """Smallest and largest value of a distribution, or the names of a choice."""
    return chosen.support if isinstance(chosen, DistributionTable) else chosen.choice


def _values(chosen: Any, points: Array) -> Any:
    """Values of a distribution, or of a choice of names, for points in [0, 1)."""
    return quantile(chosen, points) if isinstance(chosen, DistributionTable) else pick(chosen.choice, points)


def _plain(value: Any) -> Value:
    return value if isinstance(value, str) else float(value)
