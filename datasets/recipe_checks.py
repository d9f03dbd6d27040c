"""What is wrong with a recipe although every key has a legal value.

Works on the raw document, table by table, so that these faults are reported together with the structural ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeVar, cast

from pydantic import ValidationError

from phibench.datasets.recipe import MAX_STROKE_M, AmbientTable, LaserTable, Recipe, RigTable, RoomTable, TargetTable
from phibench.datasets.recipe_frames_checks import distractor_faults, frames_faults
from phibench.datasets.recipe_misalignment import MisalignmentTable
from phibench.datasets.recipe_places import boards_in_the_way, spots_on_boards
from phibench.datasets.recipe_random_checks import purpose_faults, random_faults, rigs_faults
from phibench.datasets.recipe_scene import (
    build_misalignment,
    build_rig,
    build_room,
    build_spot,
    build_target,
    build_true_rig,
    ceiling_m,
    true_stroke_m,
)
from phibench.datasets.recipe_table import Table
from phibench.render.film_grid import FilmGrid
from phibench.render.model_faults import Fault
from phibench.scenes.checks import SceneError
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.names import nearest
from phibench.scenes.rig import Rig
from phibench.scenes.room import Room

T = TypeVar("T", bound=Table)
Raw = dict[str, Any]


def semantic_faults(raw: Raw) -> list[Fault]:
    """Faults between keys: names, places, strokes, the rig as a whole. Faulty keys are passed over."""
    experiments = _tables(raw, "experiments")
    targets = [(i, table) for i, entry in _tables(raw, "targets") if (table := _sound(entry, TargetTable)) is not None]
    names = [entry["name"] for _, entry in _named(_tables(raw, "targets"))]
    laser, room = _sound(raw.get("laser", {}), LaserTable), _sound(raw.get("room", {}), RoomTable)
    return [
        *purpose_faults(raw, list(Recipe.model_fields)),
        *random_faults(raw, laser, room, [table for _, table in targets], names),
        *rigs_faults(raw),
        *frames_faults(raw),
        *distractor_faults(raw, room, names),
        *_twice("targets", _tables(raw, "targets")),
        *_twice("experiments", experiments),
        *_unknown_targets(experiments, names),
        *_repeats(experiments),
        *_laser(laser),
        *_places(room, targets),
        *spots_on_boards(laser, targets),
        *_rig(raw, experiments, targets),
    ]


def warnings(recipe: Recipe) -> list[str]:
    """What is legal but probably not meant."""
    result = []
    if not build_true_rig(recipe).fits_image():
        result.append("rig: the mirror's outline does not fit the image; spots near its rim may fall outside")
    used = _used_targets(recipe)
    unused = [target.name for target in recipe.targets if target.name not in used]
    if unused:
        what = "experiment uses" if recipe.random is None else "sample of [random] uses"
        result.append(f"targets: {', '.join(unused)} stand in the room but no {what} their spots")
    return result


def _used_targets(recipe: Recipe) -> set[str]:
    if recipe.random is not None:
        chosen = recipe.random.spot.target
        return {target.name for target in recipe.targets} if chosen is None else set(chosen.choice)
    return {name for experiment in recipe.experiments for name in experiment.targets}


def _sound(raw: object, model: type[T]) -> T | None:
    """Table of `raw` without its faulty keys; None where that leaves out a key that must be there."""
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        faulty = {details["loc"][0] for details in error.errors() if details["loc"]}
    rest = {key: value for key, value in raw.items() if key not in faulty} if isinstance(raw, dict) else None
    return None if rest is None or len(rest) == len(cast(Raw, raw)) else _sound(rest, model)


def _tables(raw: Raw, key: str) -> list[tuple[int, Raw]]:
    """Entries of an array of tables that are tables, with their index."""
    entries = raw.get(key)
    return [(i, e) for i, e in enumerate(entries) if isinstance(e, dict)] if isinstance(entries, list) else []


def _named(tables: list[tuple[int, Raw]]) -> list[tuple[int, Raw]]:
    return [(i, entry) for i, entry in tables if isinstance(entry.get("name"), str)]


def _items(entry: Raw, key: str) -> list[tuple[int, Any]]:
    """Entries of a list in a table, with their index."""
    values = entry.get(key)
    return list(enumerate(values)) if isinstance(values, list) else []


def _twice(key: str, tables: list[tuple[int, Raw]]) -> Iterator[Fault]:
    """Names that differ by case only are refused too: they become file names."""
    first: dict[str, int] = {}
    for i, entry in _named(tables):
        name = entry["name"]
        if (earlier := first.setdefault(name.casefold(), i)) != i:
            yield Fault(f"{key}[{i}].name", f"'{name}' is also the name of {key}[{earlier}]; rename one of them")


def _unknown_targets(experiments: list[tuple[int, Raw]], names: list[str]) -> Iterator[Fault]:
    for i, experiment in experiments:
        for j, name in _items(experiment, "targets"):
            if isinstance(name, str) and name not in names:
                yield Fault(f"experiments[{i}].targets[{j}]", f"no target is called '{name}'; {nearest(name, names)}")


def _repeats(experiments: list[tuple[int, Raw]]) -> Iterator[Fault]:
    for i, experiment in experiments:
        for key in ("targets", "strokes_m"):
            values = [value for _, value in _items(experiment, key)]
            for j, value in enumerate(values):
                if value in values[:j]:
                    yield Fault(f"experiments[{i}].{key}[{j}]", f"{value!r} is listed twice; remove one")


def _laser(laser: LaserTable | None) -> Iterator[Fault]:
    if laser is None:
        return
    growing = laser.model_fields_set & {"diameter_base_m", "diameter_growth_m_per_m"}
    if laser.diameter_m is not None and growing:
        yield Fault("laser.diameter_m", f"given together with {', '.join(sorted(growing))}; give one or the other")
    if laser.diameter_m is None and laser.diameter_base_m + laser.diameter_growth_m_per_m == 0.0:
        yield Fault("laser.diameter_base_m", "0.0 with no growth makes spots of diameter 0; give a number above 0")


def _places(table: RoomTable | None, targets: list[tuple[int, TargetTable]]) -> Iterator[Fault]:
    """Boards may not share a name with the room's furniture, nor spots lie in solids or outside the room."""
    if table is None:
        return
    bare = build_room(table, ())
    for i, target in targets:
        spot = build_spot(LaserTable(), target).position_world_m
        others = build_room(table, _others(targets, target))
        inside = others.solid_around(spot)
        where = f"depth_m {target.depth_m}, azimuth_deg {target.azimuth_deg}, height_m {target.height_m}"
        if inside is not None:
            yield Fault(f"targets[{i}]", f"the spot ({where}) lies inside '{inside}'; move it into the open")
        elif not _within(bare, spot):
            yield Fault(f"targets[{i}]", f"the spot ({where}) lies outside the room {_extent(bare)}; move it inside")


