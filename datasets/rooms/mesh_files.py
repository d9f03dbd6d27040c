"""Mesh files: glTF (.glb, .gltf), OBJ and PLY as parts of one material each, with linear colours.

`trimesh` reads the geometry. Three things are read here, because it rounds them, or goes on silently without them:
the factors of glTF's materials, which are linear floats; files that a mesh names, which must lie in its folder; and
what is in a file that `trimesh` does not read.

Colours become linear. Pictures, the colours of OBJ materials and vertex colours of OBJ and PLY are sRGB. Factors and
vertex colours of glTF are linear by its specification. A triangle with vertex colours has their mean.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import urllib.parse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.errors import DatasetError
from phibench.datasets.input_files import PICTURE_PIXELS, InputFile
from phibench.datasets.rooms.room_files import RoomError
from phibench.render.sensor.srgb import srgb_decoded
from phibench.scenes.frames import Array, Vector, as_vector
from phibench.scenes.validation import printable_line

MOST_TRIANGLES = 1_000_000
SUFFIXES = (".glb", ".gltf", ".obj", ".ply")
_REMEDY = "export it again as one .glb file with its textures inside"
_DAMAGED = "is damaged: it ends early, or its numbers do not go together"  # the reader's own words name its code
_PICTURES = ("PNG", "JPEG", "BMP", "TGA", "TIFF", "WEBP")
_BLACK: Vector = (0.0, 0.0, 0.0)
_WHITE: Vector = (1.0, 1.0, 1.0)
_BRIGHTEST = 1e6  # of an emission, in units of the file

Picture = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Paint:
    """Colour of a part.

    Attributes
    ----------
    colour : 3 floats, linear; times the picture, where there is one
    picture : uint8 array, shape (H, W, 3), sRGB, upper row first, or None
    uv : array, shape (M, 3, 2), or None
        Place of each triangle's corners on the picture, (0, 0) its lower left corner, (1, 1) its upper right one.
    face_colours : array, shape (M, 3), linear, or None
    """

    colour: Vector = _WHITE
    picture: Picture | None = None
    uv: Array | None = None
    face_colours: Array | None = None

    def of(self, chosen: NDArray[np.bool_]) -> Paint:
        """Paint of some of the triangles."""
        uv = None if self.uv is None else self.uv[chosen]
        return replace(self, uv=uv, face_colours=None if self.face_colours is None else self.face_colours[chosen])


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Triangles of one node with one material.

    Attributes
    ----------
    name : str, unique in its file
    vertices : array, shape (N, 3), in units and axes of the file
    triangles : int array, shape (M, 3)
    paint : Paint, or None where the file states no colour
    light : Paint, what the material emits, or None
    two_sided : bool, as the material says
    """

    name: str
    vertices: Array
    triangles: NDArray[np.int64]
    paint: Paint | None
    light: Paint | None = None
    two_sided: bool = False

    def of(self, chosen: NDArray[np.bool_], name: str) -> MeshPart:
        """Part of some of the triangles, under another name."""
        paint, light = (None if paint is None else paint.of(chosen) for paint in (self.paint, self.light))
        return replace(self, name=name, triangles=self.triangles[chosen], paint=paint, light=light)


def read_mesh(path: Path, one_file: bool = False) -> tuple[MeshPart, ...]:
    """Read the parts of a mesh file, in the order of their names; `one_file` refuses one that names others.

    Raises
    ------
    RoomError
        If the file is missing, damaged, of another kind, without triangles, or names what is not there.
    """
    file = InputFile(path, _REMEDY, RoomError)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise RoomError(f"{path} is no mesh: give a file that ends in {', '.join(SUFFIXES)}")
    try:
        with np.errstate(all="ignore"):
            plain = suffix.removeprefix(".") if suffix in (".obj", ".ply") else ""
            parts = _parts_of_plain(file, plain, one_file) if plain else _parts_of_gltf(file, _Gltf(file), one_file)
    except DatasetError:
        raise
    except Exception as error:  # documents and arrays can contradict each other in any way
        raise file.fault(_DAMAGED) from error
    found = _named([part for part in parts if len(part.triangles)])
    count = sum(len(part.triangles) for part in found)
    if not 0 < count <= MOST_TRIANGLES:
        raise file.fault(f"has {count} triangles: 1 to {MOST_TRIANGLES} are read")
    for part in found:
        _check_numbers(file, part)
    return found


