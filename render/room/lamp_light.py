"""Light of lamps and the sun on a room's texels: what arrives without a diffuse bounce, also by way of glossy coats.

Where nothing hides a lamp, its irradiance is Lambert's closed form for a polygon, cut by the horizon. Where a part of
it is hidden, rays over the lamp give the part that is seen, and the closed form the rest. A few rays tell which texels
those are; their neighbours count as well, so that a texel's own luck decides nothing. More rays follow there, the most
where what they may change is a large part of the light around.
The sun: rays over its disc that leave by a window.

Coats mirror lamps. From a texel chance rarely finds a small lamp in a coat, which is a hundred times as bright as the
rest. So photons go the other way, from lamps to coats, and on to texels (`lamps_in_coats`).
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from scipy import ndimage

from phibench.render.optics.faces import IntArray, TexelGrid
from phibench.render.room.camera_plugin import MM_PER_M
from phibench.render.room.mirror_intersection import MirrorBody
from phibench.render.room.subpixel_grid import point_shifts, quasi_random_points
from phibench.render.room.surfaces import Surfaces, aligned
from phibench.render.room.texel_points import Net, Texels, by_count, chosen_points, powers_of_two, transmitted, vector
from phibench.render.setup.variant import activate
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.room import Sun

_LAMP_GAP_MM = 1.0  # rays end this far in front of a lamp
FIRST_RAYS = 8
"""Towards a lamp, from every texel that faces it."""
_PENUMBRA_TEXELS = 2  # around those that see a part of a lamp
_OTHERS = 0.5  # light of surfaces, of the lamps' mean light
_WORTH, _MOST = 0.25, 32  # of the first rays: fewer are left out, and more are too many
_SUN_RAYS = 16
_PHOTONS = 1 << 17  # of all lamps: one changes a texel of 10 cm by 0.001 of the room's light
_COATS = 3


def direct_light(
    mi: ModuleType,
    surfaces: Surfaces,
    texels: Texels,
    sun: Sun | None,
    rays: int,
    seed: int,
    mirror: MirrorBody | None = None,
    needed: BoolArray | None = None,
) -> tuple[Array, Array]:
    """Irradiance from lamps and sun, shape (texels, 3), twice: halves with `rays` rays a lamp each, where they differ.

    L cos cos' / r^2 over the lamp's area, W/m^2. The mirror stops it, where one is given. Others than `needed` texels
    get no lamp's light.
    """
    halves = tuple(
        np.zeros((len(texels), 3)) if sun is None else _sunlight(mi, surfaces, texels, sun, seed + half, mirror)
        for half in (0, 1)
    )
    lamps = _lamps(surfaces)
    pictures = surfaces.table.is_radiance[lamps[:, 13].astype(int)]
    for kind, some in enumerate((lamps[~pictures], lamps[pictures])):
        pairs = _Pairs.of(texels, some, needed)
        if len(pairs.texel):
            for total, light in zip(
                halves, _lamplight(mi, surfaces, texels, pairs, rays, seed + 200 * kind, mirror), strict=True
            ):
                total += light
    return halves[0], halves[1]


@dataclass(frozen=True)
class _Pairs:
    """Texels, and lamps of which a part is above their horizon: pairs, lamp by lamp, in the order of neighbours.

    Attributes
    ----------
    texel, lamp : int arrays, shape (pairs,)
    whole : array, shape (pairs,)
        Irradiance per radiance, if nothing hides the lamp.
    lamps : array, shape (lamps, 14)
    """

    texel: IntArray
    lamp: IntArray
    whole: Array
    lamps: Array

    @staticmethod
    def of(texels: Texels, lamps: Array, needed: BoolArray | None) -> _Pairs:
        """Pairs of some lamps."""
        found, whole = [np.zeros(0, dtype=np.int64)], [np.zeros(0)]
        for lamp in lamps:
            way = lamp[:3] - texels.points_mm
            # the nearest corner's side decides whether any part of the lamp is above the texel's horizon
            reach = 0.5 * sum(np.abs(texels.normals_world @ edge) for edge in (lamp[3:6], lamp[6:9]))
            above = np.einsum("ni,ni->n", way, texels.normals_world)
            facing = (above > -reach) & (way @ lamp[9:12] < 0.0) & (True if needed is None else needed)
            seen = texels.order[facing[texels.order]]
            found.append(seen)
            if len(seen):  # Dr.Jit adds no arrays of size 0
                whole.append(whole_lamp(way[seen], texels.normals_world[seen], lamp))
        number = np.repeat(np.arange(len(lamps)), [len(one) for one in found[1:]])
        return _Pairs(np.concatenate(found), number, np.concatenate(whole), lamps)


def _lamplight(
    mi: ModuleType, surfaces: Surfaces, texels: Texels, pairs: _Pairs, rays: int, seed: int, mirror: MirrorBody | None
) -> tuple[Array, Array]:
    """Light of lamps, shape (texels, 3), twice.

    A few rays tell where a lamp is partly hidden. There others follow, as many as what is not known is worth.
    """
    # a few rays first tell which pairs of texel and lamp need more
    first, number = min(FIRST_RAYS, int(powers_of_two(np.array(float(rays))))), np.arange(len(pairs.texel))
    sums = _lamp_rays(mi, surfaces, texels, pairs, number, np.full(len(number), first), seed, mirror)
    counts = _counts(surfaces, texels, pairs, sums, first, rays)
    halves = []
    for half in (0, 1):
        own = sums.copy()
        more = by_count(number, np.where(counts > first, counts, counts * half))  # the first rays are of the first half
        if len(more):
            own[:, more] = _lamp_rays(mi, surfaces, texels, pairs, more, counts[more], seed + 50 + half, mirror)
        halves.append(_by_texel(pairs, own, len(texels)))
    return halves[0], halves[1]


def _by_texel(pairs: _Pairs, sums: Array, count: int) -> Array:
    """Light by the seen part of lamps, shape (texels, 3)."""
    # ratio estimate: the share that arrives times the exact light of the whole lamp
    share = np.divide(pairs.whole, sums[3], out=np.zeros_like(pairs.whole), where=sums[3] > 0.0)
    return np.stack([np.bincount(pairs.texel, band * share, count) for band in sums[:3]], axis=-1)


def _counts(surfaces: Surfaces, texels: Texels, pairs: _Pairs, sums: Array, first: int, rays: int) -> IntArray:
    """Further rays of each pair, powers of two, 0 where the first tell all: a lamp is seen whole, or hidden whole.

    Others get `rays` in the mean, in proportion to what a ray leaves open: the standard deviation of its light, by the
    part of the lamp that is seen there and around, over all light around.
    """
    patch, beside = pairs.lamps[:, 13].astype(int), texels.grid
    # a screen's picture needs all rays, and so does a lamp of which no ray has met the part above the horizon
    again = surfaces.table.is_radiance[patch][pairs.lamp] | ((sums[3] == 0.0) & (pairs.whole > 0.0))
    seen, whole_grid = sums[4] / first, len(texels) == beside.count  # those of the carriage are few
    near, level = seen.copy(), _by_texel(pairs, sums, len(texels)).mean(axis=1)
    for lamp in range(len(patch)):
        own = np.flatnonzero(pairs.lamp == lamp)
        some, shares = pairs.texel[own], np.zeros((2, len(texels)))
        partly = np.zeros(len(texels), dtype=bool)
        partly[some] = (seen[own] > 0.0) & (seen[own] < 1.0)
        again[own] |= _around(texels, partly)[some]
        if whole_grid:
            shares[:, some] = np.stack([seen[own], np.ones(len(own))])
            share, facing = (_mean_around(beside, one)[some] for one in shares)
            near[own] = share / np.maximum(facing, 1e-30)
    if whole_grid:
        level = _mean_around(beside, level)
    level += _OTHERS * level.mean() + 1e-30
    # Jeffreys' estimate of a share: never 0 or 1
    here, there = ((first * np.clip(one, 0.0, 1.0) + 0.5) / (first + 1.0) for one in (seen, near))
    # geometric mean of two binomial deviations, p (1 - p) here and around
    open_part = (here * (1.0 - here) * there * (1.0 - there)) ** 0.25
    light = _bands(surfaces)[patch].mean(axis=1)[pairs.lamp] * pairs.whole
    worth = np.where(again, light * open_part / level[pairs.texel], 0.0)
    wanted = rays * worth / max(worth.sum() / max(np.count_nonzero(again), 1), 1e-30)
    return np.where(wanted < _WORTH * first, 0, np.clip(powers_of_two(wanted), first, _MOST * first))


def _mean_around(grid: TexelGrid, values: Array) -> Array:
    """Means of the texels within two of each on its grid."""
    out, side = np.empty(grid.count), 2 * _PENUMBRA_TEXELS + 1
    for texels in grid.alike:
        out[texels] = ndimage.uniform_filter(values[texels], size=(1, side, side), mode="nearest")
    return np.maximum(out, 0.0)


def _lamps(surfaces: Surfaces) -> Array:
    """Per lamp: centre, edges along x and y, normal (scene, mm), area in mm^2, patch; shape (lamps, 14)."""
    table, view, lamps = surfaces.table, surfaces.view, np.flatnonzero(surfaces.is_lamp)
    size = MM_PER_M * table.size_m[lamps]
    centre = MM_PER_M * (table.centre_m[lamps] - view.sphere_centre_m)
    edges = (size[:, :1] * table.x_axis[lamps], size[:, 1:] * table.y_axis[lamps], table.normal[lamps])
    return np.concatenate([centre, *edges, size.prod(axis=1)[:, None], lamps[:, None]], axis=1)


def _bands(surfaces: Surfaces) -> Array:
    """Radiance of patches that shine, of screens the mean over their picture, shape (P, 3)."""
    table = surfaces.table
    return np.where(table.is_radiance[:, None], surfaces.mean_albedo()[:, None], table.radiance_w_m2_sr)


def whole_lamp(way: Array, normals: Array, lamp: Array) -> Array:
    """Irradiance per radiance by the part of a rectangle above the horizon, shape (n,): Lambert's formula for polygons.

    Half the sum over the edges of the angle that an edge subtends, times its plane's normal, times the texel's normal.
    Where the horizon cuts the rectangle, it is an edge. `way` leads to the lamp's centre, mm.
    """
    mi = activate()
    import drjit as dr

    centre, normal = (
        mi.Vector3d(*(mi.Float64(aligned(one[:, k], np.float64)) for k in range(3))) for one in (way, normals)
    )
    x, y = (mi.Vector3d(*(dr.opaque(mi.Float64, float(value)) for value in lamp[k : k + 3])) for k in (3, 6))
    corners = [centre + a * x + b * y for a, b in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]
    heights = [dr.dot(corner, normal) for corner in corners]
    total, setting, rising = mi.Float64(0.0), dr.zeros(mi.Vector3d, len(way)), dr.zeros(mi.Vector3d, len(way))
    for k in range(4):
        (here, there), (low, high) = ((values[k], values[(k + 1) % 4]) for values in (corners, heights))
        # where the side crosses the horizon of the texel
        cut = here + dr.select(low != high, low / (low - high), 0.0) * (there - here)
        up, goes_up = low > 0.0, high > 0.0
        setting, rising = dr.select(up & ~goes_up, cut, setting), dr.select(~up & goes_up, cut, rising)
        edge = _edge(dr.select(up, here, cut), dr.select(goes_up, there, cut), normal)
        total += dr.select(up | goes_up, edge, 0.0)
    return np.array(0.5 * dr.abs(total + _edge(setting, rising, normal)))


def _edge(here: Any, there: Any, normal: Any) -> Any:
    """Angle that edges subtend, times the normal of the plane through them, times the texel's normal."""
    import drjit as dr

    across = dr.cross(here, there)
    length = dr.norm(across)
    return dr.atan2(length, dr.dot(here, there)) * dr.dot(across, normal) / dr.maximum(length, 1e-30)


