"""Lamps of mesh rooms shine to the sides that their file says, and what a picture lights up in places shines there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.gltf_documents import UV, Gltf
from helpers.mesh_files import SIZE, area, corners

from phibench.datasets.rooms.mesh_parts import MeshPart
from phibench.datasets.rooms.mesh_placement import MeshSettings
from phibench.datasets.rooms.mesh_room import mesh_room
from phibench.scenes.room import Room
from phibench.scenes.shapes import Bitmap, Mesh

DOWN = corners((1.2, 0.6, 2.0))["ceiling"] + [2.0, 1.5, 0.0]  # 0.8 m below the ceiling, beside the mirror
HIGH = DOWN + [0.0, 0.0, 0.75]  # 0.05 m below it


def of_gltf(
    folder: Path, panel: np.ndarray, two_sided: bool, picture: np.ndarray | None = None, albedo: float = 0.5
) -> Room:
    """Box with a panel that shines; a picture lets its ceiling shine instead."""
    document = Gltf()
    glow: dict[str, Any] = {"name": "glow", "emissiveFactor": [1, 1, 1], "doubleSided": two_sided}
    glow["pbrMetallicRoughness"] = {"baseColorFactor": [albedo, albedo, albedo, 1.0]}
    if picture is not None:
        glow["emissiveTexture"] = {"index": document.texture(picture)}
    document.tree |= {"materials": [glow], "meshes": [], "nodes": []}
    sides = corners() if picture is not None else {**corners(), "panel": panel}
    for name, points in sides.items():
        turned = np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1).astype(np.float32)  # y is up
        primitive: dict[str, Any] = {"attributes": {"POSITION": document.array(turned)}, "mode": 6}
        if name == ("panel" if picture is None else "ceiling"):
            primitive["material"] = 0
            primitive["attributes"]["TEXCOORD_0"] = document.array(UV)
        document.tree["nodes"].append({"name": name, "mesh": len(document.tree["meshes"])})
        document.tree["meshes"].append({"primitives": [primitive]})
    document.tree["scenes"] = [{"nodes": list(range(len(sides)))}]
    document.read(folder)
    return mesh_room(MeshSettings(folder / "one.gltf", 1.0, "y", (0.0, 0.0, 0.0)))


def of_obj(folder: Path, panel: np.ndarray) -> Room:
    (folder / "a.mtl").write_text("newmtl wall\nKd 0.5 0.5 0.5\nnewmtl glow\nKe 1 1 1\n")
    lines = ["mtllib a.mtl"]
    for name, points in {**corners(), "panel": panel}.items():
        lines += [f"usemtl {'glow' if name == 'panel' else 'wall'}", *(f"v {x} {y} {z}" for x, y, z in points)]
        lines += ["f -4 -3 -2 -1"]
    (folder / "a.obj").write_text("\n".join(lines) + "\n")
    return mesh_room(MeshSettings(folder / "a.obj", 1.0, "z", (0.0, 0.0, 0.0)))


def heights(room: Room) -> list[tuple[float, float]]:
    """Upward part of each lamp's normal, and its height, metres."""
    found = [(lamp.T_world_shape.R[2, 2], lamp.T_world_shape.t[2]) for lamp in room.surfaces]
    return sorted((round(float(up), 6), round(float(height), 6)) for up, height in found)


@pytest.mark.parametrize(
    ("panel", "two_sided", "expected"),
    [
        (DOWN, False, [(-1.0, 2.0)]),
        (DOWN[::-1], False, [(1.0, 2.0)]),
        (DOWN, True, [(-1.0, 1.9995), (1.0, 2.0005)]),
        (DOWN[::-1], True, [(-1.0, 1.9995), (1.0, 2.0005)]),
        (HIGH, True, [(-1.0, 2.75)]),
        (HIGH[::-1], True, [(-1.0, 2.75)]),
        (HIGH[::-1], False, [(1.0, 2.75)]),
    ],
)
def test_a_double_sided_panel_shines_to_both_open_sides(
    tmp_path: Path, panel: np.ndarray, two_sided: bool, expected: list[tuple[float, float]]
) -> None:
    """It shone to its front alone: below a ceiling, wound upwards, it left the room dark."""
    assert heights(of_gltf(tmp_path, panel, two_sided)) == expected


@pytest.mark.parametrize(("panel", "up"), [(DOWN, -1.0), (DOWN[::-1], 1.0), (HIGH, -1.0), (HIGH[::-1], -1.0)])
def test_a_panel_of_an_obj_does_not_shine_into_a_ceiling(tmp_path: Path, panel: np.ndarray, up: float) -> None:
    assert [each[0] for each in heights(of_obj(tmp_path, panel))] == [up]


def as_part(mesh: Mesh) -> MeshPart:
    return MeshPart(mesh.name, mesh.vertices_m, mesh.triangles, None)


def test_a_small_lamp_in_a_large_picture_shines_where_it_is(tmp_path: Path) -> None:
    """At no corner, no middle of a side or a triangle, it was dark; the rest of the ceiling still reflects.

    Light by the picture's mean, as each texel's interpolation has its own area; 2 % is that of 20 000 places.
    """
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[10:16, 34:40] = 255
    room = of_gltf(tmp_path, DOWN, False, picture)
    parts = {shape.name: shape for shape in room.furniture if isinstance(shape, Mesh)}
    lit, dark = parts["ceiling/glow (light)"], parts["ceiling/glow"]
    assert isinstance(lit.texture, Bitmap)
    assert lit.corner_texels is not None
    whole = SIZE[0] * SIZE[1]
    assert area([as_part(lit), as_part(dark)]) == pytest.approx(whole, rel=1e-6)
    assert area([as_part(lit)]) < 2.0 * (6 / 64) ** 2 * whole
    a, b, c = np.moveaxis(lit.vertices_m[lit.triangles], 1, 0)
    each = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    rng = np.random.default_rng(2)
    chosen = rng.choice(len(each), 20_000, p=each / each.sum())
    places = np.einsum("nk,nkd->nd", rng.dirichlet((1, 1, 1), 20_000), lit.corner_texels[chosen])
    power = each.sum() * float(lit.texture.sample(places)[:, 0].mean())
    assert power == pytest.approx(3.6 * (6 / 64) ** 2 * whole, rel=0.02)


@pytest.mark.parametrize(("dark", "albedo", "triangles"), [(0, 0.5, 2), (2, 0.5, 2), (16, 0.5, None), (16, 0.0, 2)])
def test_a_triangle_is_cut_if_a_tenth_of_it_is_dark_and_reflects(
    tmp_path: Path, dark: int, albedo: float, triangles: int | None
) -> None:
    """A picture with a few dark texels, or of a black screen, shines as a whole: it would fall into many pieces."""
    picture = np.full((64, 64, 3), 255, np.uint8)
    picture[:, :dark] = 0
    meshes = [shape for shape in of_gltf(tmp_path, DOWN, False, picture, albedo).furniture if "glow" in shape.name]
    counts = [len(mesh.triangles) for mesh in meshes if isinstance(mesh, Mesh)]
    assert counts == [triangles] if triangles else len(counts) == 2
