"""Bounds of both images together against other mathematics, and the flag of answers that know more than the images."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import polars as pl
import pytest
from helpers.bench_cases import (
    RIG,
    Cases,
    at_the_pairs_bound,
    cases,
    constant,
    knows_boards,
    outcomes,
    point_of,
    records,
    sampler,
    shifted,
    silent,
    slopes_of,
    truth_itself,
)
from scipy.linalg import block_diag

from phibench.benchmark.isolation.method_references import resolve
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.beyond_images import MODEL_MARGIN, RAW_MARGIN, excesses
from phibench.benchmark.scores.metrics import METRICS, PAIR_TWINS, applies, metric_estimates, prepared_records
from phibench.benchmark.scores.score import score_outcomes
from phibench.benchmark.scores.score_document import Flag, MethodCard
from phibench.benchmark.scores.score_tables import leaderboard, scores_csv, scores_json
from phibench.estimator.geometry.least_squares_depth import joint_bound
from phibench.estimator.geometry.phi import estimate_phi
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.methods.registry import KNOWN

RULES = Rules(resamples=199)


@cache
def raw_cases(samples: int = 200, draws: int = 1) -> Cases:
    """Cases whose images are raw: the bound is that of the raw pixels, no model's."""

    def raw(s):
        return replace(s, bound_px2=s.raw_bound_px2)

    return Cases(tuple(replace(t, down=raw(t.down), up=raw(t.up)) for t in cases(samples, draws).truths))


def table(oracle, pairs=None):
    pairs = pairs or raw_cases()
    return prepared_records(records(pairs, outcomes(pairs, oracle), RULES))


def flagged(oracle, pairs=None):
    return {one.quantity: one for one in excesses(table(oracle, pairs))}


# -- the bound ---------------------------------------------------------------------------------------------------------


def test_the_joint_bound_is_that_of_a_point_in_the_room():
    """Other unknowns, x, y, z of the spot, and derivatives by differences of Alhazen's quartic, which is exact.

    Differences over 2e-5 m: 1e-12 px of rounding over slopes of 10 to 500 px/m, 1e-8; the curvature is below that.
    """
    checked = 0
    for t in cases(40).truths:
        J, C = slopes_of(t), block_diag(t.down.bound_px2, t.up.bound_px2)
        of_point = np.linalg.inv(J.T @ np.linalg.inv(C) @ J)
        of_pixels = J @ of_point @ J.T
        outward = np.append((point_of(t) - RIG.at(0.0).sphere_centre_m)[:2] / t.depth_m, 0.0)
        found = joint_bound(RIG, t.stroke_m, np.array(t.down.uv_px), t.depth_m, t.down.bound_px2, t.up.bound_px2)
        assert found.covariance_down_px2 == pytest.approx(of_pixels[:2, :2], rel=1e-5, abs=1e-12)
        assert found.covariance_up_px2 == pytest.approx(of_pixels[2:, 2:], rel=1e-5, abs=1e-12)
        assert float(found.variance_depth_m2) == pytest.approx(outward @ of_point @ outward, rel=1e-5)
        # the constraint gains: four coordinates of three unknowns
        assert np.trace(of_pixels) < 0.95 * np.trace(C)
        free = depth_exact(RIG, t.stroke_m, *(np.array(s.uv_px) for s in (t.down, t.up)), C[:2, :2], C[2:, 2:])
        assert float(found.variance_depth_m2) <= float(free.sigma_m) ** 2 * (1.0 + 1e-9)
        checked += 1
    assert checked == 40


