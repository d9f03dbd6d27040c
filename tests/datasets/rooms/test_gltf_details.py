"""Samplers, containers and rare parts of glTF: read by the definition, or refused by name."""

from __future__ import annotations

import io
import json
import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.gltf_documents import SQUARE, UV, Gltf
from helpers.mesh_files import area, corners
from PIL import Image

from phibench.datasets.rooms.mesh_parts import MeshPart
from phibench.datasets.rooms.mesh_placement import MeshLamp, MeshSettings, read_mesh
from phibench.datasets.rooms.mesh_room import mesh_room
from phibench.datasets.rooms.room_files import RoomError
from phibench.scenes.shapes import Bitmap

REPEAT, MIRRORED, CLAMPED = 10497, 33648, 33071
NEAREST, LINEAR = 9728, 9729
PIXELS = np.random.default_rng(8).integers(0, 256, (4, 6, 3), dtype=np.uint8)


def wrapped(index: np.ndarray, size: int, mode: int) -> np.ndarray:
    """Texel of a texel number that may lie beside the picture, by OpenGL ES 3.0, table 3.20."""
    if mode == CLAMPED:
        return np.clip(index, 0, size - 1)
    if mode == REPEAT:
        return index % size
    turned = index % (2 * size) - size
    return (size - 1) - np.where(turned >= 0, turned, -(1 + turned))


def by_definition(uv: np.ndarray, mode: int, filter_: int) -> np.ndarray:
    """Codes of places (N, 2) of the file, v downwards, as a sampler takes them."""
    place = uv * [6, 4]
    if filter_ == NEAREST:
        column, row = np.floor(place).astype(int).T
        return PIXELS[wrapped(row, 4, mode), wrapped(column, 6, mode)].astype(float)
    low = np.floor(place - 0.5)
    s, t = (place - 0.5 - low).T[..., None]
    (i, j), total = low.astype(int).T, np.zeros((len(uv), 3))
    for du, a in ((0, 1 - s), (1, s)):
        for dv, b in ((0, 1 - t), (1, t)):
            total += a * b * PIXELS[wrapped(j + dv, 4, mode), wrapped(i + du, 6, mode)]
    return total


def by_bitmap(part: MeshPart, weights: np.ndarray) -> np.ndarray:
    """Codes of a part's first triangle by the bitmap that it becomes: bilinear, repeated without end."""
    assert part.paint is not None
    assert part.paint.picture is not None
    assert part.paint.uv is not None
    pixels = part.paint.picture[::-1]
    values = np.concatenate([pixels, pixels[..., :1]], axis=-1).astype(np.float32) / 255.0
    bitmap = Bitmap(values, (1.0, 1.0))
    return 255.0 * bitmap.sample(weights @ (part.paint.uv[0] * pixels.shape[1::-1]))[:, :3]


def sampled(folder: Path, uv: Any, mode: int, filter_: int) -> MeshPart:
    document = Gltf()
    document.primitive["attributes"]["TEXCOORD_0"] = document.array(np.asarray(uv, np.float32))
    texture = document.texture(PIXELS, wrapS=mode, wrapT=mode, magFilter=filter_)
    document.material(pbrMetallicRoughness={"baseColorTexture": {"index": texture}})
    return document.one(folder)


@pytest.mark.parametrize("mode", [REPEAT, MIRRORED, CLAMPED])
def test_a_linear_picture_is_that_of_its_sampler_up_to_its_edges(tmp_path: Path, mode: int) -> None:
    """A clamped picture took half a texel of its other side; float32 of bitmap and places, 1e-3 of a code."""
    weights = np.random.default_rng(1).dirichlet((0.5, 0.5, 0.5), 300)
    for uv in (UV, 3.0 * UV - 1.0):
        if mode == CLAMPED and uv.max() > 1.0:
            continue  # refused
        part = sampled(tmp_path, uv, mode, LINEAR)
        expected = by_definition(weights @ uv[part.triangles[0]].astype(float), mode, LINEAR)
        np.testing.assert_allclose(by_bitmap(part, weights), expected, atol=1e-3)


