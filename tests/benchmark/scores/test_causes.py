"""Causes: each rule, its threshold from both sides, and their order."""

from __future__ import annotations

from dataclasses import replace
from hashlib import sha256

import numpy as np
import polars as pl
import pytest
from helpers.bench_cases import RIG, Cases, cases, change, constant, image_of, outcomes, silent, truth_itself
from scipy.ndimage import maximum_filter, uniform_filter

from phibench.benchmark.scores.answer_errors import MATCH_PX, Rules
from phibench.benchmark.scores.failure_causes import (
    _RULES,
    CAUSES,
    KINDS,
    TAKEN_FOR,
    Case,
    cause_of,
    count,
    count_failures,
    taken_for,
    with_causes,
)
from phibench.benchmark.scores.fit_at_truth import fit_at_truth
from phibench.benchmark.scores.records import record_table
from phibench.benchmark.scores.score_tables import false_line
from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.interface import FAILURES, Answer, Outcome, Pair, Spot
from phibench.estimator.pair_set import CachedPairs, Distraction

RULES = Rules()
TRUTH = cases(20).truths[0]
UV = np.array(TRUTH.down.uv_px)


FITS = {}


def fit_once(pair, truth):
    """`fit_at_truth`, once for equal images, cards and places: it asks a pair and its truth for nothing else."""
    images = (pair.down, pair.up, pair.down_off, pair.up_off)
    shown = [None if image is None else sha256(np.ascontiguousarray(image)).digest() for image in images]
    key = (pair.card, pair.rig, *shown, *((spot.visible, spot.uv_px) for spot in (truth.down, truth.up)))
    if key not in FITS:
        FITS[key] = fit_at_truth(pair, truth)
    return FITS[key]


def pair_of(truth, image=None, off=None, output="mjpeg"):
    shown = image_of(truth.down) if image is None else image
    card = sensor_card(output)
    return Pair(0, shown, shown, RIG, truth.stroke_m, card, down_off=off, up_off=off)


def cause(truth=TRUTH, answer=None, failure="", image=None, off=None, output="mjpeg", **spot):
    truth = change(truth, "down", **spot) if spot else truth
    asked = pair_of(truth, image, off, output)
    answer_px = None if answer is None else np.array(answer)
    return cause_of(Case("down", truth, answer_px, failure, lambda _: asked, RULES, fit_once))


@pytest.mark.parametrize(
    ("why", "expected"),
    [
        ("occluded:table", "occluded"),
        ("faces_away", "occluded"),
        ("no_reflection", "mirror_edge"),
        ("mirror_edge", "mirror_edge"),
        ("outside_image", "image_edge"),
    ],
)
def test_what_is_not_visible_has_the_scenes_cause(why, expected):
    # whatever else holds
    assert cause(visible=False, cause=why, saturated=True, snr=0.0, failure="crash") == expected


def test_a_visible_spot_at_the_mirrors_outline_is_clipped():
    """Three blurs of sqrt(0.7^2 + 1/12) = 0.757 px are 2.27 px."""
    centre = np.array([RIG.camera.cx_px, RIG.camera.cy_px])
    radius = np.linalg.norm(RIG.outline_px()[0] - centre)
    assert cause(uv_px=tuple(centre + [radius - 2.2, 0.0])) == "mirror_edge"
    assert cause(uv_px=tuple(centre + [radius - 2.4, 0.0])) == "method"


def test_a_visible_spot_at_the_edge_of_the_image_is_clipped():
    low = replace(TRUTH, true_rig=replace(RIG, camera=replace(RIG.camera, cy_px=30.0)))  # the mirror reaches beyond
    assert cause(low, uv_px=(640.0, -0.5 + 2.2)) == "image_edge"
    assert cause(low, uv_px=(640.0, -0.5 + 2.4)) == "method"
    assert cause(low, uv_px=(640.0, 100.0)) == "method"


def test_a_saturated_spot():
    assert cause(saturated=True) == "saturated"
    assert cause(saturated=True, answer=UV + 50.0, snr=1.0) == "saturated"


def test_a_distraction_is_what_the_answer_lies_on():
    other = UV + [40.0, 0.0]
    lamp = (Distraction("lamp", tuple(other), 500.0),)
    for off, expected in ((MATCH_PX - 0.01, "confused"), (MATCH_PX + 0.01, "method")):
        assert cause(answer=other + [0.0, off], distractions=lamp) == expected
    assert cause(distractions=lamp) == "method"  # no answer: nothing was taken for the spot


def test_a_brighter_region_is_a_distraction():
    image = image_of(TRUTH.down)
    image[100:110, 300:310] = 250
    assert cause(answer=(304.0, 104.0), image=image) == "confused"
    image[100:110, 300:310] = 10
    assert cause(answer=(304.0, 104.0), image=image) == "method"


