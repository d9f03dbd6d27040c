"""Comparison of two scores of the same pairs: paired differences with intervals over the samples that both have.

Errors are compared over the images (or pairs) that both methods found. A method that skips the hard ones gains nothing
from it. Rates, and figures that count missed spots, are compared over all visible spots.

Both scores are resampled together, and every metric has its own interval. The intervals are not corrected for the
number of metrics: at 95 %, one metric in twenty favours one of two equal methods.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl

from phibench.datasets.errors import DatasetError
from phibench.estimator.benchmark.answer_errors import Rules
from phibench.estimator.benchmark.document import ScoreDocument, read_records, read_score
from phibench.estimator.benchmark.intervals import Clusters, Estimate, Statistic, estimates
from phibench.estimator.benchmark.metrics import FAMILIES, METRICS, Metric, prepared, statistic_of, trusted
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
_MAY_DIFFER = ("pairs", "samples", "hinted", "provenance")

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
    difference : Estimate
    n, samples : int
    better : "first", "second", "no difference shown" or "too few samples"
        Which is better, only if the interval of the difference excludes 0; or that there is no interval.
    """

    name: str
    first: float
    second: float
    difference: Estimate
    n: int
    samples: int
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
    return compare_records(read_records(first, a), read_records(second, b), _rules(a.rules), "compare", seed)


def compare_records(first: pl.DataFrame, second: pl.DataFrame, rules: Rules, *stream: Name) -> list[Difference]:
    """Compare two tables of records over the pairs that both have.

    Raises
    ------
    DatasetError
        If they share no pair, or a pair's truth differs.
    """
    a, b = _common(first, second)
    return [_difference(name, a, b, rules, *stream) for name in COMPARED]


def refuse_different(first: ScoreDocument, second: ScoreDocument, first_name: str, second_name: str) -> None:
    """Raise `DatasetError` unless both scores were taken on the same pair set by the same rules."""
    for what, a, b in (("pair sets", same_pairs(first), same_pairs(second)), ("rules", first.rules, second.rules)):
        for key in sorted(set(a) | set(b)):
            if a.get(key) != b.get(key):
                raise DatasetError(
                    f"{first_name} and {second_name} have different {what}: {key} is {_short(a.get(key))} and "
                    f"{_short(b.get(key))}; score both methods on the same pairs"
                )


def note_on_code(first: ScoreDocument, second: ScoreDocument) -> str:
    """A warning if the code or the libraries that drew the frames differ between the runs; empty if not."""
    a, b = (document.provenance for document in (first, second))
    changed = [key for key in ("code_sha256", "packages") if a.get(key) != b.get(key)]
    if not changed:
        return ""
    return (
        f"the two runs differ in {' and '.join(changed)}: the frames may not be the same; score both again to be sure"
    )


def same_pairs(document: ScoreDocument) -> dict[str, Any]:
    """Entries of a score's pair set that must be equal for two scores to be of the same pairs."""
    return {key: value for key, value in document.pair_set.items() if key not in _MAY_DIFFER}


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _rules(numbers: dict[str, float]) -> Rules:
    whole = {name: int(numbers[name]) for name in ("resamples", "least_samples")}
    return Rules(**{**numbers, **whole})  # type: ignore[arg-type]


def _common(first: pl.DataFrame, second: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Both tables with the rows that both have, in the same order."""
    a, b = (x.join(y, on=_KEY, how="semi").sort(*_KEY) for x, y in ((first, second), (second, first)))
    if not len(a):
        raise DatasetError("the two scores have no pair in common: score both methods on the same pairs")
    if not a.select(_TRUTH).equals(b.select(_TRUTH), null_equal=True):
        raise DatasetError("the two scores have other truths for the same pairs: score both methods on the same pairs")
    return prepared(a), prepared(b)


def _difference(name: str, a: pl.DataFrame, b: pl.DataFrame, rules: Rules, *stream: Name) -> Difference:
    metric = METRICS[name]
    both = _flag(a, metric.family) & _flag(b, metric.family)
    a, b = a.filter(both), b.filter(both)
    clusters = Clusters.of(a["sample_code"].to_numpy())
    if clusters.n == 0:
        return Difference(name, np.nan, np.nan, _NOTHING, 0, 0, "too few samples")
    ours, theirs = (statistic_of(metric, clusters, table) for table in (a, b))
    everything = np.ones((1, clusters.n))
    (drawn,) = estimates([_minus(theirs, ours)], clusters.n, rules, generator(*stream, name))
    difference = trusted(metric, drawn, clusters.n)
    first, second = (float(statistic(everything)[0]) for statistic in (ours, theirs))
    return Difference(name, first, second, difference, len(a), clusters.n, _verdict(metric, difference))


def _flag(table: pl.DataFrame, family: str) -> pl.Series:
    return table.with_columns(flag=FAMILIES[family])["flag"]


def _minus(second: Statistic, first: Statistic) -> Statistic:
    def difference(weights: Array) -> Array:
        return second(weights) - first(weights)

    return difference


def _verdict(metric: Metric, difference: Estimate) -> Verdict:
    if not (np.isfinite(difference.low) and np.isfinite(difference.high)):
        return "too few samples"
    if metric.better == "none" or not (difference.low > 0.0 or difference.high < 0.0):
        return "no difference shown"
    second_is_lower = difference.high < 0.0
    return "second" if second_is_lower == (metric.better == "lower") else "first"
