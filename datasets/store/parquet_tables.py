"""Tables of documents, and their Parquet: a column per leaf of a model, names joined by dots, null for no number."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from phibench.datasets.store.schema import Document, ManifestRow, columns, drawn_columns

if TYPE_CHECKING:
    from polars import DataFrame


def to_table(rows: Sequence[ManifestRow]) -> DataFrame:
    """Rows as a polars table: one column per leaf, names joined by dots, null where a number does not exist."""
    import polars

    # keys of `drawn` depend on the recipe: a column for each that any row has
    drawn = [
        polars.Series(name, [row.drawn.get(name.removeprefix("drawn.")) for row in rows], _column_type(kind))
        for name, kind in drawn_columns(rows).items()
    ]
    return model_table(ManifestRow, rows).with_columns(drawn)


_LARGEST_INTEGER = 2**63 - 1  # of a column Int64


def model_table(model: type[Document], rows: Sequence[Document]) -> DataFrame:
    """Documents of one model as a polars table; free-form objects, such as a sensor's numbers, are JSON texts.

    A column with a secret seed, of 128 bits, is one of texts.
    """
    import polars

    documents = [row.model_dump(mode="json") for row in rows]
    data, types = {}, {}
    for name, field in columns(model):
        types[name] = _column_type(field.annotation)
        values = [_leaf(document, name) for document in documents]
        data[name] = [json.dumps(value) if isinstance(value, dict) else value for value in values]
        if types[name] == polars.Int64 and any(value is not None and value > _LARGEST_INTEGER for value in values):
            types[name], data[name] = polars.String, [str(value) for value in values]
    return polars.DataFrame(data, schema=types)


def parquet_bytes(table: DataFrame) -> bytes:
    """Parquet file of a table."""
    buffer = io.BytesIO()
    table.write_parquet(buffer, compression="zstd", statistics=False)
    return buffer.getvalue()


def _column_type(annotation: Any) -> Any:
    """Column type of a field: of a union its known member, of a tuple a list of doubles."""
    import polars

    kinds = {str: polars.String, float: polars.Float64, bool: polars.Boolean, int: polars.Int64}
    origin = get_origin(annotation)
    if origin is tuple or any(
        get_origin(get_args(kind)[0]) is tuple for kind in get_args(annotation) if get_args(kind)
    ):
        return polars.List(polars.Float64)
    if origin in (dict, Literal):
        return polars.String
    return next((kinds[known] for known in kinds if known in (annotation, *get_args(annotation))), polars.Float64)


def _leaf(document: dict[str, Any], name: str) -> Any:
    value: Any = document
    for key in name.split("."):
        value = None if value is None else value[key]
    return value