def _around(texels: Texels, marked: BoolArray) -> BoolArray:
    """Texels that are marked, and those within two of them on their grid."""
    if len(texels) != texels.grid.count:  # those of the carriage: few
        return np.ones_like(marked)
    wide, side = marked.copy(), 2 * _PENUMBRA_TEXELS + 1
    for grids in texels.grid.alike:
        some = grids[marked[grids].any(axis=(1, 2))]
        wide[some] = ndimage.maximum_filter(marked[some], size=(1, side, side))
    return wide


def _lamp_rays(
    mi: ModuleType,
    surfaces: Surfaces,
    texels: Texels,
    pairs: _Pairs,
    some: IntArray,
    counts: IntArray,
    seed: int,
    mirror: MirrorBody | None,
) -> Array:
    """Sums over the rays of some pairs, shape (5, n); their numbers are powers of two.

    What arrives in the bands R, G, B, its weights if nothing hid the lamp, and the number of rays that reach it.
    """
    import drjit as dr

    texel, lamp = pairs.texel[some], pairs.lamp[some]
    lanes, owner, ids = (mi.UInt32(aligned(one, np.uint32)) for one in (texel, lamp, lamp * len(texels) + texel))
    point, normal, coat = chosen_points(mi, texels, lanes)
    centre, across, up, facing = (
        dr.gather(mi.Vector3f, vector(mi, pairs.lamps[:, k : k + 3]), owner) for k in (0, 3, 6, 9)
    )
    patch = dr.gather(mi.UInt32, mi.UInt32(aligned(pairs.lamps[:, 13], np.uint32)), owner)
    spread, ends = texels.spread, mi.UInt32(aligned(counts, np.uint32))
    net = Net.of(mi, ids, counts, 2 if spread is None else 3, dr.opaque(mi.UInt32, seed))
    patches = pairs.lamps[:, 13].astype(int)
    pictures = bool(surfaces.table.is_radiance[patches].any())
    dr.eval(centre, across, up, facing, patch)

    def body(i: Any, total: Any, weights: Any, seen: Any) -> tuple[Any, Any, Any, Any]:
        x = net.points(mi, i)
        start = point if spread is None else spread.start(mi, point, lanes, x[2])
        place = mi.Point3f(centre + (x[0] - 0.5) * across + (x[1] - 0.5) * up)
        way = place - start
        r2 = dr.squared_norm(way)
        r = dr.sqrt(r2)
        way /= r
        cos_here, cos_lamp = dr.dot(way, normal), -dr.dot(way, facing)
        faces = (cos_here > 0.0) & (cos_lamp > 0.0)
        ray = mi.Ray3f(start, way)
        ray.maxt = r - _LAMP_GAP_MM
        free = faces & ~surfaces.scene.ray_test(ray, coherent=True, active=faces)
        if mirror is not None:
            free &= ~mirror.meets(start, way)[0]  # lamps are never nearer than the mirror
        # form factor of a point of the lamp: both cosines over the squared distance
        weight = dr.select(faces, cos_here * cos_lamp / r2, 0.0)
        arrives = mi.Float(1.0) if coat is None else transmitted(surfaces, coat, cos_here)
        part = dr.select(free, weight * arrives, 0.0)
        light = part * surfaces.emission(patch, place) if pictures else mi.Color3f(part)
        return i + 1, total + light, weights + weight, seen + dr.select(free | ~faces, 1.0, 0.0)

    n = len(some)
    zero = (dr.zeros(mi.UInt32, n), dr.zeros(mi.Color3f, n), dr.zeros(mi.Float, n), dr.zeros(mi.Float, n))
    _, total, weights, seen = dr.while_loop(zero, lambda i, *_: i < ends, body)
    dr.eval(total, weights, seen)  # together: each would run the loop anew
    sums = np.stack([np.array(one, dtype=float) for one in (*total, weights, seen)])
    if not pictures:
        sums[:3] *= surfaces.table.radiance_w_m2_sr[patches[lamp]].T
    return sums


