"""Room of a panorama, and its settings: an equirectangular picture as radiance on the faces of a box or a mesh.

The picture was taken at a stated point. Its middle column looks along the heading, its left and right edges behind; its
columns run to the right, as seen from inside. Its upper edge is the zenith. Row i of H has the elevation
90 - (i + 1/2) 180 / H degrees, column j of W the azimuth heading + 180 - (j + 1/2) 360 / W degrees, from world x to y.

Every face gets a bitmap of the radiance in the direction of its texels, which defines the room. A texel is as large as
stated, or as a pixel of the panorama at the face's distance if that is larger. Where a texel covers several pixels it
takes the mean of four places in a picture that was averaged over areas, so that nothing aliases. All bitmaps hold at
most 16 million values: if more would be needed, all texels grow alike.

Such walls shine and have no albedo for other light. The laser finds one stated albedo. What the camera did not see
carries the picture of what stood before it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from phibench.datasets.rooms.mesh_parts import MeshPart
from phibench.datasets.rooms.mesh_placement import (
    EXTENT_M,
    MIRROR_TOP_M,
    MeshSettings,
    corners_of,
    placed_parts,
    robot_box,
)
from phibench.datasets.rooms.mesh_room import MOST_VALUES, mesh_shape
from phibench.datasets.rooms.panorama_files import Light, read_panorama
from phibench.datasets.rooms.room_files import RoomError
from phibench.scenes.frames import Array, Vector
from phibench.scenes.room import Room
from phibench.scenes.shapes import Bitmap, Rectangle, rectangle
from phibench.scenes.validation import finite_vector, within

# Settings by which a panorama becomes a room: file, place of the camera, geometry, and their checks.


CLEAR_M = 0.05
"""Least distance of the camera from every wall."""


@dataclass(frozen=True)
class PanoramaSettings:
    """Settings by which a panorama becomes a room.

    Parameters
    ----------
    path : Path
        Absolute; JPEG, PNG, OpenEXR or Radiance HDR, equirectangular.
    point_m : 3 floats
        Place of the camera, world frame: metres from the robot, x its front, z up from the floor.
    heading_deg : float
        Azimuth of the picture's middle column, from world x towards world y.
    box_m : 5 floats, or None
        Walls around the robot: x_low, x_high, y_low, y_high, height. The floor is at 0.
    mesh : MeshSettings, or None
        Geometry of a mesh file, whose colours, emission and lamps are not used; this or a box must be stated.
    texel_m : float
        Least size of a texel.
    radiance_scale : float, or None
        W/(m^2 sr) per unit of the picture; by default the mean irradiance from all directions becomes 1 W/m^2.
    laser_albedo : float
        Of all surfaces.
    stroke_m : float
        Largest stroke that the box must leave room for; a mesh has its own.
    name : str
    """

    path: Path
    point_m: Vector
    heading_deg: float = 0.0
    box_m: Vector | None = None
    mesh: MeshSettings | None = None
    texel_m: float = 0.008
    radiance_scale: float | None = None
    laser_albedo: float = 0.5
    stroke_m: float = 1.4
    name: str = "panorama"

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))
        object.__setattr__(self, "point_m", finite_vector("PanoramaSettings", "point_m", self.point_m, 3))
        within("PanoramaSettings", "heading_deg", self.heading_deg, -360.0, 360.0)
        within("PanoramaSettings", "texel_m", self.texel_m, 5e-4, 1.0)
        within("PanoramaSettings", "laser_albedo", self.laser_albedo, 0.0, 1.0)
        within("PanoramaSettings", "stroke_m", self.stroke_m, 0.0, 10.0)
        if self.radiance_scale is not None:
            within("PanoramaSettings", "radiance_scale", self.radiance_scale, 1e-9, 1e9)
        if (self.box_m is None) == (self.mesh is None):
            raise RoomError("PanoramaSettings: state the geometry by box_m or by mesh, one of them and not both")
        if self.mesh is not None and self.mesh.lamps:
            raise RoomError(
                "PanoramaSettings.mesh has lamps: the walls of a panorama shine by themselves; leave them out"
            )
        if self.box_m is not None:
            self._check_box(finite_vector("PanoramaSettings", "box_m", self.box_m, 5))

    def _check_box(self, box: Vector) -> None:
        object.__setattr__(self, "box_m", box)
        low, high = np.array([box[0], box[2], 0.0]), np.array([box[1], box[3], box[4]])
        extent, text = high - low, f"PanoramaSettings.box_m = {box}"
        for axis in range(2):
            if extent[axis] <= 0.0:
                names = f"{'xy'[axis]}_low = {low[axis]:g} is not below {'xy'[axis]}_high = {high[axis]:g}"
                raise RoomError(f"{text}: {names}; give x_low, x_high, y_low, y_high, height in this order")
        if extent.min() < EXTENT_M[0] or extent.max() > EXTENT_M[1]:
            raise RoomError(
                f"{text} (x_low, x_high, y_low, y_high, height) measures {extent[0]:.3g} x {extent[1]:.3g} x "
                f"{extent[2]:.3g} m: a room measures {EXTENT_M[0]:g} to {EXTENT_M[1]:g} m each way; move the walls"
            )
        robot_low, robot_high = robot_box()
        if np.any(low[:2] > robot_low[:2]) or np.any(high[:2] < robot_high[:2]):
            (x_low, y_low), (x_high, y_high) = robot_low[:2], robot_high[:2]
            raise RoomError(
                f"{text}: the robot, x {x_low:.2f} to {x_high:.2f} m and y {y_low:.2f} to {y_high:.2f} m, must stand "
                "between the walls; the box counts from the robot, so x_low and y_low are below 0"
            )
        if box[4] < MIRROR_TOP_M + self.stroke_m:
            raise RoomError(
                f"{text}: the ceiling is lower than the mirror, which rises to {MIRROR_TOP_M + self.stroke_m:.2f} m "
                f"with a stroke of {self.stroke_m:g} m; take a shorter stroke or check the height"
            )
        point = np.array(self.point_m)
        if np.any(point < low + CLEAR_M) or np.any(point > high - CLEAR_M):
            inside = zip("xyz", low + CLEAR_M, high - CLEAR_M, strict=True)
            clear = ", ".join(f"{axis} {least:g} to {most:g} m" for axis, least, most in inside)
            raise RoomError(
                f"PanoramaSettings.point_m = {self.point_m}: the camera must be inside the box, {CLEAR_M:g} m or "
                f"more from its walls: {clear}; move it or the walls"
            )


MEAN_IRRADIANCE_W_M2 = 1.0
"""Pi times the mean radiance of all directions, mean of the three bands, unless a scale is stated: about 300 lx."""
_RAYS = 32  # all around from the camera, to see whether it is inside
_INSIDE = 0.75  # part of the rays from the camera that must meet the mesh: a window or a door may be open
_AT_ONCE = 1 << 16  # texels


def panorama_room(settings: PanoramaSettings) -> Room:
    """Room whose surfaces show a panorama; the same settings and the same files give the same room.

    Raises
    ------
    RoomError
        If a file cannot be read, the picture is no panorama or black, or the camera is not inside the geometry.
    """
    light = read_panorama(settings.path)
    light *= np.float32(_scale(settings, light))  # in place: a large panorama takes 400 MB
    picture = _Panorama(light, settings)
    if settings.mesh is None:
        return Room(settings.name, _box(settings, picture))
    parts = placed_parts(settings.mesh)
    _check_inside(settings, parts)
    corners = np.concatenate([corners_of(part) for part in parts])
    bitmap, texels = _atlas(settings, picture, corners)
    ends = np.cumsum([len(part.triangles) for part in parts])[:-1]
    pairs = zip(parts, np.split(texels, ends), strict=True)
    return Room(settings.name, (), tuple(mesh_shape(part, bitmap, each) for part, each in pairs))


def blank_room(settings: PanoramaSettings) -> Room:
    """Room of a panorama that is not there yet: the same box, and the same light from everywhere.

    Geometry and the laser's albedo are those of `panorama_room`, so that spots can be planned.
    """
    settings = replace(settings, texel_m=1.0)  # an even light needs no fine texels
    return Room(settings.name, _box(settings, _Panorama(np.ones((16, 32, 3), np.float32), settings)))


def _scale(settings: PanoramaSettings, light: Light) -> float:
    """W/(m^2 sr) per unit of the picture."""
    if settings.radiance_scale is not None:
        return settings.radiance_scale
    rows = len(light)
    weight = np.cos((0.5 - (np.arange(rows) + 0.5) / rows) * math.pi)
    mean = float(np.average(light.mean(axis=(1, 2), dtype=float), weights=weight))
    if not mean > 0.0:
        raise RoomError(f"{settings.path} is black: a panorama must show light")
    return MEAN_IRRADIANCE_W_M2 / (math.pi * mean)


class _Panorama:
    """Radiance by direction, at steps of its angle that halve from level to level."""

    def __init__(self, light: Light, settings: PanoramaSettings) -> None:
        self.point, self.heading = np.array(settings.point_m), math.radians(settings.heading_deg)
        self.step_rad = math.pi / len(light)
        self.levels = [light]
        while min(self.levels[-1].shape[:2]) >= 32:  # the coarsest level still has some texels a wall
            self.levels.append(_halved(self.levels[-1]))

    def texel_m(self, texel_m: float, distance_m: Array) -> Array:
        """Size of texels at distances from the camera: the stated one, or a pixel's."""
        return np.maximum(texel_m, self.step_rad * distance_m)

    def mean(self, centres_m: Array, x_m: Array, y_m: Array) -> NDArray[np.float32]:
        """Radiance, shape (N, 3), of texels at centres, shape (N, 3), with sides x and y, shape (N, 3)."""
        result = np.empty((len(centres_m), 3), np.float32)
        for start in range(0, len(centres_m), _AT_ONCE):
            rows = slice(start, start + _AT_ONCE)
            result[rows] = self._mean(centres_m[rows] - self.point, x_m[rows], y_m[rows])
        return result

    def _mean(self, centres: Array, x: Array, y: Array) -> NDArray[np.float32]:
        size = np.sqrt(np.maximum(np.einsum("ni,ni->n", x, x), np.einsum("ni,ni->n", y, y)))
        pixels = size / (self.step_rad * np.linalg.norm(centres, axis=1))
        level = np.clip(np.floor(np.log2(np.maximum(pixels, 1.0))), 0, len(self.levels) - 1).astype(int)
        result = np.empty((len(centres), 3), np.float32)
        for number in np.unique(level):
            for mine, places in (
                (np.flatnonzero((level == number) & (pixels <= 1.0)), ((0.0, 0.0),)),
                (np.flatnonzero((level == number) & (pixels > 1.0)), _QUARTERS),
            ):
                if len(mine):
                    samples = (
                        _bilinear(self.levels[number], self._place(centres[mine] + a * x[mine] + b * y[mine]))
                        for a, b in places
                    )
                    result[mine] = sum(samples, np.zeros((len(mine), 3), np.float32)) / len(places)
        return result

    def _place(self, directions: Array) -> Array:
        """Column and row as parts of the picture's width and height, shape (N, 2), of directions of any length."""
        d = directions
        azimuth = np.arctan2(d[:, 1], d[:, 0]) - self.heading
        elevation = np.arctan2(d[:, 2], np.hypot(d[:, 0], d[:, 1]))
        return np.stack([0.5 - azimuth / (2.0 * math.pi), 0.5 - elevation / math.pi], axis=-1)


