"""Room of a mesh file: a mesh for each part, textures averaged to small bitmaps, emission as lamps or shining surfaces.

Albedo is the file's base colour, linear, cut to the largest one. Metals, gloss and transparency are not kept: a window
pane is an opaque surface of its colour. The laser's albedo is that of band R.

A texture finer than `texel_m` is averaged down to it, over areas, in linear light. All bitmaps of a room hold at most
16 million values: if more would be needed, all texels grow alike. The reduced bitmap is the definition of the room.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from phibench.datasets.common.input_files import InputFile
from phibench.datasets.rooms.gltf_file import lights_without_surface
from phibench.datasets.rooms.mesh_lights import LitPictures, lamps_of, merged_places, split_by_light
from phibench.datasets.rooms.mesh_parts import REMEDY, MeshPart, Paint, Picture
from phibench.datasets.rooms.mesh_placement import (
    MIRROR_TOP_M,
    MeshSettings,
    corners_of,
    heights_on_vertical,
    placed_parts,
)
from phibench.datasets.rooms.room_files import RoomError
from phibench.render.sensor.srgb import srgb_decoded
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.room import Room
from phibench.scenes.shapes import Bitmap, Mesh, Texture, Uniform

MOST_VALUES = 16_000_000
"""Of all bitmaps of a room, four a texel."""
_LINEAR = srgb_decoded(np.arange(256) / 255.0)  # of every code of a picture
_BESIDE_M = (0.0013, 0.0007)  # a vertical beside the axis: on it, triangles like to meet


def mesh_room(settings: MeshSettings) -> Room:
    """Room of a mesh file; the same settings and the same file give the same room.

    Raises
    ------
    RoomError
        If the file or its size is not a room's, or nothing in it shines.
    """
    lit = LitPictures()
    parts = [piece for part in placed_parts(settings) for piece in split_by_light(part, lit)]
    _check_lights(settings)
    lamps, meshes = lamps_of(settings, parts)
    if not lamps and not any(part.light for part in meshes):
        raise RoomError(
            f"{settings.path} has no material that emits light, and no lamps are stated: without light the room is "
            "black; add [[rooms.meshes.lamps]], or materials with an emission"
        )
    paints = [_paint(settings, part) for part in meshes]
    bitmaps = _bitmaps(settings, meshes, paints)
    shapes = tuple(mesh_shape(part, *bitmaps[k]) for k, part in enumerate(meshes))
    return Room(settings.name, lamps, shapes)


def _check_lights(settings: MeshSettings) -> None:
    """Refuse lights of a file that have no surface, unless lamps are stated in their places."""
    if settings.lamps or settings.path.suffix.lower() not in (".glb", ".gltf"):
        return
    if count := lights_without_surface(InputFile(settings.path, REMEDY, RoomError)):
        raise RoomError(
            f"{settings.path} has {count} lights without a surface (KHR_lights_punctual), which are not read: state "
            "lamps in their places as [[rooms.meshes.lamps]], or take them away"
        )


# Bitmaps.


@dataclass(frozen=True, eq=False)
class _Wanted:
    """Colours of a part: one for all triangles, one for each, or a picture with the places of the corners."""

    factor: Array
    picture: Picture | None
    uv: Array | None
    face_values: Array | None
    is_radiance: bool


def _paint(settings: MeshSettings, part: MeshPart) -> _Wanted:
    if part.light is not None:
        factor = settings.emission_w_m2_sr * np.array(part.light.colour)
        return _Wanted(factor, part.light.picture, part.light.uv, None, True)
    paint = part.paint or Paint(settings.plain_albedo)
    return _Wanted(np.array(paint.colour), paint.picture, paint.uv, paint.face_colours, False)


def _bitmaps(
    settings: MeshSettings, parts: list[MeshPart], wanted: list[_Wanted]
) -> list[tuple[Texture, Array | None]]:
    """Texture and places of the corners of each part; parts that share a picture share a bitmap."""
    groups: dict[tuple[int, bytes, bool], list[int]] = {}
    for number, want in enumerate(wanted):
        if want.picture is not None:
            groups.setdefault((id(want.picture), want.factor.tobytes(), want.is_radiance), []).append(number)
    fixed = sum(4 * len(want.face_values) for want in wanted if want.face_values is not None)
    shrink = {key: _shrink(settings.texel_m, [(parts[k], wanted[k]) for k in group]) for key, group in groups.items()}
    sizes = {key: _picture(wanted[group[0]]).shape[:2] for key, group in groups.items()}
    times = _common_factor(shrink, sizes, fixed)
    result: list[tuple[Texture, Array | None]] = [_plain(settings, want) for want in wanted]
    for key, group in groups.items():
        bitmap = _reduced(settings, wanted[group[0]], times * shrink[key])
        rows, columns = bitmap.values.shape[:2]
        for k in group:
            uv = wanted[k].uv
            assert uv is not None
            result[k] = (bitmap, uv * np.array([columns, rows], float))
    return result


def _picture(want: _Wanted) -> Picture:
    assert want.picture is not None
    return want.picture


def _shrink(texel_m: float, group: list[tuple[MeshPart, _Wanted]]) -> float:
    """Factor, from 1, by which a picture's pixels are finer than the wanted texels, on average over its triangles."""
    metres, pixels = 0.0, 0.0
    for part, want in group:
        assert want.uv is not None
        height, width = _picture(want).shape[:2]
        one, two = (want.uv[:, k] - want.uv[:, 0] for k in (1, 2))
        pixels += 0.5 * width * height * float(np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]).sum())
        corners = corners_of(part)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        metres += 0.5 * float(np.linalg.norm(normal, axis=1).sum())
    return max(1.0, texel_m * math.sqrt(pixels / metres)) if metres > 0.0 else 1.0


