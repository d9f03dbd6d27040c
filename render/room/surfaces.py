"""Room in Mitsuba: one mesh of all faces, and tables of the radiance that they send by texture, irradiance and coat.

All triangles are one mesh: Embree answers a query five times as fast as with a shape for every face. What a kernel
needs of a face lies in one row of 32 numbers, read in groups of four. The albedo is looked up exactly, at the point of
the hit, or lies in the row where it is the same all over a face. The irradiance is bilinear between texel centres and
linear beyond the outermost ones.

A coat is a smooth dielectric over a diffuse ground (Mitsuba's `plastic`, nonlinear). With F the Fresnel reflectance
outside and f the diffuse one inside, the ground of albedo a sends out
(1 - F(theta_o)) / n^2 a / (1 - a f) E' / pi, where E' is the irradiance weighted by 1 - F(theta_i). The coat itself
mirrors F of what comes from the mirrored direction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.render.optics.faces import FaceTable, IntArray, TexelGrid
from phibench.render.room.camera_plugin import MM_PER_M
from phibench.scenes.frames import Array
from phibench.scenes.rig import View
from phibench.scenes.shapes import Bitmap, Checker, Texture

_ALIGNMENT = 64  # bytes
_ROW = 8  # groups of four numbers
_LARGEST = 1 << 24  # whole numbers that float32 holds exactly
_SCREEN_M2 = 4.0
_LIFT_MM = 0.05  # mirrored rays start this far in front of a coat


def aligned(values: Any, dtype: type[np.generic] = np.float32) -> NDArray[Any]:
    """Flat copy of an array at an address that is a multiple of 64 bytes.

    Dr.Jit takes NumPy's memory as it is, and its kernels depend on the alignment of what they read. NumPy's varies by
    chance from array to array: kernels would be compiled anew for most of them, 0.03 to 0.13 s each.
    """
    flat = np.asarray(values, dtype=dtype).ravel()
    memory = np.empty(flat.nbytes + _ALIGNMENT, dtype=np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT
    copy = memory[start : start + flat.nbytes].view(dtype)
    copy[:] = flat
    return copy


def colour_planes(colour: Any) -> NDArray[np.float32]:
    """Numbers of a colour, shape (3, n), that were evaluated; Dr.Jit's own way compiles a kernel for each n."""
    result = np.empty((3, len(colour[0])), dtype=np.float32)
    for plane, values in zip(result, colour, strict=True):
        plane[:] = np.asarray(values)
    return result


@dataclass(frozen=True)
class LookUp:
    """Light that faces send out, as a function of the irradiance: Dr.Jit arrays.

    Attributes
    ----------
    first, across : unsigned integers
        First of four texels around the point, and texels in a row.
    tx, ty : floats
        Place between them, texels.
    factor, emitted : colours
        The radiance is factor times irradiance, plus what is emitted.
    active : masks
    """

    first: Any
    across: Any
    tx: Any
    ty: Any
    factor: Any
    emitted: Any
    active: Any

    def nearest(self) -> Any:
        """Texel around the point."""
        import drjit as dr

        return self.first + dr.select(self.tx < 0.5, 0, 1) + dr.select(self.ty < 0.5, 0, self.across)


