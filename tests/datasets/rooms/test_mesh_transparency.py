"""What is wholly transparent in a mesh file is not there; what has holes is refused; half transparent is opaque."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.gltf_documents import SQUARE, UV, Gltf
from PIL import Image

from phibench.datasets.rooms.mesh_parts import MeshPart, opacities
from phibench.datasets.rooms.mesh_placement import read_mesh
from phibench.datasets.rooms.room_files import RoomError


def seen(folder: Path, mode: str | None, alpha: Any = 255, factor: float = 1.0, **row: Any) -> bool:
    """Tell whether a square with a material is among the parts, beside one that is always there."""
    document = Gltf()
    pixels = np.full((8, 8, 4), 200, np.uint8)
    pixels[..., 3] = alpha
    document.primitive["attributes"]["TEXCOORD_0"] = document.array(UV)
    base = {"baseColorFactor": [1, 1, 1, factor], "baseColorTexture": {"index": document.texture(pixels)}}
    document.material(name="glass", pbrMetallicRoughness=base, **({} if mode is None else {"alphaMode": mode}), **row)
    document.tree["meshes"].append({"primitives": [{"attributes": {"POSITION": document.array(SQUARE)}, "mode": 6}]})
    document.tree["nodes"] += [{"name": "wall", "mesh": 1}]
    document.tree["scenes"] = [{"nodes": [0, 1]}]
    names = [part.name for part in document.read(folder)]
    assert "wall" in names
    return "square/glass" in names


HOLE = np.full((8, 8), 255)
HOLE[2:5, 2:5] = 0


def test_opacity_counts_where_the_mode_says_so(tmp_path: Path) -> None:
    """Section 3.9.4 of glTF 2.0: OPAQUE ignores alpha, MASK compares it with the cutoff, 0.5 by default."""
    assert seen(tmp_path, None, 0)
    assert seen(tmp_path, "OPAQUE", 0)
    assert seen(tmp_path, "OPAQUE", HOLE)
    for mode in ("MASK", "BLEND"):
        assert seen(tmp_path, mode)
        assert not seen(tmp_path, mode, 0)
        assert not seen(tmp_path, mode, 255, factor=0.0)
        with pytest.raises(RoomError, match=r"holes in 'square/glass'"):
            seen(tmp_path, mode, HOLE)
    assert seen(tmp_path, "BLEND", 10, factor=0.3)
    assert seen(tmp_path, "MASK", 128)
    assert not seen(tmp_path, "MASK", 128, factor=0.9)  # 128/255 * 0.9 = 0.45
    assert seen(tmp_path, "MASK", 128, factor=0.9, alphaCutoff=0.4)
    with pytest.raises(RoomError, match="alphaMode"):
        seen(tmp_path, "GLASS")


def test_vertices_have_an_opacity_of_their_own(tmp_path: Path) -> None:
    for alpha, expected in (([0.0] * 4, None), ([0.4] * 4, None), ([0.6] * 4, 2), ([0.0, 1.0, 1.0, 1.0], "holes")):
        document = Gltf()
        colours = np.column_stack([np.full((4, 3), 0.5), alpha]).astype(np.float32)
        document.primitive["attributes"]["COLOR_0"] = document.array(colours)
        document.material(alphaMode="MASK")
        if expected == 2:
            assert len(document.one(tmp_path).triangles) == 2
            continue
        with pytest.raises(RoomError, match=expected or "has 0 triangles"):
            document.read(tmp_path)


def test_hidden_nodes_hide_their_children(tmp_path: Path) -> None:
    document = Gltf()
    hidden = {"mesh": 0, "children": [2], "extensions": {"KHR_node_visibility": {"visible": False}}}
    document.tree["nodes"] = [{"name": "shown", "mesh": 0}, hidden, {"mesh": 0}]
    document.tree["scenes"] = [{"nodes": [0, 1]}]
    document.tree["extensionsRequired"] = ["KHR_node_visibility"]
    assert [part.name for part in document.read(tmp_path)] == ["shown"]


def test_a_hole_of_a_sixteenth_is_found_anywhere() -> None:
    """Places are a sixteenth of a side apart, so that a hole of an eighth of a picture holds some."""
    uv = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], float)
    checked = 0
    for row in range(0, 57, 8):
        for column in range(0, 57, 8):
            alpha = np.full((64, 64), 255, np.uint8)
            alpha[row : row + 8, column : column + 8] = 0
            least, most = opacities(2, 1.0, None, uv, alpha).T
            assert least.min() == 0.0
            assert most.min() == 1.0
            checked += 1
    assert checked == 64


def of_obj(folder: Path, mask: Any) -> tuple[MeshPart, ...]:
    """Square of a material with a picture of its opacity."""
    Image.fromarray(np.asarray(mask, np.uint8)).save(folder / "mask.png")
    (folder / "a.mtl").write_text("newmtl leaf\nKd 0.2 0.5 0.1\nmap_d mask.png\n")
    corners = "".join(f"v {x:g} {y:g} {z:g}\n" for x, y, z in SQUARE)
    (folder / "a.obj").write_text(f"mtllib a.mtl\n{corners}usemtl leaf\nf 1 2 3 4\n")
    return read_mesh(folder / "a.obj")


def test_holes_of_an_obj_are_refused(tmp_path: Path) -> None:
    assert len(of_obj(tmp_path, np.full((4, 4), 128))) == 1
    with pytest.raises(RoomError, match=r"holes in the material 'leaf' \(map_d\)"):
        of_obj(tmp_path, HOLE)
