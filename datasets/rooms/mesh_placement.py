"""Mesh file read by its format and placed around the robot by `MeshSettings`: unit, axes, floor, lamps, free space.

The user states the metres of a unit, the axis that points up, and the point of the floor on which the robot stands. The
world's origin is that point. The floor below it comes to z = 0. Then the numbers are checked: a room measures 2 to
100 m, and nothing stands in the robot or in the way of the mirror.

Files (glTF, OBJ, PLY) are parts of one material each, with linear colours. Each format is read by its definition in a
module of its own. What a file states is read rightly or refused by name: a reading library would pass over it, or make
it up. Pictures, the colours of OBJ materials and vertex colours of OBJ and PLY are sRGB. Factors and vertex colours of
glTF are linear by its specification. A triangle with vertex colours has their mean.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.rooms.gltf_file import gltf_parts
from phibench.datasets.rooms.mesh_parts import (
    REMEDY,
    Companions,
    MeshPart,
    check_count,
    check_part,
    check_parts,
    damage_error,
    named_parts,
)
from phibench.datasets.rooms.mesh_polygons import CuttingError
from phibench.datasets.rooms.obj_file import obj_parts
from phibench.datasets.rooms.ply_file import ply_parts
from phibench.datasets.rooms.room_files import RoomError
from phibench.scenes.frames import Array, Vector
from phibench.scenes.room import chassis
from phibench.scenes.validation import finite_vector, positive, unit_vector, within

_READERS = {".glb": gltf_parts, ".gltf": gltf_parts, ".obj": obj_parts, ".ply": ply_parts}
SUFFIXES = tuple(_READERS)


def read_mesh(path: Path, one_file: bool = False) -> tuple[MeshPart, ...]:
    """Read the parts of a mesh file, in the order of their names; `one_file` refuses one that names others.

    Raises
    ------
    RoomError
        If the file is missing, damaged, of another kind, without triangles, has what is not read, or names what is not
        there.
    """
    file = InputFile(path, REMEDY, RoomError)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise RoomError(f"{path} is no mesh: give a file that ends in {', '.join(SUFFIXES)}")
    try:
        with np.errstate(all="ignore"):
            parts = reader(file, Companions(file, one_file))
    except (DatasetError, MemoryError):
        raise
    except CuttingError as error:
        raise file.fault(f"has {error}: export triangles") from error
    except Exception as error:  # documents and arrays can contradict each other in any way
        raise damage_error(file) from error
    named = named_parts(part for part in parts if len(part.triangles))
    check_count(file, sum(len(part.triangles) for part in named))
    check_parts(file, len(named))
    for part in named:
        check_part(file, part)
    return named


# -- mesh files --------------------------------------------------------------------------------------------------------

EXTENT_M = (2.0, 100.0)  # of a room: a wrong unit leaves these limits
FLOOR_REACH_M = 0.10
"""Largest distance of the stated point from the floor."""
MIRROR_TOP_M = 0.80
"""Height of the mirror's upper end at the down position, with some room to spare."""
_COLUMN_M = 0.12  # half width of what camera, mirror and mast need: the mirror's radius and as much again
_FLOOR_M = 0.03  # below this a surface is floor: carpets and sills are driven over
_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "feet": 0.3048, "metres": 1.0}


@dataclass(frozen=True)
class MeshLamp:
    """Rectangular lamp in a mesh room, world frame: metres from the robot, x its front, z up.

    Parameters
    ----------
    centre_m : 3 floats
    normal : 3 floats
        Of the side that shines.
    size_m : 2 floats
    radiance_w_m2_sr : 3 floats
        Bands R, G, B.
    """

    centre_m: Vector
    normal: Vector
    size_m: Vector
    radiance_w_m2_sr: Vector = (3.6, 3.2, 2.4)

    def __post_init__(self) -> None:
        for name, length in (("centre_m", 3), ("size_m", 2), ("radiance_w_m2_sr", 3)):
            object.__setattr__(self, name, finite_vector("MeshLamp", name, getattr(self, name), length))
        object.__setattr__(self, "normal", unit_vector("MeshLamp", "normal", self.normal))
        for value in self.size_m:
            positive("MeshLamp", "size_m", value)
        for value in self.radiance_w_m2_sr:
            within("MeshLamp", "radiance_w_m2_sr", value, 0.0, 1e5)
        if max(self.radiance_w_m2_sr) <= 0.0:
            raise RoomError(
                f"MeshLamp.radiance_w_m2_sr = {self.radiance_w_m2_sr}: a lamp shines; give a band above 0, or leave "
                "the lamp out"
            )


