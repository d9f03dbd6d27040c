"""Writer of an export's shards as Parquet, WebDataset tar or plain files; and features of its rows for Hugging Face.

The same pairs give the same bytes: entries stand in the order of the pairs, and no container holds a time or a name of
a user.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from phibench.benchmark.export.pair_rows import DrawnPair, ExportRequest, Form
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.store.files import write_bytes

if TYPE_CHECKING:
    from polars import DataFrame, DataType

FOLDER = {"parquet": "data", "webdataset": "shards", "frames": "frames"}
"""Folder of each form's files."""


def shard_name(form: Form, split: str, number: int, count: int) -> str:
    """File of a shard, relative to the export; of plain files its folder, so that no folder holds too many."""
    if form == "frames":
        return f"{FOLDER[form]}/{split}/{number:05d}"
    end = "parquet" if form == "parquet" else "tar"
    return f"{FOLDER[form]}/{split}-{number:05d}-of-{count:05d}.{end}"


NEEDS_PYARROW = "Parquet files with images need pyarrow: pip install 'phibench[export]'"


def write_shard(
    out: Path, name: str, request: ExportRequest, pairs: Sequence[DrawnPair], table: DataFrame
) -> list[str]:
    """Write one shard, atomically, and return the names of its files; `table` has a row for every pair.

    Raises
    ------
    DatasetError
        If Parquet files are wanted and pyarrow is not installed.
    """
    if request.form == "frames":
        return [write for pair in pairs for write in _plain_files(out, name, request, pair)]
    data = _parquet(request, pairs, table) if request.form == "parquet" else _tar(request, pairs, table)
    (out / name).parent.mkdir(parents=True, exist_ok=True)
    write_bytes(out / name, data)
    return [name]


def image_name(request: ExportRequest, key: str, column: str) -> str:
    """Name of an image: KEY.down.jpg, KEY.up_off.png."""
    return f"{key}.{column.removeprefix('image_')}{request.end}"


def _plain_files(out: Path, folder: str, request: ExportRequest, pair: DrawnPair) -> list[str]:
    (out / folder).mkdir(parents=True, exist_ok=True)
    names = {column: f"{folder}/{image_name(request, pair.key, column)}" for column in pair.images}
    for column, name in names.items():
        write_bytes(out / name, pair.images[column])
    return list(names.values())


def _tar(request: ExportRequest, pairs: Sequence[DrawnPair], table: DataFrame) -> bytes:
    """Tar with KEY.json and the images of every pair, POSIX headers, all zero that tells of time or user."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for pair, row in zip(pairs, table.iter_rows(named=True), strict=True):
            members = {image_name(request, pair.key, column): data for column, data in pair.images.items()}
            members[f"{pair.key}.json"] = json.dumps(row, allow_nan=False).encode()
            for name, data in members.items():
                entry = tarfile.TarInfo(name)
                entry.size = len(data)
                tar.addfile(entry, io.BytesIO(data))
    return buffer.getvalue()


def _parquet(request: ExportRequest, pairs: Sequence[DrawnPair], table: DataFrame) -> bytes:
    """Parquet file with each image as struct{bytes, path}, and the features that `datasets` shows images by."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise DatasetError(NEEDS_PYARROW) from error
    arrow = pa.table({name: _arrow_column(pa, table, name) for name in table.columns})
    kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    for column, _, _ in request.images:
        cells = [{"bytes": pair.images[column], "path": image_name(request, pair.key, column)} for pair in pairs]
        arrow = arrow.append_column(column, pa.array(cells, kind))
    features = {"info": {"features": hugging_face_features(request, table)}}
    arrow = arrow.replace_schema_metadata({"huggingface": json.dumps(features)})
    buffer = io.BytesIO()
    parquet.write_table(arrow, buffer, compression="zstd", row_group_size=len(pairs), write_statistics=False)
    return buffer.getvalue()


def _arrow_column(pa: Any, table: DataFrame, name: str) -> Any:
    """Column without the 64-bit offsets of polars, which `datasets` would show as another type."""
    return pa.array(table[name].to_list(), _arrow_type(pa, table.schema[name]))


def _arrow_type(pa: Any, dtype: DataType) -> Any:
    kinds = {"float64": pa.float64(), "int64": pa.int64(), "bool": pa.bool_(), "string": pa.string()}
    return pa.list_(pa.float64()) if "List" in str(dtype) else kinds[_dtype(dtype)]


def _dtype(dtype: DataType) -> str:
    """Name of a column's type in `datasets`."""
    return {"Float64": "float64", "Int64": "int64", "Boolean": "bool", "String": "string"}[str(dtype)]


def hugging_face_features(request: ExportRequest, table: DataFrame) -> Mapping[str, Any]:
    """Features of an export's rows as the library `datasets` writes them down."""
    features: dict[str, Any] = {}
    for name, dtype in table.schema.items():
        is_list = "List" in str(dtype)
        value = {"dtype": "float64" if is_list else _dtype(dtype), "_type": "Value"}
        features[name] = {"feature": value, "_type": "Sequence"} if is_list else value
    return features | {column: {"_type": "Image"} for column, _, _ in request.images}