def test_a_region_may_be_brighter_in_the_image_or_in_its_difference_to_the_laser_off_image():
    lamp = np.zeros_like(image_of(TRUTH.down))
    lamp[100:110, 300:310] = 250
    dim = lamp // 25  # 30 codes in three planes, against a mean of 74 over the spot's 4 x 4 pixels
    u, v = (round(x) for x in UV)
    room = np.zeros_like(lamp)
    room[v - 20 : v + 20, u - 20 : u + 20] = 120
    spot = image_of(TRUTH.down)
    assert cause(answer=(304.0, 104.0), image=spot + lamp, off=lamp) == "confused"  # there without the laser as well
    assert cause(answer=(304.0, 104.0), image=spot + dim, off=np.zeros_like(lamp)) == "method"
    dark = np.maximum(spot, room)  # the spot adds nothing but in its middle
    shown = dark + lamp // 5  # 50 codes: darker than the room, brighter than what the spot adds to it
    assert cause(answer=(304.0, 104.0), image=shown, off=None) == "method"
    assert cause(answer=(304.0, 104.0), image=shown, off=room) == "confused"


def test_an_answer_outside_the_image_is_no_region():
    assert cause(answer=(-500.0, 90_000.0)) == "method"


@pytest.mark.parametrize(("snr", "expected"), [(4.99, "below_noise"), (5.0, "method")])
def test_below_five_sigma_is_noise(snr, expected):
    assert cause(snr=snr) == expected


def test_compression_is_a_good_raw_spot_that_the_image_does_not_show():
    black = np.zeros_like(image_of(TRUTH.down))
    good, bad = 0.9**2 * np.eye(2), 1.1**2 * np.eye(2)
    assert cause(image=black, raw_bound_px2=good) == "compression"
    assert cause(image=black, raw_bound_px2=bad) == "method"
    assert cause(image=black, raw_bound_px2=None) == "method"
    assert cause(raw_bound_px2=good) == "method"  # the image shows it
    assert cause(image=black[..., 0], raw_bound_px2=good, output="bayer-raw") == "method"


def test_compression_leaves_less_than_three_standard_errors():
    """Noise of 6 codes in the ring: the mean of 9 pixels has a standard error of 2 codes; 3 of them are 6."""
    rng = np.random.default_rng(1)
    noise = np.clip(100 + 6 * rng.standard_normal((720, 1280, 3)), 0, 255)
    u, v = (round(x) for x in UV)
    for level, expected in ((3, "compression"), (12, "method")):
        image = noise.copy()
        image[v - 1 : v + 2, u - 1 : u + 2, 0] = 100 + level
        image[v - 1 : v + 2, u - 1 : u + 2, 1:] = 100
        assert cause(image=image.astype(np.uint8), raw_bound_px2=0.01 * np.eye(2)) == expected


@pytest.mark.parametrize("failure", FAILURES)
def test_the_harness_s_word_comes_after_the_light(failure):
    assert cause(failure=failure) == failure
    assert cause(failure=failure, snr=1.0) == "below_noise"


def test_every_image_that_is_not_detected_has_one_cause():
    """A mixed set: each pair made to fail in another way."""
    truths = list(cases(20).truths)
    truths[0] = change(truths[0], "down", visible=False, cause="occluded:table")
    truths[1] = change(truths[1], "down", saturated=True)
    truths[2] = change(truths[2], "down", snr=2.0)
    answers = [Outcome(t.number, silent(t), 0.1) for t in truths]
    answers[3] = Outcome(3, None, float("nan"), "timeout", "too slow")
    answers[4] = Outcome(4, truth_itself(truths[4]), 0.1)
    answers[5] = Outcome(5, constant(truths[5]), 0.1)
    answers[0] = Outcome(0, Answer(Spot((600.0, 300.0)), Spot(truths[0].up.uv_px)), 0.1)
    pairs = Cases(tuple(truths))
    table = with_causes(record_table(truths, answers, RULES), pairs, RULES, fit_once)
    assert table["cause"].is_null().to_list() == table["detected"].to_list() == table["kind"].is_null().to_list()
    down = table.filter(image="down")
    assert down["cause"].to_list()[:6] == ["occluded", "saturated", "below_noise", "timeout", None, "method"]
    assert down["kind"].to_list()[:6] == ["false", "missed", "missed", "missed", None, "false"]
    numbers = count(table)
    assert list(numbers) == list(CAUSES)
    assert sum(sum(kinds.values()) for kinds in numbers.values()) == int((~table["detected"]).sum())
    assert numbers["timeout"] == {"unseen": 0, "missed": 2, "false": 0}
    assert count_failures(table) == dict.fromkeys(FAILURES, 0) | {"timeout": 1}


def test_every_cause_has_a_rule_or_is_a_word_of_the_sandbox():
    assert tuple(CAUSES) == (*_RULES, *FAILURES, "method")
    assert all(CAUSES.values())


def place(answer, image=None, truth=TRUTH, **spot):
    truth = change(truth, "down", **spot) if spot else truth
    asked = pair_of(truth, image)
    return taken_for(Case("down", truth, np.array(answer), "", lambda _: asked, RULES))


