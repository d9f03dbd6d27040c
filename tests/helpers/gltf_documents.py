"""glTF documents of one square that a test fills, array by array."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from phibench.datasets.rooms.mesh_parts import MeshPart
from phibench.datasets.rooms.mesh_placement import read_mesh

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)


class Gltf:
    """Document of one square that a test fills."""

    def __init__(self) -> None:
        self.data = b""
        self.tree: dict[str, Any] = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": [], "materials": []}
        self.tree |= {"images": [], "textures": [], "samplers": [], "nodes": [{"name": "square", "mesh": 0}]}
        self.tree |= {"scenes": [{"nodes": [0]}], "scene": 0}
        self.primitive: dict[str, Any] = {"attributes": {"POSITION": self.array(SQUARE)}, "mode": 6}
        self.tree["meshes"] = [{"primitives": [self.primitive]}]

    def view(self, data: bytes, **more: Any) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **more})
        self.data += data
        return len(self.tree["bufferViews"]) - 1

    def array(self, values: Any, **more: Any) -> int:
        values = np.asarray(values)
        kinds = {"f4": 5126, "u1": 5121, "u2": 5123, "u4": 5125, "i1": 5120, "i2": 5122}
        shape = ["SCALAR", "VEC2", "VEC3", "VEC4"][0 if values.ndim == 1 else values.shape[1] - 1]
        accessor = {"componentType": kinds[values.dtype.str[1:]], "count": len(values), "type": shape, **more}
        accessor.setdefault("bufferView", self.view(values.tobytes()))
        self.tree["accessors"].append(accessor)
        return len(self.tree["accessors"]) - 1

    def texture(self, pixels: np.ndarray, **sampler: Any) -> int:
        stream = io.BytesIO()
        Image.fromarray(pixels).save(stream, "PNG")
        self.tree["images"].append({"bufferView": self.view(stream.getvalue()), "mimeType": "image/png"})
        self.tree["samplers"].append(sampler)
        row = {"source": len(self.tree["images"]) - 1, "sampler": len(self.tree["samplers"]) - 1}
        self.tree["textures"].append(row)
        return len(self.tree["textures"]) - 1

    def material(self, **row: Any) -> None:
        self.tree["materials"].append(row)
        self.primitive["material"] = 0

    def read(self, folder: Path) -> tuple[MeshPart, ...]:
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        tree = {**self.tree, "buffers": [{"byteLength": len(self.data), "uri": uri}]}
        tree = {key: value for key, value in tree.items() if value != []}
        (folder / "one.gltf").write_text(json.dumps(tree))
        return read_mesh(folder / "one.gltf")

    def one(self, folder: Path) -> MeshPart:
        [part] = self.read(folder)
        return part
