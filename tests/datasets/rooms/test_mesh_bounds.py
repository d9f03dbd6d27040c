"""Meshes of many parts, panels, masks or polygons take the time and memory of what they hold."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.gltf_documents import UV, Gltf
from PIL import Image

from phibench.datasets.common.input_files import InputFile
from phibench.datasets.rooms import mesh_polygons
from phibench.datasets.rooms.mesh_lights import lamps_of
from phibench.datasets.rooms.mesh_parts import Companions, MeshPart, Paint, opacities
from phibench.datasets.rooms.mesh_placement import MeshSettings, read_mesh


def peak(work: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_thousands_of_panels_take_little_memory() -> None:
    """Each kept a mark for every triangle: 2000 took 9 MB, 100 000 would take 20 GB. The largest become lamps."""
    count = 2000
    size = np.where(np.arange(count) == 1321, 0.02, 0.005)[:, None, None]
    place = np.stack([np.arange(count) % 100, np.arange(count) // 100, np.full(count, 300)], axis=1)[:, None] * 0.03
    points = (place + size * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])).reshape(-1, 3)
    triangles = (4 * np.arange(count)[:, None] + [0, 1, 2, 0, 2, 3]).reshape(-1, 3)
    part = MeshPart("panels", points, triangles, None, Paint((1.0, 1.0, 1.0)))
    settings = MeshSettings(Path("/a.glb"), 1.0, "z", (0.0, 0.0, 0.0))
    found = []
    assert peak(lambda: found.append(lamps_of(settings, [part]))) < 5e6
    [(lamps, [rest])] = found
    assert max(lamp.size_m[0] for lamp in lamps) == pytest.approx(0.02)
    assert len(lamps) == 12
    assert len(rest.triangles) == len(triangles) - 24


def test_opacities_of_many_triangles_take_little_memory() -> None:
    """Ten thousand took 70 MB at once, a million 7 GB."""
    uv = np.broadcast_to(UV[:3], (10_000, 3, 2))
    alpha = np.full((8, 8), 255, np.uint8)
    assert peak(lambda: opacities(10_000, 1.0, None, uv, alpha)) < 30e6


def test_a_picture_of_many_parts_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """500 parts with one picture of 9 million pixels took 14 s: it was read and hashed for each."""
    Image.fromarray(np.full((2, 2, 3), 9, np.uint8)).save(tmp_path / "a.png")
    (tmp_path / "a.mtl").write_text("newmtl a\nmap_Kd a.png\nmap_d a.png\n")
    faces = "".join(f"o {k}\nf 1/1 2/2 3/3\n" for k in range(20))
    text = "mtllib a.mtl\nvt 0 0\nvt 1 0\nvt 1 1\nv 0 0 0\nv 1 0 0\nv 1 1 0\nusemtl a\n"
    (tmp_path / "a.obj").write_text(text + faces)
    read, whole = [], InputFile.read
    monkeypatch.setattr(InputFile, "read", lambda file: read.append(file.path.suffix) or whole(file))
    assert len(read_mesh(tmp_path / "a.obj")) == 20
    assert sorted(read) == [".mtl", ".obj", ".png", ".png"]  # as a colour and as an opacity


def test_opacity_of_many_parts_is_decoded_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So is a picture that stands in many images."""
    document = Gltf()
    document.primitive["attributes"]["TEXCOORD_0"] = document.array(UV)
    texture = document.texture(np.full((2, 2, 4), 255, np.uint8))
    document.tree["images"] *= 5
    document.tree["textures"] = [{"source": k} for k in range(5)]
    base = {"pbrMetallicRoughness": {"baseColorTexture": {"index": texture}}, "alphaMode": "MASK"}
    document.tree["materials"] = [base | {"pbrMetallicRoughness": {"baseColorTexture": {"index": k}}} for k in range(5)]
    document.tree["meshes"][0]["primitives"] = [{**document.primitive, "material": k % 5} for k in range(20)]
    asked: list[str] = []
    for name in ("opacity", "pixels"):
        plain = getattr(Companions, name)
        monkeypatch.setattr(Companions, name, lambda *them, name=name, plain=plain: asked.append(name) or plain(*them))
    assert len(document.read(tmp_path)) == 20
    assert sorted(asked) == ["opacity", "pixels"]


def test_convex_polygons_of_four_corners_are_told_at_once() -> None:
    """The same as one by one, of quadrangles of all kinds: 200 000 of a file took 60 s."""
    rng = np.random.default_rng(6)
    points = rng.normal(size=(400, 3)) * [1, 1, 0.1]
    points[::7] = points[1::7][[*range(57), 0]]  # some corners twice
    polygons = [tuple(k) for k in rng.integers(0, 400, (300, 4))] + [(0, 1, 2), (0, 1, 2, 3, 4), (0, 1, 2, 400)]
    plain = mesh_polygons.plain_quads(points, polygons)
    assert not plain[300:].any()
    for polygon, is_plain in zip(polygons[:300], plain, strict=False):
        pieces = mesh_polygons.triangulated(points[list(polygon)], mesh_polygons.CuttingBudget())
        if is_plain:
            np.testing.assert_array_equal(pieces, mesh_polygons.QUAD)
    assert 20 < plain.sum() < 280
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    assert mesh_polygons.plain_quads(square, [(0, 1, 2, 3), (3, 2, 1, 0), (0, 2, 1, 3)]).tolist() == [True, True, False]
