"""Light map of a room: the irradiance of every texel, direct and by all bounces.

Direct light is integrated over the lamps with shadow rays. Bounced light is gathered over the hemisphere from the map
itself, again and again: pass k adds bounce k, and the error left after k passes falls as albedo^k. A last gather with
many rays sets the noise; its two independent halves give the noise estimate. The robot's body is in the map. Mirror,
camera housing and mast are not: they move with the carriage.

Arrays have one row per texel and three bands, W/m^2.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.render.room.camera_plugin import MM_PER_M
from phibench.render.room.shading import Patch, Surfaces, aligned, cut
from phibench.render.room.subpixel_grid import points, shifts
from phibench.render.setup.variant import activate
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import View
from phibench.scenes.room import Room, chassis
from phibench.scenes.shapes import Rectangle, Shape

_LIFT_MM = 0.05  # rays start this far in front of their surface
_LAMP_GAP_MM = 1.0  # and end this far in front of the lamp
_SEED = 0  # the shifts are part of the quadrature rule; the two halves use different streams


@dataclass(frozen=True)
class BakeSettings:
    """Size of texels and numbers of rays per texel (defaults: 0.3 % noise in the furnished lab)."""

    texel_m: float = 0.05
    lamp_rays: int = 64
    bounces: int = 12
    bounce_rays: int = 64
    final_rays: int = 1024


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


def bake(view: View, room: Room, settings: BakeSettings) -> LightMap:
    """Light map of a room; `view` only gives the origin of the scene's coordinates."""
    mi = activate()
    shapes = fixed_shapes(room)
    surfaces = Surfaces(mi, view, cut(shapes, settings.texel_m))
    texels = _Texels.of(mi, view, surfaces.patches)
    covered = _covered(mi, surfaces, texels, settings.texel_m)
    lamps = _lamps(view, shapes)
    direct = [_direct(mi, surfaces, texels, lamps, settings.lamp_rays, seed) for seed in (_SEED, _SEED + 1)]
    lit = 0.5 * (direct[0] + direct[1])
    surfaces.set_irradiance(_filled(lit, covered, surfaces.patches))
    for bounce in range(settings.bounces):
        bounced = _gather(mi, surfaces, texels, settings.bounce_rays, 10 + bounce)
        surfaces.set_irradiance(_filled(lit + bounced, covered, surfaces.patches))
    # two independent halves: half their difference is the standard error of their mean
    halves = [d + _gather(mi, surfaces, texels, settings.final_rays, 2 + i) for i, d in enumerate(direct)]
    total = _filled(0.5 * (halves[0] + halves[1]), covered, surfaces.patches)
    sigma = 0.5 * np.abs(halves[0] - halves[1])
    return LightMap(total.astype(np.float32), sigma.astype(np.float32), covered)


def light_carriage(
    surfaces: Surfaces, shapes: Sequence[Shape], fixed: int, irradiance: NDArray[np.float32], settings: BakeSettings
) -> NDArray[np.float32]:
    """Irradiance of all texels of a view: the map for the `fixed` first ones, gathered now for the others."""
    mi = activate()
    moving = [patch for patch in surfaces.patches if patch.start >= fixed]
    total = surfaces.patches[-1].start + surfaces.patches[-1].count
    full = np.zeros((total, 3), dtype=np.float32)
    full[:fixed] = irradiance
    surfaces.set_irradiance(full)
    if moving:
        texels = _Texels.of(mi, surfaces.view, moving)
        light = _direct(mi, surfaces, texels, _lamps(surfaces.view, shapes), settings.lamp_rays, _SEED)
        full[fixed:] = light + _gather(mi, surfaces, texels, settings.final_rays, 2)
        surfaces.set_irradiance(full)
    return full


@dataclass(frozen=True)
class _Texels:
    """Dr.Jit arrays of points just in front of the texels, and normals."""

    points: Any
    normals: Any

    @staticmethod
    def of(mi: ModuleType, view: View, patches: Sequence[Patch]) -> _Texels:
        normals = np.concatenate([np.repeat(patch.normal[None], patch.count, axis=0) for patch in patches])
        centres = np.concatenate([patch.centres_m() for patch in patches])
        starts = MM_PER_M * (centres - view.sphere_centre_m) + _LIFT_MM * normals
        columns = [[mi.Float(aligned(a[:, i])) for i in range(3)] for a in (starts, normals)]
        return _Texels(mi.Point3f(*columns[0]), mi.Vector3f(*columns[1]))


def _covered(mi: ModuleType, surfaces: Surfaces, texels: _Texels, texel_m: float) -> BoolArray:
    """Texels that nobody sees whole: inside a solid (the way out meets a back face), against one, or in the void."""
    import drjit as dr

    hit = surfaces.scene.ray_intersect(mi.Ray3f(texels.points, texels.normals))
    outward = dr.dot(hit.n, texels.normals) > 0.0
    # what is nearer than half a texel stands against this one
    hidden = ~hit.is_valid() | outward | (hit.t < 0.5 * MM_PER_M * texel_m)
    return np.array(hidden, dtype=bool)


