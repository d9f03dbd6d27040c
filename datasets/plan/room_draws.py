"""Rooms of a recipe: the one of `[room]`, or those of `[rooms]`, of several kinds in turn.

The first rooms are one of each kind, so that a few samples show all of them. Each property of a generated room has a
random stream of its own: neither more rooms nor another property changes it.
"""

from __future__ import annotations

from itertools import chain, zip_longest

import numpy as np

from phibench.datasets.recipe.build import room_source
from phibench.datasets.recipe.distributions import DistributionTable, quantile
from phibench.datasets.recipe.room_tables import RoomPropertiesTable, RoomsTable
from phibench.datasets.recipe.tables import Recipe
from phibench.datasets.rooms.room_files import RoomFiles
from phibench.datasets.rooms.room_sources import ONLY_ROOM, GeneratedRoom, MeshRoom, PanoramaRoom, RoomSource
from phibench.scenes.random_streams import generator
from phibench.scenes.worlds.properties import drawn_properties


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
    kinds = generated, _panoramas(table, files, stroke_m), _meshes(table, files, stroke_m)
    return dict(filter(None, chain.from_iterable(zip_longest(*kinds))))


def room_files(recipe: Recipe, files: RoomFiles) -> RoomFiles:
    """Files of the rooms of a recipe, with the SHA-256 that each must have.

    Raises
    ------
    RoomError
        If it is not known and the file cannot be read.
    """
    pinned = {} if recipe.rooms is None else recipe.rooms.pinned
    known = {name: digest for name, digest in pinned.items() if digest is not None}
    return RoomFiles(files.folder, {**files.digests, **known}).of(pinned)


def least_stroke_m(recipe: Recipe) -> float:
    """Shortest stroke that `[random]` draws: what a room must leave free unless it states more."""
    return 0.0 if recipe.random is None else recipe.random.stroke_m.support[0]


def _panoramas(table: RoomsTable, files: RoomFiles, stroke_m: float) -> list[tuple[str, RoomSource]]:
    return [
        (
            f"panorama{k:06d}",
            PanoramaRoom(
                one.settings(stroke_m), files.sha256(one.file), "" if one.mesh is None else files.sha256(one.mesh.file)
            ),
        )
        for k, one in enumerate(table.panoramas)
    ]


def _meshes(table: RoomsTable, files: RoomFiles, stroke_m: float) -> list[tuple[str, RoomSource]]:
    return [
        (f"mesh{k:06d}", MeshRoom(one.settings(stroke_m), files.sha256(one.file))) for k, one in enumerate(table.meshes)
    ]


def _generated(table: RoomPropertiesTable, stream: tuple[str | int, ...]) -> GeneratedRoom:
    fixed: dict[str, float | str] = {}
    for name in type(table).model_fields:
        if (chosen := getattr(table, name)) is not None:
            u = np.array([generator(*stream, "property", name).random()])
            named = not isinstance(chosen, DistributionTable)
            value = chosen.choice[int(u[0] * len(chosen.choice))] if named else quantile(chosen, u)[0]
            fixed[name] = value if isinstance(value, str) else float(value)
    return GeneratedRoom(drawn_properties(*stream, **fixed), stream)