_QUARTERS = ((-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25))  # middles of a texel's quarters


def _halved(light: Light) -> Light:
    """Half as many rows and columns, averaged over areas."""
    size = (light.shape[1] // 2, light.shape[0] // 2)
    bands = [Image.fromarray(np.ascontiguousarray(light[..., k])).resize(size, Image.Resampling.BOX) for k in range(3)]
    return np.stack([np.asarray(band) for band in bands], axis=-1)


def _bilinear(light: Light, place: Array) -> NDArray[np.float32]:
    """Values, shape (N, 3), between the four pixels around; columns go round, rows end at the poles."""
    rows, columns = light.shape[:2]
    column, row = place[:, 0] * columns - 0.5, place[:, 1] * rows - 0.5
    left, upper = np.floor(column), np.floor(row)
    s, t = (column - left).astype(np.float32)[:, None], (row - upper).astype(np.float32)[:, None]
    i, j = left.astype(np.int64) % columns, upper.astype(np.int64)
    k, (low, high) = (i + 1) % columns, (np.clip(j + d, 0, rows - 1) for d in (0, 1))
    flat = light.reshape(-1, 3)
    corners = (flat.take(v * columns + u, axis=0) for v in (low, high) for u in (i, k))
    weights = ((1.0 - s) * (1.0 - t), s * (1.0 - t), (1.0 - s) * t, s * t)
    return np.asarray(sum(w * c for w, c in zip(weights, corners, strict=True)), np.float32)


# A box.


def _box(settings: PanoramaSettings, picture: _Panorama) -> tuple[Rectangle, ...]:
    assert settings.box_m is not None
    x0, x1, y0, y1, height = settings.box_m
    x, y, z = 0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * height
    walls = [
        rectangle("floor", (x, y, 0.0), (0.0, 0.0, 1.0), (x1 - x0, y1 - y0)),
        rectangle("ceiling", (x, y, height), (0.0, 0.0, -1.0), (x1 - x0, y1 - y0)),
        rectangle("wall_west", (x0, y, z), (1.0, 0.0, 0.0), (y1 - y0, height)),
        rectangle("wall_east", (x1, y, z), (-1.0, 0.0, 0.0), (y1 - y0, height)),
        rectangle("wall_south", (x, y0, z), (0.0, 1.0, 0.0), (x1 - x0, height)),
        rectangle("wall_north", (x, y1, z), (0.0, -1.0, 0.0), (x1 - x0, height)),
    ]
    times = 1.0
    while sum(4 * math.prod(_texels(wall, picture, times * settings.texel_m)) for wall in walls) > MOST_VALUES:
        times *= 1.02  # until all bitmaps together fit
    return tuple(_photographed(settings, wall, picture, times * settings.texel_m) for wall in walls)


def _texels(wall: Rectangle, picture: _Panorama, texel_m: float) -> tuple[int, int]:
    """Rows and columns of a wall's bitmap, one beyond each edge included."""
    normal = wall.T_world_shape.R[:, 2]
    distance = np.abs((picture.point - wall.T_world_shape.t) @ normal)
    size = float(picture.texel_m(texel_m, distance))
    return math.ceil(wall.size_m[1] / size) + 2, math.ceil(wall.size_m[0] / size) + 2


def _photographed(settings: PanoramaSettings, wall: Rectangle, picture: _Panorama, texel_m: float) -> Rectangle:
    rows, columns = _texels(wall, picture, texel_m)
    size = (wall.size_m[0] / (columns - 2), wall.size_m[1] / (rows - 2))
    origin = (-0.5 * wall.size_m[0] - size[0], -0.5 * wall.size_m[1] - size[1])
    row, column = np.mgrid[:rows, :columns] + 0.5
    x, y = origin[0] + column.ravel() * size[0], origin[1] + row.ravel() * size[1]
    pose = wall.T_world_shape
    centres = pose.points(np.stack([x, y, np.zeros_like(x)], axis=-1))
    sides = [np.broadcast_to(pose.R[:, k] * size[k], centres.shape) for k in (0, 1)]
    radiance = picture.mean(centres, *sides).reshape(rows, columns, 3)
    return Rectangle(wall.name, pose, wall.size_m, _bitmap(settings, radiance, size, origin))


def _bitmap(settings: PanoramaSettings, radiance: NDArray[np.float32], texel_m: Vector, origin_m: Vector) -> Bitmap:
    laser = np.full((*radiance.shape[:2], 1), settings.laser_albedo, np.float32)
    return Bitmap(np.concatenate([radiance, laser], axis=-1), texel_m, origin_m, is_radiance=True)


# A mesh.


def _check_inside(settings: PanoramaSettings, parts: tuple[MeshPart, ...]) -> None:
    """Refuse a camera from which too many rays leave the mesh without meeting it."""
    corners = np.concatenate([corners_of(part) for part in parts])
    k = np.arange(_RAYS) + 0.5
    z, turn = 1.0 - 2.0 * k / _RAYS, math.pi * (1.0 + math.sqrt(5.0)) * k  # Fibonacci's sphere
    flat = np.sqrt(1.0 - z * z)
    rays = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=-1)
    corners = corners - np.array(settings.point_m)
    reach = np.array([_nearest_hit(corners, ray) for ray in rays])
    met = float(np.isfinite(reach).mean())
    if met < _INSIDE or reach.min() < CLEAR_M:
        where = "touches a surface" if met >= _INSIDE else f"sees a surface in {100.0 * met:.0f} % of all directions"
        raise RoomError(
            f"PanoramaSettings.point_m = {settings.point_m}: the camera {where}; it must be inside the mesh, where at "
            f"least {100.0 * _INSIDE:.0f} % of all directions are closed, and {CLEAR_M:g} m from every surface"
        )


