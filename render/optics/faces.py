"""Faces of shapes as arrays: planes with their own coordinates, triangles that fill them, and grids of their texels.

A patch is a plane face: a rectangle, the end of a prism, a triangle of a mesh. Its local coordinates are metres from
its centre along two unit axes; its size is that of the rectangle around it. Triangles name the patch that they lie on.
Ray tracers, light maps and the renderer read this one table.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from phibench.scenes.frames import Array, Pose
from phibench.scenes.shapes import Bitmap, Checker, Cuboid, Mesh, Prism, Rectangle, Shape, Texture, faces

IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class FaceTable:
    """P patches and T triangles of some shapes, world frame.

    Attributes
    ----------
    centre_m, x_axis, y_axis : arrays, shape (P, 3)
        Middle of the rectangle around a patch and its unit axes; the normal is their cross product.
    size_m : array, shape (P, 2)
    shape : int array, shape (P,)
        Index of the shape.
    texture : int array, shape (P,)
        Index in `textures`.
    textures : tuple of textures
    texels : array, shape (P, 2, 3)
        Place on the texture (column, row) of a local position (x, y, 1): cells of a checker, texels of a bitmap.
    radiance_w_m2_sr : array, shape (P, 3)
        Of lamps.
    coat : array, shape (P,)
    two_sided, window : bool arrays, shape (P,)
    corners_m : array, shape (T, 3, 3)
    patch : int array, shape (T,)
        Patch of each triangle; the triangles of a patch follow each other, in the order of the patches.
    """

    centre_m: Array
    x_axis: Array
    y_axis: Array
    size_m: Array
    shape: IntArray
    texture: IntArray
    textures: tuple[Texture, ...]
    texels: Array
    radiance_w_m2_sr: Array
    coat: Array
    two_sided: NDArray[np.bool_]
    window: NDArray[np.bool_]
    corners_m: Array
    patch: IntArray

    @cached_property
    def normal(self) -> Array:
        """Unit normals of the patches, shape (P, 3)."""
        return np.cross(self.x_axis, self.y_axis)

    @property
    def emits(self) -> NDArray[np.bool_]:
        """Patches that are lamps, shape (P,)."""
        return np.asarray((self.radiance_w_m2_sr > 0.0).any(axis=1))

    @cached_property
    def is_radiance(self) -> NDArray[np.bool_]:
        """Patches whose texture is their own light, shape (P,)."""
        shining = [isinstance(texture, Bitmap) and texture.is_radiance for texture in self.textures]
        return np.array(shining, dtype=bool)[self.texture]

    def local_m(self, patch: IntArray, points_m: Array) -> Array:
        """Local coordinates, shape (N, 2), of world points (N, 3) on patches (N,)."""
        offset = points_m - self.centre_m[patch]
        return np.stack([np.einsum("ni,ni->n", offset, axis[patch]) for axis in (self.x_axis, self.y_axis)], axis=-1)

    def places(self, patch: IntArray, points_m: Array) -> Array:
        """Places on the textures (column, row), shape (N, 2), of world points (N, 3) on patches (N,)."""
        local = np.concatenate([self.local_m(patch, points_m), np.ones((len(patch), 1))], axis=-1)
        return np.asarray(np.einsum("nij,nj->ni", self.texels[patch], local))

    def laser_albedo(self, patch: IntArray, points_m: Array) -> Array:
        """Albedo at the laser's wavelength, shape (N,), of world points (N, 3) on patches (N,); 0 on a lamp.

        A surface that shines by its texture has the albedo of its bitmap: a photographed wall carries a spot.
        """
        place = self.places(patch, points_m)
        albedo = np.zeros(len(patch))
        for number in np.unique(self.texture[patch]):
            mine = self.texture[patch] == number
            albedo[mine] = _laser_albedo(self.textures[number], place[mine])
        return np.where(self.emits[patch], 0.0, albedo)


def _laser_albedo(texture: Texture, place: Array) -> Array:
    """Laser albedo at places in the texture's own units (cells or texels)."""
    if isinstance(texture, Checker):
        odd = np.mod(np.floor(place).sum(axis=-1), 2.0) > 0.5
        return np.where(odd, texture.albedo_odd[0], texture.albedo_even[0])
    if isinstance(texture, Bitmap):
        return texture.laser_albedo(place * np.array(texture.texel_m) + np.array(texture.origin_m))
    return texture.laser_albedo(place)


def face_table(shapes: Sequence[Shape]) -> FaceTable:
    """All faces of some shapes, in their order; the sides of a solid as in `shapes.faces`, those of a prism around."""
    return joined_tables([_table(shape) for shape in shapes], [1] * len(shapes))


