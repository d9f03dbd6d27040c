"""Rooms for the robot's loop (`Arena`): `Boxes` that block its sight or its way, and the places of targets.

A room's shapes become boxes: cuboids as they are, prisms and meshes by the box around them, upright rectangles with a
thickness of a millimetre. A target is a laser spot on the first surface that a level ray from the stroke axis meets. It
is taken if the robot can drive straight towards it up to the stand-off distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from phibench.datasets.film.moving_camera import BakedRoom, open_baked_rooms
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.random_streams import Name, generator
from phibench.scenes.room import Room
from phibench.scenes.shapes import Cuboid, Mesh, Prism, Rectangle, Shape
from phibench.scenes.validation import SceneError
from phibench.scenes.worlds.generated_room import generate_room
from phibench.scenes.worlds.room_properties import drawn_properties

_THIN_M = 1e-3  # a rectangle as a box
_END_M = 3e-3  # of a line of sight: the spot lies on a box
_LOW_M, _HIGH_M = 0.03, 0.95  # what the robot can run into: not rugs and wires, not what hangs above the mirror
_ROBOT_M = 0.40  # beside the way; the robot is 0.53 m wide
_BODY_M = 0.28  # about the base; boxes nearer than that are run into
_TRIES = 400  # random directions: a room in which none of them is free has no place for the task
_SAME_M = 2e-3  # a box and the shape that it stands for, where a spot lies


@dataclass(frozen=True)
class Boxes:
    """Boxes at any attitude: centres (n, 3), axes as columns (n, 3, 3), half sizes (n, 3), metres, world."""

    centre_m: Array
    axes: Array
    half_m: Array

    def __len__(self) -> int:
        return len(self.centre_m)

    def chosen(self, mask: BoolArray) -> Boxes:
        """Those of a mask, shape (n,)."""
        return Boxes(self.centre_m[mask], self.axes[mask], self.half_m[mask])

    def block(self, starts_m: Array, ends_m: Array) -> BoolArray:
        """Segments, shape (m, 3), in which any box stands, their last millimetres left out: shape (m,)."""
        if not len(self):
            return np.zeros(len(starts_m), bool)
        low, high, length = self._crossing(starts_m, ends_m)
        return np.asarray((np.minimum(high, 1.0 - _END_M / length) > np.maximum(low, 0.0)).any(axis=0))

    def first_hit(self, start_m: Array, direction: Array, reach_m: float) -> tuple[float, Array] | None:
        """Distance along a unit direction, shape (3,), to the first face, and its normal; None within `reach_m`."""
        end = start_m + reach_m * direction
        into = np.einsum("nji,nj->ni", self.axes, start_m - self.centre_m)
        low, high, _ = self._crossing(start_m[None], end[None])
        enters = np.where((low[:, 0] > 0.0) & (high[:, 0] > low[:, 0]), low[:, 0], np.inf)
        k = int(np.argmin(enters))
        if not enters[k] < 1.0:
            return None
        inside = into[k] + enters[k] * reach_m * (self.axes[k].T @ direction)
        face = int(np.argmax(np.abs(inside) - self.half_m[k]))
        return float(enters[k] * reach_m), math.copysign(1.0, inside[face]) * self.axes[k][:, face]

    def distance_m(self, points_m: Array) -> Array:
        """Least distance of points (m, 2) on the floor plan from any box, shape (m,); boxes count as upright."""
        away = points_m[:, None, :] - self.centre_m[None, :, :2]
        local = np.abs(np.einsum("nji,mnj->mni", self.axes[:, :2, :2], away))
        outside = np.maximum(local - self.half_m[:, :2], 0.0)
        return np.asarray(np.sqrt(np.sum(outside**2, axis=-1)).min(axis=-1, initial=np.inf))

    def _crossing(self, starts_m: Array, ends_m: Array) -> tuple[Array, Array, Array]:
        """Parameters at which lines enter and leave the boxes, shapes (n, m), and lengths (m,)."""
        a = np.einsum("nji,nmj->nmi", self.axes, starts_m[None] - self.centre_m[:, None])
        along = np.einsum("nji,mj->nmi", self.axes, ends_m - starts_m)
        along = np.where(np.abs(along) < 1e-12, 1e-12, along)  # so that no division by 0 makes NaN
        half = self.half_m[:, None]
        one, two = (-half - a) / along, (half - a) / along
        low, high = np.minimum(one, two).max(axis=-1), np.maximum(one, two).min(axis=-1)
        return low, high, np.linalg.norm(ends_m - starts_m, axis=-1)


def boxes_of(shapes: Sequence[Shape]) -> Boxes:
    """Boxes of shapes; level rectangles, such as floors, are left out."""
    rows = [box for shape in shapes if (box := _box(shape)) is not None]
    if not rows:
        return Boxes(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)))
    centre, axes, half = (np.array(column) for column in zip(*rows, strict=True))
    return Boxes(centre, axes, half)


def _box(shape: Shape) -> tuple[Array, Array, Array] | None:
    if isinstance(shape, Mesh):
        low, high = shape.vertices_m.min(axis=0), shape.vertices_m.max(axis=0)
        return 0.5 * (low + high), np.eye(3), np.maximum(0.5 * (high - low), 0.5 * _THIN_M)
    pose = shape.T_world_shape
    if isinstance(shape, Rectangle):
        if abs(pose.R[2, 2]) > 0.5:
            return None
        width, height = shape.size_m
        up_last = pose.R[:, [0, 2, 1]]  # floor plans take the third axis as upright
        if abs(up_last[2, 2]) < abs(up_last[2, 0]):
            up_last, width, height = pose.R[:, [1, 2, 0]], height, width
        return pose.t, up_last, 0.5 * np.array([width, _THIN_M, height])
    assert isinstance(shape, Cuboid | Prism)
    return pose.t, pose.R, 0.5 * np.array(shape.size_m)


class Target(NamedTuple):
    """Laser spot on a surface.

    Attributes
    ----------
    point_m, normal : shape (3,), world
    """

    point_m: Array
    normal: Array


@dataclass(frozen=True)
class Arena:
    """A room for the loop.

    Parameters
    ----------
    sight : Boxes
        What stands in lines of sight.
    floor : Boxes
        What the robot runs into.
    baked : BakedRoom, optional
        The same room with its light, for pixels. Spots then lie where its own shapes and the boxes agree.
    """

    name: str
    sight: Boxes
    floor: Boxes
    baked: BakedRoom | None = None

    def draw_target(self, rng: np.random.Generator, distances_m: tuple[float, float], stand_off_m: float) -> Target:
        """Target at a distance from the origin's upright axis, which a robot at the origin can drive to.

        Raises
        ------
        SceneError
            If none is found.
        """
        for _ in range(_TRIES):
            azimuth, height = rng.uniform(-math.pi, math.pi), rng.uniform(0.2, 1.1)
            ahead = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
            hit = self._first_hit(np.array([0.0, 0.0, height]), ahead, distances_m[1])
            # 0.5: at most 60 degrees off the surface's normal
            if hit is None or hit[0] < distances_m[0] or hit[1] @ ahead > -0.5:
                continue
            way = np.arange(0.0, hit[0] - stand_off_m + 0.05, 0.05)  # 5 cm: an eighth of what is kept free beside it
            if self.floor.distance_m(way[:, None] * ahead[:2]).min(initial=np.inf) > _ROBOT_M:
                return Target(np.array([0.0, 0.0, height]) + hit[0] * ahead, hit[1])
        raise SceneError(
            f"room {self.name}: no target {distances_m[0]:g} to {distances_m[1]:g} m away can be driven to; "
            "allow other distances, or take another room"
        )

    def draw_distractor(self, rng: np.random.Generator) -> Target:
        """Place of another light, on the first surface in a random direction."""
        for _ in range(_TRIES):
            azimuth, rise = rng.uniform(-math.pi, math.pi), rng.uniform(-0.2, 0.5)
            d = np.array([math.cos(azimuth) * math.cos(rise), math.sin(azimuth) * math.cos(rise), math.sin(rise)])
            hit = self._first_hit(np.array([0.0, 0.0, 0.8]), d, 8.0)
            if hit is not None and hit[0] > 1.0:  # nothing right beside the robot
                return Target(np.array([0.0, 0.0, 0.8]) + hit[0] * d, hit[1])
        raise SceneError(f"room {self.name}: no surface within 8 m; take a room with walls")

    def _first_hit(self, start_m: Array, direction: Array, reach_m: float) -> tuple[float, Array] | None:
        """Distance of the first box, and its normal; None if the room's own shape lies elsewhere."""
        hit = self.sight.first_hit(start_m, direction, reach_m)
        if hit is None or self.baked is None:
            return hit
        own = self.baked.lit.geometry.first_hit(start_m[None], direction[None])
        return hit if abs(float(own.distance_m[0]) - hit[0]) < _SAME_M else None

    def collides(self, x_m: float, y_m: float) -> bool:
        """True if the base at a place runs into something."""
        return bool(self.floor.distance_m(np.array([[x_m, y_m]]))[0] < _BODY_M)