def _check_numbers(file: InputFile, part: MeshPart) -> None:
    if part.vertices.ndim != 2 or part.vertices.shape[1] != 3:
        raise file.fault(f"has vertices that are not three numbers each, in the part '{part.name}'")
    if not np.isfinite(part.vertices).all():
        raise file.fault(f"has vertices that are not finite numbers, in the part '{part.name}'")
    if part.triangles.min() < 0 or part.triangles.max() >= len(part.vertices):
        raise file.fault(f"has triangles with vertices that are not there, in the part '{part.name}'")
    for paint in (part.paint, part.light):
        uv = None if paint is None else paint.uv
        if uv is not None and (uv.shape != (len(part.triangles), 3, 2) or not np.isfinite(uv).all()):
            raise file.fault(f"has texture coordinates that are not pairs of finite numbers, in '{part.name}'")


def _named(parts: list[MeshPart]) -> tuple[MeshPart, ...]:
    """Parts in the order of their names, which are made printable and unique."""
    used: dict[str, int] = {}
    named = []
    for part in sorted(parts, key=lambda part: part.name):
        plain = printable_line(part.name, 80) or "part"
        used[plain] = used.get(plain, 0) + 1
        named.append(replace(part, name=plain if used[plain] == 1 else f"{plain} ({used[plain]})"))
    return tuple(named)


# Files that a mesh names.


class _Folder:
    """Reader of the files that a mesh names, below its folder; it keeps the first fault, which `trimesh` swallows.

    `trimesh` asks by `get` and by index.
    """

    def __init__(self, file: InputFile, one_file: bool, inside: dict[str, bytes] | None = None) -> None:
        self.file, self.one_file, self.inside, self.fault = file, one_file, inside or {}, ""
        self.file_name = file.path.stem

    def get(self, name: str) -> bytes:
        """Bytes of a file."""
        if name in self.inside:
            return self.inside[name]
        plain = urllib.parse.unquote(name.strip()).replace("\\", "/")
        if self.one_file:
            raise self._noted(f"names the file '{printable_line(plain)}', and here a mesh must be one file")
        folder = self.file.path.parent.resolve()
        path = (folder / plain).resolve()
        if not path.is_relative_to(folder):
            raise self._noted(f"names the file '{printable_line(plain)}', which is not in its folder")
        if not path.is_file():
            raise self._noted(f"names the file '{printable_line(plain)}', which is missing")
        found = InputFile(path, _REMEDY, RoomError)
        data = found.read()
        if path.suffix.lower() not in (".mtl", ".bin"):
            try:
                found.picture(_PICTURES, data)
            except DatasetError as error:
                self.fault = self.fault or str(error)
                raise
        return data

    __getitem__ = get

    def _noted(self, text: str) -> FileNotFoundError:
        self.fault = self.fault or str(self.file.fault(text))
        return FileNotFoundError(text)


def _load(file: InputFile, data: bytes, kind: str, folder: _Folder, **options: Any) -> Any:
    """Scene of `trimesh`; its faults are of many kinds."""
    import logging

    try:
        import trimesh
    except ImportError as error:
        raise RoomError("meshes are read by trimesh, which is not installed: pip install 'phibench[render]'") from error
    log = logging.getLogger("trimesh")
    level = log.level
    names: Any = folder  # trimesh takes what answers to `get`; its own class would have to be imported at the top
    log.setLevel(logging.CRITICAL)
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=names, process=False, **options)
    except Exception as error:
        if folder.fault:
            raise RoomError(folder.fault) from error
        raise file.fault(_DAMAGED) from error
    finally:
        log.setLevel(level)
    if folder.fault:
        raise RoomError(folder.fault)
    return scene


class _Pictures:
    """Decoded pictures, each once."""

    def __init__(self, file: InputFile) -> None:
        self.file, self.kept = file, dict[str, Picture]()

    def of(self, image: Any) -> Picture:
        """Pixels of a picture of Pillow."""
        width, height = image.size
        if width * height > PICTURE_PIXELS:
            raise self.file.fault(f"has a texture of {width} x {height} pixels: at most {PICTURE_PIXELS:.0e} are read")
        try:
            pixels = np.asarray(image.convert("RGB"))
        except Exception as error:  # a decoder's faults are of many kinds
            raise self.file.fault(f"has a damaged texture: {printable_line(str(error), 100)}") from error
        return self.kept.setdefault(hashlib.sha256(pixels.tobytes() + str(pixels.shape).encode()).hexdigest(), pixels)