def joined_tables(tables: Sequence[FaceTable], shapes: Sequence[int]) -> FaceTable:
    """One table of several, one after the other; `shapes` are the numbers of shapes that they stand for."""
    if not tables:
        return _empty()
    # by identity: comparing contents would take longer than it saves
    kept = {id(texture): texture for table in tables for texture in table.textures}
    places = {key: number for number, key in enumerate(kept)}
    counts = [len(table.shape) for table in tables]
    columns = {name: np.concatenate([getattr(table, name) for table in tables]) for name in _COLUMNS}
    columns["shape"] = columns["shape"] + np.repeat(_firsts(shapes), counts)
    own = [
        np.array([places[id(texture)] for texture in table.textures], dtype=np.int64)[table.texture] for table in tables
    ]
    firsts = np.repeat(_firsts(counts), [len(table.patch) for table in tables])
    columns |= {"texture": np.concatenate(own), "patch": columns["patch"] + firsts}
    return FaceTable(**columns, textures=tuple(kept.values()))


def _firsts(counts: Sequence[int]) -> IntArray:
    """Number of the first of each of some groups."""
    return np.array([0, *np.cumsum(counts)[:-1]], dtype=np.int64)


_COLUMNS = tuple(name for name in FaceTable.__dataclass_fields__ if name != "textures")


def _empty() -> FaceTable:
    n3, none, flags = np.empty((0, 3)), np.empty(0, dtype=np.int64), np.empty(0, dtype=bool)
    places = (n3, n3, n3, np.empty((0, 2)), none, none, (), np.empty((0, 2, 3)))
    return FaceTable(*places, n3, np.empty(0), flags, flags, np.empty((0, 3, 3)), none)


def _table(shape: Shape) -> FaceTable:
    """Table of one shape."""
    if isinstance(shape, Mesh):
        centre, x, y, size, texels, corners, patch = _mesh_faces(shape)
    elif isinstance(shape, Prism):
        centre, x, y, size, texels, corners, patch = _prism_faces(shape)
    else:
        centre, x, y, size, texels, corners, patch = _flat_faces(shape)
    count = len(size)
    still = np.zeros(count, dtype=np.int64)
    radiance = shape.radiance_w_m2_sr if isinstance(shape, Rectangle) else (0.0, 0.0, 0.0)
    return FaceTable(
        *(centre, x, y, size, still, still, (shape.texture,), texels),
        radiance_w_m2_sr=np.tile(np.array(radiance, dtype=float), (count, 1)),
        coat=np.full(count, shape.coat),
        two_sided=np.full(count, isinstance(shape, Mesh) and shape.two_sided),
        window=np.full(count, isinstance(shape, Rectangle) and shape.window),
        corners_m=corners,
        patch=patch,
    )


_Faces = tuple[Array, Array, Array, Array, Array, Array, IntArray]
_SQUARE = 0.5 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
_HALVES = np.array([[0, 1, 2], [0, 2, 3]])  # corners of a rectangle's two triangles


def _flat_faces(shape: Rectangle | Cuboid) -> _Faces:
    pose, size = shape.T_world_shape, np.array(shape.size_m)
    if isinstance(shape, Rectangle):
        centre, axes, size = pose.t[None], pose.R[None], size[None]
    else:  # as in `shapes.faces`, which takes thirty times as long
        turns = _side_turns()
        centre, axes = pose.points(0.5 * turns[:, :, 2] * size), pose.R @ turns
        size = (np.abs(np.swapaxes(turns, 1, 2)) @ size)[:, :2]
    texels = np.tile(_metric(shape.texture), (len(centre), 1, 1))
    return _rectangles(centre, axes[:, :, 0], axes[:, :, 1], size, texels)


@cache
def _side_turns() -> Array:
    """Axes of the sides of a cuboid as columns, shape (6, 3, 3); the last one is the normal."""
    return np.array([side.T_world_shape.R for side in faces(Cuboid("", Pose("world", "shape"), (1.0, 1.0, 1.0)))])


def _rectangles(centre: Array, x: Array, y: Array, size: Array, texels: Array) -> _Faces:
    """Two triangles for each."""
    place = _SQUARE * size[:, None]
    corners = centre[:, None] + place[..., :1] * x[:, None] + place[..., 1:] * y[:, None]
    return centre, x, y, size, texels, corners[:, _HALVES].reshape(-1, 3, 3), np.repeat(np.arange(len(size)), 2)


