"""Mesh files are read by their formats' definitions, or refused by name; `trimesh` is asked where it is right."""

from __future__ import annotations

import json
import struct
import urllib.parse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.gltf_documents import SQUARE, UV, Gltf
from helpers.mesh_files import scene, write_glb, write_obj, write_ply, y_up
from PIL import Image

from phibench.datasets.rooms.mesh_files import read_mesh
from phibench.datasets.rooms.mesh_parts import MeshPart
from phibench.datasets.rooms.polygons import Cutting, triangulated
from phibench.datasets.rooms.room_files import RoomError


def area(parts: tuple[MeshPart, ...] | list[MeshPart]) -> float:
    corners = np.concatenate([part.vertices[part.triangles] for part in parts])
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(0.5 * np.linalg.norm(cross, axis=1).sum())


def normals(part: MeshPart) -> np.ndarray:
    a, b, c = np.moveaxis(part.vertices[part.triangles], 1, 0)
    cross = np.cross(b - a, c - a)
    return cross / np.linalg.norm(cross, axis=1, keepdims=True)


# -- glTF ----------------------------------------------------------------------------------------------------------

CORNERS = np.array([[0, 1, 2], [0, 2, 3]])  # of the fan, each triangle's first corner last by the definition


@pytest.mark.parametrize(("mode", "index"), [(4, [0, 1, 2, 0, 2, 3]), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3]), (6, None)])
def test_lists_strips_and_fans_are_one_square_with_one_sense(
    tmp_path: Path, mode: int, index: list[int] | None
) -> None:
    document = Gltf()
    document.primitive["mode"] = mode
    if index is not None:
        document.primitive["indices"] = document.array(np.array(index, np.uint8))
    part = document.one(tmp_path)
    assert area([part]) == pytest.approx(1.0)
    np.testing.assert_allclose(normals(part), [[0, 0, 1]] * 2)


@pytest.mark.parametrize("mode", [0, 1, 2, 3])
def test_points_and_lines_have_no_surface(tmp_path: Path, mode: int) -> None:
    document = Gltf()
    document.tree["meshes"][0]["primitives"].append({**document.primitive, "mode": mode})
    assert len(document.read(tmp_path)) == 1
    document.primitive["mode"] = mode
    document.tree["meshes"][0]["primitives"].pop()
    with pytest.raises(RoomError, match="has 0 triangles"):
        document.read(tmp_path)


def test_emission_has_coordinates_of_its_own(tmp_path: Path) -> None:
    document = Gltf()
    attributes = document.primitive["attributes"]
    attributes |= {"TEXCOORD_0": document.array(UV), "TEXCOORD_1": document.array(0.5 * UV)}
    texture = document.texture(np.full((2, 2, 3), 156, np.uint8))
    base = {"baseColorTexture": {"index": texture}}
    emission = {"index": texture, "texCoord": 1}
    document.material(pbrMetallicRoughness=base, emissiveTexture=emission, emissiveFactor=[1.0, 1.0, 1.0])
    part = document.one(tmp_path)
    assert part.paint is not None
    assert part.light is not None
    # v counts upwards here: 1 - v of the file
    np.testing.assert_allclose(part.paint.uv, (UV * [1, -1] + [0, 1])[part.triangles])
    np.testing.assert_allclose(part.light.uv, (0.5 * UV * [1, -1] + [0, 1])[part.triangles])


@pytest.mark.parametrize(
    ("pixels", "code"),
    [
        (np.full((3, 2), 40_000, np.uint16), 156),  # 40 000 / 257 = 155.6
        (np.full((3, 2), 156, np.uint8), 156),
        (np.full((3, 2, 4), 156, np.uint8), 156),
        (np.full((3, 2), True), 255),
    ],
)
def test_pictures_of_any_depth_have_their_values(tmp_path: Path, pixels: np.ndarray, code: int) -> None:
    document = Gltf()
    document.primitive["attributes"]["TEXCOORD_0"] = document.array(UV)
    document.material(pbrMetallicRoughness={"baseColorTexture": {"index": document.texture(pixels)}})
    part = document.one(tmp_path)
    assert part.paint is not None
    assert part.paint.picture is not None
    assert part.paint.picture.shape == (3, 2, 3)
    assert set(np.unique(part.paint.picture)) == {code}


