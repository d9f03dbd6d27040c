"""Comparison of two scores of the same pairs: paired differences with intervals and tests; tables; notes on mismatches.

Errors are compared over the images (or pairs) that both methods found. A method that skips the hard ones gains nothing
from it. Rates, and figures that count missed spots, are compared over all visible spots.

Both scores are resampled together, and every metric has its own interval. The verdict does not come from the intervals.
It comes from an exact test (`exchange_chance`), corrected for the number of metrics (`holm`). Of
two methods of the same law, any metric at all is called different in at most 1 - `confidence` of the comparisons.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl

from phibench.benchmark.pair_sets.dataset_pairs import tracks_of
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.intervals import AT_ONCE, NO_SPREAD, Clusters, Estimate, Statistic, estimates, mean_of
from phibench.benchmark.scores.metrics import (
    FAMILIES,
    METRICS,
    Metric,
    prepared_records,
    statistic_of,
    trusted_estimate,
)
from phibench.benchmark.scores.records import missed_relative, with_missed
from phibench.benchmark.scores.score_document import ScoreDocument
from phibench.benchmark.scores.score_files import read_records, read_score
from phibench.benchmark.scores.score_tables import DIGITS, cell_parts, number
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.shown_text import TextTable, csv_table, latex, markdown, show_grid, table_console
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import Name, generator

COMPARED = (
    "rank_phi_rad",
    "rank_depth",
    "rms_counted_px",
    "rms_px",
    "median_px",
    "p95_px",
    "rms_radial_px",
    "rms_phi_rad",
    "rms_depth_counted",
    "rms_depth_relative",
    "median_depth_relative",
    "p95_depth_relative",
    "detection_rate",
    "false_rate",
    "depth_rate",
    "seconds",
)
_KEY = ("number", "image")
_TRUTH = ("sample_id", "draw", "depth_m", "u_true_px", "v_true_px", "visible")
# of a pair set: how much of it was taken, with which versions
_MAY_DIFFER = ("pairs", "samples", "hinted", "provenance", "frames_set_sha256")

_TOLD = 3  # methods that a note names

_NOTHING = Estimate(np.nan, np.nan, np.nan, "no record counts for both")

Verdict = Literal["first", "second", "no difference shown", "too few samples"]


@dataclass(frozen=True)
class Difference:
    """One metric of both scores and the second minus the first.

    Attributes
    ----------
    name : key of `METRICS`
    first, second : float
        Values over the records that count for both.
    chance : float
        Of a difference as large between two methods of the same law; not corrected for the number of metrics.
    better : "first", "second", "no difference shown" or "too few samples"
        Which is better, only if `chance` is small enough beside those of all metrics.
    """

    name: str
    first: float
    second: float
    difference: Estimate
    n: int
    samples: int
    chance: float
    better: Verdict


def compare(first: Path, second: Path, seed: int = 0) -> list[Difference]:
    """Compare two scores on disk.

    Raises
    ------
    DatasetError
        If they were not taken on the same pairs by the same rules.
    """
    a, b = read_score(first), read_score(second)
    refuse_different(a, b, str(first), str(second))
    return compare_records(read_records(first, a), read_records(second, b), rules_of(a.rules), "compare", seed)


def compare_records(first: pl.DataFrame, second: pl.DataFrame, rules: Rules, *stream: Name) -> list[Difference]:
    """Compare two tables of records over the pairs that both have.

    Raises
    ------
    DatasetError
        If they share no pair, or a pair's truth differs.
    """
    a, b = _common(first, second, rules)
    differences = [_difference(name, a, b, rules, *stream) for name in COMPARED]
    return _judged(differences, {name: METRICS[name].better for name in COMPARED}, rules)


StatisticOf = Callable[[Clusters, pl.DataFrame], Statistic]


def metric_differences(
    metrics: Mapping[str, tuple[pl.DataFrame, pl.DataFrame, StatisticOf]],
    better: Mapping[str, str],
    rules: Rules,
    *stream: Name,
) -> list[Difference]:
    """Differences of any metrics, each of two tables of the same records and what makes a statistic of one.

    Tables have a column `sample_id`. `better` is "lower" or "higher" by metric; of others no verdict is given.
    """
    differences = []
    for name, (a, b, statistic_of_rows) in metrics.items():
        clusters = Clusters.of(a["sample_id"].to_list())
        if clusters.n == 0:
            differences.append(Difference(name, np.nan, np.nan, _NOTHING, 0, 0, np.nan, "too few samples"))
            continue
        both = Clusters(np.concatenate([clusters.index, clusters.n + clusters.index]), 2 * clusters.n)
        tested = statistic_of_rows(both, pl.concat([a, b]))
        drawn = _drawn(name, statistic_of_rows(clusters, a), statistic_of_rows(clusters, b), clusters, rules, *stream)
        item = replace(drawn, n=len(a))
        if clusters.n >= rules.least_compared and better[name] in ("lower", "higher"):
            chance = exchange_chance(tested, clusters.n, rules, generator(*stream, name, "exchange"))
            item = replace(item, chance=chance, better="no difference shown")
        differences.append(item)
    return _judged(differences, better, rules)


def _drawn(
    name: str, ours: Statistic, theirs: Statistic, clusters: Clusters, rules: Rules, *stream: Name
) -> Difference:
    """Difference of two statistics with its interval, without a verdict."""
    everything = np.ones((1, clusters.n))
    (drawn,) = estimates([_minus(theirs, ours)], clusters.n, rules, generator(*stream, name))
    first, second = (float(statistic(everything)[0]) for statistic in (ours, theirs))
    return Difference(name, first, second, drawn, 0, clusters.n, np.nan, "too few samples")


def _judged(differences: Sequence[Difference], better: Mapping[str, str], rules: Rules) -> list[Difference]:
    """Differences with a verdict where the exact test, corrected for their number, shows one."""
    shown = holm([item.chance for item in differences], 1.0 - rules.confidence)
    return [
        replace(item, better=_verdict(item, better[item.name])) if is_shown else item
        for item, is_shown in zip(differences, shown, strict=True)
    ]


def refuse_different(first: ScoreDocument, second: ScoreDocument, first_name: str, second_name: str) -> None:
    """Raise `DatasetError` unless both scores were taken on the same pair set by the same rules."""
    for what, a, b in (("pair sets", same_pairs(first), same_pairs(second)), ("rules", first.rules, second.rules)):
        for key in sorted(set(a) | set(b)):
            if a.get(key) != b.get(key):
                if key in ("track", "boxes_px"):
                    raise DatasetError(_other_boxes(first, second, first_name, second_name))
                raise DatasetError(
                    f"{first_name} and {second_name} have different {what}: {key} is {_short(a.get(key))} and "
                    f"{_short(b.get(key))}; score both methods on the same pairs"
                )


def _other_boxes(first: ScoreDocument, second: ScoreDocument, first_name: str, second_name: str) -> str:
    """Sentence on two scores whose methods were shown other boxes."""
    shown = {first_name: same_pairs(first)["track"], second_name: same_pairs(second)["track"]}
    told = " and ".join(f"{name} ({f'track {track}' if track else 'no track'})" for name, track in shown.items())
    known = [track for track in shown.values() if track]
    advice = f"--track {known[0]}" if known else "the same --boxes"
    return f"{told} were shown other boxes: score both with {advice}"


def note_on_size(differences: Sequence[Difference], rules: Mapping[str, float], samples: int) -> str:
    """Sentence on what would give a verdict, if no metric can have one; empty if some can.

    Parameters
    ----------
    differences : of `compare`
    rules : of the scores
    samples : that both scores have
    """
    if any(item.better != "too few samples" for item in differences):
        return ""  # there are verdicts
    least = int(rules["least_compared"])
    if samples >= least:
        return (
            f"Too few samples for a verdict: every metric counts fewer than {least} of the {samples} that both have. "
            "The methods find too few spots together: score them on easier pairs, or with --track localise."
        )
    return (
        f"Too few samples for a verdict: both have {samples}, {least} are the least, and more draws of a sample do "
        f"not count. Score both on a data set of {least} samples or more: `samples` of [random] in a recipe, or "
        "bench-dev."
    )


def note_on_code(first: ScoreDocument, second: ScoreDocument) -> str:
    """A warning if the code or the libraries that drew the frames differ between the runs; empty if not."""
    a, b = (document.provenance for document in (first, second))
    changed = [key for key in ("code_sha256", "packages") if a.get(key) != b.get(key)]
    if not changed:
        return ""  # the same program made both
    return (
        f"the two runs differ in {' and '.join(changed)}: the frames may not be the same; score both again to be sure"
    )


def note_on_pairs(first: ScoreDocument, second: ScoreDocument, first_name: str, second_name: str) -> str:
    """A warning if two scores count different numbers of the same set's pairs; empty if not."""
    if first.pairs == second.pairs:
        return ""  # the same number
    return (
        f"{first_name} counts {first.pairs} pairs and {second_name} {second.pairs}: the differences are over the pairs "
        "that both have"
    )


