"""Texels of a room as Dr.Jit arrays: their points, starts and Sobol nets of their rays, and which are covered.

Sixteen neighbours share a Sobol net of n points, shifted within its n cells for each of them. So rays of neighbours
with the same number are nearly parallel, which Embree traces twice as fast. Together they fill the cells: what is
smoothed over neighbours has less noise. A group has random bits, which its points are crossed with (a digital shift):
each point by itself is uniform.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.render.optics.faces import IntArray, TexelGrid
from phibench.render.room.camera_plugin import MM_PER_M
from phibench.render.room.subpixel_grid import hashed_bits
from phibench.render.room.surfaces import Surfaces, aligned
from phibench.scenes.frames import Array, BoolArray

_LIFT_MM = 0.05  # rays start this far in front of their surface


_SIDE = 4  # places along a texel's side
_PLACES = _SIDE * _SIDE
# numbers of places along a curve that fills the texel: neighbours on it are neighbours there
_CURVE = np.array([0, 1, 5, 4, 8, 12, 13, 9, 10, 14, 15, 11, 7, 6, 2, 3])
_CLEAR = 0.25  # texels: what is nearer stands against the place
GROUP = 16
"""Texels that share a net."""
_STRIP, _BITS = 4, 24


@dataclass(frozen=True)
class Spread:
    """Places all over texels from which rays start, so that what they gather is a mean over what is free of a texel.

    Attributes
    ----------
    across, up : Dr.Jit
        Sides of the texels, mm.
    places, free : Dr.Jit
        Numbers of the places of each texel, 16 for each, those that are free first; and how many these are.
    hidden : bool array, shape (texels,)
        Where no place is free.
    """

    across: Any
    up: Any
    places: Any
    free: Any
    hidden: BoolArray

    def free_share(self) -> Array:
        """Part of each texel that is free, shape (texels,)."""
        return np.array(self.free, dtype=float) / _PLACES

    def start(self, mi: ModuleType, middle: Any, texel: Any, x: Any) -> Any:
        """Starts of rays of texels with these middles, by uniform deviates; the middles where no place is free."""
        import drjit as dr

        free = dr.gather(mi.Float, self.free, texel)
        number = mi.UInt32(dr.minimum(x * free, dr.maximum(free - 1.0, 0.0)))
        place = dr.gather(mi.UInt32, self.places, texel * _PLACES + number)
        across, up = (dr.gather(mi.Vector3f, side, texel) for side in (self.across, self.up))
        return middle + dr.select(free > 0.0, _offset(mi, place, across, up), 0.0)


def _offset(mi: ModuleType, place: Any, across: Any, up: Any) -> Any:
    """Ways from the middle of texels to places on them."""
    a, b = ((mi.Float(k) + 0.5) / _SIDE - 0.5 for k in (place % _SIDE, place // _SIDE))
    return a * across + b * up


@dataclass(frozen=True)
class Texels:
    """Points just in front of texels, and normals: Dr.Jit arrays and NumPy's (mm); places on them, or middles alone.

    `order` has them so that neighbours follow each other.
    """

    grid: TexelGrid
    points: Any
    normals: Any
    points_mm: Array
    normals_world: Array
    coat: Any
    order: IntArray
    spread: Spread | None = None

    @staticmethod
    def of(mi: ModuleType, surfaces: Surfaces, grid: TexelGrid, first: int = 0) -> Texels:
        """Texels of a grid from a number on."""
        places, normals = (values[first:] for values in grid.points())
        starts = MM_PER_M * (places - surfaces.view.sphere_centre_m) + _LIFT_MM * normals
        columns = [[mi.Float(aligned(a[:, i])) for i in range(3)] for a in (starts, normals)]
        coat = mi.Float(aligned(grid.table.coat[grid.patch()[0][first:]])) if surfaces.has_coats else None
        order = _neighbours(grid)
        order = order[order >= first] - first
        return Texels(grid, mi.Point3f(*columns[0]), mi.Vector3f(*columns[1]), starts, normals, coat, order)

    def __len__(self) -> int:
        return len(self.points_mm)


def _neighbours(grid: TexelGrid) -> IntArray:
    """All texels in strips of four rows, column by column: sixteen that follow each other are nearly a square."""
    squares = [
        texels[:, first : first + _STRIP].transpose(0, 2, 1).reshape(len(texels), -1)
        for texels in grid.alike
        for first in range(0, texels.shape[1], _STRIP)
    ]
    return np.concatenate([np.zeros(0, dtype=np.int64), *(one.ravel() for one in squares)])


@dataclass(frozen=True)
class Net:
    """Points of the rays of lanes; those of a group of sixteen make one net.

    Two dimensions are Sobol's, the third is the point's number over their count (Hammersley's): what is picked by it,
    such as a place on a texel, has a net of its own in the two others.

    Attributes
    ----------
    tables : Dr.Jit
        By dimension, two: 24 bits of every point of a net.
    keys : Dr.Jit
        By dimension: bits that each lane's points are crossed with.
    step : Dr.Jit
        Bits from the number of a point to the third dimension.
    """

    tables: list[Any]
    keys: list[Any]
    step: Any

    @staticmethod
    def of(mi: ModuleType, lanes: Any, counts: IntArray, dimensions: int, seed: Any) -> Net:
        """Net of lanes, by numbers of their own, in the order of neighbours; rays of each, powers of two.

        The net has a point in each of its cells. Within a cell the sixteen lanes' points are a small net.
        """
        import drjit as dr

        bits = mi.UInt32(aligned(np.log2(counts), np.uint32))
        place, sides = dr.arange(mi.UInt32, len(counts)), ((bits + 1) // 2, bits // 2, mi.UInt32(0))
        words = hashed_bits(mi, dr.gather(mi.UInt32, lanes, place // GROUP * GROUP), dimensions, seed)
        net, sixteen = ([mi.UInt32(aligned(one, np.uint32)) for one in _sobol(n)] for n in (int(counts.max()), GROUP))
        own = [*(dr.gather(mi.UInt32, one, place % GROUP) for one in sixteen), place % GROUP << (_BITS - 4)]
        keys = [(word >> 8) ^ (one >> side) for word, one, side in zip(words, own, sides, strict=False)]
        step = _BITS - bits
        dr.eval(keys, step)
        return Net(net, keys, step)

    def points(self, mi: ModuleType, index: Any) -> list[Any]:
        """Coordinates of the point of this number of every lane."""
        import drjit as dr

        words = (*(dr.gather(mi.UInt32, table, index) for table in self.tables), index << self.step)
        return [mi.Float(word ^ key) * 0.5**_BITS for word, key in zip(words, self.keys, strict=False)]


def by_count(order: IntArray, counts: IntArray) -> IntArray:
    """Order of those that have any rays, the most first, so that kernels run through alike."""
    some = order[counts[order] > 0]
    return some[np.argsort(-counts[some], kind="stable")]


def powers_of_two(counts: Array | IntArray) -> IntArray:
    """Nearest powers of two, 1 at least."""
    return np.left_shift(1, np.rint(np.log2(np.maximum(counts, 1.0))).astype(np.int64))


@lru_cache(maxsize=16)
def _sobol(count: int) -> NDArray[np.int64]:
    """24 bits of the first points of Sobol's sequence in two dimensions, shape (2, count)."""
    assert count & (count - 1) == 0, "nets have powers of two"
    number, found, odd = np.arange(count), np.zeros((2, count), dtype=np.int64), 1
    for k in range(count.bit_length() - 1):
        for dimension, direction in enumerate((1, odd)):
            found[dimension] ^= (number >> k & 1) * (direction << (_BITS - 1 - k))
        odd ^= odd << 1
    return found


def covered_texels(mi: ModuleType, surfaces: Surfaces, texels: Texels, texel_m: float) -> BoolArray:
    """Texels that nobody sees whole: inside a solid (the way out meets a back face), against one, or in the void."""
    import drjit as dr

    t, patch, valid = surfaces.hit(mi.Ray3f(texels.points, texels.normals))
    dr.eval(t, patch, valid)  # together: each would trace the rays anew
    patch, valid, near = np.array(patch), np.array(valid), np.array(t) < 0.5 * MM_PER_M * texel_m
    normal, two_sided = surfaces.table.normal[patch], surfaces.table.two_sided[patch]
    outward = np.einsum("ni,ni->n", normal, texels.normals_world) > 0.0
    # what is nearer than half a texel stands against this one
    return np.asarray(~valid | (outward & ~two_sided) | near)


def spread_texels(mi: ModuleType, surfaces: Surfaces, texels: Texels) -> Texels:
    """Texels whose rays start all over them, but not below what stands there, nor beyond the patch's outline."""
    import drjit as dr

    grid, table, (patch, _) = texels.grid, surfaces.table, texels.grid.patch()
    sides = MM_PER_M * table.size_m[patch] / np.stack([grid.columns, grid.rows], axis=1)[patch]
    across, up = (vector(mi, sides[:, [k]] * axis[patch]) for k, axis in enumerate((table.x_axis, table.y_axis)))
    lane = dr.arange(mi.UInt32, len(texels) * _PLACES)
    texel = lane // _PLACES
    way, over, aside = (dr.gather(mi.Vector3f, one, texel) for one in (texels.normals, across, up))
    start = dr.gather(mi.Point3f, texels.points, texel) + _offset(mi, lane % _PLACES, over, aside)
    down = mi.Ray3f(start, -way)
    down.maxt = 3.0 * _LIFT_MM
    _, below, on_face = surfaces.hit(down)
    own = dr.gather(mi.UInt32, mi.UInt32(aligned(patch, np.uint32)), texel)
    t, above, met = surfaces.hit(mi.Ray3f(start, way))
    # the back of a face that has one side alone is seen from inside a solid
    outward = dr.dot(dr.gather(mi.Vector3f, vector(mi, table.normal), above, met), way) > 0.0
    inside = outward & (dr.gather(mi.Float, mi.Float(aligned(table.two_sided)), above, met) == 0.0)
    clear = t > dr.gather(mi.Float, mi.Float(aligned(_CLEAR * sides.min(axis=1))), texel)
    found = on_face & (below == own) & met & ~inside & clear
    dr.eval(found)
    free = np.array(found, dtype=bool).reshape(-1, _PLACES)[:, _CURVE]
    count, order = free.sum(axis=1), _CURVE[np.argsort(~free, axis=1, kind="stable")]
    places = mi.UInt32(aligned(order, np.uint32))
    return replace(texels, spread=Spread(across, up, places, mi.Float(aligned(count)), count == 0))


def vector(mi: ModuleType, values: Array) -> Any:
    """Vectors of an array, shape (N, 3)."""
    return mi.Vector3f(*(mi.Float(aligned(values[:, i])) for i in range(3)))


def nearest_free(covered: BoolArray, grid: TexelGrid) -> IntArray:
    """For every texel the nearest uncovered one of its grid, shape (texels,): none leaks that takes its value.

    Itself, where it is free or where all of its grid are covered.
    """
    nearest = np.arange(grid.count)
    for texels in grid.alike:
        hidden = covered[texels]
        partly = hidden.any(axis=(1, 2)) & ~hidden.all(axis=(1, 2))
        for own, mask in zip(texels[partly], hidden[partly], strict=True):
            row, column = ndimage.distance_transform_edt(mask, return_distances=False, return_indices=True)
            nearest[own] = own[row, column]
    return nearest


def chosen_points(mi: ModuleType, texels: Texels, lanes: Any) -> tuple[Any, Any, Any]:
    """Points, normals and coats of some texels; evaluated."""
    import drjit as dr

    point, normal = dr.gather(mi.Point3f, texels.points, lanes), dr.gather(mi.Vector3f, texels.normals, lanes)
    coat = None if texels.coat is None else dr.gather(mi.Float, texels.coat, lanes)
    dr.eval(point, normal, coat)
    return point, normal, coat


def transmitted(surfaces: Surfaces, coat: Any, cos: Any) -> Any:
    """Part of the light that a coat lets in; 1 where there is none."""
    import drjit as dr

    return dr.select(coat > 0.0, 1.0 - surfaces.reflectance(cos, dr.maximum(coat, 1.0)), 1.0)
