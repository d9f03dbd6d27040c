"""Submissions to a sealed set: they come back as they were, and what is tampered with is refused in one sentence."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.sealed_sets import METHOD, refusal, tampered

from phibench.benchmark.isolation.runner import run_method
from phibench.benchmark.pair_sets.dataset_pairs import TASK_VERSION
from phibench.benchmark.sealed.sealed_set import Sealed
from phibench.benchmark.sealed.submission import SealedPairs, outcomes_of, read_submission, unseal


def test_a_submission_comes_back_as_it_was(sealed: Sealed, submitted: Path, method: str) -> None:
    opened = unseal(sealed.public, sealed.truth_file, submitted)
    assert opened.seal.id == sealed.seal.id
    expected = run_method(method, SealedPairs(sealed.public))
    for ours, theirs in zip(expected, opened.outcomes, strict=True):
        assert (ours.number, ours.failure, ours.message) == (theirs.number, theirs.failure, theirs.message)
        assert ours.answer == theirs.answer  # to the bit: JSON holds doubles exactly
        assert theirs.seconds >= 0.0
    assert [opened.pairs.truth(i).number for i in range(3)] == list(range(3))
    assert np.array_equal(opened.pairs.pair(2).up, SealedPairs(sealed.public).pair(2).up)
    assert opened.pairs.document()["id"] == sealed.seal.id


def test_a_submission_names_its_method_by_hash_and_no_path(submitted: Path) -> None:
    document = read_submission(submitted)
    assert (document.method.name, document.method.place) == ("mine:extract", "mine.py")
    assert document.method.division == "closed"  # its author's word goes with it
    assert document.method.sha256 == hashlib.sha256(METHOD.encode()).hexdigest()
    assert str(submitted.parent) not in submitted.read_text()
    assert len(outcomes_of(document)) == 3


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d["truths"][2].update(depth_m=d["truths"][2]["depth_m"] * (1.0 + 2.0**-52)),
        lambda d: d.update(salt="00" * 32),
        lambda d: d.update(salt=d["salt"][::-1]),
        lambda d: d["truths"].pop(),
        lambda d: d["truths"].reverse(),
    ],
    ids=["last bit of a depth", "no salt", "swapped salt", "a pair less", "another order"],
)
def test_another_truth_is_refused(sealed: Sealed, submitted: Path, tmp_path: Path, change: Any) -> None:
    truth = tampered(change, sealed.truth_file, tmp_path / "truth.json")
    assert "is not the truth that was sealed: its SHA-256" in refusal(sealed.public, truth, submitted)


def test_the_truths_file_written_again_is_the_same(sealed: Sealed, submitted: Path, tmp_path: Path) -> None:
    """The tampering above is what is refused, not the writing."""
    again = tampered(lambda _: None, sealed.truth_file, tmp_path / "truth.json")
    assert unseal(sealed.public, again, submitted).seal == sealed.seal


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.update(seal="0" * 16), "answers the seal 0000000000000000, not"),
        (lambda d: d.update(task_version=9), f"of task version 9, the seal of {TASK_VERSION}"),
        (lambda d: d["answers"].pop(1), "lacks pair 1 (1 of 3 are missing)"),
        (lambda d: d["answers"].append(d["answers"][1]), "answers pair 1 twice"),
        (lambda d: d["answers"][2].update(number=1), "answers pair 1 twice"),
        (lambda d: d["answers"].append({**d["answers"][1], "number": 3}), "answers pair 3, the seal has 0 to 2"),
        (lambda d: d["answers"][0].update(depth="2"), "is damaged: answers.0.depth"),
        (lambda d: d.update(format="x"), "has the format 'x'"),
    ],
)
def test_another_submission_is_refused(
    sealed: Sealed, submitted: Path, tmp_path: Path, change: Any, words: str
) -> None:
    assert words in refusal(sealed.public, sealed.truth_file, tampered(change, submitted, tmp_path / "s.json"))


@pytest.mark.parametrize(
    "change",
    [
        {"seconds": -1e6},
        {"failure": "banana"},
        {"failure": "crash"},  # together with an answer
        {"down": None, "up": None},  # neither an answer nor a failure
    ],
)
def test_a_line_that_submit_does_not_write_is_refused(
    sealed: Sealed, submitted: Path, tmp_path: Path, change: dict[str, Any]
) -> None:
    forged = tampered(lambda d: d["answers"][0].update(change), submitted, tmp_path / "s.json")
    assert "is not one that `phibench seal submit` writes" in refusal(sealed.public, sealed.truth_file, forged)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"phi_convention": "banana"}, "phi_convention"),
        ({"phi_rad": -40.0}, "phi"),
        ({"covariance_px2": [[1.0, 2.0], [2.0, 1.0]]}, "covariance"),
        ({"uv_px": None}, "uv_px"),
    ],
)
def test_an_answer_that_is_none_in_the_sandbox_is_none_in_a_submission(
    sealed: Sealed, submitted: Path, tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    forged = tampered(lambda d: d["answers"][0]["down"].update(change), submitted, tmp_path / "s.json")
    outcome = unseal(sealed.public, sealed.truth_file, forged).outcomes[0]
    assert (outcome.failure, outcome.answer) == ("invalid", None)
    assert words in outcome.message
