"""Checks of the rooms in a recipe: which tables go together, places of camera and robot, heights, and the files."""

from __future__ import annotations

import re
from collections.abc import Iterator

from pydantic import ValidationError

from phibench.datasets.recipe.distributions import DistributionTable, Raw, distribution_of, table_of, tables_of
from phibench.datasets.recipe.room_tables import ROOM_LISTS, GeometryTable, MeshTable, PanoramaTable, generated_count
from phibench.datasets.rooms.room_files import RoomError, RoomFiles
from phibench.scenes.rig import Rig
from phibench.scenes.validation import Fault, SceneError
from phibench.scenes.worlds.properties import PROPERTIES

_KINDS: tuple[tuple[str, type[PanoramaTable] | type[MeshTable]], ...] = (
    ("panoramas", PanoramaTable),
    ("meshes", MeshTable),
)


def room_faults(raw: Raw) -> Iterator[Fault]:
    """Faults of the tables of rooms: a recipe has boards, or rooms with spots that rays find."""
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
    elif "azimuth_deg" not in table_of(raw, "random", "spot"):
        yield Fault("random.spot.azimuth_deg", "missing; in these rooms a ray finds the spot, give its azimuth_deg")
    yield from _counts(raw)
    for path, table in _file_rooms(raw):
        if fault := _settings_fault(path, table, raw):
            yield fault
    yield from _ray_height(raw)


def _counts(raw: Raw) -> Iterator[Fault]:
    rooms = table_of(raw, "rooms")
    others, exported = _listed(rooms), _exported(rooms)
    if rooms.get("count") == 0 and type(rooms["count"]) is int and not others and not exported:
        text = "0, and there are no panoramas or meshes; give 1 or more, or [[rooms.panoramas]] or [[rooms.meshes]]"
        yield Fault("rooms.count", text)
    elif others and not exported and not rooms.get("count") and table_of(rooms, "properties"):
        yield Fault("rooms.properties", "given, but no room is generated; give rooms.count above 0, or remove it")


def _listed(rooms: Raw) -> int:
    """Number of rooms that the recipe lists one by one."""
    return sum(len(tables_of(rooms, key)) for key in ROOM_LISTS)


def _exported(rooms: Raw) -> int:
    """Number of generated rooms that become files; a value that is no number of rooms is told by itself."""
    counts = (rooms.get(f"exported_{key}", 0) for key, _ in _KINDS)
    return sum(count for count in counts if type(count) is int and count > 0)


def _file_rooms(raw: Raw) -> Iterator[tuple[str, PanoramaTable | MeshTable]]:
    """Sound tables of panoramas and meshes, with their paths; a faulty one is told by itself."""
    for key, model in _KINDS:
        for i, entry in tables_of(table_of(raw, "rooms"), key):
            try:
                yield f"rooms.{key}[{i}]", model.model_validate(entry)
            except ValidationError:  # told by the table
                continue


def _settings_fault(path: str, one: PanoramaTable | MeshTable, raw: Raw) -> Fault | None:
    """Fault of numbers of which no room can be made, at the key that it is about; None if there is none."""
    try:
        one.settings(_least_stroke_m(raw))
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


def low_rooms(raw: Raw, rig: Rig) -> Iterator[Fault]:
    """Rooms whose ceiling the mirror's top reaches with the shortest stroke; longer ones are drawn again."""
    stroke_m = _least_stroke_m(raw)
    top_m = float(rig.at(stroke_m).sphere_centre_m[2]) + rig.mirror.bound_m
    with_it = f"the mirror's top is at {top_m:.2f} m with the shortest stroke of [random], {stroke_m:g} m"
    for path, height_m in _heights(raw):
        if height_m <= top_m:
            text = f"the ceiling can be at {height_m:g} m, and {with_it}"
            yield Fault(path, f"{text}; make the room higher or the stroke shorter")


def _heights(raw: Raw) -> Iterator[tuple[str, float]]:
    """Path and least height of generated rooms and of boxes."""
    rooms = table_of(raw, "rooms")
    others, count = _listed(rooms), rooms.get("count")
    exported = _exported(rooms)
    if exported or generated_count(count if isinstance(count, int) else None, others):
        default = DistributionTable.model_validate(dict(PROPERTIES["height_m"].default))
        table = distribution_of(table_of(rooms, "properties").get("height_m")) or default
        if table.support[0] >= PROPERTIES["height_m"].low:  # else told by the table
            yield "rooms.properties.height_m", table.support[0]
    for path, one in _file_rooms(raw):
        if isinstance(one, PanoramaTable) and one.box_m is not None and not _settings_fault(path, one, raw):
            yield f"{path}.box_m", one.box_m[4]


def _ray_height(raw: Raw) -> Iterator[Fault]:
    table = distribution_of(table_of(raw, "random", "spot").get("height_m"))
    if table is None:
        return  # told by the table
    (low, high), limit_m = table.support, min((height for _, height in _heights(raw)), default=float("inf"))
    if low <= 0.0 or high >= limit_m:
        text = f"{low:g} m is" if low == high else f"reaches from {low:g} to {high:g} m,"
        yield Fault("random.spot.height_m", f"{text} beyond floor or ceiling; stay above 0 and below {limit_m:g}")


def _least_stroke_m(raw: Raw) -> float:
    table = distribution_of(table_of(raw, "random").get("stroke_m"))
    return 0.0 if table is None else max(table.support[0], 0.0)


# Files.


def file_faults(raw: Raw, files: RoomFiles) -> Iterator[Fault]:
    """Files of rooms that are missing, too large, or not those of the stated SHA-256."""
    for path, table in _file_rooms(raw):
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
