"""Ambient layer: the room without the laser, seen directly and through the mirror, from its light map.

The radiance of a surface is albedo x irradiance / pi, plus what a lamp emits. The image is cut into cells
(`subpixel_grid`). Every cell gets two independent samples, whose difference is the noise estimate; so does an even
pixel as a whole. Where that noise is above the budget of `noise_budget`, the cells around are sampled again, more
finely, until the budget is kept (`refinement`). What lamps cover of these is computed (`LampOutlines`). The light map's
own noise is the same in every view.

Layers have the shape (3, H, W), planes R, G, B, expected electrons per second and pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phibench.render.optics.faces import TexelGrid, texel_sizes_m
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.room.lamp_outlines import LampOutlines
from phibench.render.room.light_map import BakeSettings, LightMap, fixed_shapes, light_carriage
from phibench.render.room.noise_budget import BUDGET
from phibench.render.room.refinement import render_refined
from phibench.render.room.shading import Look
from phibench.render.room.subpixel_grid import CellSampler, Crop, FilmGrid, Stack
from phibench.render.room.surfaces import Surfaces
from phibench.render.setup.variant import activate
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.rig import View
from phibench.scenes.room import Room

ROUNDS = 8  # of refinement at most; three or four do
_OVERLAP_PX = 16  # refinement looks at neighbours
_BAND_CELLS = 1 << 22  # cells at a time


@dataclass(frozen=True)
class AmbientLayer:
    """Ambient light of one view.

    Attributes
    ----------
    electrons_per_s : array, shape (3, height, width), float32
        Expected photo-electrons per second per pixel, planes R, G, B.
    variance_per_s2 : array, shape (3, height, width), float32
        Estimated variance of that, (electrons/s)^2; neighbouring pixels share samples.
    """

    electrons_per_s: NDArray[np.float32]
    variance_per_s2: NDArray[np.float32]


def dark_layer(camera: Camera) -> AmbientLayer:
    """Ambient layer of a room without light."""
    zeros = np.zeros((3, camera.height_px, camera.width_px), dtype=np.float32)
    return AmbientLayer(zeros, zeros)


def view_surfaces(view: View, room: Room) -> Surfaces:
    """Faces of a room with robot and carriage in Mitsuba, for one view."""
    return Surfaces(activate(), view, room_geometry(room, view).table)


def render_ambient(
    view: View,
    room: Room,
    light: LightMap,
    settings: BakeSettings,
    cells_per_pixel: int,
    seed: int,
    crop: Crop | None = None,
    rounds: int = ROUNDS,
    budget: float = BUDGET,
    surfaces: Surfaces | None = None,
) -> AmbientLayer:
    """Render one view from a room's light map.

    Parameters
    ----------
    light, settings
        Of `bake.bake` for this room.
    cells_per_pixel : int
        Cells per pixel side where the image has detail; the first pass takes two samples a cell.
    seed : int
        Of the named stream for this view; 0 is legal.
    crop : (u0, v0, width, height), or None
        Image window, pixels; None is the whole image. Without refinement its pixels are those of the whole image;
        with it, those within some pixels of its border may differ by their noise.
    rounds : int
        Rounds of refinement at most; 0 leaves the first pass alone.
    budget : float
        Noise that refinement stops at, as a part of the sensor's: `noise_budget.BUDGETS`, or less.
    surfaces : Surfaces, or None
        Of `view_surfaces`, if they are there already.
    """
    activate()
    import drjit as dr

    camera = view.rig.camera
    window = crop or (0, 0, camera.width_px, camera.height_px)
    film = view_film(view, room, light, settings, cells_per_pixel, seed, surfaces or view_surfaces(view, room))
    layers = [_band(film, band, window, rounds, budget) for band in _bands(film.grid, window)]
    dr.flush_kernel_cache()  # other mirrors need other kernels; those of the next view are read from Dr.Jit's own cache
    dr.flush_malloc_cache()  # arrays that it keeps for the next time: those of a bake and of a view add up
    return AmbientLayer(*(np.concatenate([pair[i] for pair in layers], axis=1) for i in (0, 1)))


def view_film(
    view: View, room: Room, light: LightMap, settings: BakeSettings, cells_per_pixel: int, seed: int, surfaces: Surfaces
) -> CellSampler:
    """Film of one view, whose cells can be sampled; arguments as for `render_ambient`."""
    mi = activate()
    table = surfaces.table
    fixed = int(np.searchsorted(table.shape, len(fixed_shapes(room))))
    texels = TexelGrid.of(table, _texel_sizes_m(surfaces, fixed, settings.texel_m))
    light_carriage(surfaces, texels, fixed, light.irradiance_w_m2, settings, room.sun)
    look = Look(mi, surfaces)
    # a rough mirror blurs outlines by itself, a glass tube bends the rays
    known = view.rig.mirror.roughness_alpha == 0.0 and view.tube is None and bool(table.emits.any())
    lamps = LampOutlines(mi, look, surfaces) if known else None
    return CellSampler(mi, look, FilmGrid.of(view.rig.camera, cells_per_pixel), seed, lamps)


def _texel_sizes_m(surfaces: Surfaces, fixed: int, texel_m: float) -> Array:
    """Texels of each patch: those of the map; on a holder a third of the mirror's width, which changes its light."""
    sizes = texel_sizes_m(surfaces.table, texel_m)
    sizes[fixed:] = texel_m
    rig = surfaces.view.rig
    if rig.holder is not None:
        sizes[fixed:] = min(texel_m, rig.extent.wide_m / 3.0)
    return sizes


def _bands(grid: FilmGrid, window: Crop) -> list[Crop]:
    """Horizontal bands of a window that are small enough for the memory."""
    u0, v0, width, height = window
    across = (width + 2 * grid.margin_px) * grid.cells
    rows = max(16, _BAND_CELLS // (across * grid.cells) - 2 * grid.margin_px)
    return [(u0, v, width, min(rows, v0 + height - v)) for v in range(v0, v0 + height, rows)]


def _band(film: CellSampler, band: Crop, window: Crop, rounds: int, budget: float) -> tuple[Stack, Stack]:
    """Pixels of a band, refined with its neighbourhood: what is beyond it reaches the band by less than the budget."""
    u0, v0, width, height = band
    top, bottom = max(v0 - _OVERLAP_PX, window[1]), min(v0 + height + _OVERLAP_PX, window[1] + window[3])
    mean, variance = render_refined(film, (u0, top, width, bottom - top), rounds, budget)
    inner = slice(v0 - top, v0 - top + height)
    return mean[:, inner], variance[:, inner]
