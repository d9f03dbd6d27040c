"""Known answers: methods that hold the truth, whose score can be said beforehand."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from helpers.bench_cases import (
    RIG,
    Cases,
    cases,
    change,
    constant,
    outcomes,
    records,
    sampler,
    scaled,
    shifted,
    silent,
    swapped,
    truth_itself,
)
from scipy.optimize import minimize_scalar

from phibench.benchmark.scores.answer_errors import MATCH_PX, Rules
from phibench.benchmark.scores.metrics import METRICS, metric_estimates, prepared_records
from phibench.benchmark.scores.record_columns import COLUMNS, COUNTED
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.estimator.interface import Answer, Spot

RULES = Rules(resamples=999)


def score(pairs, oracle):
    table = records(pairs, outcomes(pairs, oracle), RULES)
    return table, metric_estimates(prepared_records(table), RULES, "tests")


def value(measured, name):
    return measured[name].estimate.value


def test_truth_has_no_error():
    table, m = score(cases(), truth_itself)
    assert len(table) == 400
    assert table.columns == [*COLUMNS, *COUNTED]
    assert value(m, "detection_rate") == 1.0
    assert value(m, "false_rate") == 0.0
    # positions are copied, and phi and D of two closed forms agree: 1e-12 rad, 1e-11 of D (rays 0.1 rad apart amplify)
    assert value(m, "rms_px") == 0.0
    assert value(m, "rms_phi_rad") < 1e-12
    assert value(m, "rms_depth_relative") < 1e-11
    assert value(m, "efficiency_px") == np.inf
    assert m["efficiency_px"].estimate.note == "infinite"
    assert np.isnan(value(m, "pull_deviation"))
    assert m["pull_deviation"].estimate.note == "no covariance claimed"
    assert (m["rms_px"].estimate.low, m["rms_px"].estimate.high) == (0.0, 0.0)
    assert m["rms_px"].estimate.note == "all resamples equal"


def test_half_a_pixel_is_half_a_pixel():
    table, m = score(cases(), shifted(0.5))
    for name in ("bias_u_px", "rms_px", "rms_counted_px", "median_px", "p95_px"):
        assert value(m, name) == pytest.approx(0.5, abs=1e-12), name  # u near 640: eps x 640 = 1.4e-13
    assert value(m, "bias_v_px") == 0.0
    assert value(m, "detection_rate") == 1.0
    # radial part: 0.5 px times the cosine of the image direction, spot by spot
    centre = np.array([RIG.camera.cx_px, RIG.camera.cy_px])
    outward = table.select("u_true_px", "v_true_px").to_numpy() - centre
    cosine = outward[:, 0] / np.linalg.norm(outward, axis=1)
    assert table["radial_px"].to_numpy() == pytest.approx(0.5 * cosine, abs=1e-9)
    assert np.hypot(table["radial_px"], table["tangential_px"]).to_numpy() == pytest.approx(0.5, abs=1e-9)


def test_a_tangential_error_counts_from_u_towards_v():
    pairs = cases(20)
    table = records(pairs, outcomes(pairs, shifted(0.0, 0.5)), RULES)
    right = table.filter(pl.col("u_true_px") - RIG.camera.cx_px > (pl.col("v_true_px") - RIG.camera.cy_px).abs())
    assert len(right) > 2
    assert right["tangential_px"].min() > 0.0


def test_a_scale_of_a_thousandth_is_a_radial_error():
    table, m = score(cases(), scaled(1.001))
    radius = table["from_centre_px"].to_numpy()
    assert table["radial_px"].to_numpy() == pytest.approx(1e-3 * radius, abs=1e-9)
    assert np.abs(table["tangential_px"].to_numpy()).max() < 1e-9
    assert value(m, "rms_px") == pytest.approx(1e-3 * np.sqrt(np.mean(radius**2)), rel=1e-9)
    assert value(m, "bias_radial_px") == pytest.approx(1e-3 * radius.mean(), rel=1e-9)


def test_depth_errors_are_those_of_the_pixels_given():
    """D is that of the exact triangulation of the given pixels, and its sign is estimate minus truth."""
    pairs = cases()
    table = records(pairs, outcomes(pairs, scaled(1.001)), RULES).filter(pl.col("image") == "down")
    for truth, error in zip(pairs.truths[:50], table["depth_error_m"][:50], strict=True):
        centre = np.array([RIG.camera.cx_px, RIG.camera.cy_px])
        down, up = (centre + 1.001 * (np.array(s.uv_px) - centre) for s in (truth.down, truth.up))
        assert error == pytest.approx(
            float(depth_exact(RIG, truth.stroke_m, down, up).depth_m) - truth.depth_m, abs=1e-12
        )


def test_swapped_frames_find_nothing():
    table, m = score(cases(), swapped)
    # the spot moves by more than MATCH_PX from one image to the other
    assert table["distance_px"].min() > MATCH_PX
    assert (value(m, "detection_rate"), value(m, "false_rate"), value(m, "depth_rate")) == (0.0, 1.0, 0.0)
    assert value(m, "rms_counted_px") == MATCH_PX
    assert value(m, "rms_depth_counted") == pytest.approx(best_constant_error(), rel=1e-12)
    assert np.isnan(value(m, "rms_px"))
    assert m["rms_px"].estimate.note == "no spot detected"
    assert table["depth_estimate_m"].is_null().all()  # rays that diverge


def test_a_constant_guess_is_a_false_detection_everywhere():
    _, m = score(cases(), constant)
    assert (value(m, "detection_rate"), value(m, "false_rate"), value(m, "depth_rate")) == (0.0, 1.0, 0.0)
    # Clopper-Pearson of 0 in 200 samples: 1 - 0.025^(1/200)
    assert m["detection_rate"].estimate.high == pytest.approx(1 - 0.025 ** (1 / 200), rel=1e-9)


def test_silence_is_missed_but_not_false():
    _, m = score(cases(), silent)
    assert (value(m, "detection_rate"), value(m, "false_rate")) == (0.0, 0.0)
    assert value(m, "rms_counted_px") == MATCH_PX


def test_a_missed_spot_counts_three_pixels():
    """Half the pairs half a pixel off, half silent: sqrt((0.25 + 9) / 2)."""
    pairs = cases()
    half = shifted(0.5)
    _, m = score(pairs, lambda t: half(t) if t.number % 2 else silent(t))
    assert value(m, "rms_px") == pytest.approx(0.5, abs=1e-12)
    assert value(m, "rms_counted_px") == pytest.approx(np.sqrt((0.25 + MATCH_PX**2) / 2), rel=1e-12)
    assert value(m, "detection_rate") == 0.5
    # a silent pair counts as the best constant; half a pixel is 1 % of D, 1e-3 of that square
    assert value(m, "rms_depth_counted") == pytest.approx(np.sqrt(0.5) * best_constant_error(), rel=1e-2)


# -- what a rank counts --------------------------------------------------------------------------------------------


def blind_depth(t):
    """No position, and the mean depth of a room."""
    return Answer(*(Spot.missing("not looked for") for _ in "12"), depth_m=2.9)


def best_constant_error(depths=None):
    """Relative rms error of the best constant, by search: the oracle of the closed form."""
    d = np.array([t.depth_m for t in cases().truths] if depths is None else depths)
    found = minimize_scalar(lambda c: np.mean((c / d - 1.0) ** 2), bounds=(0.5, 5.0), options={"xatol": 1e-9})
    return float(np.sqrt(found.fun))


def turned(px, quarter):
    """Positions moved by `px` outwards (quarter 0) or across (quarter 1)."""

    def answer(t):
        spots = []
        for s in (t.down, t.up):
            outward = np.array(s.uv_px) - [RIG.camera.cx_px, RIG.camera.cy_px]
            a = outward / np.linalg.norm(outward)
            moved = np.array(s.uv_px) + px * (np.array([-a[1], a[0]]) if quarter else a)
            spots.append(Spot(tuple(moved)))
        return Answer(*spots)

    return answer


def test_a_depth_without_positions_is_no_depth():
    """A guess of 2.9 m is within 50 % of most true depths; it has found nothing, and so counts as silence does."""
    table, guess = score(cases(), blind_depth)
    _, nothing = score(cases(), silent)
    assert (np.abs(table["depth_relative"]) < 0.5).mean() > 0.5
    assert value(guess, "depth_rate") == 0.0
    assert np.isnan(value(guess, "rms_depth_relative"))
    for name in ("rms_depth_counted", "rank_depth"):
        assert value(guess, name) == value(nothing, name) == pytest.approx(best_constant_error(), rel=1e-12)


@pytest.mark.parametrize("wrong", [silent, constant])
def test_a_depth_counts_only_with_two_right_positions(wrong):
    """Down found, up missed or wrong: the exact depth that comes with them does not count."""
    _, m = score(cases(), lambda t: Answer(Spot(t.down.uv_px), wrong(t).up, depth_m=t.depth_m))
    assert (value(m, "detection_rate"), value(m, "depth_rate")) == (0.5, 0.0)
    assert value(m, "rms_depth_counted") == pytest.approx(best_constant_error(), rel=1e-12)
    # with both, it does
    _, m = score(cases(), lambda t: Answer(Spot(t.down.uv_px), Spot(t.up.uv_px), depth_m=t.depth_m))
    assert (value(m, "depth_rate"), value(m, "rank_depth")) == (1.0, 0.0)


def test_the_rank_tells_radial_from_tangential_errors():
    """Both are half a pixel off: the distance in the image ties, phi and D do not."""
    (_, radial), (_, across) = (score(cases(), turned(0.5, quarter)) for quarter in (0, 1))
    for name in ("rms_px", "rms_counted_px"):
        assert value(radial, name) == pytest.approx(value(across, name), abs=1e-12)
    # a tangential error reaches the radius at second order: 0.5^2 / (2 x 100 px), 1/400 of 0.5 px
    assert value(across, "rank_phi_rad") < 0.01 * value(radial, "rank_phi_rad")
    assert value(across, "rank_depth") < 0.1 * value(radial, "rank_depth")


def test_without_missed_and_false_ones_the_rank_is_the_rms():
    _, m = score(cases(), shifted(0.5))
    assert value(m, "rank_phi_rad") == pytest.approx(value(m, "rms_phi_rad"), rel=1e-12)
    assert value(m, "rank_depth") == pytest.approx(value(m, "rms_depth_relative"), rel=1e-12)


def test_a_false_detection_counts_beside_the_missed_spot():
    """A guess costs sqrt(2) times what silence costs; by the distance with missed spots counted they tie."""
    (_, quiet), (_, guess) = (score(cases(), oracle) for oracle in (silent, constant))
    assert value(quiet, "rms_counted_px") == value(guess, "rms_counted_px") == MATCH_PX
    assert value(quiet, "rank_phi_rad") == pytest.approx(RULES.missed_phi_rad, rel=1e-12)
    assert value(guess, "rank_phi_rad") == pytest.approx(np.sqrt(2.0) * RULES.missed_phi_rad, rel=1e-12)
    assert value(guess, "rank_depth") == pytest.approx(np.sqrt(2.0) * best_constant_error(), rel=1e-12)


def test_an_answer_where_nothing_is_to_be_seen_counts():
    """Every second pair hidden in both images: its answers are false, its silences cost nothing.

    Per visible spot one false detection: sqrt(0 + m^2) = m.
    """
    hidden = [
        change(change(t, "down", visible=False, cause="occluded"), "up", visible=False, cause="occluded")
        if t.number % 2
        else t
        for t in cases().truths
    ]
    pairs = Cases(tuple(hidden))
    _, eager = score(pairs, truth_itself)
    _, careful = score(pairs, lambda t: truth_itself(t) if t.down.visible else silent(t))
    assert value(eager, "rank_phi_rad") == pytest.approx(RULES.missed_phi_rad, rel=1e-9)
    seen = [t.depth_m for t in hidden if t.down.visible]
    assert value(eager, "rank_depth") == pytest.approx(best_constant_error(seen), rel=1e-9)
    assert value(careful, "rank_phi_rad") < 1e-12
    assert value(careful, "rank_depth") < 1e-11


def test_no_answer_counts_more_than_none():
    """Right positions with an absurd phi of their own cost what missed spots cost, not more."""
    _, m = score(cases(20), lambda t: Answer(*(Spot(s.uv_px, phi_rad=1.5) for s in (t.down, t.up))))
    assert value(m, "rms_phi_rad") > 10 * RULES.missed_phi_rad
    assert value(m, "rank_phi_rad") == pytest.approx(RULES.missed_phi_rad, rel=1e-12)


def test_every_error_within_three_pixels_counts_less_than_a_missed_spot():
    """3 px outwards, the worst that is still found, on rigs and depths of the shipped recipes: below 20 mrad."""
    table, m = score(cases(), turned(0.999 * MATCH_PX, 0))
    assert value(m, "detection_rate") == 1.0
    assert table["phi_error_rad"].abs().max() < RULES.missed_phi_rad


# -- the ideal sampler ---------------------------------------------------------------------------------------------

DRAWS = 20  # 200 samples x 20 = 4000 pairs, 8000 images
FEW = 5  # for what is off by a fifth or more: deviations are known to 1 %


@pytest.fixture(scope="module")
def ideal():
    return score(cases(200, DRAWS), sampler())


def test_the_ideal_sampler_is_efficient(ideal):
    """Efficiency 1: 8000 squared distances of a law with kurtosis.

    Var(d^2) / E(d^2)^2 is (1 + a^2) 2 / (1 + a)^2 = 1.18 for axes 1 : a = 2.5, and heavier by the spread of the bounds,
    mean(b^2) / mean(b)^2, which is computed: sigma of the rms is half of sqrt(1.18 x that / 8000). Three sigma: one
    false alarm in 370.
    """
    table, m = ideal
    b = table["bound_px2"].to_numpy()
    sigma = 0.5 * np.sqrt(2 * (1 + 2.5**2) / (1 + 2.5) ** 2 * np.mean(b**2) / np.mean(b) ** 2 / len(b))
    assert sigma < 0.015
    assert abs(value(m, "efficiency_px") - 1.0) < 3 * sigma
    assert m["efficiency_px"].estimate.low < 1.0 < m["efficiency_px"].estimate.high
    assert value(m, "efficiency_raw_px") == pytest.approx(value(m, "efficiency_px") / np.sqrt(2), rel=1e-9)


def test_the_ideal_samplers_pulls_are_one(ideal):
    """16 000 standard normal numbers: sigma of their deviation is 1 / sqrt(2 x 16 000) = 0.0056; three sigma."""
    table, m = ideal
    for name in ("pull_deviation", "pull_rms"):
        assert abs(value(m, name) - 1.0) < 3 / np.sqrt(2 * 2 * len(table))
    # Mahalanobis^2 is chi^2 of 2 degrees: mean 2, variance 4
    assert abs(table["mahalanobis2"].mean() - 2.0) < 3 * 2 / np.sqrt(len(table))


def test_the_ideal_samplers_phi_and_depth_are_at_their_bounds(ideal):
    """To first order in the noise. D's squared errors are the most spread: sigma from their own scatter."""
    table, m = ideal
    for name, error, bound in (
        ("efficiency_phi", "phi_error_rad", "bound_phi_rad2"),
        ("efficiency_depth", "depth_error_m", "bound_depth_m2"),
    ):
        rows = table if name == "efficiency_phi" else table.filter(pl.col("image") == "down")
        e2, b2 = rows[error].to_numpy() ** 2, rows[bound].to_numpy()
        sigma = 0.5 * np.sqrt(2 * np.mean(b2**2) / len(b2)) / np.mean(b2)
        assert sigma < 0.04
        assert abs(value(m, name) - 1.0) < 3 * sigma + 0.002  # second order: (0.1 px / 10 px of disparity)^2
        assert abs(np.mean(e2 / b2) - 1.0) < 3 * np.sqrt(2 / len(b2)) + 0.004
    assert abs(value(m, "pull_depth") - 1.0) < 3 / np.sqrt(2 * 4000)


