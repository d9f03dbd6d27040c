"""A cheat that has learnt the rooms of bench-dev gains nothing on bench-test, and much where the room is the same.

The cheat takes D of the spot of bench-dev that is nearest in azimuth and in phi of the down image. That phi alone tells
something of D in any room is no cheat: the floor lies below. So the cheat is compared with itself after the rooms of
bench-test were turned, each by an angle of its own. A room stands at any angle to the robot with the same chance. The
law of a turned set is that of the set, unless the cheat knows the rooms: the test is exact. It calls a cheat that knows
nothing a gain with a chance of `FALSE_ALARM`. Nothing is rendered: truth follows from the plan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from phibench.datasets.plan.draws import draw_rooms
from phibench.datasets.plan.plan import Plan, make_plan
from phibench.datasets.plan.sampling import HIDDEN
from phibench.datasets.recipe.load import load_recipe
from phibench.datasets.recipe.tables import Recipe
from phibench.datasets.rooms.room_sources import room_of
from phibench.render.optics.truth import depth_m, spot_truth
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import generator

TURNS = 1999
FALSE_ALARM = 1e-3
PHI_SCALE = 3.0  # a radian of phi counts as so many of azimuth: phi runs over 0.5 rad where azimuth runs over 6


@dataclass(frozen=True)
class Known:
    """What the cheat sees of n samples (azimuth and phi of the down image), their D and their rooms, shape (n,)."""

    azimuth_rad: Array
    phi_rad: Array
    depth_m: Array
    room: Array


def known(plan: Plan) -> Known:
    """Truth of the samples that both images show: on the others no D is asked for."""
    rows = []
    for pair in plan.pairs:
        if dict(pair.drawn).get("spot.hidden") == HIDDEN:
            continue
        view, spot = plan.rigs[pair.rig].at(0.0), plan.spots[pair.spot]
        truth = spot_truth(view, spot, ())
        D = float(depth_m(np.array(spot.position_world_m), view.sphere_centre_m))
        rows.append((truth.azimuth_rad, truth.phi_ray_rad, D, list(plan.rooms).index(pair.room)))
    columns = np.array(rows).T
    return Known(*columns[:3], columns[3].astype(int))


def errors(learnt: Known, asked: Known, turn_rad: Array) -> Array:
    """Squared error of log D of each asked sample, its room turned by an angle, shape (n,)."""
    azimuth = (asked.azimuth_rad + turn_rad[asked.room])[:, None] - learnt.azimuth_rad
    across = np.abs((azimuth + np.pi) % (2.0 * np.pi) - np.pi)
    nearest = np.argmin(across**2 + (PHI_SCALE * (asked.phi_rad[:, None] - learnt.phi_rad)) ** 2, axis=1)
    return np.asarray(np.log(learnt.depth_m[nearest] / asked.depth_m) ** 2)


def gain_of_the_cheat(name: str, learnt: Known, asked: Known) -> tuple[float, float, float, float]:
    """Part of the mean squared error that knowing the rooms takes away, its 95 % interval, and the chance of as much.

    The interval resamples rooms.
    """
    rng, rooms = generator("known rooms", name), int(asked.room.max()) + 1
    still = errors(learnt, asked, np.zeros(rooms))
    turned = [errors(learnt, asked, rng.uniform(0.0, 2.0 * np.pi, rooms)) for _ in range(TURNS)]
    blind = np.mean(turned, axis=0)
    chance = (1.0 + sum(one.mean() <= still.mean() for one in turned)) / (1.0 + TURNS)
    by_room = np.array([[x[asked.room == room].sum() for x in (still, blind)] for room in range(rooms)])
    sums = by_room[rng.integers(0, rooms, (TURNS, rooms))].sum(axis=1)
    low, high = np.quantile(1.0 - sums[:, 0] / sums[:, 1], [0.025, 0.975])
    gain = float(1.0 - still.mean() / blind.mean())
    constant = np.sqrt(np.mean(np.log(asked.depth_m / np.exp(np.log(learnt.depth_m).mean())) ** 2))
    print(
        f"{name}, {len(still)} samples in {rooms} rooms: rms error of log D {np.sqrt(still.mean()):.3f}, rooms turned "
        f"{np.sqrt(blind.mean()):.3f}, best constant {constant:.3f}; gain {gain:.3f} [{low:.3f}, {high:.3f}], "
        f"chance {chance:.4f}"
    )
    return gain, float(low), float(high), chance


def subset(name: str, samples: int | None, rooms: int | None) -> Recipe:
    recipe = load_recipe(name)
    assert recipe.random is not None
    few = {} if samples is None else {"random": recipe.random.model_copy(update={"samples": samples})}
    if rooms is not None:
        assert recipe.rooms is not None
        few["rooms"] = recipe.rooms.model_copy(
            update={"count": rooms - 2, "exported_panoramas": 1, "exported_meshes": 1}
        )
    return recipe.model_copy(update=few)


def planned(name: str, samples: int | None, rooms: int | None) -> tuple[Plan, set[str]]:
    """Plan of some of a recipe's samples, and the digests of the last rooms, which are kept."""
    plan = make_plan(subset(name, samples, rooms))
    return plan, {room_of(source).digest for source in list(plan.rooms.values())[-3:]}


@pytest.mark.slow
def test_the_cheat_gains_where_the_room_is_the_same() -> None:
    """Boards in one room, as before version 3: the same cheat, and other samples of the same recipe."""
    recipe = load_recipe("random")
    assert recipe.random is not None
    plans = [
        make_plan(
            recipe.model_copy(
                update={
                    "dataset": recipe.dataset.model_copy(update={"seed": seed}),
                    "random": recipe.random.model_copy(update={"samples": 200}),
                }
            )
        )
        for seed in (0, 1)
    ]
    asked = known(plans[1])
    each = replace(asked, room=np.arange(len(asked.room)))  # turned by itself: azimuths are drawn one by one, too
    gain, *_, chance = gain_of_the_cheat("one plain room", known(plans[0]), each)
    assert gain > 0.8
    assert chance <= FALSE_ALARM


@pytest.mark.slow
def test_no_room_of_one_set_is_in_the_other_and_the_cheat_gains_nothing() -> None:
    """Three rooms of each, one a kind; all 240 by their sources."""
    sources = [set(draw_rooms(load_recipe(name)).values()) for name in ("bench-dev", "bench-test")]
    assert [len(one) for one in sources] == [120, 120]
    assert not sources[0] & sources[1]
    (dev, rooms_dev), (test, rooms_test) = (planned(name, 24, 3) for name in ("bench-dev", "bench-test"))
    assert len(rooms_dev) == len(rooms_test) == 3
    assert not rooms_dev & rooms_test
    *_, chance = gain_of_the_cheat("three rooms", known(dev), known(test))
    assert chance > FALSE_ALARM


@pytest.mark.slow
def test_the_cheat_gains_nothing_in_all_rooms() -> None:
    """500 samples in 120 rooms of each set. Were the rooms the same, the cheat would gain: the third line."""
    dev, test = (known(make_plan(load_recipe(name))) for name in ("bench-dev", "bench-test"))
    gain, low, high, chance = gain_of_the_cheat("bench-dev to bench-test", dev, test)
    assert chance > FALSE_ALARM
    assert low < 0.0 < high or gain < 0.0
    assert high < 0.2