def test_a_false_detection_lies_on_a_lamp_a_light_a_region_or_nothing():
    """Codes 255 (clipped), 240 and 60 against a spot whose 4 x 4 pixels have (8 x 120 + 230) / 16 = 74 on average."""
    u, v = (round(x) for x in (UV[0] + 60.0, UV[1]))
    for code, expected in ((255, "lamp"), (240, "region"), (60, "nothing"), (0, "nothing")):
        image = image_of(TRUTH.down)
        image[v - 6 : v + 7, u - 6 : u + 7, 0] = code
        assert place((u, v), image) == expected
    other = Distraction("glow", (float(u), float(v)), 100.0)
    assert place((u + 1.0, v), distractions=(other,)) == "light"
    assert place((u, v), visible=False, uv_px=(np.nan, np.nan)) == "nothing"


def test_a_peak_of_the_difference_on_a_lamp_is_noise_of_who_subtracts():
    """A lamp of 248 codes with noise of 3 codes, on and off: peaks of on - off stand out, what on alone shows does not.

    Of 40 x 40 positions the highest 3 x 3 mean lies 3 deviations up on average; the lowest
    is the one with no peak within 2 px.
    """
    rng = np.random.default_rng(4)
    u, v = (round(x) for x in (UV[0] + 100.0, UV[1]))
    image, off = image_of(TRUTH.down).astype(float), image_of(TRUTH.down).astype(float)
    for one in (image, off):
        one[v - 40 : v + 41, u - 40 : u + 41] = 248.0
        one[v - 40 : v + 41, u - 40 : u + 41] += 3.0 * rng.standard_normal((81, 81, 3))
    image, off = (np.clip(np.rint(one), 0, 255).astype(np.uint8) for one in (image, off))
    means = uniform_filter((image.astype(float) - off).sum(axis=-1), 3)[v - 20 : v + 21, u - 20 : u + 21]
    highest = np.unravel_index(np.argmax(means), means.shape)
    lowest = np.unravel_index(np.argmin(maximum_filter(means, 5)), means.shape)

    def kind(at, off_image):
        asked = pair_of(TRUTH, image, off_image)
        answer = np.array([u - 20 + at[1], v - 20 + at[0]], float)
        return taken_for(Case("down", TRUTH, answer, "", lambda _: asked, RULES))

    assert kind(highest, off) == "lamp_noise"
    assert kind(lowest, off) == "lamp"
    assert kind(highest, None) == "lamp"  # nothing was subtracted
    assert "subtract" not in TAKEN_FOR["lamp_noise"][1] + TAKEN_FOR["region_noise"][1]


def test_the_line_on_false_answers_takes_a_methods_places_together():
    """5 lamps, 4 of them noise, and 3 regions of noise: 7 of 8 say that the method subtracts."""
    kinds = ["lamp", *["lamp_noise"] * 4, *["region_noise"] * 3]
    table = pl.DataFrame({"u_px": [1.0] * 8, "false_detection": [True] * 8, "taken_for": kinds})
    assert false_line(table).startswith("62 % of the answers are noise of a lamp")
    assert "localise" not in false_line(table, boxed=True)  # every spot has its box already
    plain = table.with_columns(taken_for=pl.Series([kind.removesuffix("_noise") for kind in kinds]))
    assert false_line(plain).startswith("62 % of the answers are a lamp or its reflection in the mirror: subtract")


def test_a_table_full_of_false_detections_says_what_they_are():
    pairs = cases(20)
    truths = [change(t, "down", distractions=(Distraction("glow", (640.0, 360.0), 50.0),)) for t in pairs.truths]
    truths = [change(t, "up", distractions=(Distraction("glow", (640.0, 360.0), 50.0),)) for t in truths]
    for share, expected in ((0.9, "90 % of the answers are another light"), (0.1, "")):
        answers = [Outcome(t.number, (constant if t.number < 20 * share else truth_itself)(t), 0.1) for t in truths]
        table = with_causes(record_table(truths, answers, RULES), Cases(tuple(truths)), RULES, fit_once)
        assert false_line(table).startswith(expected)
        assert ("--track localise" in false_line(table)) == bool(expected)


def test_a_hidden_spot_that_is_not_answered_is_no_fault():
    truth = change(TRUTH, "down", visible=False, cause="occluded:table")
    table = record_table([truth], [Outcome(0, silent(truth), 0.1)], RULES)
    table = with_causes(table, Cases((truth,)), RULES)
    assert table["kind"].to_list() == ["unseen", "missed"]
    assert set(table["kind"]) <= set(KINDS)


def test_images_are_drawn_only_where_a_rule_looks_at_them():
    asked = []

    class Watched(Cases):
        def pair(self, number):
            asked.append(number)
            return super().pair(number)

    pairs = cases(20)
    for oracle, times in ((truth_itself, 0), (constant, 20)):  # down and up of a pair are drawn together
        held = CachedPairs(Watched(pairs.truths))
        with_causes(record_table(pairs.truths, outcomes(pairs, oracle), RULES), held, RULES)
        assert len(asked) == times
