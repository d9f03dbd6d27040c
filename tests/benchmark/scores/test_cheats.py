"""Cheats on a score: each either gains no rank, or is marked as knowing more than the images.

Honest methods beside them are not marked. Cheats on the files of a score are in tests/benchmark/sealed.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import scipy
from helpers.bench_cases import (
    Cases,
    Oracle,
    at_the_pairs_bound,
    cases,
    constant,
    outcomes,
    records,
    sampler,
    silent,
    truth_itself,
)
from helpers.sandbox_pairs import GOOD, SmallPairs, method_file

from phibench.benchmark.isolation.runner import Harness
from phibench.benchmark.pair_sets.dataset_pairs import dataset_pairs
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.beyond_images import (
    QUANTITIES,
    TESTS,
    TIMES,
    TIMES_FINDING,
    _tried,
    at_least,
    clipped_covariances,
    excesses,
    most_found,
    searched_px2,
)
from phibench.benchmark.scores.metrics import metric_estimates, prepared_records
from phibench.datasets.read import open_finished
from phibench.estimator.interface import Answer, Spot
from phibench.estimator.pair_set import CachedPairs, PairTruth
from phibench.scenes.random_streams import generator

RULES = Rules(resamples=99)


@cache
def pairs(samples: int = 90) -> Cases:
    """Cases whose images are raw: the bound is that of the raw pixels."""

    def raw(s):
        return replace(s, bound_px2=s.raw_bound_px2)

    return Cases(tuple(replace(t, down=raw(t.down), up=raw(t.up)) for t in cases(samples).truths))


@cache
def faint_pairs() -> Cases:
    """The first 15 of 60 pairs have spots of 0.5 to 4.5 sigma, placed to 0.6 px."""
    rng, bound = generator("tests", "faint pairs"), 0.36 * np.eye(2)

    def faint(t: PairTruth) -> PairTruth:
        snr = float(rng.uniform(0.5, 4.5))
        down, up = (replace(s, snr=snr, bound_px2=bound, raw_bound_px2=bound) for s in (t.down, t.up))
        return replace(t, down=down, up=up)

    return Cases(tuple(faint(t) if t.number < 15 else t for t in pairs(60).truths))


def table(oracle: Oracle, of: Cases | None = None) -> pl.DataFrame:
    of = of or pairs()
    return prepared_records(records(of, outcomes(of, oracle), RULES))


def marked(oracle: Oracle, of: Cases | None = None) -> dict[str, str]:
    return {one.quantity: one.part for one in excesses(table(oracle, of))}


def ranks(oracle: Oracle, of: Cases | None = None) -> tuple[float, float]:
    names = ("rank_phi_rad", "rank_depth")
    phi, depth = (
        metric_estimates(table(oracle, of), RULES, "cheats", names=names)[name].estimate.value for name in names
    )
    return phi, depth


HONEST = sampler(1)


def both(honest: Oracle, cheat: Oracle, cheats: object) -> Oracle:
    """The cheat's answers where `cheats` says so of a truth, honest ones elsewhere."""
    return lambda t: (cheat if cheats(t) else honest)(t)  # type: ignore[operator]


# -- knowing the truth -------------------------------------------------------------------------------------------------


def in_one_image(t: PairTruth) -> Answer:
    """Truth in the down image, honest in the up image."""
    return Answer(truth_itself(t).down, HONEST(t).up)


def in_either_image(t: PairTruth) -> Answer:
    """Truth in one image of each pair, in turns."""
    exact, honest = truth_itself(t), HONEST(t)
    return Answer(exact.down, honest.up) if t.number % 2 else Answer(honest.down, exact.up)


def where_a_fit_fails(t: PairTruth) -> bool:
    """One pair in 15, the faintest: there an honest method finds nothing."""
    return t.number % 15 == 7


def third_of_the_bound(t: PairTruth) -> bool:
    """The faintest third."""
    return float(np.trace(t.down.bound_px2)) > float(
        np.quantile([np.trace(x.down.bound_px2) for x in pairs().truths], 0.67)
    )


def own_depth(t: PairTruth) -> Answer:
    """Honest positions with a depth from elsewhere, 0.1 mm beside the truth."""
    return replace(HONEST(t), depth_m=t.depth_m + 1e-4 * (-1) ** t.number)


def own_angle(t: PairTruth) -> Answer:
    """Honest positions with the true angle of the up image."""
    answer = HONEST(t)
    return replace(answer, up=replace(answer.up, phi_rad=t.up.phi_rad["ray"]))


