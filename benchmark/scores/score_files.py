"""Files of scores, written and read: JSON document, Parquet records beside it; records of runs that broke off."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol, TypeVar

import polars as pl

from phibench.benchmark.scores.record_columns import COLUMN_TYPES
from phibench.benchmark.scores.score_document import KIND, VERSION, MethodCard, ScoreDocument
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import InputFile
from phibench.datasets.store.files import sha256, write_bytes, write_text
from phibench.datasets.store.schema import RECORDS_SO_FAR, Document
from phibench.scenes.validation import printable_line

D = TypeVar("D", bound=Document)


def parquet_path(path: Path) -> Path:
    """Path of the records of a score."""
    return path.with_suffix(".parquet")


def score_files(out: Path | None, cards: Sequence[MethodCard]) -> list[Path | None]:
    """One file per method: `out` itself for one, with the method's name added for several.

    Raises
    ------
    DatasetError
        If the name is none of a JSON file, or two methods have the same.
    """
    if out is None:
        return [None] * len(cards)  # nothing is kept
    if out.suffix != ".json":
        raise DatasetError(f"--out {out}: a score is a JSON file; give a name that ends in .json")
    if len(cards) == 1:
        return [out]
    # of a reference such as my_phi.py:extract, a colon is no letter of a file's name
    names = ["".join(c if c.isalnum() or c in "-_." else "-" for c in card.name) for card in cards]
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DatasetError(f"--method: two methods are called {twice}; score them in two runs with an --out for each")
    return [out.with_name(f"{out.stem}-{name}.json") for name in names]


def write_score(path: Path, document: D, records: pl.DataFrame) -> D:
    """Write records, then the document that names their hash; both complete or not at all."""
    if path.suffix != ".json":
        raise DatasetError(f"{path}: a score is a JSON file; give a name that ends in .json")
    target = write_bytes(parquet_path(path), _parquet(records))
    complete = document.model_copy(update={"records": target.name, "records_sha256": sha256(target)})
    write_text(path, json.dumps(complete.model_dump(mode="json"), indent=1, allow_nan=False) + "\n")
    return complete


class UnfinishedError(DatasetError):
    """A data set that became unreadable in the middle of a run; `records` are of the pairs before, by method."""

    def __init__(self, reason: str, records: Sequence[pl.DataFrame], pairs: int) -> None:
        super().__init__(reason)
        self.records, self.pairs = records, pairs


@contextmanager
def records_kept(files: Sequence[Path | None]) -> Iterator[None]:
    """Write the records of a run that ends before its time, beside the files of its scores.

    Raises
    ------
    DatasetError
        With the sample that could not be read, and the files.
    """
    try:
        yield
    except UnfinishedError as error:
        written = [
            write_bytes(file.with_suffix(RECORDS_SO_FAR), _parquet(records))
            for file, records in zip(files, error.records, strict=True)
            if file is not None and error.pairs
        ]
        before = "1 pair" if error.pairs == 1 else f"{error.pairs} pairs"
        kept = f"the records of the {before} before it are in {', '.join(map(str, written))}; "
        advice = "run `phibench dataset repair`, then " if str(error).startswith("sample") else ""
        raise DatasetError(f"{error}; {kept if written else ''}{advice}score again") from error


def _parquet(records: pl.DataFrame) -> bytes:
    buffer = io.BytesIO()
    records.write_parquet(buffer)
    return buffer.getvalue()


def read_score(path: Path) -> ScoreDocument:
    """Read a score; raises as `read_document`."""
    return read_document(path, ScoreDocument, KIND, VERSION, "phibench score --method ... --out")


def read_document(path: Path, model: type[D], kind: str, version: int, command: str) -> D:
    """Read a score of a kind.

    Raises
    ------
    DatasetError
        If the file is no such score, or one of another version; in one sentence.
    """
    file = InputFile(path, f"give a file that `{command}` wrote")
    raw = file.json()
    if raw.get("kind") != kind:
        raise DatasetError(f"{path} is no score: give a JSON file that `{command}` wrote")
    if raw.get("version") != version:
        held = printable_line(str(raw.get("version")), 60)
        raise DatasetError(f"{path} has version {held}, this program reads {version}: score again")
    return file.validated(model, raw)


class HasRecords(Protocol):
    """Document that names the file of its records."""

    @property
    def records(self) -> str:
        """Name of the Parquet file."""

    @property
    def records_sha256(self) -> str:
        """Its hash."""


def read_records(path: Path, document: HasRecords, types: Mapping[str, pl.DataType] = COLUMN_TYPES) -> pl.DataFrame:
    """Records of the score at `path`, with columns of these types.

    Raises
    ------
    DatasetError
        If the Parquet file is not there or not the one that belongs to the score.
    """
    target = path.parent / document.records
    if not target.is_file():
        raise DatasetError(f"{target} is missing: it belongs to {path.name}; keep both together, or score again")
    if sha256(target) != document.records_sha256:
        raise DatasetError(f"{target} is not the file that {path.name} was written with: score again")
    return InputFile(target, "score again").table(dict(types))
