"""Indirect light on a room's texels: rays over the hemisphere and at bright texels, rays per texel, grid resampling.

Every texel sends rays over the hemisphere, cosine-weighted, and looks up what the faces send out. For the bounces the
rays are traced once, over a coarse grid: what they meet stays the same, and only the irradiance changes. Two halves of
them tell where the last gather, over the fine grid, needs its rays; it has none of theirs, so that nothing is biased.
A ray that meets a coat follows either the coat's mirrored ray or the ground, by chance, with weights that keep the
mean.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np
from scipy import ndimage

from phibench.render.optics.faces import IntArray, TexelGrid
from phibench.render.room.camera_plugin import MM_PER_M
from phibench.render.room.subpixel_grid import point_shifts, quasi_random_points
from phibench.render.room.surfaces import LookUp, Surfaces, aligned
from phibench.render.room.texel_points import (
    Net,
    Texels,
    by_count,
    chosen_points,
    covered_texels,
    nearest_free,
    powers_of_two,
    transmitted,
    vector,
)
from phibench.scenes.frames import Array, BoolArray

BOUNCE_TEXEL_M = 0.1
"""Texels of the bounces. With 0.2 m the ceiling of a furnished room is 1.1 % too dark, with 0.1 m 0.2 %."""
FEWEST = 8
"""Rays of the smallest texels."""
_AIMED = 4  # one more ray for so many, where there are bright texels to aim at
_BRIGHT_AREA, _BRIGHT_LIGHT = 0.02, 0.25  # of a room, and of what it sends out: more of it from less is called bright
_PICKS = 4096
_AROUND = 5  # texels over which noise is averaged
_SPAN = 8.0  # between the rays of a texel and the mean, at most
_DARK = 0.2  # of the median light: what is darker need not be known better
_COHERENT = 128  # rays of a texel: of fewer, those of neighbours are too far from parallel
_MIRRORED_SHARE = 0.25  # of the rays that meet a coat, at least: a lamp in it is 20 times as bright as the ground


def gathered_light(
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

    Lamps are left out; `lamps` says whether those count that a coat mirrors. `rays` of each texel are powers of two, as
    `rays_by_area` has them, or 0. More of them aim at the bright texels of the map.
    """
    import drjit as dr

    total = np.zeros((len(texels), 3))
    if rays.any():
        sent = _Rays(mi, surfaces, texels, rays, seed, bright, lamps)
        dark = dr.zeros(mi.Color3f, len(sent.texels))
        (light,) = sent.loop((dark,), lambda _, found, light: (light + surfaces.light(found),))
        total[sent.texels] = sent.irradiance(light)
    return total


def rays_by_area(grid: TexelGrid, rays: int, texel_m: float) -> IntArray:
    """Rays of each texel, shape (texels,): `rays` for squares of `texel_m` and in proportion for smaller ones.

    The nearest power of two. A window of an image shows many small texels or few large ones: its mean has as many rays
    for the same area.
    """
    most = powers_of_two(np.array(float(rays)))
    # a small texel counts little in the room's light: rays by area
    return np.clip(powers_of_two(rays * grid.areas_m2() / texel_m**2), np.minimum(FEWEST, most), most)


def bounced_light(
    mi: ModuleType, surfaces: Surfaces, fine: TexelGrid, lit: Array, texel_m: float, bounces: int, rays: int, seed: int
) -> tuple[Array, TexelGrid, Array]:
    """Bounced irradiance of the fine texels, shape (texels, 3), from passes over a coarse grid.

    Also that grid, and two halves of the last pass on it, shape (2, texels, 3): they tell where rays are needed.
    """
    coarse_m = max(BOUNCE_TEXEL_M, texel_m)
    coarse = TexelGrid.of(surfaces.table, coarse_m)
    texels = Texels.of(mi, surfaces, coarse)
    covered = covered_texels(mi, surfaces, texels, texel_m)
    free = nearest_free(covered, coarse)
    direct, bounced = np.maximum(coarser_values(fine, coarse, lit), 0.0), np.zeros((2, coarse.count, 3))
    surfaces.set_light(coarse, direct)
    bright = BrightTexels.of(mi, surfaces, coarse, direct)
    each = needed_rays(rays_by_area(coarse, rays, coarse_m), covered, free)
    kept = _Kept.of(mi, _Rays(mi, surfaces, texels, each, seed, bright, False))
    for _ in range(bounces):
        surfaces.set_light(coarse, direct + bounced.mean(axis=0))
        # the same rays in every bounce: only the light at their ends changes
        bounced[:, kept.rays.texels] = kept.light(mi, surfaces)
        bounced = bounced[:, free]
    return finer_values(coarse, fine, bounced.mean(axis=0)), coarse, bounced