ORACLES: dict[str, tuple[Oracle, set[str]]] = {
    "truth": (truth_itself, {"positions", "phi", "D", "exact answers"}),
    "truth in one image of each pair": (in_one_image, {"positions", "phi", "exact answers"}),
    "truth in either image": (in_either_image, {"exact answers"}),
    "truth where a fit fails": (both(HONEST, truth_itself, where_a_fit_fails), {"exact answers"}),
    "truth with noise": (sampler(2, spread=0.5), {"positions", "phi"}),
    "truth with noise, in the faintest third": (
        both(HONEST, sampler(3, spread=0.2), third_of_the_bound),
        {"positions"},
    ),
    "depth from elsewhere": (own_depth, {"D"}),
    "angle from elsewhere": (own_angle, {"phi", "exact answers"}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ORACLES)
def test_whoever_has_the_truth_in_part_is_marked(name: str) -> None:
    oracle, quantities = ORACLES[name]
    found = marked(oracle)
    assert quantities <= set(found), found


def test_the_part_that_shows_it_is_told() -> None:
    found = marked(both(HONEST, sampler(3, spread=0.2), third_of_the_bound))
    assert found["positions"].endswith("third with the largest bounds")
    assert marked(in_one_image)["positions"].endswith("down images")


@pytest.mark.slow
def test_honest_methods_are_not_marked() -> None:
    """At the bound of each image, of the pair, worse, silent on some, and blind: chance of any 5e-3 at most."""
    for oracle in (sampler(5), at_the_pairs_bound(5), sampler(6, spread=2.0), silent, constant):
        assert not marked(oracle)


# -- finding what nobody can see ---------------------------------------------------------------------------------------


def searching(t: PairTruth) -> Answer:
    """The best search: of M places of pairs the one that looks most like a spot; at the bound where that is right."""
    rng = generator("tests", "searching", t.number)
    places = int(searched_px2(339.0, None) // 36.0)
    s = float(np.hypot(t.down.snr, t.up.snr))
    return HONEST(t) if rng.normal(s) > rng.normal(size=places - 1).max() else silent(t)


def test_finding_every_faint_spot_is_marked_and_the_best_search_is_not() -> None:
    """15 pairs below 5 sigma: a search finds some, an oracle all. Its noise is that of the bound: no error shows it."""
    rows = table(sampler(7, spread=1.3), faint_pairs())
    assert {one.quantity for one in excesses(rows)} == {"faint spots"}
    assert next(one for one in excesses(rows)).pairs <= 15
    assert not marked(searching, faint_pairs())
    found = table(searching, faint_pairs()).filter(pl.col("number") < 15)["detected"].sum() / 2
    assert 1 <= found <= 12
    unknown = rows.with_columns(snr=pl.lit(None, pl.Float64))  # of pictures that were not rendered
    assert excesses(unknown) == []


def test_the_best_search_among_two_places_and_among_many() -> None:
    """Of two places: Phi(s / sqrt 2), in closed form. Of 300: 20 000 draws, four standard errors of 0.0035."""
    s = np.array([0.0, 0.5, 2.0, 4.0])
    assert most_found(s, np.full(4, 72.0)) == pytest.approx(scipy.stats.norm.cdf(s / np.sqrt(2.0)), abs=1e-9)
    assert most_found(s, np.full(4, 36.0)) == pytest.approx(1.0)
    rng = generator("tests", "best search")
    noise = rng.normal(size=(20_000, 299)).max(axis=1)
    for one in (1.0, 2.5, 4.0):
        drawn = float(np.mean(rng.normal(one, size=20_000) > noise))
        assert most_found(np.array([one]), np.array([300 * 36.0]))[0] == pytest.approx(drawn, abs=0.014)
    assert most_found(np.array([3.0]), np.array([1e4]))[0] > most_found(np.array([3.0]), np.array([1e5]))[0]


def test_the_chance_of_so_many_is_that_of_all_cases() -> None:
    """Against the sum over all 2^5 outcomes."""
    p = np.array([0.1, 0.9, 0.35, 0.5, 0.02])
    for k in range(6):
        cases_of = (hits for hits in product((0, 1), repeat=5) if sum(hits) >= k)
        right = sum(float(np.prod(np.where(hits, p, 1.0 - p))) for hits in cases_of)
        assert at_least(k, p) == pytest.approx(right, rel=1e-12)


def test_clipped_covariances_and_the_number_of_tests() -> None:
    """A long covariance keeps its short axis and its directions; chances count as many tests as there are."""
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    given = turn @ np.diag([9.0, 0.04]) @ turn.T
    cut = clipped_covariances(np.stack([given, np.full((2, 2), np.nan)]))
    assert cut[0] == pytest.approx(turn @ np.diag([0.5, 0.04]) @ turn.T, rel=1e-12)
    assert np.isnan(cut[1]).all()
    tried = list(_tried(table(HONEST)))
    assert len(tried) == TESTS + 1
    assert TESTS / TIMES + 1.0 / TIMES_FINDING == 1.0
    assert {one.quantity for one in tried} == set(QUANTITIES)


# -- time --------------------------------------------------------------------------------------------------------------


class Told(Cases):
    """Pairs that tell what is asked for."""

    def pair(self, number):
        self.asked.append(("pair", number))
        return super().pair(number)

    def truth(self, number):
        self.asked.append(("truth", number))
        return super().truth(number)


def told(asked: list[tuple[str, int]]) -> Told:
    made = Told(pairs(60).truths)
    object.__setattr__(made, "asked", asked)
    return made


def test_a_truth_is_made_when_its_pair_is_answered_and_before_the_next_one() -> None:
    """Bounds take 1 s longer where both spots are seen: a method would know by the clock which spot is hidden."""
    asked: list[tuple[str, int]] = []
    first = CachedPairs(told(asked))
    second = CachedPairs(first._pairs, first)
    for number in (0, 1):
        first.pair(number)
    assert asked == [("pair", 0), ("pair", 1)]  # the second is made while the first is looked at
    first.answered(0)
    first.pair(2)
    assert asked[2:] == [("truth", 0), ("pair", 2)]
    for number in (2, 1):
        first.answered(number)
    second.pair(3)
    assert asked[4:] == [("truth", 2), ("truth", 1), ("pair", 3)]
    assert first.late_seconds == second.late_seconds == 0.0
    assert second.truth(3) is second.truth(3)
    assert second.pair(3) is second.pair(3)
    assert asked[7:] == [("truth", 3)]
    assert second.late_seconds > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2, 3])
