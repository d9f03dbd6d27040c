"""Fit that knows where to look: it reaches the bound where the light is, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.bench_cases import cases

from phibench.benchmark.isolation.easy_pairs import EasyPairs
from phibench.benchmark.scores.answer_errors import MATCH_PX, Rules
from phibench.benchmark.scores.failure_causes import Case, cause_of
from phibench.benchmark.scores.fit_at_truth import KeptFits, fit_at_truth, reaches_bound
from phibench.estimator.interface import Answer, Spot

PAIRS = cases(2)
TRUTH = PAIRS.truths[0]
ANSWER = Answer(Spot(TRUTH.down.uv_px), Spot(TRUTH.up.uv_px))


@pytest.mark.parametrize(("sigma_px", "off_px", "expected"), [(0.1, 0.39, True), (0.1, 0.41, False), (0.8, 0.1, False)])
def test_four_deviations_of_a_sharp_bound_are_its_reach(sigma_px: float, off_px: float, expected: bool) -> None:
    spot = replace(TRUTH.down, bound_px2=sigma_px**2 * np.eye(2))
    moved = Answer(Spot((spot.uv_px[0] + off_px, spot.uv_px[1])), ANSWER.up)
    assert reaches_bound(moved, "down", spot, MATCH_PX) == expected


def test_what_is_not_there_is_not_reached() -> None:
    for spot in (replace(TRUTH.down, bound_px2=None), replace(TRUTH.down, visible=False)):
        assert not reaches_bound(ANSWER, "down", spot, MATCH_PX)
    assert not reaches_bound(None, "down", TRUTH.down, MATCH_PX)
    assert not reaches_bound(Answer(Spot.missing("none"), ANSWER.up), "down", TRUTH.down, MATCH_PX)


def test_the_built_in_fit_reaches_the_bound_of_easy_pairs() -> None:
    """Of 6 images at the bound none is beyond 4 deviations; the false-alarm rate is 6 exp(-8) = 0.2 %."""
    pairs = EasyPairs("bayer-raw", 3)
    for number in range(3):
        truth = pairs.truth(number)
        answer = fit_at_truth(pairs.pair(number), truth)
        for position in ("down", "up"):
            assert reaches_bound(answer, position, getattr(truth, position), MATCH_PX)


@pytest.mark.parametrize("why", ["saturated", "below_noise"])
def test_an_image_is_no_cause_where_a_fit_reaches_its_bound(why: str) -> None:
    changes = {"saturated": {"saturated": True}, "below_noise": {"snr": 2.0}}[why]
    truth = replace(TRUTH, down=replace(TRUTH.down, **changes))
    for answer, expected in ((ANSWER, "method"), (None, why)):
        case = Case("down", truth, None, "", PAIRS.pair, Rules(), lambda pair, asked, a=answer: a)
        assert cause_of(case) == expected


def test_fits_are_made_once_for_all_methods(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    name = "phibench.benchmark.scores.fit_at_truth.fit_at_truth"
    monkeypatch.setattr(name, lambda pair, truth: asked.append(truth.number) or ANSWER)
    fits = KeptFits()
    for _ in range(3):
        for truth in PAIRS.truths:
            fits(PAIRS.pair(truth.number), truth)
    assert asked == [0, 1]
