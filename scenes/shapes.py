"""Shapes of rooms (rectangles, cuboids, prisms, meshes: polyhedra with exact plane faces), and their textures.

A curved thing is a prism with many sides or a mesh. What is rendered, what truth is computed from and what the laser
hits are the same plane faces.

A texture is the albedo, or the radiance, as an exact function of the position on a surface: metres from its centre
along its local x and y. Values stand for the three ambient bands (R, G, B). Each texture also gives the albedo at the
laser's wavelength; where none is stated it is that of band R.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydantic_core import core_schema

from phibench.scenes.frames import Array, Pose, Vector, as_vector, rotation_facing
from phibench.scenes.validation import SceneError, finite_vector, positive, within


def check_albedo(owner: str, name: str, albedo: Vector) -> Vector:
    """Return three albedos in [0, 1], else raise `SceneError`."""
    values = finite_vector(owner, name, albedo, 3)
    for value in values:
        within(owner, name, value, 0.0, 1.0)
    return values


@dataclass(frozen=True)
class Uniform:
    """One albedo everywhere."""

    albedo: Vector

    def __post_init__(self) -> None:
        object.__setattr__(self, "albedo", check_albedo("Uniform", "albedo", self.albedo))

    def evaluate(self, xy_m: Array) -> Array:
        """Albedo, shape (..., 3), at positions (..., 2), metres."""
        return np.broadcast_to(np.array(self.albedo), (*xy_m.shape[:-1], 3))

    def laser_albedo(self, xy_m: Array) -> Array:
        """Albedo at the laser's wavelength, shape (...), at positions (..., 2)."""
        return self.evaluate(xy_m)[..., 0]


@dataclass(frozen=True)
class Checker:
    """Checkerboard whose cells measure `cell_m` (x, y); a corner of four cells lies at the surface's corner (-x, -y).

    A cell longer than the surface in one direction makes stripes.
    """

    albedo_even: Vector
    albedo_odd: Vector
    cell_m: Vector
    origin_m: Vector

    def __post_init__(self) -> None:
        for name in ("albedo_even", "albedo_odd"):
            object.__setattr__(self, name, check_albedo("Checker", name, getattr(self, name)))
        for name in ("cell_m", "origin_m"):
            object.__setattr__(self, name, finite_vector("Checker", name, getattr(self, name), 2))
        for length in self.cell_m:
            positive("Checker", "cell_m", length)

    def evaluate(self, xy_m: Array) -> Array:
        """Albedo, shape (..., 3), at positions (..., 2), metres."""
        cells = np.floor((xy_m - np.array(self.origin_m)) / np.array(self.cell_m))
        odd = np.mod(cells.sum(axis=-1), 2.0)[..., None] > 0.5
        return np.where(odd, np.array(self.albedo_odd), np.array(self.albedo_even))

    def laser_albedo(self, xy_m: Array) -> Array:
        """Albedo at the laser's wavelength, shape (...), at positions (..., 2)."""
        return self.evaluate(xy_m)[..., 0]


