"""Patches and their light map inside a Dr.Jit kernel: radiance of the surface that a ray hits.

Albedo is kept out of the map and multiplied in exactly, at the very point; the map's irradiance is bilinear between
texel centres and linear beyond the outermost ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.render.c310_plugin import MM_PER_M, sensor_dict
from phibench.render.patches import Patch
from phibench.render.translate import load_scene, mirror_dict, shape_dict
from phibench.scenes.rig import View
from phibench.scenes.room import MIRROR_NAME
from phibench.scenes.textures import Checker

_ENDLESS_M = 1e3  # cells of a plain surface


class Surfaces:
    """A Mitsuba scene of patches with tables that answer look-ups.

    Parameters
    ----------
    mi : module
        Mitsuba with its variant set.
    view : View
        The scene's origin is its sphere centre.
    patches : sequence of Patch
    camera : bool
        Put the mirror and the sensor into the scene as well.
    """

    def __init__(self, mi: ModuleType, view: View, patches: Sequence[Patch], *, camera: bool = False) -> None:
        self._mi, self.view, self.patches = mi, view, tuple(patches)
        entries: dict[str, Any] = {"type": "scene"}
        if camera:
            entries |= {"sensor": sensor_dict(mi, view), MIRROR_NAME: mirror_dict(mi, view)}
        names = {f"patch_{i:05d}": patch for i, patch in enumerate(patches)}
        entries |= {name: shape_dict(mi, view, patch.surface) for name, patch in names.items()}
        self.scene = load_scene(mi, entries)
        self.mirror_id = len(patches)
        self._shape_ids = self._registry(list(names))
        self._tables()

    def set_irradiance(self, irradiance_w_m2: NDArray[np.floating]) -> None:
        """Give the texels their irradiance, shape (texels, 3), W/m^2."""
        self._irradiance = self._floats(irradiance_w_m2)

    def patch_ids(self, shape: Any, active: Any) -> Any:
        """Patch number of shape pointers (as unsigned integers); `mirror_id` for the mirror."""
        import drjit as dr

        return dr.gather(self._mi.UInt32, self._shape_ids, shape, active)

    def radiance(self, patch: Any, point: Any, direction: Any, active: Any, *, lamps: bool) -> Any:
        """Radiance, W/(m^2 sr), that a surface sends against rays of `direction` that hit it at `point` (scene, mm)."""
        import drjit as dr

        mi = self._mi
        active &= patch != self.mirror_id  # the mirror has no light of its own
        normal = dr.gather(mi.Vector3f, self._normal, patch, active)
        front = active & (dr.dot(normal, direction) < 0.0)
        offset = point - dr.gather(mi.Point3f, self._centre, patch, front)
        x = dr.dot(offset, dr.gather(mi.Vector3f, self._x_axis, patch, front))
        y = dr.dot(offset, dr.gather(mi.Vector3f, self._y_axis, patch, front))
        value = self._albedo(patch, x, y, front) * (dr.maximum(self._bilinear(patch, x, y, front), 0.0) / math.pi)
        if lamps:
            value += dr.gather(mi.Color3f, self._emission, patch, front)
        return dr.select(front, value, 0.0)

    def _bilinear(self, patch: Any, x: Any, y: Any, active: Any) -> Any:
        """Irradiance at a position in units of metres from the patch's centre."""
        import drjit as dr

        mi = self._mi
        size = dr.gather(mi.Vector2f, self._size, patch, active)
        columns = dr.gather(mi.UInt32, self._columns, patch, active)
        rows = dr.gather(mi.UInt32, self._rows, patch, active)
        fx = (x / size.x + 0.5) * mi.Float(columns) - 0.5
        fy = (y / size.y + 0.5) * mi.Float(rows) - 0.5
        ix = mi.UInt32(dr.clip(dr.floor(fx), 0.0, mi.Float(columns) - 2.0))
        iy = mi.UInt32(dr.clip(dr.floor(fy), 0.0, mi.Float(rows) - 2.0))
        tx, ty = fx - mi.Float(ix), fy - mi.Float(iy)
        first = dr.gather(mi.UInt32, self._start, patch, active) + iy * columns + ix
        corners = (first, first + 1, first + columns, first + columns + 1)
        a, b, c, d = (dr.gather(mi.Color3f, self._irradiance, index, active) for index in corners)
        return (1.0 - ty) * ((1.0 - tx) * a + tx * b) + ty * ((1.0 - tx) * c + tx * d)

    def _albedo(self, patch: Any, x: Any, y: Any, active: Any) -> Any:
        """The same function as `scenes.textures`, at a position in metres from the patch's centre."""
        import drjit as dr

        mi = self._mi
        cell, origin = (dr.gather(mi.Vector2f, table, patch, active) for table in (self._cell, self._origin))
        cells = dr.floor((x - origin.x) / cell.x) + dr.floor((y - origin.y) / cell.y)
        odd = cells - 2.0 * dr.floor(0.5 * cells) > 0.5
        even_albedo, odd_albedo = (dr.gather(mi.Color3f, t, patch, active) for t in (self._even, self._odd))
        return dr.select(odd, odd_albedo, even_albedo)

    def _registry(self, names: list[str]) -> Any:
        """Table from Dr.Jit's number of a shape to the patch number."""
        import drjit as dr

        mi = self._mi
        number = {name: i for i, name in enumerate(names)} | {MIRROR_NAME: self.mirror_id}
        pairs = [
            (int(np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)))[0]), number[shape.id()])
            for shape in self.scene.shapes()
        ]
        table = np.zeros(max(i for i, _ in pairs) + 1, dtype=np.uint32)
        for i, patch in pairs:
            table[i] = patch
        return mi.UInt32(table)

    def _tables(self) -> None:
        surfaces = [patch.surface for patch in self.patches]
        frames = [surface.T_world_shape for surface in surfaces]
        self._normal = self._floats([pose.R[:, 2] for pose in frames])
        self._x_axis, self._y_axis = (self._floats([pose.R[:, i] / MM_PER_M for pose in frames]) for i in (0, 1))
        self._centre = self._floats([MM_PER_M * (pose.t - self.view.sphere_centre_m) for pose in frames])
        self._size = self._floats([surface.size_m for surface in surfaces])
        self._columns, self._rows, self._start = (
            self._mi.UInt32(np.array([getattr(patch, name) for patch in self.patches], dtype=np.uint32))
            for name in ("columns", "rows", "start")
        )
        emission = [surface.radiance_w_m2_sr for surface in surfaces]
        self._emission = self._floats(emission)
        even, odd, cell, origin = zip(*(_texture(surface) for surface in surfaces), strict=True)
        self._even, self._odd, self._cell, self._origin = map(self._floats, (even, odd, cell, origin))

    def _floats(self, values: Any) -> Any:
        return self._mi.Float(np.ascontiguousarray(np.asarray(values, dtype=np.float32).ravel()))


def _texture(surface: Any) -> tuple[Any, Any, Any, Any]:
    """Albedo of even and odd cells, cell size, origin; lamps reflect nothing."""
    texture = surface.texture
    if surface.emits:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (_ENDLESS_M, _ENDLESS_M), (0.0, 0.0)
    if isinstance(texture, Checker):
        return texture.albedo_even, texture.albedo_odd, texture.cell_m, texture.origin_m
    return texture.albedo, texture.albedo, (_ENDLESS_M, _ENDLESS_M), (0.0, 0.0)
