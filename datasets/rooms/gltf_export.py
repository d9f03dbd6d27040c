"""Writer of glTF files (.glb): a room with one node for each shape, textures as PNG inside, lamps as emission.

World z becomes y, as glTF has it. Albedos are written for the bands R, G, B, textures in sRGB of 8 bits. An emission of
1 is 1 W/(m^2 sr), with `KHR_materials_emissive_strength` above 1. The sun, coats and the albedo at the laser's
wavelength have no place in it, and the robot is no part of a room. The same room gives the same bytes.
"""

from __future__ import annotations

import io
import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from phibench.render.optics.faces import FaceTable, face_table
from phibench.render.sensor.srgb import srgb_encoded
from phibench.scenes.frames import Array, Vector
from phibench.scenes.room import Room
from phibench.scenes.shapes import Bitmap, Checker, Shape, Texture, Uniform

_CELL = 64  # texels along a side of a checker's cell
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942  # "glTF", "JSON" and "BIN" as numbers
_FLOAT, _UNSIGNED, _PLACES, _VERTICES = 5126, 5125, "VEC2", "VEC3"  # componentType and type of glTF
_STRENGTH = "KHR_materials_emissive_strength"


def glb_of(room: Room) -> bytes:
    """Bytes of a `.glb` file; `MeshSettings(up_axis="y", metres_per_unit=1, emission_w_m2_sr=1)` reads it."""
    document = GltfWriter()
    for shape in (*room.surfaces, *room.furniture):
        document.add(shape)
    return document.encoded(room.name)


