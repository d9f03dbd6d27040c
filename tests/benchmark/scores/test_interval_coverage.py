"""How often intervals cover, and how often equal methods are told apart: figures of docs/measurements/scores.md.

`pytest -s tests/benchmark/scores/test_interval_coverage.py` prints them, with fewer trials than the page.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from helpers.bench_cases import cases, outcomes, records, sampler

from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.compare import compare_records
from phibench.benchmark.scores.intervals import Clusters, estimates, quantile_of, rms_of

RULES = Rules(resamples=999)
TRIALS, COMPARISONS = 200, 100
SPREAD = 0.8  # sigma of ln(sigma) of a sample: errors of D over 1 to 4 m are like that


def drawn(rng, samples, spread):
    """Two normal errors of each sample, whose sigma is lognormal."""
    return np.exp(spread * rng.normal(size=(samples, 1))) * rng.normal(size=(samples, 2))


def truth(spread):
    """Rms in closed form, median and 95th percentile from 4 million errors."""
    many = np.abs(drawn(np.random.default_rng(0), 2_000_000, spread))
    return np.exp(spread**2), np.quantile(many, 0.5), np.quantile(many, 0.95)


def coverage(samples, spread):
    rng, hits, expected = np.random.default_rng(samples), np.zeros(3), truth(spread)
    clusters = Clusters(np.repeat(np.arange(samples), 2), samples)
    for _ in range(TRIALS):
        x = drawn(rng, samples, spread).ravel()
        quantiles = [quantile_of(clusters, np.abs(x), share) for share in (Fraction(1, 2), Fraction(19, 20))]
        found = estimates([rms_of(clusters, x**2), *quantiles], samples, RULES, rng)
        hits += [e.low <= value <= e.high for e, value in zip(found, expected, strict=True)]
    return hits / TRIALS


@pytest.mark.slow
@pytest.mark.parametrize(
    ("samples", "spread", "page"),
    [(10, 0.0, (0.88, 0.89, 0.56)), (100, 0.0, (0.94, 0.945, 0.947)), (100, SPREAD, (0.85, 0.95, 0.93))],
)
def test_coverage_is_what_the_page_says(samples, spread, page):
    """Four binomial deviations of 200 and of 1000 trials together: false alarm in 1 of 5000 for the nine of them."""
    found = coverage(samples, spread)
    print(f"n = {samples}, spread {spread}: rms, median, 95th percentile {found}")
    p = np.array(page)
    assert np.all(np.abs(found - p) < 4 * np.sqrt(p * (1 - p) * (1 / TRIALS + 1 / 1000)))


@pytest.mark.slow
@pytest.mark.parametrize("samples", [30, 60])
def test_equal_methods_are_told_apart_as_seldom_as_the_page_says(samples):
    """Any of 16 metrics in at most 5 %; four binomial deviations, false alarm 1 in 30 000."""
    pairs, wrong = cases(samples), 0
    for trial in range(COMPARISONS):
        a, b = (records(pairs, outcomes(pairs, sampler(seed=1000 + 2 * trial + k)), RULES) for k in (0, 1))
        wrong += any(item.better in ("first", "second") for item in compare_records(a, b, RULES, "tests", trial))
    print({samples: wrong / COMPARISONS})
    assert wrong / COMPARISONS <= 0.05 + 4 * np.sqrt(0.05 * 0.95 / COMPARISONS)