def _metric(texture: Texture) -> Array:
    """Place on a texture of local metres, shape (2, 3)."""
    if isinstance(texture, Checker):
        step, origin = np.array(texture.cell_m), np.array(texture.origin_m)
    elif isinstance(texture, Bitmap):
        step, origin = np.array(texture.texel_m), np.array(texture.origin_m)
    else:
        return np.zeros((2, 3))
    return np.concatenate([np.diag(1.0 / step), (-origin / step)[:, None]], axis=1)


def _prism_faces(shape: Prism) -> _Faces:
    pose, base, n = shape.T_world_shape, shape.corners_m(), shape.sides
    ends, half = np.roll(base, -1, axis=0), 0.5 * shape.height_m
    chord = ends - base
    width = np.linalg.norm(chord, axis=1)
    middle = np.concatenate([0.5 * (base + ends), np.zeros((n, 1))], axis=1)
    across = np.concatenate([chord / width[:, None], np.zeros((n, 1))], axis=1)
    metric = _metric(shape.texture)
    around = np.tile(metric, (n, 1, 1))  # x runs on from side to side
    around[:, :, 2] += metric[:, 0] * (width * (np.arange(n) + 0.5))[:, None]
    size = np.stack([width, np.full(n, shape.height_m)], axis=1)
    up = np.tile([0.0, 0.0, 1.0], (n, 1))
    sides = _rectangles(pose.points(middle), pose.directions(across), pose.directions(up), size, around)
    corners, patches = [sides[5]], [sides[6]]
    frames = []
    for number, (sign, ring) in enumerate(((1.0, base), (-1.0, base[::-1]))):
        rim = np.concatenate([ring, np.full((n, 1), sign * half)], axis=1)
        centre = np.array([0.0, 0.0, sign * half])
        fan = np.stack([np.broadcast_to(centre, rim.shape), rim, np.roll(rim, -1, axis=0)], axis=1)
        corners.append(pose.points(fan.reshape(-1, 3)).reshape(-1, 3, 3))
        patches.append(np.full(n, n + number))
        frames.append((centre, np.array([1.0, 0.0, 0.0]), np.array([0.0, sign, 0.0])))
    centres, x, y = (np.array([frame[i] for frame in frames]) for i in range(3))
    return (
        np.concatenate([sides[0], pose.points(centres)]),
        np.concatenate([sides[1], pose.directions(x)]),
        np.concatenate([sides[2], pose.directions(y)]),
        np.concatenate([sides[3], np.full((2, 2), 2.0 * shape.radius_m)]),
        np.concatenate([sides[4], np.tile(metric, (2, 1, 1))]),
        np.concatenate(corners),
        np.concatenate(patches),
    )


def _mesh_faces(shape: Mesh) -> _Faces:
    """A patch for each triangle; x lies along its first side. Triangles without an area are left out."""
    corners = shape.vertices_m[shape.triangles]
    along, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(along, other)
    double_area, length = np.linalg.norm(normal, axis=1), np.linalg.norm(along, axis=1)
    whole = double_area > 1e-12 * np.maximum(length, np.linalg.norm(other, axis=1)) ** 2  # a triangle without a plane
    corners, along, normal = corners[whole], along[whole], normal[whole]
    x = along / length[whole, None]
    y = np.cross(normal / double_area[whole, None], x)
    local = np.stack([np.einsum("nki,ni->nk", corners - corners[:, :1], axis) for axis in (x, y)], axis=-1)
    low, high = local.min(axis=1), local.max(axis=1)
    middle = 0.5 * (low + high)
    centre = corners[:, 0] + middle[:, :1] * x + middle[:, 1:] * y
    texels = np.zeros((len(corners), 2, 3))
    if isinstance(shape.texture, Bitmap):
        place = np.concatenate([local - middle[:, None], np.ones((*local.shape[:2], 1))], axis=-1)
        assert shape.corner_texels is not None
        texels = np.swapaxes(np.linalg.solve(place, shape.corner_texels[whole]), 1, 2)
    return centre, x, y, high - low, texels, corners, np.arange(len(corners))


# Texels of a room's faces: the grid of each patch, and the places where its irradiance is computed.
#
# The texels of all patches lie one after the other in flat arrays, row by row (local y): a light map is an array of
# shape (N, 3). A patch has at least 2 x 2 texels, spread over the rectangle around it. Two-sided patches have two
# grids, front and back. Lamps and faces that shine by their texture have none.


_ACROSS, _FINEST_M = 8.0, 0.05  # texels across a small face, and their least size