@dataclass(frozen=True)
class MeshSettings:
    """Settings by which a mesh file becomes a room.

    Parameters
    ----------
    path : Path
        Absolute; .glb, .gltf, .obj or .ply.
    metres_per_unit : float
        1 for metres, 0.01 for centimetres; must be stated.
    up_axis : "y" or "z"
        Axis of the file that points up; must be stated. glTF has "y".
    floor_point : 3 floats
        Place on the floor where the robot stands, in units and axes of the file; must be stated.
    heading_deg : float
        Turn of the robot's front from the file's x axis, against the clock seen from above.
    lamps : lamps beside those of the file, at most 12
    emission_w_m2_sr : float
        Radiance of a material that emits 1.
    texel_m : float
        Textures finer than this are averaged down to it; the result defines the room.
    largest_albedo : float
        Colours are cut to it: no wall is white as 255.
    plain_albedo : 3 floats
        Of parts whose colour the file does not state.
    stroke_m : float
        Largest stroke for which the mirror's way is checked.
    name : str
    one_file : bool
        Refuse a file that names others, such as textures.
    """

    path: Path
    metres_per_unit: float | None = None
    up_axis: str | None = None
    floor_point: Vector | None = None
    heading_deg: float = 0.0
    lamps: tuple[MeshLamp, ...] = ()
    emission_w_m2_sr: float = 3.6
    texel_m: float = 0.005
    largest_albedo: float = 0.9
    plain_albedo: Vector = (0.5, 0.5, 0.5)
    stroke_m: float = 1.4
    name: str = "mesh"
    one_file: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))
        self._check_placement()
        within("MeshSettings", "heading_deg", self.heading_deg, -360.0, 360.0)
        within("MeshSettings", "emission_w_m2_sr", self.emission_w_m2_sr, 0.0, 1e5)
        within("MeshSettings", "texel_m", self.texel_m, 5e-4, 1.0)
        within("MeshSettings", "largest_albedo", self.largest_albedo, 0.01, 1.0)
        within("MeshSettings", "stroke_m", self.stroke_m, 0.0, 10.0)
        object.__setattr__(self, "plain_albedo", finite_vector("MeshSettings", "plain_albedo", self.plain_albedo, 3))
        for value in self.plain_albedo:
            if not 0.0 <= value <= self.largest_albedo:
                raise RoomError(
                    f"MeshSettings.plain_albedo = {self.plain_albedo}: allowed range is 0 to largest_albedo, "
                    f"{self.largest_albedo:g}; give darker ones or a larger largest_albedo"
                )
        object.__setattr__(self, "lamps", tuple(self.lamps))
        within("MeshSettings", "number of lamps", len(self.lamps), 0, 12)

    def _check_placement(self) -> None:
        if self.metres_per_unit is None:
            raise RoomError(
                "MeshSettings.metres_per_unit is not stated: a mesh file does not say how long its unit is; give 1 for "
                "metres, 0.01 for centimetres, 0.001 for millimetres"
            )
        within("MeshSettings", "metres_per_unit", self.metres_per_unit, 1e-6, 1e4)
        if self.up_axis not in ("y", "z"):
            raise RoomError(f"MeshSettings.up_axis = {self.up_axis!r}: state which axis points up, 'y' or 'z'")
        if self.floor_point is None:
            raise RoomError(
                "MeshSettings.floor_point is not stated: give the place on the floor where the robot stands, three "
                "numbers in units and axes of the file"
            )
        point = finite_vector("MeshSettings", "floor_point", self.floor_point, 3)
        object.__setattr__(self, "floor_point", point)


def placed_parts(settings: MeshSettings) -> tuple[MeshPart, ...]:
    """Parts of the file in the world frame, metres, checked.

    Raises
    ------
    RoomError
        If the file cannot be read, the room's size is not plausible, there is no floor, or something is in the way.
    """
    with np.errstate(all="ignore"):  # a number beyond all measure fails the check of the extent
        parts = [
            replace(part, vertices=_to_world(settings, part.vertices))
            for part in read_mesh(settings.path, settings.one_file)
        ]
    _check_extent(settings, parts)
    floor = _floor_height(settings, parts)
    parts = [replace(part, vertices=part.vertices - np.array([0.0, 0.0, floor])) for part in parts]
    _check_free(settings, parts)
    return tuple(parts)


def corners_of(part: MeshPart) -> Array:
    """Corners of the triangles, shape (M, 3, 3)."""
    return part.vertices[part.triangles]


