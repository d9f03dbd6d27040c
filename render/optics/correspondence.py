"""Place in the other image of the room point that each pixel shows, in float64, or the cause why it is not seen there.

The chief ray of a pixel centre goes over the mirror to the room point X (`ray_tracer`, `room_tracer`). From there the
other view's mirror point is solved for (`reflection_point`), and the legs X - mirror - lens are traced against room,
robot and holder. Nothing is interpolated, and nothing passes through a stored layer.

Robot and holder move or stand with the sensor, so that pixels which show them have no counterpart. A point of the room
counts as seen if its chief ray is free; within a pixel of the mirror's outline the blur mixes it with what is behind.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phibench.render.optics.faces import IntArray
from phibench.render.optics.ray_tracer import trace_pixels
from phibench.render.optics.reflection_point import mirror_points, onward_ways
from phibench.render.optics.room_tracer import RoomGeometry, blocked_by, rays_into_room, room_geometry
from phibench.render.optics.truth import depth_m, disc_window
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import View
from phibench.scenes.room import Room

CAUSES = ("none", "nothing", "robot", "holder", "mirror_rim", "back_side", "outside_image")
"""Causes by their codes: the point is seen in both images; the pixel shows no surface, or the robot, or the mirror's
holder; no point of the other mirror shows it; the other mirror looks at the surface's back; its place is not in the
image. From `OCCLUDED` on: the object with that id more stands in the way."""
SEEN, NOTHING, ROBOT, HOLDER, MIRROR_RIM, BACK_SIDE, OUTSIDE = range(len(CAUSES))
OCCLUDED = 16

_SIDE = 64  # of a square of pixels: the work arrays stay in the cache
_REST = 1e-9  # Newton's step that ends the search: the next would be its square


@dataclass(frozen=True)
class Correspondence:
    """Counterparts of the pixels of one image in the other, planes of shape (H, W).

    Attributes
    ----------
    uv_px : array, shape (H, W, 2), float64
        Place of the same room point in the other image; NaN where it is not seen there.
    cause : int16 array
        Codes of `CAUSES`, or `OCCLUDED` and more.
    point_world_m : array, shape (H, W, 3)
        Room point of each pixel; NaN where the pixel shows none.
    depth_m : array
        D of these points.
    glossy : bool array
        The point's surface has a coat that reflects.
    object_names : tuple of str
        By object id.
    """

    uv_px: Array
    cause: NDArray[np.int16]
    point_world_m: Array
    depth_m: Array
    glossy: BoolArray
    object_names: tuple[str, ...]

    @property
    def seen(self) -> BoolArray:
        """Mask of the pixels whose room point both images show."""
        return np.asarray(self.cause == SEEN)

    @property
    def of_room(self) -> BoolArray:
        """Mask of the pixels that show a point of the room, seen in the other image or not."""
        return np.asarray((self.cause == SEEN) | (self.cause > HOLDER))

    def cause_name(self, code: int) -> str:
        """Cause of a code in words, such as "occluded:column"."""
        return CAUSES[code] if code < OCCLUDED else f"occluded:{self.object_names[code - OCCLUDED]}"

    def counts(self) -> dict[str, int]:
        """Pixels of each cause that occurs, most first."""
        codes, counts = np.unique(self.cause, return_counts=True)
        order = np.argsort(-counts, kind="stable")
        return {self.cause_name(int(codes[k])): int(counts[k]) for k in order}


def correspondence(room: Room, view: View, other: View) -> Correspondence:
    """Counterparts in `other` of the pixels of `view`, the same rig at two places."""
    camera = view.rig.camera
    shape = camera.height_px, camera.width_px
    count = shape[0] * shape[1]
    planes = _Planes(np.full((count, 5), np.nan), np.full(count, NOTHING, np.int16), np.zeros(count, bool))
    geometries = room_geometry(room, view), room_geometry(room, other)
    names = tuple(part.name for part in geometries[1].shapes)
    first_own = len(room.surfaces) + len(room.furniture)
    first_held = len(names) - len(view.holder_shapes)
    for pixel in _disc_pixels(view):
        shown = _shown(view, geometries[0], pixel)
        planes.values[shown.pixel, 2:], planes.glossy[shown.pixel] = shown.points_m, shown.glossy
        planes.cause[shown.pixel] = np.where(shown.object_id < first_held, ROBOT, HOLDER)
        mine = shown[np.flatnonzero(shown.object_id < first_own)]
        uv, planes.cause[mine.pixel] = _places(other, geometries[1], mine)
        planes.values[mine.pixel, :2] = uv
    planes.values[planes.cause == NOTHING] = np.nan
    points = planes.values[:, 2:].reshape(*shape, 3)
    return Correspondence(
        uv_px=planes.values[:, :2].reshape(*shape, 2),
        cause=planes.cause.reshape(shape),
        point_world_m=points,
        depth_m=depth_m(points, view.rig.at(0.0).sphere_centre_m),
        glossy=planes.glossy.reshape(shape),
        object_names=names,
    )


@dataclass(frozen=True)
class _Planes:
    """Values (u, v, x, y, z), causes and gloss of all pixels, row by row; they are filled block by block."""

    values: Array
    cause: NDArray[np.int16]
    glossy: BoolArray


@dataclass(frozen=True)
class _Shown:
    """Points that N pixels show: pixel numbers, points, object ids, the side of the face that is seen, its gloss."""

    pixel: IntArray
    points_m: Array
    object_id: IntArray
    normals: Array
    front: BoolArray
    glossy: BoolArray

    def __getitem__(self, index: IntArray) -> _Shown:
        return _Shown(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def _disc_pixels(view: View) -> Iterator[IntArray]:
    """Numbers of the pixels that can see the mirror, a square at a time: their rays run side by side."""
    rows, columns = disc_window(view)
    width = view.rig.camera.width_px
    v, u = np.arange(rows.start, rows.stop), np.arange(columns.start, columns.stop)
    for some in np.array_split(v, len(v) // _SIDE + 1):
        for few in np.array_split(u, len(u) // _SIDE + 1):
            yield (some[:, None] * width + few).ravel()


def _shown(view: View, room: RoomGeometry, pixel: IntArray) -> _Shown:
    """Points that pixels show, those that show any."""
    v, u = np.divmod(pixel, view.rig.camera.width_px)
    rays = trace_pixels(view, np.stack([u, v]).T.astype(float))
    on = np.flatnonzero(np.isfinite(rays.cos_incidence))
    way = rays_into_room(view, room, rays.points_m[on], rays.directions[on])
    hits = room.first_hit(way.starts_m, way.directions)
    seen = np.flatnonzero(hits.object_id >= 0)
    points = way.starts_m[seen] + hits.distance_m[seen, None] * way.directions[seen]
    normals = room.table.normal[hits.patch[seen]]
    front = np.einsum("ni,ni->n", normals, way.directions[seen]) < 0.0
    glossy = room.table.coat[hits.patch[seen]] > 0.0
    return _Shown(pixel[on[seen]], points, hits.object_id[seen], normals, front, glossy)


def _places(other: View, room: RoomGeometry, shown: _Shown) -> tuple[Array, NDArray[np.int16]]:
    """Places in the other image, shape (N, 2), NaN where the points are not seen there, and the causes."""
    points = shown.points_m
    if not len(points):
        return np.empty((0, 2)), np.empty(0, np.int16)
    eye = np.broadcast_to(other.camera_centre_m, points.shape)
    found = mirror_points(other, points, eye, _REST)
    way = onward_ways(other, found, points)
    with np.errstate(invalid="ignore"):
        uv = other.rig.camera.project(other.T_world_camera.inverse().points(found.points_m))
        reflected = np.isfinite(uv).all(axis=1)
        front = np.einsum("ni,ni->n", shown.normals, way.directions) < 0.0
        inside = other.rig.camera.contains(uv)
    cause = np.full(len(points), SEEN, np.int16)
    cause[~inside] = OUTSIDE
    cause[front != shown.front] = BACK_SIDE
    cause[~reflected] = MIRROR_RIM
    open_ = np.flatnonzero(cause == SEEN)
    for start, end in (*way.legs, (eye, found.points_m)):
        blocker = blocked_by(room, start[open_], end[open_])
        cause[open_] = np.where(blocker >= 0, OCCLUDED + blocker, SEEN)
        open_ = open_[blocker < 0]
    dark = open_[~found.lit[open_]]
    if len(dark):  # so steep that no ray through the glass leads there: an end of the tube is in the way
        assert other.rig.holder is not None
        upward = way.directions[dark] @ other.T_world_camera.R[:, 2] > 0.0
        cause[dark] = OCCLUDED + len(room.shapes) - len(other.holder_shapes) + upward
    return np.where((cause == SEEN)[:, None], uv, np.nan), cause
