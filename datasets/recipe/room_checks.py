"""Checks of the rooms in a recipe: which tables go together, places of camera and robot, heights, and the files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from phibench.datasets.recipe.distributions import DistributionTable
from phibench.datasets.recipe.room_tables import ROOM_LISTS, GeometryTable, MeshTable, PanoramaTable, RoomsTable
from phibench.datasets.recipe.tables import Recipe
from phibench.datasets.rooms.room_files import RoomError, RoomFiles
from phibench.scenes.rig import Rig
from phibench.scenes.validation import Fault, SceneError
from phibench.scenes.worlds.room_properties import PROPERTIES


def room_table_faults(raw: dict[str, Any]) -> Iterator[Fault]:
    """Tables of a document that do not go with its rooms: it has boards, or rooms with spots that rays find."""
    if "rooms" not in raw:
        if raw.get("targets") in (None, []):
            yield Fault(
                "targets", "missing; add [[targets]] (boards with a laser spot), or [rooms] for generated rooms"
            )
        return  # no rooms: nothing else to check
    if raw.get("targets"):
        yield Fault("targets", "given together with [rooms], whose rooms have no boards; remove [[targets]]")
    if "room" in raw:
        yield Fault("room", "given together with [rooms]; give one or the other")
    if "random" not in raw:
        yield Fault("rooms", "given without [random]; rooms of their own are for samples that are drawn, add [random]")


def room_faults(recipe: Recipe) -> Iterator[Fault]:
    """Faults of `[rooms]`: numbers of rooms, places of cameras and lamps in them, heights of rays."""
    if recipe.rooms is None:
        return  # one room, with boards
    if recipe.random is not None and not recipe.random.spot.by_ray:
        yield Fault("random.spot.azimuth_deg", "missing; in these rooms a ray finds the spot, give its azimuth_deg")
    yield from _counts(recipe.rooms)
    for path, table in _file_rooms(recipe.rooms):
        if fault := _settings_fault(path, table, recipe):
            yield fault
    yield from _ray_height(recipe, recipe.rooms)


def _counts(rooms: RoomsTable) -> Iterator[Fault]:
    others = any(getattr(rooms, key) for key in ROOM_LISTS)
    if rooms.count == 0 and not others and not rooms.exported:
        text = "0, and there are no panoramas or meshes; give 1 or more, or [[rooms.panoramas]] or [[rooms.meshes]]"
        yield Fault("rooms.count", text)
    elif others and not rooms.exported and not rooms.count and rooms.properties.model_fields_set:
        yield Fault("rooms.properties", "given, but no room is generated; give rooms.count above 0, or remove it")


def _file_rooms(rooms: RoomsTable | None) -> Iterator[tuple[str, PanoramaTable | MeshTable]]:
    """Tables of panoramas and meshes, with their paths."""
    for key in ("panoramas", "meshes"):  # rooms of other sources have no files
        for i, table in enumerate(getattr(rooms, key, ())):
            yield f"rooms.{key}[{i}]", table


def _settings_fault(path: str, one: PanoramaTable | MeshTable, recipe: Recipe) -> Fault | None:
    """Fault of numbers of which no room can be made, at the key that it is about; None if there is none."""
    try:
        one.settings(_least_stroke_m(recipe))
    except SceneError as error:
        within_it = ".mesh" if isinstance(one, PanoramaTable) else ""
        text = str(error).replace("MeshSettings", f"PanoramaSettings{within_it}", 1)
        match = re.match(r"PanoramaSettings((?:\.\w+|\[\d+\])*)(?: = (.*?): |: | )(.*)", text, re.DOTALL)
        if match is None:
            return Fault(path, text)
        key, given, rest = match.groups()
        return Fault(path + key, rest if given is None else f"{given}: {rest}")
    return None


# Heights.


def low_room_faults(recipe: Recipe, rig: Rig) -> Iterator[Fault]:
    """Rooms whose ceiling the mirror's top reaches with the shortest stroke; longer ones are drawn again."""
    stroke_m = _least_stroke_m(recipe)
    top_m = float(rig.at(stroke_m).sphere_centre_m[2]) + rig.mirror.bound_m
    with_it = f"the mirror's top is at {top_m:.2f} m with the shortest stroke of [random], {stroke_m:g} m"
    for path, height_m in _heights(recipe, recipe.rooms or RoomsTable()):
        if height_m <= top_m:
            text = f"the ceiling can be at {height_m:g} m, and {with_it}"
            yield Fault(path, f"{text}; make the room higher or the stroke shorter")


def _heights(recipe: Recipe, rooms: RoomsTable) -> Iterator[tuple[str, float]]:
    """Path and least height of generated rooms and of boxes."""
    if rooms.exported or rooms.generated:
        default = DistributionTable.model_validate(dict(PROPERTIES["height_m"].default))
        drawn: DistributionTable | None = getattr(rooms.properties, "height_m", None)
        yield "rooms.properties.height_m", (drawn or default).support[0]
    for path, one in _file_rooms(rooms):
        if isinstance(one, PanoramaTable) and one.box_m is not None and not _settings_fault(path, one, recipe):
            yield f"{path}.box_m", one.box_m[4]


def _ray_height(recipe: Recipe, rooms: RoomsTable) -> Iterator[Fault]:
    table = None if recipe.random is None else recipe.random.spot.height_m
    if table is None:
        return  # no ray
    (low, high), limit_m = table.support, min((m for _, m in _heights(recipe, rooms)), default=float("inf"))
    if low <= 0.0 or high >= limit_m:
        text = f"{low:g} m is" if low == high else f"reaches from {low:g} to {high:g} m,"
        yield Fault("random.spot.height_m", f"{text} beyond floor or ceiling; stay above 0 and below {limit_m:g}")


def _least_stroke_m(recipe: Recipe) -> float:
    return 0.0 if recipe.random is None else recipe.random.stroke_m.support[0]


# Files.


def file_faults(recipe: Recipe, files: RoomFiles) -> Iterator[Fault]:
    """Files of rooms that are missing, too large, or not those of the stated SHA-256."""
    for path, table in _file_rooms(recipe.rooms):
        yield from _file_fault(path, table, files)
        if isinstance(table, PanoramaTable) and table.mesh is not None:
            yield from _file_fault(f"{path}.mesh", table.mesh, files)


def _file_fault(path: str, one: PanoramaTable | GeometryTable, files: RoomFiles) -> Iterator[Fault]:
    try:
        digest = RoomFiles(files.folder).sha256(one.file)
    except RoomError as error:
        yield Fault(f"{path}.file", str(error))
        return  # without the file there is no hash
    wanted = one.sha256 or files.digests.get(one.file, digest)
    if digest != wanted:
        text = f"is not that of {one.file}, which has {digest}"
        yield Fault(f"{path}.sha256", f"{text}; put the right file there, or correct the number")
