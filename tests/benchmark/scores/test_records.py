"""Records of a score: each column against a calculation by other means, and every rule of null."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from helpers.bench_cases import RIG, Cases, cases, change, outcomes, records, sampler, shifted, truth_itself
from helpers.oracles import random_rig, true_pixel
from scipy.linalg import cholesky, solve_triangular

from phibench.benchmark.scores.answer_errors import MATCH_PX, Rules, phi_of, with_kept_results
from phibench.benchmark.scores.record_columns import COLUMNS, COUNTED
from phibench.benchmark.scores.records import record_table, with_missed
from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.phi import CONVENTIONS, outline_circle
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.interface import Answer, Outcome, Spot

RULES = Rules()
NOTHING = Spot.missing("no light")
ALONE = RULES.least_missed_relative
"""What a miss costs in a set of one depth, whose best constant has no error."""


def one(answer, truth=None, **changes):
    """Rows "down" and "up" of one pair."""
    truth = replace(truth or cases(1).truths[0], **changes)
    table = records(Cases((truth,)), [Outcome(0, answer, 0.5)], RULES)
    return table.row(0, named=True), table.row(1, named=True)


def test_pulls_are_the_triangular_solution_and_give_the_mahalanobis_distance():
    pairs = cases(30)
    answers = outcomes(pairs, sampler(claim=1.7))
    table = records(pairs, answers, RULES)
    checked = 0
    for row in table.iter_rows(named=True):
        C = np.array(getattr(answers[row["number"]].answer, row["image"]).covariance_px2)
        e = np.array([row["du_px"], row["dv_px"]])
        expected = solve_triangular(cholesky(C, lower=True), e, lower=True)
        assert [row["pull_u"], row["pull_v"]] == pytest.approx(expected, rel=1e-9)
        assert row["mahalanobis2"] == pytest.approx(e @ np.linalg.inv(C) @ e, rel=1e-9)
        checked += 1
    assert checked == 60


def test_a_depth_is_within_its_own_interval_or_within_1_96_sigma():
    truth = cases(1).truths[0]
    down, up, D = Spot(truth.down.uv_px), Spot(truth.up.uv_px), truth.depth_m
    for answer, expected in (
        (Answer(down, up, D + 0.1, 0.01), False),
        (Answer(down, up, D + 0.1, 0.06), True),
        (Answer(down, up, D + 0.1, 0.01, (D - 0.01, D + 0.2)), True),
        (Answer(down, up, D + 0.1, 0.06, (D + 0.01, D + 0.2)), False),
        (Answer(down, up, D + 0.1), None),
    ):
        assert one(answer)[0]["depth_within"] is expected


@pytest.mark.parametrize(
    "claim",
    [
        ((0.0, 0.0), (0.0, 0.0)),
        ((-1.0, 0.0), (0.0, -1.0)),  # determinant above 0
        ((1.0, 2.0), (2.0, 1.0)),
        ((1.0, 0.5), (0.2, 1.0)),
        ((float("nan"), 0.0), (0.0, 1.0)),
        ((float("inf"), 0.0), (0.0, 1.0)),
    ],
)
def test_a_covariance_that_is_none_gives_no_pull(claim):
    truth = cases(1).truths[0]
    down, _ = one(Answer(Spot(truth.down.uv_px, claim), NOTHING))
    assert (down["pull_u"], down["pull_v"], down["mahalanobis2"]) == (None, None, None)
    assert down["detected"]


def test_the_method_s_own_phi_is_compared_in_its_own_sense_and_in_units_of_ray():
    """0.01 px outwards is the same error in every sense: that of phi_ray, to the curvature (0.01 / 339 px, 1e-3)."""
    t = cases(1).truths[0]
    view, centre = RIG.at(0.0), outline_circle(RIG)[0]
    uv = np.array(t.down.uv_px)
    moved = uv + 0.01 * (uv - centre) / np.linalg.norm(uv - centre)
    expected = float(CONVENTIONS["ray"](view, moved)) - t.down.phi_rad["ray"]
    assert abs(expected) > 1e-5
    for convention, phi in CONVENTIONS.items():
        answer = Spot(t.down.uv_px, None, float(phi(view, moved)), convention)
        down, up = one(Answer(answer, Spot(t.up.uv_px)))
        assert down["phi_convention"] == convention
        assert down["phi_error_rad"] == pytest.approx(expected, rel=1e-3)
        assert (up["phi_convention"], abs(up["phi_error_rad"]) < 1e-12) == ("ray", True)


def test_a_phi_in_the_wrong_sense_is_an_error():
    t = cases(1).truths[0]
    down, _ = one(Answer(Spot(t.down.uv_px, None, t.down.phi_rad["normal"], "ray"), NOTHING))
    assert abs(down["phi_error_rad"]) > 0.01


def test_the_method_s_own_depth_counts_before_the_pixels():
    t = cases(1).truths[0]
    down, up = one(
        Answer(Spot(t.down.uv_px), Spot(t.up.uv_px), depth_m=1.1 * t.depth_m, sigma_depth_m=0.05 * t.depth_m)
    )
    assert down["depth_from"] == "method"
    assert down["depth_relative"] == pytest.approx(0.1)
    assert down["depth_pull"] == pytest.approx(2.0)
    assert up["depth_error_m"] == down["depth_error_m"]
    alone, _ = one(Answer(Spot(t.down.uv_px), Spot(t.up.uv_px), depth_m=0.9 * t.depth_m))
    assert (alone["depth_found"], alone["depth_from"]) == (True, "method")
    assert alone["depth_counted"] == pytest.approx(0.1)
    assert alone["depth_sigma_m"] is None


def test_a_depth_without_two_found_spots_is_not_found():
    t = cases(1).truths[0]
    for down, up in ((NOTHING, NOTHING), (Spot(t.down.uv_px), NOTHING), (NOTHING, Spot(t.up.uv_px))):
        row, _ = one(Answer(down, up, depth_m=0.9 * t.depth_m))
        assert (row["depth_found"], row["depth_counted"]) == (False, ALONE)
        assert row["rank_depth2"] == pytest.approx(ALONE**2)


def test_a_depth_beside_a_false_detection_is_not_found():
    t = cases(1).truths[0]
    off = (t.up.uv_px[0] + 20.0, t.up.uv_px[1])
    down, up = one(Answer(Spot(t.down.uv_px), Spot(off), depth_m=t.depth_m))
    assert (down["depth_found"], down["depth_counted"]) == (False, ALONE)
    assert (up["false_detection"], up["missed"], up["counted_px"]) == (True, True, MATCH_PX)


def test_a_depth_that_is_off_by_more_than_itself_counts_as_missed():
    t = cases(1).truths[0]
    down, _ = one(Answer(Spot(t.down.uv_px), Spot(t.up.uv_px), depth_m=5.0 * t.depth_m))
    assert (down["depth_found"], down["depth_counted"]) == (True, ALONE)
    assert down["depth_relative"] == pytest.approx(4.0)
    below, _ = one(Answer(Spot(t.down.uv_px), Spot(t.up.uv_px), depth_m=-1.0))
    assert not below["depth_found"]


def test_a_spot_that_is_not_visible_can_only_be_falsely_detected():
    t = change(cases(1).truths[0], "up", visible=False, cause="occluded:table")
    down, up = one(truth_itself(t), t)
    assert (down["detected"], up["detected"], up["missed"], up["false_detection"]) == (True, False, False, True)
    assert up["counted_px"] is None
    assert (down["pair_visible"], down["depth_found"], down["depth_counted"]) == (False, False, None)
    _, quiet = one(Answer(Spot(t.down.uv_px), NOTHING), t)
    assert not quiet["false_detection"]
    assert quiet["status"] == "no light"
    lost = change(t, "up", uv_px=(np.nan, np.nan), phi_rad={}, bound_px2=None, raw_bound_px2=None)
    _, none = one(Answer(Spot(t.down.uv_px), Spot((600.0, 300.0))), lost)
    assert none["false_detection"]
    for name in ("u_true_px", "du_px", "radial_px", "distance_px", "phi_error_rad", "bound_px2", "bayer"):
        assert none[name] is None, name


@pytest.mark.parametrize(
    ("answers", "depth_m", "false", "squares"),
    [
        ((True, False), None, False, 0.0),  # the honest one
        ((False, False), None, False, 0.0),
        ((True, True), None, True, 1.0),
        ((True, False), 2.0, True, 1.0),  # a D that only a guess can give
        ((False, False), 2.0, True, 1.0),
    ],
)
def test_any_number_for_a_hidden_spot_is_false(
    answers: tuple[bool, bool], depth_m: float | None, false: bool, squares: float
) -> None:
    """Squares that the rank by D sums, in units of that of a missed pair."""
    t = change(cases(1).truths[0], "up", visible=False, cause="occluded:table")
    spots = [Spot(s.uv_px) if given else NOTHING for s, given in zip((t.down, t.up), answers, strict=True)]
    table = record_table([t], [Outcome(0, Answer(*spots, depth_m=depth_m), 0.01)], RULES)
    counted = with_missed(table, 0.4)
    assert counted["pair_false"].to_list() == [false, false]
    assert counted["rank_depth2"].to_list() == pytest.approx([0.16 * squares] * 2)
    shown = change(t, "up", visible=True, cause="none")
    own = Answer(Spot(t.down.uv_px), Spot(t.up.uv_px), depth_m=t.depth_m)
    assert not record_table([shown], [Outcome(0, own, 0.01)], RULES)["pair_false"].any()


def test_a_status_other_than_ok_takes_the_position_back():
    t = cases(1).truths[0]
    down, _ = one(Answer(Spot(t.down.uv_px, status="not sure"), NOTHING))
    assert (down["u_px"], down["missed"], down["status"]) == (None, True, "not sure")


@pytest.mark.parametrize("distance", [MATCH_PX, np.nextafter(MATCH_PX, 4.0)])
def test_three_pixels_are_the_edge(distance):
    t = change(cases(1).truths[0], "down", uv_px=(512.0, 256.0))  # so that the sum below is exact
    down, _ = one(Answer(Spot((512.0, 256.0 + distance)), NOTHING), t)
    assert down["detected"] == (down["dv_px"] <= MATCH_PX)
    assert down["false_detection"] != down["detected"]


def test_a_method_that_did_not_come_back_has_missed():
    t = cases(1).truths[0]
    table = records(Cases((t,)), [Outcome(0, None, float("nan"), "timeout", "30 s")], RULES)
    assert table["missed"].all()
    assert table["status"].to_list() == ["timeout"] * 2
    assert table["seconds"].is_null().all()
    assert table["failure"].to_list() == ["timeout"] * 2


def test_each_pair_is_measured_with_its_own_rigs():
    """Nominal and true rig differ from pair to pair: positions are right, D is what the nominal rig makes of them."""
    rng = np.random.default_rng(3)
    truths = []
    for number in range(12):
        rig, spot = random_rig(rng), np.array([2.0, rng.uniform(-1, 1), 0.5])
        uv = [true_pixel(rig, h, spot) for h in (0.0, 0.5)]
        depth = float(np.linalg.norm(spot[:2] - rig.at(0.0).sphere_centre_m[:2]))
        t = replace(cases(1).truths[0], number=number, sample_id=str(number), depth_m=depth, stroke_m=0.5)
        nominal = rig if number % 2 else RIG
        t = replace(t, true_rig=rig, nominal_rig=nominal)
        for p, x in zip(("down", "up"), uv, strict=True):
            t = change(t, p, uv_px=tuple(float(v) for v in x))
        truths.append(t)
    pairs = Cases(tuple(truths))
    table = records(pairs, outcomes(pairs, shifted(0.01)), RULES).filter(pl.col("image") == "down")
    assert table["number"].to_list() == list(range(12))
    own = table["depth_relative"].to_numpy()
    for t, relative in zip(truths, own, strict=True):
        uv = [np.array(getattr(t, p).uv_px) + [0.01, 0.0] for p in ("down", "up")]
        expected = float(depth_exact(t.nominal_rig, 0.5, *uv).depth_m) / t.depth_m - 1.0
        assert relative == pytest.approx(expected, abs=1e-12)
    assert np.abs(own[1::2]).max() < 0.01 < np.abs(own[0::2]).min()
    for t, row in zip(truths, table.iter_rows(named=True), strict=True):
        centre = outline_circle(t.true_rig)[0]
        assert row["from_centre_px"] == pytest.approx(np.linalg.norm(np.array(t.down.uv_px) - centre), rel=1e-12)


def test_no_sense_of_phi_hides_what_the_nominal_rig_gets_wrong():
    """Attack: angles in the sense "outline", right through the true rig, while the nominal rig is 5 px off."""
    t = cases(1).truths[0]
    camera = replace(RIG.camera, cx_px=RIG.camera.cx_px + 5.0)
    wrong = replace(t, nominal_rig=replace(RIG, camera=camera))
    spots = [getattr(t, p) for p in ("down", "up")]
    own = Answer(
        *(Spot(s.uv_px, None, float(phi_of("outline", RIG, np.array([s.uv_px]))[0]), "outline") for s in spots)
    )
    for plain, cheating in zip(one(truth_itself(t), wrong), one(own, wrong), strict=True):
        assert cheating["phi_convention"] == "outline"
        assert cheating["phi_error_rad"] == pytest.approx(0.0, abs=1e-12)
        assert cheating["rank_phi2_rad2"] == plain["rank_phi2_rad2"] > 1e-6


@pytest.mark.parametrize(
    ("uv", "name"),
    [
        ((10.0, 20.0), "red"),
        ((10.49, 19.51), "red"),
        ((11.0, 20.0), "green in red row"),
        ((10.0, 21.0), "green in blue row"),
        ((10.51, 20.51), "blue"),
        ((-0.4, 0.4), "red"),
    ],
)
def test_the_bayer_cell_is_that_of_the_pixel_that_holds_the_spot(uv, name):
    down, _ = one(Answer(NOTHING, NOTHING), change(cases(1).truths[0], "down", uv_px=uv))
    assert down["bayer"] == name


def test_columns_are_as_described_and_hold_no_nan():
    pairs = cases(5)
    table = records(pairs, outcomes(pairs, truth_itself), RULES)
    assert table.columns == [*COLUMNS, *COUNTED]
    assert all([*COLUMNS.values(), *COUNTED.values()])
    assert not any(table[name].is_nan().any() for name in table.columns if table.schema[name] == pl.Float64)
    assert table["jpeg_quality"].dtype == pl.Int64
    empty = records(Cases((replace(pairs.truths[0], jpeg_quality=None),)), [Outcome(0, None, 1.0, "crash")], RULES)
    assert empty.schema == table.schema  # so that tables of several runs can be put together


def test_order_of_outcomes_does_not_matter():
    pairs = cases(8)
    answers = outcomes(pairs, sampler())
    assert records(pairs, answers, RULES).equals(records(pairs, answers[::-1], RULES))


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ([0, 0], "pair 0 has several outcomes"),
        ([0, 5], "the set has 2 pairs"),
        ([-1], "the set has 2 pairs"),
        ([], "no pairs"),
    ],
)
def test_outcomes_that_belong_to_no_pair_are_refused(numbers, words):
    with pytest.raises(DatasetError, match=words):
        records(cases(2), [Outcome(n, None, 1.0, "error") for n in numbers], RULES)


@pytest.mark.parametrize(
    "changes",
    [
        {"match_px": 0.0},
        {"confidence": 1.0},
        {"resamples": 10},
        {"least_samples": 1},
        {"missed_relative": -1.0},
        {"missed_relative": 0.05},  # below the least
        {"least_compared": 1},
        {"missed_phi_rad": 0},
    ],
)
def test_rules_without_sense_are_refused(changes):
    with pytest.raises(DatasetError, match=next(iter(changes))):
        Rules(**changes)


def test_kept_results_are_those_of_equal_arguments_and_cannot_be_changed():
    calls = []

    @with_kept_results
    def total(name, values):
        calls.append(name)
        return values.sum(axis=0) + len(name)

    values = np.arange(6.0).reshape(2, 3)
    first = total("a", values)
    assert first is total("a", values.copy())
    assert first.tolist() == [4.0, 6.0, 8.0]
    assert total("bb", values).tolist() == [5.0, 7.0, 9.0]
    assert total("a", values.reshape(3, 2)).tolist() == [7.0, 10.0]
    values[0, 0] = 1.0
    assert total("a", values).tolist() == [5.0, 6.0, 8.0]
    assert calls == ["a", "bb", "a", "a"]
    with pytest.raises(ValueError, match="read-only"):
        first[0] = 0.0


def test_records_are_the_same_after_another_method():
    """Rigs and truths of a pair each, as drawn ones have: what is kept from one method is the next one's, too."""
    pairs = cases(6)
    few = [Cases((one,)) for one in pairs.truths]
    tables = []
    for make in (sampler(claim=1.7), shifted(0.3), sampler(claim=1.7)):
        answers = outcomes(pairs, make)
        tables.append([record_table(part.truths, [answers[k]], RULES) for k, part in enumerate(few)])
    assert all(a.equals(b) for a, b in zip(tables[0], tables[2], strict=True))
    assert not any(a.equals(b) for a, b in zip(tables[0], tables[1], strict=True))
