"""Names, colours and libraries of OBJ files: what readers join in different ways is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from phibench.datasets.common.input_files import InputFile
from phibench.datasets.rooms import obj_file
from phibench.datasets.rooms.mesh_parts import MeshPart
from phibench.datasets.rooms.mesh_placement import read_mesh
from phibench.datasets.rooms.room_files import RoomError
from phibench.scenes.shapes import Bitmap

V = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
VT = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
RED, GREEN = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
USED = f"mtllib a.mtl\n{V}{VT}usemtl a\nf 1/1 2/2 3/3 4/4\n"


def obj(folder: Path, text: str, materials: str = "", library: str = "a.mtl") -> tuple[MeshPart, ...]:
    (folder / library).parent.mkdir(exist_ok=True)
    (folder / library).write_text(materials)
    (folder / "a.obj").write_text(text)
    return read_mesh(folder / "a.obj")


def picture(path: Path, colour: tuple[float, ...]) -> str:
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(np.full((2, 2, 3), 255 * np.array(colour), np.uint8)).save(path)
    return path.name


def colour(part: MeshPart) -> tuple[float, ...]:
    """Colour of a part that has one; pictures here have the codes 0 and 255 alone."""
    assert part.paint is not None
    if part.paint.picture is None:
        return part.paint.colour
    return tuple(part.paint.picture[0, 0] / 255.0)


@pytest.mark.parametrize(("one", "two"), [("Material #25", "Material #26"), ("M#1", "M#2"), ("a b", "a c")])
def test_a_name_may_hold_the_sign_of_a_comment(tmp_path: Path, one: str, two: str) -> None:
    """Cut there, both were one material, and all faces had the colour of the first."""
    text = f"mtllib a.mtl\n{V}usemtl {one}\nf 1 2 3\nusemtl {two}\nf 1 3 4\n"
    parts = obj(tmp_path, text, f"newmtl {one}\nKd 1 0 0\nnewmtl {two}\nKd 0 1 0\n")
    assert [colour(part) for part in parts] == [RED, GREEN]


@pytest.mark.parametrize(("used", "defined"), [("wood # of the floor", "wood"), ("wood", "wood # brown")])
def test_a_comment_after_a_name_is_none_of_it(tmp_path: Path, used: str, defined: str) -> None:
    text = f"mtllib a.mtl # library\n{V}usemtl {used}\nf 1 2 3 4 # square\n"
    [part] = obj(tmp_path, text, f"newmtl {defined}\nKd 1 0 0 # red\n")
    assert colour(part) == RED


@pytest.mark.parametrize("name", ["f#1.png", "f # 2.png", "f%20a.png", "f  a.png", "f\u00a0a.png"])
def test_names_of_pictures_count_as_they_stand(tmp_path: Path, name: str) -> None:
    picture(tmp_path / "f a.png", GREEN)
    picture(tmp_path / name, RED)
    [part] = obj(tmp_path, USED, f"newmtl a\nmap_Kd -s 1 1 1 {name}\n")
    assert colour(part) == RED


def test_a_library_names_pictures_from_its_own_folder(tmp_path: Path) -> None:
    """Another of the same name beside the mesh was taken for it; what is only there is still found."""
    text = USED.replace("a.mtl", "mtl/a.mtl")
    picture(tmp_path / "f.png", GREEN)
    assert colour(obj(tmp_path, text, "newmtl a\nmap_Kd f.png\n", "mtl/a.mtl")[0]) == GREEN
    picture(tmp_path / "mtl" / "f.png", RED)
    assert colour(obj(tmp_path, text, "newmtl a\nmap_Kd f.png\n", "mtl/a.mtl")[0]) == RED
    assert colour(obj(tmp_path, text, "newmtl a\nmap_Kd ../f.png\n", "mtl/a.mtl")[0]) == GREEN
    with pytest.raises(RoomError, match="not in its folder"):
        obj(tmp_path, text, "newmtl a\nmap_Kd ../../f.png\n", "mtl/a.mtl")


def test_two_materials_of_one_name_are_refused_where_they_differ(tmp_path: Path) -> None:
    (tmp_path / "b.mtl").write_text("newmtl a\nKd 0 1 0\nnewmtl b\nKd 0 1 0\n")
    for text in (USED.replace("a.mtl", "a.mtl b.mtl"), f"{USED}mtllib b.mtl\n"):
        with pytest.raises(RoomError, match="define twice and not alike"):
            obj(tmp_path, text, "newmtl a\nKd 1 0 0\n")
        assert colour(obj(tmp_path, text, "newmtl a\nKd 0 1 0\n")[0]) == GREEN
        assert colour(obj(tmp_path, text.replace("usemtl a", "usemtl b"), "newmtl a\nKd 1 0 0\n")[0]) == GREEN


@pytest.mark.parametrize(
    ("vertex", "material", "expected"),
    [
        (RED, "Kd 1 1 1", RED),
        (RED, "", RED),
        ((1.0, 1.0, 1.0), "Kd 1 0 0", RED),
        (RED, "Kd 1 0 0", RED),
        (RED, "Kd 0.5 0.5 0.5", None),
        (RED, "map_Kd f.png", None),
    ],
)
def test_colours_of_vertices_and_of_a_material(
    tmp_path: Path, vertex: tuple[float, ...], material: str, expected: tuple[float, ...] | None
) -> None:
    """Readers multiply them or take one: they count where all of these agree."""
    picture(tmp_path / "f.png", GREEN)
    text = USED.replace(" 0\nv", f" 0 {vertex[0]:g} {vertex[1]:g} {vertex[2]:g}\nv")
    text = text.replace("v 0 1 0\n", f"v 0 1 0 {vertex[0]:g} {vertex[1]:g} {vertex[2]:g}\n")
    if expected is None:
        with pytest.raises(RoomError, match="take one of them away"):
            obj(tmp_path, text, f"newmtl a\n{material}\n")
        return
    [part] = obj(tmp_path, text, f"newmtl a\n{material}\n")
    assert part.paint is not None
    found = part.paint.face_colours if part.paint.face_colours is not None else [part.paint.colour] * 2
    np.testing.assert_allclose(found, [expected] * 2)


@pytest.mark.parametrize(
    ("emission", "code", "light"),
    [
        ("", 255, 1.0),
        ("Ke 0.5 0.5 0.5\n", 255, 0.5),
        ("Ke 0 0 0\n", 0, None),
        ("Ke 0 0 0\n", 255, "Ke 0 and map_Ke of 'a'"),
    ],
)
def test_a_picture_of_emission_shines_or_is_told(tmp_path: Path, emission: str, code: int, light: object) -> None:
    """Beside Ke 0 some programs mean the picture, others darkness: lamps were missing without a word."""
    Image.fromarray(np.full((2, 2, 3), code, np.uint8)).save(tmp_path / "e.png")
    materials = f"newmtl a\nKd 0.5 0.5 0.5\n{emission}map_Ke e.png\n"
    if isinstance(light, str):
        with pytest.raises(RoomError, match=light):
            obj(tmp_path, USED, materials)
        return
    [part] = obj(tmp_path, USED, materials)
    assert (None if part.light is None else part.light.colour[0]) == light


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("# from C:\\models\\\n" + V + "f 1 2 3 4\n", "ends in a backslash"),
        ("v 0 0 0 1 0 0 1\nv 1 0 0 1 0 0 1\nv 1 1 0 1 0 0 1\nf 1 2 3\n", "7 numbers: 3, 4 or 6"),
        ("v 0 0 0 2\nv 2 0 0 2\nv 2 2 0 2\nf 1 2 3\n", "the weight 2"),
        ("v 0 0 0\nv 1_0 0 0\nv 1 1 0\nf 1 2 3\n", "'1_0' in the place of a number"),
        ("v 0 0 0\nv \uff11 0 0\nv 1 1 0\nf 1 2 3\n", "in the place of a number"),
    ],
)
def test_what_readers_take_in_different_ways_is_refused(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(RoomError, match=words):
        obj(tmp_path, text)


def test_a_comment_may_end_in_a_backslash_before_another(tmp_path: Path) -> None:
    assert len(obj(tmp_path, "# C:\\a\\\n# more\n\n" + V + "f 1 2 3 4\n")) == 1


def test_a_line_without_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its words would take fifty times the memory of the file."""
    monkeypatch.setattr(obj_file, "_LONGEST_LINE", 1000)
    with pytest.raises(RoomError, match="a line of 2001 characters: at most 1000"):
        obj(tmp_path, V + "f" + " 1" * 1000 + "\n")


