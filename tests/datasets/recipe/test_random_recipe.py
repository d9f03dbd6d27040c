"""Faults of `[random]`: every one in one go, with path, value, range and advice."""

import json
import math
from typing import Any

import pytest
from helpers.drawn_values import RAY, drawing
from helpers.recipes import changed, complaints

from phibench.datasets.plan.sampling import MISALIGNMENT, PARAMETERS
from phibench.datasets.recipe.load import check_recipe
from phibench.datasets.recipe.mirror_tables import HolderTable
from phibench.datasets.recipe.tables import DRAWABLE, RandomRigTable, Recipe

UNIFORM = {"uniform": [0.1, 1.4]}


@pytest.mark.parametrize(
    ("values", "path", "words"),
    [
        ({"samples": 0}, "random.samples", ("0", "an integer from 1")),
        ({"sequence": "halton"}, "random.sequence", ("'sobol', 'independent'",)),
        ({"stroke_m": {"unifrm": [0.1, 1.4]}}, "random.stroke_m.unifrm", ("unknown", "'uniform'")),
        ({"strok_m": UNIFORM}, "random.strok_m", ("unknown", "'stroke_m'")),
        ({"stroke_m": {}}, "random.stroke_m", ("exactly one of", "given: none")),
        ({"stroke_m": {**UNIFORM, "choice": [1.0]}}, "random.stroke_m", ("exactly one of", "uniform, choice")),
        ({"stroke_m": {"uniform": [1.4, 0.1]}}, "random.stroke_m.uniform", ("[1.4, 0.1]", "below the high")),
        ({"stroke_m": {"uniform": [0.5, 0.5]}}, "random.stroke_m.uniform", ("below the high",)),
        ({"stroke_m": {"uniform": [0.1]}}, "random.stroke_m.uniform", ("a list of 2",)),
        ({"stroke_m": {"uniform": [0.1, math.nan]}}, "random.stroke_m.uniform[1]", ("nan", "a number")),
        ({"stroke_m": {"log_uniform": [-1.0, 1.0]}}, "random.stroke_m.log_uniform", ("-1", "above 0")),
        ({"stroke_m": {"choice": []}}, "random.stroke_m.choice", ("at least 1",)),
        (
            {"stroke_m": {"normal": [0.5, -0.1], "clip": [0.1, 1]}},
            "random.stroke_m.normal",
            ("sigma = -0.1", "above 0"),
        ),
        ({"stroke_m": {"normal": [0.5, 0.1]}}, "random.stroke_m.clip", ("needs clip",)),
        ({"stroke_m": {"normal": [0.5, 0.1], "clip": [1, 0]}}, "random.stroke_m.clip", ("below the high",)),
        ({"stroke_m": {"normal": [0.5, 0.1], "clip": [0.6, 1]}}, "random.stroke_m.clip", ("leaves out the mean",)),
        ({"stroke_m": {**UNIFORM, "clip": [0.2, 1]}}, "random.stroke_m.clip", ("normal distribution only",)),
        ({"stroke_m": {"uniform": [0.0, 1.4]}}, "random.stroke_m", ("reaches 0", "from 0.001 up to 10")),
        ({"stroke_m": -1}, "random.stroke_m", ("reaches -1", "from 0.001")),
        ({"stroke_m": "x"}, "random.stroke_m", ("'x'", "a number or a distribution")),
        ({"rig": {"z_c": 0.3}}, "random.rig.z_c", ("unknown", "'z_c_m'")),
        ({"rig": {"preset": "c310"}}, "random.rig.preset", ("not a number", "set preset in [rig]")),
        ({"rig": {"width_px": {"choice": [640]}}}, "random.rig.width_px", ("same for all samples",)),
        ({"rig": {"f_number": {"uniform": [0.1, 3]}}}, "random.rig.f_number", ("reaches 0.1", "from 0.5 up to 256")),
        ({"rig": {"z_c_m": {"choice": [0.3, 7.0]}}}, "random.rig.z_c_m", ("reaches 7", "up to 5")),
        ({"rig": {"k1": True}}, "random.rig.k1", ("True", "a number or a distribution")),
        ({"rig": {"holder": {"kind": "tripod"}}}, "random.rig.holder.kind.choice[0]", ("'tripod'", "'post', 'tube'")),
        ({"rig": {"holder": {"kind": {"choice": []}}}}, "random.rig.holder.kind.choice", ("at least 1",)),
        ({"rig": {"holder": {"radius_m": -0.1}}}, "random.rig.holder.radius_m", ("reaches -0.1", "from 0.0001")),
        ({"rig": {"holder": {"glass_index": 3.0}}}, "random.rig.holder.glass_index", ("reaches 3", "2.5")),
        ({"rig": {"holder": {"radius": 0.1}}}, "random.rig.holder.radius", ("unknown", "'radius_m'")),
        ({"spot": {"target": {"choice": ["b"]}}}, "random.spot.target.choice[0]", ("'b'", "known: a")),
        ({"spot": {"target": "b"}}, "random.spot.target.choice[0]", ("'b'", "known: a")),
        ({"spot": {"target": {"choice": ["a", "a"]}}}, "random.spot.target.choice[1]", ("twice",)),
        ({"spot": {"targt": "a"}}, "random.spot.targt", ("unknown", "'target'")),
        ({"spot": {"across_m": {"uniform": [-0.3, 0.1]}}}, "random.spot.across_m", ("0.3 m", "'a'", "to 0.195")),
        ({"spot": {"up_m": 0.148}}, "random.spot.up_m", ("leaves the board", "to 0.145")),
        ({"spot": {"across_m": 0.0, "up_m": {"choice": [-0.15]}}}, "random.spot.up_m", ("0.15 m", "leaves the board")),
        ({"spot": {"azimuth_deg": 10.0}}, "random.spot.height_m", ("missing", "azimuth_deg")),
        ({"spot": {"height_m": 1.0}}, "random.spot.azimuth_deg", ("missing", "height_m")),
        ({"spot": {**RAY, "up_m": 0.1}}, "random.spot", ("up_m (on a board)", "one or the other")),
        ({"spot": {**RAY, "height_m": {"uniform": [0.5, 3]}}}, "random.spot.height_m", ("beyond floor or lamps",)),
    ],
)
def test_each_fault_is_one_line_that_helps(values: dict[str, Any], path: str, words: tuple[str, ...]) -> None:
    [line] = complaints(drawing(**values))
    assert line.startswith(f"{path}: ")
    assert [word for word in words if word not in line] == []


