"""Bodies of PLY files that hold more or other numbers than their headers say are refused."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from helpers.mesh_files import area
from PIL import Image

from phibench.datasets.rooms.mesh_parts import MeshPart
from phibench.datasets.rooms.mesh_placement import read_mesh
from phibench.datasets.rooms.room_files import RoomError

XYZ = "property float x\nproperty float y\nproperty float z\n"
RGB = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
LIST = "property list uchar int vertex_indices\n"
SQUARE = ("0 0 0", "1 0 0", "1 1 0", "0 1 0")


def ply(folder: Path, own: str = "", values: str = "", end: str = "4 0 1 2 3\n", more: str = "") -> MeshPart:
    """A square in words: further properties of its vertices, their values, the face, further elements."""
    head = f"ply\nformat ascii 1.0\nelement vertex 4\n{XYZ}{own}element face 1\n{LIST}{more}end_header\n"
    (folder / "a.ply").write_text(head + "".join(f"{place}{values}\n" for place in SQUARE) + end)
    [part] = read_mesh(folder / "a.ply")
    return part


@pytest.mark.parametrize(
    ("end", "words"),
    [
        ("4 0 1 2 3\n3 0 1 2\n", "goes on for 4 numbers"),
        ("4 0 1 2 3\n7\n", "goes on for 1 numbers"),
        ("4 0 1.5 2 3\n", "not whole numbers"),
        ("3 0 nan 2\n", "not whole numbers"),
        ("3 0 1_0 2\n", "damaged"),
        ("3 0 0x1 2\n", "damaged"),
    ],
)
def test_a_body_in_words_is_what_its_header_says(tmp_path: Path, end: str, words: str) -> None:
    assert area([ply(tmp_path, end="4 0 1 2 3\n \n")]) == pytest.approx(1.0)
    with pytest.raises(RoomError, match=words):
        ply(tmp_path, end=end)


@pytest.mark.parametrize(("tail", "ok"), [(b"", True), (b"\n\0\0", True), (struct.pack("<B3i", 3, 0, 1, 2), False)])
def test_a_binary_body_is_what_its_header_says(tmp_path: Path, tail: bytes, ok: bool) -> None:
    """Padding is none of it; a face that the header does not count was left out without a word."""
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 4\n{XYZ}element face 1\n{LIST}end_header\n"
    body = b"".join(struct.pack("<3f", *map(float, place.split())) for place in SQUARE)
    (tmp_path / "a.ply").write_bytes(head.encode() + body + struct.pack("<B4i", 4, 0, 1, 2, 3) + tail)
    if ok:
        assert area(read_mesh(tmp_path / "a.ply")) == pytest.approx(1.0)
        return
    with pytest.raises(RoomError, match="goes on for 13 bytes"):
        read_mesh(tmp_path / "a.ply")


def test_corners_of_another_element_are_told(tmp_path: Path) -> None:
    with pytest.raises(RoomError, match="element 'tristrip' with vertex indices"):
        ply(tmp_path, end="4 0 1 2 3\n4 0 1 3 2\n", more=f"element tristrip 1\n{LIST}")


def test_colours_have_the_type_that_is_stated(tmp_path: Path) -> None:
    """Parts of 1 under `uchar` were nearly black."""
    with pytest.raises(RoomError, match="not whole numbers, as their type says"):
        ply(tmp_path, RGB, " 0.5 0.5 0.5")


@pytest.mark.parametrize(("values", "is_read"), [("51400 25700 0", True), ("0 0 0", True), ("200 100 0", False)])
def test_codes_of_8_bits_are_none_of_16(tmp_path: Path, values: str, is_read: bool) -> None:
    """Under `ushort` they made a black room."""
    own = RGB.replace("uchar", "ushort")
    if not is_read:
        with pytest.raises(RoomError, match="16 bits that end below 256"):
            ply(tmp_path, own, f" {values}")
        return
    paint = ply(tmp_path, own, f" {values}").paint
    assert paint is not None
    assert paint.face_colours is not None
    top = max(float(word) / 65535.0 for word in values.split())
    assert paint.face_colours.max() == pytest.approx(((top + 0.055) / 1.055) ** 2.4 if top else 0.0)


def test_a_comment_names_a_picture_in_any_case(tmp_path: Path) -> None:
    Image.fromarray(np.full((2, 2, 3), 9, np.uint8)).save(tmp_path / "a.png")
    for word in ("TextureFile", "texturefile", "TEXTUREFILE"):
        part = ply(tmp_path, f"property float s\nproperty float t\ncomment {word} a.png\n", " 0 0")
        assert part.paint is not None
        assert part.paint.picture is not None


def test_another_version_is_told(tmp_path: Path) -> None:
    ply(tmp_path)
    (tmp_path / "a.ply").write_text((tmp_path / "a.ply").read_text().replace("ascii 1.0", "ascii 2.0"))
    with pytest.raises(RoomError, match=r"version 2\.0: 1\.0 is read"):
        read_mesh(tmp_path / "a.ply")


def test_numbers_in_words_take_little_memory(tmp_path: Path) -> None:
    """Each word as an object of its own took 50 bytes and more; a file has up to 250 million."""
    count = 300_000
    text = f"ply\nformat ascii 1.0\nelement vertex {count}\n{XYZ}element face 0\n{LIST}end_header\n"
    (tmp_path / "a.ply").write_text(text + "0.125 0.125 0.125\n" * count)
    tracemalloc.start()
    try:
        with pytest.raises(RoomError, match="0 triangles"):
            read_mesh(tmp_path / "a.ply")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 40 * 3 * count