@dataclass(frozen=True, eq=False)
class Bitmap:
    """Image on a surface, bilinear between texel centres, repeated without end in both directions.

    Two bitmaps are equal if their contents are. The image is the world's definition: nothing finer stands behind it.

    Parameters
    ----------
    values : array, shape (rows, columns, 4), float32
        Albedo in the bands R, G, B and at the laser's wavelength, in [0, 1]. Where `is_radiance` the bands are radiance
        in W/(m^2 sr); the fourth value stays an albedo: 0 on a screen, that of the wall in a photographed room.
    texel_m : 2 floats
        Size of a texel along the surface's x (columns) and y (rows, the first one at the bottom).
    origin_m : 2 floats
        Place of the first texel's lower left corner on the surface.
    is_radiance : bool
        The surface sends this light out and reflects none but the laser's: a screen, or a wall of a photographed room.
    """

    values: NDArray[np.float32]
    texel_m: Vector
    origin_m: Vector = (0.0, 0.0)
    is_radiance: bool = False

    def __post_init__(self) -> None:
        values = np.ascontiguousarray(self.values, dtype=np.float32)
        if values.ndim != 3 or values.shape[2] != 4 or 0 in values.shape:
            raise SceneError(f"Bitmap.values: shape {values.shape}: must be (rows, columns, 4) with at least one texel")
        albedos = values[..., 3] if self.is_radiance else values
        if not np.isfinite(values).all() or values.min() < 0.0 or albedos.max() > 1.0:
            limits = "0 or more, the laser's albedo up to 1" if self.is_radiance else "albedos from 0 to 1"
            raise SceneError(f"Bitmap.values: must be finite, {limits}")
        values.flags.writeable = False
        object.__setattr__(self, "values", values)
        for name in ("texel_m", "origin_m"):
            object.__setattr__(self, name, finite_vector("Bitmap", name, getattr(self, name), 2))
        for length in self.texel_m:
            positive("Bitmap", "texel_m", length)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of size and contents."""
        head = f"{self.values.shape} {self.texel_m} {self.origin_m} {self.is_radiance}".encode()
        return hashlib.sha256(head + self.values.tobytes()).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Bitmap) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def __repr__(self) -> str:
        return f"Bitmap({self.digest})"

    @classmethod
    def __get_pydantic_core_schema__(cls, *_: object) -> core_schema.CoreSchema:
        """In a document a bitmap is its digest."""
        told = core_schema.plain_serializer_function_ser_schema(repr)
        return core_schema.is_instance_schema(cls, serialization=told)

    def sample(self, xy_m: Array) -> Array:
        """All four values, shape (..., 4), at positions (..., 2)."""
        rows, columns = self.values.shape[:2]
        place = (np.asarray(xy_m, float) - np.array(self.origin_m)) / np.array(self.texel_m) - 0.5
        low = np.floor(place)
        (tx, ty), (i, j) = (np.moveaxis(place - low, -1, 0)[..., None], np.moveaxis(low.astype(int), -1, 0))
        left, right, down, up = i % columns, (i + 1) % columns, j % rows, (j + 1) % rows
        bottom = (1.0 - tx) * self.values[down, left] + tx * self.values[down, right]
        top = (1.0 - tx) * self.values[up, left] + tx * self.values[up, right]
        return np.asarray((1.0 - ty) * bottom + ty * top)

    def evaluate(self, xy_m: Array) -> Array:
        """Bands, shape (..., 3), at positions (..., 2), metres."""
        return self.sample(xy_m)[..., :3]

    def laser_albedo(self, xy_m: Array) -> Array:
        """Albedo at the laser's wavelength, shape (...), at positions (..., 2)."""
        return self.sample(xy_m)[..., 3]


Texture = Uniform | Checker | Bitmap


# -- shapes ------------------------------------------------------------------------------------------------------------

_WHITE = Uniform((0.7, 0.7, 0.7))


@dataclass(frozen=True)
class Rectangle:
    """One-sided-textured rectangle, centred at its pose; its z axis is the normal.

    Parameters
    ----------
    size_m : 2 floats
        Full extent along the local x and y.
    texture : Texture
        Diffuse albedo.
    radiance_w_m2_sr : 3 floats
        Emitted radiance on the side of the normal, per ambient band; not 0 makes a lamp (its albedo is then 0).
    coat : float
        Refractive index of a smooth dielectric coat over the diffuse ground; 0 is none.
    window : bool
        The sun shines in through it (`Room.sun`); the radiance is then the sky's.
    """

    name: str
    T_world_shape: Pose
    size_m: Vector
    texture: Texture = _WHITE
    radiance_w_m2_sr: Vector = (0.0, 0.0, 0.0)
    coat: float = 0.0
    window: bool = False

    def __post_init__(self) -> None:
        _check_size(self, 2)
        _check_coat(self.name, self.coat)
        values = finite_vector(self.name, "radiance_w_m2_sr", self.radiance_w_m2_sr, 3)
        object.__setattr__(self, "radiance_w_m2_sr", values)

    @property
    def emits(self) -> bool:
        """True for a lamp that is switched on."""
        return any(value > 0.0 for value in self.radiance_w_m2_sr)


