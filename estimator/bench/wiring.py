"""Where a benchmark finds the harness, the built-in methods, the score and the report.

They are looked up when they are needed: reading and sealing a set needs none of them.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from phibench.datasets.errors import DatasetError
from phibench.estimator.bench.pair_set import PairSet
from phibench.estimator.seat.outcome import Outcome

Run = Callable[[str, PairSet], Sequence[Outcome]]
"""Runs a method, given by its reference, on all pairs of a set."""
Describe = Callable[[str], Mapping[str, str | None]]
"""What is known of a method, given by its reference: name, kind, place, function, sha256, version."""
Score = Callable[[Mapping[str, str | None], PairSet, Sequence[Outcome], Path | None], dict[str, Any]]
"""Scores outcomes of a method, given by its description, and writes the score, if a JSON file is given."""
Report = Callable[[Sequence[Path], Path], Path]
"""Writes one HTML page about score files."""


def harness(workers: int | None = None) -> Run:
    """Return what runs methods in processes of their own."""
    run_method = _found("phibench.estimator.seat.harness", "run_method")
    options = {} if workers is None else {"workers": workers}
    return lambda method, pairs: list(run_method(method, pairs, **options))


def describer() -> Describe:
    """Return what finds a method and describes it."""
    resolve = _found("phibench.estimator.seat.resolve", "resolve")
    return lambda method: dict(resolve(method).document())


def built_in() -> Mapping[str, Any]:
    """Methods that come with phibench, by name; each says with `refusal(pair)` what it cannot take."""
    methods: Mapping[str, Any] = _found("phibench.estimator.methods.registry", "METHODS")
    return methods


def scorer() -> Score:
    """Return what scores outcomes."""
    score_outcomes = _found("phibench.estimator.bench.score_method", "score_outcomes")
    card, write = (_found("phibench.estimator.bench.document", name) for name in ("MethodCard", "write_score"))
    rules = _found("phibench.estimator.bench.rules", "Rules")

    def score(
        method: Mapping[str, str | None], pairs: PairSet, outcomes: Sequence[Outcome], path: Path | None
    ) -> dict[str, Any]:
        found = score_outcomes(card.of(method["name"], **method), pairs, outcomes, rules())
        document = found.document if path is None else write(path, found.document, found.records)
        as_json: dict[str, Any] = document.model_dump(mode="json")
        return as_json

    return score


def reporter() -> Report:
    """Return what writes the report."""
    report: Report = _found("phibench.estimator.bench.report", "write_report")
    return report


def _found(module: str, name: str) -> Any:
    try:
        return getattr(importlib.import_module(module), name)
    except (ModuleNotFoundError, AttributeError) as error:
        raise DatasetError(f"{module} has no {name}: this phibench is incomplete; install it again") from error
