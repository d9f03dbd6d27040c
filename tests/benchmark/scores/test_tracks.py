"""Numbers of the tracks: each against a calculation by other means, on answers whose law is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
import scipy
from helpers.bench_cases import Cases, cases, change, outcomes, records, sampler, shifted, truth_itself

from phibench.benchmark.pair_sets.dataset_pairs import LOCALISE_BOX_PX, tracks_of
from phibench.benchmark.scores.answer_errors import MATCH_PX, Rules
from phibench.benchmark.scores.metrics import metric_estimates, prepared_records
from phibench.benchmark.scores.record_columns import LEAST_RATIO, THRESHOLDS, perfect_log
from phibench.estimator.interface import Answer, Outcome, Spot
from phibench.estimator.pair_set import PairTruth

RULES = Rules()
NAMES = ("localise", "perfect_localise", "perfect_localise_pair", "find", "false_per_empty", "average_recall")


def table(pairs: Cases, oracle) -> pl.DataFrame:
    return prepared_records(records(pairs, outcomes(pairs, oracle), RULES))


def values(frame: pl.DataFrame, *names: str) -> dict[str, float]:
    return {name: found.estimate.value for name, found in metric_estimates(frame, RULES, "test", names=names).items()}


@pytest.mark.parametrize("ratio", [1.0, 2.5, 30.0])
@pytest.mark.parametrize("bound_px", [1e-3, 0.3, 0.99])
def test_the_perfect_row_is_the_integral_over_a_gaussian(ratio: float, bound_px: float) -> None:
    """Quadrature in Cartesian coordinates against quantiles in polar ones; 1e-3 is the midpoint rule's error there."""
    one = bound_px**2 / (1.0 + ratio)
    sigma = np.sqrt([one, ratio * one])

    def part(y: float, x: float) -> float:
        error = min(np.hypot(sigma[0] * x, sigma[1] * y), MATCH_PX)
        return np.log(max(error / bound_px, LEAST_RATIO)) * np.exp(-0.5 * (x * x + y * y)) / (2.0 * np.pi)

    expected = 4.0 * scipy.integrate.dblquad(part, 0.0, 6.0, 0.0, 6.0, epsabs=2e-5)[0]
    found = perfect_log(np.diag(sigma**2)[None], np.array([bound_px**2]))
    assert found[0] == pytest.approx(expected, abs=1e-3)


def test_a_round_bound_gives_075() -> None:
    """exp(-gamma / 2) = 0.7493; the ratio's floor of 0.1 adds 0.5 % (1 - exp(-0.01) of the errors are below it)."""
    found = np.exp(perfect_log(np.eye(2)[None] * 5e-5, np.array([1e-4])))[0]
    assert found == pytest.approx(np.exp(-0.5 * np.euler_gamma) * 1.005, rel=2e-3)


def test_a_method_at_the_bound_has_the_perfect_row() -> None:
    """400 spots; the logarithm of |e| scatters by pi / sqrt(24) = 0.64: 4 sigma are 0.13 (6e-5 by chance)."""
    found = values(table(cases(), sampler()), "localise", "perfect_localise")
    assert np.log(found["localise"] / found["perfect_localise"]) == pytest.approx(0.0, abs=0.13)
    double = values(table(cases(), sampler(spread=2.0)), "localise", "perfect_localise")
    assert np.log(double["localise"] / double["perfect_localise"]) > 0.5  # ln 2, less the same


def test_silence_and_far_answers_count_3_px_and_exact_ones_a_tenth() -> None:
    pairs = cases(20)
    bounds = np.array([np.trace(spot.bound_px2) for t in pairs.truths for spot in (t.down, t.up)])
    assert (bounds < 1.0).all()
    far = np.exp(np.mean(np.log(MATCH_PX / np.sqrt(bounds))))
    silent = values(table(pairs, lambda t: Answer(Spot.missing("no"), Spot.missing("no"))), "localise")
    assert silent["localise"] == pytest.approx(far, rel=1e-12)
    assert values(table(pairs, shifted(500.0)), "localise")["localise"] == pytest.approx(far, rel=1e-12)
    assert values(table(pairs, truth_itself), "localise")["localise"] == pytest.approx(LEAST_RATIO, rel=1e-12)


def test_only_spots_with_a_bound_below_1_px_are_localised() -> None:
    first = cases(20).truths[0]
    wide = change(first, "down", bound_px2=np.eye(2) * 0.6)
    hidden = change(first, "up", visible=False, bound_px2=None, raw_bound_px2=None)
    found = metric_estimates(
        table(Cases((wide, replace(hidden, number=1))), truth_itself), RULES, "test", names=("localise",)
    )
    assert found["localise"].n == 2  # of four: "up" of the first, "down" of the second


def spots(truth: PairTruth, *errors: float | None) -> Answer:
    """Answers that are off by so many pixels; None is no answer."""
    both = zip((truth.down, truth.up), errors, strict=True)
    return Answer(*(Spot.missing("no") if e is None else Spot((s.uv_px[0] + e, s.uv_px[1])) for s, e in both))