def test_no_truth_is_made_while_its_pair_is_looked_at(workers: int, tmp_path: Path) -> None:
    """In a run: the method says when it answers, and the set when a truth is begun."""
    body = "import time\ntime.sleep(0.05 * (pair.number % 3))\nprint(time.monotonic())\nreturn " + GOOD
    made: dict[int, float] = {}

    class Timed(SmallPairs):
        def truth(self, number):
            made[number] = time.monotonic()
            return pairs(20).truth(number)

    held = CachedPairs(Timed(20))
    with Harness([method_file(tmp_path, body)], workers=workers) as harness:
        ended = [float(outcome.output) for (outcome,) in harness.outcomes(held, range(20))]
    assert len(made) >= 20 - workers - 1  # those of the last pairs are made late
    assert all(made[number] > ended[number] for number in made)


def test_the_order_of_pairs_is_that_of_a_stream(bench_dataset: Path) -> None:
    """Whoever counts pairs learns nothing of sample or preset: their order is drawn."""
    order = dataset_pairs(open_finished(bench_dataset)).pair_draws
    names = [(one.sample_id, one.preset) for one in order]
    assert len(set(names)) == len(names) == 9
    assert names != sorted(names)
    assert [one.number for one in order] == list(range(9))


# -- cheats that know nothing ------------------------------------------------------------------------------------------


def silent_on_faint(t: PairTruth) -> Answer:
    return silent(t) if third_of_the_bound(t) else HONEST(t)


def one_image_only(t: PairTruth) -> Answer:
    return Answer(HONEST(t).down, Spot.missing("not asked"))


def of_two_candidates(t: PairTruth) -> Answer:
    """A guess between the spot and a place far from it."""
    guess = Spot((t.down.uv_px[0] + 40.0, t.down.uv_px[1]))
    return HONEST(t) if t.number % 2 else Answer(guess, guess)


def claiming(factor: float) -> Oracle:
    return sampler(1, claim=factor)


def box_centre(t: PairTruth) -> Answer:
    """Centre of a box of 64 px, in which the spot is anywhere."""
    rng = generator("tests", "box centres", t.number)
    places = (np.array(s.uv_px) + rng.uniform(-28.0, 28.0, 2) for s in (t.down, t.up))
    return Answer(*(Spot((float(u), float(v))) for u, v in places))


def constant_depth(t: PairTruth) -> Answer:
    """The best constant of the set, which only its truth tells."""
    inverse = np.array([1.0 / x.depth_m for x in pairs().truths])
    return replace(silent(t), depth_m=float(inverse.sum() / (inverse**2).sum()))


GAINLESS: dict[str, Oracle] = {
    "silence on faint spots": silent_on_faint,
    "one image only": one_image_only,
    "two candidates": of_two_candidates,
    "huge covariances": claiming(1e6),
    "tiny covariances": claiming(1e-6),
    "a constant place": constant,
    "a constant depth": constant_depth,
    "centres of boxes": box_centre,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", GAINLESS)
def test_a_cheat_that_knows_nothing_gains_no_rank(name: str) -> None:
    """No rank is below the honest one; constants and box centres are no better than silence."""
    found, honest, nothing = ranks(GAINLESS[name]), ranks(HONEST), ranks(silent)
    assert min(found[k] - honest[k] for k in range(2)) >= -1e-12
    if GAINLESS[name] in (constant, constant_depth, box_centre):
        assert min(found[k] - nothing[k] for k in range(2)) >= -1e-12


def test_claims_change_no_position_and_no_rank() -> None:
    """What a huge or tiny covariance changes is seen in pulls and in the share beyond 5 sigma."""
    names = ("pull_rms", "beyond_5_sigma")
    huge, tiny = (metric_estimates(table(claiming(x)), RULES, "cheats", names=names) for x in (1e6, 1e-6))
    assert huge["pull_rms"].estimate.value < 0.01
    assert tiny["beyond_5_sigma"].estimate.value > 0.99
    assert ranks(claiming(1e6)) == ranks(claiming(1e-6)) == ranks(HONEST)
