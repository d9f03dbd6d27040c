"""OBJ and PLY files are read by their definitions, or refused by name; `trimesh` is asked where it is right."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.gltf_documents import SQUARE, UV
from helpers.mesh_files import area, normals, write_obj, write_ply
from PIL import Image

from phibench.datasets.rooms.mesh_parts import MeshPart
from phibench.datasets.rooms.mesh_placement import read_mesh
from phibench.datasets.rooms.mesh_polygons import CuttingBudget, triangulated
from phibench.datasets.rooms.room_files import RoomError

# -- OBJ -----------------------------------------------------------------------------------------------------------


def obj(folder: Path, text: str, materials: str = "") -> tuple[MeshPart, ...]:
    (folder / "one.obj").write_text(text)
    (folder / "one.mtl").write_text(materials)
    return read_mesh(folder / "one.obj")


V = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


@pytest.mark.parametrize("face", ["f 1 2 3 4", "f -4 -3 -2 -1", "f 1 -3 3 -1", "f 1// 2// 3// 4//", "f \\\n 1 2 3 4"])
def test_indices_count_from_the_front_or_back(tmp_path: Path, face: str) -> None:
    """Negative ones from what was read so far: vertices after the face do not change it."""
    [part] = obj(tmp_path, V + face + "\n" + V.replace(" 0\n", " 9\n"))
    assert area([part]) == pytest.approx(1.0)
    np.testing.assert_allclose(part.vertices[part.triangles][..., 2], 0.0)


def test_a_concave_face_keeps_its_area(tmp_path: Path) -> None:
    """An L of area 3; a fan would cover the notch."""
    points = "v 0 0 0\nv 2 0 0\nv 2 1 0\nv 1 1 0\nv 1 2 0\nv 0 2 0\n"
    for turned in range(6):
        order = " ".join(str((k + turned) % 6 + 1) for k in range(6))
        [part] = obj(tmp_path, f"{points}f {order}\n")
        assert area([part]) == pytest.approx(3.0)
        np.testing.assert_allclose(normals(part), [[0, 0, 1]] * 4)


def test_random_polygons_are_covered_once() -> None:
    """Area by the shoelace formula, 100 stars of 5 to 40 corners in random planes; 1e-9 is rounding of a sum."""
    rng, checked = np.random.default_rng(3), 0
    for _ in range(100):
        count = int(rng.integers(5, 41))
        angle, radius = np.sort(rng.uniform(0, 2 * np.pi, count)), rng.uniform(0.2, 1.0, count)
        flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        gaps = np.diff([*angle, angle[0] + 2 * np.pi])
        if gaps.max() > np.pi:
            continue
        x, y = flat.T
        shoelace = 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
        Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        points = flat @ Q[:, :2].T
        three = points[triangulated(points, CuttingBudget())]
        areas = 0.5 * np.linalg.norm(np.cross(three[:, 1] - three[:, 0], three[:, 2] - three[:, 0]), axis=1)
        assert len(three) == count - 2
        assert areas.sum() == pytest.approx(shoelace, rel=1e-9)
        checked += 1
    assert checked > 80


def test_materials_of_an_obj_have_their_options(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "my floor.png")
    text = "mtllib one.mtl\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n" + V + "usemtl a b\nf 1/1 2/2 3/3 4/4\n"
    [part] = obj(tmp_path, text, "newmtl a b\nKd 0 0 0\nKe 2\nmap_Kd -s 2 3 1 -o 0.5 -clamp off my floor.png\n")
    assert part.paint is not None
    assert part.light is not None
    np.testing.assert_allclose(part.paint.uv, (UV * [2, 3] + [0.5, 0])[part.triangles])
    assert part.light.colour == (2.0, 2.0, 2.0)
    assert part.light.picture is None


@pytest.mark.parametrize(
    ("text", "materials", "words"),
    [
        (V + "f 1 2 5\n", "", "vertices or texture coordinates that are not there"),
        (V + "f 1 2 -5\n", "", "the vertex -5, of 4 so far"),
        (V + "f 0 1 2\n", "", "the vertex 0"),
        (V + "curv 0 1 1 2\n", "", "free-form"),
        ("mtllib one.mtl\n" + V + "usemtl gone\nf 1 2 3\n", "newmtl here\n", "uses the material 'gone'"),
        ("mtllib one.mtl\n" + V + "usemtl a\nf 1 2 3\n", "newmtl a\nKd spectral x.rfl 1\n", "as spectral"),
        ("mtllib one.mtl\n" + V + "usemtl a\nf 1 2 3\n", "newmtl a\nKd 1 2\n", "three numbers from 0 up"),
        ("mtllib one.mtl\n" + V + "usemtl a\nf 1 2 3\n", "newmtl a\nmap_Kd -mm 0 2 p.png\n", "-mm"),
        ("mtllib one.mtl\n" + V + "usemtl a\nf 1 2 3\n", "newmtl a\nmap_Kd p.png\n", "p.png', which is missing"),
        ("mtllib one.mtl\n" + V + "usemtl a\nf 1 2 3\n", "newmtl a\nKd 200 100 50\n", "Kd of 'a' up to 200: write it"),
        ("mtllib one.mtl\n" + V + "usemtl a\nf 1 2 3\n", "newmtl a\nTr 1\n", "write d 1 or d 0"),
        (V[:-2] + "0 1 0 0\nf 1 2 3 4\n", "", "give all a colour, or none"),
    ],
)
def test_what_an_obj_cannot_say_is_refused(tmp_path: Path, text: str, materials: str, words: str) -> None:
    with pytest.raises(RoomError, match=words) as caught:
        obj(tmp_path, text, materials)
    assert "\n" not in str(caught.value)


def test_what_is_wholly_transparent_is_not_there(tmp_path: Path) -> None:
    """Of materials with d, by Wavefront's definition; a picture's alpha counts, or its brightness without one."""
    text = "mtllib one.mtl\nvt 0 0\nvt 1 0\nvt 1 1\n" + V + "usemtl wall\nf 1 2 3\nusemtl pane\nf 1/1 3/2 4/3\n"
    for line, seen in (("d 0.0", 1), ("d -halo 0.0", 1), ("d 0.1", 2), ("d 1\nTr 1", 2)):
        assert len(obj(tmp_path, text, f"newmtl wall\nKd 0.5\nnewmtl pane\n{line}\n")) == seen
    for name, pixel, holes in (
        ("a.png", (9, 9, 9, 0), True),
        ("b.png", (0, 0, 0, 9), False),
        ("c.png", (0, 0, 0), True),
    ):
        Image.fromarray(np.full((2, 2, len(pixel)), pixel, np.uint8)).save(tmp_path / name)
        materials = f"newmtl wall\nnewmtl pane\nmap_d {name}\n"
        if holes:
            with pytest.raises(RoomError, match="holes in the material 'pane'"):
                obj(tmp_path, text, materials)
        else:
            assert len(obj(tmp_path, text, materials)) == 2


def test_trimesh_reads_the_same_obj(tmp_path: Path) -> None:
    path = write_obj(tmp_path)
    assert area(read_mesh(path)) == pytest.approx(trimesh.load_mesh(path, process=False).area, rel=1e-6)


@pytest.mark.parametrize("head", ["\ufeff", ""])
def test_a_byte_order_mark_is_no_part_of_the_first_line(tmp_path: Path, head: str) -> None:
    """Of a first vertex it made another mesh: all indices were off by one."""
    text = head + "v 9 9 9\nv 0 0 0\nv 1 0 0\nv 1 1 0\nf 2 3 4\n"
    assert area(obj(tmp_path, text)) == pytest.approx(0.5)


def test_names_before_utf_8_stay_different(tmp_path: Path) -> None:
    (tmp_path / "a.mtl").write_bytes("newmtl W\xe4nd\nKd 1 0 0\nnewmtl W\xf6nd\nKd 0 1 0\n".encode("latin-1"))
    text = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nusemtl W\xe4nd\nf 1 2 3\nusemtl W\xf6nd\nf 1 2 3\n"
    (tmp_path / "a.obj").write_bytes(text.encode("latin-1"))
    assert [part.paint.colour for part in read_mesh(tmp_path / "a.obj") if part.paint] == [(1, 0, 0), (0, 1, 0)]


@pytest.mark.parametrize(("line", "words"), [("usemap wood", "usemap"), ("vx 1 2 3", "OBJ does not know, 'vx 1 2 3'")])
def test_a_line_that_is_not_read_is_told(tmp_path: Path, line: str, words: str) -> None:
    """Lines without a shape are passed over."""
    plain = "vn 0 0 1\ns off\nlod 1\np 1\nl 1 2\nv 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n"
    assert area(obj(tmp_path, plain)) == pytest.approx(0.5)
    with pytest.raises(RoomError, match=words):
        obj(tmp_path, f"{line}\n{plain}")


# -- PLY -----------------------------------------------------------------------------------------------------------

PLACES = "property float s\nproperty float t\n"
TINTS = "property uchar red\nproperty uchar green\nproperty uchar blue\n"


def ply(folder: Path, places: bool = False, tints: bool = False, extra: str = "", order: str = "ascii") -> MeshPart:
    """A square with texture coordinates, colours (code 200, 100, 0), both or none."""
    header = (
        f"ply\nformat {order} 1.0\n{extra}element vertex 4\nproperty double x\nproperty double y\nproperty double z\n"
    )
    header += PLACES * places + TINTS * tints + "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    if order == "ascii":
        tint = [200, 100, 0] if tints else []
        lines = [[*p, *(uv if places else []), *tint] for p, uv in zip(SQUARE, UV, strict=True)]
        rows = [" ".join(map(str, line)) for line in lines]
        body = ("\n".join(rows) + "\n4 0 1 2 3\n").encode()
    else:
        end = ">" if "big" in order else "<"
        body = b"".join(
            struct.pack(end + "3d", *p)
            + (struct.pack(end + "2f", *uv) if places else b"")
            + (bytes([200, 100, 0]) if tints else b"")
            for p, uv in zip(SQUARE, UV, strict=True)
        )
        body += struct.pack(end + "B4i", 4, 0, 1, 2, 3)
    (folder / "one.ply").write_bytes(header.encode() + body)
    [part] = read_mesh(folder / "one.ply")
    return part


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("places", [False, True])
@pytest.mark.parametrize("tints", [False, True])
def test_coordinates_without_a_picture_colour_nothing(tmp_path: Path, order: str, places: bool, tints: bool) -> None:
    part = ply(tmp_path, places, tints, order=order)
    assert area([part]) == pytest.approx(1.0)
    if not tints:
        assert part.paint is None
        return
    assert part.paint is not None
    x = np.array([200, 100]) / 255.0
    expected = [*((x + 0.055) / 1.055) ** 2.4, 0.0]  # IEC 61966-2-1, written out
    np.testing.assert_allclose(part.paint.face_colours, [expected] * 2, rtol=1e-12)
    assert part.paint.picture is None


def test_a_named_picture_is_read(tmp_path: Path) -> None:
    Image.fromarray(np.full((2, 2, 3), 9, np.uint8)).save(tmp_path / "a b.png")
    part = ply(tmp_path, places=True, tints=True, extra="comment TextureFile a b.png\n")
    assert part.paint is not None
    np.testing.assert_allclose(part.paint.uv, UV[part.triangles])
    with pytest.raises(RoomError, match="no texture coordinates"):
        ply(tmp_path, extra="comment TextureFile a b.png\n")
    with pytest.raises(RoomError, match=r"gone\.png', which is missing"):
        ply(tmp_path, places=True, extra="comment TextureFile gone.png\n")


def test_strips_and_mixed_faces_of_a_ply(tmp_path: Path) -> None:
    vertices = "\n".join(" ".join(map(str, p)) for p in SQUARE)
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    strips = "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    (tmp_path / "s.ply").write_text(f"{head}{strips}{vertices}\n8 0 1 3 2 -1 0 1 2\n")
    [part] = read_mesh(tmp_path / "s.ply")
    assert area([part]) == pytest.approx(1.5)
    np.testing.assert_allclose(normals(part), [[0, 0, 1]] * 3)
    faces = "element face 2\nproperty list uchar int vertex_indices\nproperty uchar red\nproperty uchar green\n"
    faces += "property uchar blue\nend_header\n"
    (tmp_path / "f.ply").write_text(f"{head}{faces}{vertices}\n3 0 1 2 255 0 0\n4 0 1 2 3 0 255 0\n")
    [part] = read_mesh(tmp_path / "f.ply")
    assert part.paint is not None
    np.testing.assert_allclose(part.paint.face_colours, [[1, 0, 0], [0, 1, 0], [0, 1, 0]])


def test_trimesh_reads_the_same_ply(tmp_path: Path) -> None:
    path = write_ply(tmp_path / "room.ply")
    [part], other = read_mesh(path), trimesh.load_mesh(path, process=False)
    np.testing.assert_allclose(part.vertices, other.vertices)
    np.testing.assert_array_equal(part.triangles, other.faces)


@pytest.mark.parametrize("names", ["Red Green Blue", "ambient_red ambient_green ambient_blue", "gray", "rgb"])
@pytest.mark.parametrize("owner", ["vertex", "face"])
def test_colours_by_other_names_are_told(tmp_path: Path, names: str, owner: str) -> None:
    """They were passed over, and the plain albedo took their place."""
    own = "".join(f"property uchar {name}\n" for name in names.split())
    values = " 200" * len(names.split())
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    text = f"{head}{own if owner == 'vertex' else ''}element face 1\nproperty list uchar int vertex_indices\n"
    text += f"{own if owner == 'face' else ''}end_header\n"
    text += "".join(f"{place}{values if owner == 'vertex' else ''}\n" for place in ("0 0 0", "1 0 0", "1 1 0"))
    (tmp_path / "a.ply").write_text(f"{text}3 0 1 2{values if owner == 'face' else ''}\n")
    with pytest.raises(RoomError, match=f"colours of each {owner} as '{names.split()[0]}'"):
        read_mesh(tmp_path / "a.ply")


@pytest.mark.parametrize("number", [0, 1, -1])
def test_a_face_may_name_the_one_picture_alone(tmp_path: Path, number: int) -> None:
    Image.fromarray(np.full((2, 2, 3), 9, np.uint8)).save(tmp_path / "a.png")
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile a.png\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nelement face 1\nproperty list uchar int vertex_indices\n"
        "property list uchar float texcoord\nproperty int texnumber\nend_header\n"
        f"0 0 0\n1 0 0\n1 1 0\n3 0 1 2 6 0 0 1 0 1 1 {number}\n"
    )
    if number:
        with pytest.raises(RoomError, match="texnumber other than 0"):
            read_mesh(tmp_path / "a.ply")
    else:
        assert len(read_mesh(tmp_path / "a.ply")) == 1


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_a_header_ends_at_its_own_line_end(tmp_path: Path, order: str, end: str) -> None:
    """The first byte of the body is a line feed here, and a comment holds the last word of the header."""
    sign = "<" if order == "little" else ">"
    first = np.frombuffer(b"\n\n\n\n", f"{sign}f4")[0]  # 6.6e-33, as good as 0
    points = np.array([[first, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], f"{sign}f4")
    lines = ["ply", f"format binary_{order}_endian 1.0", "comment end_header", "element vertex 4"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    body = points.tobytes() + bytes([4]) + np.arange(4, dtype=f"{sign}i4").tobytes()
    (tmp_path / "a.ply").write_bytes(end.join([*lines, ""]).encode() + body)
    assert area(read_mesh(tmp_path / "a.ply")) == pytest.approx(1.0)


@pytest.mark.parametrize("owner", ["vertex", "face"])
def test_materials_of_a_ply_colour_what_names_them(tmp_path: Path, owner: str) -> None:
    """An element `material` as Turk defines it; without a material's colour the file is refused."""
    own = "property int material_index\n"
    text = (
        "ply\nformat ascii 1.0\nelement material 2\n"
        + "".join(f"property uchar diffuse_{name}\n" for name in ("red", "green", "blue"))
        + "element vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        + (own if owner == "vertex" else "")
        + "element face 1\nproperty list uchar int vertex_indices\n"
        + (own if owner == "face" else "")
        + "end_header\n255 0 0\n0 255 0\n"
    )
    index = " 1" if owner == "vertex" else ""
    text += f"0 0 0{index}\n1 0 0{index}\n1 1 0{index}\n3 0 1 2{' 1' if owner == 'face' else ''}\n"
    (tmp_path / "a.ply").write_text(text)
    [part] = read_mesh(tmp_path / "a.ply")
    assert part.paint is not None
    np.testing.assert_allclose(part.paint.face_colours, [[0.0, 1.0, 0.0]])
    (tmp_path / "a.ply").write_text(text.replace("diffuse_", "some_"))
    with pytest.raises(RoomError, match="no material a colour"):
        read_mesh(tmp_path / "a.ply")
