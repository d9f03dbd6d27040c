"""What is wrong with `[random]` although every key has a legal value: distributions, their ranges, spots off boards.

What is wrong with `[frames]` and `[[distractors]]` although every key has a legal value.

What is wrong with a recipe although every key has a legal value.

Works on the raw document, table by table, so that these faults are reported together with the structural ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, TypeVar, cast

from pydantic import TypeAdapter, ValidationError

from phibench.datasets.recipe.build import (
    build_misalignment,
    build_rig,
    build_room,
    build_spot,
    build_target,
    build_true_rig,
    ceiling_m,
    true_stroke_m,
)
from phibench.datasets.recipe.distributions import DistributionTable, Table, distribution_faults, one_number, support
from phibench.datasets.recipe.spot_placement import boards_in_the_way, room_left_m, spots_on_boards
from phibench.datasets.recipe.tables import (
    DRAWABLE,
    LEVELS,
    MAX_STROKE_M,
    SENSOR_KEYS,
    AmbientTable,
    LaserTable,
    MisalignmentTable,
    Recipe,
    RigTable,
    RoomTable,
    StrokeM,
    TargetTable,
)
from phibench.render.room.film import FilmGrid
from phibench.render.sensor.settings import SensorError, sensor
from phibench.scenes.catalog import BOARD_SIZE_M
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig
from phibench.scenes.room import Room
from phibench.scenes.validation import Fault, SceneError, allowed, close_names, nearest, schema_node

Raw = dict[str, Any]
_ON_BOARD, _BY_RAY = ("target", "across_m", "up_m"), ("azimuth_deg", "height_m")


def purpose_faults(raw: Raw, tables: Sequence[str]) -> Iterator[Fault]:
    """A recipe has `[[experiments]]` or `[random]`; `tables` are the names that it may have."""
    given = [key for key in ("experiments", "random") if key in raw]
    misspelt = [key for key in raw if key not in tables and set(close_names(key, tables)) & {"experiments", "random"}]
    if len(given) == 2:
        yield Fault("random", "given together with [[experiments]]; give one or the other")
    elif raw.get("experiments") == [] or not (given or misspelt):
        what = "empty" if given else "missing"
        yield Fault("experiments", f"{what}; add [[experiments]] (which targets with which strokes) or [random]")


def random_faults(
    raw: Raw, laser: LaserTable | None, room: RoomTable | None, targets: Sequence[TargetTable], names: Sequence[str]
) -> Iterator[Fault]:
    """Faults of `[random]`; `targets` are the sound ones, `names` those of all."""
    table = raw.get("random")
    if not isinstance(table, dict):
        return
    yield from number_faults("random.stroke_m", table.get("stroke_m"), _stroke_range)
    rig, spot, misalignment = (_table(table.get(key)) for key in ("rig", "spot", "misalignment"))
    for key, given in rig.items():
        if key in DRAWABLE:
            yield from number_faults(f"random.rig.{key}", given, lambda value, key=key: _range(RigTable, key, value))
        elif key in RigTable.model_fields:
            yield _not_drawable(key)
    yield from _misalignment_faults("random", misalignment)
    for key in ("across_m", "up_m", "azimuth_deg", "height_m"):
        if key in spot:
            yield from number_faults(f"random.spot.{key}", spot[key], None)
    yield from _either_way(spot)
    yield from choice_faults("random.spot.target", spot.get("target"), names)
    if laser is not None:
        yield from _off_board(spot, laser, targets)
    if room is not None:
        yield from off_wall("random.spot.height_m", spot.get("height_m"), room)


def rigs_faults(raw: Raw) -> Iterator[Fault]:
    """Faults of `[rigs]`."""
    table = raw.get("rigs")
    if not isinstance(table, dict):
        return
    if "random" in raw:
        yield Fault("rigs", "given together with [random], whose samples have rigs of their own; remove one")
    misalignment = _table(table.get("misalignment"))
    if not misalignment:
        yield Fault("rigs.misalignment", "draws nothing; add distributions of keys of [misalignment] or remove [rigs]")
    yield from _misalignment_faults("rigs", misalignment)


def _misalignment_faults(where: str, misalignment: Raw) -> Iterator[Fault]:
    for key, given in misalignment.items():
        if key in MisalignmentTable.model_fields:
            path = f"{where}.misalignment.{key}"
            yield from number_faults(path, given, lambda value, key=key: _range(MisalignmentTable, key, value))


def _not_drawable(key: str) -> Fault:
    """Fault of a distribution for a key of `[rig]` that is not a number, or must be the same for all samples."""
    why = "is not a number" if key in ("preset", "laser_filter_response") else "must be the same for all samples"
    return Fault(f"random.rig.{key}", f"cannot be drawn, it {why}; set {key} in [rig]")


def _table(given: object) -> Raw:
    return given if isinstance(given, dict) else {}


def sound_distribution(given: object) -> DistributionTable | None:
    """Distribution without structural faults; None if there is none."""
    try:
        return DistributionTable.model_validate(one_number(given))
    except ValidationError:
        return None


def number_faults(path: str, given: object, in_range: Any) -> Iterator[Fault]:
    """Faults of one distribution; `in_range` says what is allowed for a value that is not, else nothing."""
    table = sound_distribution(given)
    if table is None:
        return
    faults = [Fault(f"{path}.{key}".removesuffix("."), text) for key, text in distribution_faults(table)]
    yield from faults
    if faults or in_range is None:
        return
    for value in dict.fromkeys(support(table)):
        if words := in_range(value):
            yield Fault(path, f"reaches {value:g}, which is not allowed; stay with {words}")


def _range(table: type[Table], key: str, value: float) -> str | None:
    try:
        table.model_validate({key: value})
    except ValidationError:
        return allowed(schema_node(table.model_json_schema(), (key,)))
    return None


def _stroke_range(value: float) -> str | None:
    adapter = TypeAdapter(StrokeM)
    try:
        adapter.validate_python(value)
    except ValidationError:
        return allowed(adapter.json_schema())
    return None


def _either_way(spot: Raw) -> Iterator[Fault]:
    ray, board = ([key for key in keys if key in spot] for keys in (_BY_RAY, _ON_BOARD))
    if ray and board:
        text = f"{', '.join(board)} (on a board) and {', '.join(ray)} (by a ray) are both given; give one or the other"
        yield Fault("random.spot", text)
    elif len(ray) == 1:
        [missing] = set(_BY_RAY) - set(ray)
        yield Fault(f"random.spot.{missing}", f"missing; {ray[0]} needs it, the two make the ray")


def choice_faults(where: str, given: object, names: Sequence[str]) -> Iterator[Fault]:
    """Boards that are chosen from but not there, or listed twice."""
    chosen = [given] if isinstance(given, str) else _table(given).get("choice")
    if not isinstance(chosen, list):
        return
    for i, name in enumerate(chosen):
        path = f"{where}.choice[{i}]"
        if isinstance(name, str) and names and name not in names:
            yield Fault(path, f"no target is called '{name}'; {nearest(name, names)}")
        elif name in chosen[:i]:
            yield Fault(path, f"{name!r} is listed twice; remove one")


def _off_board(spot: Raw, laser: LaserTable, targets: Sequence[TargetTable]) -> Iterator[Fault]:
    """Distributions that reach beyond where a spot of the drawn boards is wholly on its board."""
    given = spot.get("target")
    chosen = [given] if isinstance(given, str) else _table(given).get("choice")
    drawn = [target for target in targets if not isinstance(chosen, list) or target.name in chosen]
    if not drawn or any(key in spot for key in _BY_RAY):
        return
    for axis, key in enumerate(("across_m", "up_m")):
        table = sound_distribution(spot.get(key, 0.0))
        if table is None or [*distribution_faults(table)]:
            continue
        farthest = max(abs(value) for value in support(table))
        left, name = min((room_left_m(laser, target)[axis], target.name) for target in drawn)
        if left < 0.0:
            text = f"a spot at the centre of the board '{name}' already reaches {-left:.3f} m beyond its edge"
            yield Fault(f"random.spot.{key}", f"{text}; make the spot smaller (see laser.diameter_m)")
        elif farthest > left:
            text = f"reaches {farthest:g} m, where the spot leaves the board '{name}'"
            yield Fault(f"random.spot.{key}", f"{text}; stay within -{left:.3f} to {left:.3f}")


def off_wall(path: str, given: object, room: RoomTable) -> Iterator[Fault]:
    """Heights of rays below the floor or above the lamps."""
    table, limit_m = sound_distribution(given), ceiling_m(build_room(room, ()))
    if table is None or [*distribution_faults(table)]:
        return
    low, high = support(table)
    if low <= 0.0 or high >= limit_m:
        text = f"reaches from {low:g} to {high:g} m, beyond floor or lamps"
        yield Fault(path, f"{text}; stay above 0 and below {limit_m:.2f}")


_RAY = ("azimuth_deg", "height_m", "distance_m")


def frames_faults(raw: Raw) -> Iterator[Fault]:
    """Faults of `[frames]`: every number that may be drawn must be one that the sensor takes."""
    table = raw.get("frames")
    if not isinstance(table, dict):
        return
    for key in (*SENSOR_KEYS, "exposure_s"):
        if key in table and not (key == "exposure_s" and isinstance(table[key], str)):
            yield from number_faults(f"frames.{key}", table[key], partial(_sensor_range, key))
    for key in LEVELS:
        if key in table:
            yield from number_faults(f"frames.{key}", table[key], _from_to(0.0, 1e6))
    yield from _whole_qualities(table.get("jpeg_quality"))
    listed = table.get("presets")
    presets = listed if isinstance(listed, list) else []
    for i, preset in enumerate(presets):
        if preset in presets[:i]:
            yield Fault(f"frames.presets[{i}]", f"{preset!r} is listed twice; remove one")


def distractor_faults(raw: Raw, room: RoomTable | None, names: Sequence[str]) -> Iterator[Fault]:
    """Faults of `[[distractors]]`; `names` are those of the boards."""
    tables = raw.get("distractors")
    for i, table in enumerate(tables if isinstance(tables, list) else ()):
        if isinstance(table, dict):
            yield from _one_distractor(f"distractors[{i}]", table, room, names)


def _one_distractor(path: str, table: Raw, room: RoomTable | None, names: Sequence[str]) -> Iterator[Fault]:
    limits = {"flux_ratio": (1e-6, 0.5), "diameter_m": (1e-6, min(BOARD_SIZE_M) / 2.0), "distance_m": (0.1, 100.0)}
    for key, (low, high) in limits.items():
        if key in table:
            yield from number_faults(f"{path}.{key}", table[key], _from_to(low, high))
    for key in ("azimuth_deg", "height_m"):
        if key in table:
            yield from number_faults(f"{path}.{key}", table[key], None)
    yield from choice_faults(f"{path}.target", table.get("target"), names)
    given = [key for key in _RAY if key in table]
    if given and "target" in table:
        text = f"given together with {', '.join(given)} (a ray); give one or the other"
        yield Fault(f"{path}.target", text)
    if given and (missing := [key for key in _RAY[:2] if key not in table]):
        yield Fault(f"{path}.{missing[0]}", f"missing; {given[0]} needs it, azimuth_deg and height_m make the ray")
    if table.get("kind") == "glow" and "distance_m" not in table:
        yield Fault(f"{path}.distance_m", "missing; a glow hangs free in the room, at distance_m along its ray")
    if room is not None:
        yield from off_wall(f"{path}.height_m", table.get("height_m"), room)


def _whole_qualities(given: object) -> Iterator[Fault]:
    table = sound_distribution(given)
    if given is None or table is None:
        return
    if table.choice is None or any(value != int(value) for value in table.choice):
        text = "must be a whole number or a choice of whole numbers, such as { choice = [60, 75, 90] }"
        yield Fault("frames.jpeg_quality", text)


def _sensor_range(key: str, value: float) -> str | None:
    """What the sensor allows, in words, if it does not take the value."""
    try:
        sensor("mjpeg", **{key: round(value) if key == "jpeg_quality" else value})
    except SensorError as error:
        return f"what the sensor takes ({error})"
    return None


def _from_to(low: float, high: float) -> Callable[[float], str | None]:
    return lambda value: None if low <= value <= high else f"{low:g} to {high:g}"


T = TypeVar("T", bound=Table)


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
