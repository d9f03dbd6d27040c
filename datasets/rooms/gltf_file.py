"""Reader of glTF files (.glb, .gltf): triangles of the shown nodes, with their colours, textures, opacity and emission.

glTF 2.0 (Khronos Group, 2021; ISO/IEC 12113:2022). Lists, strips and fans of triangles are read; points and lines have
no surface. Base colours, emission and their pictures are read, each by its own coordinates. Metal, gloss and relief are
not kept. What is wholly transparent is not there; a picture with holes is refused, and what is half transparent counts
as opaque. Skins, instances and compressed arrays are refused by name.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.rooms.gltf_arrays import GltfDocument
from phibench.datasets.rooms.gltf_material import GltfMaterial, GltfTexture, gltf_material
from phibench.datasets.rooms.mesh_parts import (
    ROUNDED,
    Companions,
    MeshPart,
    Opacity,
    Paint,
    Picture,
    check_count,
    check_parts,
    is_no_picture,
    leaves_picture,
    opacities,
)
from phibench.datasets.rooms.samplers import finer, framed, mirrored, nearest_places, reaches_edge
from phibench.scenes.frames import Array, Vector
from phibench.scenes.validation import printable_line

_LIGHTS = "KHR_lights_punctual"
_READ_EXTENSIONS = (
    "KHR_texture_transform",
    _LIGHTS,
    "KHR_mesh_quantization",
    "EXT_texture_webp",
    "KHR_node_visibility",
    "KHR_materials_",
)
_CONVERTERS = {
    "KHR_draco_mesh_compression": "`gltf-transform cp IN.glb OUT.glb` unpacks it",
    "EXT_meshopt_compression": "`gltf-transform cp IN.glb OUT.glb` unpacks it",
    "KHR_meshopt_compression": "`gltf-transform cp IN.glb OUT.glb` unpacks it",
    "KHR_texture_basisu": "`ktx extract` of KTX-Software makes PNG of its pictures",
}
_LIST, _STRIP, _FAN = 4, 5, 6  # modes of primitives: TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN
_WITHOUT_SURFACE = (0, 1, 2, 3)  # POINTS, LINES, LINE_LOOP, LINE_STRIP
_REPEAT, _MIRRORED, _CLAMPED = 10497, 33648, 33071  # wrapS and wrapT
_NEAREST = 9728  # magFilter


def gltf_parts(file: InputFile, companions: Companions) -> list[MeshPart]:
    """Parts of a glTF file, one for each primitive of a node.

    Raises
    ------
    RoomError
        If it is damaged, has what is not read, or names a file that is not there.
    """
    return _Reader(GltfDocument(file, companions)).parts()


def lights_without_surface(file: InputFile) -> int:
    """Lights of a glTF file that are points or directions (KHR_lights_punctual), which no part shows.

    Raises
    ------
    RoomError
        If the file is damaged.
    """
    reader = _Reader(GltfDocument(file, Companions(file, False)))
    return sum(_LIGHTS in reader.document.table(node, "extensions") for _, node, _ in reader.nodes())


class _Reader:
    """Parts of a document."""

    def __init__(self, document: GltfDocument) -> None:
        self.document, self.file = document, document.file
        self._refuse_unread()
        self.materials = [gltf_material(document, row) for row in document.rows("materials")]
        self._pictures: dict[int, Picture] = {}
        self._opacities: dict[int, Opacity | None] = {}
        self._sources: dict[tuple[Any, Any], int] = {}
        self._repeats: dict[tuple[int, str], NDArray[np.uint8]] = {}
        self._seen: set[int] = set()
        self._count = 0

    def parts(self) -> list[MeshPart]:
        """All triangles of the scene."""
        mesh_parts: list[MeshPart] = []
        for number, node, transform in self.nodes():
            if "mesh" in node:
                mesh_parts += self._of_node(number, node, transform)
                check_parts(self.file, len(mesh_parts))
        check_count(self.file, self._count)
        return mesh_parts

    def nodes(self) -> Iterator[tuple[int, dict[str, Any], Array]]:
        """Nodes that are shown: number, table, place in the scene."""
        waiting = deque((number, np.eye(4)) for number in self._roots())
        while waiting:
            number, outer = waiting.popleft()
            node = self.document.row("nodes", number)
            if number in self._seen:
                raise self.file.fault("is damaged: its nodes are no trees")
            self._seen.add(number)
            if self._is_hidden(node):
                continue  # what is below a hidden node is hidden, too
            transform = outer @ self._transform(node)
            yield number, node, transform
            waiting += [(child, transform) for child in node.get("children", [])]

    def _roots(self) -> list[Any]:
        """Nodes of the scene that is shown; of a file without scenes all that are no node's children."""
        document = self.document
        scenes = document.rows("scenes")
        if scenes:
            return list(document.row("scenes", document.tree.get("scene", 0)).get("nodes", []))
        rows = document.rows("nodes")
        children = {child for node in rows for child in node.get("children", [])}
        return [number for number in range(len(rows)) if number not in children]

    def _is_hidden(self, node: dict[str, Any]) -> bool:
        """Tell whether a node and what hangs on it are not shown (KHR_node_visibility)."""
        extensions = self.document.table(node, "extensions")
        return not self.document.truth(self.document.table(extensions, "KHR_node_visibility"), "visible", True)

    def _refuse_unread(self) -> None:
        names = [str(name) for name in self.document.tree.get("extensionsRequired", [])]
        for name in names:
            if not name.startswith(_READ_EXTENSIONS):
                how = f": {_CONVERTERS[name]}" if name in _CONVERTERS else ""
                raise self.file.fault(f"needs the glTF extension {printable_line(name, 60)}, which is not read{how}")

    # Places.

    def _transform(self, node: dict[str, Any]) -> Array:
        document = self.document
        if "matrix" in node:
            matrix = np.array(document.numbers(node, "matrix", (0.0,) * 16)).reshape(4, 4).T  # glTF stores columns
        else:
            x, y, z, w = document.numbers(node, "rotation", (0.0, 0.0, 0.0, 1.0))
            length = math.sqrt(x * x + y * y + z * z + w * w)
            if not 0.5 < length < 2.0:
                raise self._misplaced(node)
            x, y, z, w = (c / length for c in (x, y, z, w))
            matrix = np.eye(4)
            matrix[:3, :3] = [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
            matrix[:3, :3] *= document.numbers(node, "scale", (1.0, 1.0, 1.0))
            matrix[:3, 3] = document.numbers(node, "translation", (0.0, 0.0, 0.0))
        if not np.isfinite(matrix).all() or np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > ROUNDED:
            raise self._misplaced(node)
        return matrix

    def _misplaced(self, node: dict[str, Any]) -> DatasetError:
        shown = printable_line(str(node.get("name", "")), 60)
        return self.file.fault(f"has a node '{shown}' whose place is not finite, or no place")

    # Triangles.

    def _of_node(self, number: int, node: dict[str, Any], transform: Array) -> list[MeshPart]:
        mesh = self.document.row("meshes", node["mesh"])
        label = str(node.get("name") or mesh.get("name") or f"node {number}")
        shown = printable_line(label, 60)
        if "skin" in node:
            raise self.file.fault(f"has a node '{shown}' that a skeleton bends (a skin): apply it before the export")
        if "EXT_mesh_gpu_instancing" in self.document.table(node, "extensions"):
            raise self.file.fault(f"has copies of '{shown}' as instances (EXT_mesh_gpu_instancing): make them nodes")
        weights = node.get("weights", mesh.get("weights", []))
        primitives = mesh.get("primitives", [])
        if not isinstance(primitives, list) or not all(isinstance(primitive, dict) for primitive in primitives):
            raise self.file.fault("is damaged: 'primitives' is not a list of tables")
        parts = (self._of_primitive(label, primitive, transform, weights) for primitive in primitives)
        return [part for part in parts if part is not None]

    def _of_primitive(self, label: str, primitive: dict[str, Any], transform: Array, weights: Any) -> MeshPart | None:
        document, shown = self.document, printable_line(label, 60)
        mode = primitive.get("mode", _LIST)
        if mode in _WITHOUT_SURFACE:
            return None  # points and lines
        if mode not in (_LIST, _STRIP, _FAN):
            raise self.file.fault(f"has a primitive of mode {mode!s:.20} in '{shown}', which glTF does not know")
        if "KHR_draco_mesh_compression" in document.table(primitive, "extensions"):
            how = _CONVERTERS["KHR_draco_mesh_compression"]
            raise self.file.fault(
                f"has '{shown}' compressed by Draco (KHR_draco_mesh_compression), which is not read: {how}"
            )
        attributes = document.table(primitive, "attributes")
        if "POSITION" not in attributes:
            return None  # the definition: such a primitive is not drawn
        points = self._morphed(primitive, document.array(attributes["POSITION"], 3), weights)
        triangles = self._triangles(primitive, mode, len(points))
        if not len(triangles):
            return None  # an empty primitive, which exporters leave
        self._count += len(triangles)
        check_count(self.file, self._count)
        material = self._material_of(primitive)
        triangles = self._visible(label, material, attributes, triangles, len(points))
        if not len(triangles):
            return None  # wholly transparent
        if np.linalg.det(transform[:3, :3]) < 0.0:
            triangles = triangles[:, ::-1]  # a mirrored node turns its triangles around
        paint, light = self._paints(label, attributes, triangles, material, len(points))
        name = f"{label}/{material.name}" if material is not None and material.name else label
        placed = points @ transform[:3, :3].T + transform[:3, 3]
        return MeshPart(name, placed, triangles, paint, light, material is not None and material.two_sided)

    def _triangles(self, primitive: dict[str, Any], mode: int, count: int) -> NDArray[np.int64]:
        if "indices" in primitive:
            stored = self.document.raw_array(primitive["indices"], 1)
            if stored.dtype.kind != "u":
                raise self.file.fault("is damaged: indices are whole numbers without sign")
            index = stored[:, 0].astype(np.int64)
        else:
            index = np.arange(count)
        if len(index) and index.max() >= count:
            raise self.file.fault("has triangles with vertices that are not there")
        if mode == _LIST:
            if len(index) % 3:
                raise self.file.fault(f"is damaged: {len(index)} corners make no whole number of triangles")
            return index.reshape(-1, 3)
        if len(index) < 3:
            return np.zeros((0, 3), np.int64)
        if mode == _FAN:
            return np.stack([index[1:-1], index[2:], np.full(len(index) - 2, index[0])], axis=1)
        three = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
        three[1::2] = three[1::2][:, [0, 2, 1]]
        return three

    def _morphed(self, primitive: dict[str, Any], points: Array, weights: Any) -> Array:
        targets = primitive.get("targets", [])
        if not isinstance(weights, list) or not isinstance(targets, list):
            raise self.file.fault("is damaged: weights and targets are lists")
        for weight, target in zip(weights, targets, strict=False):
            if weight and isinstance(target, dict) and "POSITION" in target:
                moves = self.document.array(target["POSITION"], 3)
                if len(moves) != len(points):
                    raise self.file.fault("is damaged: a morph target does not move every vertex")
                points = points + float(weight) * moves
        return points

    # Materials.

    def _material_of(self, primitive: dict[str, Any]) -> GltfMaterial | None:
        if "material" not in primitive:
            return None
        self.document.row("materials", primitive["material"])
        return self.materials[primitive["material"]]

    def _visible(
        self,
        label: str,
        material: GltfMaterial | None,
        attributes: dict[str, Any],
        triangles: NDArray[np.int64],
        count: int,
    ) -> NDArray[np.int64]:
        """Triangles of which something is seen; one with holes is refused."""
        if material is None or material.cutoff is None:
            return triangles
        uv = alpha = corners = None
        if material.picture is not None and (alpha := self._opacity(material)) is not None:
            alpha, uv = self._placed(label, material, material.picture, attributes, triangles, alpha)
        if (colours := self._vertex_colours(attributes, count)) is not None and colours.shape[1] == 4:
            corners = colours[triangles][..., 3]
        least, most = opacities(len(triangles), material.opacity, corners, uv, alpha).T
        hidden = most < material.cutoff
        holes = ~hidden & (least < material.cutoff)
        if holes.any():
            shown = printable_line(f"{label}/{material.name}", 60)
            raise self.file.fault(f"has holes in '{shown}' (alphaMode): cut the surface along them, or make it OPAQUE")
        return triangles[~hidden]

    def _opacity(self, material: GltfMaterial) -> Opacity | None:
        """Alpha of the picture of a material's base colour."""
        assert material.picture is not None
        number = self._image(self.document.row("textures", material.picture.index))
        if number not in self._opacities:
            self._opacities[number] = self.document.companions.opacity(*self._encoded(number))
        return self._opacities[number]

    def _paints(
        self,
        label: str,
        attributes: dict[str, Any],
        triangles: NDArray[np.int64],
        material: GltfMaterial | None,
        count: int,
    ) -> tuple[Paint | None, Paint | None]:
        colours = self._vertex_colours(attributes, count)
        if material is None:
            # without a material the definition takes a white one; a file that states no colour gets the plain one
            return (None if colours is None else Paint(face_colours=colours[triangles][..., :3].mean(axis=1))), None
        paint = self._paint(label, material, material.colour, material.picture, attributes, triangles)
        if colours is not None:
            paint = self._tinted(label, paint, colours, triangles)
        if max(material.light) <= 0.0:
            return paint, None
        return paint, self._paint(label, material, material.light, material.light_picture, attributes, triangles)

    def _tinted(self, label: str, paint: Paint, colours: Array, triangles: NDArray[np.int64]) -> Paint:
        """Vertex colours multiply the material's."""
        if paint.picture is None:
            return Paint(face_colours=colours[triangles][..., :3].mean(axis=1) * np.array(paint.colour))
        used = colours[triangles][..., :3].reshape(-1, 3)
        if np.ptp(used, axis=0).max() > 0.5 / 255.0:
            shown = printable_line(label, 60)
            raise self.file.fault(f"has '{shown}' with vertex colours that tint a picture: put them into the picture")
        return replace(paint, colour=tuple(float(a * b) for a, b in zip(paint.colour, used.mean(axis=0), strict=True)))

    def _vertex_colours(self, attributes: dict[str, Any], count: int) -> Array | None:
        """Linear colours of vertices, shape (N, 3), or (N, 4) with their opacity."""
        if "COLOR_0" not in attributes:
            return None
        stored = self.document.raw_array(attributes["COLOR_0"], (3, 4))
        scale = float(np.iinfo(stored.dtype).max) if stored.dtype.kind in "iu" else 1.0
        colours = stored.astype(float) / scale
        if len(colours) != count or not np.isfinite(colours).all() or colours.min(initial=0.0) < 0.0:
            raise self.file.fault("is damaged: colours of vertices are not one for each, from 0 up")
        return np.minimum(colours, 1.0)

    def _paint(
        self,
        label: str,
        material: GltfMaterial,
        colour: Vector,
        texture: GltfTexture | None,
        attributes: dict[str, Any],
        triangles: NDArray[np.int64],
    ) -> Paint:
        if texture is None:
            return Paint(colour)
        row = self.document.row("textures", texture.index)
        pixels = self._picture(material, row)
        return Paint(colour, *self._placed(label, material, texture, attributes, triangles, pixels))

    def _placed(
        self,
        label: str,
        material: GltfMaterial,
        texture: GltfTexture,
        attributes: dict[str, Any],
        triangles: NDArray[np.int64],
        pixels: NDArray[np.uint8],
    ) -> tuple[NDArray[np.uint8], Array]:
        """Pixels, and the corners' places on them, v upwards, as the sampler says."""
        corners = self._corners(label, material, texture, attributes, triangles)
        pixels, corners = self._repeated(self.document.row("textures", texture.index), pixels, corners, label)
        return pixels, np.stack([corners[..., 0], 1.0 - corners[..., 1]], axis=-1)

    def _corners(
        self,
        label: str,
        material: GltfMaterial,
        texture: GltfTexture,
        attributes: dict[str, Any],
        triangles: NDArray[np.int64],
    ) -> Array:
        """Texture coordinates of the triangles' corners, v downwards, shape (M, 3, 2)."""
        name = f"TEXCOORD_{texture.uv_set}"
        if name not in attributes:
            shown = printable_line(f"{label}/{material.name}", 60)
            raise self.file.fault(f"has no texture coordinates {name} in '{shown}', which its picture needs")
        uv = self._moved(self.document.array(attributes[name], 2), texture.transform)
        if triangles.max() >= len(uv):
            raise self.file.fault("is damaged: texture coordinates are not one for each vertex")
        return np.asarray(uv[triangles])

    def _moved(self, uv: Array, stated: dict[str, Any]) -> Array:
        """Coordinates after KHR_texture_transform: scale, then turn, then shift."""
        if not stated:
            return uv
        scale = np.array(self.document.numbers(stated, "scale", (1.0, 1.0)))
        shift = np.array(self.document.numbers(stated, "offset", (0.0, 0.0)))
        angle = self.document.number(stated, "rotation", 0.0, least=-1e6)
        c, s = math.cos(angle), math.sin(angle)
        return uv * scale @ np.array([[c, -s], [s, c]]) + shift

    def _repeated(
        self, texture: dict[str, Any], pixels: NDArray[np.uint8], uv: Array, label: str
    ) -> tuple[NDArray[np.uint8], Array]:
        """Pixels and coordinates, v downwards, whose endless bilinear repeat is what the sampler says."""
        sampler = self.document.row("samplers", texture["sampler"]) if "sampler" in texture else {}
        shown, modes = printable_line(label, 60), [sampler.get(key, _REPEAT) for key in ("wrapS", "wrapT")]
        for axis, mode in enumerate(modes):
            if mode not in (_REPEAT, _MIRRORED, _CLAMPED):
                raise self.file.fault(f"has a picture in '{shown}' whose wrap {mode!s:.20} glTF does not know")
            if mode == _CLAMPED and leaves_picture(uv, axis):
                raise self.file.fault(
                    f"has a picture in '{shown}' that ends at its edges (CLAMP_TO_EDGE) beside it: repeat it"
                )
        size = np.array(pixels.shape[1::-1])
        if axes := [axis for axis, mode in enumerate(modes) if mode == _MIRRORED and leaves_picture(uv, axis)]:
            pixels, uv = self._once(pixels, "mirrored", axes, mirrored), uv * np.where(np.isin((0, 1), axes), 0.5, 1.0)
        # within a picture the mirror images begin as a clamped edge goes on
        ends = [axis for axis, mode in enumerate(modes) if mode != _REPEAT and axis not in axes]
        if sampler.get("magFilter") == _NEAREST:
            uv = nearest_places(uv, np.array(pixels.shape[1::-1]), ends)
            return self._once(pixels, "finer", (0, 1), finer), uv
        if edges := [axis for axis in ends if reaches_edge(uv, axis, size[axis])]:
            wide = np.where(np.isin((0, 1), edges), 1.0, 0.0)
            uv = (uv * size + wide) / (size + 2.0 * wide)
            pixels = self._once(pixels, "framed", edges, framed)
        return pixels, uv

    def _once(
        self, pixels: NDArray[np.uint8], kind: str, axes: Sequence[int], make: Callable[[Any, Sequence[int]], Any]
    ) -> NDArray[np.uint8]:
        """Changed copy of pixels, made once: a thousand parts share it."""
        key = (id(pixels), f"{kind}{axes}")
        if key not in self._repeats:
            self._repeats[key] = make(pixels, axes)
        return self._repeats[key]

    def _image(self, texture: dict[str, Any]) -> int:
        """Number of the image of a texture, the first of those that have the same bytes."""
        extensions = self.document.table(texture, "extensions")
        source = self.document.table(extensions, "EXT_texture_webp").get("source", texture.get("source"))
        if source is None and "KHR_texture_basisu" in extensions:
            how = _CONVERTERS["KHR_texture_basisu"]
            raise self.file.fault(f"has pictures as KTX2 (KHR_texture_basisu), which is not read: {how}")
        if source is None and extensions:
            shown = printable_line(str(next(iter(extensions))), 60)
            raise self.file.fault(f"has pictures of the glTF extension {shown}, which is not read")
        image = self.document.row("images", source)
        return self._sources.setdefault((image.get("bufferView"), image.get("uri")), int(source or 0))

    def _picture(self, material: GltfMaterial, texture: dict[str, Any]) -> Picture:
        number = self._image(texture)
        if number not in self._pictures:
            self._pictures[number] = self._decoded(material, number)
        return self._pictures[number]

    def _encoded(self, number: int) -> tuple[InputFile, bytes]:
        """Bytes of an image, and the file that they are from."""
        image, companions = self.document.row("images", number), self.document.companions
        uri = image.get("uri")
        if "bufferView" not in image and isinstance(uri, str) and not uri.startswith("data:"):
            file = companions.named(uri, is_uri=True)
            return file, file.read()
        inside = "bufferView" in image
        return self.file, bytes(self.document.view(image["bufferView"])[0]) if inside else self.document.of_uri(uri)

    def _decoded(self, material: GltfMaterial, number: int) -> Picture:
        owner, data = self._encoded(number)
        try:
            return self.document.companions.pixels(owner, data)
        except DatasetError as error:
            if owner is not self.file or not is_no_picture(error):
                raise
            shown = printable_line(material.name, 60)
            raise self.file.fault(f"has a material '{shown}' whose texture is missing or damaged") from error
