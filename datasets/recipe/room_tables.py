"""Tables of rooms in a recipe: the one of `[room]`, and `[rooms]` with generated, photographed and mesh rooms."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, Field, create_model

from phibench.datasets.common.input_files import FILE_NAME, NAME_LENGTH
from phibench.datasets.recipe.distributions import Distribution, Name, Table, ValuesOf, names_of
from phibench.datasets.rooms.mesh_placement import MeshLamp, MeshSettings
from phibench.datasets.rooms.panorama_room import PanoramaSettings
from phibench.scenes.validation import SHA256, SceneError
from phibench.scenes.worlds.room_properties import PROPERTIES, Property

MESH_SUFFIXES = (".glb", ".ply")


class RoomTable(Table):
    """`[room]`."""

    name: Literal["lab", "dark"] = Field(default="lab", description="'dark' is the lab with every lamp off")


# Generated rooms.


def _property(entry: Property) -> Any:
    """Field of a property's distribution, in its range or of its names."""
    kind: Any
    if entry.choices:
        kind = names_of(Literal[entry.choices])
    else:
        values = ValuesOf(Annotated[float, Field(ge=entry.low, le=entry.high)], entry.whole)
        kind = Annotated[Distribution, values] | None
    return kind, Field(default=None, description=entry.meaning)


if TYPE_CHECKING:
    RoomPropertiesTable = Table
else:
    RoomPropertiesTable = create_model(
        "RoomPropertiesTable",
        __base__=Table,
        __doc__="`[rooms.properties]`: distributions of a generated room's properties.",
        **{name: _property(entry) for name, entry in PROPERTIES.items()},
    )


# Rooms of files.


def _is_below(name: str) -> str:
    if len(name) > NAME_LENGTH or re.fullmatch(FILE_NAME, name) is None:
        raise ValueError(
            f"'{name[:60]}' is no file beside the recipe or in a folder below it, named by letters, digits and signs "
            "like _ . - +; put the file there and give its name without '..'"
        )
    return name


def _is_one_file(name: str) -> str:
    if not name.lower().endswith(MESH_SUFFIXES):
        raise ValueError(
            f"'{name}' is no mesh of one file; export it as .glb with its textures inside, or as .ply with colours"
        )
    return name


def _is_picture(name: str) -> str:
    if name.lower().endswith((*MESH_SUFFIXES, ".gltf", ".obj")):
        raise ValueError(
            f"'{name}' is a mesh and no picture; give the panorama here, and the mesh in [rooms.panoramas.mesh] or "
            "[[rooms.meshes]]"
        )
    return name


RoomFile = Annotated[str, AfterValidator(_is_below), AfterValidator(_is_picture)]
MeshFile = Annotated[str, AfterValidator(_is_below), AfterValidator(_is_one_file)]
Digest = Annotated[str, Field(pattern=SHA256, max_length=64)]
HeadingDeg = Annotated[float, Field(ge=-360.0, le=360.0)]
TexelM = Annotated[float, Field(ge=5e-4, le=1.0)]
Unit = Annotated[float, Field(ge=0.0, le=1.0)]
RadianceW = Annotated[float, Field(ge=0.0, le=1e5)]


Three = Annotated[tuple[float, ...], Field(strict=False, min_length=3, max_length=3)]
Five = Annotated[tuple[float, ...], Field(strict=False, min_length=5, max_length=5)]
Albedos = Annotated[tuple[Unit, ...], Field(strict=False, min_length=3, max_length=3)]
Radiances = Annotated[tuple[RadianceW, ...], Field(strict=False, min_length=3, max_length=3)]
SideM = Annotated[float, Field(gt=0.0, le=100.0)]
Sides = Annotated[tuple[SideM, ...], Field(strict=False, min_length=2, max_length=2)]

_FILE = "file in the recipe's folder or below"
_SHA256 = "SHA-256 that the file must have, if given"
_STROKE = "stroke that the room must leave free; the smallest of [random] where not given"


