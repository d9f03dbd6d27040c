"""Light map of a room: irradiance of every texel, from lamps, the sun and all bounces. Baked once for a room.

Lamps: every pair of a texel and a lamp gets a few shadow rays over the lamp, and many where some of them are blocked or
where the lamp is near. The sun: rays over its disc, which count if they leave by a window. Bounces: passes over a
coarse grid. Last: a gather over the fine grid from the full map, in two independent halves; what both agree on is then
smoothed (`irradiance_filter`).
The mirror ball itself (12 cm) and the carriage are left out of the room's light. The carriage is lit by the map when a
view is rendered.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.render.room.camera_plugin import MM_PER_M
from phibench.render.room.irradiance_filter import smoothed
from phibench.render.room.subpixel_grid import points, shifts
from phibench.render.room.surfaces import Surfaces, aligned
from phibench.render.room.texel_grid import TexelGrid
from phibench.render.setup.variant import activate
from phibench.scenes.faces import face_table
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import View
from phibench.scenes.room import Room, Sun, chassis
from phibench.scenes.shapes import Shape

BOUNCE_TEXEL_M = 0.2
"""Texels of the bounces. With 0.4 m the lab's ceiling is 0.5 % too dark, with 0.2 m 0.1 %."""
_LIFT_MM = 0.05  # rays start this far in front of their surface
_LAMP_GAP_MM = 1.0  # and end this far in front of the lamp
_SEED = 0  # the shifts are part of the quadrature rule; the two halves use different streams
_FIRST_RAYS = 16  # towards a lamp, in each half
_PENUMBRA_TEXELS = 2  # around those that see a part of a lamp
_NEAR = 2.0  # lamps nearer than this many of their diagonals get all rays
_SUN_RAYS = 16


@dataclass(frozen=True)
class BakeSettings:
    """Size of texels and numbers of rays per texel (defaults: 0.3 % noise in the furnished lab).

    What comes from other surfaces than lamps changes slowly: it has texels of its own, `indirect_texel_m`.
    """

    texel_m: float = 0.05
    indirect_texel_m: float = 0.1
    lamp_rays: int = 64
    bounces: int = 12
    bounce_rays: int = 64
    final_rays: int = 384


@dataclass(frozen=True)
class LightMap:
    """Irradiance of all texels of a room.

    Attributes
    ----------
    irradiance_w_m2 : array, shape (texels, 3), float32
        Per ambient band; texels that are covered by another shape hold their nearest neighbour's.
    sigma_w_m2 : array, shape (texels, 3), float32
        Standard error, from two independent halves.
    covered : bool array, shape (texels,)
    """

    irradiance_w_m2: NDArray[np.float32]
    sigma_w_m2: NDArray[np.float32]
    covered: BoolArray


def fixed_shapes(room: Room) -> tuple[Shape, ...]:
    """Shapes of a room that stand still: everything but the carriage and the mirror."""
    return (*room.surfaces, *room.furniture, *(chassis() if room.robot else ()))


def texel_count(room: Room, texel_m: float) -> int:
    """Number of texels of a room's light map."""
    return TexelGrid.of(face_table(fixed_shapes(room)), texel_m).count


def bake(view: View, room: Room, settings: BakeSettings) -> LightMap:
    """Light map of a room; `view` only gives the origin of the scene's coordinates."""
    mi = activate()
    surfaces = Surfaces(mi, view, face_table(fixed_shapes(room)))
    fine = _Texels.of(mi, surfaces, TexelGrid.of(surfaces.table, settings.texel_m))
    covered = _covered(mi, surfaces, fine, settings.texel_m)
    surfaces.set_light(fine.grid, np.zeros((len(fine), 3)))
    direct = [_direct(mi, surfaces, fine, room.sun, settings.lamp_rays, seed) for seed in (_SEED, _SEED + 1)]
    lit = _filled(0.5 * (direct[0] + direct[1]), covered, fine.grid)
    lit += _bounced(mi, surfaces, fine.grid, lit, settings)
    surfaces.set_light(fine.grid, lit)
    mean, sigma = _indirect(mi, surfaces, fine, covered, settings)
    direct_mean = _filled(0.5 * (direct[0] + direct[1]), covered, fine.grid)
    noise = np.hypot(sigma, 0.5 * np.abs(direct[0] - direct[1]))
    total = np.maximum(mean, 0.0) + direct_mean  # a straight line through noise may end below 0
    return LightMap(total.astype(np.float32), noise.astype(np.float32), covered)


