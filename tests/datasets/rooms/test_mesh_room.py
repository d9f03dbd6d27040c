"""Rooms of mesh files: place, colours, textures, lamps and sides are the file's; impossible ones are one sentence."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from helpers.mesh_files import (
    FLOOR_PICTURE,
    SIZE,
    corners,
    edited_glb,
    scene,
    write_glb,
    write_obj,
    write_ply,
    y_up,
)
from PIL import Image

from phibench.datasets.rooms import mesh_room as mesh_room_module
from phibench.datasets.rooms.mesh_placement import MeshLamp, MeshSettings, meets_box, read_mesh
from phibench.datasets.rooms.mesh_room import mesh_room
from phibench.render.optics.faces import FaceTable, face_table
from phibench.scenes.room import Room
from phibench.scenes.shapes import Bitmap, Mesh, Uniform
from phibench.scenes.validation import SceneError

LAMP = MeshLamp((0.0, 0.0, 2.7), (0.0, 0.0, -1.0), (1.2, 0.6))


@pytest.fixture(scope="module")
def glb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_glb(tmp_path_factory.mktemp("mesh") / "room.glb", y_up(scene()))


def of_glb(path: Path, **options: Any) -> Room:
    return mesh_room(MeshSettings(path, 1.0, "y", (0.0, 0.0, 0.0), **options))


def part(room: Room, name: str) -> Mesh:
    (found,) = [shape for shape in room.furniture if shape.name == name]
    assert isinstance(found, Mesh)
    return found


def linear(code: Any) -> np.ndarray:
    """IEC 61966-2-1, written out again."""
    x = np.asarray(code, float) / 255.0
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def laser_albedo_at(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Of points on a mesh whose triangles all lie in a horizontal plane, by the nearest triangle that holds them."""
    table = face_table([mesh])
    return table.laser_albedo(triangle_below(table, points), points)


def triangle_below(table: FaceTable, points: np.ndarray) -> np.ndarray:
    a, b, c = (table.corners_m[None, :, k, :2] - points[:, None, :2] for k in range(3))
    turns = np.stack([p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0] for p, q in ((a, b), (b, c), (c, a))])
    inside = (turns >= -1e-12).all(axis=0) | (turns <= 1e-12).all(axis=0)
    assert inside.any(axis=1).all()
    return np.argmax(inside, axis=1)


def floor_pixels() -> tuple[np.ndarray, np.ndarray]:
    """Centres of the floor picture's pixels, shape (N, 3), world, and their linear red: its bottom row lies at -y."""
    rows, columns = FLOOR_PICTURE.shape[:2]
    row, column = np.mgrid[:rows, :columns]
    x = (column + 0.5) / columns * SIZE[0] - SIZE[0] / 2.0
    y = (rows - row - 0.5) / rows * SIZE[1] - SIZE[1] / 2.0
    points = np.stack([x, y, np.zeros(x.shape)], axis=-1).reshape(-1, 3)
    return points, np.clip(linear(FLOOR_PICTURE[..., 0]), 0.0, 0.9).ravel()


def test_parts_stand_where_the_file_has_them_with_their_colours(glb):
    room = of_glb(glb)
    names = {shape.name for shape in room.furniture}
    assert names == {"floor/tiles", "table/wood", *(f"{name}/paint" for name in corners() if name != "floor")}
    points = np.concatenate([shape.vertices_m for shape in room.furniture])
    # float32 of the file: 3 m to 2e-7
    np.testing.assert_allclose(points.min(axis=0), [-3.0, -2.5, 0.0], atol=1e-6)
    np.testing.assert_allclose(points.max(axis=0), [3.0, 2.5, 2.8], atol=1e-6)
    np.testing.assert_allclose(part(room, "table/wood").vertices_m.mean(axis=0), [2.0, 1.0, 0.36], atol=1e-6)
    # factors are linear; this file's have 8 bits, which is what wrote it
    assert part(room, "wall_east/paint").texture.albedo == pytest.approx((0.6, 0.4, 0.2), abs=0.5 / 255.0)
    assert room.lit


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_every_pixel_of_a_texture_lies_where_the_file_has_it(glb, tmp_path, kind):
    """At the centres of the texels, where bilinear interpolation gives the texel; 2e-5 is float32 of the place."""
    if kind == "glb":
        floor = part(of_glb(glb), "floor/tiles")
    else:
        settings = MeshSettings(write_obj(tmp_path), 1.0, "z", (0.0, 0.0, 0.0), lamps=(LAMP,))
        floor = part(mesh_room(settings), "floor_tiles")
    points, expected = floor_pixels()
    np.testing.assert_allclose(laser_albedo_at(floor, points), expected, atol=2e-5)


