"""The two shapes rooms and robots are built of: rectangles and cuboids."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from phibench.scenes.checks import finite_vector, positive
from phibench.scenes.frames import Array, Pose, Vector, as_vector, rotation_facing
from phibench.scenes.textures import Texture, Uniform

_WHITE = Uniform((0.7, 0.7, 0.7))


@dataclass(frozen=True)
class Rectangle:
    """One-sided-textured rectangle, centred at its pose; its z axis is the normal.

    Parameters
    ----------
    name : str
    T_world_shape : Pose
    size_m : 2 floats
        Full extent along the local x and y.
    texture : Texture
        Diffuse albedo.
    radiance_w_m2_sr : 3 floats
        Emitted radiance on the side of the normal, per ambient band; not 0 makes a lamp (its albedo is then 0).
    """

    name: str
    T_world_shape: Pose
    size_m: Vector
    texture: Texture = _WHITE
    radiance_w_m2_sr: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        _check_size(self, 2)
        values = finite_vector(self.name, "radiance_w_m2_sr", self.radiance_w_m2_sr, 3)
        object.__setattr__(self, "radiance_w_m2_sr", values)

    @property
    def emits(self) -> bool:
        """Whether the rectangle is a lamp that is switched on."""
        return any(value > 0.0 for value in self.radiance_w_m2_sr)


@dataclass(frozen=True)
class Cuboid:
    """Solid box, centred at its pose, full extents `size_m` along the local axes, one diffuse albedo."""

    name: str
    T_world_shape: Pose
    size_m: Vector
    texture: Uniform = field(default=_WHITE)

    def __post_init__(self) -> None:
        _check_size(self, 3)

    def contains(self, point_world_m: Vector) -> bool:
        """Whether a world point lies strictly inside."""
        local = self.T_world_shape.inverse().points(np.asarray(point_world_m, float))
        return bool(np.all(np.abs(local) < 0.5 * np.array(self.size_m) - 1e-9))

    def distance_m(self, point_world_m: Array) -> float:
        """Distance of a world point from the solid, 0 inside."""
        local = np.abs(self.T_world_shape.inverse().points(np.asarray(point_world_m, float)))
        return float(np.linalg.norm(np.maximum(local - 0.5 * np.array(self.size_m), 0.0)))

    def meets(self, other: Cuboid) -> bool:
        """Whether two boxes overlap: no axis separates them (of the faces, and the products of the edges)."""
        a, b = self.T_world_shape.R, other.T_world_shape.R
        axes = np.concatenate([a.T, b.T, np.cross(a.T[:, None], b.T[None]).reshape(-1, 3)])
        reach = (np.abs(axes @ a) @ np.array(self.size_m) + np.abs(axes @ b) @ np.array(other.size_m)) / 2.0
        return bool(np.all(np.abs(axes @ (self.T_world_shape.t - other.T_world_shape.t)) < reach + 1e-12))


Shape = Rectangle | Cuboid


def _check_size(shape: Rectangle | Cuboid, length: int) -> None:
    size = finite_vector(shape.name, "size_m", shape.size_m, length)
    for value in size:
        positive(shape.name, "size_m", value)
    object.__setattr__(shape, "size_m", size)


def rectangle(name: str, centre_m: Vector, normal: Vector, size_m: Vector, **options: object) -> Rectangle:
    """Rectangle at `centre_m` facing `normal`, its local y as near to world z as it can be."""
    pose = Pose("world", "shape", centre_m, rotation_facing(normal))
    return Rectangle(name, pose, size_m, **options)  # type: ignore[arg-type]


def cuboid(name: str, centre_m: Vector, size_m: Vector, albedo: Vector, rotation: object = None) -> Cuboid:
    """Cuboid at `centre_m` with one albedo; axis-aligned unless a rotation matrix is given."""
    pose = Pose("world", "shape", centre_m) if rotation is None else Pose("world", "shape", centre_m, rotation)  # type: ignore[arg-type]
    return Cuboid(name, pose, size_m, Uniform(albedo))


def faces(shape: Shape) -> tuple[Rectangle, ...]:
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
    return Rectangle(name, pose, (float(lengths[0]), float(lengths[1])), box.texture)
