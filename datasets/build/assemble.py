"""Assembly of a data set: its small files as bytes, from plan and journal. Each can be checked and written anew."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from phibench.datasets.build.journal import Entry, Head
from phibench.datasets.build.task_list import sample_task_name, spot_task_name
from phibench.datasets.plan.plan import PairPlan, Plan
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import checksums_text
from phibench.datasets.store.documents import manifest_documents, rigs_text
from phibench.datasets.store.files import write_bytes
from phibench.datasets.store.schema import ManifestRow
from phibench.scenes.rig import POSITIONS


def assemble(plan: Plan, head: Head, entries: Mapping[str, Entry]) -> dict[str, bytes]:
    """All small files of a finished data set by name, SHA256SUMS last."""
    rows = [_row(pair, entries) for pair in plan.pairs]
    small = {
        schema.INFO: head.info.encode(),
        schema.RECIPE: head.recipe.encode(),
        schema.RIGS: rigs_text(plan.rigs).encode(),
        **manifest_documents(rows),
    }
    hashes = {name: digest for entry in entries.values() for name, digest in entry.files.items()}
    hashes |= {name: hashlib.sha256(data).hexdigest() for name, data in small.items()}
    return {**small, schema.CHECKSUMS: checksums_text(hashes).encode()}


def _row(pair: PairPlan, entries: Mapping[str, Entry]) -> ManifestRow:
    """Row of a sample: the result of its spot's task, and the noise from its sample's task."""
    row, noise = dict(entries[spot_task_name(pair)].result), entries[sample_task_name(pair)].result
    row |= {position: {**row[position], "noise": noise[position]} for position in POSITIONS}
    return ManifestRow.model_validate_json(json.dumps(row))


def differing(out: Path, wanted: Mapping[str, bytes]) -> list[str]:
    """Names of files that are missing or have other bytes."""
    return [name for name, data in wanted.items() if not (out / name).is_file() or (out / name).read_bytes() != data]


def write_documents(out: Path, wanted: Mapping[str, bytes], names: Iterable[str]) -> None:
    """Write some of the small files, in their order. Without SHA256SUMS the folder does not pass for finished."""
    names = set(names)
    if names:
        (out / schema.CHECKSUMS).unlink(missing_ok=True)
        names.add(schema.CHECKSUMS)
    for name, data in wanted.items():
        if name in names:
            write_bytes(out / name, data)


def visibility_line(rows: Sequence[ManifestRow]) -> str:
    """Say how many pairs are visible in both images, and the causes for the others with their numbers."""
    hidden = [row for row in rows if not (row.down.visible and row.up.visible)]
    text = f"{len(rows) - len(hidden)} of {len(rows)} pairs are visible in both images"
    if not hidden:
        return text
    spots = ((position, row.position(position)) for row in hidden for position in POSITIONS)
    causes = Counter(f"{position} {spot.cause}" for position, spot in spots if not spot.visible)
    return f"{text}; not visible: " + ", ".join(f"{cause} ({count})" for cause, count in causes.items())