def test_find_counts_found_over_visible_and_false() -> None:
    first = cases(20).truths[0]
    empty = replace(change(change(first, "up", visible=False), "down", visible=False), sample_id="empty")
    truths = tuple(replace(t, number=n) for n, t in enumerate((first, first, empty, empty)))
    errors = ((0.5, 2.9), (3.1, None), (0.0, None), (None, None))
    asked = [Outcome(n, spots(t, *e), 0.1) for n, (t, e) in enumerate(zip(truths, errors, strict=True))]
    found = values(prepared_records(records(Cases(truths), asked, RULES)), "find", "false_per_empty")
    assert found["find"] == pytest.approx(2 / (4 + 2))  # 2 found of 4 visible; one false there, one in an empty image
    assert found["false_per_empty"] == pytest.approx(1 / 4)


def test_a_guess_pays_from_j_over_1_plus_j_on() -> None:
    """A further answer, right with chance p, changes found / (visible + false) to first order by nothing at that p."""
    found, visible, false = 700.0, 1000.0, 100.0
    J = found / (visible + false)
    for p, pays in ((J / (1 + J) - 0.01, False), (J / (1 + J) + 0.01, True)):
        after = p * (found + 1) / (visible + false) + (1 - p) * found / (visible + false + 1)
        assert (after > J) is pays


def test_average_recall_is_the_mean_over_thresholds() -> None:
    pairs = cases(6)
    relative = (0.004, 0.015, 0.03, -0.09, 0.5, 0.0)

    def answer(truth: PairTruth) -> Answer:
        missing = truth.number == 5
        own = truth.depth_m * (1.0 + relative[truth.number])
        down = Spot.missing("no") if missing else Spot(truth.down.uv_px)
        return Answer(down, Spot(truth.up.uv_px), own)

    expected = np.mean([6, 4, 3, 2, 0, 0]) / len(THRESHOLDS)  # the last answers D, but has found one spot alone
    assert values(table(pairs, answer), "average_recall")["average_recall"] == pytest.approx(expected)


def claiming(sigma_factor: float, error_factor: float = 1.0):
    """Method whose D is Gaussian with the pair's bound, and claims so many times its sigma."""
    rng = np.random.default_rng(5)
    bound = table(cases(), truth_itself).filter(pl.col("image") == "down")["pair_bound_depth_m2"].to_numpy() ** 0.5

    def answer(truth: PairTruth) -> Answer:
        sigma = bound[truth.number]
        own = truth.depth_m + error_factor * sigma * rng.standard_normal()
        return Answer(Spot(truth.down.uv_px), Spot(truth.up.uv_px), own, sigma_factor * sigma)

    return answer


def test_a_right_claim_at_the_bound_has_119() -> None:
    """The normal law's integral at z = 1.96; a score scatters by 1.15, the mean of 200 by 0.081: 4 sigma are 0.33."""
    z = scipy.stats.norm.ppf(0.975)
    expected = 1.0 + 2.0 / 0.05 * 2.0 * (scipy.stats.norm.pdf(z) - 0.025 * z) / (2.0 * z)
    assert expected == pytest.approx(1.19, abs=0.005)
    found = values(table(cases(), claiming(1.0)), "interval_score")["interval_score"]
    assert found == pytest.approx(expected, abs=0.33)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_wrong_sigma_costs(factor: float) -> None:
    """Proper: neither half nor twice the sigma wins, here on the same 200 errors."""
    right, wrong = (values(table(cases(), claiming(f)), "interval_score")["interval_score"] for f in (1.0, factor))
    assert wrong > right * 1.2


def test_an_interval_of_the_methods_own_goes_before_its_sigma() -> None:
    truth = cases(1).truths[0]
    bound = table(cases(1), truth_itself)["pair_bound_depth_m2"][0] ** 0.5
    D = truth.depth_m

    def answer(_: PairTruth) -> Answer:
        return Answer(Spot(truth.down.uv_px), Spot(truth.up.uv_px), D, 1e3, (D - bound, D + 2.0 * bound))

    assert table(cases(1), answer)["interval_score"][0] == pytest.approx(3.0 / (2.0 * 1.959963984540054))
    assert table(cases(1), lambda t: replace(answer(t), interval_depth_m=None))["interval_score"][0] == 20.0


@pytest.mark.parametrize(
    ("document", "tracks"),
    [
        ({"boxes_px": LOCALISE_BOX_PX, "hinted": 12, "track": "localise"}, ("localise",)),
        ({"boxes_px": None, "hinted": 0, "track": "depth"}, ("find", "depth")),
        ({"boxes_px": None, "hinted": 0}, ("find", "depth")),
        ({"boxes_px": None, "hinted": 3}, ()),
        ({"boxes_px": LOCALISE_BOX_PX, "hinted": 12}, ()),
        ({}, ()),
    ],
)
def test_the_pair_set_tells_its_tracks(document: dict[str, object], tracks: tuple[str, ...]) -> None:
    assert tracks_of(document) == tracks


def test_every_number_has_an_interval() -> None:
    found = metric_estimates(table(cases(), sampler()), RULES, "test", names=NAMES)
    for name in set(NAMES) - {"false_per_empty"}:
        low, value, high = (getattr(found[name].estimate, key) for key in ("low", "value", "high"))
        assert low <= value <= high, name
