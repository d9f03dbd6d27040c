"""glTF files are read by the definition, or refused by name; `trimesh` is asked where it is right."""

from __future__ import annotations

import json
import urllib.parse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.gltf_documents import SQUARE, UV, Gltf
from helpers.mesh_files import area, normals, scene, write_glb, y_up

from phibench.datasets.rooms.mesh_placement import read_mesh
from phibench.datasets.rooms.room_files import RoomError

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


def test_factors_end_at_one(tmp_path: Path) -> None:
    """Up to the rounding of 32 bits, in the last row of a matrix, too: more was clipped without a word."""
    document = Gltf()
    document.material(name="wall", pbrMetallicRoughness={"baseColorFactor": [1.0000001, 0.5, 0.5, 1.0]})
    document.tree["nodes"][0]["matrix"] = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1.0000001]
    part = document.one(tmp_path)
    assert part.paint is not None
    assert part.paint.colour == (1.0, 0.5, 0.5)
    document.tree["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"][0] = 1.8
    with pytest.raises(RoomError, match=r"'wall' with a baseColorFactor up to 1\.8: it ends at 1"):
        document.read(tmp_path)


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


def _meshopt_required(document: Gltf) -> None:
    document.tree["extensionsRequired"] = ["KHR_meshopt_compression"]


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
        (_meshopt_required, "KHR_meshopt_compression, which is not read: `gltf-transform cp"),
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


def test_a_byte_order_mark_is_no_part_of_the_document(tmp_path: Path) -> None:
    """Of editors of Windows; glTF forbids it to writers, and readers pass over it."""
    Gltf().read(tmp_path)
    (tmp_path / "two.gltf").write_bytes(b"\xef\xbb\xbf" + (tmp_path / "one.gltf").read_bytes())
    assert len(read_mesh(tmp_path / "two.gltf")) == 1
