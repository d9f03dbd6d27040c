"""File sensitivities.parquet (dD/d(parameter) by sample), written and read: tied to its data set by hash, checked."""

from __future__ import annotations

import hashlib
import io
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import NAME_LENGTH, InputFile
from phibench.datasets.store import schema
from phibench.datasets.store.files import sha256
from phibench.scenes.validation import printable_line

if TYPE_CHECKING:
    from polars import DataFrame

DIGEST, FILE_DIGEST = "phibench.dataset_sha256", "phibench.file_sha256"
"""Keys of the metadata: of the data set's SHA256SUMS, and of the table's own file."""
_WORDS, _DEPTHS = ("sample_id", "estimator", "cause"), ("depth_m", "estimate_m")
_PLACE = hashlib.sha256(FILE_DIGEST.encode()).hexdigest().encode()  # occurs nowhere else in the file
_OWN = re.compile(re.escape(FILE_DIGEST.encode()) + rb".{1,4}?([0-9a-f]{64})", re.DOTALL)  # two bytes of Thrift between
_AGAIN = "run `phibench dataset sensitivities` again"


def sensitivity_bytes(table: DataFrame, folder: Path) -> bytes:
    """Parquet file of a table for the data set in a folder as it is now, with both hashes.

    The file's own hash is taken with a constant in its place, so that every bit of the file counts.
    """
    buffer = io.BytesIO()
    metadata = {DIGEST: sha256(folder / schema.CHECKSUMS), FILE_DIGEST: _PLACE.decode()}
    table.write_parquet(buffer, compression="zstd", statistics=False, metadata=metadata)
    data = buffer.getvalue()
    return data.replace(_PLACE, hashlib.sha256(data).hexdigest().encode())


def sensitivity_fault(folder: Path) -> str | None:
    """One sentence on a table that is damaged or of another state of the data set; None if there is no fault."""
    if not os.path.lexists(folder / schema.SENSITIVITIES):
        return None
    try:
        _sensitivities(folder)
    except DatasetError as error:
        return str(error).removeprefix(f"{folder}{os.sep}")
    return None


def read_sensitivities(folder: Path) -> DataFrame:
    """Table of a data set.

    Raises
    ------
    DatasetError
        If there is none, or it is not that of this data set.
    """
    if not (folder / schema.SENSITIVITIES).is_file():
        raise DatasetError(f"{folder} has no {schema.SENSITIVITIES}; run `phibench dataset sensitivities {folder}`")
    return _sensitivities(folder)


def _sensitivities(folder: Path) -> DataFrame:
    """Table whose hash is its own, of this state of the data set, with the columns of such a table."""
    import polars

    file = InputFile(folder / schema.SENSITIVITIES, _AGAIN)
    data = file.read()
    own = _OWN.search(data)
    if own is None:
        raise file.fault("is damaged or of an earlier version: it has no SHA-256 of its own")
    if hashlib.sha256(data.replace(own[1], _PLACE)).hexdigest().encode() != own[1]:
        raise file.fault("is damaged: its SHA-256 is not the one that it holds")
    words = dict.fromkeys(_WORDS, polars.String)
    table = file.table(words | dict.fromkeys(_DEPTHS, polars.Float64), data)
    sums = folder / schema.CHECKSUMS
    state = polars.read_parquet_metadata(io.BytesIO(data)).get(DIGEST)
    if sums.is_file() and state != sha256(sums):  # without SHA256SUMS the data set itself is unfinished
        raise file.fault("belongs to another state of this data set")
    if fault := _sensitivity_column_fault(table):
        raise file.fault(f"is damaged: {fault}")
    return table


_GRADIENT = re.compile(r"(estimate|truth)_m_per_[a-z0-9_]{1,60}")


def _sensitivity_column_fault(table: DataFrame) -> str:
    """First column that is none of such a table, or holds what is no name and no number; empty if there is none."""
    import polars

    printable = rf"^\P{{C}}{{1,{NAME_LENGTH}}}$"
    for name, kind in table.schema.items():
        column = table[name]
        if name in _WORDS:
            if column.null_count() or not column.str.contains(printable).all():
                return f"column '{name}' holds what is no name of at most {NAME_LENGTH} characters"
        elif kind != polars.Float64 or not (name in _DEPTHS or _GRADIENT.fullmatch(name)):
            return f"column '{printable_line(name, 60)}' of type {kind} is none of this table"
        elif not column.is_finite().all():
            return f"column '{name}' holds a number that is not finite"
    return ""
