"""Where errors of a light map come from: `measure_light_parts.py RECIPE ROOM [--windows 20]`.

Run from the repository root. A room of the recipe is baked once with its `[ambient]`. At what windows of 16 x 16 pixels
show, the light of lamps and that of surfaces are gathered anew, with 256 and 1024 rays twice from the very points. The
second reads a map of 5 cm. What a coat mirrors has no part in it. `measure_room_light.py` holds whole images against
path tracing; this script is faster, has no noise to speak of, and tells the two parts apart.

Prints, for each window, the part of the light that comes from lamps, and both errors in percent of all light there,
band R; then their rms.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from types import ModuleType

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from helpers.path_windows import RIG, VIEW, windows_of

from phibench.datasets.build.bake_task import bake_settings
from phibench.datasets.plan.draws import draw_rooms
from phibench.datasets.recipe.load import load_recipe
from phibench.render.optics.faces import FaceTable, IntArray, TexelGrid, face_table
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.truth import truth_layer
from phibench.render.room.ambient_layer import view_surfaces
from phibench.render.room.bounced_light import gathered_light
from phibench.render.room.camera_plugin import MM_PER_M
from phibench.render.room.lamp_light import direct_light
from phibench.render.room.light_map import (
    _KEPT_OF_LAMPS,
    _SEED,
    BakeSettings,
    _spread_texels,
    bake,
    fixed_shapes,
    smoothed_mean,
)
from phibench.render.room.surfaces import Surfaces, aligned
from phibench.render.room.texel_points import Texels, nearest_free
from phibench.render.setup.variant import activate
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.room import Room

FINE = BakeSettings(texel_m=0.05, indirect_texel_m=0.1, lamp_rays=32, bounces=12, bounce_rays=128, final_rays=192)
_LAMP_RAYS, _RAYS, _FEWEST = 256, 1024, 200
_LIFT_MM = 0.05


@dataclass(frozen=True)
class Shown:
    """Points that windows show: place, window, patch, and whether its front is seen."""

    world: Array
    window: IntArray
    patch: IntArray
    front: BoolArray
    names: list[str]

    def means(self, values: Array) -> Array:
        """Means over the windows, band R; NaN where less than 200 points are lit."""
        count = np.bincount(self.window, minlength=len(self.names))
        sums = np.bincount(self.window, values[:, 0], len(self.names))
        return np.where(count >= _FEWEST, sums / np.maximum(count, 1), np.nan)


def shown(room: Room, table: FaceTable, windows: int) -> Shown:
    """Points of the pixels' middles of some random windows."""
    planes = truth_layer(VIEW, room_geometry(room, VIEW), view_surfaces(VIEW, room).first_patch)
    found = list(islice(windows_of(room, np.random.default_rng(int(room.digest[:8], 16))), windows))
    parts = [np.s_[v : v + height, u : u + width] for (u, v, width, height), _ in found]
    world = np.concatenate([np.stack([planes[k][part].ravel() for k in list(planes)[:3]], axis=-1) for part in parts])
    shape = np.concatenate([planes["object_id"][part].ravel() for part in parts]).astype(int)
    patch, front = np.array([_patch(table, *one) for one in zip(world, shape, strict=True)]).T
    lit = ~(table.emits | table.is_radiance)[patch]
    window = np.repeat(np.arange(len(parts)), len(world) // len(parts))
    names = [f"{u}, {v}: {name}" for (u, v, *_), name in found]
    return Shown(world[lit], window[lit], patch[lit], front[lit].astype(bool), names)


def _patch(table: FaceTable, point: Array, shape: int) -> tuple[int, bool]:
    """Patch of a shape on which a point lies, and whether its front faces the mirror."""
    patches = np.flatnonzero(table.shape == shape)
    way = point - table.centre_m[patches]
    local = np.abs(table.local_m(patches, np.broadcast_to(point, way.shape))) - 0.5 * table.size_m[patches]
    facing = (VIEW.sphere_centre_m - point) @ table.normal[patches].T > 0.0
    away = np.abs(np.einsum("pi,pi->p", way, table.normal[patches])) + np.maximum(local, 0.0).sum(axis=1)
    best = np.argmin(away + np.where(facing | table.two_sided[patches], 0.0, 1e3))
    return int(patches[best]), bool(facing[best])


def exact(mi: ModuleType, room: Room, surfaces: Surfaces, points: Shown) -> tuple[Array, Array]:
    """Light of lamps and of surfaces at points."""
    table = surfaces.table
    normal = np.where(points.front[:, None], 1.0, -1.0) * table.normal[points.patch]
    start = MM_PER_M * (points.world - surfaces.view.sphere_centre_m) + _LIFT_MM * normal
    place, way = ([mi.Float(aligned(a[:, i])) for i in range(3)] for a in (start, normal))
    coat = mi.Float(aligned(table.coat[points.patch])) if surfaces.has_coats else None
    order = np.arange(len(start))
    texels = Texels(TexelGrid.of(table, 1.0), mi.Point3f(*place), mi.Vector3f(*way), start, normal, coat, order)
    surfaces.set_light(texels.grid, np.zeros((texels.grid.count, 3)))
    lamps = direct_light(mi, surfaces, texels, None, _LAMP_RAYS, 77)
    surfaces.set_light(TexelGrid.of(table, FINE.texel_m), bake(RIG.at(0.0), room, FINE).irradiance_w_m2)
    others = [gathered_light(mi, surfaces, texels, np.full(len(start), _RAYS), 5000 + k) for k in (0, 7)]
    return 0.5 * (lamps[0] + lamps[1]), 0.5 * (others[0] + others[1])


def looked_up(grid: TexelGrid, values: Array, points: Shown) -> Array:
    """Values of a map at points, bilinear, as a view reads them."""
    table, patch = grid.table, points.patch
    count = np.stack([grid.columns, grid.rows], axis=1)[patch]
    place = (table.local_m(patch, points.world) / table.size_m[patch] + 0.5) * count - 0.5
    low = np.clip(np.floor(place), 0, count - 2).astype(int)
    (tx, ty), across = (place - low).T[..., None], count[:, 0]
    first = np.where(points.front, grid.start[patch], grid.back[patch]) + low[:, 1] * across + low[:, 0]
    near, far = ((1.0 - tx) * values[k] + tx * values[k + 1] for k in (first, first + across))
    return np.asarray((1.0 - ty) * near + ty * far)


def lamps_alone(mi: ModuleType, surfaces: Surfaces, grid: TexelGrid, settings: BakeSettings) -> Array:
    """Light of lamps in the map, as `bake` has it."""
    texels, covered = _spread_texels(mi, surfaces, grid, settings.texel_m)
    surfaces.set_light(grid, np.zeros((grid.count, 3)))
    direct = direct_light(mi, surfaces, texels, None, settings.lamp_rays, _SEED)
    free = nearest_free(covered, grid)
    halves = (half[free] for half in direct)
    return np.maximum(smoothed_mean(grid, *halves, _KEPT_OF_LAMPS)[0], 0.0)


def main() -> None:
    """Measure one room."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recipe")
    parser.add_argument("room")
    parser.add_argument("--windows", type=int, default=20)
    given = parser.parse_args()
    recipe = load_recipe(given.recipe)
    settings, room = bake_settings(recipe.ambient), replace(draw_rooms(recipe)[given.room].build(), sun=None)
    mi, view = activate(), RIG.at(0.0)
    surfaces = Surfaces(mi, view, face_table(fixed_shapes(room, view.robot)))
    points = shown(room, surfaces.table, given.windows)
    lamps, others = (points.means(part) for part in exact(mi, room, surfaces, points))
    grid = TexelGrid.of(surfaces.table, settings.texel_m)
    own = points.means(looked_up(grid, lamps_alone(mi, surfaces, grid, settings), points))
    start = time.process_time()
    light = bake(view, room, settings).irradiance_w_m2.astype(float)
    seconds = time.process_time() - start
    whole, both = lamps + others, points.means(looked_up(grid, light, points))
    errors = 100.0 * np.stack([own - lamps, both - own - others, both - whole]) / whole
    for name, part, (direct, indirect, _) in zip(points.names, lamps / whole, errors.T, strict=True):
        print(f"{part:5.0%} by lamps {direct:+6.2f} {indirect:+6.2f} % at {name}")
    rms = np.sqrt(np.nanmean(errors**2, axis=1))
    print(
        f"rms {rms[0]:.2f} lamps, {rms[1]:.2f} surfaces, {rms[2]:.2f} both, largest {np.nanmax(abs(errors[2])):.1f} %"
    )
    print(f"{seconds:.1f} CPU-s a bake")


if __name__ == "__main__":
    main()
