"""Comparison of two output folders: does a change of the code leave every result as it was?

    python tests/compare_results.py OLD NEW

OLD and NEW each hold data sets (folders with manifest.jsonl) and scores (*.json, records in *.parquet). Compared are
the bytes of every EXR file and light map, the doubles of every manifest and rig file, every column of the records, and
the numbers of every score. Provenance, times, hashes of code and messages are left out. A column or field that only one
side has is named. Exit code 1 if anything differs.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl

NOT_RESULTS = {
    "provenance", "code_sha256", "records_sha256", "version", "task_version", "sha256", "place", "seconds", "message",
    "method", "limits", "dataset", "dataset_sha256", "records",
}  # fmt: skip


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def numbers(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Leaves of a JSON document with their paths; what is no result is left out."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if key not in NOT_RESULTS:
                yield from numbers(inner, f"{path}.{key}")
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from numbers(inner, f"{path}[{i}]")
    else:
        yield path, value


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Fields of two flat documents that differ; NaN equals NaN."""
    found = [f"only in the old: {key}" for key in old if key not in new]
    found += [f"only in the new: {key}" for key in new if key not in old]
    return found + [
        f"{key}: {old[key]!r} -> {new[key]!r}" for key in old if key in new and not same(old[key], new[key])
    ]


def same(a: Any, b: Any) -> bool:
    return bool(a == b) or (isinstance(a, float) and isinstance(b, float) and math.isnan(a) and math.isnan(b))


def compare_lines(old: Path, new: Path) -> list[str]:
    """JSON lines, by number."""
    a, b = ([json.loads(line) for line in path.read_text().splitlines()] for path in (old, new))
    if len(a) != len(b):
        return [f"{len(a)} lines -> {len(b)} lines"]
    return [
        f"line {i}: {text}" for i, (x, y) in enumerate(zip(a, b, strict=True))
        for text in differences(dict(numbers(x)), dict(numbers(y)))
    ]  # fmt: skip


def compare_records(old: Path, new: Path) -> list[str]:
    a, b = pl.read_parquet(old), pl.read_parquet(new)
    found = [f"only in the old: column {name}" for name in a.columns if name not in b.columns]
    found += [f"only in the new: column {name}" for name in b.columns if name not in a.columns]
    for name in a.columns:
        if name in b.columns and name not in NOT_RESULTS and not a[name].equals(b[name]):
            found.append(f"column {name} differs in {sum(x != y for x, y in zip(a[name], b[name], strict=False))} rows")
    return found


def compare(old: Path, new: Path) -> tuple[dict[str, int], dict[str, list[str]]]:
    """Files compared by kind, and the differences by file."""
    counts: dict[str, int] = {}
    faults: dict[str, list[str]] = {}
    for path in sorted(path for path in old.rglob("*") if path.is_file()):
        name, other = path.relative_to(old), new / path.relative_to(old)
        kind = {".exr": "exr", ".npz": "light map", ".parquet": "records", ".json": "scores"}.get(path.suffix, "")
        if path.name in ("manifest.jsonl", "rigs.jsonl"):
            kind = "manifest"
        if path.name in ("manifest.parquet", "run.json", "sensitivities.parquet", "dataset.json") or not kind:
            continue
        counts[kind] = counts.get(kind, 0) + 1
        if not other.is_file():
            faults[str(name)] = ["is not in the new folder"]
        elif kind in ("exr", "light map"):
            if digest(path) != digest(other):
                faults[str(name)] = ["other bytes"]
        elif kind == "manifest":
            faults[str(name)] = compare_lines(path, other)
        elif kind == "records":
            faults[str(name)] = compare_records(path, other)
        else:
            a, b = (dict(numbers(json.loads(file.read_text()))) for file in (path, other))
            faults[str(name)] = differences(a, b)
    return counts, {name: found for name, found in faults.items() if found}


def main() -> int:
    if len(sys.argv) != 3:
        print(__doc__)
        return 2
    counts, faults = compare(Path(sys.argv[1]), Path(sys.argv[2]))
    print("compared:", ", ".join(f"{n} {kind}" for kind, n in counts.items()))
    for name, found in faults.items():
        print(f"{name}: {len(found)} differences")
        for text in found[:5]:
            print("   ", text)
    print(f"{len(faults)} files differ" if faults else "no difference")
    return 1 if faults or not counts.get("exr") else 0


if __name__ == "__main__":
    sys.exit(main())
