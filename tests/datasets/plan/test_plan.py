"""Plans: the paper's 25 pairs and 18 poses, stable names, named random streams."""

import csv
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from phibench.datasets.build.spot_task import answer_spot
from phibench.datasets.common.errors import RecipeError
from phibench.datasets.plan.plan import make_plan, pose_name
from phibench.datasets.recipe.load import check_recipe, load_recipe
from phibench.datasets.rooms.room_sources import room_of
from phibench.estimator.geometry import paper_depth
from phibench.scenes.random_streams import generator, seed_32, seed_sequence
from phibench.scenes.rig import POSITIONS

# Tables 1 to 4 of the paper: real depth, baselines (the last of table 1 is printed 1.04; see docs/paper.md).
PAPER = {
    "table1": [(2.18, h) for h in (0.80, 0.90, 1.00, 1.10, 1.20, 1.30, 1.40)],
    "table2": [(3.18, h) for h in (0.30, 0.35, 0.40, 0.425, 0.45, 0.50, 0.60)],
    "table3": [(4.18, h) for h in (0.10, 0.20, 0.25, 0.30, 0.35, 0.40, 0.50)],
    "table4": [(depth_m, 0.425) for depth_m in (1.0, 1.975, 2.95, 3.97)],
}


def test_the_paper_recipe_is_the_papers_tables() -> None:
    plan = make_plan(load_recipe("paper"))
    depths = {target.name: target.depth_m for target in plan.recipe.targets}
    found = [(pair.experiment, depths[pair.target], pair.stroke_m) for pair in plan.pairs]
    assert found == [(table, depth_m, h) for table, rows in PAPER.items() for depth_m, h in rows]
    assert len(found) == 25
    assert len(plan.poses) == 18


def test_the_tables_here_are_the_published_ones() -> None:
    path = Path(paper_depth.__file__).with_name("published.csv")
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    rows = [(f"table{r['table']}", float(r["real_depth_m"]), float(r["baseline_m"])) for r in csv.DictReader(lines)]
    assert rows == [(table, depth_m, h) for table, pairs in PAPER.items() for depth_m, h in pairs]


@pytest.mark.slow
def test_every_spot_of_the_paper_is_seen_and_certified_at_both_ends_of_its_strokes() -> None:
    plan = make_plan(load_recipe("paper"))
    ends = {pair.target: pair for pair in sorted(plan.pairs, key=lambda pair: pair.stroke_m)}
    assert len(ends) == 7
    for pair in ends.values():
        for position in POSITIONS:
            room = room_of(plan.rooms[pair.room])
            answer = answer_spot(plan.view(pair, position), plan.spots[pair.target], room)
            assert answer.truth.cause == "none", pair
            assert answer.certificate is not None
            assert answer.certificate.passed, pair


def test_names_are_stable_and_unique() -> None:
    plan = make_plan(load_recipe("paper"))
    assert plan.pairs[10].sample_id == "table2-d3.180-h0.425"
    assert (plan.poses[0].pose_id, plan.pairs[10].pose_id("down"), plan.pairs[10].pose_id("up")) == (
        *("h0.000", "h0.000", "h0.425"),
    )
    assert Counter(pair.sample_id.casefold() for pair in plan.pairs).most_common(1)[0][1] == 1
    assert {pair.pose_id(p) for pair in plan.pairs for p in POSITIONS} == {pose.pose_id for pose in plan.poses}


@pytest.mark.parametrize(
    ("offset_m", "name"), [(0.0, "h0.000"), (0.4, "h0.400"), (0.1 + 0.2, "h0.300"), (1.23456, "h1.23456")]
)
def test_pose_names(offset_m: float, name: str) -> None:
    assert pose_name(offset_m) == name


def test_strokes_that_share_a_name_are_refused() -> None:
    raw = load_recipe("smoke").model_dump(mode="json", exclude_unset=True)
    raw["experiments"][0]["strokes_m"] = [0.3, 0.1 + 0.2]
    with pytest.raises(RecipeError, match="less than 1 nm"):
        make_plan(check_recipe(raw))


def test_streams_depend_on_names_only() -> None:
    def first(*names: str | int) -> int:
        return int(generator(*names).integers(2**63))

    assert first("a", 0, "b") == first("a", 0, "b")
    names = [
        ("a", "bc"),
        ("ab", "c"),
        ("abc",),
        (1,),
        ("1",),
        (0,),
        ("a", 0),
        ("a", 1),
        ("a", "0"),
        ("a\0b",),
        ("a", "b"),
    ]
    assert len({first(*name) for name in names}) == len(names)


def test_adjacent_seeds_do_not_correlate() -> None:
    draws = np.stack([generator("x", seed, "ambient").standard_normal(4096) for seed in range(8)])
    correlation = np.corrcoef(draws) - np.eye(8)
    assert np.abs(correlation).max() < 6.0 / np.sqrt(4096)  # 28 pairs, 6 sigma each: false alarm 6e-8
    assert len({seed_32("x", seed) for seed in range(1000)}) == 1000
    assert seed_sequence("x").spawn_key == ()


def test_the_seed_changes_every_pose_and_zero_is_legal() -> None:
    raw = load_recipe("paper").model_dump(mode="json", exclude_unset=True)
    plans = [make_plan(check_recipe({**raw, "dataset": {"name": "paper", "seed": seed}})) for seed in (0, 1)]
    seeds = [pose.seed for plan in plans for pose in plan.poses]
    assert len(set(seeds)) == 36