class GeometryTable(Table):
    """`[rooms.panoramas.mesh]`: a mesh as the geometry of a panorama; its colours and lamps are not used."""

    file: MeshFile = Field(description=f"{_FILE}: .glb or .ply")
    sha256: Digest | None = Field(default=None, description=_SHA256)
    metres_per_unit: float = Field(ge=1e-6, le=1e4, description="1 for a file in metres, 0.01 for centimetres")
    up_axis: Literal["y", "z"] = Field(description="axis of the file that points up; glTF has 'y'")
    floor_point: Three = Field(description="where the robot stands on the floor, in units and axes of the file")
    heading_deg: HeadingDeg = Field(
        default=0.0, description="turn of the robot's front from the file's x axis, seen from above"
    )
    stroke_m: float | None = Field(default=None, ge=0.0, le=10.0, description=_STROKE)

    def settings(self, stroke_m: float) -> MeshSettings:
        """Settings of the room, with a path relative to the recipe's folder; `stroke_m` if the table states none.

        Raises
        ------
        SceneError
            If they make no room.
        """
        return MeshSettings(**self._given(stroke_m))

    def _given(self, stroke_m: float) -> dict[str, Any]:
        given = {key: value for key, value in dict(self).items() if key not in ("file", "sha256", "lamps")}
        return given | {"path": Path(self.file), "stroke_m": stroke_m if self.stroke_m is None else self.stroke_m}


class LampTable(Table):
    """`[[rooms.meshes.lamps]]`: a rectangle that shines, beside what the file's materials emit."""

    centre_m: Three = Field(description="world frame: from the robot, x its front, z up from the floor")
    normal: Three = Field(description="direction of the side that shines, world frame; of any length but 0")
    size_m: Sides = Field(description="two sides of the rectangle")
    radiance_w_m2_sr: Radiances = Field(default=(3.6, 3.2, 2.4), description="radiance in the bands R, G, B")


class MeshTable(GeometryTable):
    """`[[rooms.meshes]]`: rooms of mesh files."""

    lamps: Annotated[tuple[LampTable, ...], Field(strict=False, max_length=12)] = Field(
        default=(), description="lamps beside those of the file, at most 12"
    )
    emission_w_m2_sr: RadianceW = Field(default=3.6, description="radiance of a material that emits 1")
    texel_m: TexelM = Field(default=0.005, description="textures finer than this are averaged down to it")
    largest_albedo: float = Field(default=0.9, ge=0.01, le=1.0, description="colours are cut to it")
    plain_albedo: Albedos = Field(default=(0.5, 0.5, 0.5), description="of parts whose colour the file does not state")
    name: Name = Field(default="mesh", description="name of the room")

    def settings(self, stroke_m: float) -> MeshSettings:
        """Settings of the room, as for `GeometryTable`, with its lamps."""
        return MeshSettings(**self._given(stroke_m), lamps=tuple(map(_lamp, range(len(self.lamps)), self.lamps)))


def _lamp(number: int, table: LampTable) -> MeshLamp:
    """Lamp of a table; its faults name its place in the list."""
    try:
        return MeshLamp(**dict(table))
    except SceneError as error:
        raise SceneError(str(error).replace("MeshLamp", f"MeshSettings.lamps[{number}]")) from error


