"""How long a score takes: `pytest --benchmark-enable --benchmark-only`."""

from __future__ import annotations

from helpers.bench_cases import cases, outcomes, sampler, shifted

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.score import score_outcomes
from phibench.benchmark.scores.score_document import MethodCard


def test_score_of_500_pairs_and_8_methods(benchmark):
    """All metrics, strata and intervals, without the methods themselves."""
    pairs = cases(500)
    answers = [outcomes(pairs, sampler(seed=seed)) for seed in range(7)] + [outcomes(pairs, shifted(0.1))]

    def score():
        return [score_outcomes(MethodCard.of(str(i)), pairs, answer, Rules()) for i, answer in enumerate(answers)]

    scores = benchmark.pedantic(score, rounds=1)
    assert all(len(scored.document.strata) > 20 for scored in scores)
