"""`[rigs]`: rigs that are drawn once and see all experiments."""

from __future__ import annotations

import tomllib
from collections import Counter

import numpy as np
import pytest
import scipy

from phibench.datasets.common.errors import RecipeError
from phibench.datasets.plan.plan import RECIPE_RIG, make_plan, shard_plan
from phibench.datasets.recipe.load import RECIPES, check_recipe, load_recipe
from phibench.datasets.recipe.recipe_scene import build_misalignment
from phibench.datasets.recipe.tables import Recipe
from phibench.estimator.geometry.rig_parameters import PRIOR_SIGMA
from phibench.scenes.mirror import OF_REVOLVED

SHIPPED = (RECIPES / "paper-misaligned.toml").read_text(encoding="utf-8")


def shipped(**rigs: object) -> Recipe:
    """The shipped recipe with other keys in `[rigs]`."""
    raw = tomllib.loads(SHIPPED)
    return check_recipe({**raw, "rigs": {**raw["rigs"], **rigs}})


def faults(change: dict[str, object]) -> str:
    with pytest.raises(RecipeError) as caught:
        check_recipe({**tomllib.loads(SHIPPED), **change})
    return str(caught.value)


def test_every_rig_sees_every_experiment() -> None:
    plan, paper = make_plan(shipped(count=3)), make_plan(load_recipe("paper"))
    assert list(plan.rigs) == [RECIPE_RIG, "r000000", "r000001", "r000002"]
    assert Counter(pair.rig for pair in plan.pairs) == dict.fromkeys(["r000000", "r000001", "r000002"], 29)
    of_paper = {(pair.experiment, pair.target, pair.nominal_stroke_m) for pair in paper.pairs}
    for rig in list(plan.rigs)[1:]:
        seen = {(p.experiment, p.target, p.nominal_stroke_m) for p in plan.pairs if p.rig == rig}
        assert of_paper < seen
        assert len({pose.pose_id for pose in plan.poses if pose.rig == rig}) == 18
    assert len({pair.sample_id for pair in plan.pairs}) == len(plan.pairs) == 3 * 29
    assert all(pair.nominal_rig == RECIPE_RIG for pair in plan.pairs)


def test_a_sample_says_what_was_drawn_and_its_rig_is_that() -> None:
    recipe = shipped(count=2)
    plan = make_plan(recipe)
    for pair in plan.pairs:
        drawn = {name.removeprefix("misalignment."): value for name, value in pair.drawn}
        misalignment = build_misalignment(recipe.misalignment.model_copy(update=drawn))
        assert plan.rigs[pair.rig] == plan.rig.perturbed(misalignment)
        assert pair.stroke_m == pytest.approx(misalignment.stroke_m(pair.nominal_stroke_m), abs=5.1e-10)
        assert pair.tries >= 1


def test_more_rigs_change_none() -> None:
    few, many = make_plan(shipped(count=2)), make_plan(shipped(count=5))
    assert many.pairs[: len(few.pairs)] == few.pairs
    assert all(many.rigs[name] == rig for name, rig in few.rigs.items())
    assert set(few.poses) < set(many.poses)


def test_a_shard_keeps_only_its_rigs() -> None:
    plan = make_plan(shipped(count=2))
    first = shard_plan(plan, "1/2")
    assert set(first.rigs) == {RECIPE_RIG, "r000000"}
    assert {pose.rig for pose in first.poses} == {"r000000"}


@pytest.mark.slow
def test_what_is_drawn_is_what_the_estimator_takes_as_prior() -> None:
    """400 rigs: every parameter's sum of squares over the prior's variance is chi-square, false alarm rate 1e-3 in all.

    Truncation at 4 sigma takes 0.1 % of the variance, far below
    the 7 % that 400 draws can tell; a sigma that is off by a factor of 1.3 is noticed.
    """
    plan = make_plan(shipped(count=400))
    rows = [dict(next(p for p in plan.pairs[29 * k : 29 * k + 1]).drawn) for k in range(400)]
    low, high = scipy.stats.chi2.ppf([5e-4 / 13, 1.0 - 5e-4 / 13], 400)
    checked = 0
    for key in rows[0]:
        name = key.removeprefix("misalignment.")
        total = float(np.sum(np.square([row[key] for row in rows]))) / PRIOR_SIGMA[name] ** 2
        assert low < total < high, name
        assert not low < total * 1.3**2 < high
        assert not low < total / 1.3**2 < high
        checked += 1
    # a sphere has neither an axis nor a rim
    assert checked == len(PRIOR_SIGMA) - len(OF_REVOLVED) == 13


def test_an_impossible_rig_is_drawn_again_and_a_hopeless_one_refused() -> None:
    # the shortest stroke, 0.1 m, vanishes with an offset below -0.1 m: two thirds of the draws
    loose = {"stroke_offset_m": {"uniform": [-0.15, -0.075]}}
    plan = make_plan(shipped(count=20, misalignment=loose))
    tries = [plan.pairs[29 * k].tries for k in range(20)]
    assert max(tries) > 1
    assert min(tries) == 1  # 20 rigs without a possible first draw: (2 / 3)^20 = 3e-4
    assert all(pair.stroke_m > 0.0 for pair in plan.pairs)
    with pytest.raises(RecipeError, match="rig 0 stays impossible in 100 draws"):
        make_plan(shipped(count=1, misalignment={"stroke_offset_m": -0.5}))


def test_faults_are_named() -> None:
    rigs = tomllib.loads(SHIPPED)["rigs"]
    assert "rigs.misalignment: draws nothing" in faults({"rigs": {"count": 2}})
    assert "rigs.count" in faults({"rigs": {**rigs, "count": 0}})
    wild = {"count": 1, "misalignment": {"tilt_x_rad": {"uniform": [0.0, 0.9]}}}
    assert "rigs.misalignment.tilt_x_rad: reaches 0.9" in faults({"rigs": wild})
    loose = {"count": 1, "misalignment": {"tilt_x_rad": {"normal": [0.0, 0.1]}}}
    assert "needs clip" in faults({"rigs": loose})
    misspelt = {"count": 1, "misalignment": {"tilt_z_rad": 0.1}}
    assert "tilt_z_rad" in faults({"rigs": misspelt})
    random = {"stroke_m": {"uniform": [0.3, 0.5]}}
    assert "given together with [random]" in faults({"random": random})
