"""Light of surfaces on a room's texels: what arrives by one bounce or more.

Every texel sends rays over the hemisphere, cosine-weighted, and looks up what the faces send out. For the bounces the
rays are traced once, over a coarse grid: what they meet stays the same, and only the irradiance changes.
A ray that meets a coat follows either the coat's mirrored ray or the ground, by chance, with weights that keep the
mean.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np

from phibench.render.optics.faces import IntArray
from phibench.render.room.camera_plugin import MM_PER_M
from phibench.render.room.subpixel_grid import points, shifts
from phibench.render.room.surfaces import LookUp, Surfaces, aligned
from phibench.render.room.texel_grid import TexelGrid
from phibench.render.room.texel_points import Texels, covered_texels, nearest_free, transmitted, vector
from phibench.scenes.frames import Array

BOUNCE_TEXEL_M = 0.1
"""Texels of the bounces. With 0.2 m the ceiling of a furnished room is 1.1 % too dark, with 0.1 m 0.2 %."""
_LANES = 1 << 18  # rays at a time, 40 MB
BLOCK = 8
"""Rays of a texel come in blocks, each of which adds up by itself."""
_FEWEST = 16  # rays of the smallest texels
_AIMED = 2  # rays of a block that aim at bright texels
_BRIGHT_AREA, _BRIGHT_LIGHT = 0.02, 0.25  # of a room, and of what it sends out: more of it from less is called bright
_PICKS = 4096
_MIRRORED_SHARE = 0.25  # of the rays that meet a coat, at least: a lamp in it is 20 times as bright as the ground


def gathered(
    mi: ModuleType,
    surfaces: Surfaces,
    texels: Texels,
    rays: IntArray,
    seed: int,
    bright: BrightTexels | None = None,
    *,
    lamps: bool = True,
) -> Array:
    """Irradiance from all surfaces by the present map, shape (texels, 3): pi x mean radiance.

    Lamps are left out; `lamps` says whether those count that a coat mirrors. `rays` of each texel are multiples of
    `BLOCK`, as `rays_by_area` has them. Some aim at the bright texels of the map.
    """
    found = _found(mi, surfaces, texels, rays, seed, bright, lamps)
    return _irradiance((_light(surfaces, one) for one in found), rays)


def rays_by_area(grid: TexelGrid, rays: int, texel_m: float) -> IntArray:
    """Rays of each texel, shape (texels,): `rays` for squares of `texel_m` and in proportion for smaller ones.

    Rounded up to blocks of `BLOCK`. A window of an image shows many small texels or few large ones: its mean has as
    many rays for the same area.
    """
    most = -(-rays // BLOCK)
    blocks = np.ceil(rays / BLOCK * grid.areas_m2() / texel_m**2 - 1e-9)
    return BLOCK * np.clip(blocks, min(_FEWEST // BLOCK, most), most).astype(np.int64)


def bounced_light(
    mi: ModuleType, surfaces: Surfaces, fine: TexelGrid, lit: Array, texel_m: float, bounces: int, rays: int, seed: int
) -> Array:
    """Bounced irradiance of the fine texels, shape (texels, 3), from passes over a coarse grid."""
    coarse_m = max(BOUNCE_TEXEL_M, texel_m)
    coarse = TexelGrid.of(surfaces.table, coarse_m)
    each = rays_by_area(coarse, rays, coarse_m)
    texels = Texels.of(mi, surfaces, coarse)
    free = nearest_free(covered_texels(mi, surfaces, texels, texel_m), coarse)
    direct, bounced = coarser(fine, coarse, lit), np.zeros((coarse.count, 3))
    surfaces.set_light(coarse, direct)
    found = list(_found(mi, surfaces, texels, each, seed, BrightTexels.of(mi, surfaces, coarse, direct), False))
    for _ in range(bounces):
        surfaces.set_light(coarse, direct + bounced)
        bounced = _irradiance((_light(surfaces, part) for part in found), each)[free]
    return finer(coarse, fine, bounced)


def _irradiance(blocks: Iterable[Array], rays: IntArray) -> Array:
    """Irradiance of texels from the sums of radiance over their blocks of rays, shape (texels, 3)."""
    count = rays // BLOCK
    sums = np.add.reduceat(np.concatenate(list(blocks)), np.cumsum(count) - count, axis=0)
    return np.asarray(np.pi / rays[:, None] * sums)


def _light(surfaces: Surfaces, found: LookUp) -> Array:
    """Sums of the radiance that rays met, shape (blocks of rays, 3)."""
    import drjit as dr

    value = surfaces.light(found)
    dr.eval(value)  # its bands together: each would look up all three
    return np.stack([np.array(dr.block_sum(value[k], BLOCK), dtype=float) for k in range(3)], axis=-1)


def _found(
    mi: ModuleType,
    surfaces: Surfaces,
    texels: Texels,
    rays: IntArray,
    seed: int,
    bright: BrightTexels | None,
    lamps: bool,
) -> Iterator[LookUp]:
    """Light that the rays of all texels meet, some at a time."""
    import drjit as dr

    key, count = dr.opaque(mi.UInt32, seed), rays // BLOCK
    owner = np.repeat(np.arange(len(rays)), count)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    for first in range(0, len(owner), _LANES // BLOCK):
        owners, numbers = (mi.UInt32(aligned(a[first : first + _LANES // BLOCK], np.uint32)) for a in (owner, number))
        lane = dr.arange(mi.UInt32, dr.width(owners) * BLOCK)
        block, place = lane // BLOCK, lane % BLOCK
        texel, number_of = dr.gather(mi.UInt32, owners, block), dr.gather(mi.UInt32, numbers, block)
        lane += dr.opaque(mi.UInt32, first * BLOCK)
        aims = 0 if bright is None else _AIMED
        index = number_of * (BLOCK - aims) + place - aims
        x = points(mi, shifts(mi, texel, 2 if texels.spread is None else 3, key), index)
        normal = dr.gather(mi.Vector3f, texels.normals, texel)
        way = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(x[0], x[1])))
        start, aim = dr.gather(mi.Point3f, texels.points, texel), None
        if texels.spread is not None:
            start = texels.spread.start(mi, start, texel, x[2])
        if bright is not None:
            aimed = place < aims
            aim = bright.aim(mi, start, points(mi, shifts(mi, texel, 3, key + 2), number_of * aims + place), aimed)
            way = dr.select(aimed, aim.way, way)
        cos = dr.dot(way, normal)
        ray = mi.Ray3f(start, way)
        t, patch, valid = surfaces.hit(ray, cos > 0.0, coherent=False)
        if aim is not None:
            valid &= ~aim.aimed | (aim.faces & (patch == aim.patch))
        met = _Met(patch, ray(t), way, valid, mi.Bool(False), mi.Float(1.0), t)
        if surfaces.has_coats:
            met = _beyond_coats(mi, surfaces, met, shifts(mi, lane, 1, key + 1)[0], aim)
        weight = met.weight
        if texels.coat is not None:
            weight = weight * transmitted(surfaces, dr.gather(mi.Float, texels.coat, texel), cos)
        found = surfaces.ground(met.patch, met.place, met.way, met.valid, met.mirrored & lamps)
        if bright is not None:
            weight = weight * bright.weight(mi, surfaces, found, met.length, cos, way, patch, met.mirrored)
        found = replace(found, factor=weight * found.factor, emitted=weight * found.emitted)
        dr.eval(*(getattr(found, field.name) for field in fields(found)))
        yield found


@dataclass(frozen=True)
class _Met:
    """Faces that rays meet: patch, place (mm), direction, whether there is one, whether by a coat, and a weight.

    `length` is that of the ray to what it met first, mm.
    """

    patch: Any
    place: Any
    way: Any
    valid: Any
    mirrored: Any
    weight: Any
    length: Any


def _beyond_coats(mi: ModuleType, surfaces: Surfaces, met: _Met, chance: Any, aim: _Aim | None) -> _Met:
    """Rays that a coat mirrors, by chance, meet what is in it instead: the weights keep the mean.

    Rays that aim at a texel are for its ground alone.
    """
    import drjit as dr

    onward, coated, reflectance = surfaces.mirrored(met.patch, met.place, met.way, met.valid)
    if aim is not None:
        coated &= ~aim.aimed
    share = dr.maximum(reflectance, _MIRRORED_SHARE)
    follows = coated & (chance < share)
    weight = dr.select(follows, reflectance / share, dr.select(coated, 1.0 / (1.0 - share), 1.0))
    patch, place, way, valid = mi.UInt32(met.patch), mi.Point3f(met.place), mi.Vector3f(met.way), mi.Bool(met.valid)
    dr.eval(onward, follows, weight, patch, place, way, valid, met.length)  # once: each would trace the rays anew
    chosen = dr.compress(follows)
    if dr.width(chosen):
        rays = mi.Ray3f(dr.gather(mi.Point3f, onward.o, chosen), dr.gather(mi.Vector3f, onward.d, chosen))
        t, other, found = surfaces.hit(rays, coherent=False)
        for old, new in ((patch, other), (place, rays(t)), (way, rays.d), (valid, found)):
            dr.scatter(old, new, chosen)
    return _Met(patch, place, way, valid, follows, weight, met.length)


# Rays that aim at what is bright.


@dataclass(frozen=True)
class _Aim:
    """Ways to points of bright texels: which rays take theirs, their patches, and whether they are seen from there."""

    aimed: Any
    way: Any
    patch: Any
    faces: Any


@dataclass(frozen=True)
class BrightTexels:
    """Texels that send out much of a room's light from little of its area, such as a ceiling above a lamp.

    Rays by chance meet them rarely: 1 % of them bring a third of a wall's light. Some rays of every block aim at them,
    and all rays have the weight that both ways of drawing a direction together give it (the balance heuristic: Veach
    and Guibas, SIGGRAPH 1995). Weights stay below 1 / (1 - c), c the part that aims.

    Attributes
    ----------
    picks : Dr.Jit
        Numbers of bright texels, each as often as it is aimed at.
    middles, across, up, normals, patches : Dr.Jit
        Of the bright texels, mm.
    density : Dr.Jit
        By all texels of the map, and four more: chance per mm^2 of being aimed at.
    """

    picks: Any
    middles: Any
    across: Any
    up: Any
    normals: Any
    patches: Any
    density: Any

    @staticmethod
    def of(mi: ModuleType, surfaces: Surfaces, grid: TexelGrid, irradiance: Array) -> BrightTexels | None:
        """Bright texels of a map; None where the brightest of the area send out too little."""
        table, (patch, _), area = grid.table, grid.patch(), grid.areas_m2()
        sent = np.maximum(irradiance, 0.0).sum(axis=1) * surfaces.mean_albedo()[patch] * area
        order = np.argsort(-sent / area, kind="stable")
        chosen = order[np.cumsum(area[order]) <= _BRIGHT_AREA * area.sum()]
        if not len(chosen) or sent[chosen].sum() <= _BRIGHT_LIGHT * sent.sum():
            return None
        ends = np.round(_PICKS * np.cumsum(sent[chosen]) / sent[chosen].sum()).astype(np.int64)
        times = np.diff(ends, prepend=0)
        density = np.zeros(grid.count + 4)
        density[chosen] = times / (_PICKS * MM_PER_M**2 * area[chosen])
        middles, normals = (values[chosen] for values in grid.points())
        sides = MM_PER_M * table.size_m[patch] / np.stack([grid.columns, grid.rows], axis=1)[patch]
        axes = enumerate((table.x_axis, table.y_axis))
        across, up = (sides[chosen, k, None] * axis[patch[chosen]] for k, axis in axes)
        numbers = [np.repeat(np.arange(len(chosen)), times), patch[chosen]]
        picks, patches = (mi.UInt32(aligned(one, np.uint32)) for one in numbers)
        places = MM_PER_M * (middles - surfaces.view.sphere_centre_m)
        own_places, own_across, own_up, own_normals = (vector(mi, one) for one in (places, across, up, normals))
        return BrightTexels(picks, own_places, own_across, own_up, own_normals, patches, mi.Float(aligned(density)))

    def aim(self, mi: ModuleType, start: Any, x: list[Any], aimed: Any) -> _Aim:
        """Ways from starts to bright texels, by three uniform deviates."""
        import drjit as dr

        one = dr.gather(mi.UInt32, self.picks, dr.minimum(mi.UInt32(x[0] * _PICKS), _PICKS - 1), aimed)
        middle, across, up, normal = (
            dr.gather(mi.Vector3f, of, one, aimed) for of in (self.middles, self.across, self.up, self.normals)
        )
        way = middle + (x[1] - 0.5) * across + (x[2] - 0.5) * up - mi.Vector3f(start)
        way /= dr.norm(way)
        return _Aim(aimed, way, dr.gather(mi.UInt32, self.patches, one, aimed), dr.dot(normal, way) < 0.0)

    def weight(
        self, mi: ModuleType, surfaces: Surfaces, found: LookUp, t: Any, cos: Any, way: Any, patch: Any, mirrored: Any
    ) -> Any:
        """Weights of rays of length t (mm) that met a texel, aimed or not; what a coat mirrors is never aimed at."""
        import drjit as dr

        density = dr.gather(mi.Float, self.density, found.nearest(), found.active & ~mirrored)
        share, cos_there = _AIMED / BLOCK, dr.maximum(surfaces.cosine(patch, way), 1e-6)
        by_aim = density * dr.square(t) * dr.pi / (cos_there * dr.maximum(cos, 1e-6))  # over what chance has
        return 1.0 / (1.0 - share + share * dr.select(mirrored, 0.0, by_aim))


# Values on coarse and fine grids.


def coarser(fine: TexelGrid, coarse: TexelGrid, values: Array) -> Array:
    """Means over the coarse texels, shape (coarse texels, 3)."""
    return _resampled(fine, coarse, values, _overlap)


def finer(coarse: TexelGrid, fine: TexelGrid, values: Array) -> Array:
    """Values between the coarse texels' centres, bilinear, shape (fine texels, 3)."""
    return _resampled(coarse, fine, values, _between)