def test_texture_is_reduced_by_areas_in_linear_light(glb):
    """Pixels of 100 mm to texels of 200 mm: means of 2 x 2, rows from the bottom; 1e-6 is float32."""
    bitmap = part(of_glb(glb, texel_m=0.2, largest_albedo=1.0), "floor/tiles").texture
    expected = linear(FLOOR_PICTURE[::-1]).reshape(25, 2, 30, 2, 3).mean(axis=(1, 3))
    assert bitmap.values.shape == (25, 30, 4)
    np.testing.assert_allclose(bitmap.values[..., :3], expected, atol=1e-6)
    np.testing.assert_array_equal(bitmap.values[..., 3], bitmap.values[..., 0])


def test_bitmaps_of_a_room_hold_at_most_so_many_values(glb, monkeypatch):
    monkeypatch.setattr(mesh_room_module, "MOST_VALUES", 4 * 700)
    assert part(of_glb(glb), "floor/tiles").texture.values.size in range(4 * 500, 4 * 700 + 1)


def test_units_axes_and_heading_move_the_same_room(glb, tmp_path):
    """A file in centimetres with z up, whose robot stands at (1, -1, 0) m and looks along the file's y."""
    path = write_glb(tmp_path / "cm.glb", scene(scale=100.0))
    turned = mesh_room(MeshSettings(path, 0.01, "z", (100.0, -100.0, 3.0), heading_deg=90.0))
    here, there = part(of_glb(glb), "table/wood").vertices_m, part(turned, "table/wood").vertices_m
    # world x is the file's y, world y its -x; the stated point lies 30 mm above the floor, which comes to 0
    expected = np.stack([here[:, 1] + 1.0, 1.0 - here[:, 0], here[:, 2]], axis=-1)
    np.testing.assert_allclose(there[np.lexsort(there.T)], expected[np.lexsort(expected.T)], atol=2e-5)
    assert part(turned, "floor/tiles").vertices_m[:, 2] == pytest.approx(0.0, abs=1e-12)


def test_ply_has_the_mean_of_the_linear_colours_of_a_triangles_corners(tmp_path):
    path = write_ply(tmp_path / "room.ply")
    room = mesh_room(MeshSettings(path, 1.0, "z", (0.0, 0.0, 0.0), lamps=(LAMP,), largest_albedo=1.0))
    raw = trimesh.load_mesh(path, process=False)
    expected = linear(raw.visual.vertex_colors[raw.faces][..., 0]).mean(axis=1)
    table = face_table([part(room, "room")])
    found = table.laser_albedo(np.arange(12), table.corners_m[np.arange(12)].mean(axis=1))
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert len(set(np.round(expected, 3))) > 6  # colours differ, so a wrong order would show


def test_parts_without_a_colour_have_the_plain_one(tmp_path):
    path = write_ply(tmp_path / "grey.ply", colours=False)
    room = mesh_room(MeshSettings(path, 1.0, "z", (0.0, 0.0, 0.0), lamps=(LAMP,), plain_albedo=(0.3, 0.2, 0.1)))
    assert part(room, "grey").texture == Uniform((0.3, 0.2, 0.1))


# Light.


def test_an_evenly_shining_rectangle_is_a_lamp(glb):
    room = of_glb(glb, lamps=(LAMP,), emission_w_m2_sr=2.0)
    stated, found = room.surfaces
    assert stated.name == "lamp_1"
    assert found.radiance_w_m2_sr == pytest.approx((2.0, 1.8, 1.4))
    assert sorted(found.size_m) == pytest.approx([0.6, 1.2], abs=1e-6)
    np.testing.assert_allclose(found.T_world_shape.t, [0.0, 0.0, 2.75], atol=1e-6)
    np.testing.assert_allclose(found.T_world_shape.R[:, 2], [0.0, 0.0, -1.0], atol=1e-6)