def _geometries(file: InputFile, scene: Any) -> Iterator[tuple[str, str, Any, Array]]:
    """Yield node, geometry's name, geometry and its transform, shape (4, 4), of all that has triangles."""
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if getattr(geometry, "faces", None) is None:
            continue
        # the nodes of a glTF mesh of several primitives have names that trimesh draws at random
        many = geometry.metadata.get("from_gltf_primitive", False)
        label = str(scene.graph.transforms.parents[node] if many else node)
        if not np.isfinite(transform).all():
            raise file.fault(f"has a node '{printable_line(label)}' whose place is not finite")
        yield label, name, geometry, np.asarray(transform, float)


def _placed(geometry: Any, transform: Array) -> tuple[Array, NDArray[np.int64]]:
    """Vertices and triangles in the file's own frame; a mirrored node's triangles turn around."""
    vertices = np.asarray(geometry.vertices, float) @ transform[:3, :3].T + transform[:3, 3]
    triangles = np.asarray(geometry.faces, np.int64).reshape(-1, 3)
    return vertices, triangles[:, ::-1] if np.linalg.det(transform[:3, :3]) < 0.0 else triangles


def _corner_values(values: Any, geometry: Any, transform: Array) -> Array | None:
    """Values of vertices at the corners of the triangles, in the order of `_placed`; None if they do not fit."""
    if values is None or len(values) != len(geometry.vertices) or not len(values):
        return None
    corners = np.asarray(values, float)[np.asarray(geometry.faces, np.int64)]
    return corners[:, ::-1] if np.linalg.det(transform[:3, :3]) < 0.0 else corners


# OBJ and PLY.


def _parts_of_plain(file: InputFile, kind: str, one_file: bool) -> list[MeshPart]:
    data, folder, pictures = file.read(), _Folder(file, one_file), _Pictures(file)
    scene = _load(file, data, kind, folder, **({"split_objects": True} if kind == "obj" else {}))
    parts = []
    for _, name, geometry, transform in _geometries(file, scene):
        vertices, triangles = _placed(geometry, transform)
        label = file.path.stem if kind == "ply" else str(name)
        paint, light = _plain_paint(geometry, transform, pictures)
        parts.append(MeshPart(label, vertices, triangles, paint, light))
    return parts


def _plain_paint(geometry: Any, transform: Array, pictures: _Pictures) -> tuple[Paint | None, Paint | None]:
    visual = geometry.visual
    material = getattr(visual, "material", None)
    if material is None:
        colours = _plain_face_colours(visual, geometry)
        return (None if colours is None else Paint(face_colours=colours)), None
    stated = material.kwargs or {}
    uv = _corner_values(getattr(visual, "uv", None), geometry, transform)
    picture = None if material.image is None or uv is None else pictures.of(material.image)
    light = tuple(min(x, _BRIGHTEST) for x in _numbers(stated.get("ke", ())))
    colour = srgb_decoded(np.clip(np.array(_numbers(stated.get("kd", ())) or _WHITE), 0.0, 1.0))
    named = picture is not None or "kd" in stated
    # a picture replaces Kd: most programs write both and mean the picture alone
    paint = Paint(_WHITE if picture is not None else as_vector(colour), picture, uv if picture is not None else None)
    return (paint if named else None), (Paint(light) if light and max(light) > 0.0 else None)


def _plain_face_colours(visual: Any, geometry: Any) -> Array | None:
    if getattr(visual, "kind", None) not in ("vertex", "face"):
        return None
    if visual.kind == "face":
        return srgb_decoded(np.asarray(visual.face_colors, float)[:, :3] / 255.0)
    linear = srgb_decoded(np.asarray(visual.vertex_colors, float)[:, :3] / 255.0)
    return np.asarray(linear[np.asarray(geometry.faces)].mean(axis=1))


def _numbers(words: Any) -> Vector:
    """Three numbers of a material's line, or none."""
    try:
        values = tuple(float(word) for word in words)
    except (TypeError, ValueError):
        return ()
    return values if len(values) == 3 and all(math.isfinite(value) and value >= 0.0 for value in values) else ()


