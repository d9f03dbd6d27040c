"""Forecast of films: what will be made, bytes on the disk and seconds, from plans alone.

The constants are seconds of one process on an idle core of the machine of `build.forecast`, and bytes, of 75 films in
windows. Key views are doubled until their proof holds, which no plan knows; half of the films are taken to need it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from phibench.datasets.build.bake_task import bake_settings, is_cached
from phibench.datasets.build.forecast import START_S, duration, light_map_s, megabytes, slowdown
from phibench.datasets.film.drive_collisions import check_drives
from phibench.datasets.film.film_make import unfinished_films
from phibench.datasets.film.film_plan import FilmPlan, film_plans
from phibench.datasets.film.film_room import light_views
from phibench.datasets.plan.plan import Plan
from phibench.datasets.recipe.load import load_recipe, recipe_files
from phibench.render.film.moving_rows import spot_time_s

FILM_S = 0.5  # hashes, tables
VIEW_S = 0.15  # of a key view, and more by its size
VIEW_S_PER_MEGAPIXEL = 2.0
POSE_S = 0.010  # spot layer in a pose of its own
DOUBLED = 1.5  # views made over those to begin with: half of 75 films double theirs once until their proof holds
FRAME_S = 0.004  # rows of a frame, and their truth
_VIEW_BYTES_PX = 11.8  # three float32 planes with noise
_LIGHT_BYTES = 8_600  # image of a spot in a frame
_TRUTH_BYTES = 300  # a row of a table


@dataclass(frozen=True)
class FilmsForecast:
    """Cost of some films; seconds on an idle core, light maps apart.

    Attributes
    ----------
    films, frames, views : int
        `views` are the key views to begin with.
    size : int
        Bytes on the disk.
    bakes : tuple of float
        Seconds of each light map that no cache has.
    """

    films: int
    frames: int
    views: int
    size: int
    cpu_s: float
    bakes: tuple[float, ...]

    def text(self, workers: int, slower: float) -> str:
        """One sentence for the terminal."""
        if not self.films:
            return "to make: nothing"
        width = max(min(workers, self.films), 1)
        # films of a room wait for its light maps, each made by whoever comes first: at worst, by all of them at a time
        seconds = slower * (START_S + self.cpu_s / width + sum(self.bakes))
        baked = f"; {len(self.bakes)} light map{'s' * (len(self.bakes) != 1)}" if self.bakes else ""
        return (
            f"to make: {self.films} film{'s' * (self.films != 1)} of {self.frames} frames with {self.views} key views "
            f"or more{baked}; about {megabytes(self.size)}, {duration(seconds)} with {width} "
            f"worker{'s' * (width != 1)} (a first guess)"
        )


def films_forecast(plan: Plan, films: Sequence[FilmPlan]) -> FilmsForecast:
    """Cost of films of a plan; nothing is rendered or written."""
    views = sum(sum(film.keys) for film in films)
    frames = sum(film.scene.times.frames for film in films)
    return FilmsForecast(
        len(films), frames, views, int(sum(map(_bytes, films))), sum(map(_film_s, films)), tuple(_bakes(plan, films))
    )


def forecast_lines(recipe: str | Path, out: Path, workers: int | None = None) -> Iterator[str]:
    """Say what `make_films` would do, a line for each film and one for all; films that are there are left out.

    Raises
    ------
    DatasetError
        If recipe or folder will not do.
    """
    plan, films = film_plans(load_recipe(recipe), recipe_files(recipe))
    check_drives(plan, films)
    todo = unfinished_films(plan, films, out)
    for film in todo:
        times, (height, width) = film.scene.times, film.region.shape
        yield (
            f"{film.film_id}: {times.frames} frames, {times.duration_s:.2f} s, {width} x {height} px, "
            f"{sum(film.keys)} key views or more"
        )
    count = workers or os.cpu_count() or 1
    kept = f"; {len(films) - len(todo)} kept" if len(todo) < len(films) else ""
    yield f"{films_forecast(plan, todo).text(count, slowdown(count))}{kept}; nothing was rendered"


def _film_s(film: FilmPlan) -> float:
    """CPU seconds of a film: its views and the one that proves them, part by part, and its spots."""
    height, width = film.region.shape
    view_s = VIEW_S + VIEW_S_PER_MEGAPIXEL * height * width / 1e6
    scene = film.scene
    poses = {
        (float(scene.offset_m(at)), *np.ravel(scene.sway_m(at)), *np.ravel(scene.robot_state(at)))
        for at in (spot_time_s(scene, frame) for frame in range(scene.times.frames))
    }
    lights = 1 + len(scene.lights)
    spots_s = lights * (POSE_S * len(poses) + FRAME_S * scene.times.frames)
    return FILM_S + view_s * DOUBLED * (sum(film.keys) + len(film.keys)) + spots_s


def _bytes(film: FilmPlan) -> float:
    height, width = film.region.shape
    lights = 1 + len(film.scene.lights)
    of_frames = film.scene.times.frames * lights * (_LIGHT_BYTES + _TRUTH_BYTES)
    return DOUBLED * sum(film.keys) * _VIEW_BYTES_PX * height * width + of_frames


def _bakes(plan: Plan, films: Sequence[FilmPlan]) -> Iterator[float]:
    """Seconds of each light map that is to be baked: one for a room and a place of the robot."""
    settings, told = bake_settings(plan.recipe.ambient), set[tuple[str, str]]()
    for film in films:
        room = plan.room(film.pair.room)
        if not room.lit:
            continue  # a panorama shines by itself: nothing is baked
        for _, views in light_views(plan.rig, film):
            for view in views:
                key = film.pair.room, repr(view.robot)
                if key not in told and not is_cached(view, room, settings):
                    yield light_map_s(plan, room)
                told.add(key)
