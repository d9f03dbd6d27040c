"""Spots that one image hides: as many as dealt, for every kind of cause, dark in that image, and seen by the other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from phibench.datasets.common.errors import RecipeError
from phibench.datasets.plan import sampling
from phibench.datasets.plan.plan import PairPlan, Plan, make_plan
from phibench.datasets.plan.sampling import HIDDEN, SHOWN
from phibench.datasets.recipe.load import check_recipe
from phibench.datasets.rooms.room_sources import room_of
from phibench.render.optics.room_tracer import room_geometry
from phibench.render.optics.spot_layer import spot_layer
from phibench.render.optics.truth import spot_truth
from phibench.scenes.rig import POSITIONS

SHARE = 0.25


def raw(samples: int = 16, sequence: str = "sobol", seed: int = 0, **spot: Any) -> dict[str, Any]:
    ray = {"azimuth_deg": {"uniform": [0.0, 360.0]}, "height_m": 0.45, "elevation_deg": {"uniform": [-8.0, 25.0]}}
    hidden = {"hidden": SHARE, "hidden_elevation_deg": {"uniform": [-60.0, -20.0]}}
    given = {key: value for key, value in {**ray, **hidden, **spot}.items() if value is not None}
    return {
        "dataset": {"name": "hide", "seed": seed},
        # the lab's furniture stands along the walls: a board before them gives a ray's spot something to hide behind
        "targets": [{"name": "a", "depth_m": 1.0, "azimuth_deg": 20.0, "height_m": 0.5}],
        "laser": {"albedo": "surface"},
        "random": {"samples": samples, "sequence": sequence, "stroke_m": {"uniform": [0.1, 1.4]}, "spot": given},
    }


def planned(*arguments: Any, **spot: Any) -> Plan:
    return make_plan(check_recipe(raw(*arguments, **spot)))


def dealt(plan: Plan) -> list[Any]:
    return [dict(pair.drawn)["spot.hidden"] for pair in plan.pairs]


def seen(plan: Plan, pair: PairPlan) -> list[tuple[str, float]]:
    """Cause and light of both images."""
    spot, room, found = plan.spots[pair.spot], room_of(plan.rooms[pair.room]), []
    for position in POSITIONS:
        view = plan.rigs[pair.rig].at(pair.offset_m(position))
        geometry = room_geometry(room, view)
        light = float(spot_layer(view, spot, geometry).total_electrons_per_s.sum())
        found.append((spot_truth(view, spot, geometry).cause, light))
    return found


@pytest.fixture(scope="module")
def plan() -> Plan:
    return planned()


def test_as_many_are_hidden_as_dealt_and_the_truth_says_why(plan: Plan) -> None:
    causes = []
    for pair, word in zip(plan.pairs, dealt(plan), strict=True):
        (a, light_a), (b, light_b) = seen(plan, pair)
        assert word in (HIDDEN, SHOWN)
        if word == SHOWN:
            assert a == b == "none"
            continue
        assert (a == "none") != (b == "none")
        assert min(light_a, light_b) <= 0.01 * max(light_a, light_b)
        assert (light_a > light_b) == (a == "none")
        causes.append(b if a == "none" else a)
    assert len(causes) == SHARE * len(plan.pairs)  # exact: 16 points of a Sobol sequence, 4 in each quarter
    assert any(cause.startswith("occluded:robot") for cause in causes)  # on the floor, behind the robot


@pytest.mark.parametrize(
    ("elevation_deg", "azimuth_deg", "stroke_m", "expected"),
    [
        ([79.0, 81.5], [0.0, 360.0], [1.35, 1.4], "no_reflection"),  # the ceiling above the mirror
        ([-8.5, -6.0], [12.0, 28.0], [0.1, 1.4], "occluded:board_a"),  # below the board, on the floor behind it
    ],
)
def test_the_mirror_and_things_of_the_room_hide_spots(
    elevation_deg: list[float], azimuth_deg: list[float], stroke_m: list[float], expected: str
) -> None:
    turn, rise = {"uniform": azimuth_deg}, {"uniform": elevation_deg}
    given = raw(2, hidden=1.0, hidden_elevation_deg=rise, azimuth_deg=turn)
    given["random"]["stroke_m"] = {"uniform": stroke_m}
    plan = make_plan(check_recipe(given))
    causes = [cause for pair in plan.pairs for cause, _ in seen(plan, pair) if cause != "none"]
    assert len(causes) == 2
    assert set(causes) == {expected}


def test_more_samples_and_other_distributions_change_no_deal(plan: Plan) -> None:
    few = planned(4)
    assert few.pairs == plan.pairs[:4]
    narrow = planned(hidden_elevation_deg={"uniform": [-50.0, -20.0]})
    assert dealt(narrow) == dealt(plan)
    shown = [(a, b) for a, b, word in zip(narrow.pairs, plan.pairs, dealt(plan), strict=True) if word == SHOWN]
    assert all(a == b for a, b in shown)


def test_a_share_of_an_independent_sequence_is_binomial() -> None:
    """2000 numbers: their share within 5 standard deviations of that asked for (false alarm 6e-7)."""
    points = sampling.first_points("independent", "hide", 0, 2000, ["spot.hidden"])["spot.hidden"]
    assert abs(np.mean(points < SHARE) - SHARE) < 5.0 * np.sqrt(SHARE * (1.0 - SHARE) / 2000)


def test_a_recipe_without_the_key_asks_nothing() -> None:
    plan = planned(hidden=None, hidden_elevation_deg=None, elevation_deg={"uniform": [-60.0, 85.0]})
    assert "spot.hidden" not in dict(plan.pairs[0].drawn)
    assert any(cause != "none" for pair in plan.pairs for cause, _ in seen(plan, pair))


def test_spots_that_nothing_hides_are_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "HIDDEN_TRIES", 5)
    free = {"azimuth_deg": {"uniform": [-1.0, 1.0]}, "elevation_deg": 20.0, "hidden_elevation_deg": None}
    with pytest.raises(RecipeError, match="in 5 draws; the last: the spot is not hidden in exactly one image"):
        planned(8, hidden=1.0, **free)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"hidden": 1.5}, "random.spot.hidden"),
        ({"hidden": None}, "random.spot.hidden: missing; hidden_elevation_deg is the elevation"),
        ({"hidden_elevation_deg": {"uniform": [-95.0, 0.0]}}, "hidden_elevation_deg"),
        ({"azimuth_deg": None, "height_m": None, "elevation_deg": None}, "random.spot.azimuth_deg: missing"),
    ],
)
def test_bad_tables_are_named(change: dict[str, Any], words: str) -> None:
    with pytest.raises(RecipeError, match=words):
        check_recipe(raw(**change))