def rays_by_noise(rays: IntArray, grid: TexelGrid, halves: Array) -> IntArray:
    """Rays of each texel, as many in all as `rays`, the most where two halves of others differ most: powers of two.

    Equal noise everywhere would need them as the square; the least sum of squares, in proportion to the noise.
    """
    error, level = np.empty(grid.count), np.empty(grid.count)
    # difference of two halves: four times the variance of their mean
    square, mean = ((halves[0] - halves[1]) ** 2).sum(axis=-1), halves.sum(axis=(0, -1))
    for texels in grid.alike:
        for values, out in ((square, error), (mean, level)):
            out[texels] = ndimage.uniform_filter(values[texels], size=(1, _AROUND, _AROUND), mode="nearest")
    noise = np.sqrt(np.maximum(error, 0.0)) / np.maximum(level, _DARK * np.median(level) + 1e-30)
    share = noise / max(float(np.sum(rays * noise) / max(rays.sum(), 1)), 1e-30)
    return np.where(rays > 0, powers_of_two(rays * np.clip(share, 1.0 / _SPAN, _SPAN)), 0)


def needed_rays(rays: IntArray, covered: BoolArray, free: IntArray) -> IntArray:
    """Rays without those of covered texels that take the value of a free one; few where all of a grid are covered."""
    used = np.zeros(len(rays), dtype=bool)
    used[free] = True
    return np.where(used, np.where(covered, np.minimum(rays, FEWEST), rays), 0)


