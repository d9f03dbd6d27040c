"""Making of films: key views of the room, the spot in every frame, the truth; what is finished is kept.

A killed run loses the view or film that it was at: key views are kept one by one (`film_room`), films when they are
complete.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np
import polars
from rich.console import Console

from phibench.datasets.errors import DatasetError
from phibench.datasets.film.film_plan import FilmPlan, check_drives, film_plans
from phibench.datasets.film.film_room import key_views, renderer
from phibench.datasets.film.film_store import (
    CHECKSUMS,
    FILM,
    INFO,
    LIGHT_IMAGES,
    LIGHTS,
    RECIPE,
    SCHEMA_VERSION,
    SPOTS,
    FilmCost,
    FilmFolder,
    FilmInfo,
    FrameTruth,
    SetInfo,
    ViewHashes,
    finite_or_none,
    light_record,
    log_film,
    read_document,
    view_name,
    write_checksums,
    write_document,
    write_records,
    write_spots,
    write_table,
)
from phibench.datasets.parallel import parallel_map
from phibench.datasets.plan.plan import Plan
from phibench.datasets.progress import Steps, progress_console
from phibench.datasets.recipe.load import find_recipe, parse_recipe, recipe_files, recipe_text
from phibench.datasets.store.croissant import films_croissant
from phibench.datasets.store.files import WriteError, only_run, sha256, write_text
from phibench.datasets.store.leftovers import folder_for_work
from phibench.datasets.store.provenance import code_behind, code_sha256
from phibench.datasets.store.schema import CROISSANT, TruthFolder
from phibench.render.film.film_truth import instant_truth
from phibench.render.film.moving_rows import RowsImage, parted_image, rows_image, spot_time_s
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.spot_layer import SpotLayer, SpotLight, spot_layer, spot_light
from phibench.render.optics.truth import depth_m
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.motion.film_scene import FilmScene
from phibench.scenes.room import Room

_UNEVEN = 5e-3  # of the flux: what it changes from frame to frame beside its own course


@dataclass(frozen=True)
class FilmsMade:
    """Outcome: the folder, and the films made and kept."""

    folder: Path
    made: tuple[str, ...]
    kept: tuple[str, ...]


def make_films(
    recipe: str | Path, out: str | Path, workers: int | None = None, console: Console | None = None
) -> FilmsMade:
    """Make the films of a recipe in a folder; films that are there and unchanged are kept.

    Raises
    ------
    DatasetError
        If recipe, folder or disk will not do, or no number of key views is enough; in one sentence.
    """
    out, console = Path(out), console or progress_console()
    text = recipe_text(recipe)
    parsed = parse_recipe(text, str(find_recipe(recipe)), recipe_files(recipe))
    plan, films = film_plans(parsed, recipe_files(recipe))
    check_drives(plan, films)
    _refuse_other(out, parsed.dataset.name)
    try:
        with folder_for_work(out), only_run(out):
            return _make(plan, films, text, out, workers, console)
    except OSError as error:
        told = str(error) if isinstance(error, WriteError) else f"could not write to {out}: {error}"
        raise DatasetError(f"{told}; then run the same command again") from error


def unfinished(plan: Plan, films: Sequence[FilmPlan], out: Path) -> list[FilmPlan]:
    """Films that `make_films` would make in a folder; nothing is written.

    Raises
    ------
    DatasetError
        If the folder holds something else.
    """
    _refuse_other(out, plan.recipe.dataset.name)
    if not out.is_dir():
        return list(films)
    keys = _keys(plan, films)
    return [film for film in films if not _is_done(out, film, keys[film.film_id])]


def _keys(plan: Plan, films: Sequence[FilmPlan]) -> dict[str, str]:
    code = code_behind("phibench.datasets.film.film_make")
    return {film.film_id: film_key(plan, film, code) for film in films}


def _refuse_other(out: Path, name: str) -> None:
    """Raise `DatasetError` for a folder of something else."""
    if out.is_file():
        raise DatasetError(f"{out} is a file; give a folder")
    if not out.is_dir():
        return
    if (out / TruthFolder.DATASET).exists():
        raise DatasetError(f"{out} holds a data set of pairs; give another folder for its films")
    if (out / INFO).is_file() and (held := read_document(out / INFO, SetInfo).name) != name:
        raise DatasetError(f"{out} holds the films of '{held}', not of '{name}'; give another folder")


def _make(
    plan: Plan, films: Sequence[FilmPlan], text: str, out: Path, workers: int | None, console: Console
) -> FilmsMade:
    keys = _keys(plan, films)
    todo = [film for film in films if not _is_done(out, film, keys[film.film_id])]
    for name in {film.film_id for film in films} - {film.film_id for film in todo}:
        FilmFolder.of(out, name).begun.unlink(missing_ok=True)  # of a run that was killed at its very end
    if todo:
        (out / CHECKSUMS).unlink(missing_ok=True)
        one = partial(make_film, out, plan, keys)
        with Steps(console, "films", len(todo)) as steps:
            for cost in parallel_map(one, todo, workers, in_order=False):
                log_film(out, cost)
                steps.advance()
    names = tuple(film.film_id for film in films)
    dataset = plan.recipe.dataset
    write_text(out / RECIPE, text)
    info = SetInfo(
        schema_version=SCHEMA_VERSION, name=dataset.name, seed=dataset.seed, code_sha256=code_sha256(), films=names
    )
    write_document(out / INFO, info)
    types = polars.read_parquet_schema(FilmFolder.of(out, names[0]).path / FILM)
    kinds = {column: str(dtype) for column, dtype in types.items()}
    text = films_croissant(dataset.name, version("phibench"), len(names), kinds)
    write_text(out / CROISSANT, text)
    write_checksums(out, names)
    made = tuple(film.film_id for film in todo)
    return FilmsMade(out, made, tuple(name for name in names if name not in made))


def film_key(plan: Plan, film: FilmPlan, code: str) -> str:
    """SHA-256 over all that a film depends on."""
    ambient = plan.recipe.ambient.model_dump(mode="json")
    document = [repr(film), plan.room(film.pair.room).digest, ambient, code]
    return hashlib.sha256(json.dumps(document).encode()).hexdigest()


def _is_done(out: Path, film: FilmPlan, key: str) -> bool:
    folder = FilmFolder.of(out, film.film_id)
    try:
        info = folder.info()
    except DatasetError:
        return False
    return info.key == key and folder.is_whole(info)


def make_film(out: Path, plan: Plan, keys: dict[str, str], film: FilmPlan) -> FilmCost:
    """Make one film; the start of the renderer and the light map are not counted."""
    room = plan.room(film.pair.room)
    render = renderer(plan, film, room)
    folder = FilmFolder.of(out, film.film_id)
    hashes = ViewHashes(folder)
    folder.done.unlink(missing_ok=True)
    began = time.process_time()
    times = [spot_time_s(film.scene, frame) for frame in range(film.scene.times.frames)]
    images, centres = frame_spots(film, room, times)
    rows = frame_truths(film, room, times, images, centres)
    _check_seen(film, rows)
    places, error = key_views(film, folder, keys[film.film_id], render, images, hashes)
    write_spots(folder.path / SPOTS, images)
    write_table(folder.path / FILM, rows)
    lights = _make_lights(film, room, folder)
    counts = tuple(map(len, places))
    views = [view_name(part, float(place)) for part, at in enumerate(places) for place in at]
    names = [FILM, SPOTS, *lights, *views]
    info = FilmInfo(
        film=film.film_id,
        key=keys[film.film_id],
        frames=film.scene.times.frames,
        u0_px=film.region.u0_px,
        v0_px=film.region.v0_px,
        width_px=film.region.shape[1],
        height_px=film.region.shape[0],
        window_px=film.window_px,
        keys_m=tuple(map(float, np.concatenate(places))),
        key_counts=counts,
        pixel_ratio=finite_or_none(error.pixel_ratio),
        position_ratio=finite_or_none(error.position_ratio),
        sha256={name: sha256(folder.path / name) for name in names},
    )
    write_document(folder.done, info)
    hashes.remove()
    return FilmCost(film.film_id, round(time.process_time() - began, 3))


def _make_lights(film: FilmPlan, room: Room, folder: FilmFolder) -> list[str]:
    """Write images and truth of the other lights; return the files' names."""
    names, records = [], []
    for number, light in enumerate(film.scene.lights):
        images, rows = light_images(film, room, number)
        names.append(LIGHT_IMAGES.format(number))
        write_spots(folder.path / names[-1], images)
        records += [light_record(light.name, row) for row in rows]
    if records:
        names.append(LIGHTS)
        write_records(folder.path / LIGHTS, records)
    return names


