"""Assemblies: pieces of furniture as parts in a frame of their own, and their footprints on the floor plan.

Local frame: x to the right, the front towards -y, z up, the floor at 0. Boxes are half a millimetre smaller on each
side than stated, so that neighbours never share a plane.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from phibench.scenes.frames import Array, Matrix, Pose, Vector, as_matrix, as_vector, rotation_facing, rotation_xyz
from phibench.scenes.shapes import Cuboid, Mesh, Prism, Rectangle, Shape
from phibench.scenes.worlds.materials import MaterialSet, Rng, Surface

GAP_M = 5e-4
Span = tuple[float, float]
_TOUCH_M = 1e-3


@dataclass(frozen=True)
class AssemblyShape:
    """A shape in the frame of its assembly; `role` marks what may be switched on: "screen" or "bulb"."""

    shape: Shape
    role: str = ""


@dataclass
class Assembly:
    """Parts of one piece, in its own frame."""

    parts: list[AssemblyShape] = field(default_factory=list)
    _bounds: dict[int, Array] = field(default_factory=dict, repr=False)  # by the number of parts

    def box(self, name: str, x: Span, y: Span, z: Span, surface: Surface, yaw_rad: float = 0.0) -> None:
        """Add a cuboid between the limits, turned about its own upright axis."""
        limits = np.array([x, y, z])
        size = np.maximum(limits[:, 1] - limits[:, 0] - 2.0 * GAP_M, 1e-3)
        self.tilted(name, as_vector(limits.mean(axis=1)), as_vector(size), surface, rotation_xyz(z_rad=yaw_rad))

    def tilted(self, name: str, centre_m: Vector, size_m: Vector, surface: Surface, rotation: Matrix) -> None:
        """Add a cuboid of any direction; its size is exact."""
        pose = Pose("world", "shape", centre_m, rotation)
        self.parts.append(AssemblyShape(Cuboid(name, pose, size_m, surface.texture, surface.coat)))

    def post(self, name: str, x: float, y: float, z: Span, radius_m: float, surface: Surface, sides: int = 8) -> None:
        """Add an upright prism."""
        height = max(z[1] - z[0] - 2.0 * GAP_M, 1e-3)
        pose = Pose("world", "shape", (x, y, 0.5 * (z[0] + z[1])))
        self.parts.append(AssemblyShape(Prism(name, pose, radius_m, height, sides, surface.texture, surface.coat)))

    def rod(self, name: str, start: Vector, end: Vector, radius_m: float, surface: Surface, sides: int = 8) -> None:
        """Add a prism between two points."""
        a, b = np.array(start), np.array(end)
        up = (0.0, 0.0, 1.0) if abs((b - a)[2]) < 0.99 * np.linalg.norm(b - a) else (1.0, 0.0, 0.0)
        pose = Pose("world", "shape", as_vector(0.5 * (a + b)), rotation_facing(as_vector(b - a), up))
        length = float(np.linalg.norm(b - a))
        self.parts.append(AssemblyShape(Prism(name, pose, radius_m, length, sides, surface.texture, surface.coat)))

    def panel(
        self, name: str, centre_m: Vector, normal: Vector, size_m: Vector, surface: Surface, role: str = ""
    ) -> None:
        """Add a rectangle."""
        pose = Pose("world", "shape", centre_m, rotation_facing(normal))
        self.parts.append(AssemblyShape(Rectangle(name, pose, size_m, surface.texture, coat=surface.coat), role))

    def mesh(
        self, name: str, vertices_m: Array, triangles: NDArray[np.int64], surface: Surface, texel_m: float
    ) -> None:
        """Add a two-sided mesh whose texture lies along the longest axes of its triangles' corners (x and z)."""
        texels = (vertices_m[:, [0, 2]] / texel_m)[triangles]
        shape = Mesh(name, vertices_m, triangles, surface.texture, texels, two_sided=True, coat=surface.coat)
        self.parts.append(AssemblyShape(shape))

    def add(self, other: Assembly, x: float, y: float, z: float, yaw_rad: float, prefix: str) -> None:
        """Add the parts of another assembly, moved and turned about the upright axis."""
        pose = Pose("world", "world", (x, y, z), rotation_xyz(z_rad=yaw_rad))
        self.parts += moved_parts(other.parts, pose, prefix)

    def bounds_m(self) -> Array:
        """Least and largest coordinates, shape (2, 3)."""
        count = len(self.parts)
        if count not in self._bounds:
            boxes = np.array([part_bounds_m(part.shape) for part in self.parts])
            self._bounds[count] = np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
        return self._bounds[count]