class GltfWriter:
    """Parts of a glTF document in the making; equal textures are written once."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._lists: dict[str, list[dict[str, Any]]] = {
            name: [] for name in ("nodes", "meshes", "materials", "textures", "images", "accessors", "bufferViews")
        }
        self._lists["cameras"] = []
        self._textures: dict[Texture, int] = {}

    def add(self, shape: Shape) -> None:
        """Add a shape as a node."""
        table = face_table((shape,))
        attributes = {"POSITION": self._accessor(y_up(table.corners_m.reshape(-1, 3)), _VERTICES)}
        texture = table.textures[0]
        if not isinstance(texture, Uniform) and not table.emits[0]:
            attributes["TEXCOORD_0"] = self._accessor(_places(table), _PLACES)
        self._put_mesh(shape.name, {"attributes": attributes, "material": self._material(shape.name, table)})

    def add_mesh(
        self,
        name: str,
        points_m: Array,
        material: dict[str, Any],
        triangles: NDArray[np.integer[Any]],
        normals: Array | None = None,
    ) -> None:
        """Add a mesh of world points (N, 3) with one material; `triangles` have the shape (M, 3)."""
        attributes = {"POSITION": self._accessor(y_up(points_m), _VERTICES)}
        if normals is not None:
            attributes["NORMAL"] = self._accessor(y_up(normals), _VERTICES)
        corners = np.ascontiguousarray(triangles, "<u4")
        view = self._view(corners.tobytes())
        entry = {"bufferView": view, "componentType": _UNSIGNED, "count": corners.size, "type": "SCALAR"}
        indices = self._put("accessors", entry)
        primitive = {"attributes": attributes, "indices": indices, "material": self._put("materials", material)}
        self._put_mesh(name, primitive)

    def add_camera(self, name: str, perspective: dict[str, float], matrix: Array) -> None:
        """Add a camera whose axes are the columns of a matrix (4, 4) of glTF's world."""
        camera = self._put("cameras", {"name": name, "type": "perspective", "perspective": perspective})
        self._put("nodes", {"name": name, "camera": camera, "matrix": matrix.T.ravel().tolist()})

    @staticmethod
    def emitting(name: str, radiance_w_m2_sr: Vector) -> dict[str, Any]:
        """Black material that shines."""
        light, black = max(radiance_w_m2_sr), {"metallicFactor": 0.0, "baseColorFactor": [0.0, 0.0, 0.0, 1.0]}
        factor = [value / light for value in radiance_w_m2_sr]
        return {"name": name, "pbrMetallicRoughness": black, "emissiveFactor": factor} | _emission(light)

    def _put_mesh(self, name: str, primitive: dict[str, Any]) -> None:
        mesh = self._put("meshes", {"name": name, "primitives": [primitive]})
        self._put("nodes", {"name": name, "mesh": mesh})

    def encoded(self, name: str) -> bytes:
        """Bytes of the file."""
        lists = {key: values for key, values in self._lists.items() if values}
        document = {
            "asset": {"version": "2.0", "generator": "phibench"},
            "extensionsUsed": [_STRENGTH],
            "scene": 0,
            "scenes": [{"name": name, "nodes": list(range(len(self._lists["nodes"])))}],
            **lists,
            "buffers": [{"byteLength": len(self._data)}],
        }
        text = json.dumps(document, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)  # glTF 2.0: a chunk ends at a multiple of four bytes, JSON with spaces
        body = struct.pack("<II", len(text), _JSON) + text
        body += struct.pack("<II", len(self._data), _BIN) + bytes(self._data)
        return struct.pack("<III", _MAGIC, 2, 12 + len(body)) + body  # the length counts these 12 bytes, too

    def _material(self, name: str, table: FaceTable) -> int:
        """Material of a shape, whose faces share one texture."""
        texture, light = table.textures[0], table.radiance_w_m2_sr[0]
        surface: dict[str, Any] = {"metallicFactor": 0.0, "baseColorFactor": [0.0, 0.0, 0.0, 1.0]}
        material: dict[str, Any] = {"name": name, "pbrMetallicRoughness": surface}
        if table.two_sided[0]:
            material["doubleSided"] = True
        if table.emits[0]:
            material |= _emission(float(light.max())) | {"emissiveFactor": (light / light.max()).tolist()}
        elif isinstance(texture, Bitmap) and texture.is_radiance:
            strength = max(float(texture.values[..., :3].max()), 1e-6)  # a dark screen: no division by 0
            material |= _emission(strength) | {"emissiveFactor": [1.0, 1.0, 1.0]}
            material["emissiveTexture"] = {"index": self._texture(texture, texture.values[..., :3] / strength)}
        elif isinstance(texture, Uniform):
            surface["baseColorFactor"] = [*texture.albedo, 1.0]
        else:
            surface["baseColorFactor"] = [1.0, 1.0, 1.0, 1.0]
            surface["baseColorTexture"] = {"index": self._texture(texture, _picture(texture))}
        return self._put("materials", material)

    def _texture(self, texture: Texture, linear: NDArray[np.floating[Any]]) -> int:
        if texture not in self._textures:
            codes = np.rint(255.0 * srgb_encoded(np.asarray(linear[::-1], float))).astype(np.uint8)
            file = io.BytesIO()
            Image.fromarray(codes).save(file, "PNG")
            image = self._put("images", {"bufferView": self._view(file.getvalue()), "mimeType": "image/png"})
            self._textures[texture] = self._put("textures", {"source": image})
        return self._textures[texture]

    def _accessor(self, values: Array, kind: str) -> int:
        data: NDArray[np.float32] = np.ascontiguousarray(values, "<f4")
        accessor = {"bufferView": self._view(data.tobytes()), "componentType": _FLOAT, "count": len(data), "type": kind}
        if kind == _VERTICES:
            accessor |= {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
        return self._put("accessors", accessor)

    def _view(self, data: bytes) -> int:
        start = len(self._data)
        self._data += data + bytes(-len(data) % 4)
        return self._put("bufferViews", {"buffer": 0, "byteOffset": start, "byteLength": len(data)})

    def _put(self, name: str, value: dict[str, Any]) -> int:
        self._lists[name].append(value)
        return len(self._lists[name]) - 1


def y_up(points: Array) -> Array:
    """World vectors, shape (..., 3), in glTF's axes."""
    x, y, z = np.moveaxis(np.asarray(points, float), -1, 0)
    return np.stack([x, z, -y], axis=-1)


def _emission(strength: float) -> dict[str, Any]:
    return {"extensions": {_STRENGTH: {"emissiveStrength": strength}}}


def _places(table: FaceTable) -> Array:
    """Places of all corners on the texture, shape (3 T, 2): (0, 0) its upper left corner, (1, 1) its lower right."""
    texture = table.textures[0]
    rows, columns = texture.values.shape[:2] if isinstance(texture, Bitmap) else (2, 2)
    places = table.places(np.repeat(table.patch, 3), table.corners_m.reshape(-1, 3)) / (columns, rows)
    return np.stack([places[:, 0], 1.0 - places[:, 1]], axis=-1)


def _picture(texture: Texture) -> Array:
    """Albedos, shape (rows, columns, 3), the lowest row first; of a checker two by two cells."""
    if isinstance(texture, Checker):
        even, odd = (np.broadcast_to(each, (_CELL, _CELL, 3)) for each in (texture.albedo_even, texture.albedo_odd))
        return np.block([[[even], [odd]], [[odd], [even]]])
    assert isinstance(texture, Bitmap)
    return np.asarray(texture.values[..., :3])
