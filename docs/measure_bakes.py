"""CPU time and stated noise of light maps: of `lab`, or of the first rooms of a recipe, one thread, one bake each.

python docs/measure_bakes.py lab
python docs/measure_bakes.py worlds --rooms 20
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from itertools import islice

import numpy as np

from phibench.datasets.build.bake_task import bake_settings
from phibench.datasets.plan.room_draws import draw_rooms
from phibench.datasets.recipe.load import load_recipe
from phibench.render.room.light_map import BakeSettings, bake
from phibench.render.setup.variant import activate
from phibench.scenes.catalog import default_rig, lab
from phibench.scenes.room import Room

COARSE = BakeSettings(texel_m=0.5, lamp_rays=16, bounces=2, bounce_rays=8, final_rays=16)


def rooms(what: str, count: int) -> Iterator[tuple[str, Room, BakeSettings]]:
    """Name, room and settings of each bake."""
    if what == "lab":
        yield from (("lab", lab(()), BakeSettings()) for _ in range(count))
        return
    recipe = load_recipe(what)
    for name, source in islice(draw_rooms(recipe).items(), count):
        yield name, source.build(), bake_settings(recipe.ambient)


def main() -> None:
    """Bake and print a line each, then the median."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", help="lab, or a recipe with generated rooms")
    parser.add_argument("--rooms", type=int, default=5)
    options = parser.parse_args()
    activate()
    import drjit as dr

    dr.set_thread_count(1)
    view, times = default_rig().at(0.0), []
    bake(view, lab(()), COARSE)  # compiles the kernels
    for name, room, settings in rooms(options.what, options.rooms):
        before = time.process_time()
        light = bake(view, room, settings)
        times.append(time.process_time() - before)
        free = ~light.covered
        level, sigma = (np.asarray(a, float)[free] for a in (light.irradiance_w_m2, light.sigma_w_m2))
        noise = np.sqrt(np.mean(sigma**2) / np.mean(level**2))
        print(f"{name}: {len(level)} texels, {times[-1]:.2f} CPU-s, stated noise {100 * noise:.2f} % rms", flush=True)
    print(f"median {np.median(times):.2f} CPU-s of {len(times)}")


if __name__ == "__main__":
    main()