def test_rounded_coordinates_sparse_arrays_and_strides_are_read(tmp_path: Path) -> None:
    document = Gltf()
    document.primitive["attributes"]["TEXCOORD_0"] = document.array((255 * UV).astype(np.uint8), normalized=True)
    document.material(
        pbrMetallicRoughness={"baseColorTexture": {"index": document.texture(np.zeros((2, 2, 3), np.uint8))}}
    )
    part = document.one(tmp_path)
    assert part.paint is not None
    np.testing.assert_allclose(part.paint.uv, (UV * [1, -1] + [0, 1])[part.triangles])
    wide = np.zeros((4, 5), np.float32)
    wide[:, :3] = SQUARE
    accessor = document.tree["accessors"][document.primitive["attributes"]["POSITION"]]
    accessor["bufferView"] = document.view(wide.tobytes(), byteStride=20)
    index, value = np.array([2], np.uint8), np.array([[3.0, 1.0, 0.0]], np.float32)
    places = {"bufferView": document.view(index.tobytes()), "componentType": 5121}
    accessor["sparse"] = {"count": 1, "indices": places, "values": {"bufferView": document.view(value.tobytes())}}
    assert area(document.read(tmp_path)) == pytest.approx(2.0)  # the square, and a triangle of base 1... beside it


def test_repeats_are_those_of_the_sampler(tmp_path: Path) -> None:
    """Mirrored: the same texels as by the definition, at random places; clamped: only within the picture."""
    pixels = np.random.default_rng(0).integers(0, 256, (4, 4, 3), dtype=np.uint8)
    for mode, ok in ((10497, True), (33648, True), (33071, False)):
        document = Gltf()
        uv = (3.0 * UV - 1.0).astype(np.float32)
        document.primitive["attributes"]["TEXCOORD_0"] = document.array(uv)
        texture = document.texture(pixels, wrapS=mode, wrapT=mode)
        document.material(pbrMetallicRoughness={"baseColorTexture": {"index": texture}})
        if not ok:
            with pytest.raises(RoomError, match="CLAMP_TO_EDGE"):
                document.read(tmp_path)
            document.tree["accessors"][-1]["bufferView"] = document.view(UV.tobytes())
            assert document.read(tmp_path)
            continue
        part = document.one(tmp_path)
        assert part.paint is not None
        assert part.paint.picture is not None
        assert part.paint.uv is not None
        inside = np.random.default_rng(1).dirichlet((1, 1, 1), 200)
        place, found = inside @ uv[part.triangles[0]].astype(float), inside @ part.paint.uv[0]
        wrapped = place % 1.0 if mode == 10497 else 1.0 - np.abs(place % 2.0 - 1.0)
        expected = pixels[tuple(np.minimum((wrapped * 4).astype(int), 3).T[::-1])]
        height, width = part.paint.picture.shape[:2]
        row = height - 1 - np.floor((found[:, 1] % 1.0) * height).astype(int)
        column = np.floor((found[:, 0] % 1.0) * width).astype(int)
        np.testing.assert_array_equal(part.paint.picture[row, column], expected)


def test_a_transform_of_coordinates_is_the_definitions_example(tmp_path: Path) -> None:
    """The lower left quadrant, turned: offset (0, 1), a quarter turn, scale 0.5 (KHR_texture_transform, examples)."""
    document = Gltf()
    document.primitive["attributes"]["TEXCOORD_0"] = document.array(UV)
    texture = document.texture(np.zeros((2, 2, 3), np.uint8))
    moved = {"KHR_texture_transform": {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}}
    document.material(pbrMetallicRoughness={"baseColorTexture": {"index": texture, "extensions": moved}})
    part = document.one(tmp_path)
    assert part.paint is not None
    assert part.paint.uv is not None
    low, high = part.paint.uv.min(axis=(0, 1)), part.paint.uv.max(axis=(0, 1))
    np.testing.assert_allclose([*low, *high], [0.0, 0.0, 0.5, 0.5], atol=1e-7)  # v upwards: the lower left


