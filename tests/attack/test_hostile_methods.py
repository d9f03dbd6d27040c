"""Every hostile method in a run of its own, then a score, a report and a submission of all that they left.

No run may end, the pairs beside the bad one have their honest answers, and no process and no file is left.
"""

from __future__ import annotations

import io
import json
import tempfile
import time
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from helpers.bench_cases import cases
from helpers.hostile_methods import ALL, BAD, HEADER
from helpers.processes import processes_under
from helpers.sandbox_pairs import SmallPairs, method_file

from phibench.benchmark.isolation.run_limits import RunLimits
from phibench.benchmark.isolation.runner import run_method
from phibench.benchmark.reports.report_page import write_report
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.score import Scored, saved_score, score_outcomes
from phibench.benchmark.scores.score_document import MethodCard
from phibench.benchmark.scores.score_tables import print_scores
from phibench.estimator.interface import Outcome

pytestmark = pytest.mark.slow
LIMITS = RunLimits(seconds=6.0, memory_mb=1000.0)
PAIRS = 3
LONGEST_S = 60.0  # starts, a pair that is late, 4 s for a supervisor that was stopped; on a machine with other work


@dataclass(frozen=True)
class Run:
    """Result of one hostile method: what came of its pairs, what it left, and the time that it took."""

    outcomes: list[Outcome]
    processes: list[int]
    files: list[str]
    seconds: float


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Run]]:
    folder = tmp_path_factory.mktemp("hostile")
    temporary, before = folder / "temporary", tempfile.tempdir
    (temporary / "precious").mkdir(parents=True)
    (temporary / "precious" / "file").touch()
    tempfile.tempdir = str(temporary)
    try:
        yield {name: run(folder, temporary, name) for name in ALL}
    finally:
        tempfile.tempdir = before


def run(folder: Path, temporary: Path, name: str) -> Run:
    start = time.monotonic()
    outcomes = run_method(method_file(folder, ALL[name].body(), header=HEADER), SmallPairs(PAIRS), LIMITS)
    took_s = time.monotonic() - start
    files = sorted(path.name for path in temporary.iterdir())
    return Run(outcomes, list(processes_under(folder)), files, took_s)


def test_there_are_many() -> None:
    assert len(ALL) >= 130
    assert len({hostile.deed for hostile in ALL.values()}) == len(ALL)


@pytest.mark.parametrize("name", ALL)
def test_a_hostile_method_costs_its_own_pair_alone(runs: dict[str, Run], name: str) -> None:
    hostile, result = ALL[name], runs[name]
    assert [outcome.number for outcome in result.outcomes] == list(range(PAIRS))
    assert result.outcomes[BAD].failure in hostile.failures
    assert all(text.isprintable() and len(text) <= 400 for o in result.outcomes for text in texts(o))
    assert result.processes == []
    assert result.files == ["precious"]
    assert result.seconds < LONGEST_S
    for outcome in result.outcomes:
        if outcome.number != BAD and not (hostile.lasting and outcome.number > BAD):
            assert outcome.answer is not None, outcome
            assert outcome.answer.down.uv_px == (outcome.number + 100.0, 2.0)
            assert 0.0 < outcome.seconds < LIMITS.seconds


def texts(outcome: Outcome) -> list[str]:
    spots = [] if outcome.answer is None else [outcome.answer.down, outcome.answer.up]
    return [outcome.message, *outcome.output.splitlines(), *(spot.status for spot in spots)]


def test_links_were_not_followed(runs: dict[str, Run]) -> None:
    assert (Path(str(tempfile.tempdir)) / "precious" / "file").exists()


@pytest.fixture(scope="module")
def scored(runs: dict[str, Run]) -> Scored:
    """All that the hostile pairs gave, as answers of one method with a hostile name."""
    outcomes = [replace(run.outcomes[BAD], number=i) for i, run in enumerate(runs.values())]
    card = MethodCard.of("$\\frac{1}$ [/b] <b>", kind="function")
    one = score_outcomes(card, cases(len(outcomes)), outcomes, Rules())
    return replace(one, output="\n".join(o.output for o in outcomes))


def test_a_score_of_all_is_written_printed_and_reported(scored: Scored, tmp_path: Path) -> None:
    written = saved_score(scored, tmp_path / "score.json")
    assert json.loads((tmp_path / "score.json").read_text(encoding="utf-8"))["pairs"] == len(ALL)
    for form in ("terminal", "csv", "markdown", "latex", "json"):
        with redirect_stdout(io.StringIO()) as out:
            print_scores([written], form, "phi", wide=True, calibrated=True)  # type: ignore[arg-type]
        assert "\x1b[2J" not in out.getvalue()
        out.getvalue().encode()
    page = write_report([tmp_path / "score.json"], tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<script>" not in page
    assert "[/b] &lt;b&gt;" in page
