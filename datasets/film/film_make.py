"""Making of films: key views of the room, the spot in every frame, the truth; what is finished is kept.

A killed run loses the view or film that it was at: key views are kept one by one, films when they are complete. The
number of key views is doubled until the view that was left out agrees with the interpolated one (`key_views`).
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from phibench.datasets.errors import DatasetError
from phibench.datasets.film.film_plan import FilmPlan, film_plans, offset_range_m
from phibench.datasets.film.film_store import (
    CHECKSUMS,
    INFO,
    LIGHT_IMAGES,
    LIGHTS,
    RECIPE,
    SCHEMA_VERSION,
    FilmFolder,
    FilmInfo,
    FrameTruth,
    SetInfo,
    finite_or_none,
    light_record,
    read_document,
    read_view,
    view_key,
    write_checksums,
    write_document,
    write_records,
    write_spots,
    write_table,
    write_view,
)
from phibench.datasets.parallel import parallel_map
from phibench.datasets.plan.plan import Plan
from phibench.datasets.progress import Steps, progress_console
from phibench.datasets.recipe.load import find_recipe, parse_recipe, recipe_files, recipe_text
from phibench.datasets.recipe.tables import AmbientTable
from phibench.datasets.store.files import WriteError, only_run, sha256, write_text
from phibench.datasets.store.provenance import code_behind, code_sha256
from phibench.render.film.film_truth import instant_truth
from phibench.render.film.key_views import ALLOWED, ViewError, blended, compare, key_offsets_m, key_weights
from phibench.render.film.moving_rows import RowsImage, rows_image, spot_time_s
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.spot_layer import spot_layer
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import seed_32
from phibench.scenes.rig import View
from phibench.scenes.room import Room

_DOUBLINGS = 5
Render = Callable[[View, int], NDArray[np.float32]]
"""Room of a view on the film's region, shape (3, h, w), from a seed."""


@dataclass(frozen=True)
class Made:
    """Outcome: the folder, and the films made and kept."""

    folder: Path
    made: tuple[str, ...]
    kept: tuple[str, ...]


def make_films(recipe: str | Path, out: str | Path, workers: int | None = None, console: Console | None = None) -> Made:
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
    _refuse_other(out, parsed.dataset.name)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with only_run(out):
            return _make(plan, films, text, out, workers, console)
    except OSError as error:
        told = str(error) if isinstance(error, WriteError) else f"could not write to {out}: {error}"
        raise DatasetError(f"{told}; then run the same command again") from error


def _refuse_other(out: Path, name: str) -> None:
    """Raise `DatasetError` for a folder of something else."""
    if out.is_file():
        raise DatasetError(f"{out} is a file; give a folder")
    if not out.is_dir():
        return
    if (out / "dataset.json").exists():
        raise DatasetError(f"{out} holds a data set of pairs; give another folder for its films")
    if (out / INFO).is_file() and (held := read_document(out / INFO, SetInfo).name) != name:
        raise DatasetError(f"{out} holds the films of '{held}', not of '{name}'; give another folder")


def _make(plan: Plan, films: Sequence[FilmPlan], text: str, out: Path, workers: int | None, console: Console) -> Made:
    code = code_behind("phibench.datasets.film.film_make")
    keys = {film.film_id: film_key(plan, film, code) for film in films}
    todo = [film for film in films if not _is_done(out, film, keys[film.film_id])]
    if todo:
        (out / CHECKSUMS).unlink(missing_ok=True)
        one = partial(make_film, out, plan, keys)
        with Steps(console, "films", len(todo)) as steps:
            for _ in parallel_map(one, todo, workers, in_order=False):
                steps.advance()
    names = tuple(film.film_id for film in films)
    dataset = plan.recipe.dataset
    write_text(out / RECIPE, text)
    info = SetInfo(
        schema_version=SCHEMA_VERSION, name=dataset.name, seed=dataset.seed, code_sha256=code_sha256(), films=names
    )
    write_document(out / INFO, info)
    write_checksums(out, names)
    made = tuple(film.film_id for film in todo)
    return Made(out, made, tuple(name for name in names if name not in made))


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


