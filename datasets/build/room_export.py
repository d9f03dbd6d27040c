"""Writer of catalogue and generated rooms as panorama or mesh files, on request or for a data set; damaged ones found.

Both come with the table of a recipe that reads them. The robot is left out: it stands in every room by itself.

A data set exports rooms by itself before samples are drawn, to `rooms/exported/`. The name of each file holds a hash of
the room and of its settings: a file that is there is kept, by a later version of the code too, and its SHA-256 stands
in the documents. Each is written whole or not at all.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console

from phibench.datasets.build.bake_task import bake_settings, light_map
from phibench.datasets.build.dataset_build import missing_room_files
from phibench.datasets.build.task_runner import schedule
from phibench.datasets.build.tasks import BuildTask, Failed, TaskResult
from phibench.datasets.build.workers import WorkerPool
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.progress import Steps
from phibench.datasets.plan.draws import BOX, room_files
from phibench.datasets.recipe.tables import AmbientTable, Recipe
from phibench.datasets.rooms.gltf_export import glb_of
from phibench.datasets.rooms.panorama_room import PanoramaSettings
from phibench.datasets.rooms.room_files import RoomError, RoomFiles
from phibench.datasets.rooms.room_sources import EXPORTED, NamedRoom, UnexportedRoom
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import held_room_files
from phibench.datasets.store.files import require_writable, sha256, write_bytes
from phibench.datasets.store.layers import write_exr
from phibench.render.optics.faces import face_table
from phibench.render.room.light_map import BakeSettings
from phibench.scenes.frames import Vector
from phibench.scenes.room import Room, default_rig
from phibench.scenes.validation import finite_vector, printable_line, within
from phibench.scenes.worlds.generated_room import generate_room
from phibench.scenes.worlds.room_properties import PROPERTIES, drawn_properties

SETTINGS = BakeSettings(texel_m=0.05, indirect_texel_m=0.1, lamp_rays=32, bounces=8, bounce_rays=32, final_rays=128)
_LEAST_ROWS, _MOST_ROWS = 16, 4096  # of a panorama; those that a recipe takes
_CLOSED = 0.75  # part of the directions from a point of a room that meet a surface


@dataclass(frozen=True)
class ExportedRoomFile:
    """A file of a room, and the table of a recipe that reads it."""

    path: Path
    table: str


def export_room(name: str | None, seed: int | None, properties: Sequence[str] = (), *, box: bool = False) -> Room:
    """Room of the catalogue without boards, or a generated one, without the robot.

    Parameters
    ----------
    name, seed : one of them
    properties : texts such as ``height_m=2.6``
        Of a generated room; others are drawn.
    box : bool
        Its walls are a box along the world's axes unless `properties` say otherwise: what a panorama is laid on.

    Raises
    ------
    SceneError
        If there is no such room or property.
    """
    if (name is None) == (seed is None):
        raise RoomError("give --room for a room of the catalogue, or --seed for a generated one, one of them")
    if name is not None:
        if properties:
            raise RoomError("--set is for generated rooms; leave it out, or give --seed instead of --room")
        return replace(NamedRoom(name, ()).build(), robot=False)
    if seed is not None and not 0 <= seed < 2**63:
        raise RoomError(f"--seed {seed}: must be a whole number from 0 to 2^63 - 1")
    stream = ("export", int(seed or 0))
    fixed = (dict(BOX) if box else {}) | dict(_property(text) for text in properties)
    return replace(generate_room(drawn_properties(*stream, **fixed), *stream), robot=False)


def _property(text: str) -> tuple[str, float | str]:
    key, equals, value = text.partition("=")
    if not equals:
        raise RoomError(f"--set {printable_line(text, 60)}: give a property and its value, such as height_m=2.6")
    if key in PROPERTIES and PROPERTIES[key].choices:
        return key, PROPERTIES[key].checked(value)
    try:
        return key, float(value)
    except ValueError:
        raise RoomError(f"--set {printable_line(text, 60)}: the value must be a number") from None


def export_panorama(
    room: Room, out: Path, point_m: Vector, heading_deg: float = 0.0, rows: int = 512, settings: BakeSettings = SETTINGS
) -> ExportedRoomFile:
    """Write the radiance at a point of a room, W/(m^2 sr), as an OpenEXR file of `rows` x 2 `rows` pixels.

    Raises
    ------
    RoomError
        If the point is not inside the room, or the file cannot be a panorama.
    """
    from phibench.render.room.rendered_panorama import rendered_panorama

    if out.suffix.lower() != ".exr":
        raise RoomError(f"{out}: a panorama is written as OpenEXR; give a name that ends in .exr")
    require_writable(out)
    point_m = finite_vector("panorama", "point_m", point_m, 3)
    within("panorama", "heading_deg", heading_deg, -360.0, 360.0)
    within("panorama", "rows", rows, _LEAST_ROWS, _MOST_ROWS)
    if (solid := room.solid_around(point_m)) is not None:
        raise RoomError(f"point_m = {point_m}: the camera would be inside '{solid}'; move it into the open")
    low, high = bounds_m(room)
    if not all(a < x < b for a, x, b in zip(low, point_m, high, strict=True)):
        raise RoomError(f"point_m = {point_m}: outside the room, {low.round(2)} to {high.round(2)} m; move it inside")
    view = default_rig().at(0.0)
    light = light_map(view, room, settings)
    radiance, closed = rendered_panorama(view, room, light, settings, point_m, heading_deg, rows)
    if closed < _CLOSED or radiance.max() <= 0.0:
        text = "shows no light" if closed >= _CLOSED else f"is open in {100.0 * (1.0 - closed):.0f} % of all directions"
        raise RoomError(f"point_m = {point_m}: the room {text} from there; give a point inside a lit room, metres")
    header = {"kind": "panorama", "room": room.name, "point_m": list(point_m), "heading_deg": heading_deg}
    write_exr(out, {name: radiance[..., k] for k, name in enumerate("RGB")}, header)
    box = [float(low[0]), float(high[0]), float(low[1]), float(high[1]), float(high[2])]
    lines = (
        "[[rooms.panoramas]]",
        f'file = "{out.name}"',
        f"point_m = {[float(x) for x in point_m]}",
        f"heading_deg = {heading_deg}",
        f"box_m = {[round(x, 4) for x in box]}  # around all surfaces",
        "radiance_scale = 1.0  # the file holds W/(m^2 sr)",
    )
    return ExportedRoomFile(out, "\n".join(lines))


def export_mesh(room: Room, out: Path) -> ExportedRoomFile:
    """Write a room as glTF, textures inside, lamps and screens as emission.

    Raises
    ------
    RoomError
        If the name is not that of a `.glb` file.
    """
    if out.suffix.lower() != ".glb":
        raise RoomError(f"{out}: a mesh is written as binary glTF; give a name that ends in .glb")
    require_writable(out)
    write_bytes(out, glb_of(room))
    lines = (
        "[[rooms.meshes]]",
        f'file = "{out.name}"',
        "metres_per_unit = 1.0",
        'up_axis = "y"',
        "floor_point = [0.0, 0.0, 0.0]",
        "emission_w_m2_sr = 1.0  # the file holds W/(m^2 sr)",
        "largest_albedo = 1.0",
    )
    return ExportedRoomFile(out, "\n".join(lines))


def bounds_m(room: Room) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of all surfaces of a room, metres."""
    corners = face_table((*room.surfaces, *room.furniture)).corners_m.reshape(-1, 3)
    return corners.min(axis=0), corners.max(axis=0)