class Surfaces:
    """A Mitsuba scene of faces, with tables that answer look-ups.

    Parameters
    ----------
    mi : module
        Mitsuba with its variant set.
    view : View
        The scene's origin is its sphere centre.

    Attributes
    ----------
    is_lamp : bool array, shape (patches,)
        Lamps, and screens, which are sampled like them.
    """

    def __init__(self, mi: ModuleType, view: View, table: FaceTable) -> None:
        self._mi, self.view, self.table = mi, view, table
        self.is_lamp = table.emits | _screens(table)
        self.has_coats = bool((table.coat > 0.0).any())
        self.corners_mm = (MM_PER_M * (table.corners_m - view.sphere_centre_m)).astype(np.float32)
        self.scene = load_scene(mi, {"type": "scene", "room": self._mesh()})
        self._patch = mi.UInt32(aligned(table.patch, np.uint32))
        self._texels, self._places = self._textures()
        self._inside = mi.Float(aligned(_inside_reflectance(mi, table.coat))) if self.has_coats else None
        self._grid: TexelGrid | None = None

    def cross_the_way(self) -> bool:
        """True if a face may stand between the lens and the mirror: their common box meets a triangle's."""
        view, corners = self.view, self.corners_mm
        reach_mm = MM_PER_M * view.rig.mirror.bound_m
        lens = MM_PER_M * (view.camera_centre_m - view.sphere_centre_m)
        rim_mm = MM_PER_M * view.rig.camera.aperture_radius_m
        axis = view.T_world_camera.R[:, 2]
        tilted = rim_mm * np.sqrt(np.maximum(1.0 - axis**2, 0.0))  # half extents of the lens's disc
        low, high = np.minimum(lens - tilted, -reach_mm), np.maximum(lens + tilted, reach_mm)
        return bool(np.all((corners.max(axis=1) > low) & (corners.min(axis=1) < high), axis=1).any())

    def set_light(self, grid: TexelGrid, irradiance_w_m2: NDArray[np.floating]) -> None:
        """Give the texels of a grid their irradiance, shape (texels, 3), W/m^2."""
        # four more texels, of pi: with them a texture of radiance is what its surface sends out
        padded = np.full((grid.count + 4, 4), math.pi, dtype=np.float32)
        padded[: grid.count, :3] = irradiance_w_m2
        self._irradiance = self._mi.Float(aligned(padded))
        if grid is not self._grid:
            self._grid, self._rows = grid, self._mi.Float(aligned(self._row_table(grid)))

    def hit(self, ray: Any, active: Any = True, *, coherent: bool = True) -> tuple[Any, Any, Any]:
        """Distance (mm) and patch of the first face along rays, and whether there is one.

        `coherent` lets Embree take 16 rays at a time: 4 times faster for a camera, 1.7 times slower for scattered rays.
        """
        import drjit as dr

        found = self.scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
        valid = active & found.is_valid()
        return found.t, dr.gather(self._mi.UInt32, self._patch, found.prim_index, valid), valid

    def first_patch(self, origins_m: Array, directions: Array) -> IntArray:
        """Patch that each ray meets first, to float32, -1 for none: world rays, shape (N, 3); a `Finder`."""
        import drjit as dr

        mi = self._mi
        places = MM_PER_M * (origins_m - self.view.sphere_centre_m)
        o, d = (mi.Vector3f(*(mi.Float(aligned(a[:, i])) for i in range(3))) for a in (places, directions))
        _, patch, valid = self.hit(mi.Ray3f(mi.Point3f(o), d))
        return np.array(dr.select(valid, mi.Int32(patch), -1), dtype=np.int64)

    def radiance(self, patch: Any, point: Any, direction: Any, active: Any, *, lamps: bool) -> Any:
        """Radiance, W/(m^2 sr), that faces send against rays of `direction` that hit them at `point` (scene, mm).

        With coats, what they mirror is part of it: one more bounce, to what the mirrored ray meets.
        """
        import drjit as dr

        value = self.light(self.ground(patch, point, direction, active, lamps))
        if not self.has_coats:
            return value
        onward, coated, mirrored = self.mirrored(patch, point, direction, active)

        def beyond(start: Any, way: Any, part: Any) -> Any:
            ray = self._mi.Ray3f(start, way)
            t, other, valid = self.hit(ray)
            return part * self.light(self.ground(other, ray(t), way, valid, True))

        # most lanes of a kernel meet no coat: it leaves out what none of those that run together needs
        start = onward.o, onward.d, mirrored
        return value + dr.if_stmt(start, coated, beyond, lambda *_: dr.zeros(self._mi.Color3f))

    def mirrored(self, patch: Any, point: Any, direction: Any, active: Any) -> tuple[Any, Any, Any]:
        """Rays that coats mirror, where there is a coat, and its reflectance."""
        import drjit as dr

        mi = self._mi
        plane = dr.gather(mi.Vector4f, self._rows, patch * _ROW, active)
        side = mi.Vector3f(plane.x, plane.y, plane.z)
        normal = dr.select(dr.dot(side, direction) < 0.0, side, -side)
        cos = -dr.dot(normal, direction)
        coated = active & (plane.w > 0.0) & (cos > 0.0)
        onward = mi.Ray3f(point + _LIFT_MM * normal, direction + 2.0 * cos * normal)
        return onward, coated, self.reflectance(cos, plane.w)

    def cosine(self, patch: Any, direction: Any) -> Any:
        """Size of the cosine between directions and the normals of patches."""
        import drjit as dr

        plane = dr.gather(self._mi.Vector4f, self._rows, patch * _ROW)
        return dr.abs(dr.dot(self._mi.Vector3f(plane.x, plane.y, plane.z), direction))

    def entering(self, patch: Any, direction: Any) -> Any:
        """Part of light of a direction that the coats of patches let in; 1 where there is none."""
        import drjit as dr

        plane = dr.gather(self._mi.Vector4f, self._rows, patch * _ROW)
        cos = dr.abs(dr.dot(self._mi.Vector3f(plane.x, plane.y, plane.z), direction))
        return dr.select(plane.w > 0.0, 1.0 - self.reflectance(cos, dr.maximum(plane.w, 1.0)), 1.0)

    def mean_albedo(self) -> Array:
        """Albedo of each patch, mean of its texture and of the bands, shape (P,)."""
        means = [image[..., :3].mean() for image, _ in map(_image, self.table.textures)]
        return np.array([*means, 0.0])[np.where(self.table.emits, len(means), self.table.texture)]

    def emission(self, patch: Any, point: Any) -> Any:
        """Radiance of lamps and screens at points on them (scene, mm)."""
        import drjit as dr

        mi = self._mi
        texture, light = (dr.gather(mi.Vector4f, self._rows, patch * _ROW + k) for k in (6, 7))
        return self._albedo(patch, point, texture, mi.Bool(True)) * mi.Color3f(light.x, light.y, light.z)

    def reflectance(self, cos: Any, coat: Any) -> Any:
        """Fresnel reflectance of a coat from outside, for the cosine of the angle to its normal."""
        return self._mi.fresnel(cos, coat)[0]

    def ground(self, patch: Any, point: Any, direction: Any, active: Any, lamps: Any) -> LookUp:
        """Light of a face without what its coat mirrors; `lamps` says whether what it emits counts."""
        import drjit as dr

        mi = self._mi
        plane, grid, along_x, along_y, texture, light = (
            dr.gather(mi.Vector4f, self._rows, patch * _ROW + k, active) for k in (0, 1, 2, 3, 6, 7)
        )
        cos = dr.dot(mi.Vector3f(plane.x, plane.y, plane.z), direction)
        front = cos < 0.0
        start = dr.select(front, grid.z, grid.w)
        seen = active & (start >= 0.0)
        fx, fy = (_affine(dr, group, point) for group in (along_x, along_y))
        albedo = self._albedo(patch, point, texture, seen)
        if self.has_coats:
            albedo = self._coated(patch, albedo, dr.abs(cos), plane.w, seen)
        emitted = dr.select(seen & front & lamps, albedo * mi.Color3f(light.x, light.y, light.z), 0.0)
        low_x, low_y = dr.clip(dr.floor(fx), 0.0, grid.x - 2.0), dr.clip(dr.floor(fy), 0.0, grid.y - 2.0)
        across = mi.UInt32(grid.x)
        first = mi.UInt32(start) + mi.UInt32(low_y) * across + mi.UInt32(low_x)
        factor = dr.select(seen, albedo * (light.w / math.pi), 0.0)
        return LookUp(dr.select(seen, first, 0), across, fx - low_x, fy - low_y, factor, emitted, seen)

    def light(self, found: LookUp) -> Any:
        """Radiance of what was looked up, by the present irradiance."""
        import drjit as dr

        first, across = found.first, found.across
        corners = (first, first + 1, first + across, first + across + 1)
        irradiance = self._blend(self._irradiance, corners, found.tx, found.ty, found.active)
        # rays that meet nothing have no place: what is computed there may be no number
        return dr.select(found.active, found.factor * dr.maximum(irradiance, 0.0) + found.emitted, 0.0)

    def irradiance(self, texel: Any) -> Any:
        """Present irradiance of texels."""
        import drjit as dr

        found = dr.gather(self._mi.Vector4f, self._irradiance, texel)
        return self._mi.Color3f(found.x, found.y, found.z)

    def _albedo(self, patch: Any, point: Any, texture: Any, active: Any) -> Any:
        """Albedo of faces at a point; `texture` is that of a row, which `_textures` explains."""
        import drjit as dr

        mi = self._mi

        def looked_up(patch: Any, point: Any, texture: Any) -> Any:
            column, row = (dr.gather(mi.Vector4f, self._rows, patch * _ROW + k) for k in (4, 5))
            return self._texel(_affine(dr, column, point), _affine(dr, row, point), texture)

        # most faces are plain: a kernel leaves the rest out where all lanes that run together meet such
        pictured = active & (texture.w >= 0.0)
        return dr.if_stmt(
            (patch, point, texture), pictured, looked_up, lambda _, __, plain: mi.Color3f(plain.x, plain.y, plain.z)
        )

    def _texel(self, s: Any, t: Any, texture: Any) -> Any:
        """Value of a texture at a place in its own units."""
        import drjit as dr

        mi = self._mi
        width, height, start, half = texture.x, texture.y, mi.UInt32(texture.z), texture.w
        smooth = half > 0.0
        s, t = s - half, t - half
        low_s, low_t = dr.floor(s), dr.floor(t)
        ts, tt = dr.select(smooth, s - low_s, 0.0), dr.select(smooth, t - low_t, 0.0)
        i, j = low_s - width * dr.floor(low_s / width), low_t - height * dr.floor(low_t / height)
        i, j = dr.clip(i, 0.0, width - 1.0), dr.clip(j, 0.0, height - 1.0)  # i = width by rounding
        i1, j1 = dr.select(i + 1.0 < width, i + 1.0, 0.0), dr.select(j + 1.0 < height, j + 1.0, 0.0)
        i, i1, j, j1, across = (mi.UInt32(value) for value in (i, i1, j, j1, width))
        corners = (start + j * across + i, start + j * across + i1, start + j1 * across + i, start + j1 * across + i1)
        return self._blend(self._texels, corners, ts, tt, True)

    def _blend(self, table: Any, corners: tuple[Any, ...], tx: Any, ty: Any, active: Any) -> Any:
        import drjit as dr

        a, b, c, d = (dr.gather(self._mi.Vector4f, table, index, active) for index in corners)
        mixed = (1.0 - ty) * ((1.0 - tx) * a + tx * b) + ty * ((1.0 - tx) * c + tx * d)
        return self._mi.Color3f(mixed.x, mixed.y, mixed.z)

    def _coated(self, patch: Any, albedo: Any, cos: Any, coat: Any, active: Any) -> Any:
        """Albedo of a ground below its coat, seen at an angle; the albedo itself where there is none."""
        import drjit as dr

        inside = dr.gather(self._mi.Float, self._inside, patch, active)
        below = albedo / (1.0 - albedo * inside) * ((1.0 - self.reflectance(cos, coat)) / dr.square(coat))
        return dr.select(coat > 0.0, below, albedo)

    def _mesh(self) -> Any:
        mi, corners = self._mi, self.corners_mm
        mesh = mi.Mesh("room", 3 * len(corners), len(corners))
        buffers = mi.traverse(mesh)
        buffers["vertex_positions"] = mi.Float(aligned(corners))
        buffers["faces"] = mi.UInt32(aligned(np.arange(3 * len(corners)), np.uint32))
        buffers.update()
        return mesh

    def _textures(self) -> tuple[Any, Array]:
        """Texels of all textures, four numbers each; four numbers of each texture, and of a white one after them.

        These are width, height, start, and 0.5 if it is smooth, 0 if its cells are plain. Of a texture that is the same
        all over they are its albedo, and -1.
        """
        images = [_image(texture) for texture in self.table.textures]
        starts = np.cumsum([0, *(image.shape[0] * image.shape[1] for image, _ in images)])
        if starts[-1] >= _LARGEST:
            raise ValueError(f"the room's textures have {starts[-1]} texels, {_LARGEST} or more")
        numbers = [
            (*image[0, 0, :3], -1.0) if image.shape[:2] == (1, 1) and not half else (*image.shape[1::-1], start, half)
            for (image, half), start in zip(images, starts[:-1], strict=True)
        ]
        texels = np.concatenate([*(image.reshape(-1, 4) for image, _ in images), np.ones((1, 4))])
        return self._mi.Float(aligned(texels)), np.array([*numbers, (1.0, 1.0, 1.0, -1.0)])

    def _row_table(self, grid: TexelGrid) -> Array:
        """Rows of all patches, shape (P, 8, 4); see `ground`."""
        table = self.table
        count = len(table.size_m)
        rows = np.zeros((count, _ROW, 4))
        rows[:, 0] = np.concatenate([table.normal, table.coat[:, None]], axis=1)
        own = grid.columns > 0
        rows[:, 1] = np.where(
            own[:, None], np.stack([grid.columns, grid.rows, grid.start, grid.back], axis=1), (2, 2, grid.count, -1)
        )
        assert grid.count + 4 < _LARGEST, "float32 must hold the texels' numbers"
        centre = MM_PER_M * (table.centre_m - self.view.sphere_centre_m)
        axes = np.stack([table.x_axis, table.y_axis], axis=1) / MM_PER_M
        metres = np.concatenate([axes, -np.einsum("pij,pj->pi", axes, centre)[..., None]], axis=2)  # (P, 2, 4)
        texels = np.where(own[:, None], np.stack([grid.columns, grid.rows], axis=1), 2) / table.size_m
        rows[:, 2:4] = texels[..., None] * metres
        rows[:, 2:4, 3] += 0.5 * np.where(own[:, None], np.stack([grid.columns, grid.rows], axis=1), 2) - 0.5
        rows[:, 4:6] = np.einsum("pij,pjk->pik", table.texels[..., :2], metres)
        rows[:, 4:6, 3] += table.texels[..., 2]
        rows[:, 6] = self._places[np.where(table.emits, len(table.textures), table.texture)]
        rows[:, 7, :3] = np.where(table.emits[:, None], table.radiance_w_m2_sr, self.is_lamp[:, None])
        rows[:, 7, 3] = np.where(self.is_lamp, 0.0, 1.0)
        return rows


