"""Light of surfaces on a room's texels: what arrives by one bounce or more.

Every texel sends rays over the hemisphere, cosine-weighted, and looks up what the faces send out. For the bounces the
rays are traced once, over a coarse grid: what they meet stays the same, and only the irradiance changes.
A ray that meets a coat follows either the coat's mirrored ray or the ground, by chance, with weights that keep the
mean.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np

from phibench.render.room.subpixel_grid import points, shifts
from phibench.render.room.surfaces import LookUp, Surfaces
from phibench.render.room.texel_grid import TexelGrid
from phibench.render.room.texel_points import Texels, covered_texels, nearest_free, transmitted
from phibench.scenes.frames import Array

BOUNCE_TEXEL_M = 0.1
"""Texels of the bounces. With 0.2 m the ceiling of a furnished room is 1.1 % too dark, with 0.1 m 0.2 %."""
_LANES = 1 << 18  # rays at a time, 40 MB
_MIRRORED_SHARE = 0.25  # of the rays that meet a coat, at least: a lamp in it is 20 times as bright as the ground


def gathered(mi: ModuleType, surfaces: Surfaces, texels: Texels, rays: int, seed: int) -> Array:
    """Irradiance from all surfaces by the present map, lamps left out, shape (texels, 3): pi x mean radiance."""
    return np.concatenate([_light(surfaces, found) for found in _found(mi, surfaces, texels, rays, seed)])


def bounced_light(
    mi: ModuleType, surfaces: Surfaces, fine: TexelGrid, lit: Array, texel_m: float, bounces: int, rays: int, seed: int
) -> Array:
    """Bounced irradiance of the fine texels, shape (texels, 3), from passes over a coarse grid."""
    coarse = TexelGrid.of(surfaces.table, max(BOUNCE_TEXEL_M, texel_m))
    texels = Texels.of(mi, surfaces, coarse)
    free = nearest_free(covered_texels(mi, surfaces, texels, texel_m), coarse)
    direct, bounced = coarser(fine, coarse, lit), np.zeros((coarse.count, 3))
    surfaces.set_light(coarse, direct)
    found = list(_found(mi, surfaces, texels, rays, seed))
    for _ in range(bounces):
        surfaces.set_light(coarse, direct + bounced)
        bounced = np.concatenate([_light(surfaces, part) for part in found])[free]
    return finer(coarse, fine, bounced)


@dataclass(frozen=True)
class _Found:
    """Light that the rays of some texels meet: `rays` entries for each."""

    look_up: LookUp
    rays: int


def _light(surfaces: Surfaces, found: _Found) -> Array:
    """Irradiance by what rays met, shape (texels, 3)."""
    import drjit as dr

    value = surfaces.light(found.look_up)
    dr.eval(value)  # its bands together: each would look up all three
    sums = [dr.block_sum(value[k], found.rays) for k in range(3)]
    return np.pi / found.rays * np.stack([np.array(channel, dtype=float) for channel in sums], axis=-1)


def _found(mi: ModuleType, surfaces: Surfaces, texels: Texels, rays: int, seed: int) -> Iterator[_Found]:
    """Light that the rays of all texels meet, some texels at a time."""
    import drjit as dr

    each = max(1, _LANES // rays)
    key, count = dr.opaque(mi.UInt32, seed), dr.opaque(mi.UInt32, rays)
    for first in range(0, len(texels), each):
        some = rays * min(each, len(texels) - first)
        lane = dr.arange(mi.UInt32, some) + dr.opaque(mi.UInt32, first * rays)
        texel = lane // count
        x = points(mi, shifts(mi, texel, 2 if texels.spread is None else 3, key), lane % count)
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(x[0], x[1]))
        way = mi.Frame3f(dr.gather(mi.Vector3f, texels.normals, texel)).to_world(local)
        start = dr.gather(mi.Point3f, texels.points, texel)
        ray = mi.Ray3f(start if texels.spread is None else texels.spread.start(mi, start, texel, x[2]), way)
        t, patch, valid = surfaces.hit(ray, coherent=False)
        met = _Met(patch, ray(t), way, valid, mi.Bool(False), mi.Float(1.0))
        if surfaces.has_coats:
            met = _beyond_coats(mi, surfaces, met, shifts(mi, lane, 1, key + 1)[0])
        weight = met.weight
        if texels.coat is not None:
            weight = weight * transmitted(surfaces, dr.gather(mi.Float, texels.coat, texel), local.z)
        found = surfaces.ground(met.patch, met.place, met.way, met.valid, met.lamps)
        found = replace(found, factor=weight * found.factor, emitted=weight * found.emitted)
        dr.eval(*(getattr(found, field.name) for field in fields(found)))
        yield _Found(found, rays)


@dataclass(frozen=True)
class _Met:
    """Faces that rays meet: patch, place (mm), direction, whether there is one, whether lamps count, and a weight."""

    patch: Any
    place: Any
    way: Any
    valid: Any
    lamps: Any
    weight: Any


def _beyond_coats(mi: ModuleType, surfaces: Surfaces, met: _Met, chance: Any) -> _Met:
    """Rays that a coat mirrors, by chance, meet what is in it instead: the weights keep the mean."""
    import drjit as dr

    onward, coated, reflectance = surfaces.mirrored(met.patch, met.place, met.way, met.valid)
    share = dr.maximum(reflectance, _MIRRORED_SHARE)
    follows = coated & (chance < share)
    weight = dr.select(follows, reflectance / share, dr.select(coated, 1.0 / (1.0 - share), 1.0))
    patch, place, way, valid = mi.UInt32(met.patch), mi.Point3f(met.place), mi.Vector3f(met.way), mi.Bool(met.valid)
    dr.eval(onward, follows, weight, patch, place, way, valid)
    chosen = dr.compress(follows)
    if dr.width(chosen):
        rays = mi.Ray3f(dr.gather(mi.Point3f, onward.o, chosen), dr.gather(mi.Vector3f, onward.d, chosen))
        t, other, found = surfaces.hit(rays, coherent=False)
        for old, new in ((patch, other), (place, rays(t)), (way, rays.d), (valid, found)):
            dr.scatter(old, new, chosen)
    return _Met(patch, place, way, valid, follows, weight)


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