def _others(targets: list[tuple[int, TargetTable]], target: TargetTable) -> list[TargetTable]:
    unique = {other.name: other for _, other in targets if other.name != target.name}
    return [other for other in unique.values() if build_target(other) != build_target(target)]


def _bounds(room: Room) -> list[tuple[float, float]]:
    """Extent of the room along x, y, z: of the centres of its surfaces (walls, floor, ceiling)."""
    places = [surface.T_world_shape.translation_m for surface in room.surfaces]
    return [(min(place[axis] for place in places), max(place[axis] for place in places)) for axis in range(3)]


def _within(room: Room, point: tuple[float, ...]) -> bool:
    return all(low <= x <= high for x, (low, high) in zip(point, _bounds(room), strict=True))


def _extent(room: Room) -> str:
    return ", ".join(f"{name} {low:g} to {high:g} m" for name, (low, high) in zip("xyz", _bounds(room), strict=True))


def _rig(raw: Raw, experiments: list[tuple[int, Raw]], targets: list[tuple[int, TargetTable]]) -> Iterator[Fault]:
    table, room_table = _sound(raw.get("rig", {}), RigTable), _sound(raw.get("room", {}), RoomTable)
    if table is None:
        return
    try:
        rig = build_rig(table)
    except SceneError as error:
        yield Fault("rig", str(error))
        return
    yield from _cells(rig, _sound(raw.get("ambient", {}), AmbientTable))
    if not rig.in_image():
        yield Fault("rig", "the mirror is outside of the image; move it or the principal point")
        return
    misalignment = _sound(raw.get("misalignment", {}), MisalignmentTable)
    if misalignment is None:
        return
    try:
        deviation = build_misalignment(misalignment)
        rig, strokes_m = rig.perturbed(deviation), [true_stroke_m(deviation, h) for h in _legal_strokes(experiments)]
    except SceneError as error:
        yield Fault("misalignment", str(error))
        return
    if not rig.in_image():
        yield Fault("misalignment", "the mirror is outside of the image; take smaller deviations")
        return
    yield from boards_in_the_way(rig, strokes_m, targets)
    if room_table is not None:
        yield from _strokes(rig, deviation, build_room(room_table, ()), experiments)


def _cells(rig: Rig, ambient: AmbientTable | None) -> Iterator[Fault]:
    try:
        FilmGrid.of(rig.camera, 1 if ambient is None else ambient.cells_per_pixel)
    except SceneError as error:
        yield Fault("ambient.cells_per_pixel", str(error))


def _strokes(rig: Rig, misalignment: Misalignment, room: Room, experiments: list[tuple[int, Raw]]) -> Iterator[Fault]:
    """The mirror must stay below the lowest thing that hangs from the ceiling."""
    limit_m = ceiling_m(room)
    for i, experiment in experiments:
        for j, stroke_m in _items(experiment, "strokes_m"):
            if not _is_legal(stroke_m):
                continue  # a structural fault
            top_m = rig.at(true_stroke_m(misalignment, stroke_m)).sphere_centre_m[2] + rig.mirror.bound_m
            if top_m >= limit_m:
                longest_m = stroke_m - (top_m - limit_m)
                text = f"{stroke_m} lifts the mirror's top to {top_m:.3f} m, through the ceiling at {limit_m:.2f} m"
                yield Fault(f"experiments[{i}].strokes_m[{j}]", f"{text}; give less than {longest_m:.3f}")


def _is_legal(stroke_m: object) -> bool:
    return type(stroke_m) in (int, float) and 0.0 < cast(float, stroke_m) <= MAX_STROKE_M


def _legal_strokes(experiments: list[tuple[int, Raw]]) -> list[float]:
    return [float(h) for _, experiment in experiments for _, h in _items(experiment, "strokes_m") if _is_legal(h)]
