"""Parts of a mesh file (triangles of one material); files and pictures that it names; triangle opacity; limits, checks.

Colours are linear. Texture coordinates have (0, 0) at a picture's lower left corner and (1, 1) at its upper right one;
beyond them the picture repeats.
"""

from __future__ import annotations

import hashlib
import math
import urllib.parse
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL.Image import Image

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.rooms.room_files import RoomError
from phibench.datasets.rooms.samplers import framed
from phibench.scenes.frames import Array, Vector
from phibench.scenes.validation import printable_line

MOST_TRIANGLES = 1_000_000
MOST_PARTS = 5_000
_MOST_PICTURES = 400_000_000  # pixels of all pictures of a file
REMEDY = "export it again as one .glb file with its textures inside"
DAMAGED = "is damaged: it ends early, or its numbers do not go together"
PICTURES = ("PNG", "JPEG", "BMP", "TGA", "TIFF", "WEBP")
BLACK: Vector = (0.0, 0.0, 0.0)
WHITE: Vector = (1.0, 1.0, 1.0)
BRIGHTEST = 1e6
"""Of an emission, in units of the file."""
ROUNDED = 1e-6
"""By which numbers that are written as 32-bit floats may be off: a colour may end at 1.000001."""
_ORIENTATION = 0x0112  # EXIF's tag
_GREY_16 = ("I", "I;16", "I;16L", "I;16B")
_OF_8_BITS = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX")
_OUTSIDE = 1e-5  # by which coordinates may leave a picture that does not repeat

Picture = NDArray[np.uint8]
Opacity = NDArray[np.uint8]


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

    colour: Vector = WHITE
    picture: Picture | None = None
    uv: Array | None = None
    face_colours: Array | None = None

    def of(self, chosen: NDArray[np.bool_]) -> Paint:
        """Paint of some of the triangles."""
        uv = None if self.uv is None else self.uv[chosen]
        return replace(self, uv=uv, face_colours=None if self.face_colours is None else self.face_colours[chosen])

    def pieces(self, owner: NDArray[np.int64], weights: Array) -> Paint:
        """Paint of pieces of triangles: the triangle of each, and weights of its corners, shape (N, 3, 3)."""
        uv = None if self.uv is None else weights @ self.uv[owner]
        return replace(self, uv=uv, face_colours=None if self.face_colours is None else self.face_colours[owner])


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


class Companions:
    """Files that a mesh names, below its folder, and the pictures in them, each decoded once.

    Parameters
    ----------
    file : InputFile
        The mesh.
    one_file : bool
        Refuse every other file.
    """

    def __init__(self, file: InputFile, one_file: bool) -> None:
        self.file, self.one_file = file, one_file
        self._pictures: dict[str, Picture] = {}
        self._of_files: dict[tuple[Path, bool], Picture] = {}
        self._holes: dict[Path, bool] = {}
        self._opacities: dict[str, Opacity | None] = {}

    def is_there(self, name: str, folder: Path | None = None) -> bool:
        """Tell whether a name is that of a file, as `named` looks for it."""
        return self._found(name, folder, False) is not None

    def named(self, name: str, folder: Path | None = None, is_uri: bool = False) -> InputFile:
        """File of a name, in the folder of the file that names it or in that of the mesh.

        Parameters
        ----------
        name : str
            A URI has blanks and others as `%20`; another name may hold `%` itself, and is tried first as it stands.
        folder : Path or None
        is_uri : bool

        Raises
        ------
        RoomError
            If it is missing or not below the mesh's folder, or the mesh must be one file.
        """
        shown = f"names the file '{printable_line(name.strip())}'"
        if self.one_file:
            raise self.file.fault(f"{shown}, and here a mesh must be one file")
        if path := self._found(name, folder, is_uri):
            return InputFile(path, REMEDY, RoomError)
        root = self.file.path.parent.resolve()
        is_below = (root / _plain(name)).resolve().is_relative_to(root)
        raise self.file.fault(f"{shown}, which is {'missing' if is_below else 'not in its folder'}")

    def _found(self, name: str, folder: Path | None, is_uri: bool) -> Path | None:
        root = self.file.path.parent.resolve()
        spellings = [name.strip().replace("\\", "/"), _plain(name)]
        for base in (root,) if folder is None else (folder, root):
            for spelling in reversed(spellings) if is_uri else spellings:
                path = (base / spelling).resolve()
                if path.is_relative_to(root) and path.is_file():
                    return path
        return None

    def picture(self, file: InputFile, is_framed: bool = False) -> Picture:
        """Pixels of a picture that has a file of its own, which is read once; `framed` if it ends at its edges."""
        key = (file.path, is_framed)
        if key not in self._of_files:
            self._of_files[key] = framed(self.picture(file), (0, 1)) if is_framed else self.pixels(file, file.read())
        return self._of_files[key]

    def has_holes(self, file: InputFile) -> bool:
        """Tell whether a picture of opacity is 0 somewhere: its alpha, or its brightness if it is opaque everywhere."""
        if file.path not in self._holes:
            data = file.read()
            alpha = self.opacity(file, data)
            mask = self.pixels(file, data) if alpha is None or alpha.min() == 255 else alpha
            self._holes[file.path] = bool(mask.min() == 0)
        return self._holes[file.path]

    def pixels(self, owner: InputFile, data: bytes) -> Picture:
        """Pixels of an encoded picture, 8 bits, sRGB; 16 bits of grey are scaled.

        Raises
        ------
        RoomError
            If it is none, or has colours that are not red, green and blue or grey of 8 or 16 bits.
        """
        digest = hashlib.sha256(data).hexdigest()
        if digest not in self._pictures:
            self._pictures[digest] = _pixels(owner, data)
            if sum(picture.size for picture in self._pictures.values()) > 3 * _MOST_PICTURES:
                most = f"{_MOST_PICTURES:.0e} pixels"
                raise self.file.fault(f"has pictures of more than {most} together: make them smaller")
        return self._pictures[digest]

    def opacity(self, owner: InputFile, data: bytes) -> Opacity | None:
        """Alpha of an encoded picture, 8 bits; None where it has none."""
        digest = hashlib.sha256(data).hexdigest()
        if digest not in self._opacities:
            image = owner.picture(PICTURES, data)
            self._opacities[digest] = opacity_of(image)
        return self._opacities[digest]


