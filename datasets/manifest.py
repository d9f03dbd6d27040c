"""The manifest: `manifest.jsonl`, and the same as a flat Parquet table."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from phibench.datasets import layout
from phibench.datasets.files import write_bytes
from phibench.datasets.lines import read_rows
from phibench.datasets.schema import ManifestRow, columns, drawn_columns, row_line


def write_manifest(folder: Path, rows: Sequence[ManifestRow]) -> None:
    """Write both forms."""
    for name, data in manifest_documents(rows).items():
        write_bytes(folder / name, data)


def manifest_documents(rows: Sequence[ManifestRow]) -> dict[str, bytes]:
    """Both forms as bytes, by file name."""
    buffer = io.BytesIO()
    to_frame(rows).write_parquet(buffer, compression="zstd", statistics=False)
    return {
        layout.MANIFEST: "".join(row_line(row) + "\n" for row in rows).encode(),
        layout.TABLE: buffer.getvalue(),
    }


def read_manifest(folder: Path) -> list[ManifestRow]:
    """Rows of `manifest.jsonl`.

    Raises
    ------
    DatasetError
        If it is missing, or with the number of the first line that is not a row.
    """
    return read_rows(folder / layout.MANIFEST, ManifestRow)


def to_frame(rows: Sequence[ManifestRow]) -> Any:
    """Rows as a polars DataFrame: one column per leaf, names joined by dots, null where a number does not exist."""
    import polars

    types = {str: polars.String, float: polars.Float64, bool: polars.Boolean, int: polars.Int64}
    documents = [row.model_dump(mode="json") for row in rows]
    data, schema = {}, {}
    for name, field in columns():
        kind = field.annotation
        base = next((known for known in types if known in (kind, *getattr(kind, "__args__", ()))), float)
        is_list = getattr(kind, "__origin__", None) is tuple
        data[name] = [_leaf(document, name) for document in documents]
        schema[name] = polars.List(polars.Float64) if is_list else types[base]
    for name, drawn in drawn_columns(rows).items():
        data[name] = [row.drawn.get(name.removeprefix("drawn.")) for row in rows]
        schema[name] = types[drawn]
    return polars.DataFrame(data, schema=schema)


def differences(folder: Path, rows: Sequence[ManifestRow]) -> list[str]:
    """One sentence per column in which the Parquet table differs from the rows."""
    import polars

    expected = to_frame(rows)
    try:
        table = polars.read_parquet(folder / layout.TABLE)
    except (OSError, polars.exceptions.PolarsError) as error:
        return [f"{layout.TABLE} cannot be read: {error}"]
    if table.schema != expected.schema or table.height != expected.height:
        return [f"{layout.TABLE} has other columns or rows than {layout.MANIFEST}"]
    changed = [name for name in table.columns if not table[name].equals(expected[name], null_equal=True)]
    return [f"{layout.TABLE} differs from {layout.MANIFEST} in column {name}" for name in changed]


def _leaf(document: dict[str, Any], name: str) -> Any:
    value: Any = document
    for key in name.split("."):
        value = None if value is None else value[key]
    return value


def same_number(a: float, b: float, relative: float = 1e-11, absolute: float = 1e-12) -> bool:
    """Whether two doubles agree to rounding; two NaN do."""
    return (math.isnan(a) and math.isnan(b)) or math.isclose(a, b, rel_tol=relative, abs_tol=absolute)