def texel_sizes_m(table: FaceTable, texel_m: float) -> Array:
    """Sizes of the texels of patches, shape (P,): `texel_m` on large faces.

    Smaller ones, where shadows of near things count for more, get eight texels across, down to half the size, or 5 cm
    if that is more. Strips narrower than a texel would gain nothing.
    """
    short, finest = table.size_m.min(axis=1, initial=np.inf), min(texel_m, max(0.5 * texel_m, _FINEST_M))
    return np.where(short < texel_m, texel_m, np.clip(short / _ACROSS, finest, texel_m))


@dataclass(frozen=True, eq=False)
class TexelGrid:
    """Texel grids of the patches of a table.

    Attributes
    ----------
    columns, rows : int arrays, shape (P,)
        Along local x and y; 0 where there is no grid.
    start : int array, shape (P,)
        First texel of a patch's front.
    """

    table: FaceTable
    columns: IntArray
    rows: IntArray
    start: IntArray

    @classmethod
    def of(cls, table: FaceTable, texel_m: float | Array) -> TexelGrid:
        """Grid with texels of at most `texel_m`: sizes of patches, shape (P,), or one for `texel_sizes_m`."""
        if np.ndim(texel_m) == 0:
            texel_m = texel_sizes_m(table, float(texel_m))
        sides = np.maximum(np.ceil(table.size_m / np.reshape(texel_m, (-1, 1)) - 1e-9), 2).astype(np.int64)
        columns, rows = np.where(table.emits | table.is_radiance, 0, sides.T)
        counts = columns * rows * np.where(table.two_sided, 2, 1)
        return cls(table, columns, rows, np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64))

    @property
    def back(self) -> IntArray:
        """First texel of a patch's back, shape (P,); -1 where it has none."""
        return np.where(self.table.two_sided & (self.columns > 0), self.start + self.columns * self.rows, -1)

    @cached_property
    def count(self) -> int:
        """Number of texels."""
        return int(np.sum(self.columns * self.rows * np.where(self.table.two_sided, 2, 1)))

    def texels_of(self, patches: int) -> int:
        """Number of texels of the first so many patches."""
        return int(self.start[patches]) if patches < len(self.start) else self.count

    def grids(self) -> Iterator[tuple[slice, int, int]]:
        """Texels, rows and columns of every grid."""
        sides = zip(self.start.tolist(), self.back.tolist(), self.rows.tolist(), self.columns.tolist(), strict=True)
        for start, back, rows, columns in sides:
            for first in (start, back):
                if columns and first >= 0:
                    yield slice(first, first + rows * columns), rows, columns

    @cached_property
    def alike(self) -> list[IntArray]:
        """Texels of all grids, those of as many rows and columns together, shape (grids, rows, columns) each.

        A room has a thousand grids of few shapes: what is done to all of one shape at once costs a tenth of the time.
        """
        found: dict[tuple[int, int], list[int]] = {}
        for part, *size in self.grids():
            found.setdefault((size[0], size[1]), []).append(part.start)
        return [
            np.array(starts)[:, None, None] + np.arange(rows * columns).reshape(rows, columns)
            for (rows, columns), starts in found.items()
        ]

    def patch(self) -> tuple[IntArray, IntArray]:
        """Patch and number within its grid of every texel, shape (N,) each."""
        each = self.columns * self.rows
        counts = np.stack([each, np.where(self.table.two_sided, each, 0)], axis=1).ravel()
        grid = np.repeat(np.arange(len(counts)), counts)
        first = np.cumsum(counts) - counts
        return grid // 2, np.arange(len(grid)) - first[grid]

    def areas_m2(self) -> Array:
        """Area of every texel, shape (N,)."""
        each = self.table.size_m.prod(axis=1) / np.maximum(self.columns * self.rows, 1)
        return np.asarray(each[self.patch()[0]])

    def points(self) -> tuple[Array, Array]:
        """World points of the texels' middles and the normals of their side, shape (N, 3) each.

        Those beyond the outline of a patch that is no rectangle lie in its plane all the same: the light there is what
        goes on smoothly from the patch, or they are covered by what stands there.
        """
        table, (patch, number) = self.table, self.patch()
        column, row = number % self.columns[patch], number // self.columns[patch]
        x = ((column + 0.5) / self.columns[patch] - 0.5) * table.size_m[patch, 0]
        y = ((row + 0.5) / self.rows[patch] - 0.5) * table.size_m[patch, 1]
        points = table.centre_m[patch] + x[:, None] * table.x_axis[patch] + y[:, None] * table.y_axis[patch]
        behind = np.arange(len(patch)) >= np.where(self.back >= 0, self.back, self.count + 1)[patch]
        return points, np.where(behind[:, None], -1.0, 1.0) * table.normal[patch]
