"""CPU time of light maps, of views with all that is written of them, and of a film; noise of a view over seeds.

One thread, as a worker does them.

python docs/measure_views.py bake lab
python docs/measure_views.py bake worlds --rooms 20
python docs/measure_views.py bake bench-test --only mesh000005 mesh000015
python docs/measure_views.py view paper
python docs/measure_views.py view worlds
python docs/measure_views.py noise worlds
python docs/measure_views.py film bench-drives
"""

from __future__ import annotations

import argparse
import importlib
import os
import re
import resource
import shutil
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np

from phibench.datasets.build.bake_task import bake_room, bake_settings, read_light_map
from phibench.datasets.build.view_task import render_view
from phibench.datasets.common.parallel import ONE_THREAD, keep_memory, return_memory
from phibench.datasets.film.film_plan import film_plans
from phibench.datasets.film.film_room import renderer
from phibench.datasets.film.film_task import make_film
from phibench.datasets.plan.draws import draw_rooms
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.recipe.load import load_recipe, parse_recipe, recipe_text
from phibench.datasets.rooms.room_sources import room_of
from phibench.datasets.store.layers import STORED_TRUTH_PLANES
from phibench.datasets.store.schema import ROOM_FILES, view_file
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.truth import truth_layer
from phibench.render.room.ambient_layer import ROUNDS, render_ambient, view_surfaces
from phibench.render.room.light_map import BakeSettings, bake
from phibench.render.room.noise_budget import BUDGETS, allowed_per_s2, is_full
from phibench.render.room.subpixel_grid import CellSampler
from phibench.render.setup.variant import activate
from phibench.scenes.room import Room, default_rig, lab

COARSE = BakeSettings(texel_m=0.5, lamp_rays=16, bounces=2, bounce_rays=8, final_rays=16)
SHORT = {  # lines of a recipe of drives
    'preset = "c310"': 'preset = "default"',
    r"\[film\]": '[film]\nview = "full"\nframes = 31',
    "pauses_s =": "pauses_s = [0.1]",
    "length_m =": "length_m = 0.06\nspeed_m_per_s = 0.08",
    "turn_deg =": "turn_deg = 3.0",
}
TASK = "phibench.datasets.build.view_task"
PARTS = {
    "light": ("phibench.render.room.ambient_layer", ("view_surfaces", "render_ambient")),
    "truth": ("phibench.render.optics.truth", ("truth_layer",)),
    "layers' files": (TASK, ("write_ambient", "write_truth")),
    "preview": (TASK, ("display_exposure_s", "to_srgb", "save_png")),
}


def rooms(what: str, count: int, only: list[str]) -> Iterator[tuple[str, Room, BakeSettings]]:
    """Name, room and settings of each bake; of the first rooms, or of those that are named."""
    if what == "lab":
        yield from (("lab", lab(()), BakeSettings()) for _ in range(count))
        return
    recipe = load_recipe(what)
    drawn = draw_rooms(recipe)
    for name, source in ((name, drawn[name]) for name in only) if only else islice(drawn.items(), count):
        yield name, source.build(), bake_settings(recipe.ambient)


def measure_bakes(what: str, count: int, only: list[str]) -> None:
    """Bake and print a line each, then the median."""
    view, times = default_rig().at(0.0), []
    bake(view, lab(()), COARSE)  # compiles the kernels
    for name, room, settings in rooms(what, count, only):
        return_memory()  # as a worker does
        before = time.process_time()
        light = bake(view, room, settings)
        times.append(time.process_time() - before)
        free = ~light.covered
        level, sigma = (np.asarray(a, float)[free] for a in (light.irradiance_w_m2, light.sigma_w_m2))
        noise = np.sqrt(np.mean(sigma**2) / np.mean(level**2))
        print(f"{name}: {len(level)} texels, {times[-1]:.2f} CPU-s, stated noise {100 * noise:.2f} % rms", flush=True)
    print(f"median {np.median(times):.2f} CPU-s of {len(times)}; memory {_memory_mb():.0f} MB")


def measure_views(what: str, quality: str | None, repeat: int) -> None:
    """Render the first view of a recipe several times; print the median CPU time of its parts, rays, sizes, memory."""
    recipe = load_recipe(what)
    ambient = recipe.ambient.model_copy(update={"quality": quality or recipe.ambient.quality})
    plan = make_plan(recipe)
    pose = plan.poses[0]
    rig, source = plan.rigs[pose.rig], plan.rooms[pose.room]
    with TemporaryDirectory() as folder:
        out = Path(folder)
        bake_room(out, plan.rig, pose.room, source, ambient)
        print(f"memory after the bake {_memory_mb():.0f} MB")
        runs = [_parts(lambda: render_view(out, what, rig, source, pose, ambient)) for _ in range(repeat + 1)]
        files = [out / view_file(pose.pose_id, name) for name in ("ambient", "truth", "preview")]
        print(", ".join(f"{file.name} {file.stat().st_size / 1e6:.2f} MB" for file in files))
        count, was = 0, {name: getattr(CellSampler, name) for name in ("sample_once", "sample")}

        def once(self: Any, numbers: Any, *rest: Any) -> Any:
            nonlocal count
            count += len(numbers)
            return was["sample_once"](self, numbers, *rest)

        def again(self: Any, numbers: Any, side: Any, *rest: Any) -> Any:
            nonlocal count
            count += int(np.sum(side.astype(int) ** 2))
            return was["sample"](self, numbers, side, *rest)

        with patch.object(CellSampler, "sample_once", once), patch.object(CellSampler, "sample", again):
            render_view(out, what, rig, source, pose, ambient)
    for name in (*PARTS, "all"):
        times = [run[name] for run in runs[1:]]  # the first compiles kernels
        print(f"{name}: median {np.median(times):.3f}, least {min(times):.3f} CPU-s")
    print(f"{count / 1e6:.2f} million rays; memory {_memory_mb():.0f} MB")