@pytest.mark.parametrize("mode", [REPEAT, MIRRORED, CLAMPED])
@pytest.mark.parametrize("place", [(0.0, 0.0), (1.0, 1.0), (0.5, 0.25), (0.99, 0.01), (1.0 / 3.0 + 1e-4, 0.75)])
def test_a_triangle_of_one_place_has_the_nearest_texel(tmp_path: Path, mode: int, place: tuple[float, float]) -> None:
    """As colour palettes are used: the row at v = 0 was mixed with the last one."""
    part = sampled(tmp_path, np.tile(place, (4, 1)), mode, NEAREST)
    expected = by_definition(np.float32([place]).astype(float), mode, NEAREST)
    np.testing.assert_allclose(by_bitmap(part, np.array([[0.2, 0.3, 0.5]])), expected, atol=1e-3)


def test_a_face_of_one_nearest_texel_has_its_colour(tmp_path: Path) -> None:
    """Neighbours had 44 % of it; a sixteenth at each edge makes at most 7 % of the difference."""
    uv = (UV + [2, 1]) / [6, 4]
    part = sampled(tmp_path, uv, REPEAT, NEAREST)
    weights = np.random.default_rng(1).dirichlet((1, 1, 1), 4000)
    found = by_bitmap(part, weights).mean(axis=0)
    assert np.abs(found - PIXELS[1, 2]).max() < 0.07 * 255.0


def test_a_wrap_that_gltf_does_not_know_is_told(tmp_path: Path) -> None:
    with pytest.raises(RoomError, match="whose wrap 10496 glTF does not know"):
        sampled(tmp_path, UV, 10496, LINEAR)


def test_opacity_lies_where_the_sampler_puts_it(tmp_path: Path) -> None:
    """The right half is a hole: mirrored, it is the left half of the next picture. It was looked for without mirror."""
    pixels = np.full((4, 4, 4), 200, np.uint8)
    pixels[:, 2:, 3] = 0
    for start, seen in ((1.55, True), (1.05, False)):
        document = Gltf()
        document.primitive["attributes"]["TEXCOORD_0"] = document.array((UV * [0.4, 1] + [start, 0]).astype(np.float32))
        texture = document.texture(pixels, wrapS=MIRRORED, wrapT=MIRRORED)
        document.material(alphaMode="MASK", pbrMetallicRoughness={"baseColorTexture": {"index": texture}})
        if seen:
            assert area(document.read(tmp_path)) == pytest.approx(1.0)
        else:
            with pytest.raises(RoomError, match="0 triangles"):
                document.read(tmp_path)


def test_a_cutoff_of_zero_hides_nothing(tmp_path: Path) -> None:
    document = Gltf()
    document.material(alphaMode="MASK", alphaCutoff=0.0, pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 0]})
    assert len(document.one(tmp_path).triangles) == 2


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({"doubleSided": "false"}, "'doubleSided' is 'false', not true or false"),
        ({"alphaMode": "MASK", "alphaCutoff": "0.5"}, "'alphaCutoff' is '0.5', not a number"),
        ({"alphaMode": "MASK", "alphaCutoff": -1}, "'alphaCutoff' is -1, not a number from 0 up"),
        ({"extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": "4"}}}, "'emissiveStrength' is '4'"),
        ({"extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": True}}}, "'emissiveStrength' is True"),
        ({"emissiveFactor": [1, 1, 1], "emissiveTexture": {}}, "number None of its textures"),
        ({"pbrMetallicRoughness": {"baseColorTexture": {"index": "0"}}}, "number 0 of its textures"),
    ],
)
def test_text_is_no_number_and_a_table_without_a_picture_is_none(
    stated: dict[str, Any], said: str, tmp_path: Path
) -> None:
    document = Gltf()
    document.material(**stated)
    with pytest.raises(RoomError, match=said):
        document.one(tmp_path)


def png_16(grey: int, transparent: int | None) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = (b"\0" + struct.pack(">2H", grey, grey)) * 2
    told = b"" if transparent is None else chunk(b"tRNS", struct.pack(">H", transparent))
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 2, 2, 16, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + told + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