def _plain(name: str) -> str:
    return urllib.parse.unquote(name.strip()).replace("\\", "/")


def opacity_of(image: Image) -> Opacity | None:
    """Alpha of a picture, 8 bits; None where it has none."""
    if image.mode in _GREY_16 and "transparency" in image.info:  # one grey, which Pillow leaves
        return np.where(np.asarray(image) == image.info["transparency"], 0, 255).astype(np.uint8)
    has = image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
    return np.asarray(image.convert("RGBA"))[..., 3].copy() if has else None


def _pixels(owner: InputFile, data: bytes) -> Picture:
    image = owner.picture(PICTURES, data)
    with owner.decoding("has damaged EXIF data; `exiftool -all= FILE` removes them"):
        orientation = image.getexif().get(_ORIENTATION, 1)
    if orientation not in (0, 1):
        raise owner.fault(
            f"has a picture of the EXIF orientation {orientation}, by which some readers turn it: save it upright"
        )
    if image.mode in _GREY_16:
        grey = np.asarray(image, float)
        if image.format == "TIFF":  # bits, white as 0, sign: Pillow gives the numbers as they are
            tags: Any = image.tag_v2  # type: ignore[attr-defined]
            if (tags.get(258, (0,))[0], tags.get(262), tags.get(339, (1,))[0]) != (16, 1, 1):
                raise owner.fault("is a grey TIFF of another kind than 16 bits, black 0: save it with 8 bits")
        if image.format not in ("PNG", "TIFF") or grey.min() < 0.0 or grey.max() > 65535.0:
            raise owner.fault("has a picture of more than 16 bits: save it with 8 bits a colour")
        return np.repeat(np.rint(grey / 257.0).astype(np.uint8)[..., None], 3, axis=2)  # 65535 / 255
    if image.mode not in _OF_8_BITS:
        raise owner.fault(
            f"has a picture with colours of the kind {image.mode}: save it as red, green and blue of 8 bits"
        )
    return np.asarray(image.convert("RGBA").convert("RGB") if image.mode in ("P", "PA", "LA") else image.convert("RGB"))


def is_no_picture(error: DatasetError) -> bool:
    """Tell whether `InputFile.picture` found none, or a damaged one."""
    return "not a picture" in str(error) or "damaged picture" in str(error)