def measure_noise(what: str, quality: str | None, seeds: int) -> None:
    """Render the first view of a recipe with several seeds; print its scatter beside what is stated and allowed."""
    recipe = load_recipe(what)
    ambient = recipe.ambient.model_copy(update={"quality": quality or recipe.ambient.quality})
    plan = make_plan(recipe)
    pose = plan.poses[0]
    view, budget = plan.rigs[pose.rig].at(pose.offset_m), BUDGETS[ambient.quality]
    with TemporaryDirectory() as folder:
        out = Path(folder)
        bake_room(out, plan.rig, pose.room, plan.rooms[pose.room], ambient)
        room, light = room_of(plan.rooms[pose.room], out / ROOM_FILES), read_light_map(out, pose.room)
    settings, surfaces = bake_settings(ambient), view_surfaces(view, room)
    drawn = (
        render_ambient(
            view, room, light, settings, ambient.cells_per_pixel, pose.seed + k, None, ROUNDS, budget, surfaces
        )
        for k in range(seeds)
    )
    levels, variances = (
        np.array(a) for a in zip(*((v.electrons_per_s, v.variance_per_s2) for v in drawn), strict=True)
    )
    truth = truth_layer(view, room_geometry(room, view), surfaces.first_patch, STORED_TRUTH_PLANES)
    mean = levels.mean(axis=0)
    counts = np.isfinite(truth["path_m"]) & ~is_full(mean)
    scatter = levels.var(axis=0, ddof=1)
    found, stated = scatter[counts], variances.mean(axis=0)[counts]
    over = np.where(counts, scatter, 0.0) > allowed_per_s2(mean, view.rig.camera.blur_sigma_px, budget)
    step = (levels[1] - levels[0])[counts] / np.sqrt((variances[0] + variances[1])[counts])
    print(
        f"{seeds} seeds, values in the mirror: stated over true variance {stated.sum() / found.sum():.3f}; "
        f"pixels above the budget {100 * over.any(axis=0).sum() / counts.any(axis=0).sum():.3f} %; "
        f"two seeds differ by more than 5 stated sigma in {100 * np.mean(np.abs(step) > 5.0):.2f} % of the values, "
        f"in the mean by {(levels[1] - levels[0])[counts].sum() / mean[counts].sum():.1e}"
    )


def _parts(work: Any) -> Counter[str]:
    """CPU seconds of parts of some work, and of all of it."""
    spent: Counter[str] = Counter()

    def timed(part: str, function: Any) -> Any:
        def call(*args: Any, **named: Any) -> Any:
            before = time.process_time()
            result = function(*args, **named)
            spent[part] += time.process_time() - before
            return result

        return call

    with ExitStack() as stack:
        for part, (name, functions) in PARTS.items():
            module = importlib.import_module(name)
            for one in functions:
                stack.enter_context(patch.object(module, one, timed(part, getattr(module, one))))
        timed("all", work)()
    return spent


def measure_film(what: str) -> None:
    """Make the last film of a recipe of drives as whole images of a short arc; print the CPU time of a frame.

    Light maps are baked before, and are not counted.
    """
    text = recipe_text(what)
    for line, short in SHORT.items():
        text, count = re.subn(f"(?m)^{line}.*$", short, text)
        if not count:
            sys.exit(f"recipe {what} has no line `{line}`: give one of a drive, such as bench-drives")
    with TemporaryDirectory() as folder:
        plan, films = film_plans(parse_recipe(text))
        film = films[-1]
        renderer(plan, film, plan.room(film.pair.room))
        out = Path(folder) / "films"
        for _ in range(2):  # the first compiles kernels
            spent = _parts(lambda: make_film(out, plan, "key", film))
            views = len(list(out.rglob("views/*.exr")))
            shutil.rmtree(out)
    frames = film.scene.times.frames
    print(
        f"{frames} frames, {views} key views: {spent['all'] / frames:.2f} CPU-s a frame, light {spent['light']:.1f} s"
    )


def _memory_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Read the options and measure."""
    if any(os.environ.get(name) != value for name, value in ONE_THREAD.items()):
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **ONE_THREAD})
    keep_memory()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("which", choices=("bake", "view", "noise", "film"))
    parser.add_argument("what", help="a recipe; bakes also of `lab` at its own noise")
    parser.add_argument("--rooms", type=int, default=5, help="bakes")
    parser.add_argument("--only", nargs="+", default=[], metavar="ROOM", help="bakes of these rooms")
    parser.add_argument("--repeat", type=int, default=5, help="renderings of a view; seeds of its noise")
    parser.add_argument("--quality", choices=tuple(BUDGETS), help="of a view, over the recipe's")
    options = parser.parse_args()
    activate()
    if options.which == "bake":
        measure_bakes(options.what, options.rooms, options.only)
    elif options.which == "film":
        measure_film(options.what)
    elif options.which == "noise":
        measure_noise(options.what, options.quality, options.repeat)
    else:
        measure_views(options.what, options.quality, options.repeat)


if __name__ == "__main__":
    main()