def arena_of(room: Room) -> Arena:
    """Arena of a room whose robot stands at the origin."""
    sight = boxes_of((*room.surfaces, *room.furniture))
    reach = np.einsum("nij,nj->ni", np.abs(sight.axes), sight.half_m)[:, 2]
    bottom, top = sight.centre_m[:, 2] - reach, sight.centre_m[:, 2] + reach
    return Arena(room.name, sight, _upright(sight.chosen((top > _LOW_M) & (bottom < _HIGH_M))))


def offers_targets(room: Room) -> bool:
    """True if the default task has targets in a room that the robot can drive to; drawn with a stream of its own."""
    try:
        arena_of(room).draw_target(generator(room.name, "offers targets"), (1.5, 4.5), 1.0)
    except SceneError:
        return False
    return True


def _upright(boxes: Boxes) -> Boxes:
    """The boxes, leaning ones replaced by the upright boxes around them."""
    leans = np.abs(boxes.axes[:, 2, 2]) < 1.0 - 1e-9  # rounding of an upright box
    around = np.einsum("nij,nj->ni", np.abs(boxes.axes), boxes.half_m)
    return Boxes(
        boxes.centre_m,
        np.where(leans[:, None, None], np.eye(3), boxes.axes),
        np.where(leans[:, None], around, boxes.half_m),
    )


