"""Bounding volume hierarchy of plane faces (parallelograms, triangles) in NumPy: first hits of many rays, in float64.

Rays that run side by side meet few faces: these are tried by all of them. Where they meet many, the largest faces are
tried by all rays. The others stand in a tree of boxes, split at the median of the longest side, eight children to a
node; all rays go down together, level by level, as pairs (ray, node). There is no loop over rays or faces.

**No ray slips through an edge.** A ray meets the plane of a face at t = (h - n.o) / (n.d). With coordinates up to 30 m
and about 30 roundings the numerator errs by e <= 30 * 30 m * 1.1e-16 = 1e-13 m, and the place on the face by
e / |n.d|. A face therefore reaches `_REACH_M` / max(|n.d|, 1e-6) beyond its border, ten times that error. Of two faces
with a common edge the one that the exact ray meets takes it, or else the ray is within e of the edge and the other
face takes it. Only rays flatter than 1e-7 rad to both faces may be lost: they run along a surface. A hit is never
more than 1e-6 m beside its face. Rays in the plane of a face (|n.d| < 1e-14) do not meet that face.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phibench.render.optics.faces import FaceTable, IntArray
from phibench.scenes.frames import Array, BoolArray

CANDIDATE_MARGIN_M = 1e-5  # a hit in float32 errs by less: 30 m * 6e-8 * a few roundings

_REACH_M = 1e-12
_FLATTEST = 1e-6
_IN_PLANE = 1e-14
_BOX_MARGIN_M = 2e-6  # the reach beyond borders, and the rounding of the test with boxes
_LARGE = 16  # faces tried by all rays
_LEAF = 4  # faces in a leaf, at most
_FEW = 48  # faces without a tree
_BUNDLE = 256  # rays from which on it pays to ask which faces they may meet


@dataclass(frozen=True)
class Rays:
    """Rays as rows: origins and directions (3, N), the inverse of the directions, and where they are negative."""

    origins: Array
    directions: Array
    inverse: Array
    negative: IntArray

    @staticmethod
    def of(origins_m: Array, directions: Array) -> Rays:
        """Rays of origins and directions, shape (N, 3)."""
        o, d = np.ascontiguousarray(origins_m.T), np.ascontiguousarray(directions.T)
        inverse = 1.0 / np.where(np.abs(d) < 1e-300, 1e-300, d)  # 1 / 0 would make NaN for a ray in a face's plane
        return Rays(o, d, inverse, (inverse < 0.0).astype(np.int64))

    def __getitem__(self, index: IntArray) -> Rays:
        o, d, inverse = (np.take(a, index, axis=1) for a in (self.origins, self.directions, self.inverse))
        return Rays(o, d, inverse, np.take(self.negative, index, axis=1))


# Plane pieces: parallelograms and triangles.


@dataclass(frozen=True, eq=False)
class _Pieces:
    """M plane pieces: P = corner + a e1 + b e2 with 0 <= a, b and, for triangles, a + b <= 1, otherwise a, b <= 1.

    Attributes
    ----------
    plane : array, shape (4, M): unit normal and height h of the plane n.P = h
    a, b : arrays, shape (4, M): a = A.P - a0, b = B.P - b0
    slant : array, shape (M,): 1 for triangles, 0 for parallelograms
    scale : array, shape (4, M): metres per unit of -a, -b, a + slant b - 1, b + slant a - 1, across each border
    patch : int array, shape (M,)
    low, high : arrays, shape (M, 3)
    """

    plane: Array
    a: Array
    b: Array
    slant: Array
    scale: Array
    patch: IntArray
    low: Array
    high: Array

    @staticmethod
    def of(table: FaceTable) -> _Pieces:
        """Faces of two triangles are parallelograms: one piece. Others have a piece for each triangle."""
        count = np.bincount(table.patch, minlength=len(table.shape))
        first = np.searchsorted(table.patch, np.arange(len(table.shape)))
        quad = count[table.patch] == 2
        kept = np.flatnonzero(~quad | (np.arange(len(table.patch)) == first[table.patch]))
        corners, patch, slant = table.corners_m[kept], table.patch[kept], np.where(quad[kept], 0.0, 1.0)
        # the halves of a parallelogram are its corners 0 1 2 and 0 2 3
        fourth = table.corners_m[np.minimum(kept + 1, len(table.corners_m) - 1), 2]
        corner, e1 = corners[:, 0], corners[:, 1] - corners[:, 0]
        e2 = np.where(quad[kept, None], fourth, corners[:, 2]) - corner
        n = table.normal[patch]
        A, B = np.cross(e2, n), np.cross(n, e1)
        A /= np.einsum("mi,mi->m", A, e1)[:, None]
        B /= np.einsum("mi,mi->m", B, e2)[:, None]
        gradients = np.stack([A, B, A + slant[:, None] * B, B + slant[:, None] * A])
        ends = np.concatenate([corners, np.where(quad[kept, None], fourth, corner)[:, None]], axis=1)
        return _Pieces(
            plane=_rows(n, np.einsum("mi,mi->m", n, table.centre_m[patch])),
            a=_rows(A, np.einsum("mi,mi->m", A, corner)),
            b=_rows(B, np.einsum("mi,mi->m", B, corner)),
            slant=slant,
            scale=1.0 / np.linalg.norm(gradients, axis=-1),
            patch=patch,
            low=ends.min(axis=1),
            high=ends.max(axis=1),
        )

    def __getitem__(self, index: IntArray) -> _Pieces:
        return _Pieces(
            *(self.plane[:, index], self.a[:, index], self.b[:, index], self.slant[index], self.scale[:, index]),
            *(self.patch[index], self.low[index], self.high[index]),
        )

    def outside_m(self, piece: IntArray, points: Array) -> Array:
        """Distance outside pieces (K,) of points (3, K) in their planes, metres; negative inside."""
        x, y, z = points
        A, B = self.a, self.b
        a = A[0][piece] * x + A[1][piece] * y + A[2][piece] * z - A[3][piece]
        b = B[0][piece] * x + B[1][piece] * y + B[2][piece] * z - B[3][piece]
        return _outside(a, b, self.slant[piece], self.scale[:, piece])


def _outside(a: Array, b: Array, slant: Array, scale: Array) -> Array:
    """Distance of places (a, b) outside their pieces, metres."""
    outside = np.maximum(-a * scale[0], -b * scale[1])
    np.maximum(outside, (a + slant * b - 1.0) * scale[2], out=outside)
    return np.maximum(outside, (b + slant * a - 1.0) * scale[3], out=outside)


def _reach_m(cos: Array) -> Array:
    """Reach of a face beyond its border, metres, for the cosine between a ray and its normal."""
    return _REACH_M / np.maximum(np.abs(cos), _FLATTEST)


def _rows(vectors: Array, last: Array) -> Array:
    return np.ascontiguousarray(np.concatenate([vectors.T, last[None]]))


# Trees.


class FaceTree:
    """Pieces of some faces: the largest, and boxes around the others."""

    def __init__(self, table: FaceTable) -> None:
        self._pieces = _Pieces.of(table)
        self._faces = len(table.shape)
        size = np.linalg.norm(self._pieces.high - self._pieces.low, axis=1)
        order = np.argsort(-size, kind="stable")
        large = len(order) if len(order) <= _FEW else _LARGE
        self._large = np.sort(order[:large])
        self._leaves, self._levels = _boxes(self._pieces, np.sort(order[large:]))

    def first(self, rays: Rays, distance: Array) -> IntArray:
        """Nearest face before `distance`, shape (N,), which is lowered in place; -1 for none."""
        found = np.full(len(distance), -1, dtype=np.int64)
        near = np.flatnonzero(self._reaches(rays, distance))
        if not len(near):
            return found
        some = len(near) < len(distance)
        rays, limit = (rays[near], distance[near]) if some else (rays, distance)
        best = np.full(len(near), -1, dtype=np.int64)
        few = self._ahead(rays, limit) if len(near) >= _BUNDLE else None
        if few is not None and len(few) <= _LARGE:
            self._try_all(rays, few, best, limit)
        else:
            self._try_all(rays, self._large, best, limit)
            self._try_leaves(rays, best, limit)
        hit = np.flatnonzero(best >= 0)
        found[near[hit]], distance[near[hit]] = self._pieces.patch[best[hit]], limit[hit]
        return found

    @cached_property
    def _only(self) -> IntArray:
        """Number of each face's only piece; -1 for faces of several."""
        patch, only = self._pieces.patch, np.full(self._faces, -1, dtype=np.int64)
        only[patch] = np.arange(len(patch))
        only[np.bincount(patch, minlength=self._faces) > 1] = -1
        return only

    def _reaches(self, rays: Rays, distance: Array) -> BoolArray:
        """Rays that meet the box around everything."""
        if not len(self._pieces.patch):
            return np.zeros(len(distance), dtype=bool)
        enter, leave = np.zeros(len(distance)), distance
        for axis in range(3):
            o, inverse = rays.origins[axis], rays.inverse[axis]
            low, high = ((end - o) * inverse for end in self._box[:, axis])
            enter, leave = np.maximum(enter, np.minimum(low, high)), np.minimum(leave, np.maximum(low, high))
        return np.asarray(enter <= leave)

    @cached_property
    def _box(self) -> Array:
        low, high = self._pieces.low.min(axis=0), self._pieces.high.max(axis=0)
        return np.stack([low - _BOX_MARGIN_M, high + _BOX_MARGIN_M])

    def _ahead(self, rays: Rays, distance: Array) -> IntArray:
        """Pieces that a bundle of rays may meet, by boxes around its starts, its directions and each piece."""
        enter, leave = np.zeros(len(self._pieces.patch)), np.full(len(self._pieces.patch), distance.max())
        for axis in range(3):
            o, d = rays.origins[axis], rays.directions[axis]
            top, bottom = self._pieces.high[:, axis] + _BOX_MARGIN_M, self._pieces.low[:, axis] - _BOX_MARGIN_M
            # after the way t some ray must be below the top, t d <= gap, and some above the bottom
            for gap, most in ((top - o.min(), d.min()), (o.max() - bottom, -d.max())):
                if most > 0.0:
                    np.minimum(leave, gap / most, out=leave)
                elif most < 0.0:
                    np.maximum(enter, gap / most, out=enter)
                else:
                    leave[gap < 0.0] = -1.0
        return np.flatnonzero(enter <= leave)

    def meet(self, origins_m: Array, directions: Array, ray: IntArray, face: IntArray) -> tuple[Array, BoolArray]:
        """Distance of rays to planes of faces, and whether they meet well inside the border of a face of one piece."""
        piece = self._only[face]
        usable = piece >= 0
        piece = np.where(usable, piece, 0)
        o, d = origins_m[ray].T, directions[ray].T
        with np.errstate(divide="ignore", invalid="ignore"):
            n = [row[piece] for row in self._pieces.plane] if len(piece) else [np.empty(0)] * 4
            t = (n[3] - (n[0] * o[0] + n[1] * o[1] + n[2] * o[2])) / (n[0] * d[0] + n[1] * d[1] + n[2] * d[2])
            points = o + t * d
            inside = usable & (t > 0.0) & (self._pieces.outside_m(piece, points) < -CANDIDATE_MARGIN_M)
        return t, inside

    def _try_all(self, rays: Rays, some: IntArray, best: IntArray, distance: Array) -> None:
        """All rays with some pieces, as matrices (pieces, N)."""
        if not len(some):
            return
        own, o, d = self._large_pieces if some is self._large else self._pieces[some], rays.origins, rays.directions
        with np.errstate(divide="ignore", invalid="ignore"):
            cos = own.plane[:3].T @ d
            t = (own.plane[3][:, None] - own.plane[:3].T @ o) / _not_flat(cos)
            a = own.a[:3].T @ o + t * (own.a[:3].T @ d) - own.a[3][:, None]
            b = own.b[:3].T @ o + t * (own.b[:3].T @ d) - own.b[3][:, None]
            outside = _outside(a, b, own.slant[:, None], own.scale[..., None])
            t[~((outside <= _reach_m(cos)) & (t > 0.0))] = np.inf
        number = np.argmin(t, axis=0)
        nearest = t[number, np.arange(len(number))]
        nearer = np.flatnonzero(nearest < distance)
        best[nearer], distance[nearer] = some[number[nearer]], nearest[nearer]

    def _try_leaves(self, rays: Rays, best: IntArray, distance: Array) -> None:
        if not len(self._leaves):
            return
        ray, leaf, enter, leave = self._leaf_visits(rays, distance)
        n = [np.take(row, leaf, axis=1) for row in self._leaf_planes]
        o, d = rays.origins[:, ray], rays.directions[:, ray]
        with np.errstate(divide="ignore", invalid="ignore"):
            cos = _not_flat(n[0] * d[0] + n[1] * d[1] + n[2] * d[2])
            t = (n[3] - (n[0] * o[0] + n[1] * o[1] + n[2] * o[2])) / cos
            # a piece lies in its box: few planes are met within it
            place, pair = np.nonzero((t >= enter) & (t <= leave) & (t > 0.0))
        piece, ray, t, cos = self._leaves[leaf[pair], place], ray[pair], t[place, pair], cos[place, pair]
        points = rays.origins[:, ray] + t * rays.directions[:, ray]
        on = np.flatnonzero((self._pieces.outside_m(piece, points) <= _reach_m(cos)) & (t < distance[ray]))
        order = on[np.argsort(-t[on], kind="stable")]  # of several for one ray the last, nearest one stays
        best[ray[order]], distance[ray[order]] = piece[order], t[order]

    @cached_property
    def _large_pieces(self) -> _Pieces:
        return self._pieces[self._large]

    @cached_property
    def _leaf_planes(self) -> Array:
        return np.ascontiguousarray(self._pieces.plane[:, self._leaves.T])

    def _leaf_visits(self, rays: Rays, distance: Array) -> tuple[IntArray, IntArray, Array, Array]:
        """Pairs (ray, leaf) whose boxes meet before `distance`, and where the ray enters and leaves the box."""
        ray, node = np.arange(len(distance)), np.zeros(len(distance), dtype=np.int64)
        for boxes in self._levels:
            nodes = boxes.shape[2] // 2
            enter, leave = np.zeros((boxes.shape[1], len(ray))), distance[ray]
            for axis in range(3):
                o, inverse = rays.origins[axis][ray], rays.inverse[axis][ray]
                side = rays.negative[axis][ray] * nodes
                near, far = (np.take(boxes[axis], place, axis=1) for place in (node + side, node + (nodes - side)))
                near -= o
                near *= inverse
                far -= o
                far *= inverse
                np.maximum(enter, near, out=enter)
                leave = np.minimum(leave, far, out=far)
            child, pair = np.nonzero(enter <= leave)
            ray, node = ray[pair], node[pair] * boxes.shape[1] + child
        return ray, node, enter[child, pair], leave[child, pair]