Key = tuple[int, bytes, bool]


def _common_factor(shrink: dict[Key, float], sizes: dict[Key, tuple[int, ...]], fixed: int) -> float:
    """Factor, from 1, by which all texels grow so that the room's bitmaps hold few enough values."""
    times = 1.0
    while True:
        total = sum(4 * math.prod(_shape(sizes[key], times * shrink[key])) for key in sizes)
        if total + fixed <= MOST_VALUES or max(map(max, sizes.values()), default=0) < times:
            return times
        times *= max(1.01, math.sqrt(total / max(MOST_VALUES - fixed, 1)))  # 1.01: rounding of sizes may stand still


def _shape(size: tuple[int, ...], shrink: float) -> tuple[int, int]:
    """Rows and columns of a reduced picture."""
    return max(1, round(size[0] / shrink)), max(1, round(size[1] / shrink))


def _reduced(settings: MeshSettings, want: _Wanted, shrink: float) -> Bitmap:
    """Bitmap of a picture, averaged over areas in linear light."""
    picture = _picture(want)
    rows, columns = _shape(picture.shape[:2], shrink)
    bands = []
    for k in range(3):
        linear = (_LINEAR[picture[::-1, :, k]] * want.factor[k]).astype(np.float32)
        if (rows, columns) != linear.shape:
            linear = np.asarray(Image.fromarray(linear).resize((columns, rows), Image.Resampling.BOX))
        bands.append(linear)
    return _bitmap(settings, np.stack(bands, axis=-1), want.is_radiance)


def _bitmap(settings: MeshSettings, values: NDArray[Any], is_radiance: bool) -> Bitmap:
    """Bitmap of three bands, shape (rows, columns, 3); the laser's albedo is 0 on what shines, else that of R."""
    if is_radiance:
        laser = np.zeros_like(values[..., :1])
        return Bitmap(np.concatenate([values, laser], axis=-1), (1.0, 1.0), is_radiance=True)
    albedo = np.clip(values, 0.0, settings.largest_albedo)
    return Bitmap(np.concatenate([albedo, albedo[..., :1]], axis=-1), (1.0, 1.0))


def _plain(settings: MeshSettings, want: _Wanted) -> tuple[Texture, Array | None]:
    """Texture of a part without a picture. Colours of triangles stand in a palette, a texel for each colour."""
    if want.face_values is not None:
        colours, index = np.unique(np.float32(want.face_values), axis=0, return_inverse=True)
        columns = math.ceil(math.sqrt(len(colours)))
        values = np.zeros((math.ceil(len(colours) / columns) * columns, 3), np.float32)
        values[: len(colours)] = colours
        row, column = np.divmod(index.reshape(-1), columns)
        place = np.stack([column + 0.5, row + 0.5], axis=-1)
        bitmap = _bitmap(settings, values.reshape(-1, columns, 3), want.is_radiance)
        return bitmap, np.repeat(place[:, None], 3, axis=1)
    if want.is_radiance:
        return _bitmap(settings, want.factor.reshape(1, 1, 3), True), None
    return Uniform(as_vector(np.clip(want.factor, 0.0, settings.largest_albedo))), None


# Shapes.


def mesh_shape(part: MeshPart, texture: Texture, texels: Array | None) -> Mesh:
    """Shape of a part: without the vertices that it does not use, one-sided where it may be."""
    used, index = np.unique(part.triangles, return_inverse=True)
    triangles = index.reshape(-1, 3)
    if isinstance(texture, Bitmap) and texels is None:
        texels = np.full((*triangles.shape, 2), 0.5)
    two_sided = part.two_sided or not _one_sided(part)
    return Mesh(part.name, part.vertices[used], triangles, texture, texels, two_sided)


def _one_sided(part: MeshPart) -> bool:
    """Return True for a closed part whose normals look at the mirror's side: outwards, or inwards if it holds it."""
    corners, index = corners_of(part), merged_places(part)
    edges = np.concatenate([index[:, [0, 1]], index[:, [1, 2]], index[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    count = int(index.max()) + 1
    forth, back = np.sort(edges @ [count, 1]), np.sort(edges @ [1, count])
    if len(forth) == 0 or not (np.array_equal(forth, back) and np.all(forth[1:] > forth[:-1])):
        return False  # an open edge, or one of three triangles: no solid
    a, b, c = np.moveaxis(corners, 1, 0)
    outwards = float(np.einsum("ti,ti->", a, np.cross(b, c))) > 0.0
    above = heights_on_vertical([part], _BESIDE_M)[0] > MIRROR_TOP_M
    return outwards != bool(above.sum() % 2)
