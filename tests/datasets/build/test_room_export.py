"""Rooms as files: a panorama on the room's own box gives its views again, and a mesh has its faces and colours."""

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.processes import SMALLEST

from phibench.cli.main import main
from phibench.datasets.build.room_export import bounds_m, export_mesh, export_panorama, export_room
from phibench.datasets.recipe.load import load_recipe
from phibench.datasets.recipe.recipe_scene import build_rig
from phibench.datasets.recipe.room_tables import MeshTable, PanoramaTable
from phibench.datasets.rooms.mesh_room import mesh_room
from phibench.datasets.rooms.panorama_room import panorama_room
from phibench.render.optics.room_tracer import own_geometry
from phibench.render.room.ambient_layer import render_ambient
from phibench.render.room.light_map import BakeSettings, bake
from phibench.scenes.room import Room
from phibench.scenes.shapes import Bitmap, Checker, Uniform, rectangle

BOX = (-2.4, 2.6, -2.0, 2.2, 2.7)
POINT = (0.5, -0.4, 1.3)
COARSE = BakeSettings(texel_m=0.1, indirect_texel_m=0.2, lamp_rays=16, bounces=6, bounce_rays=32, final_rays=64)


def plain_room() -> Room:
    """Box with checkers, colours and a lamp close under the ceiling; no furniture, no robot."""
    x0, x1, y0, y1, h = BOX
    x, y, length, width = 0.5 * (x0 + x1), 0.5 * (y0 + y1), x1 - x0, y1 - y0
    grey, red = Uniform((0.6, 0.55, 0.5)), Uniform((0.7, 0.2, 0.2))
    cells = Checker((0.3, 0.4, 0.2), (0.7, 0.6, 0.6), (0.7, 0.7), (-3.0, -3.0))
    walls = (
        rectangle("floor", (x, y, 0.0), (0, 0, 1), (length, width), texture=cells),
        rectangle("ceiling", (x, y, h), (0, 0, -1), (length, width), texture=grey),
        rectangle("west", (x0, y, h / 2), (1, 0, 0), (width, h), texture=cells),
        rectangle("east", (x1, y, h / 2), (-1, 0, 0), (width, h), texture=grey),
        rectangle("south", (x, y0, h / 2), (0, 1, 0), (length, h), texture=red),
        rectangle("north", (x, y1, h / 2), (0, -1, 0), (length, h), texture=cells),
        rectangle("lamp", (0.9, 0.6, h - 1e-3), (0, 0, -1), (0.8, 0.6), radiance_w_m2_sr=(8.0, 7.0, 6.0)),
    )
    return Room("plain", walls, robot=False)


def table(text: str, name: str) -> dict[str, Any]:
    [found] = tomllib.loads(text)["rooms"][name]
    return dict(found)


def test_a_panorama_on_its_own_box_gives_the_views_of_the_room(tmp_path: Path) -> None:
    """Two offsets: a panorama with a wrong axis, mirrored or turned fails by tens of percent.

    Where a pixel lies within a texel of an edge, bilinear walls blur it: edges of checkers and lamp, a tenth of the
    pixels. Half of all agree to 0.01 %; 2e-3 leaves room for the noise of 0.1 % at equal random numbers.
    """
    room = plain_room()
    made = export_panorama(room, tmp_path / "plain.exr", POINT, 30.0, 256, COARSE)
    given = table(made.table, "panoramas")
    assert (given["point_m"], given["heading_deg"], given["box_m"]) == (list(POINT), 30.0, list(BOX))
    settings = PanoramaTable.model_validate(given).settings(0.3)
    again = replace(panorama_room(replace(settings, path=made.path)), robot=False)
    rig = build_rig(load_recipe(SMALLEST).rig)
    lights = [bake(rig.at(0.0), each, COARSE) for each in (room, again)]
    for offset_m in (0.0, 0.3):
        view = rig.at(offset_m)
        a, b = (
            render_ambient(view, each, light, COARSE, 2, 1, rounds=2).electrons_per_s
            for each, light in zip((room, again), lights, strict=True)
        )
        assert np.abs(b.mean(axis=(1, 2)) / a.mean(axis=(1, 2)) - 1.0).max() < 0.01
        seen = a.min(axis=0) > 0.0
        ratio = b[:, seen] / a[:, seen]
        low, high = np.quantile(ratio, [0.25, 0.75])
        assert 0.998 < low <= high < 1.002
        assert np.quantile(np.abs(ratio - 1.0), 0.9) < 0.02