def test_only_so_many_rectangles_are_lamps_and_the_rest_shines_as_it_is(glb):
    room = of_glb(glb, lamps=(LAMP,) * 12)
    assert len(room.surfaces) == 12
    panel = part(room, "panel/glow")
    assert isinstance(panel.texture, Bitmap)
    assert panel.texture.is_radiance
    np.testing.assert_allclose(panel.texture.values[0, 0], [3.6, 3.24, 2.52, 0.0], rtol=1e-6)


def test_strength_of_an_emission_counts(glb, tmp_path):
    def brighter(document: dict[str, Any]) -> None:
        (glow,) = [m for m in document["materials"] if m["name"] == "glow"]
        glow["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": 5.0}}

    path = edited_glb(glb, tmp_path / "strong.glb", brighter)
    assert of_glb(path).surfaces[0].radiance_w_m2_sr == pytest.approx((18.0, 16.2, 12.6))


def test_of_an_emission_texture_the_lit_triangles_shine(tmp_path):
    """Two panels share a material; the texture is lit on its left half, where one of them lies."""
    room = scene(lamp=False)
    glow = np.zeros((8, 16, 3), np.uint8)
    glow[:, :8] = (255, 188, 0)
    material = trimesh.visual.material.PBRMaterial(
        name="sign", emissiveTexture=Image.fromarray(glow), emissiveFactor=[1.0, 1.0, 1.0], baseColorFactor=[0.5] * 4
    )
    quad, place = corners((1.0, 1.0, 2.7))["ceiling"], np.array([[0, 0], [0, 1], [1, 1], [1, 0]])
    uv = np.concatenate([0.05 + 0.3 * place, 0.65 + 0.3 * place])
    faces = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    room.add_geometry(
        trimesh.Trimesh([*quad, *(quad + [1.5, 0, 0])], faces, visual=visual, process=False), node_name="sign"
    )
    found = of_glb(write_glb(tmp_path / "sign.glb", y_up(room)), emission_w_m2_sr=2.0)
    lit, dark = part(found, "sign/sign (light)"), part(found, "sign/sign")
    assert len(lit.triangles) == len(dark.triangles) == 2
    assert lit.vertices_m[:, 0].max() < 1.0 < dark.vertices_m[:, 0].max() + 0.1
    assert isinstance(dark.texture, Uniform)
    assert lit.texture.is_radiance
    np.testing.assert_allclose(lit.texture.values[4, 3], [2.0, 2.0 * linear(188), 0.0, 0.0], atol=1e-5)


# Sides.


def test_closed_parts_are_one_sided_and_open_ones_are_not(glb, tmp_path):
    room = of_glb(glb)
    assert not part(room, "table/wood").two_sided
    assert part(room, "floor/tiles").two_sided

    def swapped(document: dict[str, Any]) -> None:
        for material in document["materials"]:
            material["doubleSided"] = True

    assert part(of_glb(edited_glb(glb, tmp_path / "both.glb", swapped)), "table/wood").two_sided


@pytest.mark.parametrize(("inwards", "two_sided"), [(False, True), (True, False)])
def test_a_closed_shell_around_the_robot_shows_its_inside(tmp_path, inwards, two_sided):
    """One whose normals look outwards would be black from inside."""
    shell = trimesh.creation.box(SIZE)
    shell.apply_translation((0.0, 0.0, SIZE[2] / 2.0))
    faces = shell.faces[:, ::-1] if inwards else shell.faces
    mesh = trimesh.Trimesh(shell.vertices, faces, process=False)
    (tmp_path / "shell.ply").write_bytes(mesh.export(file_type="ply"))
    room = mesh_room(MeshSettings(tmp_path / "shell.ply", 1.0, "z", (0.0, 0.0, 0.0), lamps=(LAMP,)))
    assert part(room, "shell").two_sided is two_sided


def test_mirrored_nodes_keep_their_outside(glb, tmp_path):
    def mirrored(document: dict[str, Any]) -> None:
        for node in document["nodes"]:
            if node.get("name") == "table":
                node["scale"] = [-1.0, 1.0, 1.0]

    table = part(of_glb(edited_glb(glb, tmp_path / "mirrored.glb", mirrored)), "table/wood")
    a, b, c = np.moveaxis(table.vertices_m[table.triangles], 1, 0)
    assert np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0 == pytest.approx(1.0 * 0.6 * 0.7, rel=1e-5)
    assert not table.two_sided