def light_images(film: FilmPlan, room: Room, number: int) -> tuple[list[RowsImage], list[FrameTruth]]:
    """Another light in every frame, in its colour, and its truth."""
    alone = replace(film, scene=film.scene.of_light(number))
    times = [spot_time_s(alone.scene, frame) for frame in range(alone.scene.times.frames)]
    images, centres = frame_spots(alone, room, times)
    colour = film.scene.lights[number].colour
    if colour is not None:
        images = [coloured(one, colour) for one in images]
    return images, frame_truths(alone, room, times, images, centres)


def coloured(image: RowsImage, colour: tuple[float, ...]) -> RowsImage:
    """Image whose planes are shares of the laser's red one."""
    share = np.array(colour)[:, None, None]
    stacks = (image.electrons_per_s, image.du_electrons_per_s_px, image.dv_electrons_per_s_px)
    return RowsImage(image.u0_px, image.v0_px, *(share * stack[:1] for stack in stacks))


def frame_spots(film: FilmPlan, room: Room, times_s: Sequence[float]) -> tuple[list[RowsImage], list[SpotLight | None]]:
    """Spot in every frame, and the centre of its light in the still of each of these times.

    Frames of one pose, in which nothing moves, share their image.

    Where a spot goes behind something, or comes out, its flux bends: such frames are put together from parts.
    """
    scene = film.scene
    images: list[RowsImage] = []
    centres: list[SpotLight | None] = []
    flux: list[float] = []
    held: tuple[tuple[float, ...], SpotLayer, SpotLight | None] | None = None
    for frame, at in enumerate(times_s):
        state = _state(film, at)
        if held is not None and held[0] == state and not _moves(film, frame):
            images.append(images[-1])
            flux.append(flux[-1])
            centres.append(centres[-1])
            continue
        if held is None or held[0] != state:
            view = scene.view_at(at)
            layer = spot_layer(view, scene.spot_at(at), room_geometry(room, view))
            held = state, layer, spot_light(view, layer)
        images.append(rows_image(scene, frame, held[1], at))
        flux.append(float(held[1].total_electrons_per_s.sum()))
        centres.append(held[2])
    for frame in _bends(np.array(flux)):
        if _moves(film, frame):
            images[frame] = parted_image(scene, room, frame)
    return images, centres