def _filled(values: Array, covered: BoolArray, patches: Sequence[Patch]) -> Array:
    """Give covered texels the value of the nearest uncovered one of their patch, so that none leaks."""
    filled = values.copy()
    for patch in patches:
        part = slice(patch.start, patch.start + patch.count)
        hidden = covered[part].reshape(patch.rows, patch.columns)
        if hidden.any() and not hidden.all():
            row, column = ndimage.distance_transform_edt(hidden, return_distances=False, return_indices=True)
            filled[part] = values[part].reshape(patch.rows, patch.columns, 3)[row, column].reshape(-1, 3)
    return filled


def _lamps(view: View, shapes: Sequence[Shape]) -> Array:
    """Per lamp: centre, edges along x and y, normal (scene, mm), radiance, area in mm^2; shape (lamps, 16)."""
    rows = []
    for lamp in shapes:
        if isinstance(lamp, Rectangle) and lamp.emits:
            pose, (width, height) = lamp.T_world_shape, (MM_PER_M * length for length in lamp.size_m)
            centre = MM_PER_M * (pose.t - view.sphere_centre_m)
            edges = (width * pose.R[:, 0], height * pose.R[:, 1], pose.R[:, 2])
            rows.append(np.concatenate([centre, *edges, lamp.radiance_w_m2_sr, [width * height]]))
    return np.array(rows).reshape(-1, 16)


def _direct(mi: ModuleType, surfaces: Surfaces, texels: _Texels, lamps: Array, rays: int, seed: int) -> Array:
    """Irradiance from the lamps, shape (texels, 3): L cos cos' V / r^2 dA with `rays` points per lamp."""
    import drjit as dr

    if len(lamps) == 0:
        return np.zeros((dr.width(texels.points), 3))
    table = mi.Float(aligned(lamps))
    lanes = dr.arange(mi.UInt32, dr.width(texels.points))
    rays, key, count = (dr.opaque(mi.UInt32, value) for value in (rays, seed, len(lamps) * rays))
    shift = shifts(mi, lanes, 2, key)

    def body(i: Any, total: Any) -> tuple[Any, Any]:
        lamp = i // rays
        column = [dr.gather(mi.Float, table, lamp * 16 + k) for k in range(16)]
        a, b = (x - 0.5 for x in points(mi, shift, i - lamp * rays))
        place = mi.Point3f(*(column[k] + a * column[3 + k] + b * column[6 + k] for k in range(3)))
        way = place - texels.points
        r2 = dr.squared_norm(way)
        r = dr.sqrt(r2)
        way /= r
        cos_here, cos_lamp = dr.dot(way, texels.normals), -dr.dot(way, mi.Vector3f(*column[9:12]))
        faces = (cos_here > 0.0) & (cos_lamp > 0.0)
        ray = mi.Ray3f(texels.points, way)
        ray.maxt = r - _LAMP_GAP_MM
        seen = faces & ~surfaces.scene.ray_test(ray, faces)
        weight = dr.select(seen, cos_here * cos_lamp / r2 * column[15] / mi.Float(rays), 0.0)
        return i + 1, total + weight * mi.Color3f(*column[12:15])

    return _loop(mi, body, count, len(lanes))


def _gather(mi: ModuleType, surfaces: Surfaces, texels: _Texels, rays: int, seed: int) -> Array:
    """Irradiance from all surfaces by the present map, lamps left out, shape (texels, 3): pi x mean radiance."""
    import drjit as dr

    lanes = dr.arange(mi.UInt32, dr.width(texels.points))
    key, count = (dr.opaque(mi.UInt32, value) for value in (seed, rays))
    shift, frame = shifts(mi, lanes, 2, key), mi.Frame3f(texels.normals)

    def body(i: Any, total: Any) -> tuple[Any, Any]:
        way = frame.to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(*points(mi, shift, i))))
        ray = mi.Ray3f(texels.points, way)
        hit = surfaces.scene.ray_intersect_preliminary(ray)
        valid = hit.is_valid()
        patch = surfaces.patch_ids(dr.reinterpret_array(mi.UInt32, hit.shape), valid)
        return i + 1, total + surfaces.radiance(patch, ray(hit.t), way, valid, lamps=False)

    return np.pi / rays * _loop(mi, body, count, len(lanes))


def _loop(mi: ModuleType, body: Any, count: Any, lanes: int) -> Array:
    """Sum a colour over `count` turns, shape (lanes, 3)."""
    import drjit as dr

    start = (mi.UInt32(0), dr.zeros(mi.Color3f, lanes))
    _, total = dr.while_loop(start, lambda i, _: i < count, body)
    return np.stack([np.array(total[k], dtype=float) for k in range(3)], axis=-1)


# Light maps as files.

ARRAYS = {"irradiance_w_m2": ("<f4", 2), "sigma_w_m2": ("<f4", 2), "covered": ("|b1", 1)}
"""Type and number of axes of each array of a file."""


def encoded(light: LightMap) -> bytes:
    """Bytes of an `.npz` file."""
    buffer = io.BytesIO()
    np.savez(buffer, **{name: getattr(light, name) for name in ARRAYS})
    return buffer.getvalue()