# Rooms that a data set exports by itself.


def own_files(recipe: Recipe, files: RoomFiles) -> RoomFiles:
    """Files that the recipe itself names, with their SHA-256.

    Raises
    ------
    RoomError
        If one is not known and cannot be read.
    """
    files_of_rooms = room_files(recipe, files)
    return RoomFiles(
        files_of_rooms.folder, {n: d for n, d in files_of_rooms.digests.items() if not n.startswith(f"{EXPORTED}/")}
    )


def held_files(files: RoomFiles, out: Path) -> RoomFiles:
    """Files of rooms as a folder holds them, where it has all that are known; else as they were."""
    there = (out / schema.ROOM_FILES / EXPORTED).is_dir() and not missing_room_files(files, out)
    return RoomFiles(out / schema.ROOM_FILES, files.digests) if there else files


def export_rooms(
    todo: Sequence[UnexportedRoom], ambient: AmbientTable, pool: WorkerPool, console: Console, made: list[str]
) -> None:
    """Write the files of rooms below the pool's folder, and add their names to `made`.

    Raises
    ------
    DatasetError
        If some cannot be made, when the others are done.
    """
    console.print(f"{_counted(todo)} to be exported before samples are drawn", highlight=False, soft_wrap=True)
    tasks, failures = [export_task(source, ambient) for source in todo], list[str]()
    with Steps(console, "rooms", len(tasks)) as steps:
        for task, outcome in schedule(tasks, pool.executor(len(tasks))):
            if isinstance(outcome, Failed):
                failures.append(f"{task.name} cannot be exported: {outcome.cause}")
            else:
                made += outcome.files
            steps.advance()
    if failures:
        text = f"{len(failures)} of {len(tasks)} rooms failed, the others are kept"
        raise DatasetError("\n".join([f"{text}; run the same command again, or give another seed:", *failures]))


def export_lines(todo: Sequence[UnexportedRoom]) -> list[str]:
    """Say what a run will export first; nothing where all files are there."""
    if not todo:
        return []
    return [f"{_counted(todo)} to be exported first; the samples above are drawn from the surfaces of these files"]


def _counted(todo: Iterable[UnexportedRoom]) -> str:
    kinds = [source.kind.removeprefix("unexported ") for source in todo]
    return f"generated rooms: {kinds.count('panorama')} as panoramas and {kinds.count('mesh')} as meshes are"


def damaged_exports(out: Path) -> list[str]:
    """Exported files of a folder that have other bytes than SHA256SUMS says."""
    folder, known = out / schema.ROOM_FILES, held_room_files(out).digests
    names = {name: folder / name for name in known if name.startswith(f"{EXPORTED}/")}
    return [schema.room_file(name) for name, path in names.items() if path.is_file() and sha256(path) != known[name]]


def export_task(source: UnexportedRoom, ambient: AmbientTable) -> BuildTask:
    """Task that writes the file of a room. It has no key: its file's name tells it from all others."""
    kind = source.kind.removeprefix("unexported ")
    return BuildTask(f"{kind} {source.settings.path.stem}", "", write_room_file, (source, ambient))


def write_room_file(out: Path, source: UnexportedRoom, ambient: AmbientTable) -> TaskResult:
    """Task: write a room's panorama or mesh below `out`, whole or not at all."""
    name, room = schema.room_file(source.file), source.generated()
    settings = source.settings
    if isinstance(settings, PanoramaSettings):
        export_panorama(room, out / name, settings.point_m, settings.heading_deg, source.rows, bake_settings(ambient))
    else:
        export_mesh(room, out / name)
    return TaskResult((name,))
