"""Reader of OBJ files and their MTL materials, by Wavefront's definition (Advanced Visualizer, appendix B1, 1995).

Relative indices count back from the vertices read so far. Faces of any number of corners become triangles. Curves and
free-form surfaces are refused by name; points and lines have no surface. A part is an object with one material.
Material colours and vertex colours are sRGB. A picture replaces `Kd`: most programs write both and mean the picture.
Where readers differ (a weight of a vertex, colours of vertices beside a material's), the file is refused.

`#` begins a comment, but names may hold one: a name counts as it stands, or else without what follows a blank and `#`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from phibench.datasets.common.input_files import InputFile
from phibench.datasets.rooms.mesh_parts import (
    BRIGHTEST,
    MOST_PARTS,
    MOST_TRIANGLES,
    ROUNDED,
    WHITE,
    Companions,
    MeshPart,
    Paint,
    check_count,
    check_parts,
    damage_error,
    leaves_picture,
    three_numbers,
)
from phibench.datasets.rooms.mesh_polygons import QUAD, CuttingBudget, plain_quads, triangulated
from phibench.render.sensor.srgb import srgb_decoded
from phibench.scenes.frames import Array, Vector, as_vector
from phibench.scenes.validation import printable_line

_FREE_FORM = ("curv", "curv2", "surf", "cstype", "bmat", "deg", "step", "parm", "trim", "hole", "scrv", "sp", "con")
_SCRIPTS = ("call", "csh")
_OF_NO_SHAPE = (
    "vn", "vp", "p", "l", "s", "mg", "end", "bevel", "c_interp", "d_interp", "lod", "shadow_obj", "trace_obj", "ctech",
    "stech", "maplib",
)  # fmt: skip
_MOST_CORNERS = 10_000  # of a polygon: cutting it takes the square of them
_MOST_VERTICES = 3 * MOST_TRIANGLES  # and as many texture coordinates
_MOST_LINES = 4 * _MOST_VERTICES
_LONGEST_LINE = 1_000_000  # characters: its words take fifty times their memory
_SAME = 1.0 / 255.0  # by which colours that are written twice may differ
_BLANKS = " \t\v\f"  # names may hold others
_COMMENT_GOES_ON = re.compile(r"#[^\n]*\\\n[ \t]*[^#\s]")
_OPTIONS = {
    **dict.fromkeys(("-blendu", "-blendv", "-clamp", "-cc", "-imfchan", "-texres", "-boost", "-bm", "-type"), 1),
    "-mm": 2,
}
"""Options of a picture and how many words follow; -s, -o and -t take one to three numbers."""


@dataclass(frozen=True)
class _Map:
    """Picture of a material, named from the folder of its library: u' = scale u + offset."""

    name: str
    folder: Path
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    clamped: bool = False


@dataclass(frozen=True)
class _Material:
    name: str
    diffuse: Vector = ()
    emission: Vector = ()
    picture: _Map | None = None
    light_picture: _Map | None = None
    mask: _Map | None = None
    opacity: float | None = None
    transparency: float = 0.0

    @property
    def is_hidden(self) -> bool:
        return self.opacity is not None and self.opacity <= 0.0


@dataclass
class _Group:
    """Faces of an object with one material: numbers of vertices and of texture coordinates, -1 where there is none."""

    corners: list[tuple[int, ...]] = field(default_factory=list)
    places: list[tuple[int, ...]] = field(default_factory=list)


@dataclass(frozen=True)
class _Vertices:
    """Places of vertices and texture coordinates, and colours of the vertices, where all have one."""

    points: Array
    places: Array
    colours: Array | None