def _bends(flux: Array) -> list[int]:
    """Frames beside which the flux of the spot does not change evenly."""
    if len(flux) < 2:
        return []
    padded = np.pad(flux, 1, mode="reflect", reflect_type="odd")
    bent = np.abs(np.diff(padded, n=2)) > _UNEVEN * flux.max(initial=0.0)
    near = bent | np.append(bent[1:], False) | np.append(False, bent[:-1])
    return [int(frame) for frame in np.flatnonzero(near)]


def _state(film: FilmPlan, at: float) -> tuple[float, ...]:
    scene = film.scene
    parts = scene.sway_m(at), scene.spot_m(at), scene.robot_state(at)
    return (float(scene.offset_m(at)), *(float(x) for part in parts for x in part))


def _moves(film: FilmPlan, frame: int) -> bool:
    """True if anything changes while a frame is exposed."""
    scene = film.scene
    if scene.code.duration_s > 0.0 or scene.vibrations:
        return True
    times = scene.times
    half = 0.5 * (times.exposure_s + times.readout_s)
    ends = times.frame_s[frame] + half * np.linspace(-1.0, 1.0, 9)
    ways = scene.spot_m(ends), scene.robot_state(ends)
    return bool(np.ptp(scene.offset_m(ends)) or any(np.ptp(way, axis=0).any() for way in ways))


def frame_truths(
    film: FilmPlan,
    room: Room,
    times_s: Sequence[float],
    images: Sequence[RowsImage],
    centres: Sequence[SpotLight | None],
) -> list[FrameTruth]:
    """Truth of every frame."""
    scene = film.scene
    frames = scene.times.frame_s
    # an encoder counts what it takes for metres: at the stop above, the stroke that it was told
    told = film.pair.nominal_stroke_m / film.pair.stroke_m
    readings = film.encoder.readings_m(told * scene.carriage.position_m(frames), *film.names)
    tracks = np.zeros((len(frames), 2)) if scene.drive is None else scene.drive.readings_m(frames, *film.names)
    return [
        FrameTruth(
            frame,
            float(readings[frame]),
            film.encoder.sigma_m,
            as_vector(tracks[frame]),
            instant_truth(scene, room, float(frames[frame])),
            instant_truth(scene, room, at),
            centres[frame],
            _light_depth_m(scene, at, centres[frame]),
            tuple(float(x) for x in images[frame].electrons_per_s.sum(axis=(1, 2))),
        )
        for frame, at in enumerate(times_s)
    ]


def _light_depth_m(scene: FilmScene, time_s: float, light: SpotLight | None) -> float:
    if light is None:
        return math.nan
    down = scene.view_of(0.0, np.zeros(3), scene.robot_state(time_s)).sphere_centre_m
    return float(depth_m(np.array(light.place_world_m), down))


def _check_seen(film: FilmPlan, rows: Sequence[FrameTruth]) -> None:
    if not any(row.at_row.spot.visible for row in rows):
        cause = rows[0].at_row.spot.cause
        raise DatasetError(f"film {film.film_id}: the target is never seen ({cause}); move the target or the rig")
