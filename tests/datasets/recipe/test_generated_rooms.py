"""Generated rooms in recipes: distributions of properties, streams of their own, samples dealt to rooms, bad input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from phibench.datasets.common.errors import RecipeError
from phibench.datasets.plan.draws import draw_rooms
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.recipe.load import check_recipe, load_recipe
from phibench.datasets.rooms.room_sources import GeneratedRoom
from phibench.datasets.store.json_forms import from_json, to_json
from phibench.scenes.worlds.room_properties import PROPERTIES

RAY = {"azimuth_deg": {"uniform": [0.0, 360.0]}, "height_m": 0.45}


def raw(count: int = 2, samples: int = 3, seed: int = 0, **properties: Any) -> dict[str, Any]:
    return {
        "dataset": {"name": "worlds", "seed": seed},
        "rooms": {"count": count, "properties": properties},
        "laser": {"albedo": "surface"},
        "random": {"samples": samples, "stroke_m": {"uniform": [0.1, 0.4]}, "spot": RAY},
    }


def properties_of(count: int, seed: int = 0, **properties: Any) -> list[dict[str, Any]]:
    sources = draw_rooms(check_recipe(raw(count, seed=seed, **properties))).values()
    return [to_json(source)["properties"] for source in sources]


@pytest.mark.slow
def test_properties_follow_their_distributions() -> None:
    """600 draws: the mean of a uniform number lies within 5 of its standard errors (false alarm 6e-7)."""
    drawn = properties_of(600, height_m={"uniform": [2.5, 3.0]}, lamp_kind="tubes", windows={"choice": [1, 2]})
    heights = np.array([one["height_m"] for one in drawn])
    assert abs(heights.mean() - 2.75) < 5.0 * 0.5 / np.sqrt(12.0 * 600)
    assert heights.min() >= 2.5
    assert heights.max() <= 3.0
    assert {one["lamp_kind"] for one in drawn} == {"tubes"}
    assert {one["windows"] for one in drawn} == {1, 2}
    assert {one["use"] for one in drawn} == set(PROPERTIES["use"].choices)  # not given: the default distribution


def test_one_property_changes_no_other_and_more_rooms_change_none() -> None:
    plain, other = properties_of(5), properties_of(9, lamps=1)
    assert [{**one, "lamps": 1} for one in plain] == other[:5]
    assert plain != properties_of(5, seed=1)


@pytest.mark.slow
def test_samples_are_dealt_to_rooms_in_turn_and_more_of_them_keep_the_first() -> None:
    few, many = make_plan(check_recipe(raw(samples=2))), make_plan(check_recipe(raw(samples=4)))
    assert [pair.room for pair in many.pairs] == ["room000000", "room000001"] * 2
    assert many.pairs[:2] == few.pairs
    assert [many.spots[pair.spot] for pair in few.pairs] == list(few.spots.values())
    assert all(pose.pose_id.startswith(f"{pose.room}-") for pose in many.poses)
    assert many.rooms == few.rooms


def test_a_source_comes_back_from_its_line() -> None:
    source = draw_rooms(check_recipe(raw()))["room000001"]
    assert from_json(GeneratedRoom, to_json(source)) == source


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"random": None}, "rooms: given without \\[random\\]"),
        ({"targets": [{"name": "a", "depth_m": 2.0, "azimuth_deg": 0.0, "height_m": 0.5}]}, "no boards"),
        ({"room": {"name": "lab"}}, "room: given together with \\[rooms\\]"),
        ({"rooms": {"count": 0}}, "rooms.count"),
        ({"rooms": {"properties": {"height_m": 9.0}}}, "rooms.properties.height_m"),
        ({"rooms": {"properties": {"lamp_kind": "candles"}}}, "rooms.properties.lamp_kind"),
        ({"rooms": {"properties": {"windows": 1.5}}}, "rooms.properties.windows"),
        ({"rooms": {"properties": {"hight_m": 3.0}}}, "hight_m"),
        ({"rooms": None}, "targets: missing"),
    ],
)
def test_bad_tables_are_named(change: dict[str, Any], words: str) -> None:
    given = {key: value for key, value in {**raw(), **change}.items() if value is not None}
    with pytest.raises(RecipeError, match=words):
        check_recipe(given)


def test_rooms_need_rays() -> None:
    given = raw()
    given["random"]["spot"] = {}
    with pytest.raises(RecipeError, match="azimuth_deg: missing"):
        check_recipe(given)


def test_four_samples_of_the_shipped_recipe_share_a_room() -> None:
    recipe = load_recipe("worlds")
    assert recipe.rooms is not None
    assert recipe.random is not None
    assert 4 * recipe.rooms.count == recipe.random.samples == 100
