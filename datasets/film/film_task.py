"""Task that makes one film: key views of the room, images of spot and other lights in each frame, truth, `done.json`.

Key views have lines in a journal of the film's own folder (`film_room`): a killed task goes on after the last of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from phibench.datasets.build.journal import NO_HEAD, Journal
from phibench.datasets.build.tasks import TaskResult
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.film.film_plan import FilmPlan
from phibench.datasets.film.film_room import key_view_name, made_key_views, renderer
from phibench.datasets.film.film_store import (
    FILM,
    LIGHT_IMAGES,
    LIGHTS,
    SPOTS,
    FilmFolder,
    FilmInfo,
    FrameTruth,
    finite_or_none,
    light_record,
    view_name,
    write_document,
    write_records,
    write_spots,
    write_table,
)
from phibench.datasets.plan.plan import Plan
from phibench.datasets.store.files import sha256
from phibench.render.film.film_truth import instant_truth
from phibench.render.film.moving_rows import RowsImage, parted_image, rows_image, spot_time_s
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.spot_layer import SpotLayer, SpotLight, spot_layer, spot_light
from phibench.render.optics.truth import depth_m
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.motion.film_scene import FilmScene
from phibench.scenes.room import Room

_UNEVEN = 5e-3  # of the flux: what it changes from frame to frame beside its own course


def make_film(out: Path, plan: Plan, key: str, film: FilmPlan) -> TaskResult:
    """Task: make one film below `out`.

    Raises
    ------
    DatasetError
        If its spot is never seen, or no number of key views is enough.
    """
    room, folder = plan.room(film.pair.room), FilmFolder.of(out, film.film_id)
    render = renderer(plan, film, room)
    folder.done.unlink(missing_ok=True)
    times = [spot_time_s(film.scene, frame) for frame in range(film.scene.times.frames)]
    images, centres = frame_spots(film, room, times)
    rows = frame_truths(film, room, times, images, centres)
    _check_seen(film, rows)
    with Journal(folder.path) as journal:
        journal.begin(NO_HEAD, list(journal.entries))
        places, error = made_key_views(film, folder, key, render, images, journal)
        at = [(part, float(place)) for part, places_ in enumerate(places) for place in places_]
        journal.begin(NO_HEAD, [key_view_name(*pose) for pose in at])  # in one order, whatever a kill left
    write_spots(folder.path / SPOTS, images)
    write_table(folder.path / FILM, rows)
    lights = _make_lights(film, room, folder)
    names = [FILM, SPOTS, *lights, *(view_name(*pose) for pose in at)]
    info = FilmInfo(
        film=film.film_id,
        key=key,
        frames=film.scene.times.frames,
        u0_px=film.region.u0_px,
        v0_px=film.region.v0_px,
        width_px=film.region.shape[1],
        height_px=film.region.shape[0],
        window_px=film.window_px,
        keys_m=tuple(map(float, np.concatenate(places))),
        key_counts=tuple(map(len, places)),
        pixel_ratio=finite_or_none(error.pixel_ratio),
        position_ratio=finite_or_none(error.position_ratio),
        sha256={name: sha256(folder.path / name) for name in names},
    )
    write_document(folder.done, info)
    return TaskResult(tuple((folder.path / name).relative_to(out).as_posix() for name in (*names, folder.done.name)))


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
        images = [coloured_image(image, colour) for image in images]
    return images, frame_truths(alone, room, times, images, centres)


def coloured_image(image: RowsImage, colour: tuple[float, ...]) -> RowsImage:
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
            continue  # the spot stands still: as the frame before
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
        return []  # a single frame has no neighbours
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
    ends = times.frame_s[frame] + half * np.linspace(-1.0, 1.0, 9)  # instants of a frame, its rows included
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