@pytest.mark.slow
@pytest.mark.parametrize(("claim", "expected"), [(1.2**2, 1 / 1.2), (1 / 1.2**2, 1.2)])
def test_a_wrong_covariance_shows_in_the_pull(claim, expected):
    table, m = score(cases(200, FEW), sampler(claim=claim))
    sigma = expected / np.sqrt(2 * 2 * len(table))
    assert abs(value(m, "pull_deviation") - expected) < 3 * sigma
    assert abs(value(m, "pull_deviation") - 1.0) > 10 * sigma  # and the test of the ideal sampler would have said so
    low, high = m["pull_deviation"].estimate.low, m["pull_deviation"].estimate.high
    assert low < expected < high
    assert not low < 1.0 < high


def test_a_noisier_sampler_is_less_efficient():
    """Twice the bound's variance: efficiency 1 / sqrt 2, and the interval excludes 1."""
    _, m = score(cases(200, FEW), sampler(spread=np.sqrt(2.0)))
    assert m["efficiency_px"].estimate.low < np.sqrt(0.5) < m["efficiency_px"].estimate.high
    assert m["efficiency_px"].estimate.high < 0.8


def test_a_biased_method_has_a_pull_rms_above_its_deviation():
    def biased(t):
        answer = sampler()(t)
        move = {p: np.linalg.cholesky(getattr(t, p).bound_px2) @ [1.0, 0.0] for p in ("down", "up")}
        spots = {p: getattr(answer, p) for p in move}
        return type(answer)(*(type(s)(tuple(np.array(s.uv_px) + move[p]), s.covariance_px2) for p, s in spots.items()))

    _, m = score(cases(), biased)
    assert abs(value(m, "pull_deviation") - 1.0) < 3 / np.sqrt(2 * 800)
    assert abs(value(m, "pull_rms") - np.sqrt(1.5)) < 4 / np.sqrt(800)  # half of the components are 1 off


def test_every_metric_has_a_definition_and_every_family_a_reason():
    from phibench.benchmark.scores.metrics import FAMILIES, WHY_EMPTY

    assert set(WHY_EMPTY) == set(FAMILIES) == {metric.family for metric in METRICS.values()}
    assert all(metric.text and metric.unit for metric in METRICS.values())
