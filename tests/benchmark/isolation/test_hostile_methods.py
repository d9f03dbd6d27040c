"""Answers, messages and deeds that ended a run, or could have; `tests/attack` has all of them."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.hostile_methods import ANSWERS, CHANNEL, FOLDER, HEADER, MESSAGES, PROCESS, Hostile
from helpers.processes import processes_under
from helpers.sandbox_pairs import GOOD, SmallPairs, method_file

from phibench.benchmark.isolation.printed_output import last_lines
from phibench.benchmark.isolation.run_limits import RunLimits
from phibench.benchmark.isolation.runner import run_method
from phibench.estimator.interface import Outcome
from phibench.scenes.validation import printable_line

LIMITS = RunLimits(seconds=20.0, memory_mb=1000.0)  # nothing here runs into a limit
# deeds that a warm process survives, one after the other
IN_ONE_PROCESS = [
    *ANSWERS.values(),
    MESSAGES["causes in a circle"],
    MESSAGES["prints escapes and halves of letters"],
]
BROKE = [
    PROCESS["a real-time signal"],
    PROCESS["a copy that answers, too"],
    PROCESS["a daemon of its own session"],
    CHANNEL["ten forged replies"],
    CHANNEL["brackets without end"],
    CHANNEL["memory that is cut short"],
    FOLDER["3000 folders in each other"],
]


def run_all(folder: Path, deeds: list[Hostile]) -> list[Outcome]:
    """Run one method that does all deeds, for the odd pairs, and is honest for the even ones."""
    lines = [
        f"if pair.number == {2 * i + 1}:\n" + "\n".join(f"    {line}" for line in hostile.deed.splitlines())
        for i, hostile in enumerate(deeds)
    ]
    reference = method_file(folder, "\n".join([*lines, f"return {GOOD}"]), header=HEADER)
    return run_method(reference, SmallPairs(2 * len(deeds) + 1), LIMITS)


@pytest.mark.parametrize("deeds", [IN_ONE_PROCESS, BROKE], ids=["answers", "broke"])
def test_a_deed_costs_its_own_pair_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, deeds: list[Hostile]) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    done = run_all(tmp_path, deeds)
    for number, outcome in enumerate(done):
        if number % 2:
            hostile = deeds[number // 2]
            assert outcome.failure in hostile.failures, (hostile.deed, outcome)
        else:
            assert outcome.failure == "", outcome
            assert outcome.answer is not None
            assert outcome.answer.down.uv_px == (number + 100.0, 2.0)
        assert outcome.seconds >= 0.0 or outcome.failure == "crash"
        assert all(len(text) <= 400 and text.isprintable() for text in texts(outcome))
    assert not list(processes_under(tmp_path))
    assert not list((tmp_path / "temporary").iterdir())


def texts(outcome: Outcome) -> list[str]:
    spots = [] if outcome.answer is None else [outcome.answer.down, outcome.answer.up]
    return [outcome.message, *outcome.output.splitlines(), *(spot.status for spot in spots)]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain, with ä and 中", "plain, with ä and 中"),
        (" two\n lines\t", "two lines"),
        ("\x1b[2J\ud800\u202e\x00", "\\x1b[2J\\ud800\\u202e\\x00"),
        ("x" * 1000, "x" * 17 + "..."),
        ("", ""),
    ],
)
def test_text_from_outside_is_printable_and_short(text: str, shown: str) -> None:
    assert printable_line(text, 20 if len(text) > 100 else 100) == shown
    assert printable_line("\ud800" * 1000, 20).startswith("\\ud800")
    assert len(printable_line("\ud800" * 1000, 20)) == 20


def test_lines_keep_their_indentation_and_lose_what_a_terminal_obeys() -> None:
    assert last_lines("a\n    b\x1b[2J\n\tc") == "a\n    b\\x1b[2J\n    c"