def note_on_others(mine: Sequence[ScoreDocument], every: Sequence[ScoreDocument]) -> str:
    """A warning for scores that stand together if others of the same set count another number of pairs.

    Parameters
    ----------
    mine : scores of the same pairs
    every : these and all others
    """
    first = mine[0]
    apart = [score for score in every if same_pairs(score) == same_pairs(first) and score.pairs != first.pairs]
    if not apart:
        return ""
    told = ", ".join(f"{score.method.name} ({score.pairs})" for score in apart[:_TOLD])
    more = f" and {len(apart) - _TOLD} more" if len(apart) > _TOLD else ""
    return f"{first.pairs} pairs are counted here, other numbers elsewhere: {told}{more}; such scores do not compare"


def same_pairs(document: ScoreDocument) -> dict[str, Any]:
    """Entries of a score's pair set that must be equal for two scores to be of the same pairs.

    Whole frames are the same pairs, whether they were asked for as `find`, as `depth`, or are all that the set has.
    """
    pair_set = {"track": "", **document.pair_set}
    if tracks := tracks_of(pair_set):
        pair_set["track"] = tracks[0]
    return {key: value for key, value in pair_set.items() if key not in _MAY_DIFFER}


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def rules_of(numbers: Mapping[str, float]) -> Rules:
    """Rules of a score as its document has them."""
    whole = {name: int(numbers[name]) for name in ("resamples", "least_samples", "least_compared")}
    return Rules(**{**numbers, **whole})  # type: ignore[arg-type]


