"""Light of a recipe's rooms beside path tracing: `measure_room_light.py RECIPE [--rooms 25] [--windows 4]`.

Run from the repository root. Every lit room of the recipe is baked once, as `dataset make` bakes it: with the settings
of its `[ambient]`. Windows of 16 x 16 pixels are drawn in the mirror, and nothing of ours is looked at to choose them.
A window may not show the robot, or what is nearer than 0.5 m: there the ball's own shadow counts, which light maps
leave out. Rooms of panoramas have no light map, the sun is left out of all. Rooms in which a mesh shines are left out,
because Mitsuba cannot trace them. Path tracing is Mitsuba's, 30 bounces. Its
runs are kept in `out/room_light/`, by the digest of the room: other settings are measured against the same runs.

Prints a line for every window, then rms and largest differences of those that the tracer knows to 1 %, the tracer's own
part, and the time of baking.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from helpers.path_ambient import path_runs
from helpers.path_windows import DEPTH, RIG, VIEW, windows_of

from phibench.datasets.build.bake_task import bake_settings
from phibench.datasets.plan.draws import draw_rooms
from phibench.datasets.recipe.load import load_recipe
from phibench.datasets.rooms.panorama_room import PanoramaSettings
from phibench.render.room.ambient_layer import render_ambient
from phibench.render.room.light_map import BakeSettings, bake
from phibench.scenes.room import Room
from phibench.scenes.shapes import Rectangle

KEPT = Path("out/room_light")
_SAMPLES, _RUNS, _MOST_RUNS = 128, 4, 12
_KNOWN = 0.01  # standard error beyond which a window is not counted
_ENOUGH = 0.004  # standard error of a window's mean that ends its runs, largest of the three bands


def traced(room: Room, key: str, windows: int) -> dict[str, np.ndarray]:
    """Windows of a room with the tracer's mean and its standard error, from `out/room_light` if they are there."""
    path = KEPT / f"{key}-{room.digest[:16]}-{windows}.npz"
    if not path.is_file():
        stream = np.random.default_rng(int(room.digest[:8], 16))
        crops, means, errors, shown = [], [], [], []
        for (crop, names), _ in zip(windows_of(room, stream), range(windows), strict=False):
            runs = np.zeros((0, 3))
            while len(runs) < _MOST_RUNS:
                more = path_runs(VIEW, room, _SAMPLES, DEPTH, _RUNS, crop, first_seed=len(runs))
                runs = np.concatenate([runs, more.mean(axis=(2, 3), dtype=float)])
                mean, error = runs.mean(axis=0), runs.std(axis=0, ddof=1) / np.sqrt(len(runs))
                if np.all(error < _ENOUGH * mean):
                    break
            crops.append(crop), means.append(mean), errors.append(error), shown.append(names)
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, crops=crops, means=means, errors=errors, shown=shown)
    with np.load(path) as kept:
        return dict(kept)


def traceable(room: Room) -> bool:
    """Whether Mitsuba can trace a room: of what shines by a picture, only rectangles."""
    shapes = (*room.surfaces, *room.furniture)
    return all(isinstance(one, Rectangle) or not getattr(one.texture, "is_radiance", False) for one in shapes)


def compared(room: Room, settings: BakeSettings, kept: dict[str, np.ndarray]) -> tuple[np.ndarray, float]:
    """Relative differences of the windows' means, shape (windows, 3), and CPU-seconds of the bake."""
    start = time.process_time()
    light = bake(RIG.at(0.0), room, settings)
    seconds = time.process_time() - start
    ours = [
        render_ambient(VIEW, room, light, settings, 4, 0, tuple(map(int, crop))).electrons_per_s.mean(
            axis=(1, 2), dtype=float
        )
        for crop in kept["crops"]
    ]
    return np.array(ours) / kept["means"] - 1.0, seconds


def main() -> None:
    """Measure the rooms of a recipe."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recipe")
    parser.add_argument("--rooms", type=int, default=25)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--windows", type=int, default=4)
    for name, kind in (("texel-m", float), ("indirect-texel-m", float), ("lamp-rays", int), ("final-rays", int)):
        parser.add_argument(f"--{name}", type=kind, help="instead of the recipe's")
    given = parser.parse_args()
    recipe = load_recipe(given.recipe)
    settings = bake_settings(recipe.ambient)
    changed = {name: getattr(given, name) for name in settings.__dataclass_fields__ if getattr(given, name, None)}
    settings = replace(settings, **changed)
    print(settings)
    sources = draw_rooms(recipe).items()
    baked = [(key, one) for key, one in sources if not isinstance(getattr(one, "settings", None), PanoramaSettings)]
    built = ((key, replace(one.build(), sun=None)) for key, one in baked)
    rooms = islice(((key, room) for key, room in built if traceable(room)), given.first, given.first + given.rooms)
    differences, errors, seconds = [], [], []
    for key, room in rooms:
        kept = traced(room, f"{recipe.dataset.name}-{key}", given.windows)
        difference, spent = compared(room, settings, kept)
        error = kept["errors"] / kept["means"]
        for row, own, crop, names in zip(difference, error, kept["crops"], kept["shown"], strict=True):
            percents = " ".join(f"{100.0 * x:+6.2f}" for x in row)
            print(f"{key} {percents} % +- {100.0 * own.max():.2f} at {crop[0]}, {crop[1]}: {names}", flush=True)
        print(f"{key} bake {spent:.1f} CPU-s", flush=True)
        differences.append(difference), errors.append(error), seconds.append(spent)
    all_of, own = np.concatenate(differences), np.concatenate(errors)
    known = own.max(axis=1) < _KNOWN
    all_of, own = all_of[known], own[known]
    rms, noise = (100.0 * np.sqrt(np.mean(x**2, axis=0)) for x in (all_of, own))
    size = np.sort(np.abs(all_of).max(axis=1))[::-1]
    worst, beyond = size[:5], np.mean(size > 0.05)
    print(f"{len(known)} windows of {len(seconds)} rooms, {sum(seconds) / len(seconds):.1f} CPU-s a bake")
    print(
        f"{known.sum()} known to {100.0 * _KNOWN:g} %: median {100.0 * np.median(size):.2f} %, {beyond:.1%} beyond 5 %"
    )
    print("rms R, G, B: " + ", ".join(f"{x:.2f}" for x in rms) + " %; the tracer's part " + f"{noise.max():.2f} %")
    print("largest: " + ", ".join(f"{100.0 * x:.1f}" for x in worst) + " %")


if __name__ == "__main__":
    main()
