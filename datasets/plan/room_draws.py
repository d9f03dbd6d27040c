"""Rooms of a recipe: the one of `[room]`, or those of `[rooms]`, of several kinds in turn.

The first rooms are one of each kind, so that a few samples show all of them. Each property of a generated room has a
random stream of its own: neither more rooms nor another property changes it.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from itertools import chain, zip_longest
from pathlib import Path

import numpy as np

from phibench.datasets.recipe.build import room_source
from phibench.datasets.recipe.distributions import DistributionTable, quantile
from phibench.datasets.recipe.room_tables import RoomPropertiesTable, RoomsTable
from phibench.datasets.recipe.tables import Recipe
from phibench.datasets.rooms.mesh_placement import MeshSettings
from phibench.datasets.rooms.panorama_settings import PanoramaSettings
from phibench.datasets.rooms.room_files import RoomFiles
from phibench.datasets.rooms.room_sources import (
    EXPORTED,
    ONLY_ROOM,
    GeneratedRoom,
    MeshRoom,
    PanoramaRoom,
    RoomSource,
    UnexportedRoom,
)
from phibench.scenes.random_streams import generator
from phibench.scenes.worlds.floor_plan import floor_plan
from phibench.scenes.worlds.properties import drawn_properties

BOX: dict[str, float | str] = {"heading_deg": 0.0, "l_shape": 0.0}
"""Properties of a generated room whose walls are a box along the world's axes: what a panorama is laid on."""
# Every generated room leaves a cylinder of 0.20 m about the stroke axis free up to its ceiling, here for the camera.
_CAMERA_RADIUS_M = 0.12
_CAMERA_HEIGHTS_M = (1.1, 1.7)  # at which one holds a camera


def draw_rooms(recipe: Recipe, files: RoomFiles | None = None) -> dict[str, RoomSource]:
    """Sources of the rooms of a recipe, by id, in the order in which samples are dealt to them.

    Raises
    ------
    RoomError
        If the SHA-256 of a file is not known and the file cannot be read.
    """
    table, dataset = recipe.rooms, recipe.dataset
    if table is None:
        return {ONLY_ROOM: room_source(recipe.room, recipe.targets)}
    files, stroke_m = files or RoomFiles(), least_stroke_m(recipe)
    generated: list[tuple[str, RoomSource]] = [
        (f"room{k:06d}", _generated(table.properties, (dataset.name, dataset.seed, "room", k)))
        for k in range(table.generated)
    ]
    panoramas, meshes = _panoramas(table, files, stroke_m), _meshes(table, files, stroke_m)
    first, second = len(panoramas), len(meshes)
    panoramas += [
        (f"panorama{first + k:06d}", _read(_to_panorama(recipe, table, k), files))
        for k in range(table.exported_panoramas)
    ]
    meshes += [
        (f"mesh{second + k:06d}", _read(_to_mesh(recipe, table, k), files)) for k in range(table.exported_meshes)
    ]
    return dict(filter(None, chain.from_iterable(zip_longest(generated, panoramas, meshes))))


def room_files(recipe: Recipe, files: RoomFiles) -> RoomFiles:
    """Files of the rooms of a recipe, with the SHA-256 that each must have.

    Raises
    ------
    RoomError
        If it is not known and the file cannot be read.
    """
    pinned = {} if recipe.rooms is None else recipe.rooms.pinned
    known = {name: digest for name, digest in pinned.items() if digest is not None}
    files = RoomFiles(files.folder, {**files.digests, **known})
    sources = used_rooms(recipe, files).values() if recipe.rooms is not None and recipe.rooms.exported else ()
    made = [source.settings.path.as_posix() for source in sources if isinstance(source, PanoramaRoom | MeshRoom)]
    return files.of([*pinned, *(name for name in made if name not in pinned)])


def used_rooms(recipe: Recipe, files: RoomFiles) -> dict[str, RoomSource]:
    """Sources of those rooms of a recipe to which a sample is dealt, as `draw_rooms`."""
    rooms = draw_rooms(recipe, files)
    count = len(rooms) if recipe.random is None else recipe.random.samples
    return dict(list(rooms.items())[:count])


def unexported(recipe: Recipe, files: RoomFiles) -> list[UnexportedRoom]:
    """Rooms with samples whose file the data set has to make."""
    return [source for source in used_rooms(recipe, files).values() if isinstance(source, UnexportedRoom)]


def least_stroke_m(recipe: Recipe) -> float:
    """Shortest stroke that `[random]` draws: what a room must leave free unless it states more."""
    return 0.0 if recipe.random is None else recipe.random.stroke_m.support[0]