def _indirect(
    mi: ModuleType, surfaces: Surfaces, fine: _Texels, covered: BoolArray, settings: BakeSettings
) -> tuple[Array, Array]:
    """Irradiance by all surfaces, from the present map, and its standard error, shape (texels, 3) each."""
    texels, hidden = fine, covered
    if settings.indirect_texel_m > settings.texel_m:
        texels = _Texels.of(mi, surfaces, TexelGrid.of(surfaces.table, settings.indirect_texel_m))
        hidden = _covered(mi, surfaces, texels, settings.texel_m)
    # two independent halves: half their difference is the standard error of their mean
    halves = [_filled(_gather(mi, surfaces, texels, settings.final_rays, 2 + i), hidden, texels.grid) for i in (0, 1)]
    mean, sigma = smoothed(texels.grid, halves[0], halves[1])
    if texels is fine:
        return mean, sigma
    return _finer(texels.grid, fine.grid, mean), _finer(texels.grid, fine.grid, sigma)


def light_carriage(
    surfaces: Surfaces,
    grid: TexelGrid,
    fixed: int,
    irradiance: NDArray[np.float32],
    settings: BakeSettings,
    sun: Sun | None = None,
) -> NDArray[np.float32]:
    """Irradiance of all texels of a view: the map for the `fixed` first patches, gathered now for the others."""
    mi = activate()
    first = grid.texels_of(fixed)
    full = np.zeros((grid.count, 3), dtype=np.float32)
    full[:first] = irradiance
    surfaces.set_light(grid, full)
    if first < grid.count:
        texels = _Texels.of(mi, surfaces, grid, first)
        light = _direct(mi, surfaces, texels, sun, settings.lamp_rays, _SEED)
        full[first:] = light + _gather(mi, surfaces, texels, _CARRIAGE_RAYS, 2)
        surfaces.set_light(grid, full)
    return full


_CARRIAGE_RAYS = 1024


@dataclass(frozen=True)
class _Texels:
    """Points just in front of texels, and normals: Dr.Jit arrays and NumPy's (mm)."""

    grid: TexelGrid
    points: Any
    normals: Any
    points_mm: Array
    normals_world: Array
    coat: Any

    @staticmethod
    def of(mi: ModuleType, surfaces: Surfaces, grid: TexelGrid, first: int = 0) -> _Texels:
        """Texels of a grid from a number on."""
        places, normals = (values[first:] for values in grid.points())
        starts = MM_PER_M * (places - surfaces.view.sphere_centre_m) + _LIFT_MM * normals
        columns = [[mi.Float(aligned(a[:, i])) for i in range(3)] for a in (starts, normals)]
        coat = mi.Float(aligned(grid.table.coat[grid.patch()[0][first:]])) if surfaces.has_coats else None
        return _Texels(grid, mi.Point3f(*columns[0]), mi.Vector3f(*columns[1]), starts, normals, coat)

    def __len__(self) -> int:
        return len(self.points_mm)


def _covered(mi: ModuleType, surfaces: Surfaces, texels: _Texels, texel_m: float) -> BoolArray:
    """Texels that nobody sees whole: inside a solid (the way out meets a back face), against one, or in the void."""
    import drjit as dr

    t, patch, valid = surfaces.hit(mi.Ray3f(texels.points, texels.normals))
    patch, valid, near = np.array(patch), np.array(valid), np.array(t) < 0.5 * MM_PER_M * texel_m
    dr.sync_thread()
    normal, two_sided = surfaces.table.normal[patch], surfaces.table.two_sided[patch]
    outward = np.einsum("ni,ni->n", normal, texels.normals_world) > 0.0
    # what is nearer than half a texel stands against this one
    return np.asarray(~valid | (outward & ~two_sided) | near)