def _not_flat(cos: Array) -> Array:
    """Cosines, NaN for rays in the plane."""
    cos[np.abs(cos) < _IN_PLANE] = np.nan
    return cos


def _boxes(pieces: _Pieces, members: IntArray) -> tuple[IntArray, list[Array]]:
    """Leaves, shape (leaves, pieces), and for each level of the tree the boxes of each node's children.

    Boxes have the shape (axis, children, low ends of all nodes and then high ones). The number of leaves is a power of
    two; all have the same length, which a few pieces fill that stand twice.
    """
    if not len(members):
        return np.empty((0, 0), dtype=np.int64), []
    depth = max(0, math.ceil(math.log2(len(members) / _LEAF)))
    length = math.ceil(len(members) / 2**depth)
    order = np.resize(members, (1, length * 2**depth))
    middle = 0.5 * (pieces.low + pieces.high)
    for _ in range(depth):
        places = middle[order]
        axis = np.argmax(places.max(axis=1) - places.min(axis=1), axis=1)
        key = np.take_along_axis(places, axis[:, None, None], axis=2)[..., 0]
        order = np.take_along_axis(order, np.argsort(key, axis=1, kind="stable"), axis=1).reshape(2 * len(order), -1)
    low = pieces.low[order].min(axis=1) - _BOX_MARGIN_M
    high = pieces.high[order].max(axis=1) + _BOX_MARGIN_M
    levels: list[Array] = []
    while len(low) > 1:
        children = 8 if len(low) % 8 == 0 else len(low)
        low, high = low.reshape(-1, children, 3), high.reshape(-1, children, 3)
        levels.insert(0, np.concatenate([low, high]).transpose(2, 1, 0).copy())
        low, high = low.min(axis=1), high.max(axis=1)
    return order, levels
