"""Windows of views in rooms of all kinds: mean by light map, mean by path tracing, and the noise of both."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any
from unittest.mock import patch

import numpy as np
from helpers.path_ambient import path_runs

from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.truth import truth_layer
from phibench.render.room import light_map
from phibench.render.room.ambient_layer import Crop, render_ambient, view_surfaces
from phibench.render.room.light_map import BakeSettings, LightMap, bake
from phibench.scenes.frames import Array
from phibench.scenes.room import Room, default_rig

RIG = default_rig()
VIEW = RIG.at(0.3)
SIDE_PX = 16
DEPTH = 30
RUNS = 8
NEAREST_M = 0.5  # of what a window shows: a thing at the mirror fills it with the ball's own shadow
_CANDIDATES = 4  # windows of which the first is taken that the tracer can measure
_PILOT = 16  # samples a pixel of each
ENOUGH = 0.003
"""Standard error of the tracer's mean that is asked of a window: three of them leave 0.1 % between 1 % and 2 %."""
_MOST_BAKES = 6  # of a room: the light map's mean gets as many as `ENOUGH` needs


@dataclass(frozen=True)
class Window:
    """A window of the image; relative numbers for the bands R, G, B.

    Attributes
    ----------
    crop : (u0, v0, width, height), pixels
    shown : str
        Names of the shapes in it, and their pixels.
    difference : array
        Mean of our view over that of path tracing, less 1.
    path_error : array
        Standard error of path tracing's mean, from its runs.
    map_error : float
        Standard error of our mean, from independent bakes, over the bands.
    bakes : int
    """

    crop: Crop
    shown: str
    difference: Array
    path_error: Array
    map_error: float
    bakes: int

    def __str__(self) -> str:
        percents = " ".join(f"{100.0 * x:+.2f}" for x in self.difference)
        errors = f"path {100.0 * self.path_error.max():.2f}, map {100.0 * self.map_error:.2f} ({self.bakes} bakes)"
        return f"{percents} % +- {errors} % at {self.crop[:2]}: {self.shown}"


def drawn_window(room: Room, stream: int, samples: int) -> tuple[Crop, str]:
    """One window in the mirror that shows nothing but the room, and what it shows.

    The first of a few random ones of which the tracer's mean will have the error `ENOUGH`, or else the best one.
    Nothing of ours is looked at.
    """
    best = (np.inf, ((0, 0, 0, 0), ""))
    for window in islice(windows_of(room, np.random.default_rng(stream)), _CANDIDATES):
        a, b = path_runs(VIEW, room, _PILOT, DEPTH, 2, window[0]).astype(float)
        noise = np.sqrt(np.sum((a - b) ** 2, axis=(1, 2))) / np.sum(a + b, axis=(1, 2))
        error = float(noise.max()) * np.sqrt(2.0 * _PILOT / (RUNS * samples))
        best = min(best, (error, window))
        if error < ENOUGH:
            break
    return best[1]


def windows_of(room: Room, rng: np.random.Generator) -> Iterator[tuple[Crop, str]]:
    """Random windows in the mirror that show nothing but the room, no nearer than `NEAREST_M`, and what they show."""
    geometry = room_geometry(room, VIEW)
    planes = truth_layer(VIEW, geometry, view_surfaces(VIEW, room).first_patch)
    ids, depth_m = planes["object_id"], planes["depth_m"]
    names = [shape.name for shape in geometry.shapes]
    own = len(room.surfaces) + len(room.furniture)
    for _ in range(1000):
        u, v = int(rng.integers(330, 950 - SIDE_PX)), int(rng.integers(40, 680 - SIDE_PX))
        part = np.s_[v : v + SIDE_PX, u : u + SIDE_PX]
        if np.all((ids[part] >= 0) & (ids[part] < own)) and depth_m[part].min() >= NEAREST_M:
            found, counts = np.unique(ids[part].astype(int), return_counts=True)
            order = np.argsort(-counts)[:3]
            yield (u, v, SIDE_PX, SIDE_PX), ", ".join(f"{names[found[k]]} {counts[k]}" for k in order)


def measured(room: Room, settings: BakeSettings, stream: int, samples: int) -> Window:
    """A drawn window of a room without sun, baked with these settings; `samples` a pixel in each run of the tracer."""
    room = replace(room, sun=None)  # the tracer's lamps are rectangles
    crop, shown = drawn_window(room, stream, samples)
    traced = path_runs(VIEW, room, samples, DEPTH, RUNS, crop).mean(axis=(2, 3), dtype=float)
    mean, error = traced.mean(axis=0), traced.std(axis=0, ddof=1) / np.sqrt(RUNS)
    ours = _bakes_mean(room, settings, crop)
    scatter = ours.std(axis=0, ddof=1) / mean / np.sqrt(len(ours))
    map_error = float(np.sqrt(np.mean(scatter**2)))
    return Window(crop, shown, ours.mean(axis=0) / mean - 1.0, error / mean, map_error, len(ours))


def _bakes_mean(room: Room, settings: BakeSettings, crop: Crop) -> Array:
    """Means of the window by independent bakes, shape (bakes, 3): two at least, until their mean is known to `ENOUGH`.

    Two may agree by chance, so that a room in some five is noisier than its stated error.
    """
    means: list[Array] = []
    for number in range(_MOST_BAKES):
        means.append(_mean(room, independent_bake(room, settings, number), settings, crop))
        found = np.array(means)
        if number and np.all(found.std(axis=0, ddof=1) < ENOUGH * np.sqrt(len(found)) * found.mean(axis=0)):
            break
    return np.array(means)


def independent_bake(room: Room, settings: BakeSettings, number: int) -> LightMap:
    """Light map of a room; two of different numbers share no random number.

    The stated standard errors do not serve here: smoothing correlates them, and bounces are not in them.
    """
    gathered_light = light_map.gathered_light

    def others(mi: Any, surfaces: Any, texels: Any, rays: Any, seed: int, *rest: Any, **named: Any) -> Any:
        return gathered_light(mi, surfaces, texels, rays, seed + 1000 * number, *rest, **named)

    with patch.object(light_map, "gathered_light", others), patch.object(light_map, "_SEED", 1000 * number):
        return bake(RIG.at(0.0), room, settings)


def _mean(room: Room, light: LightMap, settings: BakeSettings, crop: Crop) -> Array:
    layer = render_ambient(VIEW, room, light, settings, 4, 0, crop)
    return np.asarray(layer.electrons_per_s.mean(axis=(1, 2), dtype=float))