def test_the_same_file_gives_the_same_room(glb, tmp_path):
    """Of a mesh with two primitives too, whose nodes get random names from the reader."""

    def joined(document: dict[str, Any]) -> None:
        document["meshes"][0]["primitives"] += document["meshes"][1]["primitives"]

    path = edited_glb(glb, tmp_path / "two.glb", joined)
    one, two = of_glb(path), of_glb(path)
    assert one.digest == two.digest
    assert len({shape.name for shape in one.furniture}) == len(one.furniture) == 8


# What no room can be made of.


def no_triangles(document: dict[str, Any]) -> None:
    document["meshes"] = []
    document["nodes"] = [{"name": "nothing"}]
    document["scenes"] = [{"nodes": [0]}]


def lost_picture(document: dict[str, Any]) -> None:
    document["images"] = [{"uri": "gone.png"}]


def stolen_picture(document: dict[str, Any]) -> None:
    document["images"] = [{"uri": "../../secret.png"}]


def wrong_picture(document: dict[str, Any]) -> None:
    document["images"] = [{"bufferView": 0, "mimeType": "image/png"}]


def compressed(document: dict[str, Any]) -> None:
    document["extensionsRequired"] = ["KHR_draco_mesh_compression"]


def huge(document: dict[str, Any]) -> None:
    document["accessors"][0]["count"] = 10**12


@pytest.mark.parametrize(
    ("edit", "word"),
    [
        (no_triangles, "has 0 triangles"),
        (lost_picture, "gone.png', which is missing"),
        (stolen_picture, "not in its folder"),
        (wrong_picture, "texture is missing or damaged"),
        (compressed, "KHR_draco_mesh_compression, which is not read"),
        (huge, "entries: at most"),
    ],
)
def test_faulty_files_end_in_one_sentence(glb, tmp_path, edit: Callable, word: str):
    with pytest.raises(SceneError, match=word) as caught:
        of_glb(edited_glb(glb, tmp_path / "faulty.glb", edit))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kept", [0, 7, 19, 400, 5000, -5])
def test_cut_files_end_in_one_sentence(glb, tmp_path, kept):
    (tmp_path / "cut.glb").write_bytes(glb.read_bytes()[:kept])
    with pytest.raises(SceneError, match=r"cut\.glb") as caught:
        of_glb(tmp_path / "cut.glb")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("head", ["", "format\n", "format ascii 1.0\nelement\nend_header\n"])
def test_a_broken_ply_names_no_slip_of_the_reader(tmp_path, head):
    path = tmp_path / "room.ply"
    path.write_text(f"ply\n{head}")
    with pytest.raises(SceneError, match=r"room\.ply is damaged: it ends early, or its numbers do not go together"):
        read_mesh(path)


def test_missing_companions_of_an_obj_are_named(tmp_path):
    settings = MeshSettings(write_obj(tmp_path, picture=False), 1.0, "z", (0.0, 0.0, 0.0), lamps=(LAMP,))
    with pytest.raises(SceneError, match=r"floor\.png', which is missing"):
        mesh_room(settings)
    (tmp_path / "floor.png").write_bytes(b"no picture")
    with pytest.raises(SceneError, match="not a picture"):
        mesh_room(settings)
    (tmp_path / "room.mtl").unlink()
    with pytest.raises(SceneError, match=r"room\.mtl', which is missing"):
        mesh_room(settings)