class _Rays:
    """Rays of texels, as many of each as it needs: cosine-weighted ones, and those that aim.

    Those of most rays come first, and neighbours beside each other.
    """

    def __init__(
        self,
        mi: ModuleType,
        surfaces: Surfaces,
        texels: Texels,
        rays: IntArray,
        seed: int,
        bright: BrightTexels | None,
        lamps: bool,
    ) -> None:
        import drjit as dr

        self._mi, self._surfaces, self._bright, self._lamps = mi, surfaces, bright, lamps
        self.texels = by_count(texels.order, rays)
        count = rays[self.texels]
        self._lanes = mi.UInt32(aligned(self.texels, np.uint32))
        self._point, self._normal, self._coat = chosen_points(mi, texels, self._lanes)
        self._frame, self._spread = mi.Frame3f(self._normal), texels.spread
        self.counts: list[IntArray] = [count] if bright is None else [count, np.maximum(count // _AIMED, 1)]
        self._all = np.sum(self.counts, axis=0)
        # opaque: another seed then runs the same kernel
        key = dr.opaque(mi.UInt32, seed)
        self._nets = [Net.of(mi, self._lanes, each, 3, key + 2 * k) for k, each in enumerate(self.counts)]
        self._coherent = bool(count.mean() >= _COHERENT)
        self._chance = point_shifts(mi, self._lanes, 1, key + 1)
        self._share = mi.Float(0.0) if bright is None else mi.Float(aligned(self.counts[1] / self._all))
        dr.eval(self._frame, self._chance)

    def loop(self, state: tuple[Any, ...], step: Callable[..., tuple[Any, ...]]) -> tuple[Any, ...]:
        """State after a step for every ray: `step` gets the ray's place among all, its light, and the state."""
        for aims, (ends, rows) in enumerate(self.rows()):

            def body(i: Any, *state: Any, aims: int = aims, rows: Any = rows) -> tuple[Any, ...]:
                return i + 1, *step(self.place(rows, i), self._look(i, bool(aims)), *state)

            state = self.while_rays(ends, body, state)
        return state

    def while_rays(self, ends: Any, body: Callable[..., tuple[Any, ...]], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """State after the rays of all texels, which are `ends`."""
        import drjit as dr

        _, *state = dr.while_loop((dr.zeros(self._mi.UInt32, dr.width(ends)), *state), lambda i, *_: i < ends, body)
        return tuple(state)

    def rows(self) -> Iterator[tuple[Any, Any]]:
        """Numbers of rays, and where each row of rays begins that have the same number."""
        mi, first = self._mi, 0
        for count in self.counts:
            widths = np.searchsorted(-count, -np.arange(count[0]))  # texels that have more rays
            yield (
                mi.UInt32(aligned(count, np.uint32)),
                mi.UInt32(aligned(first + np.cumsum(widths) - widths, np.uint32)),
            )
            first += int(count.sum())

    def place(self, rows: Any, index: Any) -> Any:
        """Place of a ray of each texel among all: row by row."""
        import drjit as dr

        return dr.gather(self._mi.UInt32, rows, index) + dr.arange(self._mi.UInt32, len(self.texels))

    def _look(self, index: Any, aims: bool) -> LookUp:
        """Light that one ray of every texel meets, with its weight."""
        import drjit as dr

        mi, surfaces, bright = self._mi, self._surfaces, self._bright
        x = self._nets[aims].points(mi, index)
        start, aim = self._point, None
        if aims:
            assert bright is not None
            aim = bright.aim(mi, start, x)
            way = aim.way
        else:
            way = self._frame.to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(x[0], x[1])))
            if self._spread is not None:
                start = self._spread.start(mi, start, self._lanes, x[2])
        cos = dr.dot(way, self._normal)
        ray = mi.Ray3f(start, way)
        t, patch, valid = surfaces.hit(ray, cos > 0.0, coherent=self._coherent)
        if aim is not None:
            valid &= aim.faces & (patch == aim.patch)
        met = _Met(patch, ray(t), way, valid, mi.Bool(False), mi.Float(1.0), t)
        if surfaces.has_coats and not aims:  # rays that aim at a texel are for its ground alone
            met = _beyond_coats(surfaces, met, quasi_random_points(mi, self._chance, index)[0])
        weight = met.weight
        if self._coat is not None:
            weight = weight * transmitted(surfaces, self._coat, cos)
        found = surfaces.ground(met.patch, met.place, met.way, met.valid, met.mirrored & self._lamps)
        if bright is not None:
            weight = weight * bright.weight(mi, surfaces, found, self._share, met.length, cos, way, patch, met.mirrored)
        return replace(found, factor=weight * found.factor, emitted=weight * found.emitted)

    def irradiance(self, light: Any) -> Array:
        """Irradiance from sums of radiance, shape (texels, 3)."""
        import drjit as dr

        dr.eval(light)  # its bands together: each would run the loop anew
        values = np.stack([np.array(light[k], dtype=float) for k in range(3)], axis=-1)
        # rays by the cosine: irradiance is pi times the mean radiance
        return np.asarray(np.pi / self._all[:, None] * values)


@dataclass(frozen=True)
class _Kept:
    """Texel that each ray meets, and what it sends out per irradiance: what stays from bounce to bounce."""

    rays: _Rays
    texel: Any
    factor: Any

    @staticmethod
    def of(mi: ModuleType, rays: _Rays) -> _Kept:
        """Trace rays."""
        import drjit as dr

        texel = dr.zeros(mi.UInt32, int(np.sum([count.sum() for count in rays.counts])))
        factor = dr.zeros(mi.Color3f, dr.width(texel))

        def step(at: Any, found: LookUp, lanes: Any) -> tuple[Any]:
            dr.scatter(texel, dr.select(found.active, found.nearest(), 0), at)
            dr.scatter(factor, dr.select(found.active, found.factor, 0.0), at)
            return (lanes,)

        rays.loop((dr.zeros(mi.UInt32, len(rays.texels)),), step)
        dr.eval(texel, factor)
        return _Kept(rays, texel, factor)

    def light(self, mi: ModuleType, surfaces: Surfaces) -> Array:
        """Irradiance of the rays' texels by the present map, by half of the rays each, shape (2, texels, 3)."""
        import drjit as dr

        state: tuple[Any, ...] = tuple(dr.zeros(mi.Color3f, len(self.rays.texels)) for _ in (0, 1))
        for ends, rows in self.rays.rows():

            def body(i: Any, one: Any, other: Any, ends: Any = ends, rows: Any = rows) -> Any:
                at = self.rays.place(rows, i)
                light = dr.gather(mi.Color3f, self.factor, at) * surfaces.irradiance(
                    dr.gather(mi.UInt32, self.texel, at)
                )
                earlier = 2 * i < ends
                return i + 1, one + dr.select(earlier, light, 0.0), other + dr.select(earlier, 0.0, light)

            state = self.rays.while_rays(ends, body, state)
        dr.eval(state)
        return 2.0 * np.stack([self.rays.irradiance(one) for one in state])


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


def _beyond_coats(surfaces: Surfaces, met: _Met, chance: Any) -> _Met:
    """Rays that a coat mirrors, by chance, meet what is in it instead: the weights keep the mean."""
    import drjit as dr

    onward, coated, reflectance = surfaces.mirrored(met.patch, met.place, met.way, met.valid)
    share = dr.maximum(reflectance, _MIRRORED_SHARE)
    follows = coated & (chance < share)
    # Russian roulette: each branch is weighted by its true share over its chance
    weight = dr.select(follows, reflectance / share, dr.select(coated, 1.0 / (1.0 - share), 1.0))
    t, patch, found = surfaces.hit(onward, follows, coherent=False)
    patch, place = dr.select(follows, patch, met.patch), dr.select(follows, onward(t), met.place)
    way, valid = dr.select(follows, onward.d, met.way), dr.select(follows, found, met.valid)
    return _Met(patch, place, way, valid, follows, weight, met.length)


# Rays that aim at what is bright.


@dataclass(frozen=True)
class _Aim:
    """Ways to points of bright texels, their patches, and whether they are seen from there."""

    way: Any
    patch: Any
    faces: Any


@dataclass(frozen=True)
class BrightTexels:
    """Texels that send out much of a room's light from little of its area, such as a ceiling above a lamp.

    Rays by chance meet them rarely: 1 % of them bring a third of a wall's light. Some rays of every texel aim at them,
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
        # brightest by area first, so that the part that is chosen is small
        order = np.argsort(-sent / area, kind="stable")
        chosen = order[np.cumsum(area[order]) <= _BRIGHT_AREA * area.sum()]
        if not len(chosen) or sent[chosen].sum() <= _BRIGHT_LIGHT * sent.sum():
            return None
        ends = np.round(_PICKS * np.cumsum(sent[chosen]) / sent[chosen].sum()).astype(np.int64)
        times = np.diff(ends, prepend=0)
        density = np.zeros(grid.count + 4)
        # chance per mm^2 of each texel, as rounding has left it
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

    def aim(self, mi: ModuleType, start: Any, x: list[Any]) -> _Aim:
        """Ways from starts to bright texels, by three uniform deviates."""
        import drjit as dr

        one = dr.gather(mi.UInt32, self.picks, dr.minimum(mi.UInt32(x[0] * _PICKS), _PICKS - 1))
        middle, across, up, normal = (
            dr.gather(mi.Vector3f, of, one) for of in (self.middles, self.across, self.up, self.normals)
        )
        way = middle + (x[1] - 0.5) * across + (x[2] - 0.5) * up - mi.Vector3f(start)
        way /= dr.norm(way)
        return _Aim(way, dr.gather(mi.UInt32, self.patches, one), dr.dot(normal, way) < 0.0)

    def weight(
        self,
        mi: ModuleType,
        surfaces: Surfaces,
        found: LookUp,
        share: Any,
        t: Any,
        cos: Any,
        way: Any,
        patch: Any,
        mirrored: Any,
    ) -> Any:
        """Weights of rays of length t (mm) that met a texel, aimed, as `share` of them are, or not.

        What a coat mirrors is never aimed at.
        """
        import drjit as dr

        density = dr.gather(mi.Float, self.density, found.nearest(), found.active & ~mirrored)
        cos_there = dr.maximum(surfaces.cosine(patch, way), 1e-6)
        by_aim = density * dr.square(t) * dr.pi / (cos_there * dr.maximum(cos, 1e-6))  # over what chance has
        # balance heuristic of both ways to choose a direction (Veach)
        return 1.0 / (1.0 - share + share * dr.select(mirrored, 0.0, by_aim))


# Values on coarse and fine grids.


def coarser_values(fine: TexelGrid, coarse: TexelGrid, values: Array) -> Array:
    """Means over the coarse texels, shape (coarse texels, 3)."""
    return _resampled(fine, coarse, values, _overlap)


def finer_values(coarse: TexelGrid, fine: TexelGrid, values: Array) -> Array:
    """Values between the coarse texels' centres, bilinear, shape (fine texels, 3)."""
    return _resampled(coarse, fine, values, _between)


def _resampled(old: TexelGrid, new: TexelGrid, values: Array, matrix: Callable[[int, int], Array]) -> Array:
    if np.array_equal(old.columns, new.columns) and np.array_equal(old.rows, new.rows):
        return values
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
    # rows add up to 1: means over what new and old texels share
    return np.asarray(np.maximum(shared, 0.0) * new)


@lru_cache(maxsize=512)
def _between(old: int, new: int) -> Array:
    """Linear interpolation between the middles of `old` parts of a line at those of `new` ones, shape (new, old)."""
    # middles of new texels among those of old ones; beyond the outermost a constant
    place = np.clip((np.arange(new) + 0.5) / new * old - 0.5, 0.0, old - 1.0)
    low = np.minimum(place.astype(int), old - 2)
    matrix = np.zeros((new, old))
    matrix[np.arange(new), low], matrix[np.arange(new), low + 1] = low + 1 - place, place - low
    return matrix