def _panoramas(table: RoomsTable, files: RoomFiles, stroke_m: float) -> list[tuple[str, RoomSource]]:
    return [
        (
            f"panorama{k:06d}",
            PanoramaRoom(
                panorama.settings(stroke_m),
                files.sha256(panorama.file),
                "" if panorama.mesh is None else files.sha256(panorama.mesh.file),
            ),
        )
        for k, panorama in enumerate(table.panoramas)
    ]


def _meshes(table: RoomsTable, files: RoomFiles, stroke_m: float) -> list[tuple[str, RoomSource]]:
    return [
        (f"mesh{k:06d}", MeshRoom(mesh.settings(stroke_m), files.sha256(mesh.file)))
        for k, mesh in enumerate(table.meshes)
    ]


# Rooms that are generated and exported.


def _read(source: UnexportedRoom, files: RoomFiles) -> RoomSource:
    """Room of the file, where it is there; else the one that is to be exported."""
    if not files.holds(source.file):
        return source
    sha256 = files.sha256(source.file)
    if isinstance(source.settings, PanoramaSettings):
        return PanoramaRoom(source.settings, sha256)
    return MeshRoom(source.settings, sha256)


def _to_panorama(recipe: Recipe, table: RoomsTable, k: int) -> UnexportedRoom:
    stream = (recipe.dataset.name, recipe.dataset.seed, "panorama", k)
    room = _generated(table.properties, stream, box=True)
    plan, rng = floor_plan(room.properties), generator(*stream, "camera")
    (x, y), height_m = plan.robot, plan.height_m
    distance_m, turn = _CAMERA_RADIUS_M * np.sqrt(rng.random()), 2.0 * np.pi * rng.random()
    low_m, high_m = _CAMERA_HEIGHTS_M
    point = (distance_m * np.cos(turn), distance_m * np.sin(turn), rng.uniform(low_m, min(high_m, height_m - 0.3)))
    settings = PanoramaSettings(
        path=Path(f"{EXPORTED}/panorama{k:06d}-{_key(recipe, room, table.panorama_rows)}.exr"),
        point_m=tuple(round(float(p), 4) for p in point),
        box_m=tuple(round(float(p), 4) for p in (-x, plan.length_m - x, -y, plan.width_m - y, height_m)),
        radiance_scale=1.0,
        stroke_m=least_stroke_m(recipe),
        name=_name("panorama of", stream),
    )
    return UnexportedRoom(room, settings, table.panorama_rows, "unexported panorama")


def _to_mesh(recipe: Recipe, table: RoomsTable, k: int) -> UnexportedRoom:
    stream = (recipe.dataset.name, recipe.dataset.seed, "mesh", k)
    room = _generated(table.properties, stream)
    settings = MeshSettings(
        path=Path(f"{EXPORTED}/mesh{k:06d}-{_key(recipe, room)}.glb"),
        metres_per_unit=1.0,
        up_axis="y",
        floor_point=(0.0, 0.0, 0.0),
        emission_w_m2_sr=1.0,  # the file holds W/(m^2 sr)
        largest_albedo=1.0,
        stroke_m=least_stroke_m(recipe),
        name=_name("mesh of", stream),
    )
    return UnexportedRoom(room, settings, table.panorama_rows, "unexported mesh")


def _name(what: str, stream: tuple[str | int, ...]) -> str:
    return f"{what} generated:{':'.join(map(str, stream))}"


def _key(recipe: Recipe, room: GeneratedRoom, rows: int | None = None) -> str:
    """Part of a file's name that differs where another file would be made."""
    light = None if rows is None else [rows, recipe.ambient.model_dump(mode="json")]
    document = json.dumps([asdict(room), light], sort_keys=True, allow_nan=False)
    return hashlib.sha256(document.encode()).hexdigest()[:12]


def _generated(table: RoomPropertiesTable, stream: tuple[str | int, ...], box: bool = False) -> GeneratedRoom:
    fixed: dict[str, float | str] = {}
    for name in type(table).model_fields:
        if (chosen := getattr(table, name)) is not None:
            u = np.array([generator(*stream, "property", name).random()])
            named = not isinstance(chosen, DistributionTable)
            value = chosen.choice[int(u[0] * len(chosen.choice))] if named else quantile(chosen, u)[0]
            fixed[name] = value if isinstance(value, str) else float(value)
    return GeneratedRoom(drawn_properties(*stream, **(fixed | (BOX if box else {}))), stream)
