"""Shading kernels (Dr.Jit): the camera's look into a room of texel patches, directly or by the mirror.

A patch is one rectangle; its texels form a grid of about `texel_m`, at least 2 x 2. The texels of all patches lie one
after the other in flat arrays, row by row (local y): a light map is an array of shape (N, 3). Albedo is kept out of the
map and multiplied in exactly, at the point of the hit. The map's irradiance is bilinear between texel centres and
linear beyond the outermost ones.

Rays that meet a mirror with a form error are solved in float64 by Newton's method on q(t) = |P|^2 - r(P / |P|)^2 along
the ray: first to its least value, which tells hit from miss, then from the parabola's zero to that of q. `ray_tracer`
answers the same question from values alone, `reflection_point` from the other side; tests compare the three.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.render.room.camera_plugin import MM_PER_M, sensor_dict
from phibench.render.room.scene import load_scene, mirror_dict, shape_dict
from phibench.scenes.frames import Array
from phibench.scenes.rig import View
from phibench.scenes.room import MIRROR_NAME
from phibench.scenes.shapes import Cuboid, Rectangle, Shape, faces
from phibench.scenes.textures import Checker

# Patches and their light map.


@dataclass(frozen=True)
class Patch:
    """One rectangle and its texel grid: `columns` along local x, `rows` along local y, texels from `start` on."""

    surface: Rectangle
    columns: int
    rows: int
    start: int

    @property
    def count(self) -> int:
        """Number of texels."""
        return self.columns * self.rows

    def centres_m(self) -> Array:
        """World points of the texel centres, shape (rows * columns, 3)."""
        x, y = ((np.arange(n) + 0.5) / n - 0.5 for n in (self.columns, self.rows))
        width, height = self.surface.size_m
        grid = np.stack(np.broadcast_arrays(width * x, height * y[:, None], 0.0), axis=-1)
        return self.surface.T_world_shape.points(grid.reshape(-1, 3))

    @property
    def normal(self) -> Array:
        """Unit normal, world frame, shape (3,)."""
        return self.surface.T_world_shape.R[:, 2]


def cut(shapes: Sequence[Shape], texel_m: float) -> tuple[Patch, ...]:
    """Patches of all faces of the shapes, in order; the index of a patch is its id in the Mitsuba scene."""
    patches, start = [], 0
    for shape in shapes:
        assert isinstance(shape, Rectangle | Cuboid)
        for surface in faces(shape):
            columns, rows = (max(2, math.ceil(length / texel_m)) for length in surface.size_m)
            patches.append(Patch(surface, columns, rows, start))
            start += columns * rows
    return tuple(patches)


def texel_count(patches: Sequence[Patch]) -> int:
    """Number of texels of all patches."""
    return sum(patch.count for patch in patches)


_ENDLESS_M = 1e3  # cells of a plain surface
_ALIGNMENT = 64  # bytes


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
        import drjit as dr

        self._mi, self.view, self.patches = mi, view, tuple(patches)
        entries: dict[str, Any] = {"type": "scene"}
        if camera:
            entries |= {"sensor": sensor_dict(mi, view), MIRROR_NAME: mirror_dict(mi, view)}
        names = {f"patch_{i:05d}": patch for i, patch in enumerate(patches)}
        entries |= {name: shape_dict(mi, view, patch.surface) for name, patch in names.items()}
        self.scene = load_scene(mi, entries)
        self.mirror_id = dr.opaque(mi.UInt32, len(patches))  # one kernel for all rooms
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
        number = {name: i for i, name in enumerate(names)} | {MIRROR_NAME: len(names)}
        pairs = [
            (int(np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)))[0]), number[shape.id()])
            for shape in self.scene.shapes()
        ]
        table = np.zeros(max(i for i, _ in pairs) + 1, dtype=np.uint32)
        for i, patch in pairs:
            table[i] = patch
        return mi.UInt32(aligned(table, np.uint32))

    def _tables(self) -> None:
        surfaces = [patch.surface for patch in self.patches]
        frames = [surface.T_world_shape for surface in surfaces]
        self._normal = self._floats([pose.R[:, 2] for pose in frames])
        self._x_axis, self._y_axis = (self._floats([pose.R[:, i] / MM_PER_M for pose in frames]) for i in (0, 1))
        self._centre = self._floats([MM_PER_M * (pose.t - self.view.sphere_centre_m) for pose in frames])
        self._size = self._floats([surface.size_m for surface in surfaces])
        self._columns, self._rows, self._start = (
            self._mi.UInt32(aligned([getattr(patch, name) for patch in self.patches], np.uint32))
            for name in ("columns", "rows", "start")
        )
        emission = [surface.radiance_w_m2_sr for surface in surfaces]
        self._emission = self._floats(emission)
        even, odd, cell, origin = zip(*(_texture(surface) for surface in surfaces), strict=True)
        self._even, self._odd, self._cell, self._origin = map(self._floats, (even, odd, cell, origin))

    def _floats(self, values: Any) -> Any:
        return self._mi.Float(aligned(values))


def _texture(surface: Any) -> tuple[Any, Any, Any, Any]:
    """Albedo of even and odd cells, cell size, origin; lamps reflect nothing."""
    texture = surface.texture
    if surface.emits:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (_ENDLESS_M, _ENDLESS_M), (0.0, 0.0)
    if isinstance(texture, Checker):
        return texture.albedo_even, texture.albedo_odd, texture.cell_m, texture.origin_m
    return texture.albedo, texture.albedo, (_ENDLESS_M, _ENDLESS_M), (0.0, 0.0)


# Mirror with a form error.


_LEAST_STEPS = 3
_STEPS = 5


def meet(mi: ModuleType, view: View, ray: Any) -> tuple[Any, Any, Any]:
    """First point of the mirror, its outward normal, and whether there is one, in scene coordinates (mm, float32).

    `ray` comes from outside, in the scene's coordinates: world axes, the sphere centre at the origin.
    """
    import drjit as dr

    V, axes = mi.Vector3d, view.T_world_sphere.R
    form = view.rig.mirror.form
    assert form is not None
    tensors = [MM_PER_M * tensor for tensor in form.tensors]
    radius = MM_PER_M * view.rig.mirror.radius_m
    o, d = (_turned(V, axes.T, V(vector)) for vector in (ray.o, ray.d))
    d = dr.normalize(d)
    foot = o - dr.dot(o, d) * d
    foot2 = dr.dot(foot, foot)
    central = foot2 < 0.25 * radius * radius  # certainly hits, and q is no parabola near the sphere's centre
    x = mi.Float64(0.0)
    for _ in range(_LEAST_STEPS):  # q'' is 2 but for the form
        _, slope = _q(V, foot, foot2, d, x, radius, tensors)
        x = dr.select(central, 0.0, x - 0.5 * slope)
    q, _ = _q(V, foot, foot2, d, x, radius, tensors)
    q = dr.select(central, foot2 - radius * radius, q)
    found = q < 0.0
    x = x - dr.sqrt(dr.maximum(-q, 0.0))
    for _ in range(_STEPS):
        q, slope = _q(V, foot, foot2, d, x, radius, tensors)
        x = dr.select(found, x - q / slope, x)
    P = foot + x * d
    rho = dr.norm(P)
    n = P / rho
    _, gradient = _added(V, n, tensors)
    normal = dr.normalize(n - gradient / rho)
    return mi.Point3f(_turned(V, axes, P)), mi.Vector3f(_turned(V, axes, normal)), found


def _q(V: Any, foot: Any, foot2: Any, d: Any, x: Any, radius: float, tensors: list[Array]) -> tuple[Any, Any]:
    """q and its derivative by the distance x from the foot."""
    import drjit as dr

    rho2 = foot2 + x * x
    rho = dr.sqrt(rho2)
    added, gradient = _added(V, (foot + x * d) / rho, tensors)
    r = radius + added
    return rho2 - r * r, 2.0 * x - 2.0 * r * dr.dot(gradient, d) / rho


def _added(V: Any, n: Any, tensors: list[Array]) -> tuple[Any, Any]:
    """Deviation of the radius in a unit direction, and its derivative along the unit sphere."""
    import drjit as dr

    Q, T = tensors
    q = _turned(V, Q, n)
    t = V(*(dr.dot(n, _turned(V, T[i], n)) for i in range(3)))
    along_q, along_t = dr.dot(q, n), dr.dot(t, n)
    return along_q + along_t, 2.0 * q + 3.0 * t - (2.0 * along_q + 3.0 * along_t) * n


def _turned(V: Any, matrix: Array, vector: Any) -> Any:
    """Matrix times vector."""
    rows = [[float(value) for value in row] for row in matrix]
    return V(*(row[0] * vector.x + row[1] * vector.y + row[2] * vector.z for row in rows))


# From film position and lens point to electrons.


_LIFT_MM = 0.01


def look(mi: ModuleType, surfaces: Surfaces, u: Any, v: Any, x: list[Any]) -> tuple[Any, Any]:
    """Electrons/s per square pixel at film positions (u, v), float64 pixels, and whether they see the mirror.

    `x` are uniform deviates: two for the lens point, and two for the facet of a rough mirror.
    """
    import drjit as dr

    sensor = surfaces.scene.sensors()[0]
    lens = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(x[0], x[1]))
    ray, weight = sensor.film_ray(u, v, lens)
    first = surfaces.scene.ray_intersect_preliminary(ray, coherent=True)
    first_patch = surfaces.patch_ids(_pointer(mi, first), first.is_valid())
    turned = first.is_valid() & (first_patch == surfaces.mirror_id)
    at_mirror = _meet_sphere if surfaces.view.rig.mirror.form is None else _meet_form
    mirrored, start, way, reflectance = at_mirror(mi, surfaces, ray, first.t, turned, x[2:])
    onward = mi.Ray3f(dr.select(turned, start, ray.o), dr.select(turned, way, ray.d))
    second = surfaces.scene.ray_intersect_preliminary(onward, coherent=False, active=turned)
    second_patch = surfaces.patch_ids(_pointer(mi, second), turned & second.is_valid())
    patch = dr.select(turned, second_patch, first_patch)
    hit = dr.select(turned, second.is_valid(), first.is_valid())
    place = onward(dr.select(turned, second.t, first.t))
    radiance = surfaces.radiance(patch, place, onward.d, hit, lamps=True)
    return weight * dr.select(mirrored, reflectance, 1.0) * radiance, mirrored


def _meet_sphere(mi: ModuleType, surfaces: Surfaces, ray: Any, t: Any, turned: Any, x: list[Any]) -> tuple[Any, ...]:
    """Rays at a sphere: hit or not, where and whereto they go on, and the part of their light that the mirror leaves.

    `t` is the distance to the scene's sphere for those rays that are `turned` there.
    """
    import drjit as dr

    point = ray(t)
    normal = dr.normalize(mi.Vector3f(point))  # the sphere's centre is the origin
    way, reflectance = _reflect(mi, surfaces, ray.d, normal, x)
    return turned, point + _LIFT_MM * normal, way, reflectance


def _meet_form(mi: ModuleType, surfaces: Surfaces, ray: Any, t: Any, turned: Any, x: list[Any]) -> tuple[Any, ...]:
    """As `_meet_sphere`, where the scene's sphere is only what encloses a mirror with a form error.

    A ray that misses the mirror goes straight on; all go on from where they leave the enclosing sphere.
    """
    import drjit as dr

    point, normal, found = meet(mi, surfaces.view, ray)
    mirrored = turned & found
    reflected, reflectance = _reflect(mi, surfaces, ray.d, normal, x)
    way = dr.select(mirrored, reflected, ray.d)
    start = dr.select(mirrored, point, ray(t))
    b = dr.dot(start, way)
    reach = MM_PER_M * surfaces.view.rig.mirror.bound_m + _LIFT_MM
    out = dr.sqrt(dr.maximum(b * b + reach * reach - dr.dot(start, start), 0.0)) - b
    return mirrored, start + out * way, way, reflectance


def _reflect(mi: ModuleType, surfaces: Surfaces, direction: Any, normal: Any, x: list[Any]) -> tuple[Any, Any]:
    """Mirror direction and reflectance of the three bands where the mirror has a normal."""
    import drjit as dr

    rig = surfaces.view.rig
    facet, shadowing = (normal, 1.0) if not x else _facet(mi, rig.mirror.roughness_alpha, normal, direction, x)
    cos = -dr.dot(direction, facet)
    way = direction + 2.0 * cos * facet
    bands = [rig.mirror.refractive_index(nm) for nm in rig.camera.detector.band_wavelength_nm]
    fresnel = [mi.fresnel_conductor(cos, mi.Complex2f(index.real, index.imag)) for index in bands]
    return way, shadowing * mi.Color3f(*fresnel)


def _facet(mi: ModuleType, alpha: float, normal: Any, direction: Any, x: list[Any]) -> tuple[Any, Any]:
    """Normal of a visible Beckmann facet, and Smith's masking of the way out (0 below the surface).

    Walter et al. (2007), with the visible normals of Heitz and d'Eon (2014): the weight is the masking alone.
    """
    import drjit as dr

    frame = mi.Frame3f(normal)
    facets = mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, alpha, True)
    towards = frame.to_local(-direction)
    facet, _ = facets.sample(towards, mi.Point2f(x[0], x[1]))
    out = 2.0 * dr.dot(towards, facet) * facet - towards
    return frame.to_world(facet), dr.select(out.z > 0.0, facets.smith_g1(out, facet), 0.0)


def _pointer(mi: ModuleType, hit: Any) -> Any:
    import drjit as dr

    return dr.reinterpret_array(mi.UInt32, hit.shape)
