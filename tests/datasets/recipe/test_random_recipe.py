"""Faults of `[random]`: every one in one go, with path, value, range and advice."""

import hashlib
import json
import math
from typing import Any

import pytest
from helpers.drawn_values import RAY, drawing
from helpers.recipes import changed, complaints

from phibench.datasets.plan.sampling import (
    MISALIGNMENT,
    PARAMETERS,
    draw_values,
    drawn_parameters,
    first_points,
    rig_table,
)
from phibench.datasets.recipe.load import check_recipe, load_recipe
from phibench.datasets.recipe.mirror_tables import DRAWN_OF_MIRROR, HolderTable
from phibench.datasets.recipe.recipe_scene import build_rig
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
        ({"rig": {"k1": True}}, "random.rig.k1", ("true", "a number or a distribution")),
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
    raw["dataset"] = {"name": "x", "seed": -1}
    assert {line.split(": ")[0] for line in complaints(raw)} == {
        *("dataset.seed", "random.samples", "random.stroke_m.uniform", "random.rig.z_c", "random.rig.k1.log_uniform")
    }
    raw = drawing(spot={"up_m": 0.2, "target": {"choice": ["a", "a", "b"]}})
    assert [line.split(": ")[0] for line in complaints(raw)] == [
        *("random.spot.target.choice[2]", "random.spot.target.choice[1]", "random.spot.up_m")
    ]


@pytest.mark.parametrize("nonsense", [3, [], {"rig": 3, "spot": []}, {"stroke_m": [1]}, {"spot": {"target": 3}}])
def test_nonsense_is_reported_and_never_raises_anything_else(nonsense: Any) -> None:
    assert complaints({**drawing(), "random": nonsense})


def test_every_drawable_key_is_a_key_of_the_rig_and_has_a_parameter() -> None:
    assert tuple(RandomRigTable.model_fields) == (*DRAWABLE, "holder", "mirror")
    others = 8 + len(MISALIGNMENT) + len(HolderTable.model_fields) + len(DRAWN_OF_MIRROR)
    assert len(PARAMETERS) == len(set(PARAMETERS)) == len(DRAWABLE) + others
    recipe = check_recipe(drawing(rig={"z_c_m": 0.3}))
    assert Recipe.model_validate(json.loads(json.dumps(recipe.model_dump(mode="json")))) == recipe


# -- shapes of mirrors -------------------------------------------------------------------------------------------------


def mirrors(drawn: dict[str, Any], **given: Any) -> dict[str, Any]:
    """Recipe that draws keys of a mirror of revolution."""
    raw = drawing(rig={"mirror": drawn})
    table = {"mirror": {"shape": "paraboloid", **given}} if given.get("shape") != "none" else {}
    return {**raw, "rig": {**{k: v for k, v in raw.get("rig", {}).items() if k not in ("radius_m", "z_c_m")}, **table}}


@pytest.mark.parametrize(
    ("drawn", "given", "path", "words"),
    [
        ({"shape": "cone"}, {"shape": "none"}, "rig.mirror", ("missing", "[random.rig.mirror]")),
        ({"shape": "sphere"}, {}, "random.rig.mirror.shape.choice[0]", ("'sphere'", "'ellipsoid'")),
        ({"shape": {"choice": []}}, {}, "random.rig.mirror.shape.choice", ("at least 1",)),
        ({"half_angle_deg": 40.0}, {}, "random.rig.mirror.half_angle_deg", ("no effect", 'shape = "cone"')),
        ({"shape": "cone", "conic": -0.5}, {}, "random.rig.mirror.conic", ("no effect on", '"cone"')),
        ({"vertex_radius_m": -1.0}, {}, "random.rig.mirror.vertex_radius_m", ("reaches -1", "above 0")),
        ({"even_terms": 3.0}, {}, "random.rig.mirror.even_terms", ("unknown",)),
        ({"shape": "polynomial"}, {}, "rig.mirror.even_terms", ("is missing",)),
        (
            {"shape": {"choice": ["ellipsoid", "hyperboloid"]}},
            {"conic": -0.5},
            "rig.mirror.conic",
            ("is -0.5", "below -1", "leave that shape out"),
        ),
        (
            {"shape": {"choice": ["ellipsoid", "hyperboloid"]}, "conic": {"uniform": [-0.8, -0.2]}},
            {},
            "random.rig.mirror.conic",
            ("from -0.8 to -0.2", '"hyperboloid" is below -1'),
        ),
    ],
)
def test_each_fault_of_a_drawn_mirror_is_one_line(
    drawn: dict[str, Any], given: dict[str, Any], path: str, words: tuple[str, ...]
) -> None:
    [line] = complaints(mirrors(drawn, **given))
    assert line.startswith(f"{path}: ")
    assert [word for word in words if word not in line] == []


