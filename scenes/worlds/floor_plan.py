"""Floor plan of a generated room: outline, walls, the robot's place, and what already stands where.

Plan frame: the outline's lower left corner at the origin, the length along x, metres. `FloorPlan.T_world_plan` moves it
so that the robot stands at the world's origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from phibench.scenes.frames import Pose, Vector, rotation_xyz
from phibench.scenes.shapes import Rectangle, rectangle
from phibench.scenes.worlds.assembly import Assembly, AssemblyShape, Footprint, footprint_of, moved_parts, part_bounds_m
from phibench.scenes.worlds.materials import Surface
from phibench.scenes.worlds.room_properties import RoomProperties

FREE_RADIUS_M = 0.20  # of the upright cylinder about the stroke axis that stays free up to the ceiling
FREE_DISC_M = 0.55  # of the disc on the floor that the robot takes; its half diagonal is 0.522 m
FREE_DISC_HEIGHT_M = 0.35  # the robot's flippers and body end below
_MARGIN_M = 0.02  # from the walls: skirting boards are 14 mm thick
_ROBOT_MARGIN_M = 0.85  # from the walls: half a diagonal and 0.3 m


@dataclass(frozen=True)
class Wall:
    """Wall between two corners of the outline; the room is to its left.

    Parameters
    ----------
    start, end : 2 floats
    """

    name: str
    start: tuple[float, float]
    end: tuple[float, float]

    @cached_property
    def length_m(self) -> float:
        """Length."""
        return math.dist(self.start, self.end)

    @cached_property
    def along(self) -> tuple[float, float]:
        """Unit vector from start to end."""
        return (self.end[0] - self.start[0]) / self.length_m, (self.end[1] - self.start[1]) / self.length_m

    @property
    def normal(self) -> tuple[float, float]:
        """Unit normal into the room."""
        return -self.along[1], self.along[0]

    @property
    def yaw_rad(self) -> float:
        """Turn of a piece whose back (+y) is at this wall."""
        return math.atan2(self.normal[0], -self.normal[1])

    def place(self, along_m: float, off_m: float) -> tuple[float, float]:
        """Point at a distance from the start and from the wall."""
        (x, y), (ax, ay), (nx, ny) = self.start, self.along, self.normal
        return x + along_m * ax + off_m * nx, y + along_m * ay + off_m * ny


@dataclass(frozen=True)
class FloorPlan:
    """Outline of a room and the robot in it.

    Parameters
    ----------
    cut_m : 2 floats
        Size of the corner that is missing; (0, 0) for a plain rectangle.
    robot : 2 floats
        Place on the plan.
    """

    length_m: float
    width_m: float
    height_m: float
    cut_m: tuple[float, float]
    robot: tuple[float, float]
    heading_rad: float

    @property
    def area_m2(self) -> float:
        """Area of the floor."""
        return self.length_m * self.width_m - self.cut_m[0] * self.cut_m[1]

    @cached_property
    def corners(self) -> tuple[tuple[float, float], ...]:
        """Corners of the outline, against the clock."""
        L, W, (a, b) = self.length_m, self.width_m, self.cut_m
        far = ((L, W),) if a == 0.0 else ((L, W - b), (L - a, W - b), (L - a, W))
        return ((0.0, 0.0), (L, 0.0), *far, (0.0, W))

    @cached_property
    def walls(self) -> tuple[Wall, ...]:
        """Walls, against the clock."""
        ends = (*self.corners[1:], self.corners[0])
        pairs = zip(self.corners, ends, strict=True)
        return tuple(Wall(f"wall_{k + 1}", start, end) for k, (start, end) in enumerate(pairs))

    @cached_property
    def T_world_plan(self) -> Pose:
        """Pose of the plan in the world."""
        turn = rotation_xyz(z_rad=-self.heading_rad)
        moved = np.array(turn) @ np.array([-self.robot[0], -self.robot[1], 0.0])
        return Pose("world", "world", tuple(float(x) for x in moved), turn)

    def holds(self, thing: Footprint) -> bool:
        """True if a footprint lies inside the outline, two centimetres from the walls."""
        points = thing.corners()
        low, high = points.min(axis=0), points.max(axis=0)
        if low.min() < _MARGIN_M or high[0] > self.length_m - _MARGIN_M or high[1] > self.width_m - _MARGIN_M:
            return False
        return self.cut_m[0] == 0.0 or not self._missing.meets(thing, _MARGIN_M)

    @cached_property
    def _missing(self) -> Footprint:
        a, b = self.cut_m
        place = (self.length_m - a / 2.0, self.width_m - b / 2.0)
        return Footprint(*place, 0.0, (a / 2.0, b / 2.0), (-1.0, self.height_m + 1.0))

    def rectangles(self) -> tuple[tuple[Vector, Vector], ...]:
        """Floor as (centre, size) of one rectangle or two."""
        L, W, (a, b) = self.length_m, self.width_m, self.cut_m
        if a == 0.0:
            return (((L / 2.0, W / 2.0), (L, W)),)
        return ((((L - a) / 2.0, W / 2.0), (L - a, W)), ((L - a / 2.0, (W - b) / 2.0), (a, W - b)))


def floor_plan(properties: RoomProperties) -> FloorPlan:
    """Plan of a room with these properties. An L shape whose cut would be below 0.5 m stays a rectangle."""
    p = properties
    sides = (p.length_m, p.width_m)
    # The robot keeps its distance from the cut even where its place is mirrored out of it: below half a side.
    cut = tuple(min(p.cut_part * side, side / 2.0 - _ROBOT_MARGIN_M) for side in sides)
    if not p.l_shape or min(cut) < 0.5:
        cut = (0.0, 0.0)
    robot = [
        _ROBOT_MARGIN_M + share * (side - 2.0 * _ROBOT_MARGIN_M)
        for share, side in zip((p.robot_x, p.robot_y), sides, strict=True)
    ]
    if cut[0] > 0.0 and all(at > side - c - _ROBOT_MARGIN_M for at, side, c in zip(robot, sides, cut, strict=True)):
        robot[0] = p.length_m - robot[0]  # into the part that is left
    return FloorPlan(*sides, p.height_m, (cut[0], cut[1]), (robot[0], robot[1]), math.radians(p.heading_deg))


def shell(plan: FloorPlan, floor: Surface, ceiling: Surface, walls: tuple[Surface, ...]) -> tuple[Rectangle, ...]:
    """Floor, ceiling and walls, plan frame; walls take the surfaces in turn."""
    made = []
    for k, ((x, y), size) in enumerate(plan.rectangles()):
        suffix = f"_{k + 1}" if k else ""
        made.append(
            rectangle(f"floor{suffix}", (x, y, 0.0), (0.0, 0.0, 1.0), size, texture=floor.texture, coat=floor.coat)
        )
        place = (x, y, plan.height_m)
        made.append(rectangle(f"ceiling{suffix}", place, (0.0, 0.0, -1.0), size, texture=ceiling.texture))
    for k, wall in enumerate(plan.walls):
        x, y = wall.place(wall.length_m / 2.0, 0.0)
        surface, size = walls[k % len(walls)], (wall.length_m, plan.height_m)
        centre, normal = (x, y, plan.height_m / 2.0), (*wall.normal, 0.0)
        made.append(rectangle(wall.name, centre, normal, size, texture=surface.texture, coat=surface.coat))
    return tuple(made)


@dataclass
class Layout:
    """Contents of a room so far: parts in the plan frame, and what they take of the room."""

    plan: FloorPlan
    parts: list[AssemblyShape] = field(default_factory=list)
    taken: list[Footprint] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)

    def is_free(self, thing: Footprint, gap_m: float, axis_m: float, outline: bool = True) -> bool:
        """True if a footprint is in the room, `gap_m` from everything and `axis_m` from the stroke axis."""
        if thing.z[1] > self.plan.height_m or thing.distance_m(self.plan.robot) < axis_m:
            return False
        return (not outline or self.plan.holds(thing)) and not any(thing.meets(other, gap_m) for other in self.taken)

    def put(
        self, kind: str, assembly: Assembly, x: float, y: float, yaw_rad: float, taken: Footprint | None = None
    ) -> None:
        """Place an assembly, a millimetre above the floor; its name is its kind and a number."""
        self.counts[kind] = self.counts.get(kind, 0) + 1
        pose = Pose("world", "world", (x, y, 0.001), rotation_xyz(z_rad=yaw_rad))
        self.parts += moved_parts(assembly.parts, pose, f"{kind}_{self.counts[kind]}")
        self.taken.append(taken or footprint_of(assembly, x, y, yaw_rad))

    def leaves_the_robot(self, assembly: Assembly, x: float, y: float, yaw_rad: float) -> bool:
        """True if each part by itself keeps off the free cylinder and, near the floor, off the robot's disc."""
        for part in assembly.parts:
            low, high = part_bounds_m(part.shape)
            single = footprint_of(Assembly([part]), x, y, yaw_rad)
            least = FREE_DISC_M + 0.01 if low[2] < FREE_DISC_HEIGHT_M + 0.02 else FREE_RADIUS_M + 0.05
            if single.distance_m(self.plan.robot) < least or high[2] > self.plan.height_m - 0.002:
                return False
        return True


def patch_count(parts: list[AssemblyShape]) -> int:
    """Number of faces."""
    return sum(_faces(part) for part in parts)


def _faces(part: AssemblyShape) -> int:
    shape = part.shape
    if isinstance(shape, Rectangle):
        return 1
    if hasattr(shape, "sides"):
        return int(shape.sides) + 2
    return len(shape.triangles) if hasattr(shape, "triangles") else 6