def lamps_in_coats(mi: ModuleType, surfaces: Surfaces, texels: Texels, seed: int) -> Array:
    """Irradiance from lamps by way of coats, three of them at most, shape (texels, 3): photons, counted by texel.

    The light of the surfaces must be that of the same grid.
    """
    import drjit as dr

    total, areas = np.zeros((texels.grid.count, 3)), texels.grid.areas_m2()
    lamps = _lamps(surfaces)
    if not surfaces.has_coats or not len(lamps):
        return total
    ray, flux = _photons(mi, surfaces, lamps, seed)
    t, patch, valid = surfaces.hit(ray, coherent=False)
    for _ in range(_COATS):
        onward, coated, reflectance = surfaces.mirrored(patch, ray(t), ray.d, valid)
        flux *= reflectance
        dr.eval(onward, coated, flux)
        some = dr.compress(coated)
        if not dr.width(some):
            break
        ray = mi.Ray3f(dr.gather(mi.Point3f, onward.o, some), dr.gather(mi.Vector3f, onward.d, some))
        flux = dr.gather(mi.Color3f, flux, some)
        t, patch, valid = surfaces.hit(ray, coherent=False)
        found, arriving = surfaces.ground(patch, ray(t), ray.d, valid, False), flux * surfaces.entering(patch, ray.d)
        texel = dr.select(found.active, found.nearest(), texels.grid.count)
        dr.eval(ray, t, patch, valid, texel, arriving)
        number = np.array(texel)
        for k in range(3):
            total[:, k] += np.bincount(number, np.array(arriving[k]), len(total) + 4)[: len(total)]
    free = 1.0 if texels.spread is None else np.maximum(texels.spread.free_share(), 1.0 / 16.0)
    return total / (areas * free)[:, None]


