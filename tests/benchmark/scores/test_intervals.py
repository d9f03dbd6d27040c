"""Intervals: against plain scipy, against resampling by hand, and by how often they cover."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from itertools import product

import numpy as np
import pytest
import scipy
from helpers.bench_cases import cases, outcomes, records, sampler

from phibench.benchmark.scores import intervals as ours
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.compare import exchange_chance, holm
from phibench.benchmark.scores.intervals import (
    Clusters,
    clopper_pearson,
    deviation_of,
    estimates,
    mean_of,
    quantile_of,
    rate,
    rms_of,
    rms_ratio_of,
)
from phibench.benchmark.scores.metrics import metric_estimates, prepared_records

RULES = Rules(resamples=999)
SINGLE = 50


def alone(n):
    """One record per sample."""
    return Clusters(np.arange(n), n)


def test_one_record_per_sample_is_scipys_bootstrap():
    x = np.random.default_rng(1).normal(size=SINGLE)
    (mine,) = estimates([rms_of(alone(SINGLE), x**2)], SINGLE, RULES, np.random.default_rng(5))

    def rms(x, axis):
        return np.sqrt(np.mean(x**2, axis=axis))

    # the batches are ours: they decide how the generator's numbers are shared out
    rng = np.random.default_rng(5)
    theirs = scipy.stats.bootstrap((x,), rms, n_resamples=999, rng=rng, method="BCa").confidence_interval
    assert (mine.low, mine.high) == pytest.approx((theirs.low, theirs.high), rel=1e-12)


@pytest.mark.parametrize("share", [Fraction(1, 2), Fraction(19, 20), Fraction(1, 4)])
def test_weighted_quantiles_are_those_of_repeated_records(share):
    rng = np.random.default_rng(2)
    checked = 0
    for n, per in ((5, 1), (7, 3), (20, 1), (40, 2)):
        values, index = rng.normal(size=n * per), np.repeat(np.arange(n), per)
        quantile = quantile_of(Clusters(index, n), values, share)
        weights = rng.multinomial(n, np.ones(n) / n, size=25).astype(float)
        for row, mine in zip(weights, quantile(weights), strict=True):
            repeated = np.repeat(values, row[index].astype(int))
            expected = np.quantile(repeated, float(share), method="averaged_inverted_cdf")
            assert mine == pytest.approx(expected, rel=1e-13, abs=1e-15)  # numpy interpolates with weights 0.5
            checked += 1
    assert checked == 100


def test_statistics_of_weights_are_those_of_repeated_records():
    rng = np.random.default_rng(3)
    index, (a, b) = np.repeat(np.arange(10), 3), rng.normal(1.0, 2.0, (2, 30))
    clusters = Clusters(index, 10)
    weights = rng.multinomial(10, np.ones(10) / 10, size=40).astype(float)
    for row in weights:
        times = row[index].astype(int)
        x, y, w = np.repeat(a, times), np.repeat(b, times), row[None]
        assert mean_of(clusters, a)(w)[0] == pytest.approx(x.mean(), rel=1e-12)
        assert rms_of(clusters, a**2)(w)[0] == pytest.approx(np.sqrt(np.mean(x**2)), rel=1e-12)
        assert rms_ratio_of(clusters, a**2, b**2)(w)[0] == pytest.approx(
            np.linalg.norm(x) / np.linalg.norm(y), rel=1e-12
        )
        pooled = np.sqrt((np.var(x) + np.var(y)) / 2)
        assert deviation_of(clusters, a, b)(w)[0] == pytest.approx(pooled, rel=1e-9)


def test_labels_make_clusters_whatever_their_order():
    clusters = Clusters.of(["b", "a", "b", "c"])
    assert clusters.n == 3
    assert clusters.sums(np.array([1.0, 2.0, 3.0, 4.0]))[:, 0].tolist() == [2.0, 4.0, 4.0]
    assert clusters.key == Clusters.of(["a", "b", "c"]).key != Clusters.of(["a", "b"]).key


def test_copies_of_a_sample_add_no_knowledge():
    """Each record five times: an interval over samples stays, one over records would shrink by sqrt 5."""
    x = np.random.default_rng(4).normal(size=SINGLE)
    copies = Clusters(np.repeat(np.arange(SINGLE), 5), SINGLE)
    many = np.repeat(x, 5)
    (single,) = estimates([rms_of(alone(SINGLE), x**2)], SINGLE, RULES, np.random.default_rng(6))
    (copied,) = estimates([rms_of(copies, many**2)], SINGLE, RULES, np.random.default_rng(6))
    (wrong,) = estimates([rms_of(alone(5 * SINGLE), many**2)], 5 * SINGLE, RULES, np.random.default_rng(6))
    assert (copied.low, copied.high) == pytest.approx((single.low, single.high), rel=1e-12)
    assert 0.35 < (wrong.high - wrong.low) / (single.high - single.low) < 0.55  # 1 / sqrt 5 = 0.45
    once = rate(alone(SINGLE), (x > 0).astype(float), RULES)
    # the effective number differs by the ratio of Student's quantiles alone, 4 % of n: 2 % of the half width 0.14
    assert rate(copies, (many > 0).astype(float), RULES).low == pytest.approx(once.low, abs=0.004)
    assert rate(alone(5 * SINGLE), (many > 0).astype(float), RULES).low > once.low + 0.03


# -- coverage ------------------------------------------------------------------------------------------------------

TRIALS = 400


def simulated(rng, samples=40, per=4):
    """Errors that share half of their variance within a sample."""
    common = rng.normal(size=(samples, 1))
    return np.sqrt(0.5) * (common + rng.normal(size=(samples, per)))


def coverage(make, truth, seed):
    rng = np.random.default_rng(seed)
    hits = 0
    for _ in range(TRIALS):
        estimate = make(simulated(rng), rng)
        hits += estimate.low <= truth <= estimate.high
    return hits / TRIALS


def over_samples(statistic):
    def make(x, rng):
        clusters = Clusters(np.repeat(np.arange(len(x)), x.shape[1]), len(x))
        return estimates([statistic(clusters, x.ravel())], len(x), RULES, rng)[0]

    return make


def over_records(statistic):
    def make(x, rng):
        return estimates([statistic(alone(x.size), x.ravel())], x.size, RULES, rng)[0]

    return make


STATISTICS = {
    "mean": (lambda c, x: mean_of(c, x), 0.0),
    "rms": (lambda c, x: rms_of(c, x**2), 1.0),
    "median of |x|": (lambda c, x: quantile_of(c, np.abs(x), Fraction(1, 2)), 0.6744897501960817),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", STATISTICS)
def test_bca_intervals_cover(name):
    """40 samples of 4 records that share half their variance, 400 trials.

    BCa is second-order right: at n = 40 its coverage is within some 2 % of 95 %. Binomial deviation at 95 % is 1.1 %;
    2 + 3 x 1.1 below is a false alarm in 1 of 700 runs (the seeds are fixed); above, 3 deviations.
    """
    statistic, truth = STATISTICS[name]
    assert 0.95 - 0.02 - 3 * 0.011 < coverage(over_samples(statistic), truth, 7) < 0.95 + 3 * 0.011


@pytest.mark.slow
def test_intervals_over_records_would_not_cover():
    """What the test above is for: resampling images instead of samples covers the mean in some 78 % only.

    The mean's variance is 1 + 3/2 times that of independent records: 95 % become P(|z| < 1.96 / sqrt 2.5) = 78.5 %.
    """
    statistic, truth = STATISTICS["mean"]
    assert abs(coverage(over_records(statistic), truth, 7) - 0.785) < 4 * 0.0205


@pytest.mark.parametrize("chance", [0.5, 0.9, 0.98])
def test_intervals_of_rates_cover_at_least(chance):
    """Exact intervals are conservative: at least 95 %, less 3 binomial deviations (false alarm 1 in 700)."""
    rng = np.random.default_rng(8)
    cut = float(np.quantile(rng.normal(size=2_000_000), chance))
    hits = naive = 0
    for _ in range(TRIALS):
        x = (simulated(rng) < cut).astype(float)
        clusters = Clusters(np.repeat(np.arange(len(x)), x.shape[1]), len(x))
        estimate = rate(clusters, x.ravel(), RULES)
        hits += estimate.low <= chance <= estimate.high
        low, high = clopper_pearson(x.sum(), x.size, 0.95)
        naive += low <= chance <= high
    assert hits / TRIALS > 0.95 - 3 * 0.011
    if chance == 0.5:
        assert naive / TRIALS < 0.93  # images taken for independent: the test would say so


def test_clopper_pearson_is_scipys_exact_interval():
    for hits, n in ((0, 20), (1, 20), (7, 20), (20, 20)):
        theirs = scipy.stats.binomtest(hits, n).proportion_ci(0.95, "exact")
        assert clopper_pearson(hits, n, 0.95) == pytest.approx((theirs.low, theirs.high), abs=1e-12)


def test_a_rate_of_all_or_nothing_counts_samples():
    clusters = Clusters(np.repeat(np.arange(10), 6), 10)
    none = rate(clusters, np.zeros(60), RULES)
    assert (none.value, none.low) == (0.0, 0.0)
    assert none.high == pytest.approx(1 - 0.025**0.1)
    assert rate(clusters, np.ones(60), RULES).low == pytest.approx(0.025**0.1)
    assert (
        rate(Clusters(np.zeros(4, int), 1), np.array([1.0, 0, 1, 0]), RULES).high > 0.98
    )  # one sample says next to nothing


# -- where BCa is not defined --------------------------------------------------------------------------------------


def test_few_samples_have_a_value_and_no_interval():
    (estimate,) = estimates([mean_of(alone(4), np.arange(4.0))], 4, RULES, np.random.default_rng(0))
    assert (estimate.value, estimate.note) == (1.5, "under 5 samples")
    assert math.isnan(estimate.low)
    (five,) = estimates([mean_of(alone(5), np.arange(5.0))], 5, RULES, np.random.default_rng(0))
    assert five.low < 2.0 < five.high


@pytest.mark.parametrize(("samples", "note"), [(49, "under 50 samples"), (50, "")])
def test_a_95th_percentile_of_few_samples_has_no_interval(samples, note):
    pairs = cases(samples)
    table = prepared_records(records(pairs, outcomes(pairs, sampler()), RULES))
    measured = metric_estimates(table, RULES, "tests", names=("p95_px", "median_px", "p95_depth_m"))
    for name in ("p95_px", "p95_depth_m"):
        assert measured[name].estimate.note == note
        assert math.isnan(measured[name].estimate.low) == bool(note)
    assert math.isfinite(measured["median_px"].estimate.low)


def test_no_sample_is_nothing():
    (estimate,) = estimates([mean_of(alone(0), np.empty(0))], 0, RULES, np.random.default_rng(0))
    assert math.isnan(estimate.value)
    assert estimate.note == ours.NOTHING


def test_equal_errors_have_the_value_as_their_interval():
    (estimate,) = estimates([rms_of(alone(9), np.full(9, 0.04))], 9, RULES, np.random.default_rng(0))
    assert (estimate.low, estimate.high, estimate.note) == (estimate.value, estimate.value, ours.EQUAL)
    (near,) = estimates([rms_of(alone(9), 0.04 + 1e-6 * np.arange(9))], 9, RULES, np.random.default_rng(0))
    assert near.low < near.value < near.high


def test_a_value_beyond_all_resamples_falls_back_and_says_so():
    """The share of samples that were drawn: 1 for the samples themselves, below it for every resample."""
    (estimate,) = estimates([lambda weights: np.mean(weights > 0, axis=-1)], 30, RULES, np.random.default_rng(0))
    assert (estimate.value, estimate.note) == (1.0, ours.PERCENTILE)
    assert 0.45 < estimate.low < 1 - 1 / np.e < estimate.high < 0.8  # on average 1 - 1/e are drawn, sigma 0.057


def test_an_infinite_value_has_no_interval():
    (estimate,) = estimates([rms_ratio_of(alone(9), np.ones(9), np.zeros(9))], 9, RULES, np.random.default_rng(0))
    assert (estimate.value, estimate.note) == (math.inf, "infinite")
    assert math.isnan(estimate.high)


def test_the_same_stream_gives_the_same_interval():
    x = np.random.default_rng(9).normal(size=SINGLE)
    a, b, c = (
        estimates([mean_of(alone(SINGLE), x)], SINGLE, RULES, np.random.default_rng(seed))[0] for seed in (1, 1, 2)
    )
    assert a == b != c


# -- tests of a difference ---------------------------------------------------------------------------------------------


def both(first, second):
    """Mean of 2 n samples of one record each, the first method's n, then the second's."""
    return mean_of(Clusters(np.arange(2 * len(first)), 2 * len(first)), np.concatenate([first, second]))


def test_the_chance_of_a_mean_difference_is_that_of_all_exchanges():
    """All 2^10 exchanges by hand; 20 000 drawn ones know a chance of 0.1 to 0.002, five deviations are 0.01."""
    rng = np.random.default_rng(5)
    first, second = rng.normal(size=(2, 10)) + [[0.0], [1.2]]
    signs = np.array(list(product((-1.0, 1.0), repeat=10)))
    observed = abs(np.sum(second - first))
    exact = np.mean(np.abs(signs @ (second - first)) >= observed * (1.0 - 1e-12))
    assert 0.01 < exact < 0.6
    drawn = exchange_chance(both(first, second), 10, replace(RULES, resamples=20_000), np.random.default_rng(1))
    assert drawn == pytest.approx(exact, abs=5.0 * np.sqrt(exact * (1.0 - exact) / 20_000))


def test_the_chance_is_even_where_nothing_differs():
    """400 pairs of equal laws: below 0.05 in 5 % (binomial, four deviations)."""
    rng = np.random.default_rng(6)
    rules = replace(RULES, resamples=199)
    chances = [exchange_chance(both(*rng.standard_t(2, (2, 30))), 30, rules, rng) for _ in range(400)]
    assert abs(np.mean(np.array(chances) <= 0.05) - 0.05) < 4.0 * np.sqrt(0.05 * 0.95 / 400)


def test_equal_answers_have_a_chance_of_one():
    x = np.random.default_rng(7).normal(size=40)
    assert exchange_chance(both(x, x), 40, RULES, np.random.default_rng(0)) == 1.0
    assert np.isnan(exchange_chance(both(x, np.full(40, np.nan)), 40, RULES, np.random.default_rng(0)))


@pytest.mark.parametrize(
    ("chances", "rejected"),
    [
        # by hand: 0.05 / 3, 0.05 / 2, 0.05
        ((0.01, 0.02, 0.04), (True, True, True)),
        ((0.04, 0.02, 0.01), (True, True, True)),
        ((0.01, 0.03, 0.04), (True, False, False)),  # the second fails, and so does what follows
        ((0.02, 0.001, np.nan), (True, True, False)),  # of two
        ((0.017, 0.001, 0.9), (True, True, False)),
        ((0.02, 0.03, 0.9), (False, False, False)),
        ((), ()),
    ],
)
def test_holm(chances, rejected):
    assert tuple(holm(chances, 0.05)) == rejected