# glTF.

_BIN = "phibench:bin"  # name under which the binary chunk of a .glb is handed on
_READ_EXTENSIONS = ("KHR_texture_transform", "KHR_lights_punctual", "EXT_texture_webp", "KHR_materials_")
_GLOSSY = "KHR_materials_pbrSpecularGlossiness"


class _Gltf:
    """Document of a glTF file, rewritten so that `trimesh` keeps apart what belongs apart.

    Materials get their number as name; pictures that are neither colour nor emission are left out.
    """

    def __init__(self, file: InputFile) -> None:
        self.file = file
        data = file.read()
        if data[:4] == b"glTF":
            text, binary = self._chunks(data)
            self.tree, self.inside = file.json(text), {_BIN: binary}
            for buffer in self._list("buffers")[:1]:
                buffer.setdefault("uri", _BIN)
        else:
            self.tree, self.inside = file.json(data), {}
        self.materials = [self._material(material) for material in self._list("materials")]
        self._refuse_unread()
        self._rewrite()

    def _list(self, key: str) -> list[dict[str, Any]]:
        found = self.tree.get(key, [])
        if not isinstance(found, list) or not all(isinstance(one, dict) for one in found):
            raise self.file.fault(f"is damaged: '{key}' is not a list of tables")
        return found

    def _chunks(self, data: bytes) -> tuple[bytes, bytes]:
        """Text and binary chunk of a .glb file."""
        found: dict[bytes, bytes] = {}
        at = 12
        while at + 8 <= len(data):
            length, kind = int.from_bytes(data[at : at + 4], "little"), data[at + 4 : at + 8]
            if at + 8 + length > len(data):
                raise self.file.fault("is damaged: it ends within a chunk")
            found.setdefault(kind, data[at + 8 : at + 8 + length])
            at += 8 + length
        if b"JSON" not in found:
            raise self.file.fault("is damaged: it has no JSON chunk")
        return found[b"JSON"], found.get(b"BIN\0", b"")

    def _refuse_unread(self) -> None:
        names = self.tree.get("extensionsRequired", [])
        unread = [str(name) for name in names if not str(name).startswith(_READ_EXTENSIONS)]
        if unread:
            raise self.file.fault(f"needs the glTF extension {printable_line(unread[0], 60)}, which is not read")
        uv = {p.get("attributes", {}).get("TEXCOORD_0") for m in self._list("meshes") for p in m.get("primitives", [])}
        for number, accessor in enumerate(self._list("accessors")):
            if "sparse" in accessor or (number in uv and accessor.get("componentType") != 5126):
                raise self.file.fault("has sparse arrays or rounded texture coordinates, which are not read")
            count = accessor.get("count", 0)
            if not isinstance(count, int) or not 0 <= count <= 3 * MOST_TRIANGLES:
                raise self.file.fault(f"has an array of {count!s:.20} entries: at most {3 * MOST_TRIANGLES} are read")

    @staticmethod
    def _material(material: dict[str, Any]) -> dict[str, Any]:
        """Name, colour, emission and sides of a material."""
        extensions = material.get("extensions", {})
        glossy = extensions.get(_GLOSSY)
        base = material.get("pbrMetallicRoughness", {})
        if glossy is not None:
            base = {"baseColorFactor": glossy.get("diffuseFactor"), "baseColorTexture": glossy.get("diffuseTexture")}
        strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
        light = [float(x) * strength for x in material.get("emissiveFactor", _BLACK)]
        return {
            "name": str(material.get("name", "")),
            "colour": tuple(min(x, 1.0) for x in _numbers((base.get("baseColorFactor") or _WHITE)[:3]) or _WHITE),
            "picture": base.get("baseColorTexture"),
            "light": tuple(min(x, _BRIGHTEST) for x in _numbers(light) or _BLACK),
            "light_picture": material.get("emissiveTexture"),
            "two_sided": bool(material.get("doubleSided", False)),
        }

    def _rewrite(self) -> None:
        self.tree["materials"] = []
        for number, material in enumerate(self.materials):
            plain: dict[str, Any] = {"name": str(number), "emissiveFactor": [1.0, 1.0, 1.0]}
            if material["picture"]:
                plain["pbrMetallicRoughness"] = {"baseColorTexture": {"index": material["picture"].get("index")}}
            if material["light_picture"]:
                plain["emissiveTexture"] = {"index": material["light_picture"].get("index")}
            self.tree["materials"].append(plain)
        textures = [m[key].get("index") for m in self.materials for key in ("picture", "light_picture") if m[key]]
        known = dict(enumerate(self._list("textures")))
        used = {_source(known[index]) for index in textures if index in known}
        self.tree["images"] = [image if k in used else {} for k, image in enumerate(self._list("images"))]
        for primitive in (p for m in self._list("meshes") for p in m.get("primitives", [])):
            picture = self._of_primitive(primitive).get("picture") or {}
            second = primitive.get("attributes", {}).get(f"TEXCOORD_{picture.get('texCoord', 0)}")
            if second is not None:
                primitive["attributes"]["TEXCOORD_0"] = second

    def _of_primitive(self, primitive: dict[str, Any]) -> dict[str, Any]:
        number = primitive.get("material")
        return self.materials[number] if isinstance(number, int) and 0 <= number < len(self.materials) else {}