@dataclass(frozen=True)
class Cuboid:
    """Solid box, centred at its pose, full extents `size_m` along the local axes, the same texture on every face.

    Each face has its own coordinates, those of `faces`. `coat` is as for `Rectangle`.
    """

    name: str
    T_world_shape: Pose
    size_m: Vector
    texture: Texture = field(default=_WHITE)
    coat: float = 0.0

    def __post_init__(self) -> None:
        _check_size(self, 3)
        _check_coat(self.name, self.coat)

    def contains(self, point_world_m: Vector) -> bool:
        """Return True for a world point strictly inside."""
        local = self.T_world_shape.inverse().points(np.asarray(point_world_m, float))
        return bool(np.all(np.abs(local) < 0.5 * np.array(self.size_m) - 1e-9))  # a point on a face is outside

    def distance_m(self, point_world_m: Array) -> float:
        """Distance of a world point from the solid, 0 inside."""
        local = np.abs(self.T_world_shape.inverse().points(np.asarray(point_world_m, float)))
        return float(np.linalg.norm(np.maximum(local - 0.5 * np.array(self.size_m), 0.0)))

    def meets(self, other: Cuboid) -> bool:
        """Return True if two boxes overlap: no axis separates them (of the faces, and the products of the edges)."""
        a, b = self.T_world_shape.R, other.T_world_shape.R
        axes = np.concatenate([a.T, b.T, np.cross(a.T[:, None], b.T[None]).reshape(-1, 3)])
        reach = (np.abs(axes @ a) @ np.array(self.size_m) + np.abs(axes @ b) @ np.array(other.size_m)) / 2.0
        # the cross product of parallel edges is 0, and must not separate
        return bool(np.all(np.abs(axes @ (self.T_world_shape.t - other.T_world_shape.t)) < reach + 1e-12))


@dataclass(frozen=True)
class Prism:
    """Solid with a regular polygon as its base: pipes, posts, bins, bulbs.

    The axis is the local z; corner 0 lies on the local x. The texture runs around the sides (x, metres from corner 0)
    and up (y, from the middle); on both ends it starts at the centre.

    Parameters
    ----------
    T_world_shape : Pose
        Of the middle of the axis.
    radius_m : float
        Of the corners.
    sides : int, from 3
    """

    name: str
    T_world_shape: Pose
    radius_m: float
    height_m: float
    sides: int = 24
    texture: Texture = field(default=_WHITE)
    coat: float = 0.0

    def __post_init__(self) -> None:
        positive(self.name, "radius_m", self.radius_m)
        positive(self.name, "height_m", self.height_m)
        within(self.name, "sides", self.sides, 3, 360)
        _check_coat(self.name, self.coat)

    @property
    def size_m(self) -> Vector:
        """Extents of the box around it, metres."""
        return (2.0 * self.radius_m, 2.0 * self.radius_m, self.height_m)

    def corners_m(self) -> Array:
        """Corners of the base, shape (sides, 2), local x and y, against the clock seen from above."""
        turn = 2.0 * math.pi * np.arange(self.sides) / self.sides
        return self.radius_m * np.stack([np.cos(turn), np.sin(turn)], axis=-1)

    def contains(self, point_world_m: Vector) -> bool:
        """Return True for a world point strictly inside."""
        x, y, z = self.T_world_shape.inverse().points(np.asarray(point_world_m, float))
        middle = math.pi / self.sides
        normals = np.arange(self.sides) * 2.0 * middle + middle
        reach = (np.cos(normals) * x + np.sin(normals) * y).max()
        # a point on a face is outside
        return bool(reach < self.radius_m * math.cos(middle) - 1e-9 and abs(z) < 0.5 * self.height_m - 1e-9)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles that share a texture; two meshes are equal if their contents are.

    Parameters
    ----------
    vertices_m : array, shape (N, 3)
        World frame.
    triangles : int array, shape (M, 3)
        Corners, against the clock seen from outside.
    corner_texels : array, shape (M, 3, 2), or None
        Place of each triangle's corners on the bitmap, in texels (column, row) from its first texel's lower left
        corner; None for a uniform texture.
    two_sided : bool
        Both sides are surfaces; else the back of a triangle is black.
    """

    name: str
    vertices_m: Array
    triangles: NDArray[np.int64]
    texture: Texture = field(default=_WHITE)
    corner_texels: Array | None = None
    two_sided: bool = False
    coat: float = 0.0

    def __post_init__(self) -> None:
        vertices, triangles = np.array(self.vertices_m, dtype=float), np.array(self.triangles, dtype=np.int64)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
            raise SceneError(f"{self.name}: vertices_m must be finite, of shape (N, 3)")
        if triangles.ndim != 2 or triangles.shape[1] != 3 or len(triangles) == 0:
            raise SceneError(f"{self.name}: triangles must have the shape (M, 3), with at least one triangle")
        if triangles.min() < 0 or triangles.max() >= len(vertices):
            raise SceneError(f"{self.name}: triangles name vertices from 0 to {len(vertices) - 1} only")
        _check_coat(self.name, self.coat)
        for name, values in (("vertices_m", vertices), ("triangles", triangles)):
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        if isinstance(self.texture, Bitmap):
            texels = np.array(self.corner_texels, dtype=float)
            if texels.shape != (*triangles.shape, 2) or not np.isfinite(texels).all():
                raise SceneError(f"{self.name}: corner_texels must be finite, of shape ({len(triangles)}, 3, 2)")
            texels.flags.writeable = False
            object.__setattr__(self, "corner_texels", texels)
        elif not isinstance(self.texture, Uniform):
            raise SceneError(f"{self.name}: the texture of a mesh must be uniform or a bitmap")

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the contents."""
        head = f"{self.name} {self.texture!r} {self.two_sided} {self.coat}".encode()
        texels = b"" if self.corner_texels is None else self.corner_texels.tobytes()
        return hashlib.sha256(head + self.vertices_m.tobytes() + self.triangles.tobytes() + texels).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mesh) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @classmethod
    def __get_pydantic_core_schema__(cls, *_: object) -> core_schema.CoreSchema:
        """In a document a mesh is its digest."""
        told = core_schema.plain_serializer_function_ser_schema(repr)
        return core_schema.is_instance_schema(cls, serialization=told)

    def __repr__(self) -> str:
        return f"Mesh({self.name!r}, {self.digest})"


