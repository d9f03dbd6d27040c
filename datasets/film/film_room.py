"""Room in a film: light maps along the robot's way, rendered key views, test of interpolated views by rendered ones.

Key views are kept one by one, named by their place: a killed run, and one with twice as many, find those that are
there. The number of key views of a part of the poses is doubled until a view that was left out agrees with the
interpolated one (`made_key_views`).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.build.journal import Entry, Journal, is_intact
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.film.film_plan import FilmPlan
from phibench.datasets.film.film_store import FilmFolder, read_view, view_name, write_view
from phibench.datasets.plan.plan import Plan
from phibench.datasets.recipe.tables import AmbientTable
from phibench.datasets.store.files import sha256
from phibench.render.film.key_views import ALLOWED, PoseParts, ViewError, blended, compare, key_offsets_m, key_weights
from phibench.render.film.moving_rows import RowsImage, chief_uv_px, spot_time_s
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import seed_32
from phibench.scenes.rig import Rig, View
from phibench.scenes.room import Room

if TYPE_CHECKING:  # they import Mitsuba
    from phibench.render.room.light_map import BakeSettings, LightMap

_DOUBLINGS = 5  # of the views: 32 times as many do not help any more
_BAKE_M, _HALF_ROBOT_M = 0.25, 0.45  # way of the robot's ends from light map to light map
Render = Callable[[View, tuple[int, float], int], NDArray[np.float32]]
"""Room of a view on the film's region, shape (3, h, w), at a part and place of the poses, from a seed."""


def renderer(plan: Plan, film: FilmPlan, room: Room) -> Render:
    """Renderer of the room on the film's region; light maps are baked, or taken from the cache, now."""
    if not room.lit:
        return lambda view, pose, seed: np.zeros((3, *film.region.shape), np.float32)
    from phibench.datasets.build.bake_task import bake_settings
    from phibench.datasets.build.view_task import start_renderer
    from phibench.render.room.ambient_layer import render_ambient
    from phibench.render.room.light_map import interpolated_light_map
    from phibench.render.room.noise_budget import BUDGETS

    start_renderer()
    ambient: AmbientTable = plan.recipe.ambient
    settings = bake_settings(ambient)
    lights = _light_maps(plan.rig, film, room, settings)
    height, width = film.region.shape
    crop = (film.region.u0_px, film.region.v0_px, width, height)

    def render(view: View, pose: tuple[int, float], seed: int) -> NDArray[np.float32]:
        part, place = pose
        places, maps = lights[part]
        right = int(np.clip(np.searchsorted(places, place), 1, len(places) - 1)) if len(places) > 1 else 0
        light = maps[right]
        if right:
            share = (place - places[right - 1]) / (places[right] - places[right - 1])
            light = interpolated_light_map(maps[right - 1], light, float(np.clip(share, 0.0, 1.0)))
        layer = render_ambient(view, room, light, settings, ambient.cells_per_pixel, seed, crop=crop, budget=budget)
        return layer.electrons_per_s

    budget = _PART * BUDGETS[ambient.quality]
    return render


_PART = 0.5  # of the budget: noise of key views adds to the error that the proof finds, and doubles their number


def _light_maps(rig: Rig, film: FilmPlan, room: Room, settings: BakeSettings) -> list[tuple[Array, list[LightMap]]]:
    """Places of each part at which the robot's shadow is known, and the light maps there.

    Where the robot drives, its ends move by a quarter of a metre at most from one to the next: its soft shadow on the
    floor is some decimetres wide.
    """
    from phibench.datasets.build.bake_task import light_map

    return [(places, [light_map(view, room, settings) for view in views]) for places, views in light_views(rig, film)]


def light_views(rig: Rig, film: FilmPlan) -> Iterator[tuple[Array, list[View]]]:
    """Places of each part at which a light map is baked, and the views there."""
    parts = PoseParts.of(film.scene)
    for number, part in enumerate(parts.parts):
        count, drive = 1, film.scene.drive
        if part.leg is not None and drive is not None:
            leg = drive.legs[part.leg]
            way = (abs(leg.length_m) + _HALF_ROBOT_M * abs(leg.turn_rad)) * (part.high - part.low)
            count = 1 + math.ceil(way / drive.profiles[part.leg].end_m / _BAKE_M) if leg.drives else 2
        places = np.linspace(part.low, part.high, count)
        # of the view, a light map takes the robot's place and the origin of coordinates: films of a set share that
        yield places, [replace(parts.view(number, float(at)), rig=rig, offset_m=0.0, motion=None) for at in places]