class _Reader:
    """State while the lines are read."""

    def __init__(self, file: InputFile) -> None:
        self.file = file
        self.vertices: list[tuple[float, ...]] = []
        self.colours: list[tuple[float, ...]] = []
        self.places: list[tuple[float, float]] = []
        self.libraries: list[str] = []
        self.groups: dict[tuple[str, str], _Group] = {}
        self.label, self.material, self.triangles = "", "", 0

    def line(self, key: str, rest: str) -> None:
        """Take one line: its first word and what follows."""
        values = rest.partition("#")[0].split()
        if key in ("v", "vt", "f", "fo") and ("_" in rest or not rest.isascii()):
            self._check_digits(values)
        if key == "v":
            self._vertex(values)
        elif key == "vt":
            self.places.append((float(values[0]), float(values[1]) if len(values) > 1 else 0.0))
        elif key in ("f", "fo"):
            self._face(values)
        elif key in ("o", "g"):
            self.label = " ".join(values) if key == "o" or not self._has_objects else self.label
            self._has_objects = self._has_objects or key == "o"
        elif key == "usemtl":
            self.material = " ".join(rest.split(" "))
        elif key == "mtllib":
            self.libraries.append(rest)
        elif key in _FREE_FORM:
            raise self.file.fault(f"has free-form curves or surfaces (`{key}`), which are not read: export triangles")
        elif key in _SCRIPTS:
            raise self.file.fault(f"calls other files (`{key}`), which is not done")
        elif key == "usemap" and values[:1] != ["off"]:
            raise self.file.fault(
                "names pictures without materials (`usemap`), which is not read: use map_Kd of an MTL"
            )
        elif key not in _OF_NO_SHAPE and key != "usemap":
            raise self.file.fault(f"has a line that OBJ does not know, '{printable_line(f'{key} {rest}', 60)}'")

    _has_objects = False

    def _check_digits(self, values: list[str]) -> None:
        """Refuse what Python counts as a number and nobody else does: `1_000`, or digits of other scripts."""
        for word in values:
            if "_" in word or not word.isascii():
                raise self.file.fault(f"has '{printable_line(word, 20)}' in the place of a number")

    def _vertex(self, values: list[str]) -> None:
        numbers = tuple(float(word) for word in values)
        if len(numbers) not in (3, 4, 6):  # x, y, z; with a weight; with a colour; of seven readers differ
            raise self.file.fault(f"has a vertex of {len(numbers)} numbers: 3, 4 or 6 are read")
        if len(numbers) == 4 and numbers[3] != 1.0:  # by the definition of curves alone; some readers divide by it
            raise self.file.fault(f"has a vertex of the weight {numbers[3]:g}: give three numbers, or the weight 1")
        self.vertices.append(numbers[:3])
        if len(numbers) == 6:
            self.colours.append(numbers[3:])

    def _face(self, values: list[str]) -> None:
        if not 3 <= len(values) <= _MOST_CORNERS:
            if len(values) > 2:
                raise self.file.fault(f"has a face of {len(values)} corners: at most {_MOST_CORNERS} are read")
            return  # a point or a line has no surface
        pairs = [word.split("/") for word in values]
        corners = tuple(self._number(pair[0], len(self.vertices), "vertex") for pair in pairs)
        has_places = all(len(pair) > 1 and pair[1] for pair in pairs)
        places = tuple(self._number(p[1], len(self.places), "texture coordinate") if has_places else -1 for p in pairs)
        self.triangles += len(values) - 2
        if self.triangles > MOST_TRIANGLES:
            check_count(self.file, self.triangles)
        group = self.groups.setdefault((self.label, self.material), _Group())
        if len(self.groups) > MOST_PARTS:
            check_parts(self.file, len(self.groups))
        group.corners.append(corners)
        group.places.append(places)

    def _number(self, word: str, count: int, what: str) -> int:
        """Number from 0 of an index; a negative one counts back from the last that was read."""
        number = int(word)
        index = number - 1 if number > 0 else count + number
        # a positive one may name what comes later in the file; `obj_parts` looks at these
        if number == 0 or index < 0:
            raise self.file.fault(f"has a face with the {what} {number}, of {count} so far")
        return index