@pytest.mark.parametrize("kind", ["glb", "ply", "obj"])
def test_vertices_that_are_no_numbers_are_refused(tmp_path, kind):
    quads = np.concatenate(list(corners().values()))
    quads[7, 1] = np.nan
    faces = [[4 * k, 4 * k + i, 4 * k + i + 1] for k in range(6) for i in (1, 2)]
    mesh = trimesh.Trimesh(quads, faces, process=False)
    data = mesh.export(file_type=kind)
    (tmp_path / f"nan.{kind}").write_bytes(data if isinstance(data, bytes) else data.encode())
    with pytest.raises(SceneError, match=rf"nan\.{kind}"):
        mesh_room(MeshSettings(tmp_path / f"nan.{kind}", 1.0, "z", (0.0, 0.0, 0.0), lamps=(LAMP,)))


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"metres_per_unit": None}, "metres_per_unit is not stated"),
        ({"up_axis": None}, "up_axis"),
        ({"up_axis": "x"}, "'y' or 'z'"),
        ({"floor_point": None}, "floor_point is not stated"),
        ({"floor_point": (0.0, float("nan"), 0.0)}, "finite"),
        ({"texel_m": 0.0}, "texel_m"),
        ({"largest_albedo": 1.5}, "largest_albedo"),
        ({"lamps": (LAMP,) * 13}, "lamps"),
    ],
)
def test_settings_that_say_too_little_or_too_much(glb, options, word):
    stated = {"metres_per_unit": 1.0, "up_axis": "y", "floor_point": (0.0, 0.0, 0.0), **options}
    with pytest.raises(SceneError, match=word):
        MeshSettings(glb, **stated)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"metres_per_unit": 0.01}, "a room measures 2 to 100 m"),
        ({"metres_per_unit": 100.0}, r"metres_per_unit = 1 \(metres\)"),
        ({"floor_point": (0.0, 0.5, 0.0)}, "no floor within 0.1 m"),
        ({"floor_point": (40.0, 0.0, 0.0)}, "no surface lies above or below it"),
        ({"floor_point": (1.5, 0.0, -1.0)}, "stands where the robot is"),
        ({"floor_point": (2.75, 0.0, 2.0)}, "stands where the robot is"),
        ({"stroke_m": 2.1}, "in the way of the mirror, which rises to 2.90 m"),
    ],
)
def test_implausible_places_are_one_sentence(glb, change, word):
    settings = MeshSettings(glb, 1.0, "y", (0.0, 0.0, 0.0))
    assert mesh_room(settings).lit
    with pytest.raises(SceneError, match=word) as caught:
        mesh_room(replace(settings, **change))
    assert "\n" not in str(caught.value)


def test_a_room_lower_than_the_stroke_is_refused(tmp_path):
    path = write_glb(tmp_path / "low.glb", y_up(scene((6.0, 5.0, 2.1))))
    with pytest.raises(SceneError, match=r"ceiling.*in the way of the mirror"):
        of_glb(path)
    assert of_glb(path, stroke_m=1.2).lit


def test_a_mesh_without_light_is_refused(tmp_path):
    path = write_glb(tmp_path / "dark.glb", y_up(scene(lamp=False)))
    with pytest.raises(SceneError, match="no lamps are stated"):
        of_glb(path)
    assert of_glb(path, lamps=(LAMP,)).lit


@pytest.mark.parametrize("name", ["nothing.glb", "nothing.stl", "."])
def test_what_is_no_mesh_file(tmp_path, name):
    with pytest.raises(SceneError):
        of_glb(tmp_path / name)


def test_triangles_in_a_box_are_found():
    """Against a brute search: points of a fine net on each triangle."""
    rng = np.random.default_rng(5)
    triangles = rng.uniform(-1.0, 1.0, (400, 1, 3)) + rng.uniform(-0.8, 0.8, (400, 3, 3))
    low, high = np.array([-0.5, -0.3, -0.2]), np.array([0.4, 0.3, 0.6])
    s, t = np.meshgrid(np.linspace(0, 1, 60), np.linspace(0, 1, 60))
    net = np.stack([s, t * (1 - s), (1 - t) * (1 - s)], axis=-1).reshape(-1, 3)
    points = np.einsum("pk,nki->npi", net, triangles)
    inside = np.all((points > low) & (points < high), axis=2).any(axis=1)
    found = meets_box(triangles, low, high)
    assert not np.any(inside & ~found)
    # a corner that just enters may fall between the points of the net
    assert np.count_nonzero(found & ~inside) <= 4
    assert 50 < inside.sum() < 350


def test_a_room_does_not_depend_on_where_its_file_lies(glb, tmp_path):
    room = of_glb(Path(shutil.copy(glb, tmp_path / "copy.glb")))
    (tmp_path / "copy.glb").unlink()
    assert of_glb(glb).digest == room.digest