def made_key_views(
    film: FilmPlan, folder: FilmFolder, key: str, render: Render, images: Sequence[RowsImage], journal: Journal
) -> tuple[list[Array], ViewError]:
    """Render key views until views that were left out agree; return their places, part by part, and the worst error.

    Raises
    ------
    DatasetError
        If five doublings do not do.
    """
    parts, counts = PoseParts.of(film.scene), list(film.keys)
    errors: dict[int, ViewError] = {}
    for _ in range(_DOUBLINGS + 1):
        places = [key_offsets_m(part.low, part.high, n) for part, n in zip(parts.parts, counts, strict=True)]
        for part, at in enumerate(places):
            if part in errors and not errors[part].largest > ALLOWED:
                continue  # proved already
            views = np.stack(
                [_key_view(film, folder, key, render, parts, (part, float(place)), journal) for place in at]
            )
            errors[part] = held_out_error(film, render, parts, part, at, views, images)
        # a part that no frame falls into has nothing to prove
        worst = max(errors.values(), key=lambda error: -1.0 if math.isnan(error.largest) else error.largest)
        if worst.largest <= ALLOWED:
            kept = {folder.view(part, float(place)) for part, at in enumerate(places) for place in at}
            for stale in set(folder.path.glob("views/*.exr")) - kept:
                stale.unlink()
            return places, worst
        counts = [2 * len(at) - 1 if errors[n].largest > ALLOWED else len(at) for n, at in enumerate(places)]
    raise DatasetError(
        f"film {film.film_id}: a view that was left out differs from the interpolated one by {worst.largest:.2f} of "
        f"the sensor's noise, {ALLOWED} is allowed, with {sum(map(len, places))} key views; weaken the vibration"
    )


def _key_view(
    film: FilmPlan,
    folder: FilmFolder,
    key: str,
    render: Render,
    parts: PoseParts,
    pose: tuple[int, float],
    journal: Journal,
) -> NDArray[np.float32]:
    """Key view from its file, or rendered and written: files of a killed run, or of fewer keys, have key and hash.

    The places of few keys are among those of twice as many, but for rounding.
    """
    path, (part, place), name = folder.view(*pose), pose, key_view_name(*pose)
    wanted = hashlib.sha256(f"{key} {path.name}".encode()).hexdigest()
    held = journal.entries.get(name)
    if held is None or held.key != wanted or not is_intact(held, folder.path):
        planes = render(parts.view(part, place), pose, seed_32(*film.names, "key", path.name))
        write_view(path, planes, film.region, {"film": film.film_id, "place": place, "part": part, "key": wanted})
        journal.add(Entry(name, wanted, {view_name(*pose): sha256(path)}))
        return planes  # as the file holds them: `write_view` has read it back
    return read_view(path, film.region)


def key_view_name(part: int, place: float) -> str:
    """Name of a key view in its film's journal."""
    return f"key {Path(view_name(part, place)).stem}"


def held_out_error(
    film: FilmPlan,
    render: Render,
    parts: PoseParts,
    part: int,
    places: Array,
    views: NDArray[np.float32],
    images: Sequence[RowsImage],
) -> ViewError:
    """Error at the frame of a part whose pose is nearest to half-way between two keys, where the views change most.

    The view is rendered in the pose of that frame, vibration across the stroke included. NaN where there is no frame.
    """
    frame = _frame_between(film, parts, part, places, views, images)
    if frame is None:
        return ViewError(math.nan, math.nan)
    scene = film.scene
    time_s = spot_time_s(scene, frame)
    view, (_, place) = scene.view_at(time_s), parts.places(np.array([time_s]))
    rendered = render(view, (part, float(place[0])), seed_32(*film.names, "held out", frame))
    interpolated = blended(views, np.tile(key_weights(places, place), (film.region.shape[0], 1)))
    uv = chief_uv_px(scene, np.array([time_s]))[0]
    return compare(rendered, interpolated, film.region, images[frame], scene.times.exposure_s, uv)


def _frame_between(
    film: FilmPlan, parts: PoseParts, part: int, places: Array, views: NDArray[np.float32], images: Sequence[RowsImage]
) -> int | None:
    number, at = parts.places(film.scene.times.frame_s)
    light = np.array([max(float(image.electrons_per_s.sum()), 0.0) for image in images])
    mine = number == part
    if not mine.any():
        return None  # no frame of this part
    light = np.where(mine, light, -1.0)
    if len(places) == 1:
        return int(np.argmax(light))
    place = (at - places[0]) / (places[1] - places[0])
    # second differences of the views say where they bend; the half-way point of that interval is the worst
    bend = np.array([np.abs((c - b) - (b - a)).mean() for a, b, c in zip(views, views[1:], views[2:], strict=False)])
    interval = np.clip(np.floor(place).astype(int), 0, len(places) - 2)
    strength = 0.5 * (bend[np.clip(interval - 1, 0, len(bend) - 1)] + bend[np.clip(interval, 0, len(bend) - 1)])
    halfway = 1.0 - 2.0 * np.abs(place - np.floor(place) - 0.5)
    # a laser that is off cannot be put beside noise; where it is never on, pixels alone are compared
    bright = mine & (light > 0.5 * light.max() if light.max() > 0.0 else True)
    return int(np.argmax(np.where(bright, strength * np.clip(halfway, 0.0, 1.0) ** 2, -1.0)))