def _nearest_hit(corners: Array, ray: Array) -> float:
    """Distance from the origin along a ray to the nearest of triangles, shape (N, 3, 3); infinite if it meets none.

    T. Moeller and B. Trumbore, J. Graphics Tools 2, 21 (1997).
    """
    a, one, two = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(ray, two)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / np.einsum("ni,ni->n", one, across)
        u = -np.einsum("ni,ni->n", a, across) * scale
        turned = np.cross(-a, one)
        v = turned @ ray * scale
        t = np.einsum("ni,ni->n", two, turned) * scale
        hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0)
    return float(np.min(t[hit], initial=np.inf))


@dataclass(frozen=True, eq=False)
class _Block:
    """Frames of triangles: x along the first side, texels from the lower left one, which lies beyond the corner."""

    origin_m: Array
    x: Array
    y: Array
    local_m: Array
    texel_m: Array
    columns: NDArray[np.int64]
    rows: NDArray[np.int64]


def _atlas(settings: PanoramaSettings, picture: _Panorama, corners: Array) -> tuple[Bitmap, Array]:
    """One bitmap with a block for each triangle, and the places of the corners on it, shape (N, 3, 2)."""
    texel_m = settings.texel_m
    while True:
        block = _blocks(picture, corners, texel_m)
        column, row, width, height = _packed(block.columns, block.rows)
        if 4 * width * height <= MOST_VALUES:
            break  # it fits
        if texel_m > EXTENT_M[1]:
            raise RoomError(
                f"the mesh has too many triangles ({len(corners)}) for the texels of a panorama: simplify it"
            )
        texel_m *= max(1.02, math.sqrt(4.0 * width * height / MOST_VALUES))  # 1.02: rounding may stand still
    radiance = np.zeros((height * width, 3), np.float32)
    counts = block.columns * block.rows
    ends = np.cumsum(counts)
    batches = np.searchsorted(ends, np.arange(0, int(ends[-1]), 4 * _AT_ONCE))
    for first, last in zip(batches, [*batches[1:], len(counts)], strict=True):
        if last > first:
            which = np.repeat(np.arange(first, last), counts[first:last])
            number = np.arange(len(which)) - np.repeat(ends[first:last] - counts[first:last], counts[first:last])
            number += int(ends[first] - counts[first])
            i, j = number % block.columns[which], number // block.columns[which]
            size = block.texel_m[which, None]
            x, y = block.x[which] * size, block.y[which] * size
            centres = block.origin_m[which] + (i - 0.5)[:, None] * x + (j - 0.5)[:, None] * y
            radiance[(row[which] + j) * width + column[which] + i] = picture.mean(centres, x, y)
    texels = np.stack([column, row], axis=-1)[:, None] + 1.0 + block.local_m / block.texel_m[:, None, None]
    return _bitmap(settings, radiance.reshape(height, width, 3), (1.0, 1.0), (0.0, 0.0)), texels