def obj_parts(file: InputFile, companions: Companions) -> list[MeshPart]:
    """Parts of an OBJ file, one for each object and material.

    Raises
    ------
    RoomError
        If it is damaged, has what is not read, or names a file or a material that is not there.
    """
    reader = _Reader(file)
    for key, rest in _lines(file):
        reader.line(key, rest)
    if max(len(reader.vertices), len(reader.places)) > _MOST_VERTICES:
        raise file.fault(f"has more than {_MOST_VERTICES} vertices or texture coordinates")
    materials = _materials(companions, reader.libraries)
    check_count(file, reader.triangles)
    points = np.array(reader.vertices, float).reshape(-1, 3)
    places = np.array(reader.places, float).reshape(-1, 2)
    tints = np.array(reader.colours, float).reshape(-1, 3)
    colours = tints if len(tints) == len(points) else None
    if len(tints) and colours is None:
        raise file.fault(f"has {len(points)} vertices and colours of {len(tints)} of them: give all a colour, or none")
    parts, vertices, cutting = [], _Vertices(points, places, colours), CuttingBudget()
    for (label, name), group in reader.groups.items():
        material = _material_of(file, materials, name) if name and reader.libraries else None
        if material is not None and material.is_hidden:
            continue  # wholly transparent
        title = "_".join(filter(None, (label, name))) or file.path.stem
        parts.append(_part(file, companions, title, group, vertices, material, cutting))
    return parts


def _material_of(file: InputFile, materials: dict[str, list[_Material]], name: str) -> _Material:
    """Material of a name; either name may have a comment after it."""
    shown = printable_line(name, 60)
    named = materials.get(name) or materials.get(_without_comment(name))
    named = named or [one for key, them in materials.items() if _without_comment(key) == name for one in them]
    if not named:
        raise file.fault(f"uses the material '{shown}', which none of its libraries has")
    if len(named) > 1:
        raise file.fault(f"uses the material '{shown}', which its libraries define twice and not alike")
    return named[0]


def _without_comment(name: str) -> str:
    return re.split(r"\s#", name, maxsplit=1)[0].rstrip()


def _lines(file: InputFile) -> Iterator[tuple[str, str]]:
    """First word and rest of each line that is no comment; one that ends in a backslash goes on."""
    data = file.read()
    if data.count(b"\n") + data.count(b"\r") > 2 * _MOST_LINES:
        raise file.fault(f"has more than {_MOST_LINES} lines")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:  # written before UTF-8: names that differ stay different
        text = data.decode("latin-1")
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if _COMMENT_GOES_ON.search(text):  # is what follows a part of the comment? readers differ
        raise file.fault("has a comment that ends in a backslash, before a line that is none: take the backslash away")
    for line in text.replace("\\\n", " ").split("\n"):
        if len(line) > _LONGEST_LINE:
            raise file.fault(f"has a line of {len(line)} characters: at most {_LONGEST_LINE} are read")
        key, _, rest = line.strip(_BLANKS).replace("\t", " ").partition(" ")
        if key and not key.startswith("#"):
            yield key.partition("#")[0], rest.strip(_BLANKS)


def _part(
    file: InputFile,
    companions: Companions,
    title: str,
    group: _Group,
    vertices: _Vertices,
    material: _Material | None,
    cutting: CuttingBudget,
) -> MeshPart:
    points, places, colours = vertices.points, vertices.places, vertices.colours
    corners, uv_corners = [], []
    plain = plain_quads(points, group.corners)
    for polygon, place, is_plain in zip(group.corners, group.places, plain, strict=True):
        if max(polygon) >= len(points) or max(place) >= len(places):
            raise file.fault("has faces with vertices or texture coordinates that are not there")
        is_triangle = len(polygon) == 3
        pieces = QUAD[:1] if is_triangle else QUAD if is_plain else triangulated(points[list(polygon)], cutting)
        corners.append(np.array(polygon, np.int64)[pieces])
        uv_corners.append(np.array(place, np.int64)[pieces])
    triangles, numbers = np.concatenate(corners), np.concatenate(uv_corners)
    if not np.isfinite(points[triangles]).all():
        raise file.fault(f"has vertices that are not finite numbers, in the part '{printable_line(title, 60)}'")
    uv = places[numbers] if len(places) and numbers.min() >= 0 else None
    paint = light = None
    if material is not None:
        _check_holes(file, companions, material)
        paint = _paint(file, companions, material, uv)
        light = _light(file, companions, material, uv)
    if colours is not None:
        paint = _tinted(file, title, paint, colours[triangles])
    used, own = np.unique(triangles, return_inverse=True)  # a thousand parts do not carry all vertices each
    return MeshPart(title, points[used], own.reshape(-1, 3), paint, light)