def test_drawn_mirrors_have_what_their_shape_has() -> None:
    shapes = ["ellipsoid", "paraboloid", "cone", "polynomial"]
    drawn = {
        "shape": {"choice": shapes},
        "conic": {"uniform": [-0.8, -0.2]},
        "half_angle_deg": {"uniform": [40.0, 50.0]},
        "rim_radius_m": {"uniform": [0.055, 0.060]},
    }
    recipe = check_recipe(mirrors(drawn, even_terms=[3.0]))
    assert recipe.random is not None
    points = first_points("sobol", "name", 1, 64, drawn_parameters(recipe.random))
    values = draw_values(recipe.random, [target.name for target in recipe.targets], points)
    found = dict.fromkeys(shapes, 0)
    for k in range(64):
        own = {key: column[k] for key, column in values.items() if key.startswith("rig.")}
        mirror = rig_table(recipe.rig, own).mirror
        assert mirror is not None
        assert 0.055 <= mirror.rim_radius_m <= 0.060
        assert (mirror.conic is None) == (mirror.shape in ("paraboloid", "cone"))
        assert (mirror.half_angle_deg is None) == (mirror.shape != "cone")
        assert (mirror.even_terms is None) == (mirror.shape != "polynomial")
        profile = build_rig(rig_table(recipe.rig, own)).mirror.profile  # type: ignore[union-attr]
        assert profile.rim_radius_m == mirror.rim_radius_m
        assert mirror.conic is None or profile.conic == mirror.conic
        found[mirror.shape] += 1
    assert min(found.values()) == max(found.values()) == 16  # Sobol's points deal four shapes evenly


def test_the_frozen_recipes_draw_what_they_drew() -> None:
    """Hashes of recipe and numbers from before shapes could be drawn: later keys have later dimensions."""
    kept = {"bench-dev": ("89feb0cc176f6f1c", DEV), "bench-test": ("95a966a1bcbaa60a", TEST)}
    for name, (of_recipe, of_points) in kept.items():
        recipe = load_recipe(name)
        assert recipe.random is not None
        document = json.dumps(recipe.model_dump(mode="json"), sort_keys=True)
        assert hashlib.sha256(document.encode()).hexdigest()[:16] == of_recipe
        points = first_points(recipe.random.sequence, name, recipe.dataset.seed, 64, drawn_parameters(recipe.random))
        text = "".join(f"{key}{[float(x).hex() for x in column]}" for key, column in points.items())
        assert hashlib.sha256(text.encode()).hexdigest()[:16] == of_points
    assert PARAMETERS[-7:] == tuple(f"rig.mirror.{key}" for key in DRAWN_OF_MIRROR)
    assert hashlib.sha256(repr(PARAMETERS[:-7]).encode()).hexdigest()[:16] == ORDER  # places are Sobol's dimensions


DEV, TEST, ORDER = "bf20b945d932884a", "b8267fd806dda2f7", "1d9f874c8ac06f6a"