def _filled(values: Array, covered: BoolArray, grid: TexelGrid) -> Array:
    """Give covered texels the value of the nearest uncovered one of their grid, so that none leaks."""
    filled = values.copy()
    for part, rows, columns in grid.grids():
        hidden = covered[part].reshape(rows, columns)
        if hidden.any() and not hidden.all():
            row, column = ndimage.distance_transform_edt(hidden, return_distances=False, return_indices=True)
            filled[part] = values[part].reshape(rows, columns, 3)[row, column].reshape(-1, 3)
    return filled


# Lamps and the sun.


def _lamps(surfaces: Surfaces) -> Array:
    """Per lamp: centre, edges along x and y, normal (scene, mm), area in mm^2, patch; shape (lamps, 14)."""
    table, view, lamps = surfaces.table, surfaces.view, np.flatnonzero(surfaces.is_lamp)
    size = MM_PER_M * table.size_m[lamps]
    centre = MM_PER_M * (table.centre_m[lamps] - view.sphere_centre_m)
    edges = (size[:, :1] * table.x_axis[lamps], size[:, 1:] * table.y_axis[lamps], table.normal[lamps])
    return np.concatenate([centre, *edges, size.prod(axis=1)[:, None], lamps[:, None]], axis=1)


def _direct(mi: ModuleType, surfaces: Surfaces, texels: _Texels, sun: Sun | None, rays: int, seed: int) -> Array:
    """Irradiance from lamps and sun, shape (texels, 3): L cos cos' V / r^2 dA with `rays` points per lamp at most."""
    total = np.zeros((len(texels), 3))
    for number, lamp in enumerate(_lamps(surfaces)):
        way = lamp[:3] - texels.points_mm
        diagonal = np.linalg.norm(lamp[3:9].reshape(2, 3).sum(axis=0))
        # the nearest corner's side decides whether any part of the lamp is above the texel's horizon
        reach = 0.5 * sum(np.abs(texels.normals_world @ edge) for edge in (lamp[3:6], lamp[6:9]))
        above = np.einsum("ni,ni->n", way, texels.normals_world) > -reach
        chosen = np.flatnonzero(above & (way @ lamp[9:12] < 0.0))
        if len(chosen) == 0:
            continue
        # a screen's picture needs all rays: 8 leave 6 % of noise
        first = rays if surfaces.table.is_radiance[int(lamp[13])] else min(_FIRST_RAYS, rays)
        value, share = _lamp_rays(mi, surfaces, texels, chosen, lamp, first, seed + 100 * number)
        distance = np.linalg.norm(way[chosen], axis=1)
        # what is asked for more must not depend on a texel's own luck: that would favour those that seem free
        partly = np.zeros(len(texels), dtype=bool)
        partly[chosen] = (share > 0.0) & (share < 1.0)
        again = _around(texels, partly)[chosen] | (distance < _NEAR * diagonal)
        if rays > first and again.any():
            value[again], _ = _lamp_rays(mi, surfaces, texels, chosen[again], lamp, rays, seed + 100 * number + 50)
        total[chosen] += value
    return total if sun is None else total + _sunlight(mi, surfaces, texels, sun, seed)


def _around(texels: _Texels, marked: BoolArray) -> BoolArray:
    """Texels that are marked, and those within two of them on their grid."""
    if len(texels) != texels.grid.count:  # those of the carriage: few
        return np.ones_like(marked)
    wide = marked.copy()
    for part, rows, columns in texels.grid.grids():
        if marked[part].any():
            grid = marked[part].reshape(rows, columns)
            wide[part] = ndimage.maximum_filter(grid, size=2 * _PENUMBRA_TEXELS + 1).ravel()
    return wide