def baked_arenas(folder: str | Path) -> tuple[Arena, ...]:
    """Arenas of the baked rooms in a folder (`phibench loop bake`), of which there are pixels."""
    return tuple(replace(arena_of(baked.room), baked=baked) for baked in open_baked_rooms(folder).values())


def generated_arena(*stream: Name) -> Arena:
    """Arena of a generated room; the same names give the same room."""
    return arena_of(generate_room(drawn_properties(*stream), *stream))


def plain_arena(*stream: Name) -> Arena:
    """Arena of four walls and some cupboards, drawn from a named stream in a millisecond: for learning."""
    rng = generator(*stream, "plain arena")
    size, heading = rng.uniform((5.0, 5.0), (9.0, 9.0)), rng.uniform(-math.pi, math.pi)
    place = rng.uniform(0.3, 0.7, 2) * size
    rows = [(0.5 * size[0], y, 0.5 * size[0], 0.01, 1.4) for y in (0.0, size[1])]  # half sizes: walls 2.8 m high
    rows += [(x, 0.5 * size[1], 0.01, 0.5 * size[1], 1.4) for x in (0.0, size[0])]
    for _ in range(int(rng.integers(2, 7))):
        half, at = rng.uniform((0.2, 0.15), (0.6, 0.4)), rng.uniform((0.5, 0.5), size - 0.5)
        if np.hypot(*(at - place)) > 1.4:  # the robot's own place stays free
            rows.append((*at, *half, rng.uniform(0.2, 1.0)))
    x, y, a, b, c = np.array(rows).T
    turn = np.array([[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]])
    flat = (np.stack([x, y], axis=-1) - place) @ turn.T
    axes = np.zeros((len(rows), 3, 3))
    axes[:, :2, :2], axes[:, 2, 2] = turn, 1.0
    boxes = Boxes(np.column_stack([flat, c]), axes, np.stack([a, b, c], axis=-1))
    return Arena("-".join(map(str, stream)), boxes, boxes)
