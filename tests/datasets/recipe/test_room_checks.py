"""Faults of rooms in recipes: each mistake is exactly one sentence, with its place."""

from pathlib import Path
from typing import Any

import pytest
from helpers.room_files import BOX, MESH, PANORAMA, recipe, write_files

from phibench.datasets.common.errors import RecipeError
from phibench.datasets.recipe.load import check_recipe, load_recipe
from phibench.datasets.rooms import room_files
from phibench.datasets.rooms.room_files import RoomFiles


def without(table: dict[str, Any], *keys: str) -> dict[str, Any]:
    return {key: value for key, value in table.items() if key not in keys}


def panorama(*absent: str, **values: Any) -> dict[str, Any]:
    return {"panoramas": [{**without(PANORAMA, *absent), **values}]}


def mesh(*absent: str, **values: Any) -> dict[str, Any]:
    return {"meshes": [{**without(MESH, *absent), **values}]}


LOW = (*BOX[:4], 2.05)
GEOMETRY = without(MESH, "lamps")
LAMP = MESH["lamps"][0]
THERE = "put a file of at most 64 MiB there, or give the name of another one"
FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "no rooms at all": ({"count": 0, "panoramas": [], "meshes": []}, "rooms.count: 0, and there are no panoramas"),
    "properties of no room": ({"count": 0, "properties": {"lamps": 2}}, "rooms.properties: given, but no room is"),
    "a file elsewhere": (panorama(file="../office.png"), "rooms.panoramas[0].file: '../office.png' is no file beside"),
    "a file of the system": (panorama(file="/etc/passwd"), "rooms.panoramas[0].file: '/etc/passwd' is no file beside"),
    "no file": (panorama("file"), "rooms.panoramas[0].file: missing; add a string (file in the recipe"),
    "no camera": (panorama("point_m"), "rooms.panoramas[0].point_m: missing; add a list of 3"),
    "camera outside": (
        panorama(point_m=[0.0, 1.98, 1.4]),
        "rooms.panoramas[0].point_m: (0.0, 1.98, 1.4): the camera",
    ),
    "no geometry": (panorama("box_m"), "rooms.panoramas[0]: state the geometry by box_m or by mesh, one of them"),
    "two geometries": (panorama(mesh=GEOMETRY), "rooms.panoramas[0]: state the geometry by box_m or by mesh"),
    "robot outside": (
        panorama(box_m=[0.1, 4.0, -2.0, 2.0, 2.6]),
        "rooms.panoramas[0].box_m: (0.1, 4.0, -2.0, 2.0, 2.6): the robot, x -0.45 to 0.45 m",
    ),
    "a box too small": (panorama(box_m=[-0.9, 0.9, -2.0, 2.0, 2.6]), "rooms.panoramas[0].box_m: (-0.9, 0.9, -2.0, 2"),
    "a low box": (panorama(box_m=LOW, stroke_m=1.3), "rooms.panoramas[0].box_m: (-2.5, 2.5, -2.0, 2.0, 2.05): the c"),
    "an unknown key": (panorama(scale=2.0), "rooms.panoramas[0].scale: unknown key; "),
    "a mesh without scale": (
        mesh("metres_per_unit"),
        "rooms.meshes[0].metres_per_unit: missing; add a number from",
    ),
    "a mesh without up axis": (mesh("up_axis"), "rooms.meshes[0].up_axis: missing; add one of 'y', 'z' (axis of the"),
    "a mesh without floor": (mesh("floor_point"), "rooms.meshes[0].floor_point: missing; add a list of 3"),
    "a mesh of many files": (mesh(file="hall.obj"), "rooms.meshes[0].file: 'hall.obj' is no mesh of one file"),
    "a lamp that faces nowhere": (mesh(lamps=[{**LAMP, "normal": [0, 0, 0]}]), "rooms.meshes[0].lamps[0].normal: ("),
    "a lamp that is dark": (
        mesh(lamps=[LAMP, {**LAMP, "radiance_w_m2_sr": [0, 0, 0]}]),
        "rooms.meshes[0].lamps[1].radiance_w_m2_sr: (0.0, 0.0, 0.0): a lamp shines; give",
    ),
    "a box of another order": (
        panorama(box_m=[2.5, -2.5, -2.0, 2.0, 2.6]),
        "rooms.panoramas[0].box_m: (2.5, -2.5, -2.0, 2.0, 2.6): x_low = 2.5 is not below x_high = -2.5; give x_low",
    ),
    "a mesh as a picture": (panorama(file="hall.glb"), "rooms.panoramas[0].file: 'hall.glb' is a mesh and no picture"),
    "a short SHA-256": (mesh(sha256="ab"), "rooms.meshes[0].sha256: 'ab' is not allowed; give a string of 64 digits"),
    "albedo above the largest": (
        mesh(plain_albedo=[0.5] * 3, largest_albedo=0.3),
        "rooms.meshes[0].plain_albedo: (0.5, 0.5, 0.5): allowed range is 0 to largest_albedo, 0.3; give",
    ),
    "geometry turned too far": (
        panorama("box_m", mesh={**GEOMETRY, "heading_deg": 400.0}),
        "rooms.panoramas[0].mesh.heading_deg: 400.0 is not allowed; give a number from -360 up to 360",
    ),
    "a lamp without a size": (mesh(lamps=[without(LAMP, "size_m")]), "rooms.meshes[0].lamps[0].size_m: missing; add"),
    "geometry with lamps": (panorama("box_m", mesh=MESH), "rooms.panoramas[0].mesh.lamps: unknown key; "),
}