def _screens(table: FaceTable) -> NDArray[np.bool_]:
    """Single faces that shine by their texture and are small: chance would rarely meet them."""
    single = np.bincount(table.shape)[table.shape] == 1 if len(table.shape) else np.zeros(0, dtype=bool)
    return np.asarray(table.is_radiance & single & (table.size_m.prod(axis=1) <= _SCREEN_M2))


def _affine(dr: ModuleType, group: Any, point: Any) -> Any:
    return dr.fma(group.x, point.x, dr.fma(group.y, point.y, dr.fma(group.z, point.z, group.w)))


def _image(texture: Texture) -> tuple[Array, float]:
    """Texels of a texture, shape (rows, columns, 4), and half a texel if it is smooth, 0 if its cells are plain."""
    if isinstance(texture, Bitmap):
        return texture.values.astype(float), 0.5
    if isinstance(texture, Checker):
        even, odd = (np.array([*albedo, albedo[0]]) for albedo in (texture.albedo_even, texture.albedo_odd))
        return np.array([[even, odd], [odd, even]]), 0.0
    return np.array([[[*texture.albedo, texture.albedo[0]]]]), 0.0


def _inside_reflectance(mi: ModuleType, coats: Array) -> Array:
    """Diffuse reflectance of coats from inside, by patch; 0 where there is none."""
    values = {
        coat: mi.fresnel_diffuse_reflectance(1.0 / coat) if coat > 0.0 else 0.0 for coat in set(map(float, coats))
    }
    return np.array([float(np.array(values[float(coat)]).ravel()[0]) if coat > 0.0 else 0.0 for coat in coats])


def load_scene(mi: ModuleType, scene: dict[str, Any]) -> Any:
    """Load a scene dictionary so that lamps keep their order, and runs their bits.

    Mitsuba's scene optimisation merges meshes and materials in an order that differs between loads.
    """
    return mi.load_dict(scene, parallel=False, optimize=False)
