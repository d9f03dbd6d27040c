"""Points of a room's texels as Dr.Jit arrays, for the kernels that gather their light."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from scipy import ndimage

from phibench.render.room.camera_plugin import MM_PER_M
from phibench.render.room.surfaces import Surfaces, aligned
from phibench.render.room.texel_grid import TexelGrid
from phibench.scenes.frames import Array, BoolArray

_LIFT_MM = 0.05  # rays start this far in front of their surface


@dataclass(frozen=True)
class Texels:
    """Points just in front of texels, and normals: Dr.Jit arrays and NumPy's (mm)."""

    grid: TexelGrid
    points: Any
    normals: Any
    points_mm: Array
    normals_world: Array
    coat: Any

    @staticmethod
    def of(mi: ModuleType, surfaces: Surfaces, grid: TexelGrid, first: int = 0) -> Texels:
        """Texels of a grid from a number on."""
        places, normals = (values[first:] for values in grid.points())
        starts = MM_PER_M * (places - surfaces.view.sphere_centre_m) + _LIFT_MM * normals
        columns = [[mi.Float(aligned(a[:, i])) for i in range(3)] for a in (starts, normals)]
        coat = mi.Float(aligned(grid.table.coat[grid.patch()[0][first:]])) if surfaces.has_coats else None
        return Texels(grid, mi.Point3f(*columns[0]), mi.Vector3f(*columns[1]), starts, normals, coat)

    def __len__(self) -> int:
        return len(self.points_mm)


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


def filled(values: Array, covered: BoolArray, grid: TexelGrid) -> Array:
    """Give covered texels the value of the nearest uncovered one of their grid, so that none leaks."""
    full = values.copy()
    for part, rows, columns in grid.grids():
        hidden = covered[part].reshape(rows, columns)
        if hidden.any() and not hidden.all():
            row, column = ndimage.distance_transform_edt(hidden, return_distances=False, return_indices=True)
            full[part] = values[part].reshape(rows, columns, 3)[row, column].reshape(-1, 3)
    return full


def chosen(mi: ModuleType, texels: Texels, lanes: Any) -> tuple[Any, Any, Any]:
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