def _to_world(settings: MeshSettings, points: Array) -> Array:
    """World coordinates, with z from the stated point."""
    assert settings.metres_per_unit is not None
    moved = (points - np.array(settings.floor_point)) * settings.metres_per_unit
    if settings.up_axis == "y":
        moved = np.stack([moved[:, 0], -moved[:, 2], moved[:, 1]], axis=-1)
    turn = math.radians(settings.heading_deg)
    c, s = math.cos(turn), math.sin(turn)
    return np.asarray(moved @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


def _check_extent(settings: MeshSettings, parts: list[MeshPart]) -> None:
    low = np.min([corners_of(part).min(axis=(0, 1)) for part in parts], axis=0)
    high = np.max([corners_of(part).max(axis=(0, 1)) for part in parts], axis=0)
    extent = high - low
    if np.isfinite(extent).all() and extent.min() >= EXTENT_M[0] and extent.max() <= EXTENT_M[1]:
        return  # a room's size: the unit is right
    assert settings.metres_per_unit is not None
    units = extent / settings.metres_per_unit
    fits = [
        f"{metres:g} ({name})"
        for name, metres in _UNITS.items()
        if (units * metres).min() >= EXTENT_M[0] and (units * metres).max() <= EXTENT_M[1]
    ]
    advice = f"metres_per_unit = {' or '.join(fits)} would fit" if fits else "check metres_per_unit and up_axis"
    raise RoomError(
        f"{settings.path} measures {extent[0]:.3g} x {extent[1]:.3g} x {extent[2]:.3g} m with metres_per_unit = "
        f"{settings.metres_per_unit:g}: a room measures {EXTENT_M[0]:g} to {EXTENT_M[1]:g} m each way; {advice}"
    )


def heights_on_vertical(parts: Sequence[MeshPart], xy_m: Vector = (0.0, 0.0)) -> list[Array]:
    """Heights, metres, rising, at which a vertical crosses each part."""
    heights, foot = [], np.array([*xy_m, 0.0])
    for part in parts:
        a, b, c = np.moveaxis(corners_of(part) - foot, 1, 0)
        area = _cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = -_cross(a, c - a) / area, -_cross(b - a, a) / area
            inside = (area != 0.0) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
        z = a[inside, 2] + u[inside] * (b - a)[inside, 2] + v[inside] * (c - a)[inside, 2]
        heights.append(np.sort(z))
    return heights


def _cross(a: Array, b: Array) -> Array:
    """Vertical part of the cross product of vectors (N, 3)."""
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _floor_height(settings: MeshSettings, parts: list[MeshPart]) -> float:
    heights = np.concatenate(heights_on_vertical(parts))
    near = heights[np.abs(heights) <= FLOOR_REACH_M]
    if len(near):
        return float(near[np.argmin(np.abs(near))])
    nearest = f"the nearest surface there is {heights[np.argmin(np.abs(heights))]:+.2f} m off" if len(heights) else ""
    raise RoomError(
        f"{settings.path} has no floor within {FLOOR_REACH_M:g} m of floor_point {settings.floor_point}; "
        f"{nearest or 'no surface lies above or below it'}; check floor_point, up_axis = {settings.up_axis!r} and units"
    )


def robot_box() -> tuple[Array, Array]:
    """Lower and upper corner of the box around the robot's chassis, above what counts as floor, metres."""
    signs = 0.5 * np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
    points = np.concatenate([box.T_world_shape.points(signs * np.array(box.size_m)) for box in chassis()])
    return np.array([*points.min(axis=0)[:2], _FLOOR_M]), points.max(axis=0)


def _check_free(settings: MeshSettings, parts: list[MeshPart]) -> None:
    low, high = robot_box()
    top = MIRROR_TOP_M + settings.stroke_m
    for part in parts:
        corners = corners_of(part)
        if meets_box(corners, low, high).any():
            size = high - low
            raise RoomError(
                f"'{part.name}' stands where the robot is, {size[0]:.2f} x {size[1]:.2f} x {high[2]:.2f} m around "
                f"floor_point; choose another floor_point or heading_deg in {settings.path}"
            )
        column = np.array([_COLUMN_M, _COLUMN_M, top])
        if meets_box(corners, np.array([-_COLUMN_M, -_COLUMN_M, high[2]]), column).any():
            raise RoomError(
                f"'{part.name}' is in the way of the mirror, which rises to {top:.2f} m with a stroke of "
                f"{settings.stroke_m:g} m; take a shorter stroke, another floor_point, or check metres_per_unit"
            )


def meets_box(corners_m: Array, low_m: Array, high_m: Array) -> NDArray[np.bool_]:
    """Triangles, shape (N, 3, 3), that have a point in an upright box: bool, shape (N,).

    No axis separates them: the box's, the triangle's normal, and the products of their edges (T. Akenine-Moller,
    J. Graphics Tools 6, 29, 2001).
    """
    near = np.all((corners_m.min(axis=1) < high_m) & (corners_m.max(axis=1) > low_m), axis=1)
    if not near.any():
        return near
    p, half = corners_m[near] - 0.5 * (low_m + high_m), 0.5 * (high_m - low_m)
    edges = np.roll(p, -1, axis=1) - p
    axes = [np.cross(edges[:, i], np.eye(3)[k]) for i in range(3) for k in range(3)]
    axes.append(np.cross(edges[:, 0], edges[:, 1]))
    meets = np.ones(len(p), dtype=bool)
    for axis in axes:
        along = np.einsum("nki,ni->nk", p, axis)
        reach = np.abs(axis) @ half
        meets &= (along.min(axis=1) <= reach) & (along.max(axis=1) >= -reach)
    result = near.copy()
    result[near] = meets
    return result