@pytest.mark.parametrize(("transparent", "seen"), [(None, True), (39_999, True), (40_000, False)])
def test_a_grey_of_16_bits_may_be_transparent(tmp_path: Path, transparent: int | None, seen: bool) -> None:
    document = Gltf()
    document.primitive["attributes"]["TEXCOORD_0"] = document.array(UV)
    document.tree["images"] = [{"bufferView": document.view(png_16(40_000, transparent)), "mimeType": "image/png"}]
    document.tree["textures"] = [{"source": 0}]
    document.material(alphaMode="MASK", pbrMetallicRoughness={"baseColorTexture": {"index": 0}})
    if seen:
        assert len(document.one(tmp_path).triangles) == 2
    else:
        with pytest.raises(RoomError, match="0 triangles"):
            document.read(tmp_path)


@pytest.mark.parametrize(
    ("bits", "photometric", "kind", "code"), [(16, 1, 1, 156), (16, 0, 1, None), (12, 1, 1, None), (16, 1, 2, None)]
)
def test_a_grey_tiff_of_more_bits_has_its_values(
    tmp_path: Path, bits: int, photometric: int, kind: int, code: int | None
) -> None:
    """White as 0 was black as 0, 12 bits were nearly black, signed ones half as bright."""
    data = bytes.fromhex("9c49c49c49c4") if bits == 12 else struct.pack("<4H", *[40_000 >> (kind - 1)] * 4)
    tags = [(256, 2), (257, 2), (258, bits), (259, 1), (262, photometric), (273, 134), (277, 1), (278, 2)]
    tags += [(279, len(data)), (339, kind)]
    rows = b"".join(struct.pack("<HHIHH", tag, 3, 1, value, 0) for tag, value in tags)
    text = b"II*\0" + struct.pack("<IH", 8, len(tags)) + rows + bytes(4) + data
    document = Gltf()
    document.primitive["attributes"]["TEXCOORD_0"] = document.array(UV)
    document.tree["images"], document.tree["textures"] = [{"bufferView": document.view(text)}], [{"source": 0}]
    document.material(pbrMetallicRoughness={"baseColorTexture": {"index": 0}})
    if code is None:
        with pytest.raises(RoomError, match="grey TIFF of another kind"):
            document.read(tmp_path)
        return
    part = document.one(tmp_path)
    assert part.paint is not None
    assert part.paint.picture is not None
    assert np.unique(part.paint.picture).tolist() == [code]


@pytest.mark.parametrize(("orientation", "words"), [(1, ""), (6, "EXIF orientation 6")])
def test_a_picture_that_some_readers_turn_is_told(tmp_path: Path, orientation: int, words: str) -> None:
    document, exif, stream = Gltf(), Image.Exif(), io.BytesIO()
    exif[0x0112] = orientation
    Image.new("RGB", (8, 8)).save(stream, "JPEG", exif=exif)
    document.primitive["attributes"]["TEXCOORD_0"] = document.array(UV)
    document.tree["images"] = [{"bufferView": document.view(stream.getvalue())}]
    document.tree["textures"] = [{"source": 0}]
    document.material(pbrMetallicRoughness={"baseColorTexture": {"index": 0}})
    if words:
        with pytest.raises(RoomError, match=words):
            document.read(tmp_path)
    else:
        assert document.one(tmp_path).paint is not None


def test_long_chains_of_nodes_are_trees(tmp_path: Path) -> None:
    document = Gltf()
    chain = [{"children": [k + 1], "translation": [0.01, 0, 0]} for k in range(300)]
    document.tree["nodes"] = [*chain, {"mesh": 0}]
    assert document.one(tmp_path).vertices[:, 0].max() == pytest.approx(4.0)


def _version(document: Gltf) -> None:
    document.tree["asset"] |= {"version": "2.1", "minVersion": "2.1"}


def _morph(document: Gltf) -> None:
    document.primitive["targets"] = [{"POSITION": document.array(SQUARE[:1])}]
    document.tree["meshes"][0]["weights"] = [1.0]


def _meshopt(document: Gltf) -> None:
    document.tree["bufferViews"][0]["extensions"] = {"KHR_meshopt_compression": {}}


@pytest.mark.parametrize(
    ("edit", "words"), [(_version, r"needs 2\.1: 2\.0"), (_morph, "does not move every vertex"), (_meshopt, "meshopt")]
)
def test_what_a_document_says_in_rare_places_counts(tmp_path: Path, edit: Callable[[Gltf], None], words: str) -> None:
    document = Gltf()
    edit(document)
    with pytest.raises(RoomError, match=words):
        document.read(tmp_path)


