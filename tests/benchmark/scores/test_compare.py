"""Paired comparison: known differences, what counts for both, and when it is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.bench_cases import Cases, cases, outcomes, records, sampler, scaled, shifted, silent, truth_itself

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.compare import (
    COMPARED,
    compare,
    compare_records,
    note_on_code,
    note_on_size,
    refuse_different,
)
from phibench.benchmark.scores.metrics import METRICS
from phibench.benchmark.scores.score import score_outcomes
from phibench.benchmark.scores.score_document import MethodCard
from phibench.benchmark.scores.score_files import read_score, write_score
from phibench.datasets.common.errors import DatasetError
from phibench.estimator.interface import Outcome

RULES = Rules(resamples=999)


def table(oracle, pairs=None):
    pairs = pairs or cases()
    return records(pairs, outcomes(pairs, oracle), RULES)


def differences(first, second, stream=0, rules=RULES):
    return {item.name: item for item in compare_records(first, second, rules, "tests", stream)}


def test_a_constant_difference_is_exact():
    found = differences(table(shifted(0.2)), table(shifted(0.5)))
    for name in ("rms_px", "rms_counted_px", "median_px", "p95_px"):
        item = found[name]
        assert item.difference.value == pytest.approx(0.3, abs=1e-12)
        assert item.difference.low == pytest.approx(0.3, abs=1e-9)
        assert (item.first, item.second) == (pytest.approx(0.2), pytest.approx(0.5))
        assert item.better == "first"
    assert found["detection_rate"].better == "no difference shown"
    assert found["seconds"].better == "no difference shown"


def test_the_other_way_round_is_the_other_sign():
    one, other = table(sampler()), table(sampler(seed=1, spread=1.5))
    there, back = differences(one, other), differences(other, one)
    for name in COMPARED:
        assert there[name].difference.value == pytest.approx(-back[name].difference.value, abs=1e-15)
    assert (there["rms_px"].better, back["rms_px"].better) == ("first", "second")


def test_pairing_sees_what_two_intervals_do_not():
    """The same noise, and 1 % more of it: the single intervals overlap widely, the paired one excludes 0."""
    one, other = table(sampler()), table(sampler(spread=1.01))
    item = differences(one, other)["rms_px"]
    assert item.better == "first"
    assert item.difference.value == pytest.approx(0.01 * item.first, rel=1e-6)
    # with noise of its own, the difference has the spread of two independent rms: 3 to 4 % each, not 0.1 %
    other_noise = differences(one, table(sampler(seed=2, spread=1.01)))["rms_px"].difference
    assert other_noise.high - other_noise.low > 10 * (item.difference.high - item.difference.low)


@pytest.mark.slow
def test_equal_methods_are_seldom_told_apart_and_unequal_ones_always():
    """Two samplers with the same law, 20 times 16 metrics: any metric at all is called different in at most 5 %.

    Binomial(20, 0.05) is above 6 in one run of 3 x 10^4. Half as much noise again is seen nearly every time: the rms of
    60 samples scatters by a tenth, and Holm's first limit is 3 standard deviations. Intervals, which have no part in a
    verdict, take half of the time: they are not drawn where samples are too few for one.
    """
    pairs, wrong, seen = cases(60), 0, 0
    rules = replace(RULES, least_samples=61)
    for trial in range(20):
        first, second, worse = (
            table(sampler(seed=100 * trial + k, spread=spread), pairs) for k, spread in ((1, 1.0), (2, 1.0), (3, 1.5))
        )
        wrong += any(item.better != "no difference shown" for item in differences(first, second, trial, rules).values())
        seen += differences(first, worse, trial, rules)["rms_px"].better == "first"
    assert wrong <= 6
    assert seen >= 17


def test_below_thirty_samples_there_is_no_verdict():
    """The attack of issue 13: at 5 samples intervals call equal methods different in 18 % of the cases."""
    for samples, better in ((5, "too few samples"), (29, "too few samples"), (30, "first")):
        pairs = cases(samples)
        found = differences(table(shifted(0.1), pairs), table(shifted(1.5), pairs))
        assert found["rms_px"].better == better
        assert found["rms_px"].difference.value == pytest.approx(1.4)
        assert np.isnan(found["rms_px"].chance) == (samples < 30)


def test_what_would_give_a_verdict_is_said():
    rules = {"least_compared": 30.0}
    small = compare_records(table(shifted(0.1), cases(25)), table(shifted(1.5), cases(25)), RULES, "test")
    note = note_on_size(small, rules, 25)
    assert "both have 25, 30 are the least" in note
    assert "30 samples or more" in note
    assert "bench-dev" in note
    enough = compare_records(table(shifted(0.1), cases(30)), table(shifted(1.5), cases(30)), RULES, "test")
    assert note_on_size(enough, rules, 30) == ""
    nothing = [replace(item, better="too few samples") for item in enough]
    assert "--track localise" in note_on_size(nothing, rules, 30)


def test_a_constant_depth_without_positions_is_never_better():
    """The attack of issue 13: a method that misses half of the pairs against the best constant depth."""
    d = np.array([t.depth_m for t in cases().truths])
    best = float(np.sum(1.0 / d) / np.sum(1.0 / d**2))
    good = sampler()
    half = table(lambda t: good(t) if t.number % 2 else silent(t))
    for positions in (silent, shifted(20.0)):
        constant = table(lambda t, at=positions: replace(at(t), depth_m=best))
        found = differences(half, constant)
        for name in ("rms_depth_counted", "rank_depth"):
            assert found[name].better == "first", name
    # and the positions that it has not found gain nothing over silence
    found = differences(table(silent), table(lambda t: replace(silent(t), depth_m=best)))
    assert {item.better for item in found.values()} <= {"no difference shown", "too few samples"}


def test_a_miss_costs_in_a_comparison_what_the_common_pairs_make_of_it():
    """One score is of all pairs, the other of the nearer half: both count a miss alike."""
    pairs = cases()
    near = [t for t in pairs.truths if t.depth_m < 2.5]
    whole, part = table(silent), records(pairs, [Outcome(t.number, silent(t), 0.01) for t in near], RULES)
    assert whole["depth_counted"].max() != pytest.approx(part["depth_counted"].max(), rel=1e-3)
    found = differences(whole, part)["rms_depth_counted"]
    assert found.first == found.second == pytest.approx(part["depth_counted"].max(), rel=1e-12)


def test_errors_are_compared_over_what_both_found():
    """One skips every second pair, and has the better rms on the rest by leaving out nothing."""
    half = sampler(spread=1.3)
    skips = table(lambda t: half(t) if t.number % 2 else silent(t))
    item = differences(table(sampler()), skips)
    assert item["rms_px"].n == 200
    assert item["rms_px"].samples == 100
    assert item["rms_px"].better == "first"
    assert item["rms_counted_px"].n == 400
    assert item["detection_rate"].difference.value == -0.5
    assert item["detection_rate"].better == "first"


def test_nothing_in_common_says_so():
    item = differences(table(silent), table(truth_itself))["rms_px"]
    assert (item.n, item.better) == (0, "too few samples")
    assert np.isnan(item.difference.value)
    assert item.difference.note


def test_only_directed_metrics_are_compared():
    assert all(METRICS[name].better in ("lower", "higher") for name in COMPARED)


# -- on disk -------------------------------------------------------------------------------------------------------


def write(folder, name, pairs, oracle, answers=None, rules=RULES):
    scored = score_outcomes(MethodCard.of(name), pairs, answers or outcomes(pairs, oracle), rules)
    write_score(folder / f"{name}.json", scored.document, scored.records)
    return folder / f"{name}.json"


@pytest.mark.slow
def test_scores_on_disk_are_compared_over_the_pairs_of_both(tmp_path):
    pairs = cases(40)
    whole = write(tmp_path, "whole", pairs, shifted(0.1))
    part = write(tmp_path, "part", pairs, None, [Outcome(t.number, scaled(1.0)(t), 0.1) for t in pairs.truths[:32]])
    found = {item.name: item for item in compare(whole, part)}
    assert found["rms_px"].n == 64
    assert found["rms_px"].better == "second"


def test_other_code_is_noted(tmp_path):
    d = read_score(write(tmp_path, "a", cases(10), truth_itself))
    assert note_on_code(d, d) == ""
    other = d.model_copy(update={"provenance": {**d.provenance, "code_sha256": "f" * 64}})
    assert "differ in code_sha256" in note_on_code(d, other)


@pytest.mark.parametrize("case", ["set", "rules", "truth", "no pair"])
def test_what_cannot_be_compared_is_refused(tmp_path, case):
    pairs = cases(10)
    first = write(tmp_path, "first", pairs, truth_itself)
    answers, other, rules, words = None, pairs, RULES, ""
    if case == "set":
        other, words = replace(pairs, name="others"), "different pair sets: name is 'cases' and 'others'"
    elif case == "rules":
        rules, words = replace(RULES, match_px=5.0), "different rules: match_px is 3.0 and 5.0"
    elif case == "truth":
        other, words = Cases(tuple(replace(t, depth_m=9.0) for t in pairs.truths)), "other truths"
    else:
        first = write(tmp_path, "first", pairs, None, [Outcome(0, None, 1.0, "error")])
        answers, words = [Outcome(1, None, 1.0, "error")], "no pair in common"
    second = write(tmp_path, "second", other, truth_itself, answers, rules)
    with pytest.raises(DatasetError, match=words) as error:
        compare(first, second)
    assert "\n" not in str(error.value)


def test_whole_frames_are_the_same_pairs_and_boxes_are_not(tmp_path):
    """`find`, `depth` and a set without boxes show whole frames; `localise` shows boxes."""
    scored = read_score(write(tmp_path, "a", cases(10), truth_itself))

    def shown(track, boxes_px=None):
        changes = {"track": track, "hinted": 0, "boxes_px": boxes_px}
        return scored.model_copy(update={"pair_set": {**scored.pair_set, **changes}})

    for track in ("find", "depth", ""):
        refuse_different(shown("find"), shown(track), "a.json", "b.json")
    for other, words in (
        (shown("localise", 64), r"b.json \(track localise\) were shown other boxes: score both with --track find"),
        (shown("", 64), r"b.json \(no track\) were shown other boxes: score both with --track find"),
    ):
        with pytest.raises(DatasetError, match=words):
            refuse_different(shown("find"), other, "a.json", "b.json")