def _tinted(file: InputFile, title: str, paint: Paint | None, colours: Array) -> Paint:
    """Paint of the colours of corners, shape (M, 3, 3), or of the material if they say the same or nothing."""
    if not (np.isfinite(colours).all() and colours.min() >= 0.0 and colours.max() <= 1.0):
        raise file.fault("has vertex colours outside 0 to 1")
    linear = srgb_decoded(colours)
    is_plain = paint is not None and paint.picture is None
    if paint is not None and (colours.min() == 1.0 or (is_plain and np.abs(linear - paint.colour).max() < _SAME)):
        return paint
    if paint is not None and not (is_plain and paint.colour == WHITE):
        raise file.fault(
            f"has vertex colours beside those of a material in '{printable_line(title, 60)}', which readers join in "
            "different ways: take one of them away"
        )
    return Paint(face_colours=linear.mean(axis=1))


def _check_holes(file: InputFile, companions: Companions, material: _Material) -> None:
    """Refuse a picture of the opacity that has holes: what is half transparent counts as opaque."""
    if material.mask is None:
        return
    if companions.has_holes(_file_of(companions, material.mask)):
        shown = printable_line(material.name, 60)
        raise file.fault(f"has holes in the material '{shown}' (map_d): cut its faces along them, or take map_d away")


def _paint(file: InputFile, companions: Companions, material: _Material, uv: Array | None) -> Paint | None:
    if material.picture is not None:
        return _pictured(file, companions, material, material.picture, WHITE, uv)
    if not material.diffuse:
        return None
    return Paint(as_vector(srgb_decoded(np.clip(np.array(material.diffuse), 0.0, 1.0))))


def _light(file: InputFile, companions: Companions, material: _Material, uv: Array | None) -> Paint | None:
    colour = tuple(min(x, BRIGHTEST) for x in material.emission)
    if material.light_picture is not None and (not colour or max(colour) > 0.0):
        return _pictured(file, companions, material, material.light_picture, colour or WHITE, uv)
    if material.light_picture is not None and companions.picture(_file_of(companions, material.light_picture)).any():
        raise file.fault(
            f"states Ke 0 and map_Ke of '{printable_line(material.name, 60)}', by which programs mean dark or the "
            "picture: write Ke 1, or take map_Ke away"
        )
    return Paint(colour) if colour and max(colour) > 0.0 else None


def _pictured(
    file: InputFile, companions: Companions, material: _Material, found: _Map, colour: Vector, uv: Array | None
) -> Paint:
    picture = companions.picture(_file_of(companions, found), found.clamped)
    if uv is None:
        shown = printable_line(material.name, 60)
        raise file.fault(f"has faces of the material '{shown}', which has a picture, without texture coordinates")
    moved = uv * np.array(found.scale) + np.array(found.offset)
    if found.clamped and any(leaves_picture(moved, axis) for axis in (0, 1)):
        raise file.fault(f"has a picture that ends at its edges (-clamp on) in '{printable_line(material.name, 60)}'")
    if found.clamped:
        size = np.array(picture.shape[1::-1]) - 2.0
        moved = (moved * size + 1.0) / (size + 2.0)
    return Paint(colour, picture, moved)


# Materials.


def _file_of(companions: Companions, found: _Map) -> InputFile:
    name = found.name if companions.is_there(found.name, found.folder) else _without_comment(found.name)
    return companions.named(name, found.folder)


