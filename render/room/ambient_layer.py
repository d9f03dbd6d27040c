"""Ambient layer: a view's image without the laser, from the room's light map and the light on carriage and holder.

The radiance of a surface is albedo x irradiance / pi, plus what a lamp emits. The image is cut into cells
(`subpixel_grid`). Every cell gets two independent samples, whose difference is the noise estimate; so does an even
pixel as a whole. Where that noise is above the budget of `noise_budget`, the cells around are sampled again, more
finely, until the budget is kept (`refinement`). What lamps cover of these is computed (`LampOutlines`). The light map's
own noise is the same in every view.

Layers have the shape (3, H, W), planes R, G, B, expected electrons per second and pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.render.optics.faces import TexelGrid, texel_sizes_m
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.room.bounced_light import gathered_light
from phibench.render.room.lamp_light import direct_light
from phibench.render.room.lamp_outlines import LampOutlines
from phibench.render.room.light_map import BakeSettings, LightMap, fixed_shapes
from phibench.render.room.mirror_intersection import MirrorBody, mirror_bands, mirror_body
from phibench.render.room.noise_budget import BUDGET
from phibench.render.room.refinement import render_refined
from phibench.render.room.shading import Look
from phibench.render.room.subpixel_grid import CellSampler, Crop, FilmGrid, Stack, point_shifts, quasi_random_points
from phibench.render.room.surfaces import Surfaces
from phibench.render.room.texel_points import Texels, transmitted
from phibench.render.setup.variant import activate
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.rig import View
from phibench.scenes.room import Room, Sun

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
        Of `light_map.bake` for this room.
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


# Light on carriage and holder, which move with the view: light maps leave them out.

_CARRIAGE_RAYS = 1024
_HOLDER_RAYS = 256  # its texels are many and small; 1024 rays would take 3 CPU-s for each view
_SEED = 0  # the shifts are part of the quadrature rule


def light_carriage(
    surfaces: Surfaces,
    grid: TexelGrid,
    fixed: int,
    irradiance: NDArray[np.float32],
    settings: BakeSettings,
    sun: Sun | None = None,
) -> NDArray[np.float32]:
    """Irradiance of all texels of a view: the map for the `fixed` first patches, gathered now for the others.

    With a holder, which stands close to it, the mirror takes and gives light as well (`mirror_light`).
    """
    mi = activate()
    first = grid.texels_of(fixed)
    full = np.zeros((grid.count, 3), dtype=np.float32)
    full[:first] = irradiance
    surfaces.set_light(grid, full)
    if first < grid.count:
        texels = Texels.of(mi, surfaces, grid, first)
        body = mirror_body(mi, surfaces.view)
        rays = _CARRIAGE_RAYS if body is None else _HOLDER_RAYS
        direct = direct_light(mi, surfaces, texels, sun, settings.lamp_rays, _SEED, body)
        others = gathered_light(mi, surfaces, texels, np.full(len(texels), rays), _SEED + 2)
        light = 0.5 * (direct[0] + direct[1]) + others
        if body is not None:
            light = np.maximum(light + mirror_light(mi, surfaces, texels, body, rays, _SEED + 3), 0.0)
        full[first:] = light
        surfaces.set_light(grid, full)
    return full


# Light that the mirror takes from what stands beside it, and the light that it throws there.
#
# Light maps leave the mirror out: it is small for a room. It is not small for its holder, whose rods stand a quarter of
# its radius away. Seen from a texel a ball around the mirror fills a cone. In that cone rays compare what is behind the
# mirror with what the mirror shows, and the difference is added. Lamps and the sun behind the mirror are tested ray by
# ray (`lamp_light`). A spherical mirror is perfect and smooth here: a form error moves what a black rod mirrors by less
# than it matters. A mirror of revolution is closed by a black disc in the plane of its rim, its back.


def mirror_light(mi: ModuleType, surfaces: Surfaces, texels: Texels, mirror: MirrorBody, rays: int, seed: int) -> Array:
    """Change of the irradiance by the mirror, shape (texels, 3): what it shows, less what surfaces behind it send."""
    import drjit as dr

    bands = mirror_bands(mi, surfaces.view.rig)
    point, normal, lanes = texels.points, texels.normals, dr.arange(mi.UInt32, len(texels))
    way_there = mirror.centre - mi.Vector3f(point)
    distance = dr.norm(way_there)
    rim = dr.safe_sqrt(1.0 - dr.square(dr.minimum(mirror.radius / distance, 1.0)))  # cosine of the cone's half angle
    rim = dr.select(distance > mirror.radius, rim, -1.0)
    frame = mi.Frame3f(way_there / distance)
    key, count = (dr.opaque(mi.UInt32, value) for value in (seed, rays))
    shift = point_shifts(mi, lanes, 2, key)
    dr.eval(shift, rim, frame)

    def body(i: Any, total: Any) -> tuple[Any, Any]:
        x, y = quasi_random_points(mi, shift, i)
        c = 1.0 - x * (1.0 - rim)
        sine, turn = dr.safe_sqrt(1.0 - c * c), 2.0 * dr.pi * y
        way = frame.to_world(mi.Vector3f(sine * dr.cos(turn), sine * dr.sin(turn), c))
        cos = dr.dot(way, normal)
        met, near, facet, shows = mirror.meets(point, way)
        met &= cos > 0.0
        ray = mi.Ray3f(point, way)
        t, patch, valid = surfaces.hit(ray, met, coherent=False)
        met &= ~valid | (t > near)
        behind = surfaces.radiance(patch, ray(t), way, met & valid, lamps=False)
        at = point + near * way
        cos_mirror = dr.maximum(-dr.dot(way, facet), 0.0)
        onward = mi.Ray3f(at, way + 2.0 * cos_mirror * facet)
        t, patch, valid = surfaces.hit(onward, met & shows, coherent=False)
        mirrored = surfaces.radiance(patch, onward(t), onward.d, valid, lamps=True)
        mirrored *= mi.Color3f(*(band(cos_mirror) for band in bands))
        weight = dr.select(met, cos, 0.0)
        if texels.coat is not None:
            weight *= transmitted(surfaces, texels.coat, cos)
        return i + 1, total + weight * (mirrored - behind)

    start = (mi.UInt32(0), dr.zeros(mi.Color3f, len(texels)))
    _, total = dr.while_loop(start, lambda i, _: i < count, body)
    dr.eval(total)  # its bands together: each would run the loop anew
    cone = 2.0 * np.pi * (1.0 - np.array(rim, dtype=float)) / rays
    return cone[:, None] * np.stack([np.array(total[k], dtype=float) for k in range(3)], axis=-1)
