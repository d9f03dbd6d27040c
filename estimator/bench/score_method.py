"""A method's score on a pair set: run it, join answers and truth, measure, name causes, keep the worst."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import polars as pl

from phibench.datasets.code_hash import code_behind
from phibench.datasets.provenance import provenance
from phibench.estimator.bench.causes import count, count_failures, with_causes
from phibench.estimator.bench.document import KIND, VERSION, MethodCard, ScoreDocument, StratumScore, Value, finite
from phibench.estimator.bench.metrics import METRICS
from phibench.estimator.bench.pair_set import PairSet
from phibench.estimator.bench.records import in_order, record_table
from phibench.estimator.bench.rules import Rules
from phibench.estimator.bench.strata import Stratum, count_pairs, measured, strata
from phibench.estimator.bench.worst import worst
from phibench.estimator.seat.outcome import Outcome

Runner = Callable[[str, PairSet], Iterable[Outcome]]
"""Method reference and pairs to outcomes: `seat.harness.run_method` with its limits, or one in this process."""


@dataclass(frozen=True)
class Scored:
    """A score with the records that it was computed from."""

    document: ScoreDocument
    records: pl.DataFrame


def score_method(
    method: MethodCard,
    pairs: PairSet,
    run: Runner,
    rules: Rules | None = None,
    seed: int = 0,
    limits: Mapping[str, Any] | None = None,
) -> Scored:
    """Run a method on all pairs of a set and score it.

    Parameters
    ----------
    method : MethodCard
    pairs : PairSet
    run : Runner
    rules : Rules, by default the usual ones
    seed : int
        Of the bootstrap; 0 or above.
    limits : the runner's, for the record

    Raises
    ------
    DatasetError
        If the set is sealed or empty, or an outcome belongs to no pair.
    """
    return score_outcomes(method, pairs, run(method.reference, pairs), rules or Rules(), seed, limits or {})


def score_outcomes(
    method: MethodCard,
    pairs: PairSet,
    outcomes: Iterable[Outcome],
    rules: Rules,
    seed: int = 0,
    limits: Mapping[str, Any] | None = None,
) -> Scored:
    """Score what a method has answered; parameters as for `score_method`."""
    ordered = in_order(outcomes, len(pairs))
    truths = [pairs.truth(outcome.number) for outcome in ordered]  # once: a bound is not computed in no time
    table = record_table(truths, ordered, rules)
    table = with_causes(table, {truth.number: truth for truth in truths}, pairs.pair, rules)
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
        limits=dict(limits or {}),
        provenance=dict(provenance()),
        code_sha256=code_behind(__name__),
        metrics={n: {"unit": m.unit, "better": m.better, "text": m.text} for n, m in METRICS.items()},
        strata=[_stratum(stratum, rules, seed) for stratum in strata(table)],
        causes=count(table),
        failures=count_failures(table),
        worst=worst(table, pairs.pair),
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