class PanoramaTable(Table):
    """`[[rooms.panoramas]]`: photographed rooms, on a box or on a mesh."""

    file: RoomFile = Field(description=f"{_FILE}: JPEG, PNG, OpenEXR, Radiance HDR; equirectangular")
    sha256: Digest | None = Field(default=None, description=_SHA256)
    point_m: Three = Field(description="place of the camera: from the robot, x its front, z up from the floor")
    heading_deg: HeadingDeg = Field(
        default=0.0, description="azimuth of the picture's middle column, from world x towards world y"
    )
    box_m: Five | None = Field(
        default=None,
        description="walls around the robot: x_low, x_high, y_low, y_high, height; this or [rooms.panoramas.mesh]",
    )
    mesh: GeometryTable | None = Field(default=None, description="geometry of a mesh file, instead of box_m")
    texel_m: TexelM = Field(default=0.008, description="least size of a texel of the walls")
    radiance_scale: float | None = Field(
        default=None,
        ge=1e-9,
        le=1e9,
        description="W/(m^2 sr) per unit of the picture; a mean irradiance of 1 W/m^2 where not given",
    )
    laser_albedo: Unit = Field(default=0.5, description="of all surfaces, at the laser's wavelength")
    stroke_m: float | None = Field(default=None, ge=0.0, le=10.0, description=_STROKE)
    name: Name = Field(default="panorama", description="name of the room")

    def settings(self, stroke_m: float) -> PanoramaSettings:
        """Settings of the room, with paths relative to the recipe's folder; `stroke_m` if the table states none.

        Raises
        ------
        SceneError
            If they make no room.
        """
        stroke_m = stroke_m if self.stroke_m is None else self.stroke_m
        given = {key: value for key, value in dict(self).items() if key not in ("file", "sha256")}
        mesh = None if self.mesh is None else self.mesh.settings(stroke_m)
        return PanoramaSettings(**{**given, "path": Path(self.file), "mesh": mesh, "stroke_m": stroke_m})


class RoomsTable(Table):
    """`[rooms]`: rooms for the samples of `[random]`, which are dealt to them in turn."""

    count: int | None = Field(
        default=None,
        ge=0,
        le=1_000_000,
        description="how many are generated; where not given 1, or 0 beside panoramas or meshes",
    )
    properties: RoomPropertiesTable = Field(
        default_factory=RoomPropertiesTable, description="distributions of what the generated rooms are like"
    )
    panoramas: Annotated[tuple[PanoramaTable, ...], Field(strict=False, max_length=100_000)] = Field(
        default=(), description="photographed rooms"
    )
    meshes: Annotated[tuple[MeshTable, ...], Field(strict=False, max_length=100_000)] = Field(
        default=(), description="rooms of mesh files"
    )

    exported_panoramas: int = Field(
        default=0,
        ge=0,
        le=100_000,
        description="how many further rooms are generated and shown by a panorama of each, on its box",
    )
    exported_meshes: int = Field(
        default=0, ge=0, le=100_000, description="how many further rooms are generated and written as a glTF mesh each"
    )
    panorama_rows: int = Field(
        default=512, ge=16, le=4096, description="rows of an exported panorama; it has twice as many columns"
    )

    @property
    def generated(self) -> int:
        """Number of generated rooms that are rendered as they are."""
        return generated_count(self.count, sum(len(getattr(self, key)) for key in ROOM_LISTS) + self.exported)

    @property
    def exported(self) -> int:
        """Number of generated rooms that become files first."""
        return self.exported_panoramas + self.exported_meshes

    @property
    def pinned(self) -> Mapping[str, str | None]:
        """SHA-256 of the files of all rooms by name, None where the recipe does not state it; in their order."""
        digests: dict[str, str | None] = {}
        for table in self.file_tables:
            digests[table.file] = digests.get(table.file) or table.sha256
        return digests

    @property
    def file_tables(self) -> tuple[PanoramaTable | GeometryTable, ...]:
        """All tables that name a file."""
        geometries = (panorama.mesh for panorama in self.panoramas if panorama.mesh is not None)
        return (*self.panoramas, *geometries, *self.meshes)


ROOM_LISTS = tuple(key for key, field in RoomsTable.model_fields.items() if field.default == ())
"""Keys of `[rooms]` that list rooms one by one."""


def generated_count(count: int | None, others: int) -> int:
    """Number of generated rooms beside others, with `count` as in the recipe."""
    return int(not others) if count is None else count
