"""The small files of a data set as bytes, known from plan and journal: each can be checked and written anew."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path

from phibench.datasets import layout
from phibench.datasets.files import write_bytes
from phibench.datasets.journal import Entry, Head
from phibench.datasets.manifest import manifest_documents
from phibench.datasets.plan import PairPlan, Plan
from phibench.datasets.rigs import rigs_text
from phibench.datasets.schema import ManifestRow
from phibench.datasets.sums import sums_text
from phibench.datasets.work import sample_task_name, spot_task_name
from phibench.scenes.rig import POSITIONS


def documents(plan: Plan, head: Head, entries: Mapping[str, Entry]) -> dict[str, bytes]:
    """All small files of a finished data set by name, SHA256SUMS last."""
    rows = [_row(pair, entries) for pair in plan.pairs]
    small = {
        layout.INFO: head.info.encode(),
        layout.RECIPE: head.recipe.encode(),
        layout.RIGS: rigs_text(plan.rigs).encode(),
        **manifest_documents(rows),
    }
    hashes = {name: digest for entry in entries.values() for name, digest in entry.files.items()}
    hashes |= {name: hashlib.sha256(data).hexdigest() for name, data in small.items()}
    return {**small, layout.SUMS: sums_text(hashes).encode()}


def _row(pair: PairPlan, entries: Mapping[str, Entry]) -> ManifestRow:
    """Row of a sample: what its spot's task found, and the noise that was known when its views were there."""
    row, noise = dict(entries[spot_task_name(pair)].result), entries[sample_task_name(pair)].result
    row |= {position: {**row[position], "noise": noise[position]} for position in POSITIONS}
    return ManifestRow.model_validate_json(json.dumps(row))


def unlike(out: Path, wanted: Mapping[str, bytes]) -> list[str]:
    """Names of files that are missing or have other bytes."""
    return [name for name, data in wanted.items() if not (out / name).is_file() or (out / name).read_bytes() != data]


def write_documents(out: Path, wanted: Mapping[str, bytes], names: Iterable[str]) -> None:
    """Write some of them, in their order. Without SHA256SUMS the folder does not pass for finished."""
    names = set(names)
    if names:
        (out / layout.SUMS).unlink(missing_ok=True)
        names.add(layout.SUMS)
    for name, data in wanted.items():
        if name in names:
            write_bytes(out / name, data)