def _materials(companions: Companions, libraries: list[str]) -> dict[str, list[_Material]]:
    """Materials by their names; of one name several, if they differ."""
    materials: dict[str, list[_Material]] = {}
    for line in dict.fromkeys(libraries):
        # one name with blanks, or several names
        whole = next((name for name in (line, _without_comment(line)) if companions.is_there(name)), "")
        for name in [whole] if whole else _without_comment(line).split() or [line]:
            library = companions.named(name)
            for material in _library(library):
                if material.transparency >= 1.0 and material.opacity is None:
                    raise library.fault(
                        f"states Tr 1 and no d of '{printable_line(material.name, 60)}', by which programs mean opaque "
                        "or wholly transparent: write d 1 or d 0"
                    )
                same = materials.setdefault(material.name, [])
                if material not in same:
                    same.append(material)
    return materials


def _library(file: InputFile) -> list[_Material]:
    materials: list[_Material] = []
    for key, rest in _lines(file):
        if key == "newmtl":
            materials.append(_Material(" ".join(rest.split(" "))))
        elif materials:
            materials[-1] = _with_line(file, materials[-1], key.lower(), rest)
    return materials


def _with_line(file: InputFile, material: _Material, key: str, rest: str) -> _Material:
    values = rest.partition("#")[0].split()
    if key in ("kd", "ke"):
        colour = _colour(file, material.name, key, values)
        return replace(material, diffuse=colour) if key == "kd" else replace(material, emission=colour)
    if key in ("map_kd", "map_ke"):
        picture = _map(file, material.name, key, rest)
        return replace(material, picture=picture) if key == "map_kd" else replace(material, light_picture=picture)
    if key == "map_d":
        return replace(material, mask=_map(file, material.name, key, rest))
    if key == "d" and values:
        return replace(material, opacity=float(values[-1]))  # after -halo, where it stands
    if key == "tr" and values:
        return replace(material, transparency=float(values[0]))
    return material  # gloss and relief are not kept, nor is a half transparency


def _colour(file: InputFile, name: str, key: str, values: list[str]) -> Vector:
    if values[:1] in (["spectral"], ["xyz"]):
        raise file.fault(f"states {key} of '{printable_line(name, 60)}' as {values[0]}: write red, green and blue")
    words = values * 3 if len(values) == 1 else values  # one number is for all three
    colour = three_numbers(words[:3])
    if not colour:
        raise file.fault(f"has a {key} of '{printable_line(name, 60)}' that is not three numbers from 0 up")
    if key == "kd" and max(colour) > 1.0 + ROUNDED:
        raise file.fault(f"has a Kd of '{printable_line(name, 60)}' up to {max(colour):g}: write it from 0 to 1")
    return colour


def _map(file: InputFile, name: str, key: str, rest: str) -> _Map:
    """Picture with its options, which stand before its name."""
    where = f"{key} of '{printable_line(name, 60)}'"
    words_found = list(re.finditer(r"[^ ]+", rest))
    values = [word[0] for word in words_found]
    picture, k = _Map("", file.path.parent), 0
    while k < len(values) and values[k].startswith("-"):
        option = values[k]
        if option in ("-s", "-o", "-t"):
            numbers = _leading_numbers(values[k + 1 : k + 4])
            k += 1 + len(numbers)
            if option == "-t" and any(numbers):
                raise file.fault(f"has turbulence in {where}, which is not read")
            default = 1.0 if option == "-s" else 0.0
            u, v, *_ = (*numbers, default, default)
            picture = replace(picture, scale=(u, v)) if option == "-s" else picture
            picture = replace(picture, offset=(u, v)) if option == "-o" else picture
            continue
        if option not in _OPTIONS:
            raise file.fault(f"has the option {printable_line(option, 20)} in {where}, which is not read")
        words = values[k + 1 : k + 1 + _OPTIONS[option]]
        if option == "-mm" and [float(word) for word in words] != [0.0, 1.0]:
            raise file.fault(f"changes the values of a picture (-mm) in {where}: put it into the picture")
        if option == "-clamp":
            picture = replace(picture, clamped=words == ["on"])
        k += 1 + _OPTIONS[option]
    if k >= len(values):
        raise damage_error(file)
    return replace(picture, name=rest[words_found[k].start() :])


def _leading_numbers(words: list[str]) -> list[float]:
    numbers: list[float] = []
    for word in words:
        try:
            numbers.append(float(word))
        except ValueError:  # the picture's name begins
            break
    return numbers
