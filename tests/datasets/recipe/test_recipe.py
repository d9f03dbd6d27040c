"""Recipes: every fault in one go, with path, value, range and advice."""

import math
from typing import Any

import pytest
from helpers.recipes import SOUND, changed, complaints, target

from phibench.datasets.common.errors import RecipeError
from phibench.datasets.recipe.checks import warnings
from phibench.datasets.recipe.load import RECIPES, check_recipe, find_recipe, load_recipe, parse_recipe
from phibench.datasets.recipe.recipe_scene import build_rig, build_spot
from phibench.scenes.room import c310_rig, default_rig


def experiment(**values: Any) -> dict[str, Any]:
    return {**SOUND["experiments"][0], **values}


@pytest.mark.parametrize("path", sorted(RECIPES.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_recipes_are_sound_and_give_no_warning(path: Any) -> None:
    found = warnings(load_recipe(path))
    if path.stem == "study-isotropy-tilted":  # boards without spots: its light map is that of the others
        assert len(found) == 1
        assert "stand in the room" in found[0]
    else:
        assert found == []


def test_a_shipped_recipe_is_found_by_its_name() -> None:
    assert load_recipe("paper").dataset.name == "paper"


def test_defaults_are_the_default_rig_and_the_presets_theirs() -> None:
    assert build_rig(check_recipe(SOUND).rig) == default_rig()
    assert build_rig(check_recipe(changed(rig={"preset": "c310"})).rig) == c310_rig()


def test_what_is_implied_follows_what_is_given() -> None:
    rig = build_rig(check_recipe(changed(rig={"z_c_m": 0.30, "radius_m": 0.05, "width_px": 640, "height_px": 480})).rig)
    assert rig.camera.focus_distance_m == pytest.approx(0.275)
    assert (rig.camera.cx_px, rig.camera.cy_px) == (319.5, 239.5)
    given = build_rig(check_recipe(changed(rig={"z_c_m": 0.30, "focus_distance_m": 0.46})).rig)
    assert given.camera.focus_distance_m == 0.46


@pytest.mark.parametrize("given", ["fx_px", "fy_px"])
def test_pixels_are_square_unless_both_focal_lengths_are_given(given: str) -> None:
    camera = build_rig(check_recipe(changed(rig={given: 700.0, "width_px": 640})).rig).camera
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (700.0, 700.0, 319.5, 359.5)
    both = build_rig(check_recipe(changed(rig={"fx_px": 700.0, "fy_px": 710.0})).rig).camera
    assert (both.fx_px, both.fy_px) == (700.0, 710.0)


def test_a_tilted_camera_leaves_the_mirror_where_it_is() -> None:
    rig = build_rig(check_recipe(changed(rig={"tilt_x_rad": 0.02, "tilt_y_rad": -0.03, "decentre_x_m": 0.001})).rig)
    assert rig.at(0.0).sphere_centre_m == pytest.approx([0.001, 0.0, 0.71], abs=1e-15)
    assert rig.T_world_camera.R[2, 2] < 1.0


def test_the_spot_grows_with_distance_or_has_one_diameter() -> None:
    recipe = check_recipe(SOUND)
    assert build_spot(recipe.laser, recipe.targets[0]).diameter_m == pytest.approx(5e-3)
    fixed = check_recipe(changed(laser={"diameter_m": 0.01}))
    assert build_spot(fixed.laser, fixed.targets[0]).diameter_m == 0.01


@pytest.mark.parametrize(
    ("raw", "path", "words"),
    [
        (changed(dataset={}), "dataset.name", ("missing", "string")),
        (changed(dataset={"name": "a/b"}), "dataset.name", ("'a/b'", "letters")),
        (changed(dataset={"name": "x", "seed": -1}), "dataset.seed", ("-1", "from 0")),
        (changed(dataset={"name": "x", "sed": 1}), "dataset.sed", ("unknown", "'seed'")),
        (changed(rig={"z_c": 0.3}), "rig.z_c", ("unknown", "'z_c_m'")),
        (changed(rig={"preset": "defalt"}), "rig.preset", ("'default', 'c310'",)),
        (changed(rig={"k1": math.nan}), "rig.k1", ("nan", "from -1000 up to 1000")),
        (changed(rig={"f_number": True}), "rig.f_number", ("true", "a number from 0.5")),
        (changed(rig={"z_c_m": "0.3"}), "rig.z_c_m", ("'0.3'", "a number above 0")),
        (changed(rig={"z_c_m": 0.05}), "rig", ("0.0500 m", "mirror radius", "z_c_m = 0.05", "radius_m = 0.06")),
        (changed(rig={"camera_height_m": 3.0}), "rig.camera_height_m", ("ceiling", "less than 2.679")),
        (changed(rig={"z_c_m": 2.6}), "rig.z_c_m", ("ceiling",)),
        ({k: v for k, v in changed().items() if k != "targets"}, "targets", ("missing",)),
        (changed(targets=target()), "targets", ("[[targets]]",)),
        (
            changed(targets=[{("nmae" if k == "name" else k): v for k, v in target().items()}]),
            "targets[0].nmae",
            ("'name'",),
        ),
        (changed(room={"name": "kitchen"}), "room.name", ("'lab', 'dark'",)),
        (changed(roomm={}), "roomm", ("unknown", "'room'")),
        (changed(laser={"diameter_m": 0.01, "diameter_base_m": 0.01}), "laser.diameter_m", ("one or the other",)),
        (changed(laser={"power_w": 0.0}), "laser.power_w", ("above 0",)),
        (changed(ambient={"cells_per_pixel": 1.5}), "ambient.cells_per_pixel", ("an integer from 2",)),
        (changed(targets=[target(depth_m=-2.0)]), "targets[0].depth_m", ("-2.0", "above 0")),
        (changed(targets=[target(depth_m=math.inf)]), "targets[0].depth_m", ("inf", "up to 100")),
        (changed(targets=[target(), target(name="A")]), "targets[1].name", ("targets[0]",)),
        (changed(targets=[target(depth_m=0.2, height_m=0.2)]), "targets[0]", ("robot_body",)),
        (changed(targets=[target(depth_m=4.45, azimuth_deg=160.0)]), "targets[0]", ("cabinet",)),
        (changed(targets=[target(depth_m=9.0)]), "targets[0]", ("outside the room",)),
        (changed(experiments=[experiment(targets=["b"])]), "experiments[0].targets[0]", ("'b'", "known: a")),
        (changed(experiments=[experiment(targets=[])]), "experiments[0].targets", ("at least 1",)),
        (
            changed(experiments=[experiment(strokes_m=[0.0])]),
            "experiments[0].strokes_m[0]",
            ("0.0", "from 0.001 up to 10"),
        ),
        (changed(experiments=[experiment(strokes_m=[0.0005])]), "experiments[0].strokes_m[0]", ("0.0005", "0.001")),
        (changed(experiments=[experiment(strokes_m=[0.3, -1])]), "experiments[0].strokes_m[1]", ("-1",)),
        (changed(experiments=[experiment(strokes_m=[math.nan])]), "experiments[0].strokes_m[0]", ("nan",)),
        (changed(experiments=[experiment(strokes_m=[0.3, 0.3])]), "experiments[0].strokes_m[1]", ("twice",)),
        (changed(experiments=[experiment(strokes_m=[2.5])]), "experiments[0].strokes_m[0]", ("ceiling", "2.230")),
    ],
)
def test_each_fault_is_one_line_that_helps(raw: dict[str, Any], path: str, words: tuple[str, ...]) -> None:
    [line] = complaints(raw)
    assert line.startswith(f"{path}: ")
    assert [word for word in words if word not in line] == []


def test_all_faults_of_a_stage_come_in_one_go() -> None:
    """First those of the tables, then, once they are mended, those of the scene."""
    raw = {
        "dataset": {"name": "x", "seed": -1},
        "rig": {"presett": "default", "k1": math.nan},
        "laser": {"profile": "gauss", "diameter_m": 0.01, "diameter_base_m": 0.01},
        "targets": [target(depth_m=0.2, height_m=0.2), target()],
        "experiments": [{"name": "e", "targets": ["c"], "strokes_m": [0.0, 2.5]}],
    }
    assert {line.split(": ")[0] for line in complaints(raw)} == {
        *("dataset.seed", "rig.presett", "rig.k1", "laser.profile", "experiments[0].strokes_m[0]")
    }
    raw["experiments"][0]["strokes_m"] = [0.3, 2.5]  # type: ignore[index]
    mended = raw | {"dataset": {"name": "x"}, "rig": {}, "laser": {"diameter_m": 0.01, "diameter_base_m": 0.01}}
    assert {line.split(": ")[0] for line in complaints(mended)} == {
        *("laser.diameter_m", "targets[0]", "targets[1].name"),
        *("experiments[0].targets[0]", "experiments[0].strokes_m[1]"),
    }


@pytest.mark.parametrize("raw", [{}, {"targets": 3, "experiments": "x"}, {"targets": [1], "rig": 2, "laser": []}])
def test_nonsense_is_reported_and_never_raises_anything_else(raw: dict[str, Any]) -> None:
    assert len(complaints(raw)) >= 3


def test_toml_and_file_faults(tmp_path: Any) -> None:
    with pytest.raises(RecipeError, match=r"line 1, column"):
        parse_recipe("a = = 1")
    with pytest.raises(RecipeError, match="smoke"):
        load_recipe(tmp_path / "smok")
    (tmp_path / "latin.toml").write_bytes(b"# \xe9")
    with pytest.raises(RecipeError, match=r"cannot be read.*UTF-8"):
        load_recipe(tmp_path / "latin.toml")
    with pytest.raises(RecipeError, match="is a folder"):
        load_recipe(tmp_path)


def test_a_byte_order_mark_is_accepted(tmp_path: Any) -> None:
    (tmp_path / "marked.toml").write_bytes(b"\xef\xbb\xbf" + find_recipe("smoke").read_bytes())
    assert load_recipe(tmp_path / "marked.toml") == load_recipe("smoke")


def test_a_mirror_beyond_the_image_is_a_warning() -> None:
    [warning] = warnings(check_recipe(changed(rig={"z_c_m": 0.2})))
    assert "does not fit the image" in warning


@pytest.mark.parametrize(
    ("drawn", "count"),
    [({}, 1), ({"f_number": {"uniform": [2.0, 2.8]}}, 1), ({"z_c_m": {"uniform": [0.26, 0.28]}}, 0)],
)
def test_the_outline_of_a_rig_that_no_sample_has_is_no_warning(drawn: dict[str, Any], count: int) -> None:
    document = changed(rig={"z_c_m": 0.2}, random={"stroke_m": {"uniform": [0.2, 0.4]}, "rig": drawn})
    document.pop("experiments", None)
    assert len([text for text in warnings(check_recipe(document)) if "outline" in text]) == count


def test_a_board_that_nobody_uses_is_a_warning() -> None:
    [warning] = warnings(check_recipe(changed(targets=[target(), target(name="b", azimuth_deg=90.0)])))
    assert "b stand" in warning


@pytest.mark.parametrize(
    ("place", "part"),
    [
        ((0.1, 0.0, 0.05), "robot_body"),  # below the body
        ((0.15, 90.0, 0.15), "robot_track"),  # in the gap between body and track
        ((0.35, 0.0, 0.25), "robot_flipper"),  # in front, between the flippers
        ((0.52, 180.0, 0.1), None),
    ],
)
def test_a_board_that_cuts_the_robot_is_refused(place: tuple[float, float, float], part: str | None) -> None:
    depth_m, azimuth_deg, height_m = place
    raw = changed(targets=[target(depth_m=depth_m, azimuth_deg=azimuth_deg, height_m=height_m)])
    if part is None:
        check_recipe(raw)
    else:
        [line] = complaints(raw)
        assert line.startswith("targets[0]: ")
        assert part in line


@pytest.mark.parametrize(
    ("place", "part"),
    [((0.01, 0.71), "mirror"), ((0.05, 0.71), "mirror"), ((0.02, 0.46), "camera housing"), ((0.02, 1.11), "mirror")],
)
def test_board_that_cuts_the_carriage_is_refused(place: tuple[float, float], part: str) -> None:
    depth_m, height_m = place
    targets = [{"name": "a", "depth_m": depth_m, "azimuth_deg": 0.0, "height_m": height_m}]
    with pytest.raises(RecipeError, match=rf"targets\[0\].depth_m.*cuts the {part}"):
        check_recipe(changed(targets=targets, experiments=[{"name": "e", "targets": ["a"], "strokes_m": [0.4]}]))


def test_spot_larger_than_its_board_is_refused() -> None:
    with pytest.raises(RecipeError, match=r"its board measures 0\.3 m"):
        check_recipe(changed(laser={"diameter_m": 0.5}))


def test_camera_above_the_ceiling_is_blamed_on_the_camera() -> None:
    with pytest.raises(RecipeError, match=r"rig.camera_height_m.*through the ceiling"):
        check_recipe(changed(rig={"camera_height_m": 2.9}))


def test_distortion_that_folds_is_refused_with_its_coefficients() -> None:
    with pytest.raises(RecipeError, match=r"k1 = -0.12, k2 = 0.03, k3 = -3.4.*folds"):
        check_recipe(changed(rig={"preset": "c310", "k1": -0.12, "k2": 0.03}))


@pytest.mark.parametrize("table", [{"misalignment": {"cx_px": 1500.0}}, {"rig": {"cx_px": 3000.0}}], ids=str)
def test_a_mirror_outside_of_the_image_is_a_fault(table: dict[str, Any]) -> None:
    assert any("the mirror is outside of the image" in line for line in complaints(changed(**table)))