def _blocks(picture: _Panorama, corners: Array, texel_m: float) -> _Block:
    along, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(along, other)
    area, length = np.linalg.norm(normal, axis=1), np.linalg.norm(along, axis=1)
    # a triangle without a plane of its own
    flat = area <= 1e-12 * np.maximum(length, np.linalg.norm(other, axis=1)) ** 2
    safe = np.where(flat, 1.0, area)[:, None]
    normal = np.where(flat[:, None], [0.0, 0.0, 1.0], normal / safe)
    x = np.where(flat[:, None], [1.0, 0.0, 0.0], along / np.where(flat, 1.0, length)[:, None])
    y = np.cross(normal, x)
    local = np.stack([np.einsum("nki,ni->nk", corners - corners[:, :1], axis) for axis in (x, y)], axis=-1)
    local[flat] = 0.0
    low = local.min(axis=1)
    local = local - low[:, None]
    origin = corners[:, 0] + low[:, :1] * x + low[:, 1:] * y
    distance = np.abs(np.einsum("ni,ni->n", corners[:, 0] - picture.point, normal))
    size = picture.texel_m(texel_m, distance)
    # a texel around each for interpolation
    count = np.ceil(local.max(axis=1) / size[:, None] - 1e-9).astype(np.int64) + 2
    return _Block(origin, x, y, local, size, count[:, 0], count[:, 1])


def _packed(columns: NDArray[np.int64], rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
    """Column and row of the lower left texel of each block, and width and height: shelves of falling height."""
    width = max(int(columns.max()), math.ceil(math.sqrt(float((columns * rows).sum()))))
    column, row = np.empty(len(columns), np.int64), np.empty(len(columns), np.int64)
    u, v, shelf = 0, 0, 0
    order = np.lexsort((np.arange(len(rows)), -columns, -rows))
    for k in order.tolist():
        if u + int(columns[k]) > width:
            u, v, shelf = 0, v + shelf, 0
        column[k], row[k] = u, v
        u, shelf = u + int(columns[k]), max(shelf, int(rows[k]))
    return column, row, np.int64(width), np.int64(v + shelf)  # type: ignore[return-value]