def _source(texture: dict[str, Any]) -> Any:
    webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
    return webp.get("source", texture.get("source"))


def _parts_of_gltf(file: InputFile, document: _Gltf, one_file: bool) -> list[MeshPart]:
    folder, pictures = _Folder(file, one_file, document.inside), _Pictures(file)
    scene = _load(file, json.dumps(document.tree).encode(), "gltf", folder)
    parts = []
    for label, _, geometry, transform in _geometries(file, scene):
        vertices, triangles = _placed(geometry, transform)
        found = getattr(geometry.visual, "material", None)
        if found is None:
            colours = _gltf_face_colours(getattr(geometry.visual, "vertex_colors", None), geometry)
            has_any = getattr(geometry.visual, "kind", None) == "vertex" and colours is not None
            parts.append(MeshPart(label, vertices, triangles, Paint(face_colours=colours) if has_any else None))
            continue
        material = document.materials[int(found.name)]
        uv = _corner_values(geometry.visual.uv, geometry, transform)
        paint = _gltf_paint(file, material, "colour", "picture", found.baseColorTexture, uv, pictures)
        colours = _gltf_face_colours(geometry.visual.vertex_attributes.get("color"), geometry)
        if colours is not None and paint.picture is None:
            paint = Paint(face_colours=colours * np.array(paint.colour))
        light = _gltf_paint(file, material, "light", "light_picture", found.emissiveTexture, uv, pictures)
        name = f"{label}/{material['name']}" if material["name"] else label
        shines = max(light.colour) > 0.0
        parts.append(MeshPart(name, vertices, triangles, paint, light if shines else None, material["two_sided"]))
    return parts


def _gltf_paint(
    file: InputFile, material: dict[str, Any], colour: str, key: str, image: Any, uv: Array | None, pictures: _Pictures
) -> Paint:
    reference = material[key]
    if not reference or uv is None:
        return Paint(material[colour])
    if image is None:
        raise file.fault(f"has a material '{printable_line(material['name'])}' whose texture is missing or damaged")
    moved = _transformed(uv, reference.get("extensions", {}).get("KHR_texture_transform", {}))
    return Paint(material[colour], pictures.of(image), moved)


def _transformed(uv: Array, stated: dict[str, Any]) -> Array:
    """Texture coordinates after KHR_texture_transform, which counts v downwards."""
    if not stated:
        return uv
    place = np.stack([uv[..., 0], 1.0 - uv[..., 1]], axis=-1) * np.array(stated.get("scale", (1.0, 1.0)), float)
    c, s = math.cos(stated.get("rotation", 0.0)), math.sin(stated.get("rotation", 0.0))
    place = place @ np.array([[c, -s], [s, c]]) + np.array(stated.get("offset", (0.0, 0.0)), float)
    return np.stack([place[..., 0], 1.0 - place[..., 1]], axis=-1)


def _gltf_face_colours(values: Any, geometry: Any) -> Array | None:
    """Mean linear colour of each triangle's corners; None without vertex colours."""
    if values is None or len(values) != len(geometry.vertices):
        return None
    colours = np.asarray(values)
    scale = np.iinfo(colours.dtype).max if colours.dtype.kind in "ui" else 1.0
    return np.asarray((colours[:, :3].astype(float) / scale)[np.asarray(geometry.faces)].mean(axis=1))