def _lamp_rays(
    mi: ModuleType, surfaces: Surfaces, texels: _Texels, chosen: NDArray[np.intp], lamp: Array, rays: int, seed: int
) -> tuple[Array, Array]:
    """Irradiance by a lamp, shape (n, 3), and the part of the rays that reach it, shape (n,)."""
    import drjit as dr

    lanes = mi.UInt32(aligned(chosen, np.uint32))
    point, normal, coat = _chosen(mi, texels, lanes)
    numbers = [dr.opaque(mi.Float, float(value)) for value in lamp]
    count, key, patch = (dr.opaque(mi.UInt32, value) for value in (rays, seed, int(lamp[13])))
    shift = shifts(mi, lanes, 2, key)
    dr.eval(shift)

    def body(i: Any, total: Any, seen: Any) -> tuple[Any, Any, Any]:
        a, b = (x - 0.5 for x in points(mi, shift, i))
        place = mi.Point3f(*(numbers[k] + a * numbers[3 + k] + b * numbers[6 + k] for k in range(3)))
        way = place - point
        r2 = dr.squared_norm(way)
        r = dr.sqrt(r2)
        way /= r
        cos_here, cos_lamp = dr.dot(way, normal), -dr.dot(way, mi.Vector3f(*numbers[9:12]))
        faces = (cos_here > 0.0) & (cos_lamp > 0.0)
        ray = mi.Ray3f(point, way)
        ray.maxt = r - _LAMP_GAP_MM
        free = faces & ~surfaces.scene.ray_test(ray, coherent=True, active=faces)
        weight = dr.select(free, cos_here * cos_lamp / r2, 0.0)
        if coat is not None:
            weight *= _transmitted(surfaces, coat, cos_here)
        return i + 1, total + weight * surfaces.emission(patch, place), seen + dr.select(free | ~faces, 1.0, 0.0)

    zero = (mi.UInt32(0), dr.zeros(mi.Color3f, len(chosen)), dr.zeros(mi.Float, len(chosen)))
    _, total, seen = dr.while_loop(zero, lambda i, *_: i < count, body)
    value = np.stack([np.array(total[k], dtype=float) for k in range(3)], axis=-1)
    return value * (lamp[12] / rays), np.array(seen, dtype=float) / rays


def _chosen(mi: ModuleType, texels: _Texels, lanes: Any) -> tuple[Any, Any, Any]:
    """Points, normals and coats of some texels."""
    import drjit as dr

    point, normal = dr.gather(mi.Point3f, texels.points, lanes), dr.gather(mi.Vector3f, texels.normals, lanes)
    coat = None if texels.coat is None else dr.gather(mi.Float, texels.coat, lanes)
    dr.eval(point, normal, coat)
    return point, normal, coat


def _sunlight(mi: ModuleType, surfaces: Surfaces, texels: _Texels, sun: Sun, seed: int) -> Array:
    """Irradiance from the sun, shape (texels, 3): rays over its disc that leave by a window."""
    import drjit as dr

    direction = np.array(sun.direction_world)
    chosen = np.flatnonzero(texels.normals_world @ direction > 0.0)
    total = np.zeros((len(texels), 3))
    if len(chosen) == 0 or not surfaces.table.window.any():
        return total
    lanes = mi.UInt32(aligned(chosen, np.uint32))
    point, normal, coat = _chosen(mi, texels, lanes)
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
        cos = dr.maximum(dr.dot(way, normal), 0.0)
        if coat is not None:
            cos *= _transmitted(surfaces, coat, cos)
        return i + 1, total + dr.select(out, cos, 0.0)

    _, light = dr.while_loop((mi.UInt32(0), dr.zeros(mi.Float, len(chosen))), lambda i, _: i < count, body)
    total[chosen] = np.array(light, dtype=float)[:, None] / _SUN_RAYS * np.array(sun.irradiance_w_m2)
    return total


