"""Rooms of several kinds: their order and ids, what their sources hold, and sentences where none can be built."""

import hashlib
from pathlib import Path
from typing import Any

import pytest
from helpers.room_files import MESH, PANORAMA, recipe, write_files

from phibench.datasets.common.errors import RecipeError
from phibench.datasets.plan.draws import draw_rooms
from phibench.datasets.plan.plan import Plan, make_plan
from phibench.datasets.recipe.load import check_recipe
from phibench.datasets.rooms.room_files import RoomFiles
from phibench.datasets.rooms.room_sources import MeshRoom, PanoramaRoom


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the files. Read only."""
    return write_files(tmp_path_factory.mktemp("files"))


def plan_of(folder: Path | None, **rooms: Any) -> Plan:
    return make_plan(check_recipe(recipe(**rooms)), RoomFiles(folder))


def test_kinds_take_turns_until_one_has_no_more(folder: Path) -> None:
    given = recipe(count=3, panoramas=[PANORAMA] * 2, meshes=[MESH])
    assert list(draw_rooms(check_recipe(given), RoomFiles(folder))) == [
        *("room000000", "panorama000000", "mesh000000"),
        *("room000001", "panorama000001", "room000002"),
    ]


@pytest.mark.parametrize(
    ("rooms", "ids"),
    [
        ({"panoramas": [], "meshes": []}, ["room000000"]),
        ({"panoramas": [PANORAMA], "meshes": []}, ["panorama000000"]),
        ({"count": 0, "meshes": [MESH], "panoramas": []}, ["mesh000000"]),
    ],
)
def test_count_may_be_left_out(folder: Path, rooms: dict[str, Any], ids: list[str]) -> None:
    given = recipe(**rooms)
    given["rooms"] = rooms
    assert list(draw_rooms(check_recipe(given), RoomFiles(folder))) == ids


def test_generated_rooms_are_those_of_a_recipe_without_files(folder: Path) -> None:
    alone = draw_rooms(check_recipe(recipe(count=2, panoramas=[], meshes=[])))
    beside = draw_rooms(check_recipe(recipe(count=2)), RoomFiles(folder))
    assert {name: beside[name] for name in alone} == alone


def test_sources_hold_name_digest_and_settings(folder: Path) -> None:
    plan = plan_of(folder, panoramas=[PANORAMA, {**PANORAMA, "stroke_m": 0.5, "box_m": None, "mesh": GEOMETRY}])
    digests = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in (PANORAMA["file"], HALL)}
    assert plan.files == RoomFiles(folder, digests)
    photo, mesh = plan.rooms["panorama000000"], plan.rooms["mesh000000"]
    assert isinstance(photo, PanoramaRoom)
    assert isinstance(mesh, MeshRoom)
    assert (photo.settings.path, photo.sha256, photo.mesh_sha256) == (Path("office.png"), digests["office.png"], "")
    assert (mesh.settings.path, mesh.sha256) == (Path(HALL), digests[HALL])
    assert photo.settings.stroke_m == mesh.settings.stroke_m == 0.1  # the shortest of [random]
    drawn = draw_rooms(plan.recipe, plan.files)["panorama000001"]
    assert isinstance(drawn, PanoramaRoom)
    assert drawn.settings.mesh is not None
    assert (drawn.mesh_sha256, drawn.settings.stroke_m, drawn.settings.mesh.stroke_m) == (digests[HALL], 0.5, 0.5)
    assert plan.room("panorama000000").name == "panorama"


HALL = "meshes/hall.glb"
GEOMETRY = {key: value for key, value in MESH.items() if key != "lamps"}


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "no spot": (
        {"panoramas": [{**PANORAMA, "laser_albedo": 0.0}]},
        r"^random: sample \d+ has no possible rig, spot and stroke in panorama000000 in 100 draws; the last: the ray "
        r"meets wall_\w+, a screen; change the numbers that are fixed or narrow",
    ),
    "no floor": (
        {"meshes": [{**MESH, "floor_point": [0.0, 1.0, 0.0]}]},
        r"^rooms: mesh000000 cannot be built: .*hall\.glb has no floor within 0\.1 m of floor_point",
    ),
    "a cabinet around the robot": (
        {"meshes": [{**MESH, "floor_point": [1.9, 0.0, 1.2]}]},
        r"^rooms: mesh000000 cannot be built: 'cabinet.*' stands where the robot is",
    ),
    "a mesh lower than the stroke": (
        {"meshes": [{**MESH, "stroke_m": 2.0}]},
        r"^rooms: mesh000000 cannot be built: 'room.*' is in the way of the mirror, which rises to 2\.80 m",
    ),
    "in other units": (
        {"meshes": [{**MESH, "metres_per_unit": 0.01}]},
        r"^rooms: mesh000000 cannot be built: .*a room measures 2 to 100 m each way; metres_per_unit = 1",
    ),
}


@pytest.mark.parametrize(("rooms", "words"), FAULTS.values(), ids=FAULTS)
def test_a_room_that_cannot_be_used_is_one_sentence(folder: Path, rooms: dict[str, Any], words: str) -> None:
    with pytest.raises(RecipeError, match=words) as caught:
        plan_of(folder, **rooms)
    assert str(caught.value).isprintable()


def test_a_panorama_of_the_wrong_aspect_is_one_sentence(folder: Path) -> None:
    from PIL import Image

    Image.new("RGB", (60, 40), (90, 90, 90)).save(folder / "square.png")
    with pytest.raises(RecipeError, match=r"^rooms: panorama000000 cannot be built: .*square\.png has 60 x 40 pixels"):
        plan_of(folder, panoramas=[{**PANORAMA, "file": "square.png"}])


def test_files_whose_folder_nobody_knows_are_one_sentence() -> None:
    with pytest.raises(RecipeError, match=r"^rooms: the file 'office\.png' of a room is needed, and nobody says in"):
        plan_of(None)