def make_film(out: Path, plan: Plan, keys: dict[str, str], film: FilmPlan) -> str:
    """Make one film; return its id."""
    room = plan.room(film.pair.room)
    render = renderer(plan, film, room)
    folder = FilmFolder.of(out, film.film_id)
    folder.done.unlink(missing_ok=True)
    began = time.process_time()
    times = [spot_time_s(film.scene, frame) for frame in range(film.scene.times.frames)]
    images = frame_spots(film, room, times)
    rows = frame_truths(film, room, times, images)
    _check_seen(film, rows)
    offsets, error = key_views(film, folder, keys[film.film_id], render, images)
    write_spots(folder.path / "spots.npz", images)
    write_table(folder.path / "film.parquet", rows)
    lights = _make_lights(film, room, folder)
    names = ["film.parquet", "spots.npz", *lights, *(f"views/k{n:03d}.exr" for n in range(len(offsets)))]
    info = FilmInfo(
        film=film.film_id,
        key=keys[film.film_id],
        frames=film.scene.times.frames,
        u0_px=film.region.u0_px,
        v0_px=film.region.v0_px,
        width_px=film.region.shape[1],
        height_px=film.region.shape[0],
        window_px=film.window_px,
        keys_m=tuple(map(float, offsets)),
        pixel_ratio=finite_or_none(error.pixel_ratio),
        position_ratio=finite_or_none(error.position_ratio),
        cpu_s=round(time.process_time() - began, 3),
        sha256={name: sha256(folder.path / name) for name in names},
    )
    write_document(folder.done, info)
    return film.film_id


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
    images = frame_spots(alone, room, times)
    colour = film.scene.lights[number].colour
    if colour is not None:
        images = [_coloured(one, colour) for one in images]
    return images, frame_truths(alone, room, times, images)


def _coloured(image: RowsImage, colour: tuple[float, ...]) -> RowsImage:
    """Image whose planes are shares of the laser's red one."""
    share = np.array(colour)[:, None, None]
    stacks = (image.electrons_per_s, image.du_electrons_per_s_px, image.dv_electrons_per_s_px)
    return RowsImage(image.u0_px, image.v0_px, *(share * stack[:1] for stack in stacks))


def renderer(plan: Plan, film: FilmPlan, room: Room) -> Render:
    """Renderer of the room on the film's region; the light map is baked, or taken from the cache, now."""
    if not room.lit:
        return lambda view, seed: np.zeros((3, *film.region.shape), np.float32)
    from phibench.datasets.build.bake_task import bake_settings
    from phibench.datasets.build.light_map_cache import light_map
    from phibench.datasets.build.view_task import start_renderer
    from phibench.render.room.ambient import render_ambient
    from phibench.render.room.noise_budget import BUDGETS

    start_renderer()
    ambient: AmbientTable = plan.recipe.ambient
    settings = bake_settings(ambient)
    light = light_map(plan.rig.at(0.0), room, settings)
    height, width = film.region.shape
    crop = (film.region.u0_px, film.region.v0_px, width, height)

    def render(view: View, seed: int) -> NDArray[np.float32]:
        budget = BUDGETS[ambient.quality]
        layer = render_ambient(view, room, light, settings, ambient.cells_per_pixel, seed, crop=crop, budget=budget)
        return layer.electrons_per_s

    return render


# Room.


def key_views(
    film: FilmPlan, folder: FilmFolder, key: str, render: Render, images: Sequence[RowsImage]
) -> tuple[Array, ViewError]:
    """Render key views until a view that was left out agrees; return their offsets and that view's error.

    Raises
    ------
    DatasetError
        If five doublings do not do.
    """
    count = film.keys
    for _ in range(_DOUBLINGS + 1):
        offsets = key_offsets_m(*offset_range_m(film.scene), count)
        views = np.stack([_key_view(film, folder, key, render, n, float(at)) for n, at in enumerate(offsets)])
        error = held_out_error(film, render, offsets, views, images)
        if error.largest <= ALLOWED:
            for stale in sorted(folder.path.glob("views/k*.exr"))[len(offsets) :]:
                stale.unlink()
            return offsets, error
        count = 2 * len(offsets) - 1
    raise DatasetError(
        f"film {film.film_id}: a view that was left out differs from the interpolated one by {error.largest:.2f} of "
        f"the sensor's noise, {ALLOWED} is allowed, with {len(offsets)} key views; weaken the vibration"
    )


def _key_view(
    film: FilmPlan, folder: FilmFolder, key: str, render: Render, number: int, offset_m: float
) -> NDArray[np.float32]:
    """Key view from its file, or rendered and written; after a killed run, or one with other keys, files are told."""
    path = folder.view(number)
    wanted = hashlib.sha256(f"{key} {offset_m!r}".encode()).hexdigest()
    if view_key(path) != wanted:
        seed = seed_32(*film.names, "key", f"{offset_m:.9f}")
        planes = render(film.scene.rig.at(offset_m), seed)
        write_view(path, planes, film.region, {"film": film.film_id, "offset_m": offset_m, "key": wanted})
    return read_view(path, film.region)