@pytest.mark.parametrize(
    ("version", "longer", "words"), [(2, 0, ""), (1, 0, "version 1: 2"), (3, 0, "version 3: 2"), (2, 4, "has .* of")]
)
def test_the_head_of_a_glb_counts(tmp_path: Path, version: int, longer: int, words: str) -> None:
    document = Gltf()
    tree = {key: value for key, value in document.tree.items() if value != []}
    text = json.dumps({**tree, "buffers": [{"byteLength": len(document.data)}]}).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    body += struct.pack("<I4s", len(document.data), b"BIN\0") + document.data
    head = struct.pack("<4sII", b"glTF", version, 12 + len(body) + longer)
    # what follows the stated length is no chunk
    (tmp_path / "a.glb").write_bytes(head + body + (b"" if longer else b"\1\1\1\1\1\1\1\1\1"))
    if not words:
        assert area(read_mesh(tmp_path / "a.glb")) == pytest.approx(1.0)
        return
    with pytest.raises(RoomError, match=words):
        read_mesh(tmp_path / "a.glb")


def test_many_parts_share_one_view_and_one_mirrored_picture(tmp_path: Path) -> None:
    """The view was copied for each array: 40 MB each time; the picture was mirrored for each part."""
    document = Gltf()
    document.primitive["attributes"]["TEXCOORD_0"] = document.array((2 * UV).astype(np.float32))
    stream = io.BytesIO()
    Image.new("RGB", (1024, 512)).save(stream, "PNG")
    document.tree["images"] = [{"bufferView": document.view(stream.getvalue())}]
    document.tree["samplers"], document.tree["textures"] = [{"wrapS": MIRRORED}], [{"source": 0, "sampler": 0}]
    document.material(pbrMetallicRoughness={"baseColorTexture": {"index": 0}})
    document.data += bytes(40_000_000)
    document.tree["bufferViews"] = [{"buffer": 0, "byteLength": len(document.data)}]
    for k, start in enumerate((0, 48)):
        document.tree["accessors"][k] |= {"bufferView": 0, "byteOffset": start}
    picture = len(document.data) - 40_000_000 - len(stream.getvalue())
    document.tree["bufferViews"].append({"buffer": 0, "byteOffset": picture, "byteLength": len(stream.getvalue())})
    document.tree["images"][0]["bufferView"] = 1
    document.tree["meshes"][0]["primitives"] *= 300
    (tmp_path / "a.bin").write_bytes(document.data)
    buffers = [{"byteLength": len(document.data), "uri": "a.bin"}]
    (tmp_path / "a.gltf").write_text(json.dumps({**document.tree, "buffers": buffers}))
    start_s = time.process_time()
    parts = read_mesh(tmp_path / "a.gltf")
    assert time.process_time() - start_s < 5.0
    assert len(parts) == 300
    assert len({id(part.paint.picture) for part in parts if part.paint is not None}) == 1


def test_lights_without_a_surface_are_told(tmp_path: Path) -> None:
    """They were left out; whoever states lamps has put them in their places."""
    document = Gltf()
    turned = [np.stack([p[:, 0], p[:, 2], -p[:, 1]], axis=1).astype(np.float32) for p in corners().values()]
    document.material(emissiveFactor=[1, 1, 1])
    meshes = [{"primitives": [{"attributes": {"POSITION": document.array(p)}, "mode": 6}]} for p in turned]
    meshes[1]["primitives"][0]["material"] = 0
    document.tree["meshes"], document.tree["nodes"] = meshes, [{"mesh": k} for k in range(6)]
    document.tree["nodes"] += [{"extensions": {"KHR_lights_punctual": {"light": 0}}, "translation": [0, 2, 0]}]
    document.tree["scenes"] = [{"nodes": list(range(7))}]
    assert len(document.read(tmp_path)) == 6
    settings = MeshSettings(tmp_path / "one.gltf", 1.0, "y", (0.0, 0.0, 0.0))
    with pytest.raises(RoomError, match=r"has 1 lights without a surface \(KHR_lights_punctual\)"):
        mesh_room(settings)
    lamp = MeshLamp((0.0, 0.0, 2.7), (0.0, 0.0, -1.0), (1.2, 0.6))
    assert mesh_room(MeshSettings(tmp_path / "one.gltf", 1.0, "y", (0.0, 0.0, 0.0), lamps=(lamp,))).lit
