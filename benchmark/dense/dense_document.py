"""JSON score document of a dense method: its models, its maker, and strata of records by stroke, room and preset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import polars as pl
from pydantic import Field

from phibench.benchmark.dense.dense_metrics import DENSE_METRICS, measure_dense
from phibench.benchmark.scores.answer_errors import Rules
from phibench.benchmark.scores.metrics import MetricEstimate
from phibench.benchmark.scores.score_document import MethodCard, MetricDescription, Value, results_sha256
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.store.provenance import code_behind, program_version, provenance
from phibench.datasets.store.schema import Document

KIND: Literal["phibench dense score"] = "phibench dense score"
VERSION = 1
SCORER = "phibench.benchmark.dense.dense_score"
COMMAND = "phibench dense score ... --out"


class DenseStratum(Document):
    """Metrics of a part of the pixels, or of the pairs."""

    by: str
    label: str
    pixels: int
    pairs: int
    metrics: Mapping[str, Value]


class DenseScore(Document):
    """One run of one dense method on one set of dense pairs."""

    kind: Literal["phibench dense score"]
    version: int
    method: MethodCard
    pair_set: dict[str, Any]
    pairs: int
    samples: int
    pixels: int = Field(description="that count, of all pairs")
    seed: int
    rules: dict[str, float]
    limits: dict[str, Any]
    isolation: str = Field(default="", description="what the method could reach: `Isolation.sentence`")
    provenance: dict[str, Any]
    program: str = ""
    code_sha256: str = Field(description="of everything behind the score")
    metrics: dict[str, MetricDescription] = Field(description="of the whole: `jq .metrics.recall.value`")
    strata: list[DenseStratum] = Field(description="parts of the whole")
    failures: dict[str, int] = Field(description="pairs on which the method failed, by the harness's word")
    records: str = Field(description="name of the Parquet file")
    records_sha256: str
    results_sha256: str = ""


def dense_document(
    method: MethodCard,
    pair_set: Mapping[str, Any],
    table: pl.DataFrame,
    rules: Rules,
    seed: int,
    limits: Mapping[str, Any],
    isolation: str,
) -> DenseScore:
    """Score of complete records."""
    whole = table.filter(pl.col("by") == "all")
    if not len(whole):
        raise DatasetError("the set of dense pairs is empty: there is nothing to score")
    failures = whole.filter(pl.col("failure") != "").group_by("failure").len().sort("failure").rows()
    measured = measure_dense(whole, rules, "dense", seed, "all")
    return DenseScore(
        kind=KIND,
        version=VERSION,
        method=method,
        pair_set=dict(pair_set),
        pairs=len(whole),
        samples=whole["sample_id"].n_unique(),
        pixels=int(whole["pixels"].sum()),
        seed=seed,
        rules={name: float(value) for name, value in asdict(rules).items()},
        limits=dict(limits),
        isolation=isolation,
        provenance=dict(provenance()),
        program=program_version(),
        code_sha256=code_behind(SCORER),
        metrics={name: _described(name, value) for name, value in measured.items()},
        strata=[_stratum(*part, rules, seed) for part in dense_strata(table)],
        failures=dict(failures),
        records="",
        records_sha256="",
        results_sha256=results_sha256(table),
    )


_STROKES_M = (0.0, 0.3, 0.6, 0.9, np.inf)


def dense_strata(table: pl.DataFrame) -> list[tuple[str, str, pl.DataFrame]]:
    """Parts of the records: those of pixels in their order, then pairs by stroke, room and preset."""
    keys = table.filter(pl.col("by") != "all").select("by", "label").unique(maintain_order=True).rows()
    parts = [(by, label, table.filter((pl.col("by") == by) & (pl.col("label") == label))) for by, label in keys]
    whole = table.filter(pl.col("by") == "all")
    for low, high in pairwise(_STROKES_M):
        label = f"from {low:g} m" if np.isinf(high) else f"{low:g} to {high:g} m"
        parts.append(("stroke", label, whole.filter((pl.col("stroke_m") >= low) & (pl.col("stroke_m") < high))))
    for by in ("room", "preset"):
        parts += [(by, value, whole.filter(pl.col(by) == value)) for value in whole[by].unique().sort()]
    return [part for part in parts if len(part[2]) and not part[2].equals(whole)]


def _described(name: str, value: MetricEstimate) -> MetricDescription:
    metric = DENSE_METRICS[name]
    return MetricDescription.of(value, unit=metric.unit, better=metric.better, text=metric.text)


def _stratum(by: str, label: str, rows: pl.DataFrame, rules: Rules, seed: int) -> DenseStratum:
    measured = measure_dense(rows, rules, "dense", seed, by, label)
    values = {name: Value.of(value) for name, value in measured.items()}
    return DenseStratum(by=by, label=label, pixels=int(rows["pixels"].sum()), pairs=len(rows), metrics=values)
