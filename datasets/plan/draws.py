"""Random draws of a plan: rooms and their files, rigs of `[rigs]`, and samples rebuilt from draws of an earlier run."""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain, zip_longest
from pathlib import Path

import numpy as np

from phibench.datasets.common.errors import RecipeError
from phibench.datasets.plan.sampling import (
    PREFIX,
    TRIES,
    RandomSample,
    Value,
    draw_values,
    drawn_misalignment,
    drawn_parameters,
    drawn_rigs,
    first_points,
    further_points,
    points_of,
    rig_fault,
    rows_of,
)
from phibench.datasets.recipe.distributions import DistributionTable, quantile
from phibench.datasets.recipe.recipe_scene import (
    build_target,
    ceiling_m,
    make_spot,
    room_source,
    text_by_keys,
    true_stroke_m,
)
from phibench.datasets.recipe.room_tables import RoomPropertiesTable, RoomsTable
from phibench.datasets.recipe.tables import DrawnRigsTable, RandomTable, Recipe
from phibench.datasets.rooms.mesh_placement import MeshSettings
from phibench.datasets.rooms.panorama_room import PanoramaSettings
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
from phibench.scenes.frames import Array, Vector
from phibench.scenes.laser import LaserSpot
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.random_streams import generator
from phibench.scenes.rig import Rig
from phibench.scenes.room import Boards, Room
from phibench.scenes.validation import SceneError
from phibench.scenes.worlds.floor_plan import floor_plan
from phibench.scenes.worlds.room_properties import drawn_properties

# Rooms of a recipe: the one of `[room]`, or those of `[rooms]`, of several kinds in turn.
#
# The first rooms are one of each kind, so that a few samples show all of them. Each property of a generated room has a
# random stream of its own: neither more rooms nor another property changes it.


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


def unexported_rooms(recipe: Recipe, files: RoomFiles) -> list[UnexportedRoom]:
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


# Random rigs of a recipe with `[rigs]`: misalignments that are drawn, again where a rig is impossible.
#
# Impossible is a rig that cannot exist, or cannot make one of the strokes in its room.


@dataclass(frozen=True)
class DrawnRig:
    """A drawn rig.

    Attributes
    ----------
    rig_id : str
        Such as ``r000002``, the third one.
    tries : int
        Number of the first draw that was possible.
    drawn : tuple of (parameter, value)
        Parameters as in `PARAMETERS`.
    rig : Rig, the true one
    """

    rig_id: str
    tries: int
    drawn: tuple[tuple[str, Value], ...]
    misalignment: Misalignment
    rig: Rig


def draw_rigs(recipe: Recipe, table: DrawnRigsTable, nominal: Rig, room: Room) -> tuple[DrawnRig, ...]:
    """All rigs of a recipe with `[rigs]`.

    Raises
    ------
    RecipeError
        If a rig stays impossible after `TRIES` draws, with the reason of the last one.
    """
    chosen = _rig_distributions(table)
    first = first_points("independent", recipe.dataset.name, recipe.dataset.seed, table.count, chosen)
    values = {name: quantile(chosen[name], u) for name, u in first.items()}
    top_m, boards = ceiling_m(room), Boards([build_target(target) for target in recipe.targets])
    return tuple(_possible(recipe, chosen, _row(values, k), k, nominal, top_m, boards) for k in range(table.count))


def _possible(
    recipe: Recipe,
    chosen: Mapping[str, DistributionTable],
    drawn: dict[str, Value],
    number: int,
    nominal: Rig,
    top_m: float,
    boards: Boards,
) -> DrawnRig:
    for attempt in range(TRIES):
        if attempt:
            points = further_points(recipe.dataset.name, recipe.dataset.seed, chosen, [number], attempt)
            drawn = _row({name: quantile(chosen[name], u) for name, u in points.items()}, 0)
        made = _made(recipe, drawn, number, attempt + 1, nominal, top_m, boards)
        if isinstance(made, DrawnRig):
            return made
    text = f"rig {number} stays impossible in {TRIES} draws; the last: {made}"
    raise RecipeError(f"rigs: {text}; narrow the distributions, move the boards or shorten the strokes")


