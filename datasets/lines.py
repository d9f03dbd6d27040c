"""Reading files of one JSON document a line."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from phibench.datasets.errors import DatasetError
from phibench.datasets.schema import Document

Row = TypeVar("Row", bound=Document)


def read_rows(path: Path, model: type[Row]) -> list[Row]:
    """All documents of a file.

    Raises
    ------
    DatasetError
        If it is missing or not readable, or with the number of the first line that is not such a document.
    """
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError as error:
        raise DatasetError(f"{path} is missing") from error
    except OSError as error:
        raise DatasetError(f"{path} is not readable: {error.strerror or error}") from error
    return [_row(path, model, number, line) for number, line in enumerate(lines, 1)]


def _row(path: Path, model: type[Row], number: int, line: str) -> Row:
    try:
        return model.model_validate_json(line)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        text = f"{where}: {first['msg']}" if where else first["msg"]
        raise DatasetError(f"{path} line {number} is damaged: {text}") from error