Shape = Rectangle | Cuboid | Prism | Mesh


def shines(shape: Shape) -> bool:
    """Return True for what sends out light of its own: a lamp, a screen, a wall of a photographed room."""
    by_texture = isinstance(shape.texture, Bitmap) and shape.texture.is_radiance
    return by_texture or (isinstance(shape, Rectangle) and shape.emits)


def _check_size(shape: Rectangle | Cuboid, length: int) -> None:
    size = finite_vector(shape.name, "size_m", shape.size_m, length)
    for value in size:
        positive(shape.name, "size_m", value)
    object.__setattr__(shape, "size_m", size)


def _check_coat(name: str, coat: float) -> None:
    if coat != 0.0:
        within(name, "coat", coat, 1.05, 3.0)  # refractive indices: below 1.05 nothing is mirrored


def rectangle(name: str, centre_m: Vector, normal: Vector, size_m: Vector, **options: object) -> Rectangle:
    """Rectangle at `centre_m` facing `normal`, its local y as near to world z as it can be."""
    pose = Pose("world", "shape", centre_m, rotation_facing(normal))
    return Rectangle(name, pose, size_m, **options)  # type: ignore[arg-type]


def cuboid(
    name: str, centre_m: Vector, size_m: Vector, albedo: Vector | Texture, rotation: object = None, coat: float = 0.0
) -> Cuboid:
    """Cuboid at `centre_m` with one albedo or a texture; axis-aligned unless a rotation matrix is given."""
    pose = Pose("world", "shape", centre_m) if rotation is None else Pose("world", "shape", centre_m, rotation)  # type: ignore[arg-type]
    texture = Uniform(albedo) if isinstance(albedo, tuple) else albedo
    return Cuboid(name, pose, size_m, texture, coat)


def faces(shape: Rectangle | Cuboid) -> tuple[Rectangle, ...]:
    """The shape's surface as rectangles: itself, or the six sides of a cuboid in the order +x -x +y -y +z -z."""
    if isinstance(shape, Rectangle):
        return (shape,)
    return tuple(_side(shape, axis, sign) for axis in range(3) for sign in (1.0, -1.0))


def _side(box: Cuboid, axis: int, sign: float) -> Rectangle:
    normal = np.zeros(3)
    normal[axis] = sign
    local = Pose("shape", "side", as_vector(0.5 * box.size_m[axis] * normal), rotation_facing(as_vector(normal)))
    lengths = np.abs(local.R.T) @ np.array(box.size_m)
    pose = box.T_world_shape @ local
    pose = Pose("world", "shape", pose.translation_m, pose.rotation)
    name = f"{box.name}{'+-'[sign < 0.0]}{'xyz'[axis]}"
    return Rectangle(name, pose, (float(lengths[0]), float(lengths[1])), box.texture, coat=box.coat)
