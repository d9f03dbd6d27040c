"""The study `cause`: errors of log evidences, and what differences of them decide."""

from __future__ import annotations

import polars as pl
import pytest

from phibench.studies.cause.study import made_up_findings, scale_findings
from phibench.studies.cause.tables import ENOUGH, FLOOR, evidence_error, verdict


def test_errors_of_few_samplings_have_a_floor() -> None:
    assert evidence_error(0.6, 1) == evidence_error(0.6, ENOUGH - 1) == FLOOR
    assert evidence_error(2.5, 1) == 2.5
    assert evidence_error(0.6, ENOUGH) == 0.6


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_verdicts_ask_for_odds_beyond_twice_the_error(sign: float) -> None:
    """ln 10 = 2.303: with an error of 2.12 (1.5 of each) 6.54 is the limit, with one of 0.1 it is 2.50."""
    decided = "favoured" if sign > 0.0 else "disfavoured"
    assert verdict(sign * 6.5, 1.5 * 2.0**0.5) == "undecided"
    assert verdict(sign * 6.6, 1.5 * 2.0**0.5) == decided
    assert verdict(sign * 2.45, 0.1) == "undecided"
    assert verdict(sign * 2.55, 0.1) == decided
    assert verdict(sign * 2.25, 0.0) == "undecided"


@pytest.mark.parametrize(("error", "lost"), [(0.5, 1), (FLOOR, 0)])
def test_made_up_data_decide_by_the_same_rule(error: float, lost: int) -> None:
    made_up = pl.DataFrame(
        {
            "truth": ["ray"] * 2,
            "repeat": [0, 0],
            "explanation": ["ray", "tilted"],
            "log_evidence": [0.0, 5.0],
            "log_evidence_error": [error] * 2,
            "covered": [6, 0],
            "parameters": [6, 0],
        }
    )
    best, against, held = made_up_findings(made_up)
    assert (best.value, best.unit) == (0, "of 1")
    assert (against.value, against.unit) == (lost, "of 1")
    assert (held.value, held.unit) == (6, "of 6")


def test_wider_priors_come_with_errors() -> None:
    rows = {"explanation": ["a", "a"], "scale": [1.0, 2.0], "against": [11.9, 13.9], "error": [1.6, 2.1]}
    plain, wide = scale_findings(pl.DataFrame(rows))
    assert plain.label == "log evidence with priors 1 times as wide: a"
    assert (wide.value, wide.low, wide.high) == pytest.approx((13.9, 9.7, 18.1))
    assert wide.verdict == "favoured"
