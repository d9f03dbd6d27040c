"""What is wrong with `[random]` although every key has a legal value: distributions, their ranges, spots off boards."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from pydantic import TypeAdapter, ValidationError

from phibench.datasets.distribution import DistributionTable, distribution_faults, one_number, support
from phibench.datasets.random_spot import room_left_m
from phibench.datasets.recipe import (
    DRAWABLE,
    LaserTable,
    RigTable,
    RoomTable,
    StrokeM,
    TargetTable,
)
from phibench.datasets.recipe_misalignment import MisalignmentTable
from phibench.datasets.recipe_scene import build_room, ceiling_m
from phibench.datasets.recipe_table import Table
from phibench.render.model_faults import Fault, allowed, schema_node
from phibench.scenes.names import close_names, nearest

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