def colours(room: Room, directions: np.ndarray) -> tuple[np.ndarray, ...]:
    """Distance, normal, value and whether it shines of what rays from a point of the room meet."""
    geometry = own_geometry(room)
    origins = np.broadcast_to(np.array([0.1, 0.05, 1.5]), directions.shape)
    hits = geometry.first_hit(origins, directions)
    faces, points = geometry.table, origins + hits.distance_m[:, None] * directions
    places, values = faces.places(hits.patch, points), np.zeros((len(points), 3))
    for number, texture in enumerate(faces.textures):
        mine = faces.texture[hits.patch] == number
        scale, start = (
            (np.array(texture.texel_m), np.array(texture.origin_m)) if isinstance(texture, Bitmap) else (1.0, 0.0)
        )
        if isinstance(texture, Checker):
            scale, start = np.array(texture.cell_m), np.array(texture.origin_m)
        values[mine] = texture.evaluate(places[mine] * scale + start)
    emits = faces.emits[hits.patch]
    values[emits] = faces.radiance_w_m2_sr[hits.patch[emits]]
    return hits.distance_m, faces.normal[hits.patch], values, emits | faces.is_radiance[hits.patch]


@pytest.mark.slow
def test_a_mesh_has_faces_colours_and_lamps_of_the_room(tmp_path: Path) -> None:
    """float32 corners in a room of 16 m round by 1e-6 m. sRGB of 8 bits is off by half a code: at most
    0.5 / 255 x 2.28 (the curve's slope at 1) = 0.0045, and 0.002 more by averaging to 5 mm; screens likewise.
    """
    room = export_room(None, 3, ["screens=2", "length_m=6"])
    made = export_mesh(room, tmp_path / "room.glb")
    again = export_mesh(export_room(None, 3, ["screens=2", "length_m=6"]), tmp_path / "again.glb")
    assert made.path.read_bytes() == again.path.read_bytes()
    settings = MeshTable.model_validate(table(made.table, "meshes")).settings(0.3)
    back = mesh_room(replace(settings, path=made.path, one_file=True))
    assert np.allclose(bounds_m(back), bounds_m(room), atol=2e-6)
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    a, b = (colours(each, directions) for each in (room, back))
    assert np.abs(a[0] - b[0]).max() < 1e-5
    assert np.abs(a[1] - b[1]).max() < 1e-4
    assert np.array_equal(a[3], b[3])
    most = np.where(a[3][:, None], np.maximum(a[2].max(), 1.0), 1.0)
    assert np.quantile(np.abs(a[2] - b[2]) / most, 0.99) < 0.0065
    assert np.abs(a[2] - b[2])[~a[3]].mean() < 0.002


def test_commands_write_files_and_the_tables_that_read_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "lab.glb"
    assert main(["room", "mesh", "--room", "lab", "--out", str(out)]) == 0
    assert table(capsys.readouterr().out, "meshes")["file"] == "lab.glb"  # the whole output: `>> recipe.toml`
    assert out.stat().st_size > 10_000


FAULTS: dict[str, tuple[list[str], str]] = {
    "no room": ([], "give --room for a room of the catalogue, or --seed for a generated one, one of them"),
    "two rooms": (["--room", "lab", "--seed", "3"], "give --room for a room of the catalogue, or --seed"),
    "no such room": (["--room", "lob"], "no room is called 'lob'; did you mean 'lab'?"),
    "no such property": (
        ["--seed", "3", "--set", "hight_m=3"],
        "RoomProperties has no 'hight_m'; did you mean 'height",
    ),
    "no such use": (["--seed", "3", "--set", "use=pub"], "RoomProperties.use = 'pub'"),
    "too high": (["--seed", "3", "--set", "height_m=30"], "RoomProperties.height_m = 30.0: allowed range is 2.3"),
    "no number": (["--seed", "3", "--set", "height_m=high"], "--set height_m=high: the value must be a number"),
    "no value": (["--seed", "3", "--set", "height_m"], "--set height_m: give a property and its value, such as"),
    "negative seed": (["--seed", "-1"], "--seed -1: must be a whole number from 0"),
    "properties of the lab": (["--room", "lab", "--set", "height_m=3"], "--set is for generated rooms; leave it out"),
}


@pytest.mark.parametrize(("options", "words"), FAULTS.values(), ids=FAULTS)
def test_a_room_that_is_none_is_one_sentence(
    options: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["room", "mesh", "--out", str(tmp_path / "a.glb"), *options]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert "Traceback" not in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "point", "words"),
    [
        ("a.png", (0.5, 0.0, 1.2), "a panorama is written as OpenEXR"),
        ("a.exr", (0.5, 0.0, -1.2), "outside the room"),
        ("a.exr", (0.5, float("nan"), 1.2), "must be a finite number"),
    ],
)
def test_a_panorama_that_cannot_be_is_one_sentence(
    name: str, point: tuple[float, ...], words: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=words):
        export_panorama(plain_room(), tmp_path / name, point, 0.0, 16, COARSE)
    assert not (tmp_path / name).exists()


def test_a_panorama_of_an_open_room_is_one_sentence(tmp_path: Path) -> None:
    room = plain_room()
    with pytest.raises(ValueError, match="the room is open in"):
        export_panorama(replace(room, surfaces=room.surfaces[1:]), tmp_path / "a.exr", POINT, 0.0, 16, COARSE)


def test_a_panorama_of_a_dark_room_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="the room shows no light from there"):
        export_panorama(plain_room().dark(), tmp_path / "a.exr", POINT, 0.0, 16, COARSE)