def _resampled(old: TexelGrid, new: TexelGrid, values: Array, matrix: Callable[[int, int], Array]) -> Array:
    out = np.zeros((new.count, 3))
    alike: dict[tuple[int, ...], list[tuple[int, int]]] = {}
    for (part, *size), (to, *wanted) in zip(old.grids(), new.grids(), strict=True):
        alike.setdefault((*size, *wanted), []).append((part.start, to.start))
    for (rows, columns, *wanted), starts in alike.items():
        first, to = np.array(starts).T[..., None]
        images = values[first + np.arange(rows * columns)].reshape(-1, rows, columns * 3)
        down, across = matrix(rows, wanted[0]), matrix(columns, wanted[1])
        images = np.matmul(down, images).reshape(-1, wanted[0], columns, 3)  # einsum takes 20 times as long
        out[to + np.arange(wanted[0] * wanted[1])] = np.matmul(across, images).reshape(len(starts), -1, 3)
    return out


@lru_cache(maxsize=512)
def _overlap(old: int, new: int) -> Array:
    """Shares of `old` equal parts of a line in `new` ones, shape (new, old)."""
    low, start = np.arange(new)[:, None] / new, np.arange(old) / old
    shared = np.minimum(low + 1.0 / new, start + 1.0 / old) - np.maximum(low, start)
    return np.asarray(np.maximum(shared, 0.0) * new)


@lru_cache(maxsize=512)
def _between(old: int, new: int) -> Array:
    """Linear interpolation between the middles of `old` parts of a line at those of `new` ones, shape (new, old)."""
    place = np.clip((np.arange(new) + 0.5) / new * old - 0.5, 0.0, old - 1.0)
    low = np.minimum(place.astype(int), old - 2)
    matrix = np.zeros((new, old))
    matrix[np.arange(new), low], matrix[np.arange(new), low + 1] = low + 1 - place, place - low
    return matrix