def test_records_have_both_bounds():
    rows = table(truth_itself, cases(20))
    checked = 0
    for t in cases(20).truths:
        J, C = slopes_of(t), block_diag(t.down.bound_px2, t.up.bound_px2)
        of_pixels = J @ np.linalg.inv(J.T @ np.linalg.inv(C) @ J) @ J.T
        for position, part in (("down", slice(0, 2)), ("up", slice(2, 4))):
            row = rows.filter((pl.col("number") == t.number) & (pl.col("image") == position)).row(0, named=True)
            spot = getattr(t, position)
            assert row["pair_bound_px2"] == pytest.approx(np.trace(of_pixels[part, part]), rel=1e-5)
            phi = estimate_phi("ray", RIG.at(0.0), np.array(spot.uv_px), of_pixels[part, part])
            assert row["pair_bound_phi_rad2"] == pytest.approx(float(phi.variance_rad2), rel=1e-5)
            assert row["pair_bound_px2"] < row["bound_px2"]
            assert row["pair_bound_depth_m2"] <= row["bound_depth_m2"] * (1.0 + 1e-9)
            checked += 1
    assert checked == 40


@pytest.mark.slow
def test_a_pair_method_at_its_bound_is_above_1_against_single_images_and_at_1_against_the_pair():
    """200 pairs, whose squares have 3 degrees of freedom and bounds that spread by 1.7: 0.5 sqrt(2 x 1.7 / 400), 0.05.

    Against single images it is above 1 by sqrt(4 / 3), if all coordinates are alike.
    """
    rows = table(at_the_pairs_bound())
    found = metric_estimates(rows, RULES, "tests", names=(*PAIR_TWINS, *PAIR_TWINS.values()))
    for single, pair in PAIR_TWINS.items():
        assert abs(found[pair].estimate.value - 1.0) < 0.15, pair
        assert found[single].estimate.value >= found[pair].estimate.value * (1.0 - 1e-9)
    assert found["efficiency_px"].estimate.value > 1.1 * found["efficiency_pair_px"].estimate.value


def test_a_missing_bound_or_spot_gives_no_pair_bound():
    t = replace(cases(1).truths[0], up=replace(cases(1).truths[0].up, bound_px2=None, raw_bound_px2=None))
    rows = table(truth_itself, Cases((t,)))
    assert rows["pair_bound_px2"].null_count() == 2
    assert rows["possible_depth_m2"].null_count() == 2
    found = metric_estimates(rows, RULES, "tests", names=("efficiency_pair_px",))["efficiency_pair_px"].estimate
    assert found.note == "no bound for these pairs, or none below a third of 3 px"
    assert {one.quantity: one.part.partition(" ")[0] for one in excesses(rows)} == {"positions": "all", "phi": "all"}
    assert not {"D", "faint spots"} & {one.quantity for one in excesses(rows)}  # of the down image alone


# -- what the images cannot tell ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_squares_over_what_is_possible_have_the_law_of_chi2():
    """Both samplers at the smallest possible covariance, 1 / RAW_MARGIN of the bound: means 3, 1, 1.

    500 pairs: sigma of a mean of chi^2 of k degrees is sqrt(2 k / 500). Four sigma.
    """
    pairs = raw_cases(100, 5)
    for oracle in (sampler(spread=1.0 / RAW_MARGIN), at_the_pairs_bound(spread=1.0 / RAW_MARGIN)):
        down = table(oracle, pairs).filter(pl.col("image") == "down")
        assert down["sharp_pair"].all()
        assert down["sharp_depth"].all()
        assert abs(down["possible_position_chi2"].mean() - 3.0) < 4.0 * np.sqrt(6.0 / 500)
        # single images know D and phi a little less well than the pair does
        assert (down["depth_error_m"] ** 2 / down["possible_depth_m2"]).mean() > 1.0 - 4.0 * np.sqrt(2.0 / 500)
        for _, image in table(oracle, pairs).group_by("image"):
            assert image["possible_spot_chi2"].mean() > 2.0 - 4.0 * np.sqrt(4.0 / 500)
            squares = image["phi_error_rad"] ** 2 / image["possible_spot_phi_rad2"]
            assert squares.mean() > 1.0 - 4.0 * np.sqrt(2.0 / 500)


