"""Scores in two formats of others: Every Eval Ever (a JSON file a score), and the Hugging Face Hub's `.eval_results`.

Both were read in November 2026: `eval.schema.json` 0.3.0 of github.com/evaleval/every_eval_ever, and
huggingface.co/docs/hub/eval-results. The Hub takes one number a task; ours is the number that ranks a track.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from phibench.benchmark.pair_sets.dataset_pairs import tracks_of
from phibench.benchmark.reports.track_tables import preset_name
from phibench.benchmark.scores.score_document import MetricDescription, ScoreDocument
from phibench.benchmark.scores.score_files import read_score
from phibench.benchmark.scores.score_tables import RANKS_OF_TRACKS, rig_known
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.store.files import write_text

SCHEMA = "0.3.0"
"""Version of Every Eval Ever's schema."""
_ALSO = ("rank_phi_rad", "rank_depth", "detection_rate", "false_rate", "median_px", "rms_px", "pull_deviation")
_CONFIDENCE = 0.95


def write_eval_records(files: Sequence[Path], out: Path, dataset_id: str, organization: str) -> list[Path]:
    """Write both formats of score files: `every_eval_ever/*.json` and `.eval_results/*.yaml` below `out`.

    Parameters
    ----------
    files : JSON files of `score --out`
        Their time of writing is that of the records.
    dataset_id : str
        Of the data set on the Hub, ORGANIZATION/NAME.
    organization : str
        That ran the scores.

    Raises
    ------
    DatasetError
        If a score cannot be read, the data set has no such name, or two scores would share a file.
    """
    if dataset_id.count("/") != 1 or not all(dataset_id.split("/")):
        raise DatasetError(f"data set '{dataset_id}': give ORGANIZATION/NAME, as the Hub names it")
    if not files:
        raise DatasetError("records of nothing: give the JSON files that `phibench score --out` wrote")
    texts: dict[Path, str] = {}
    for path in files:
        document, when = read_score(path), datetime.fromtimestamp(int(path.stat().st_mtime), UTC)
        stem = f"{file_word(document.method.name)}-{file_word(preset_name(document))}-{document.results_sha256[:8]}"
        record = every_eval_ever(document, dataset_id, organization, when)
        made = {f"every_eval_ever/{stem}.json": json.dumps(record, indent=1, allow_nan=False) + "\n"}
        if entries := hub_entries(document, dataset_id, when):
            made[f".eval_results/{stem}.yaml"] = hub_yaml(entries)
        for name, text in made.items():
            if out / name in texts:
                raise DatasetError(f"{path}: another score has the same method, preset and results; give one of them")
            texts[out / name] = text
    return [write_text(path, text) for path, text in texts.items()]


def file_word(text: str) -> str:
    """Text with what file names do not take replaced."""
    return "".join(letter if letter.isascii() and (letter.isalnum() or letter in "._") else "_" for letter in text)


def every_eval_ever(document: ScoreDocument, dataset_id: str, organization: str, when: datetime) -> dict[str, Any]:
    """Record of a score: each metric with its interval, what was scored, and by which program."""
    method = document.method
    details = {"reference": method.reference, "sha256": method.sha256 or "", "rig": rig_known(document)}
    details["division"] = method.division
    names = [*(RANKS_OF_TRACKS[track] for track in tracks_of(document.pair_set)), *_ALSO]
    return {
        "schema_version": SCHEMA,
        "evaluation_id": f"phibench/{dataset_id}/{method.name}/{int(when.timestamp())}",
        "evaluation_timestamp": when.isoformat(),
        "retrieved_timestamp": str(int(when.timestamp())),
        "source_metadata": {
            "source_name": "phibench",
            "source_type": "evaluation_run",
            "source_organization_name": organization,
            "evaluator_relationship": "first_party" if method.kind == "built-in" else "third_party",
        },
        "eval_library": {
            "name": "phibench",
            "version": document.program or "unknown",
            "additional_details": {"code_sha256": document.code_sha256, "results_sha256": document.results_sha256},
        },
        "model_info": {"name": method.name, "id": f"phibench/{method.name}", "additional_details": details},
        "evaluation_results": [
            _result(name, document, dataset_id)
            for name in dict.fromkeys(names)
            if document.metrics[name].value is not None
        ],
    }


def _result(name: str, document: ScoreDocument, dataset_id: str) -> dict[str, Any]:
    metric = document.metrics[name]
    source = {"dataset_name": dataset_id, "source_type": "hf_dataset", "hf_repo": dataset_id}
    return {
        "evaluation_name": f"{name}, {preset_name(document)}",
        "source_data": source | {"samples_number": document.samples},
        "metric_config": {
            "evaluation_description": f"{metric.text} / {metric.unit}".removesuffix(" / 1"),
            "lower_is_better": metric.better == "lower",
        },
        "score_details": {"score": metric.value, "uncertainty": _uncertainty(metric)},
    }


def _uncertainty(metric: MetricDescription) -> dict[str, Any]:
    told: dict[str, Any] = {"num_samples": metric.samples}
    if metric.low is not None and metric.high is not None:
        interval = {"lower": metric.low, "upper": metric.high, "confidence_level": _CONFIDENCE}
        told["confidence_interval"] = interval | {"method": "BCa bootstrap over samples, or Clopper-Pearson for rates"}
    return told


def hub_entries(document: ScoreDocument, dataset_id: str, when: datetime) -> list[dict[str, Any]]:
    """Entry of each track of a score that has a number."""
    entries = []
    for track in tracks_of(document.pair_set):
        name = RANKS_OF_TRACKS[track]
        value = document.metrics[name].value
        if value is not None:
            word = f"rig {rig_known(document)}; {document.method.division} division"
            task = f"{track}_{file_word(preset_name(document))}"
            note = f"{document.metrics[name].text}; {word}; {document.program}"
            entries.append(
                {
                    "dataset": {"id": dataset_id, "task_id": task},
                    "value": value,
                    "date": when.date().isoformat(),
                    "notes": note,
                }
            )
    return entries


def hub_yaml(entries: Sequence[dict[str, Any]]) -> str:
    """Entries as YAML; strings are quoted as in JSON, which YAML 1.2 holds."""
    lines = []
    for entry in entries:
        lines += ["- dataset:", *(f"    {key}: {json.dumps(text)}" for key, text in entry["dataset"].items())]
        lines += [f"  {key}: {json.dumps(value)}" for key, value in entry.items() if key != "dataset"]
    return "\n".join(lines) + "\n"
