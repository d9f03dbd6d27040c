"""Room tracer: `room_geometry`, the first face along rays (`first_hit`), and the light of a laser there (`deposit`).

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
from numpy.polynomial.legendre import leggauss

from phibench.render.optics.face_tree import FaceTree, Rays
from phibench.render.optics.faces import FaceTable, IntArray, face_table, joined_tables
from phibench.scenes.frames import Array
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import View
from phibench.scenes.room import Room
from phibench.scenes.shapes import Bitmap, Checker, Shape

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


# Deposit of a laser beam: where its light lands on the room's surfaces, and what they scatter.
#
# The beam is parallel over its width of a few millimetres. Each place across it runs from `BEAM_REACH_M` before the
# spot's centre to the first surface, at most as far behind it. What lands elsewhere is not part of the spot; recipes
# refuse such spots (`recipe.spot_placement`). The robot, which carries the laser, stops none of it.
#
# A bare surface of albedo a is Lambertian: of the power P it sends P a cos(theta_o) / pi into each steradian. A coated
# one is a smooth dielectric of index n over a diffuse ground (Mitsuba's `plastic`, nonlinear; Weidlich and Wilkie,
# "Arbitrarily layered micro-facet surfaces", 2007). With T = 1 - F the Fresnel transmittance and f the diffuse
# reflectance of the coat from inside,
#
# P T(theta_i) T(theta_o) / n^2  a / (1 - a f)  cos(theta_o) / pi,        f = 1 - (1 - F_mean) / n^2,
#
# F_mean = 2 integral of F(mu) mu dmu over [0, 1] (reciprocity gives f from it). What the coat mirrors leaves the spot
# in one direction and is left out. Lamps and backs of one-sided faces scatter nothing.


BEAM_REACH_M = 0.25  # before and behind the spot's centre, along the beam


@dataclass(frozen=True)
class Deposit:
    """Light that N places across a beam leave on surfaces.

    Attributes
    ----------
    points_m : array, shape (N, 3); NaN where nothing is met
    normals : array, shape (N, 3)
        On the side that the beam comes from.
    strength : array, shape (N,)
        Share of the power that is scattered: the albedo, or T(theta_i) / n^2 a / (1 - a f) below a coat; 0 for what
        scatters nothing.
    coat : array, shape (N,)
        Refractive index; 0 is none.
    patch : int array, shape (N,)
        Face; -1 where nothing is met, and for flat spots.
    """

    points_m: Array
    normals: Array
    strength: Array
    coat: Array
    patch: IntArray

    def __getitem__(self, n: IntArray | slice) -> Deposit:
        return Deposit(self.points_m[n], self.normals[n], self.strength[n], self.coat[n], self.patch[n])

    @property
    def lit(self) -> IntArray:
        """Numbers of the places that scatter any light."""
        return np.flatnonzero(self.strength > 0.0)

    def scattered(self, leaving: Array) -> Array:
        """Power per steradian and watt, 1/sr, shape (N,), in unit directions (N, 3)."""
        cos = np.maximum(np.einsum("ni,ni->n", leaving, self.normals), 0.0)
        return self.strength / np.pi * cos * np.where(self.coat > 0.0, transmittance(cos, self.coat), 1.0)


def deposit(spot: LaserSpot, room: RoomGeometry, disc: Array) -> Deposit:
    """Deposit of places (N, 2) across the beam, in units of `spot.scale_m`; of a flat spot, its disc."""
    count = len(disc)
    across = np.array(spot.position_world_m) + spot.scale_m * disc @ np.stack(spot.across_beam())
    if spot.beam_direction_world is None:
        assert spot.albedo is not None
        normals = np.broadcast_to(np.array(spot.normal_world), (count, 3))
        return Deposit(across, normals, np.full(count, spot.albedo), np.zeros(count), np.full(count, -1))
    beam = np.array(spot.beam_direction_world)
    starts, own = across - BEAM_REACH_M * beam, room.without_robot
    hits = own.first_hit(starts, np.broadcast_to(beam, (count, 3)), np.full(count, 2.0 * BEAM_REACH_M))
    way = np.where(hits.patch >= 0, hits.distance_m, np.nan) - BEAM_REACH_M
    points = across + way[:, None] * beam
    return _scattering(spot, own.table, hits.patch, points)


def footprint(spot: LaserSpot, disc: Array) -> Array:
    """Points (N, 3) where places (N, 2) across the beam would land if the spot's plane went on without end."""
    offset = spot.scale_m * disc @ np.stack(spot.across_beam())
    if spot.beam_direction_world is not None:
        beam, normal = np.array(spot.beam_direction_world), np.array(spot.normal_world)
        offset = offset - (offset @ normal / (beam @ normal))[:, None] * beam
    return np.array(spot.position_world_m) + offset


def is_plain_spot(spot: LaserSpot, room: RoomGeometry, light: Deposit) -> bool:
    """True for a flat spot, and where places of a beam all lie on one face and in one colour of it."""
    if spot.beam_direction_world is None:
        return True
    if light.patch[0] < 0 or np.any(light.patch != light.patch[0]):
        return False
    table = room.without_robot.table
    texture = table.textures[table.texture[light.patch[0]]]
    if spot.albedo is not None or not isinstance(texture, Bitmap | Checker):
        return True
    cells = np.floor(table.places(light.patch, light.points_m))
    return isinstance(texture, Checker) and bool(np.all(cells == cells[0]))


def transmittance(cos: Array, n: Array) -> Array:
    """1 - F of unpolarised light that enters a dielectric of index n, shape of `cos`, the cosine outside."""
    n = np.where(n > 0.0, n, 1.0)
    inside = np.sqrt(1.0 - (1.0 - cos * cos) / (n * n))
    with np.errstate(invalid="ignore"):  # 0 / 0: grazing incidence without a coat
        r_s, r_p = (cos - n * inside) / (cos + n * inside), (n * cos - inside) / (n * cos + inside)
    return 1.0 - 0.5 * (r_s * r_s + r_p * r_p)


def inside_reflectance(n: float) -> float:
    """Diffuse reflectance f of a coat from inside."""
    x, weight = leggauss(64)
    mu = 0.5 * (x + 1.0)
    mean_transmittance = float(weight @ (mu * transmittance(mu, np.full_like(mu, n))))
    return 1.0 - mean_transmittance / (n * n)


def _scattering(spot: LaserSpot, table: FaceTable, patch: IntArray, points: Array) -> Deposit:
    """Deposit at points (N, 3) on faces (N,)."""
    met = patch >= 0
    face = np.where(met, patch, 0)
    if not len(table.shape):
        return Deposit(points, np.zeros_like(points), np.zeros(len(patch)), np.zeros(len(patch)), patch)
    normals = table.normal[face]
    cos = -normals @ np.array(spot.beam_direction_world)
    scatters = met & ((cos > 0.0) | table.two_sided[face]) & ~table.emits[face]
    normals, cos = np.where(cos[:, None] < 0.0, -normals, normals), np.abs(cos)
    if spot.albedo is not None:
        return Deposit(points, normals, np.where(scatters, spot.albedo, 0.0), np.zeros(len(patch)), patch)
    albedo, coat = np.zeros(len(patch)), table.coat[face]
    albedo[scatters] = table.laser_albedo(patch[scatters], points[scatters])
    strength = albedo.copy()
    for n in np.unique(coat[coat > 0.0]):
        below = coat == n
        ground = albedo[below] / (1.0 - albedo[below] * inside_reflectance(float(n)))
        strength[below] = transmittance(cos[below], coat[below]) / n**2 * ground
    return Deposit(points, normals, strength, coat, patch)
