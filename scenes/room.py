"""Room and robot: shapes with diffuse albedos, everything that light can hit except the mirror.

Shapes are rectangles and cuboids. An albedo is an exact function of the position on a surface and has three values,
one per ambient band (R, G, B); positions are metres from the surface's centre.

The robot is the ESCALADE360 as simple solids. The paper gives its overall dimensions, 0.90 x 0.53 x 0.30 m, and tracks
with flippers after the PackBot; the split into body, tracks and flippers is ours. So are the mast that lifts the sensor
and the camera's housing, which make the middle of the mirror show a camera on a robot. The holder of the mirror is not
modelled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from phibench.scenes.frames import Array, Pose, Vector, as_vector, rotation_facing, rotation_xyz
from phibench.scenes.rig import View
from phibench.scenes.validation import SceneError, finite_vector, positive, within


@dataclass(frozen=True)
class Uniform:
    """One albedo everywhere."""

    albedo: Vector

    def __post_init__(self) -> None:
        object.__setattr__(self, "albedo", check_albedo("Uniform", "albedo", self.albedo))

    def evaluate(self, xy_m: Array) -> Array:
        """Albedo, shape (..., 3), at positions (..., 2), metres."""
        return np.broadcast_to(np.array(self.albedo), (*xy_m.shape[:-1], 3))


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


Texture = Uniform | Checker


def check_albedo(owner: str, name: str, albedo: Vector) -> Vector:
    """Return three albedos in [0, 1], else raise `SceneError`."""
    values = finite_vector(owner, name, albedo, 3)
    for value in values:
        within(owner, name, value, 0.0, 1.0)
    return values


# Shapes.

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
        """True for a lamp that is switched on."""
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
        """Return True for a world point strictly inside."""
        local = self.T_world_shape.inverse().points(np.asarray(point_world_m, float))
        return bool(np.all(np.abs(local) < 0.5 * np.array(self.size_m) - 1e-9))

    def distance_m(self, point_world_m: Array) -> float:
        """Distance of a world point from the solid, 0 inside."""
        local = np.abs(self.T_world_shape.inverse().points(np.asarray(point_world_m, float)))
        return float(np.linalg.norm(np.maximum(local - 0.5 * np.array(self.size_m), 0.0)))

    def meets(self, other: Cuboid) -> bool:
        """Return True if two boxes overlap: no axis separates them (of the faces, and the products of the edges)."""
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


# The robot.

BODY_TOP_M = 0.30
_HOUSING_M = (0.072, 0.030, 0.032)  # the C310's bar, lying on its back
_LENS_CLEARANCE_M = 1e-3  # the housing's top stays below the lens centre so that it shades no aperture
_GREY, _BLACK, _OLIVE = (0.10, 0.10, 0.10), (0.03, 0.03, 0.03), (0.16, 0.17, 0.10)


def chassis() -> tuple[Cuboid, ...]:
    """Body, two tracks and two flippers, standing on the floor, front towards world +x."""
    flipper = rotation_xyz(y_rad=math.radians(-25.0))
    return (
        cuboid("robot_body", (-0.05, 0.0, 0.19), (0.66, 0.31, 0.22), _OLIVE),
        cuboid("robot_track_left", (-0.06, 0.21, 0.10), (0.78, 0.09, 0.20), _BLACK),
        cuboid("robot_track_right", (-0.06, -0.21, 0.10), (0.78, 0.09, 0.20), _BLACK),
        cuboid("robot_flipper_left", (0.30, 0.21, 0.18), (0.28, 0.05, 0.08), _GREY, flipper),
        cuboid("robot_flipper_right", (0.30, -0.21, 0.18), (0.28, 0.05, 0.08), _GREY, flipper),
    )


def carriage(view: View) -> tuple[Cuboid, ...]:
    """Camera housing and the mast below it, for a rig at one stroke offset."""
    T_world_camera = view.T_world_camera
    height = _HOUSING_M[2]
    centre = Pose("camera", "shape", (0.0, 0.0, -_LENS_CLEARANCE_M - height / 2.0))
    housing = Cuboid("camera_housing", T_world_camera @ centre, _HOUSING_M, Uniform(_GREY))
    foot = T_world_camera.points(np.array([0.0, 0.0, -_LENS_CLEARANCE_M - height]))
    rise = max(float(foot[2]) - BODY_TOP_M, 1e-3)
    mast = cuboid(
        "robot_mast", as_vector(np.array([foot[0], foot[1], BODY_TOP_M + rise / 2.0])), (0.03, 0.02, rise), _GREY
    )
    return (housing, mast)


def escalade360(view: View) -> tuple[Cuboid, ...]:
    """All solids of robot and sensor housing for one view; the same number and order at every offset."""
    return (*chassis(), *carriage(view))


# The room.

MIRROR_NAME = "mirror"


@dataclass(frozen=True)
class Room:
    """Surfaces, lamps and furniture, in the world frame, and whether the robot stands in it.

    Parameters
    ----------
    name : str
    surfaces : rectangles; those that emit are the lamps
    furniture : cuboids
    robot : bool
        Robot, mast and camera housing are part of the scene.
    """

    name: str
    surfaces: tuple[Rectangle, ...]
    furniture: tuple[Cuboid, ...] = ()
    robot: bool = True

    def __post_init__(self) -> None:
        shapes: tuple[Shape, ...] = (*self.surfaces, *self.furniture)
        names = [shape.name for shape in shapes]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise SceneError(f"Room '{self.name}': two shapes are called {twice[0]}; names must differ")

    @property
    def lit(self) -> bool:
        """True if any lamp is on."""
        return any(surface.emits for surface in self.surfaces)

    def shapes(self, view: View) -> tuple[Shape, ...]:
        """All shapes for one view; the index of a shape in this tuple is its object id, the same at every offset."""
        return (*self.surfaces, *self.furniture, *(escalade360(view) if self.robot else ()))

    def object_names(self, view: View) -> tuple[str, ...]:
        """Names of the shapes in the order of their object ids."""
        return tuple(shape.name for shape in self.shapes(view))

    def dark(self) -> Room:
        """Return the same room with every lamp switched off."""
        off = tuple(replace(surface, radiance_w_m2_sr=(0.0, 0.0, 0.0)) for surface in self.surfaces)
        return replace(self, name="dark", surfaces=off)

    def solid_around(self, point_world_m: tuple[float, ...]) -> str | None:
        """Name of the solid (furniture, robot) that a world point lies inside, or None."""
        solids = (*self.furniture, *(chassis() if self.robot else ()))
        return next((solid.name for solid in solids if solid.contains(point_world_m)), None)
