"""Room tracer in NumPy: first face along rays, free segments, and the way of rays through the glass tube.

A room is the table of its plane faces (`faces`) and a tree of them (`face_tree`). What belongs to the room is made
ready once and stays with the room; robot, carriage and holder are added for each view.

All is float64. Rays are origins and unit directions, shape (N, 3), world frame, metres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from phibench.render.optics.face_tree import FaceTree, Rays
from phibench.render.optics.faces import FaceTable, IntArray, face_table, joined_tables
from phibench.scenes.frames import Array
from phibench.scenes.rig import View
from phibench.scenes.room import Room
from phibench.scenes.shapes import Shape

Finder = Callable[[Array, Array], IntArray]
"""Rays to the number of the face that each probably meets first, -1 for none; a guess, which is checked."""

SURFACE_GAP_M = 1e-7  # a segment may touch the surface it ends on by this much; far above float64 rounding
_CHUNK = 1024  # rays at a time: the work arrays stay in the cache


@dataclass(frozen=True)
class RoomHits:
    """First faces along N rays.

    Attributes
    ----------
    distance_m : array, shape (N,); inf where nothing is hit
    object_id : int array, shape (N,)
        Index of the shape; -1 where nothing is hit.
    patch : int array, shape (N,)
        Index of the face in the geometry's `table`; -1 where nothing is hit.
    """

    distance_m: Array
    object_id: IntArray
    patch: IntArray


class RoomGeometry:
    """Shapes that rays can meet, ready to be traced.

    Parameters
    ----------
    shapes : sequence of shapes
        Their indices are the object ids.
    """

    def __init__(self, shapes: Sequence[Shape] = ()) -> None:
        self._parts: tuple[_Part, ...] = (_Part(tuple(shapes)),)

    @classmethod
    def _of(cls, *parts: _Part) -> RoomGeometry:
        geometry = cls()
        geometry._parts = parts
        return geometry

    @cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """All shapes in the order of their object ids."""
        return tuple(shape for part in self._parts for shape in part.shapes)

    @property
    def without_robot(self) -> RoomGeometry:
        """The same without robot, carriage and holder; ids stay what they are."""
        return RoomGeometry._of(self._parts[0])

    @cached_property
    def table(self) -> FaceTable:
        """Faces of all shapes."""
        return joined_tables([part.table for part in self._parts], [len(part.shapes) for part in self._parts])

    def first_hit(self, origins_m: Array, directions: Array, limit_m: Array | None = None) -> RoomHits:
        """First face along each ray; nothing at `limit_m`, shape (N,), or beyond it."""
        count = len(directions)
        distance = np.full(count, np.inf) if limit_m is None else np.array(limit_m, dtype=float)
        object_id, patch = np.full((2, count), -1, dtype=np.int64)
        for start in range(0, count, _CHUNK):
            rays = Rays.of(origins_m[start : start + _CHUNK], directions[start : start + _CHUNK])
            shapes_before = faces_before = 0
            for part in filter(lambda part: part.shapes, self._parts):
                found = part.tree.first(rays, distance[start : start + _CHUNK])
                hit = np.flatnonzero(found >= 0)
                object_id[start + hit] = part.table.shape[found[hit]] + shapes_before
                patch[start + hit] = found[hit] + faces_before
                shapes_before += len(part.shapes)
                faces_before += len(part.table.shape)
        return RoomHits(np.where(patch >= 0, distance, np.inf), object_id, patch)

    def resolve(self, origins_m: Array, directions: Array, guess: IntArray) -> RoomHits:
        """First face along each ray, where nearly all are guessed right.

        A guess holds if the ray meets the face at least `face_tree.CANDIDATE_MARGIN_M` inside its border. The other
        rays are traced. A nearer face that the guess missed, by its rounding at that face's border, is not looked for.
        """
        distance, object_id, patch = np.full(len(guess), np.inf), np.full(len(guess), -1), guess.astype(np.int64)
        held = np.zeros(len(guess), dtype=bool)
        shapes_before = faces_before = 0
        for part in self._parts:
            count = len(part.table.shape)
            mine = np.flatnonzero((guess >= faces_before) & (guess < faces_before + count))
            local = patch[mine] - faces_before
            t, inside = part.tree.meet(origins_m, directions, mine, local)
            good = mine[inside]
            distance[good], held[good] = t[inside], True
            object_id[good] = part.table.shape[local[inside]] + shapes_before
            shapes_before += len(part.shapes)
            faces_before += count
        open_ = np.flatnonzero(~held)
        if len(open_):
            traced = self.first_hit(origins_m[open_], directions[open_])
            distance[open_], object_id[open_], patch[open_] = traced.distance_m, traced.object_id, traced.patch
        return RoomHits(distance, object_id, patch)


GeometryLike = RoomGeometry | Sequence[Shape]
"""A geometry, or shapes that one is made from."""


def as_geometry(room: GeometryLike) -> RoomGeometry:
    """Geometry as it is, or of some shapes."""
    return room if isinstance(room, RoomGeometry) else RoomGeometry(room)


def own_geometry(room: Room) -> RoomGeometry:
    """Geometry of surfaces and furniture, built once: it stays with the room, which is frozen."""
    kept = vars(room)
    if _KEPT not in kept:
        kept[_KEPT] = _Part((*room.surfaces, *room.furniture))
    return RoomGeometry._of(kept[_KEPT])


def room_geometry(room: Room, view: View) -> RoomGeometry:
    """Geometry of `room.shapes(view)`: the room's own, and what comes with the rig."""
    own, brought = own_geometry(room), room.brought(view)
    return RoomGeometry._of(*own._parts, _Part(brought)) if brought else own