@pytest.mark.slow
def test_methods_at_the_bounds_are_not_flagged():
    """10 runs each of samplers at the bound and at the smallest possible covariance: chance of any 10 x 1e-3."""
    pairs = raw_cases(40)
    for seed in range(10):
        assert not flagged(at_the_pairs_bound(seed), pairs)
        assert not flagged(sampler(seed, spread=1.0 / RAW_MARGIN), pairs)


def test_a_sampler_that_is_too_good_is_flagged():
    """0.8 of the smallest possible rms: 600 degrees of freedom x 0.64 are ten standard deviations below."""
    found = flagged(sampler(spread=0.8 / RAW_MARGIN))
    assert {"positions", "phi"} <= set(found)
    assert found["positions"].ratio == pytest.approx(1.25, rel=0.2)
    # images without a theorem have more room
    assert not flagged(sampler(spread=0.8), cases())
    assert flagged(sampler(spread=0.8 / MODEL_MARGIN), cases())


def test_whoever_reads_the_truth_is_flagged_with_five_pairs():
    found = flagged(truth_itself, raw_cases(5))
    assert {"positions", "phi", "D", "exact answers"} <= set(found)
    assert found["D"].ratio > 1e6


@pytest.mark.slow
def test_whoever_knows_the_boards_is_flagged():
    """The attack of issue 13: no noise is left out, only the plane of each board is known. D falls out exactly."""
    found = flagged(knows_boards())
    assert found["D"].ratio > 50.0
    # what they gain where the bound is that of single images: the table of docs/sealed.md
    names = ("efficiency_px", "efficiency_phi", "efficiency_depth")
    for oracle in (sampler(), at_the_pairs_bound(), knows_boards()):
        gained = metric_estimates(table(oracle), RULES, "tests", names=names)
        print({name: round(gained[name].estimate.value, 2) for name in names})
    assert min(gained[name].estimate.value for name in names) > 1.3
    # also with 30 pairs, and where the bound is that of a model
    assert "D" in flagged(knows_boards(1), raw_cases(30))
    assert "D" in flagged(knows_boards(1), cases(30))


def test_poor_and_silent_methods_are_not_flagged():
    for oracle in (silent, constant, sampler(spread=1.5), sampler(spread=4.0), at_the_pairs_bound(spread=2.0)):
        assert not flagged(oracle)


def test_errors_without_noise_are_flagged():
    """The truth moved by half a pixel: a shift that both images share hardly changes D, and noise would."""
    assert "D" in flagged(shifted(0.5))


@pytest.mark.slow
def test_the_flag_is_in_document_and_tables():
    pairs = raw_cases(30)
    scored = [
        score_outcomes(MethodCard.of(name), pairs, outcomes(pairs, oracle), RULES)
        for name, oracle in (("honest", sampler()), ("cheat", knows_boards()))
    ]
    documents = [one.document for one in scored]
    assert documents[0].flags == []
    assert "D" in [flag.quantity for flag in documents[1].flags]
    board = leaderboard(documents)
    assert {row[0] for row in board.rows} == {"honest", "cheat !"}
    assert "knows more than the images" in board.note
    assert '"flags": [{"quantity"' in scores_json(documents).splitlines()[0]
    assert "D" in scores_csv(documents).splitlines()[1]


def test_a_flag_is_a_sentence_also_without_errors():
    assert (
        "D without error (all pairs, 5;" in Flag(quantity="D", part="all pairs", ratio=None, pairs=5, chance=0.0).text
    )


# -- which bound is whose ----------------------------------------------------------------------------------------------


def test_built_in_methods_say_what_they_see():
    assert [name for name, method in KNOWN.items() if method.joint] == ["joint_fit"]
    assert (resolve("joint_fit").sees, resolve("red_centroid").sees) == ("pair", "image")
    assert MethodCard.of("mine.py:extract").sees == ""
    for single, pair in PAIR_TWINS.items():
        assert {single, pair} <= set(METRICS)
        assert [applies(single, sees) for sees in ("image", "pair", "")] == [True, False, True]
        assert [applies(pair, sees) for sees in ("image", "pair", "")] == [False, True, True]