@pytest.mark.parametrize("option", ["-clamp on", "-clamp off"])
def test_a_clamped_picture_ends_at_its_edges(tmp_path: Path, option: str) -> None:
    """Half a texel of its other side shone through; at v = 0 in the middle of the lower row, between both otherwise."""
    pixels = np.array([[RED] * 2, [GREEN] * 2])
    Image.fromarray(np.uint8(255 * pixels)).save(tmp_path / "f.png")
    [part] = obj(tmp_path, USED, f"newmtl a\nmap_Kd {option} f.png\n")
    assert part.paint is not None
    assert part.paint.picture is not None
    assert part.paint.uv is not None
    values = np.concatenate([part.paint.picture[::-1], part.paint.picture[::-1, :, :1]], axis=-1) / np.float32(255)
    bitmap = Bitmap(values, (1.0, 1.0))
    lower = bitmap.sample(part.paint.uv[0, 0] * part.paint.picture.shape[1::-1])[:3]
    np.testing.assert_allclose(lower, GREEN if option == "-clamp on" else (0.5, 0.5, 0.0), atol=1e-6)


def test_a_library_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read, whole = [], InputFile.read
    monkeypatch.setattr(InputFile, "read", lambda file: read.append(file.path.suffix) or whole(file))
    assert len(obj(tmp_path, "mtllib a.mtl\n" * 50 + USED, "newmtl a\nKd 1 0 0\n")) == 1
    assert sorted(read) == [".mtl", ".obj"]