# Bounced light.


def _bounced(mi: ModuleType, surfaces: Surfaces, fine: TexelGrid, lit: Array, settings: BakeSettings) -> Array:
    """Bounced irradiance of the fine texels, shape (texels, 3), from passes over a coarse grid."""
    coarse = TexelGrid.of(surfaces.table, max(BOUNCE_TEXEL_M, settings.texel_m))
    texels = _Texels.of(mi, surfaces, coarse)
    covered = _covered(mi, surfaces, texels, settings.texel_m)
    direct, bounced = _coarser(fine, coarse, lit), np.zeros((coarse.count, 3))
    for turn in range(settings.bounces):
        surfaces.set_light(coarse, direct + bounced)
        bounced = _filled(_gather(mi, surfaces, texels, settings.bounce_rays, 10 + turn), covered, coarse)
    return _finer(coarse, fine, bounced)


def _coarser(fine: TexelGrid, coarse: TexelGrid, values: Array) -> Array:
    """Means over the coarse texels, shape (coarse texels, 3)."""
    return _resampled(fine, coarse, values, _overlap)


def _finer(coarse: TexelGrid, fine: TexelGrid, values: Array) -> Array:
    """Values between the coarse texels' centres, bilinear, shape (fine texels, 3)."""
    return _resampled(coarse, fine, values, _between)


def _resampled(old: TexelGrid, new: TexelGrid, values: Array, matrix: Callable[[int, int], Array]) -> Array:
    out = np.zeros((new.count, 3))
    for (part, *size), (to, *wanted) in zip(old.grids(), new.grids(), strict=True):
        down, across = (matrix(n, m) for n, m in zip(size, wanted, strict=True))
        image = np.tensordot(down, values[part].reshape(*size, 3), axes=1)
        out[to] = np.einsum("ij,rjc->ric", across, image).reshape(-1, 3)
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


def _gather(mi: ModuleType, surfaces: Surfaces, texels: _Texels, rays: int, seed: int) -> Array:
    """Irradiance from all surfaces by the present map, lamps left out, shape (texels, 3): pi x mean radiance."""
    import drjit as dr

    lanes = dr.arange(mi.UInt32, len(texels))
    key, count = (dr.opaque(mi.UInt32, value) for value in (seed, rays))
    shift, frame = shifts(mi, lanes, 2, key), mi.Frame3f(texels.normals)

    def body(i: Any, total: Any) -> tuple[Any, Any]:
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(*points(mi, shift, i)))
        way = frame.to_world(local)
        ray = mi.Ray3f(texels.points, way)
        t, patch, valid = surfaces.hit(ray, coherent=False)
        value = surfaces.radiance(patch, ray(t), way, valid, lamps=False)
        if texels.coat is not None:
            value *= _transmitted(surfaces, texels.coat, local.z)
        return i + 1, total + value

    start = (mi.UInt32(0), dr.zeros(mi.Color3f, len(texels)))
    _, total = dr.while_loop(start, lambda i, _: i < count, body)
    return np.pi / rays * np.stack([np.array(total[k], dtype=float) for k in range(3)], axis=-1)


def _transmitted(surfaces: Surfaces, coat: Any, cos: Any) -> Any:
    """Part of the light that a coat lets in; 1 where there is none."""
    import drjit as dr

    return dr.select(coat > 0.0, 1.0 - surfaces.reflectance(cos, dr.maximum(coat, 1.0)), 1.0)


# Light maps as files.

ARRAYS = {"irradiance_w_m2": ("<f4", 2), "sigma_w_m2": ("<f4", 2), "covered": ("|b1", 1)}
"""Type and number of axes of each array of a file."""


def encoded(light: LightMap) -> bytes:
    """Bytes of an `.npz` file."""
    buffer = io.BytesIO()
    np.savez(buffer, **{name: getattr(light, name) for name in ARRAYS})
    return buffer.getvalue()