def _made(
    recipe: Recipe, drawn: dict[str, Value], number: int, tries: int, nominal: Rig, top_m: float, boards: Boards
) -> DrawnRig | str:
    """The rig, or why it is impossible."""
    try:
        misalignment = drawn_misalignment(recipe.misalignment, drawn)
        rig = nominal.perturbed(misalignment)
        strokes_m = {true_stroke_m(misalignment, h) for experiment in recipe.experiments for h in experiment.strokes_m}
    except SceneError as error:
        return text_by_keys(str(error))
    faults = (rig_fault(rig, stroke_m, top_m, boards) for stroke_m in sorted(strokes_m))
    why = next((fault for fault in faults if fault), None)
    return why or DrawnRig(f"r{number:06d}", tries, tuple(drawn.items()), misalignment, rig)


def _rig_distributions(table: DrawnRigsTable) -> dict[str, DistributionTable]:
    """Distribution by parameter, in the order of `[misalignment]`."""
    given = ((key, getattr(table.misalignment, key)) for key in type(table.misalignment).model_fields)
    return {PREFIX + key: distribution for key, distribution in given if isinstance(distribution, DistributionTable)}


def _row(values: Mapping[str, Array], k: int) -> dict[str, Value]:
    return {name: float(np.asarray(column)[k]) for name, column in values.items()}


# Samples that were drawn before, made again from what took long to find.
#
# To find the draw of a sample that is possible, its room is built and rays are traced in it. The number of that draw
# and its spot are kept; rig and stroke follow from the draw's numbers in a millisecond, to the same bits, without a
# room.


Causes = tuple[str, str]
"""Causes of both views, down and up, as in `render.optics.truth`."""


@dataclass(frozen=True)
class KeptSample:
    """Outcome of a sample's draws; the vectors are those of its spot."""

    tries: int
    surface: str
    position_world_m: Vector
    normal_world: Vector
    diameter_m: float
    beam_direction_world: Vector | None
    causes: Causes


KeptSamples = Mapping[int, KeptSample | str]
"""Outcome by number of a sample; of one that stays impossible its reason."""


def rebuilt_samples(
    recipe: Recipe, table: RandomTable, rooms: Sequence[str], kept: KeptSamples, wanted: range
) -> dict[int, RandomSample]:
    """Kept samples of the wanted numbers; `rooms` are the ids of all rooms. One that is no draw of this is left out."""
    first = first_points(
        table.sequence, recipe.dataset.name, recipe.dataset.seed, table.samples, drawn_parameters(table)
    )
    by_draw: dict[int, list[int]] = defaultdict(list)
    for number in wanted:
        if isinstance(sample := kept.get(number), KeptSample):
            by_draw[sample.tries].append(number)
    targets, samples = [target.name for target in recipe.targets], dict[int, RandomSample]()
    for tries, numbers in by_draw.items():
        points = points_of(recipe, table, first, numbers, tries - 1)
        rows = rows_of(draw_values(table, targets, points), len(numbers))
        for number, drawn in zip(numbers, rows, strict=True):
            sample = kept[number]
            assert isinstance(sample, KeptSample)
            try:
                rigs, spot = drawn_rigs(recipe, dict(drawn)), _spot(recipe, sample)
            except SceneError:  # of an older draw: it is drawn anew
                continue
            place = (rooms[number % len(rooms)], rigs.rig, sample.surface, spot)
            numbers_of = (rigs.stroke_m, rigs.nominal_rig, rigs.nominal_stroke_m)
            samples[number] = RandomSample(number, tries, drawn, *place, *numbers_of, sample.causes)
    return samples


def _spot(recipe: Recipe, one: KeptSample) -> LaserSpot:
    vectors = (one.position_world_m, one.normal_world, one.diameter_m, one.beam_direction_world)
    spot = make_spot(recipe.laser, *vectors)
    # both are of unit length already, and dividing by it again would change their last bit
    object.__setattr__(spot, "normal_world", one.normal_world)
    object.__setattr__(spot, "beam_direction_world", one.beam_direction_world)
    return spot