def complaints(raw: dict[str, Any], files: RoomFiles | None = None) -> list[str]:
    with pytest.raises(RecipeError) as caught:
        check_recipe(raw, files=files)
    return [line.strip() for line in str(caught.value).splitlines()[1:]]


@pytest.mark.parametrize(("rooms", "words"), FAULTS.values(), ids=FAULTS)
def test_each_mistake_is_one_sentence(rooms: dict[str, Any], words: str) -> None:
    [line] = complaints(recipe(**rooms))
    assert line.startswith(words)
    assert line.isprintable()


def test_the_sound_recipe_is_sound() -> None:
    assert len(check_recipe(recipe()).rooms.file_tables) == 2  # type: ignore[union-attr]


def test_a_room_lower_than_the_shortest_stroke_is_one_sentence() -> None:
    """A camera 1.9 m high, whose mirror stands above the ceilings that are allowed."""
    raw = {**recipe(), "rig": {"camera_height_m": 2.3}}
    lines = complaints(raw)
    assert [line.split(":")[0] for line in lines] == ["rooms.properties.height_m", "rooms.panoramas[0].box_m"]
    assert all("the mirror's top is at 2.72 m with the shortest stroke of [random], 0.1 m" in line for line in lines)
    raw["rooms"] = {**raw["rooms"], "properties": {"height_m": {"uniform": [3.0, 3.5]}}}
    assert [line.split(":")[0] for line in complaints(raw)] == ["rooms.panoramas[0].box_m"]


def test_rays_start_between_floor_and_the_lowest_ceiling() -> None:
    raw = recipe(properties={"height_m": 3.0})
    raw["random"]["spot"]["height_m"] = {"uniform": [0.2, 2.7]}
    [line] = complaints(raw)
    assert line.startswith("random.spot.height_m: reaches from 0.2 to 2.7 m, beyond floor or ceiling; stay above 0 and")
    assert line.endswith("below 2.6")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the files. Read only."""
    return write_files(tmp_path_factory.mktemp("files"))


def test_files_are_looked_for_beside_the_recipe(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = RoomFiles(folder)
    assert check_recipe(recipe(), files=files)
    [line] = complaints(recipe(**panorama(file="ofice.png")), files)
    assert line == f"rooms.panoramas[0].file: {folder}/ofice.png is missing; {THERE}"
    [line] = complaints(recipe(**mesh(file="meshes/all.glb")), files)
    assert line == f"rooms.meshes[0].file: {folder}/meshes/all.glb is missing; {THERE}"
    [line] = complaints(recipe(**panorama(file="meshes")), files)
    assert line == f"rooms.panoramas[0].file: {folder}/meshes is not readable: it is a folder; {THERE}"
    monkeypatch.setattr(room_files, "LARGEST_BYTES", 1 << 10)
    lines = complaints(recipe(), files)
    assert len(lines) == 2
    assert all("is larger than" in line for line in lines)


def test_a_stated_sha256_is_compared(folder: Path) -> None:
    files = RoomFiles(folder)
    right = files.sha256("office.png")
    assert check_recipe(recipe(**panorama(sha256=right)), files=files)
    [line] = complaints(recipe(**panorama(sha256="0" * 64)), files)
    assert line.startswith(f"rooms.panoramas[0].sha256: is not that of office.png, which has {right}; put the right")
    [line] = complaints(recipe(**panorama(sha256="0123")), files)
    assert line.startswith("rooms.panoramas[0].sha256: '0123' is not allowed")


def test_a_recipe_file_finds_its_folder(folder: Path, tmp_path: Path) -> None:
    from helpers.room_files import KINDS_TOML

    (folder / "kinds.toml").write_text(KINDS_TOML)
    assert load_recipe(folder / "kinds.toml").rooms is not None
    (tmp_path / "kinds.toml").write_text(KINDS_TOML)
    with pytest.raises(RecipeError, match=r"kinds\.toml has 2 faults:"):
        load_recipe(tmp_path / "kinds.toml")