def held_out_error(
    film: FilmPlan, render: Render, offsets: Array, views: NDArray[np.float32], images: Sequence[RowsImage]
) -> ViewError:
    """Error at the frame whose pose is nearest to half-way between two keys, where the views change most.

    The view is rendered in the pose of that frame, vibration across the stroke included.
    """
    frame = _frame_between(film, offsets, views, images)
    time_s = spot_time_s(film.scene, frame)
    view = film.scene.view_at(time_s)
    rendered = render(view, seed_32(*film.names, "held out", frame))
    weights = key_weights(offsets, np.full(film.region.shape[0], view.offset_m))
    interpolated = blended(views, weights)
    return compare(rendered, interpolated, film.region, images[frame], film.scene.times.exposure_s)


def _frame_between(film: FilmPlan, offsets: Array, views: NDArray[np.float32], images: Sequence[RowsImage]) -> int:
    at = film.scene.offset_m(film.scene.times.frame_s)
    light = np.array([max(float(one.electrons_per_s.sum()), 0.0) for one in images])
    if len(offsets) == 1:
        return int(np.argmax(light))
    place = (at - offsets[0]) / (offsets[1] - offsets[0])
    # second differences of the views say where they bend; the half-way point of that interval is the worst
    bend = np.abs(np.diff(views.astype(np.float32), n=2, axis=0)).mean(axis=(1, 2, 3))
    interval = np.clip(np.floor(place).astype(int), 0, len(offsets) - 2)
    strength = 0.5 * (bend[np.clip(interval - 1, 0, len(bend) - 1)] + bend[np.clip(interval, 0, len(bend) - 1)])
    halfway = 1.0 - 2.0 * np.abs(place - np.floor(place) - 0.5)
    bright = light > 0.5 * light.max()  # a laser that is off cannot be put beside noise
    return int(np.argmax(np.where(bright, strength * np.clip(halfway, 0.0, 1.0) ** 2, -1.0)))


# Spot.


def frame_spots(film: FilmPlan, room: Room, times_s: Sequence[float]) -> list[RowsImage]:
    """Spot in every frame; frames of one pose, in which nothing moves, share their image."""
    scene, images = film.scene, []
    held: tuple[tuple[float, ...], RowsImage] | None = None
    for frame, at in enumerate(times_s):
        state = _state(film, at)
        if held is not None and held[0] == state and not _moves(film, frame):
            images.append(held[1])
            continue
        view = scene.view_at(at)
        layer = spot_layer(view, scene.spot_at(at), room_geometry(room, view))
        image = rows_image(scene, frame, layer, at)
        images.append(image)
        held = (state, image)
    return images


def _state(film: FilmPlan, at: float) -> tuple[float, ...]:
    scene = film.scene
    return (float(scene.offset_m(at)), *map(float, scene.sway_m(at)), *map(float, scene.spot_m(at)))


def _moves(film: FilmPlan, frame: int) -> bool:
    """True if anything changes while a frame is exposed."""
    scene = film.scene
    if scene.code.duration_s > 0.0 or scene.vibrations:
        return True
    times = scene.times
    half = 0.5 * (times.exposure_s + times.readout_s)
    ends = times.frame_s[frame] + half * np.linspace(-1.0, 1.0, 9)
    return bool(np.ptp(scene.offset_m(ends)) or np.ptp(scene.spot_m(ends), axis=0).any())


def frame_truths(film: FilmPlan, room: Room, times_s: Sequence[float], images: Sequence[RowsImage]) -> list[FrameTruth]:
    """Truth of every frame."""
    scene = film.scene
    frames = scene.times.frame_s
    # an encoder counts what it takes for metres: at the stop above, the stroke that it was told
    told = film.pair.nominal_stroke_m / film.pair.stroke_m
    readings = film.encoder.readings_m(told * scene.carriage.position_m(frames), *film.names)
    return [
        FrameTruth(
            frame,
            float(readings[frame]),
            film.encoder.sigma_m,
            instant_truth(scene, room, float(frames[frame])),
            instant_truth(scene, room, at),
            tuple(float(x) for x in images[frame].electrons_per_s.sum(axis=(1, 2))),
        )
        for frame, at in enumerate(times_s)
    ]


def _check_seen(film: FilmPlan, rows: Sequence[FrameTruth]) -> None:
    if not any(row.at_row.spot.visible for row in rows):
        cause = rows[0].at_row.spot.cause
        raise DatasetError(f"film {film.film_id}: the target is never seen ({cause}); move the target or the rig")