def test_a_spot_that_fits_on_no_place_of_its_board_is_refused() -> None:
    """Its 4 sigma, 0.16 m, go beyond 0.15 m upwards, though the board is larger than its diameter."""
    [line] = complaints({**drawing(), "laser": {"diameter_m": 0.16}})
    assert line.startswith("random.spot.up_m: a spot at the centre of the board 'a' already reaches 0.010 m beyond")
    check_recipe({**drawing(), "laser": {"diameter_m": 0.16, "profile": "uniform"}})


def test_a_recipe_has_experiments_or_draws() -> None:
    [line] = complaints({**drawing(), "experiments": changed()["experiments"]})
    assert line.startswith("random: given together with [[experiments]]")
    [line] = complaints({key: value for key, value in drawing().items() if key != "random"})
    assert line.startswith("experiments: missing; add [[experiments]]")
    assert "[random]" in line
    [line] = complaints({**{k: v for k, v in drawing().items() if k != "random"}, "randm": {}})
    assert "did you mean 'random'" in line


def test_all_faults_of_a_random_recipe_come_in_one_go() -> None:
    raw = drawing(samples=0, stroke_m={"uniform": [2, 1]}, rig={"z_c": 0.3, "k1": {"log_uniform": [0, 1]}})
    raw["random"]["spot"] = {"up_m": 0.2}
    raw["dataset"] = {"name": "x", "seed": -1}
    assert {line.split(": ")[0] for line in complaints(raw)} == {
        *("dataset.seed", "random.samples", "random.stroke_m.uniform", "random.rig.z_c", "random.rig.k1.log_uniform"),
        "random.spot.up_m",
    }


@pytest.mark.parametrize("nonsense", [3, [], {"rig": 3, "spot": []}, {"stroke_m": [1]}, {"spot": {"target": 3}}])
def test_nonsense_is_reported_and_never_raises_anything_else(nonsense: Any) -> None:
    assert complaints({**drawing(), "random": nonsense})


def test_every_drawable_key_is_a_key_of_the_rig_and_has_a_parameter() -> None:
    assert tuple(RandomRigTable.model_fields) == (*DRAWABLE, "holder")
    others = 8 + len(MISALIGNMENT) + len(HolderTable.model_fields)
    assert len(PARAMETERS) == len(set(PARAMETERS)) == len(DRAWABLE) + others
    recipe = check_recipe(drawing(rig={"z_c_m": 0.3}))
    assert Recipe.model_validate(json.loads(json.dumps(recipe.model_dump(mode="json")))) == recipe