_KEPT = "_traced_part"


def first_hit(room: GeometryLike, origins_m: Array, directions: Array) -> RoomHits:
    """First face along each ray.

    Parameters
    ----------
    room : RoomGeometry or sequence of shapes
    origins_m, directions : arrays, shape (N, 3); directions of unit length
    """
    return as_geometry(room).first_hit(origins_m, directions)


def blocked_by(room: GeometryLike, starts_m: Array, ends_m: Array) -> IntArray:
    """Index of the first shape between two points, shape (N,), or -1 where the segment is free.

    Shapes within `SURFACE_GAP_M` of either end do not count: the ends lie on surfaces themselves.
    """
    span = ends_m - starts_m
    length = np.linalg.norm(span, axis=-1)
    directions = span / length[:, None]
    limit, starts = length - 2.0 * SURFACE_GAP_M, starts_m + SURFACE_GAP_M * directions
    return as_geometry(room).first_hit(starts, directions, limit).object_id


@dataclass(frozen=True)
class RaysIntoRoom:
    """Rays from inside the holder on their way into the room.

    Attributes
    ----------
    starts_m, directions : arrays, shape (N, 3)
    path_m : array, shape (N,), or 0 where all are as they were
        Length of the way to the start.
    """

    starts_m: Array
    directions: Array
    path_m: Array | float


def rays_into_room(view: View, room: RoomGeometry, points_m: Array, directions: Array) -> RaysIntoRoom:
    """Rays that leave the mirror, unit directions, as they go on into the room: as they are unless a tube bends them.

    A ray that meets a plate or the camera before the glass stays as it is. One that meets a plate within the wall goes
    on from its inner face, the others from its outer one.
    """
    if view.tube is None:
        return RaysIntoRoom(points_m, directions, 0.0)
    crossing = view.tube.leave(points_m, directions)
    crosses = np.flatnonzero(crossing.crosses)
    inner, outer = crossing.inner_m[crosses], crossing.outer_m[crosses]
    clear = blocked_by(room, points_m[crosses], inner) < 0
    crosses, inner, outer = crosses[clear], inner[clear], outer[clear]
    passes = crossing.passes[crosses][:, None]
    before, within = np.linalg.norm(inner - points_m[crosses], axis=1), np.linalg.norm(outer - inner, axis=1)
    starts, onward, path = points_m.copy(), directions.copy(), np.zeros(len(points_m))
    starts[crosses] = np.where(passes, outer, inner)
    onward[crosses] = np.where(passes, crossing.directions[crosses], (outer - inner) / within[:, None])
    path[crosses] = before + np.where(passes[:, 0], within, 0.0)
    return RaysIntoRoom(starts, onward, path)


# Parts: shapes with their faces and tree.


class _Part:
    """Shapes, and what is made from them when it is needed first; only the shapes are pickled."""

    def __init__(self, shapes: tuple[Shape, ...]) -> None:
        self.shapes = shapes

    def __getstate__(self) -> dict[str, Any]:
        return {"shapes": self.shapes}

    @cached_property
    def table(self) -> FaceTable:
        return face_table(self.shapes)

    @cached_property
    def tree(self) -> FaceTree:
        return FaceTree(self.table)
