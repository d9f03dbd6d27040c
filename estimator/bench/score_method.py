"""Scores of methods on a pair set: run them, join answers and truth, measure, name causes, keep the worst."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import polars as pl

from phibench.datasets.code_hash import code_behind
from phibench.datasets.errors import DatasetError
from phibench.datasets.provenance import provenance
from phibench.estimator.bench.causes import count, count_failures, with_causes
from phibench.estimator.bench.document import (
    KIND,
    VERSION,
    MethodCard,
    ScoreDocument,
    StratumScore,
    Value,
    Worst,
    finite,
)
from phibench.estimator.bench.held_pairs import HeldPairs
from phibench.estimator.bench.metrics import METRICS
from phibench.estimator.bench.pair_set import PairSet
from phibench.estimator.bench.records import in_order, record_table
from phibench.estimator.bench.rules import Rules
from phibench.estimator.bench.strata import Stratum, count_pairs, measured, strata
from phibench.estimator.bench.worst import worst, worst_of
from phibench.estimator.seat.outcome import Outcome

Ask = Callable[[PairSet, Sequence[int]], Iterable[tuple[Outcome, ...]]]
"""Pairs and numbers to the outcomes of every method: `estimator.seat.harness.Harness.outcomes`."""
AT_ONCE = 16
"""Pairs in memory at a time; one of MJPEG frames with the laser on and off takes 11 MB."""


@dataclass(frozen=True)
class Scored:
    """A score with the records that it was computed from."""

    document: ScoreDocument
    records: pl.DataFrame


@dataclass(frozen=True)
class Examined:
    """Some pairs of one method: records with causes, and its worst images among them."""

    records: pl.DataFrame
    worst: list[Worst]


def score_methods(
    methods: Sequence[MethodCard],
    pairs: PairSet,
    ask: Ask,
    rules: Rules | None = None,
    seed: int = 0,
    limits: Mapping[str, Any] | None = None,
    told: Callable[[int], None] = lambda done: None,
) -> list[Scored]:
    """Run methods on all pairs of a set and score them; each pair is drawn once for all of them.

    Parameters
    ----------
    methods : MethodCards, in the order in which `ask` answers
    pairs : PairSet
    ask : Ask
    rules : Rules, by default the usual ones
    seed : int
        Of the bootstrap; 0 or above.
    limits : the harness's, for the record
    told : callable
        Given the number of pairs that are done, now and then.

    Raises
    ------
    DatasetError
        If the set is sealed or empty, or an outcome belongs to no pair.
    """
    rules = rules or Rules()
    parts: list[list[Examined]] = [[] for _ in methods]
    for start in range(0, len(pairs), AT_ONCE):
        numbers = range(start, min(start + AT_ONCE, len(pairs)))
        held = HeldPairs(pairs)
        answers = list(ask(held, numbers))
        for part, outcomes in zip(parts, zip(*answers, strict=True), strict=True):
            part.append(examine(held, outcomes, rules))
        told(numbers.stop)
    return [
        _scored(method, pairs, part, rules, seed, limits or {}) for method, part in zip(methods, parts, strict=True)
    ]


def score_outcomes(
    method: MethodCard,
    pairs: PairSet,
    outcomes: Iterable[Outcome],
    rules: Rules,
    seed: int = 0,
    limits: Mapping[str, Any] | None = None,
) -> Scored:
    """Score what a method has answered on all pairs; parameters as for `score_methods`."""
    ordered = in_order(outcomes, len(pairs))
    parts = [
        examine(HeldPairs(pairs), ordered[i : i + AT_ONCE], rules) for i in range(0, max(len(ordered), 1), AT_ONCE)
    ]
    return _scored(method, pairs, parts, rules, seed, limits or {})


def examine(pairs: PairSet, outcomes: Sequence[Outcome], rules: Rules) -> Examined:
    """Join outcomes with truth and images."""
    truths = [pairs.truth(outcome.number) for outcome in outcomes]
    table = record_table(truths, outcomes, rules)
    table = with_causes(table, {truth.number: truth for truth in truths}, pairs.pair, rules)
    return Examined(table, worst(table, pairs.pair))


def _scored(
    method: MethodCard,
    pairs: PairSet,
    parts: Sequence[Examined],
    rules: Rules,
    seed: int,
    limits: Mapping[str, Any],
) -> Scored:
    if not parts:
        raise DatasetError("the pair set is empty: there is nothing to score")
    table = pl.concat([part.records for part in parts])
    document = ScoreDocument(
        kind=KIND,
        version=VERSION,
        method=method,
        pair_set=pairs.document(),
        pairs=table["number"].n_unique(),
        images=len(table),
        samples=table["sample_id"].n_unique(),
        seed=seed,
        rules={name: float(value) for name, value in asdict(rules).items()},
        limits=dict(limits),
        provenance=dict(provenance()),
        code_sha256=code_behind(__name__),
        metrics={n: {"unit": m.unit, "better": m.better, "text": m.text} for n, m in METRICS.items()},
        strata=[_stratum(stratum, rules, seed) for stratum in strata(table)],
        causes=count(table),
        failures=count_failures(table),
        worst=worst_of(table, [entry for part in parts for entry in part.worst]),
        records="",
        records_sha256="",
    )
    return Scored(document, table)


def _stratum(stratum: Stratum, rules: Rules, seed: int) -> StratumScore:
    # the same stream for every method: on the same pairs they are resampled alike, so that their intervals compare
    values = measured(stratum, rules, "score", seed)
    return StratumScore(
        by=stratum.by,
        label=stratum.label,
        low=finite(stratum.low),
        high=finite(stratum.high),
        mean=finite(stratum.mean),
        images=len(stratum.images),
        pairs=count_pairs(stratum),
        metrics={name: Value.of(value) for name, value in values.items()},
    )