def _photons(mi: ModuleType, surfaces: Surfaces, lamps: Array, seed: int) -> tuple[Any, Any]:
    """Rays that leave lamps, cosine-weighted, and the flux of each, W: as many of a lamp as its part of the power."""
    import drjit as dr

    power = _bands(surfaces)[lamps[:, 13].astype(int)].sum(axis=1) * lamps[:, 12]
    # photons by power, so that each carries about as much
    counts = np.maximum(np.round(_PHOTONS * power / max(power.sum(), 1e-30)), 1).astype(np.int64)
    owner = mi.UInt32(aligned(np.repeat(np.arange(len(lamps)), counts), np.uint32))
    centre, across, up, normal = (dr.gather(mi.Vector3f, vector(mi, lamps[:, k : k + 3]), owner) for k in (0, 3, 6, 9))
    # flux of a Lambertian lamp is pi x area x radiance; lengths are mm here
    each = dr.gather(mi.Float, mi.Float(aligned(np.pi * lamps[:, 12] / MM_PER_M**2 / counts)), owner)
    patch = dr.gather(mi.UInt32, mi.UInt32(aligned(lamps[:, 13], np.uint32)), owner)
    lane = dr.arange(mi.UInt32, int(counts.sum()))
    x = quasi_random_points(mi, point_shifts(mi, lane // 256, 4, dr.opaque(mi.UInt32, seed)), lane % 256)
    place = mi.Point3f(centre + (x[0] - 0.5) * across + (x[1] - 0.5) * up)
    # Lambert: by the cosine, and then all photons of a lamp weigh the same
    way = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(x[2], x[3])))
    return mi.Ray3f(place + _LAMP_GAP_MM * normal, way), each * surfaces.emission(patch, place)