def test_vertex_colours_multiply_the_material(tmp_path: Path) -> None:
    document = Gltf()
    tints = np.array([[65535, 0, 0]] * 4, np.uint16)
    document.primitive["attributes"]["COLOR_0"] = document.array(tints, normalized=True)
    document.material(pbrMetallicRoughness={"baseColorFactor": [0.5, 0.5, 0.5, 1.0]})
    part = document.one(tmp_path)
    assert part.paint is not None
    np.testing.assert_allclose(part.paint.face_colours, [[0.5, 0.0, 0.0]] * 2)
    document.primitive["attributes"]["TEXCOORD_0"] = document.array(UV)
    document.tree["materials"][0]["pbrMetallicRoughness"] |= {
        "baseColorTexture": {"index": document.texture(np.full((2, 2, 3), 255, np.uint8))}
    }
    part = document.one(tmp_path)
    assert part.paint is not None
    assert part.paint.colour == pytest.approx((0.5, 0.0, 0.0))
    tints[2] = 7
    document.primitive["attributes"]["COLOR_0"] = document.array(tints, normalized=True)
    with pytest.raises(RoomError, match="tint a picture"):
        document.read(tmp_path)


def test_only_the_scene_that_is_shown_counts(tmp_path: Path) -> None:
    document = Gltf()
    document.tree["nodes"] += [{"name": "other", "mesh": 0, "translation": [5, 0, 0]}]
    document.tree["scenes"] = [{"nodes": [1]}, {"nodes": [0, 1]}]
    document.tree["scene"] = 1
    assert len(document.read(tmp_path)) == 2
    del document.tree["scene"]
    [part] = document.read(tmp_path)
    assert part.vertices[:, 0].min() == 5.0
    document.tree["scenes"] = []
    assert len(document.read(tmp_path)) == 2


def _draco(document: Gltf) -> None:
    document.primitive["extensions"] = {"KHR_draco_mesh_compression": {}}


def _basisu(document: Gltf) -> None:
    document.primitive["attributes"]["TEXCOORD_0"] = document.array(UV)
    document.tree["images"], document.tree["textures"] = (
        [{"uri": "a.ktx2"}],
        [{"extensions": {"KHR_texture_basisu": {"source": 0}}}],
    )
    document.material(pbrMetallicRoughness={"baseColorTexture": {"index": 0}})


def _basisu_required(document: Gltf) -> None:
    document.tree["extensionsRequired"] = ["KHR_texture_basisu"]


def _meshopt(document: Gltf) -> None:
    document.tree["bufferViews"][0]["extensions"] = {"EXT_meshopt_compression": {}}


def _skin(document: Gltf) -> None:
    document.tree["nodes"][0]["skin"] = 0


def _instances(document: Gltf) -> None:
    document.tree["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {}}


def _no_places(document: Gltf) -> None:
    texture = document.texture(np.zeros((2, 2, 3), np.uint8))
    document.material(pbrMetallicRoughness={"baseColorTexture": {"index": texture}})


def _cycle(document: Gltf) -> None:
    document.tree["nodes"][0]["children"] = [0]


def _mode(document: Gltf) -> None:
    document.primitive["mode"] = 7


def _beyond(document: Gltf) -> None:
    document.primitive["indices"] = document.array(np.array([0, 1, 9], np.uint16))


def _short(document: Gltf) -> None:
    document.tree["accessors"][0]["count"] = 4000


def _version(document: Gltf) -> None:
    document.tree["asset"]["version"] = "1.0"


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (_draco, r"KHR_draco_mesh_compression\), which is not read: `gltf-transform cp"),
        (_basisu, "KHR_texture_basisu.*`ktx extract`"),
        (_basisu_required, "KHR_texture_basisu, which is not read: `ktx extract`"),
        (_meshopt, "meshopt: `gltf-transform cp"),
        (_skin, "a skeleton bends"),
        (_instances, "EXT_mesh_gpu_instancing"),
        (_no_places, "no texture coordinates TEXCOORD_0"),
        (_cycle, "no trees"),
        (_mode, "mode 7"),
        (_beyond, "vertices that are not there"),
        (_short, "damaged"),
        (_version, "is glTF 1.0"),
    ],
)
def test_what_is_not_read_is_refused_by_name(tmp_path: Path, edit: Callable[[Gltf], None], words: str) -> None:
    document = Gltf()
    edit(document)
    with pytest.raises(RoomError, match=words) as caught:
        document.read(tmp_path)
    assert "\n" not in str(caught.value)


