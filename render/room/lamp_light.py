"""Light of lamps and of the sun on a room's texels: what arrives without a bounce.

Where nothing hides a lamp, its irradiance is Lambert's closed form for a polygon, cut by the horizon. Where a part of
it is hidden, rays over the lamp give the part that is seen, and the closed form the rest. A few rays tell which texels
those are; their neighbours count as well, so that a texel's own luck decides nothing.
The sun: rays over its disc that leave by a window.

Coats mirror lamps. From a texel chance rarely finds a small lamp in a coat, which is a hundred times as bright as the
rest. So photons go the other way, from lamps to coats, and on to texels (`lamps_in_coats`).
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.render.room.camera_plugin import MM_PER_M
from phibench.render.room.mirror_intersection import MirrorBody
from phibench.render.room.subpixel_grid import points, shifts
from phibench.render.room.surfaces import Surfaces, aligned
from phibench.render.room.texel_points import Texels, chosen, transmitted, vector
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.room import Sun

_LAMP_GAP_MM = 1.0  # rays end this far in front of a lamp
FIRST_RAYS = 8
"""Towards a lamp, from every texel that faces it."""
_PENUMBRA_TEXELS = 2  # around those that see a part of a lamp
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
) -> tuple[Array, Array]:
    """Irradiance from lamps and sun, shape (texels, 3), twice: halves with `rays` rays a lamp each, where they differ.

    L cos cos' / r^2 over the lamp's area, W/m^2. The mirror stops it, where one is given.
    """
    halves = tuple(
        np.zeros((len(texels), 3)) if sun is None else _sunlight(mi, surfaces, texels, sun, seed + half, mirror)
        for half in (0, 1)
    )
    for number, lamp in enumerate(_lamps(surfaces)):
        way = lamp[:3] - texels.points_mm
        # the nearest corner's side decides whether any part of the lamp is above the texel's horizon
        reach = 0.5 * sum(np.abs(texels.normals_world @ edge) for edge in (lamp[3:6], lamp[6:9]))
        above = np.einsum("ni,ni->n", way, texels.normals_world)
        seen = np.flatnonzero((above > -reach) & (way @ lamp[9:12] < 0.0))
        if len(seen) == 0:
            continue
        whole = whole_lamp(way[seen], texels.normals_world[seen], lamp)
        key, first = seed + 100 * number, min(FIRST_RAYS, rays)
        sums = _lamp_rays(mi, surfaces, texels, seen, lamp, (0, first), key, mirror)
        share = sums[4] / first
        partly = np.zeros(len(texels), dtype=bool)
        partly[seen] = (share > 0.0) & (share < 1.0)
        # a screen's picture needs all rays, and so does a lamp of which no ray has met the part above the horizon
        again = _around(texels, partly)[seen] | surfaces.table.is_radiance[int(lamp[13])]
        again |= (sums[3] == 0.0) & (whole > 0.0)
        for half, total in enumerate(halves):
            own = sums.copy()
            more = (first, rays) if half == 0 else (0, rays)  # the first rays are of the first half
            if again.any() and more[0] < more[1]:
                found = _lamp_rays(mi, surfaces, texels, seen[again], lamp, more, key + 50 * half, mirror)
                own[:, again] = found + (own[:, again] if half == 0 else 0.0)
            weight = own[3]
            total[seen] += (own[:3] * np.divide(whole, weight, out=np.zeros_like(whole), where=weight > 0.0)).T
    return halves[0], halves[1]


def _lamps(surfaces: Surfaces) -> Array:
    """Per lamp: centre, edges along x and y, normal (scene, mm), area in mm^2, patch; shape (lamps, 14)."""
    table, view, lamps = surfaces.table, surfaces.view, np.flatnonzero(surfaces.is_lamp)
    size = MM_PER_M * table.size_m[lamps]
    centre = MM_PER_M * (table.centre_m[lamps] - view.sphere_centre_m)
    edges = (size[:, :1] * table.x_axis[lamps], size[:, 1:] * table.y_axis[lamps], table.normal[lamps])
    return np.concatenate([centre, *edges, size.prod(axis=1)[:, None], lamps[:, None]], axis=1)


def whole_lamp(way: Array, normals: Array, lamp: Array) -> Array:
    """Irradiance per radiance by the part of a rectangle above the horizon, shape (n,): Lambert's formula for polygons.

    Half the sum over the edges of the angle that an edge subtends, times its plane's normal, times the texel's normal.
    Where the horizon cuts the rectangle, it is an edge. `way` leads to the lamp's centre, mm.
    """
    corners = [way + a * lamp[3:6] + b * lamp[6:9] for a, b in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]
    heights = [np.einsum("ni,ni->n", corner, normals) for corner in corners]
    total, setting, rising = np.zeros(len(way)), np.zeros_like(way), np.zeros_like(way)
    for k in range(4):
        (here, there), (low, high) = ((values[k], values[(k + 1) % 4]) for values in (corners, heights))
        share = np.divide(low, low - high, out=np.zeros_like(low), where=low != high)[:, None]
        cut, up, goes_up = here + share * (there - here), (low > 0.0)[:, None], (high > 0.0)[:, None]
        setting, rising = np.where(up & ~goes_up, cut, setting), np.where(~up & goes_up, cut, rising)
        total += _edge(np.where(up, here, cut), np.where(goes_up, there, cut), normals) * (up | goes_up)[:, 0]
    return np.asarray(0.5 * np.abs(total + _edge(setting, rising, normals)))


def _edge(here: Array, there: Array, normals: Array) -> Array:
    """Angle that edges subtend, times the normal of the plane through them, times the texel's normal."""
    across = np.cross(here, there)
    length = np.linalg.norm(across, axis=1)
    angle = np.arctan2(length, np.einsum("ni,ni->n", here, there))
    return np.asarray(angle * np.einsum("ni,ni->n", across, normals) / np.maximum(length, 1e-30))


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
    some: NDArray[np.intp],
    lamp: Array,
    rays: tuple[int, int],
    seed: int,
    mirror: MirrorBody | None,
) -> Array:
    """Sums over rays from some texels to a lamp, shape (5, n); `rays` are the first number and the end of them.

    What arrives in the bands R, G, B, its weights if nothing hid the lamp, and the number of rays that reach it.
    """
    import drjit as dr

    lanes = mi.UInt32(aligned(some, np.uint32))
    point, normal, coat = chosen(mi, texels, lanes)
    numbers = [dr.opaque(mi.Float, float(value)) for value in lamp]
    is_screen = bool(surfaces.table.is_radiance[int(lamp[13])])
    start_at, count, key, patch = (dr.opaque(mi.UInt32, value) for value in (*rays, seed, int(lamp[13])))
    spread = texels.spread
    shift = shifts(mi, lanes, 2 if spread is None else 3, key)
    dr.eval(shift)

    def body(i: Any, total: Any, weights: Any, seen: Any) -> tuple[Any, Any, Any, Any]:
        x = points(mi, shift, i)
        a, b = x[0] - 0.5, x[1] - 0.5
        start = point if spread is None else spread.start(mi, point, lanes, x[2])
        place = mi.Point3f(*(numbers[k] + a * numbers[3 + k] + b * numbers[6 + k] for k in range(3)))
        way = place - start
        r2 = dr.squared_norm(way)
        r = dr.sqrt(r2)
        way /= r
        cos_here, cos_lamp = dr.dot(way, normal), -dr.dot(way, mi.Vector3f(*numbers[9:12]))
        faces = (cos_here > 0.0) & (cos_lamp > 0.0)
        ray = mi.Ray3f(start, way)
        ray.maxt = r - _LAMP_GAP_MM
        free = faces & ~surfaces.scene.ray_test(ray, coherent=True, active=faces)
        if mirror is not None:
            free &= ~mirror.meets(start, way)[0]  # lamps are never nearer than the mirror
        weight = dr.select(faces, cos_here * cos_lamp / r2, 0.0)
        arrives = mi.Float(1.0) if coat is None else transmitted(surfaces, coat, cos_here)
        part = dr.select(free, weight * arrives, 0.0)
        light = part * surfaces.emission(patch, place) if is_screen else mi.Color3f(part)
        return i + 1, total + light, weights + weight, seen + dr.select(free | ~faces, 1.0, 0.0)

    n = len(some)
    zero = (mi.UInt32(start_at), dr.zeros(mi.Color3f, n), dr.zeros(mi.Float, n), dr.zeros(mi.Float, n))
    _, total, weights, seen = dr.while_loop(zero, lambda i, *_: i < count, body)
    dr.eval(total, weights, seen)  # together: each would run the loop anew
    sums = np.stack([np.array(one, dtype=float) for one in (*total, weights, seen)])
    if not is_screen:
        sums[:3] *= surfaces.table.radiance_w_m2_sr[int(lamp[13])][:, None]
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

    bands = np.where(
        surfaces.table.is_radiance[:, None], surfaces.mean_albedo()[:, None], surfaces.table.radiance_w_m2_sr
    )
    power = bands[lamps[:, 13].astype(int)].sum(axis=1) * lamps[:, 12]
    counts = np.maximum(np.round(_PHOTONS * power / max(power.sum(), 1e-30)), 1).astype(np.int64)
    owner = mi.UInt32(aligned(np.repeat(np.arange(len(lamps)), counts), np.uint32))
    centre, across, up, normal = (dr.gather(mi.Vector3f, vector(mi, lamps[:, k : k + 3]), owner) for k in (0, 3, 6, 9))
    each = dr.gather(mi.Float, mi.Float(aligned(np.pi * lamps[:, 12] / MM_PER_M**2 / counts)), owner)
    patch = dr.gather(mi.UInt32, mi.UInt32(aligned(lamps[:, 13], np.uint32)), owner)
    lane = dr.arange(mi.UInt32, int(counts.sum()))
    x = points(mi, shifts(mi, lane // 256, 4, dr.opaque(mi.UInt32, seed)), lane % 256)
    place = mi.Point3f(centre + (x[0] - 0.5) * across + (x[1] - 0.5) * up)
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
    point, normal, coat = chosen(mi, texels, lanes)
    window = mi.Float(aligned(surfaces.table.window))
    axis = mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in direction))
    radius, key = dr.opaque(mi.Float, sun.radius_rad), dr.opaque(mi.UInt32, seed + 7)
    count, frame = dr.opaque(mi.UInt32, _SUN_RAYS), mi.Frame3f(axis)
    shift = shifts(mi, lanes, 2, key)
    dr.eval(shift)

    def body(i: Any, total: Any) -> tuple[Any, Any]:
        disc = radius * mi.warp.square_to_uniform_disk_concentric(mi.Point2f(*points(mi, shift, i)))
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