def _sunlight(
    mi: ModuleType, surfaces: Surfaces, texels: Texels, sun: Sun, seed: int, mirror: MirrorBody | None
) -> Array:
    """Irradiance from the sun, shape (texels, 3): rays over its disc that leave by a window."""
    import drjit as dr

    direction = np.array(sun.direction_world)
    towards = np.flatnonzero(texels.normals_world @ direction > 0.0)
    total = np.zeros((len(texels), 3))
    if len(towards) == 0 or not surfaces.table.window.any():
        return total
    lanes = mi.UInt32(aligned(towards, np.uint32))
    point, normal, coat = chosen_points(mi, texels, lanes)
    window = mi.Float(aligned(surfaces.table.window))
    axis = mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in direction))
    radius, key = dr.opaque(mi.Float, sun.radius_rad), dr.opaque(mi.UInt32, seed + 7)
    count, frame = dr.opaque(mi.UInt32, _SUN_RAYS), mi.Frame3f(axis)
    shift = point_shifts(mi, lanes, 2, key)
    dr.eval(shift)

    def body(i: Any, total: Any) -> tuple[Any, Any]:
        # a small disc: its radius in radians is the radius at distance 1
        disc = radius * mi.warp.square_to_uniform_disk_concentric(mi.Point2f(*quasi_random_points(mi, shift, i)))
        way = dr.normalize(frame.to_world(mi.Vector3f(disc.x, disc.y, 1.0)))
        _, patch, valid = surfaces.hit(mi.Ray3f(point, way))
        out = valid & (dr.gather(mi.Float, window, patch, valid) > 0.0)
        if mirror is not None:
            out &= ~mirror.meets(point, way)[0]
        cos = dr.maximum(dr.dot(way, normal), 0.0)
        if coat is not None:
            cos *= transmitted(surfaces, coat, cos)
        return i + 1, total + dr.select(out, cos, 0.0)

    _, light = dr.while_loop((mi.UInt32(0), dr.zeros(mi.Float, len(towards))), lambda i, _: i < count, body)
    total[towards] = np.array(light, dtype=float)[:, None] / _SUN_RAYS * np.array(sun.irradiance_w_m2)
    return total
