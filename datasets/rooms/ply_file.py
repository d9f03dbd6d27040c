"""Reader of PLY files: ASCII and binary of either byte order, faces, strips, colours of vertices or faces, a picture.

Greg Turk's definition, "The PLY Polygon File Format" (1994): a header names elements, their counts and properties. What
names mean is custom: x, y, z; red, green, blue; vertex_indices; s, t with a picture in `comment TextureFile`; colours
of an element `material` by the `material_index` of faces or vertices. Elements and properties of other names are
passed over. Texture coordinates without a picture colour nothing.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.input_files import InputFile
from phibench.datasets.rooms.mesh_parts import (
    MOST_TRIANGLES,
    Companions,
    MeshPart,
    Paint,
    check_count,
    damage_error,
)
from phibench.datasets.rooms.mesh_polygons import QUAD, CuttingBudget, plain_quads, triangulated
from phibench.render.sensor.srgb import srgb_decoded
from phibench.scenes.frames import Array
from phibench.scenes.validation import printable_line

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_OTHER_COLOURS = {name for names in _COLOURS for name in names} | {
    "ambient_red", "gray", "grey", "luminance", "rgb", "rgba", "color", "colour", "f_dc_0", "albedo_red",
}  # fmt: skip
_PLACES = (("s", "t"), ("texture_u", "texture_v"), ("u", "v"))
_MOST_CORNERS = 10_000  # of one polygon
_MOST_ENTRIES = 3 * MOST_TRIANGLES  # of one kind


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str
    count_kind: str = ""  # of a list


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]


@dataclass(frozen=True)
class _Faces:
    """Triangles, shape (M, 3); of those of faces, which come first: the face, and which of its corners."""

    triangles: NDArray[np.int64]
    owner: Any
    corner: Any
    polygons: Any

    @property
    def of_faces(self) -> bool:
        """True without strips, so that each triangle has a face."""
        return len(self.triangles) == len(self.owner)


Table = dict[str, Any]  # property to an array of numbers, or to a list of arrays


def ply_parts(file: InputFile, companions: Companions) -> list[MeshPart]:
    """Parts of a PLY file: all its faces are one.

    Raises
    ------
    RoomError
        If it is damaged, has no vertices or faces, or names several pictures or one that is not there.
    """
    data = file.read()
    order, elements, pictures, start = _header(file, data)
    reader = _AsciiBody(file, data[start:]) if order == "" else _BinaryBody(file, data[start:], order)
    tables = {element.name: reader.table(element) for element in elements}
    if rest := reader.rest():
        raise file.fault(f"goes on for {rest} after the last entry of its header: its counts are too low")
    _refuse_other_surfaces(file, elements)
    vertex, face = tables.get("vertex", {}), tables.get("face", {})
    if not all(name in vertex for name in "xyz"):
        raise file.fault("has no vertices with x, y and z")
    points = np.stack([np.asarray(vertex[name], float) for name in "xyz"], axis=1)
    polygons: Any = next((face[name] for name in _CORNERS if name in face), [])
    triangles, owner, corner = _triangles(file, points, polygons)
    strips: Any = next((tables["tristrips"][name] for name in _CORNERS if name in tables.get("tristrips", {})), [])
    extra = _strips(file, strips)
    check_count(file, len(triangles) + len(extra))
    whole = np.concatenate([triangles, extra])
    if whole.min() < 0 or whole.max() >= len(points):
        raise file.fault("has triangles with vertices that are not there")
    faces = _Faces(whole, owner, corner, polygons)
    kinds = {element.name: {p.name: p.kind for p in element.properties} for element in elements}
    paint = _picture_paint(file, companions, pictures, vertex, face, faces)
    paint = paint or _colour_paint(file, tables, kinds, faces)
    return [MeshPart(file.path.stem, points, whole, paint)]


def _refuse_other_surfaces(file: InputFile, elements: list[_Element]) -> None:
    """Refuse corners of an element of another name, such as `tristrip`: its surface would be missing."""
    for element in elements:
        corners = any(p.name in _CORNERS and p.count_kind for p in element.properties)
        if corners and element.count and element.name not in ("face", "tristrips"):
            shown = printable_line(element.name, 60)
            raise file.fault(f"has an element '{shown}' with vertex indices, which is not read: make it faces")


def _header(file: InputFile, data: bytes) -> tuple[str, list[_Element], list[str], int]:
    """Byte order, elements, names of pictures, and where the body begins."""
    # a comment may hold the word, and a header may end its lines as a body does not: by a carriage return alone
    ending = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", data[:100_000])
    if not data.startswith(b"ply") or ending is None:
        raise damage_error(file)
    end, stop = ending.start() + 1, ending.end() - 1
    if ending[1] == b"\r\n" and b"\n" not in data[:end]:
        stop -= 1
    text = data[:end]
    order, elements, pictures = None, list[_Element](), list[str]()
    try:
        shown = text.decode("utf-8")
    except UnicodeDecodeError:  # comments of older programs; keywords are ASCII
        shown = text.decode("latin-1")
    for line in shown.replace("\r", "\n").split("\n")[1:]:
        words = line.split()
        if not words or words[0] == "obj_info":
            continue  # an older name of comments
        if words[0] == "comment":
            if len(words) > 2 and words[1].lower() == "texturefile":
                pictures.append(line.split(None, 2)[2].strip())
        elif words[0] == "format":
            order = _ORDERS[words[1]]
            if words[2:] != ["1.0"]:
                raise file.fault(f"is PLY of the version {printable_line(' '.join(words[2:]), 20)}: 1.0 is read")
        elif words[0] == "element":
            elements.append(_Element(words[1], _count(file, words[2]), ()))
        elif words[0] == "property":
            last = elements[-1]
            elements[-1] = _Element(last.name, last.count, (*last.properties, _property(words[1:])))
        else:
            raise file.fault(f"has a line in its header that is not PLY's: {printable_line(line, 60)}")
    if order is None:
        raise damage_error(file)
    if sum(element.count for element in elements) > 2 * _MOST_ENTRIES:
        raise file.fault(f"has more than {2 * _MOST_ENTRIES} entries: at most that many are read")
    if any(len({p.name for p in element.properties}) < len(element.properties) for element in elements):
        raise file.fault("has a property twice")
    if len({element.name for element in elements}) < len(elements):
        raise file.fault("has an element twice")
    return order, elements, pictures, stop + 1


def _count(file: InputFile, word: str) -> int:
    count = int(word)
    if not 0 <= count <= _MOST_ENTRIES:
        raise file.fault(f"has {printable_line(word, 20)} entries of one kind: at most {_MOST_ENTRIES} are read")
    return count


def _property(words: Sequence[str]) -> _Property:
    if words[0] == "list":
        return _Property(words[3], _TYPES[words[2]], _TYPES[words[1]])
    return _Property(words[1], _TYPES[words[0]])


# Bodies.


class _AsciiBody:
    """Numbers in words, one after the other."""

    def __init__(self, file: InputFile, data: bytes) -> None:
        self.file = file
        with warnings.catch_warnings():  # words as objects would take ten times the memory
            warnings.simplefilter("error")  # of a word that is no number
            self.numbers = np.fromstring(data.decode("ascii"), np.float64, sep=" ") if data.strip() else np.zeros(0)
        self.at = 0

    def rest(self) -> str:
        """Tell how much follows the last element."""
        left = len(self.numbers) - self.at
        return f"{left} numbers" if left else ""

    def table(self, element: _Element) -> Table:
        """Next element."""
        if not any(p.count_kind for p in element.properties):
            width = len(element.properties)
            values = self._take(width * element.count).reshape(element.count, width)
            return {p.name: values[:, k] for k, p in enumerate(element.properties)}
        columns: dict[str, list[Any]] = {p.name: [] for p in element.properties}
        for _ in range(element.count):
            for p in element.properties:
                if p.count_kind:
                    columns[p.name].append(self._take(_corners(self.file, self._take(1)[0])))
                else:
                    columns[p.name].append(self._take(1)[0])
        return dict(columns)

    def _take(self, count: int) -> Array:
        values = self.numbers[self.at : self.at + count]
        if len(values) != count:
            raise damage_error(self.file)
        self.at += count
        return values


class _BinaryBody:
    """Numbers in bytes."""

    def __init__(self, file: InputFile, data: bytes, order: str) -> None:
        self.file, self.data, self.order, self.at = file, data, order, 0

    def rest(self) -> str:
        """Tell how much follows the last element; blanks and zeros are padding."""
        left = len(self.data) - self.at
        return f"{left} bytes" if self.data[self.at :].strip(b" \t\r\n\0") else ""

    def table(self, element: _Element) -> Table:
        """Next element; lists that are all equally long are read at once."""
        if not element.count:
            return {p.name: [] for p in element.properties}
        lengths = self._lengths_of_first(element)
        fields: list[Any] = []
        for p, length in zip(element.properties, lengths, strict=True):
            if p.count_kind:
                fields.append((f"#{p.name}", self.order + p.count_kind))
            fields.append((p.name, self.order + p.kind, (length,)) if p.count_kind else (p.name, self.order + p.kind))
        kind = np.dtype(fields)
        if self.at + kind.itemsize * element.count <= len(self.data):
            rows = np.frombuffer(self.data, kind, element.count, self.at)
            lists = [(p.name, n) for p, n in zip(element.properties, lengths, strict=True) if p.count_kind]
            if all((rows[f"#{name}"] == length).all() for name, length in lists):
                self.at += kind.itemsize * element.count
                return {p.name: rows[p.name] for p in element.properties}
        return self._one_by_one(element)

    def _lengths_of_first(self, element: _Element) -> list[int]:
        at, lengths = self.at, []
        for p in element.properties:
            length = 1
            if p.count_kind:
                [count], at = self._read(p.count_kind, 1, at)
                length = _corners(self.file, count)
            lengths.append(length)
            at += np.dtype(p.kind).itemsize * length
        return lengths

    def _one_by_one(self, element: _Element) -> Table:
        columns: dict[str, list[Any]] = {p.name: [] for p in element.properties}
        for _ in range(element.count):
            for p in element.properties:
                length = 1
                if p.count_kind:
                    [count], self.at = self._read(p.count_kind, 1, self.at)
                    length = _corners(self.file, count)
                values, self.at = self._read(p.kind, length, self.at)
                columns[p.name].append(values if p.count_kind else values[0])
        return dict(columns)

    def _read(self, kind: str, count: int, at: int) -> tuple[Any, int]:
        size = np.dtype(kind).itemsize * count
        if at + size > len(self.data):
            raise damage_error(self.file)
        return np.frombuffer(self.data, self.order + kind, count, at), at + size


def _corners(file: InputFile, count: float) -> int:
    """Length of a list."""
    if not (0 <= count <= 3 * MOST_TRIANGLES and count == math.floor(count)):
        raise damage_error(file)
    return int(count)


# Faces.


def _whole(file: InputFile, numbers: Any) -> NDArray[np.int64]:
    """Numbers of vertices as integers."""
    values = np.asarray(numbers)
    if values.dtype.kind == "f" and not (np.floor(values) == values).all():
        raise file.fault("has faces whose vertices are not whole numbers")
    return values.astype(np.int64)


def _triangles(file: InputFile, points: Array, polygons: Any) -> tuple[NDArray[np.int64], Any, Any]:
    """Triangles, the face of each, and which corners of the face it has, shape (M, 3)."""
    if len(polygons) == 0:
        return np.zeros((0, 3), np.int64), np.zeros(0, int), np.zeros((0, 3), int)
    if isinstance(polygons, np.ndarray) and polygons.shape[1] == 3:
        count = len(polygons)
        return _whole(file, polygons), np.arange(count), np.tile(np.arange(3), (count, 1))
    triangles: list[Any] = []
    owner: list[int] = []
    corner: list[Any] = []
    total, cutting, plain = 0, CuttingBudget(), plain_quads(points, polygons)
    for number, polygon in enumerate(polygons):
        index = _whole(file, polygon)
        if len(index) < 3:
            continue  # a point or a line has no surface
        if len(index) > _MOST_CORNERS:
            raise file.fault(f"has a face of {len(index)} corners: at most {_MOST_CORNERS} are read")
        if index.min() < 0 or index.max() >= len(points):
            raise file.fault("has faces with vertices that are not there")
        pieces = QUAD if plain[number] else triangulated(points[index], cutting)
        total += len(pieces)
        if total > MOST_TRIANGLES:
            check_count(file, total)
        triangles.append(index[pieces])
        owner += [number] * len(pieces)
        corner.append(pieces)
    if not triangles:
        return np.zeros((0, 3), np.int64), np.zeros(0, int), np.zeros((0, 3), int)
    return np.concatenate(triangles), np.array(owner), np.concatenate(corner)


def _strips(file: InputFile, strips: Any) -> NDArray[np.int64]:
    """Triangles of strips; -1 begins a new one. Every other triangle turns around."""
    triangles = []
    for strip in strips:
        index = _whole(file, strip)
        for run in np.split(index, np.flatnonzero(index == -1)):
            part = run[run != -1]
            if len(part) > 2:
                three = np.stack([part[:-2], part[1:-1], part[2:]], axis=1)
                three[1::2] = three[1::2, ::-1]
                triangles.append(three)
    return np.concatenate(triangles) if triangles else np.zeros((0, 3), np.int64)


# Colours.


def _picture_paint(
    file: InputFile, companions: Companions, pictures: list[str], vertex: Table, face: Table, faces: _Faces
) -> Paint | None:
    """Paint of the picture that the header names; None where it names none."""
    if not pictures:
        return None
    if len(set(pictures)) > 1:
        raise file.fault("names several pictures, of which each face would have one: that is not read")
    if np.any(np.asarray(face.get("texnumber", []), float) != 0.0):
        raise file.fault("has faces with a texnumber other than 0, and names one picture: give all faces that one")
    places = next((names for names in _PLACES if all(name in vertex for name in names)), None)
    if "texcoord" in face:
        uv = _face_places(file, face["texcoord"], faces)
    elif places is not None:
        uv = np.stack([np.asarray(vertex[name], float) for name in places], axis=1)[faces.triangles]
    else:
        raise file.fault(f"names the picture '{printable_line(pictures[0])}' and no texture coordinates")
    return Paint(picture=companions.picture(companions.named(pictures[0])), uv=uv)


def _face_places(file: InputFile, rows: Any, faces: _Faces) -> Array:
    fits = all(len(row) == 2 * len(polygon) for row, polygon in zip(rows, faces.polygons, strict=True))
    if not fits or not faces.of_faces:
        raise file.fault("has faces whose texture coordinates are not two for each corner")
    flat = [np.asarray(row, float).reshape(-1, 2) for row in rows]
    return np.stack([flat[k][three] for k, three in zip(faces.owner, faces.corner, strict=True)])


def _colour_paint(
    file: InputFile, tables: dict[str, Table], kinds: dict[str, dict[str, str]], faces: _Faces
) -> Paint | None:
    """Paint of the colours of faces, else of vertices; each its own, or that of its material."""
    of_faces = _own_colours(file, "face", tables, kinds) if faces.of_faces else None
    if of_faces is not None:
        return Paint(face_colours=of_faces[faces.owner])
    of_vertices = _own_colours(file, "vertex", tables, kinds)
    if of_vertices is None:
        _refuse_other_colours(file, tables)
        return None
    return Paint(face_colours=of_vertices[faces.triangles].mean(axis=1))


def _refuse_other_colours(file: InputFile, tables: dict[str, Table]) -> None:
    """Refuse colours by names that are not read: the plain albedo would take their place without a word."""
    for element in ("vertex", "face"):
        for name in tables.get(element, {}):
            if name.lower() in _OTHER_COLOURS:
                raise file.fault(
                    f"has colours of each {element} as '{printable_line(name, 60)}', which is not read: name them red, "
                    "green and blue, or take them away"
                )


def _own_colours(
    file: InputFile, name: str, tables: dict[str, Table], kinds: dict[str, dict[str, str]]
) -> Array | None:
    """Linear colours of the entries of an element, shape (N, 3), or None where the file states none."""
    table = tables.get(name, {})
    own = _colours(file, table, kinds.get(name, {}))
    if own is not None or "material_index" not in table or not len(table["material_index"]):
        return own
    colours = _colours(file, tables.get("material", {}), kinds.get("material", {}))
    index = np.asarray(table["material_index"], float)
    if colours is None:
        raise file.fault(f"gives each {name} a material, and no material a colour that is read (diffuse_red, red)")
    if index.min() < 0 or index.max() >= len(colours) or (index != np.floor(index)).any():
        raise file.fault(f"names materials that are not there: it has {len(colours)}")
    return np.asarray(colours[index.astype(int)])


def _colours(file: InputFile, table: Table, kinds: dict[str, str]) -> Array | None:
    """Linear colours, shape (N, 3); floats span 0 to 1, 16 bits without sign all of theirs, other integers 0 to 255."""
    names = next((names for names in _COLOURS if all(name in table for name in names)), None)
    if names is None or not len(table[names[0]]):
        return None
    columns = []
    for name in names:
        values, kind = np.asarray(table[name], float), kinds[name]
        scale = 1.0 if kind in ("f4", "f8") else 65535.0 if kind == "u2" else 255.0  # largest value of the type
        if not (np.isfinite(values).all() and values.min() >= 0.0 and values.max() <= scale):
            raise file.fault(f"has colours outside 0 to {scale:g}, which are the ends of their type")
        if kind[0] != "f" and (values != np.floor(values)).any():
            raise file.fault("has colours that are not whole numbers, as their type says")
        columns.append(values / scale)
    if kinds[names[0]] == "u2" and 1.0 < 65535.0 * np.max(columns) < 256.0:  # black, or codes of 8 bits
        raise file.fault("has colours of 16 bits that end below 256: scale them to 65535, or state them as uchar")
    return np.asarray(srgb_decoded(np.stack(columns, axis=1)))