def three_numbers(words: Any) -> Vector:
    """Three finite numbers from 0 up; none where they are others."""
    try:
        values = tuple(float(word) for word in words)
    except (TypeError, ValueError):  # the caller knows the material's name
        return ()
    return values if len(values) == 3 and all(math.isfinite(value) and value >= 0.0 for value in values) else ()


def leaves_picture(uv: Array, axis: int) -> bool:
    """Tell whether coordinates along an axis leave the picture, so that a clamped one would not repeat."""
    return bool(uv.size) and bool(uv[..., axis].min() < -_OUTSIDE or uv[..., axis].max() > 1.0 + _OUTSIDE)


_AT_ONCE = 2000  # triangles
_STEPS = 16  # of a triangle's sides, at whose places its opacity is looked at
# middles of parts
_INSIDE = np.array([(i + 1 / 3, j + 1 / 3) for i in range(_STEPS) for j in range(_STEPS - i)]) / _STEPS
_WEIGHTS = np.column_stack([1.0 - _INSIDE.sum(axis=1), _INSIDE])


def opacities(triangles: int, uniform: float, corners: Array | None, uv: Array | None, alpha: Opacity | None) -> Array:
    """Least and largest opacity within each triangle, shape (M, 2): of the material, its corners and its picture.

    Parameters
    ----------
    triangles : int, M
    uniform : float
    corners : shape (M, 3), or None for 1
    uv : shape (M, 3, 2), places of the corners on the picture, v upwards, or None
    alpha : picture's alpha, or None for 1
    """
    result = np.empty((triangles, 2))
    for start in range(0, triangles, _AT_ONCE):  # a million triangles at once would take gigabytes
        few = slice(start, start + _AT_ONCE)
        values = np.full((len(result[few]), 1), uniform)
        if corners is not None:
            values = values * (corners[few] @ _WEIGHTS.T)
        if uv is not None and alpha is not None:
            places = np.einsum("sk,mkd->msd", _WEIGHTS, uv[few])
            height, width = alpha.shape
            column = np.floor(places[..., 0] * width).astype(int) % width
            row = height - 1 - np.floor(places[..., 1] * height).astype(int) % height
            values = values * (alpha[row, column] / 255.0)
        result[few] = np.stack([values.min(axis=1), values.max(axis=1)], axis=1)
    return result


def check_count(file: InputFile, count: int) -> None:
    """Refuse a file with too many triangles, or none.

    Raises
    ------
    RoomError
    """
    if not 0 < count <= MOST_TRIANGLES:
        raise file.fault(f"has {count} triangles: 1 to {MOST_TRIANGLES} are read")


def check_parts(file: InputFile, count: int) -> None:
    """Refuse a file with too many parts: each costs time, however small it is.

    Raises
    ------
    RoomError
    """
    if count > MOST_PARTS:
        raise file.fault(f"has more than {MOST_PARTS} parts: join objects of one material")


def check_part(file: InputFile, part: MeshPart) -> None:
    """Refuse numbers that are none, or that do not go together.

    Raises
    ------
    RoomError
    """
    if part.vertices.ndim != 2 or part.vertices.shape[1] != 3:
        raise file.fault(f"has vertices that are not three numbers each, in the part '{part.name}'")
    if part.triangles.min() < 0 or part.triangles.max() >= len(part.vertices):
        raise file.fault(f"has triangles with vertices that are not there, in the part '{part.name}'")
    if not np.isfinite(part.vertices).all():
        raise file.fault(f"has vertices that are not finite numbers, in the part '{part.name}'")
    for paint in (part.paint, part.light):
        uv = None if paint is None else paint.uv
        if uv is not None and (uv.shape != (len(part.triangles), 3, 2) or not np.isfinite(uv).all()):
            raise file.fault(f"has texture coordinates that are not pairs of finite numbers, in '{part.name}'")


def named_parts(parts: Iterable[MeshPart]) -> tuple[MeshPart, ...]:
    """Parts in the order of their names, which are made printable and unique."""
    used: dict[str, int] = {}
    named = []
    for part in sorted(parts, key=lambda part: part.name):
        plain = printable_line(part.name, 80) or "part"
        used[plain] = used.get(plain, 0) + 1
        named.append(replace(part, name=plain if used[plain] == 1 else f"{plain} ({used[plain]})"))
    return tuple(named)


def damage_error(file: InputFile) -> DatasetError:
    """Fault of a file whose numbers contradict each other."""
    return file.fault(DAMAGED)