def part_bounds_m(shape: Shape) -> Array:
    """Box along the axes around a shape, shape (2, 3)."""
    if isinstance(shape, Mesh):
        return np.stack([shape.vertices_m.min(axis=0), shape.vertices_m.max(axis=0)])
    pose = shape.T_world_shape
    size = np.zeros(3)
    size[: len(shape.size_m)] = shape.size_m
    half, t = 0.5 * np.abs(pose.R) @ size, pose.t
    return np.array([t - half, t + half])


def moved_parts(parts: Iterable[AssemblyShape], pose: Pose, prefix: str = "") -> list[AssemblyShape]:
    """Parts in another frame, their names after a prefix if one is given."""
    R, t = pose.R, pose.t
    done = []
    for part in parts:
        shape = part.shape
        name = f"{prefix}_{shape.name}" if prefix else shape.name
        if isinstance(shape, Mesh):
            shape = replace(shape, name=name, vertices_m=shape.vertices_m @ R.T + t)
        else:
            own = shape.T_world_shape
            place = Pose("world", "shape", as_vector(R @ own.t + t), as_matrix(R @ own.R))
            shape = replace(shape, name=name, T_world_shape=place)
        done.append(replace(part, shape=shape))
    return done


@dataclass(frozen=True)
class Footprint:
    """Upright box of any direction: what a thing takes of the room.

    Parameters
    ----------
    x, y : float
        Centre, metres.
    half_m : 2 floats
    z : 2 floats
        Lowest and highest.
    """

    x: float
    y: float
    yaw_rad: float
    half_m: tuple[float, float]
    z: Span

    def axes(self) -> Array:
        """Unit axes as rows, shape (2, 2)."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.array([[c, s], [-s, c]])

    def corners(self) -> Array:
        """Corners on the floor plan, shape (4, 2)."""
        signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        return np.array([self.x, self.y]) + (signs * self.half_m) @ self.axes()

    def distance_m(self, point: Sequence[float]) -> float:
        """Distance of a point of the floor plan, 0 inside."""
        local = np.abs(self.axes() @ (np.asarray(point) - (self.x, self.y)))
        return float(np.linalg.norm(np.maximum(local - self.half_m, 0.0)))

    def meets(self, other: Footprint, gap_m: float = 0.0) -> bool:
        """True if less than a gap is between two boxes along every separating axis."""
        if self.z[0] >= other.z[1] + _TOUCH_M or other.z[0] >= self.z[1] + _TOUCH_M:
            return False
        dx, dy = other.x - self.x, other.y - self.y
        reach = math.hypot(*self.half_m) + math.hypot(*other.half_m) + gap_m
        if dx * dx + dy * dy >= reach * reach:
            return False
        c, s = abs(math.cos(other.yaw_rad - self.yaw_rad)), abs(math.sin(other.yaw_rad - self.yaw_rad))
        for one, two, turn in ((self, other, self.yaw_rad), (other, self, other.yaw_rad)):
            ca, sa = math.cos(turn), math.sin(turn)
            (ax, ay), (bx, by) = one.half_m, two.half_m
            if abs(dx * ca + dy * sa) >= ax + bx * c + by * s + gap_m:
                return False
            if abs(-dx * sa + dy * ca) >= ay + bx * s + by * c + gap_m:
                return False
        return True


def footprint_of(assembly: Assembly, x: float, y: float, yaw_rad: float, z: float = 0.0) -> Footprint:
    """Footprint of an assembly whose origin stands at a place."""
    low, high = assembly.bounds_m()
    middle = 0.5 * (low + high)
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    centre = (x + c * middle[0] - s * middle[1], y + s * middle[0] + c * middle[1])
    half = (float(0.5 * (high - low)[0]), float(0.5 * (high - low)[1]))
    return Footprint(float(centre[0]), float(centre[1]), yaw_rad, half, (z + float(low[2]), z + float(high[2])))


Piece = Callable[[Rng, MaterialSet], Assembly]
"""Furniture and other things: functions of a random generator and the room's materials."""