def test_trimesh_reads_the_same_of_what_it_wrote(tmp_path: Path) -> None:
    """Triangles of every node as sets of corners, against another reader; float32 of the file."""
    path = write_glb(tmp_path / "room.glb", y_up(scene()))
    others = trimesh.load_scene(path, process=False)
    compared = 0
    for part in read_mesh(path):
        name = part.name.split("/")[0]
        transform, geometry = others.graph[name]
        mesh = others.geometry[geometry].copy().apply_transform(transform)
        assert {tuple(x) for x in np.sort(part.vertices[part.triangles].round(5), axis=1).reshape(-1, 9)} == {
            tuple(x) for x in np.sort(mesh.vertices[mesh.faces].round(5), axis=1).reshape(-1, 9)
        }
        compared += 1
    assert compared == 8


@pytest.mark.parametrize("base64_", [True, False])
def test_a_data_uri_is_base64_or_bytes_by_percent(tmp_path: Path, base64_: bool) -> None:
    """RFC 2397 has both."""
    document = Gltf()
    document.read(tmp_path)
    tree = json.loads((tmp_path / "one.gltf").read_text())
    if not base64_:
        tree["buffers"][0]["uri"] = "data:application/gltf-buffer," + urllib.parse.quote(document.data)
    (tmp_path / "two.gltf").write_text(json.dumps(tree))
    assert area(read_mesh(tmp_path / "two.gltf")) == pytest.approx(1.0)


def test_interleaved_whole_numbers_have_their_values(tmp_path: Path) -> None:
    """One view of 20 bytes a vertex: floats, 16 bits for coordinates and 8 for colours, as gltfpack writes them."""
    document = Gltf()
    rows = np.zeros(4, dtype=[("place", "<f4", 3), ("uv", "<u2", 2), ("colour", "<u1", 4)])
    rows["place"], rows["uv"], rows["colour"] = 2 * SQUARE, 65535 * UV, (128, 64, 32, 255)
    view = document.view(rows.tobytes(), byteStride=20)
    for name, offset, kind, shape in (
        ("POSITION", 0, 5126, "VEC3"),
        ("TEXCOORD_0", 12, 5123, "VEC2"),
        ("COLOR_0", 16, 5121, "VEC4"),
    ):
        accessor = {"bufferView": view, "byteOffset": offset, "componentType": kind, "count": 4, "type": shape}
        document.tree["accessors"].append(accessor | {"normalized": kind != 5126})
        document.primitive["attributes"][name] = len(document.tree["accessors"]) - 1
    document.material(pbrMetallicRoughness={})
    part = document.one(tmp_path)
    assert area([part]) == pytest.approx(4.0)
    assert part.paint is not None
    np.testing.assert_allclose(part.paint.face_colours, [[128 / 255, 64 / 255, 32 / 255]] * 2)


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
        three = points[triangulated(points, Cutting())]
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
        (V[:-2] + "0 1 0 0\nf 1 2 3 4\n", "", "give all a colour, or none"),
    ],
)
def test_what_an_obj_cannot_say_is_refused(tmp_path: Path, text: str, materials: str, words: str) -> None:
    with pytest.raises(RoomError, match=words) as caught:
        obj(tmp_path, text, materials)
    assert "\n" not in str(caught.value)


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