def _common(first: pl.DataFrame, second: pl.DataFrame, rules: Rules) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Both tables with the rows that both have, in the same order; a miss costs what these rows make of it."""
    a, b = (x.join(y, on=_KEY, how="semi").sort(*_KEY) for x, y in ((first, second), (second, first)))
    if not len(a):
        raise DatasetError("the two scores have no pair in common: score both methods on the same pairs")
    if not a.select(_TRUTH).equals(b.select(_TRUTH), null_equal=True):
        raise DatasetError("the two scores have other truths for the same pairs: score both methods on the same pairs")
    missed = missed_relative(a, rules)
    return prepared_records(with_missed(a, missed)), prepared_records(with_missed(b, missed))


def _difference(name: str, a: pl.DataFrame, b: pl.DataFrame, rules: Rules, *stream: Name) -> Difference:
    metric = METRICS[name]
    both = _flag(a, metric.family) & _flag(b, metric.family)
    a, b = a.filter(both), b.filter(both)
    clusters = Clusters.of(a["sample_code"].to_numpy())
    if clusters.n == 0:
        return Difference(name, np.nan, np.nan, _NOTHING, 0, 0, np.nan, "too few samples")
    ours, theirs = (statistic_of(metric, clusters, table) for table in (a, b))
    drawn = _drawn(name, ours, theirs, clusters, rules, *stream)
    item = replace(drawn, difference=trusted_estimate(metric, drawn.difference, clusters.n), n=len(a))
    if clusters.n < rules.least_compared:
        return item
    tested = _tested(metric, clusters, pl.concat([a, b], how="vertical_relaxed"))
    chance = exchange_chance(tested, clusters.n, rules, generator(*stream, name, "exchange"))
    return replace(item, chance=chance, better="no difference shown")


def _tested(metric: Metric, clusters: Clusters, joined: pl.DataFrame) -> Statistic:
    """Statistic that `exchange_chance` tests: the metric, or the share of records above the quantile of both methods.

    Where two methods differ much, a quantile of exchanged answers is either method's by chance, and tells nothing. The
    quantile of all answers stays as it is (A. M. Mood, Introduction to the Theory of Statistics, 1950, 16.5).
    """
    both = Clusters(np.concatenate([clusters.index, clusters.n + clusters.index]), 2 * clusters.n)
    if metric.kind not in ("median", "p95"):
        return statistic_of(metric, both, joined)
    values = joined[metric.columns[0]].abs().to_numpy()
    pooled = statistic_of(metric, both, joined)(np.ones((1, both.n)))[0]
    return mean_of(both, np.heaviside(values - pooled, 0.5))


def _flag(table: pl.DataFrame, family: str) -> pl.Series:
    return table.with_columns(flag=FAMILIES[family])["flag"]


def _minus(second: Statistic, first: Statistic) -> Statistic:
    def difference(weights: Array) -> Array:
        return second(weights) - first(weights)

    return difference


def _verdict(item: Difference, better: str) -> Verdict:
    return "second" if (item.second < item.first) == (better == "lower") else "first"


_BETTER = {"no difference shown": "not shown", "too few samples": "not shown"}


def comparison(differences: Sequence[Difference], first: str, second: str, wide: bool = False) -> TextTable:
    """One row per metric: both values, second minus first with its interval, and which is better if that is shown."""
    rows = []
    for item in differences:
        metric = METRICS[item.name]
        factor, unit = metric.shown
        values = (number(factor * x, DIGITS, significant=True) for x in (item.first, item.second))
        change = cell_parts(item.difference, factor, DIGITS, significant=True)
        counts = (str(item.n), str(item.samples), number(item.chance, 4)) if wide else ()
        rows.append((metric.text, unit, *values, *change, *counts, _BETTER.get(item.better, item.better)))
    counted = ("n", "samples", "chance") if wide else ()
    heads = ("metric", "unit", "first", "second", "second\n- first", "interval", *counted, "better")
    columns = "LlrrrL" + "r" * len(counted) + "L"
    return TextTable(f"Over what both have. First: {first}. Second: {second}", heads, tuple(rows), columns)


def print_comparison(differences: Sequence[Difference], first: str, second: str, form: str, wide: bool) -> None:
    """Print a comparison; parameters as for `print_scores`."""
    grid = comparison(differences, first, second, wide)
    if form == "terminal":
        show_grid(table_console(wide), grid)
    else:
        texts = {"csv": lambda: differences_csv(differences), "json": lambda: differences_json(differences)}
        texts |= {"markdown": lambda: markdown(grid), "latex": lambda: latex(grid)}
        sys.stdout.write(texts[form]())


def differences_csv(differences: Sequence[Difference]) -> str:
    """One row per metric, in the units of the files, in full."""
    return csv_table(
        list(_difference_fields(differences[0])), [list(_difference_fields(d).values()) for d in differences]
    )


def differences_json(differences: Sequence[Difference]) -> str:
    """One JSON object: metric to values and difference."""
    fields = {d.name: {key: x for key, x in _difference_fields(d).items() if key != "metric"} for d in differences}
    return json.dumps(fields, indent=1, allow_nan=False) + "\n"


def _difference_fields(d: Difference) -> dict[str, str | float | int | None]:
    numbers = {"first": d.first, "second": d.second, "difference": d.difference.value}
    numbers |= {"low": d.difference.low, "high": d.difference.high}
    finite = {name: x if math.isfinite(x) else None for name, x in numbers.items()}
    return {
        "metric": d.name,
        "unit": METRICS[d.name].unit,
        **finite,
        "n": d.n,
        "samples": d.samples,
        "chance": d.chance if math.isfinite(d.chance) else None,
        "better": d.better,
    }


def exchange_chance(statistic: Statistic, n: int, rules: Rules, rng: np.random.Generator) -> float:
    """Chance of a difference as large as that of two methods if nothing tells them apart; NaN where there is none.

    The methods' answers on each of n samples are exchanged with a chance of one half, `Rules.resamples` times. The
    share of differences at least as large, the observed one included, is the p-value of an exact test of the hypothesis
    that both methods have the same law. It is below alpha with a chance of at most alpha, for every n and statistic
    (E. J. G. Pitman, Suppl. J. R. Stat. Soc. 4, 119, 1937).

    Parameters
    ----------
    statistic : of 2 n samples, the first method's n, then the second's
    """
    stay = np.zeros((1, n))
    first, second = _exchanged(statistic, stay)
    observed = abs(float(second[0] - first[0]))
    if not math.isfinite(observed):
        return math.nan
    # what differs by the rounding of sums alone is as large
    least = observed - NO_SPREAD * max(abs(float(first[0])), abs(float(second[0])))
    rows, larger = max(1, AT_ONCE // (2 * n)), 0
    for start in range(0, rules.resamples, rows):
        flips = rng.integers(0, 2, (min(rows, rules.resamples - start), n)).astype(float)
        one, other = _exchanged(statistic, flips)
        larger += int(np.count_nonzero(~(np.abs(other - one) < least)))  # one without a value counts as larger
    # the order as it is counts as one of all: never a chance of 0
    return (1.0 + larger) / (1.0 + rules.resamples)


def _exchanged(statistic: Statistic, flips: Array) -> tuple[Array, Array]:
    """Values of both methods where the answers of samples, `flips` of shape (b, n), are exchanged."""
    return statistic(np.hstack([1.0 - flips, flips])), statistic(np.hstack([flips, 1.0 - flips]))


def holm(chances: Sequence[float], alpha: float) -> list[bool]:
    """Rejections of several hypotheses, with a chance of at most alpha that any true one is rejected; NaN never is.

    S. Holm, Scand. J. Stat. 6, 65 (1979): the smallest p-value against alpha / m, the next against alpha / (m - 1), and
    so on until one is larger. The tests may depend on each other.
    """
    order = sorted((k for k, chance in enumerate(chances) if not math.isnan(chance)), key=lambda k: chances[k])
    rejected = [False] * len(chances)
    for left, k in zip(range(len(order), 0, -1), order, strict=True):
        if chances[k] > alpha / left:
            break  # Holm: what comes later is larger
        rejected[k] = True
    return rejected
