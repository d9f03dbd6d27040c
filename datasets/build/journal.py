"""Journal of a folder (`Journal`): a log of its finished and refused tasks (`Entry`, `Refusal`), for resuming.

It alone decides what is finished; names and times of files do not.

Each line is one entry: a CRC-32 and a JSON object. The first is the folder's head. Of a data set it has the texts of
`dataset.json` and `recipe.toml`, so that these can be repaired; of other folders it is empty. One entry per finished
task follows, and one per task that was refused; the last one of a name counts. A line that was half-written or damaged
fails its CRC and is ignored: its task is done again. So is one whose files are not those of its task: nobody follows a
name that leads elsewhere.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from pydantic import TypeAdapter, ValidationError

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import FileName, InputFile
from phibench.datasets.store import schema
from phibench.datasets.store.files import sha256, write_bytes


@dataclass(frozen=True)
class Entry:
    """A finished task: its key, the SHA-256 of each of its files, its result."""

    task: str
    key: str
    files: dict[FileName, str]
    result: Any = None


@dataclass(frozen=True)
class Refusal:
    """A task that was tried and cannot be done: its key, and the cause that it gave."""

    task: str
    key: str
    refused: str


@dataclass(frozen=True)
class FolderHead:
    """Description of the folder: the text of `dataset.json`, and of the recipe."""

    info: str
    recipe: str


NO_HEAD = FolderHead("", "")
"""First line of the journal of a folder whose documents are not repaired from it."""


def is_intact(entry: Entry, out: Path) -> bool:
    """Return True if all files of a part are there with their bytes."""
    return all((out / name).is_file() and sha256(out / name) == digest for name, digest in entry.files.items())


class Journal:
    """The journal of one folder, as a context manager: read when made, appended to inside.

    Attributes
    ----------
    head : FolderHead or None
    entries : dict of Entry by task
    refusals : dict of Refusal by task
    damaged : list of int
        Numbers of the lines that are ignored, from 1.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self._path = folder, folder / schema.JOURNAL
        self._file: IO[bytes] | None = None
        self._size = 0
        self.head: FolderHead | None = None
        self.entries: dict[str, Entry] = {}
        self.refusals: dict[str, Refusal] = {}
        self.damaged: list[int] = []
        for number, document in enumerate(_documents(self._path), 1):
            if document is None:
                self.damaged.append(number)
            elif isinstance(document, FolderHead):
                self.head = None if document == NO_HEAD else document
            elif _is_of_its_task(document):
                self._note(document)
            else:
                self.damaged.append(number)

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def _note(self, document: Entry | Refusal) -> None:
        """Keep an entry or a refusal in memory; of both, the last one of a task counts."""
        if isinstance(document, Entry):
            self.entries[document.task] = document
            self.refusals.pop(document.task, None)
        else:
            self.refusals[document.task] = document
            self.entries.pop(document.task, None)

    def keep_refusals(self, tasks: Iterable[str]) -> None:
        """Forget the refusals of all tasks but these; the next `begin` writes them in this order."""
        self.refusals = {name: self.refusals[name] for name in tasks if name in self.refusals}

    def begin(self, head: FolderHead, tasks: Iterable[str]) -> None:
        """Write the journal anew, atomically: this head, the entries of these tasks in this order, the refusals."""
        self.__exit__()
        self.head = head
        self.entries = {name: self.entries[name] for name in tasks if name in self.entries}
        data = self._bytes(head, self.entries)
        write_bytes(self._path, data)
        self._size = len(data)

    def require(self) -> None:
        """Make sure that the journal lies where it was begun, and holds what was written.

        Raises
        ------
        DatasetError
            If not: somebody has removed or moved the folder.
        """
        try:
            same = self._path.stat().st_size == self._size  # not by its inode: some network drives change it
        except FileNotFoundError:
            same = False
        if not same:
            text = f"{self.folder} was removed or moved while this run wrote to it"
            raise DatasetError(f"{text}; delete what is left of it and run the same command again")

    def is_written(self, head: FolderHead, tasks: Iterable[str]) -> bool:
        """Tell whether the file has the bytes that `begin` would write."""
        wanted = self._bytes(head, tasks)
        return self._path.is_file() and self._path.read_bytes() == wanted

    def _bytes(self, head: FolderHead, tasks: Iterable[str]) -> bytes:
        entries = (self.entries[name] for name in tasks if name in self.entries)
        lines = [_line(asdict(head)), *(_line(asdict(entry)) for entry in entries)]
        return b"".join([*lines, *(_line(asdict(refusal)) for refusal in self.refusals.values())])

    def add(self, entry: Entry | Refusal) -> None:
        """Append one entry or refusal. The operating system has it before this returns: kill -9 cannot take it."""
        if self._file is None:
            self._file = self._path.open("ab", buffering=0)
        line = _line(asdict(entry))
        self._file.write(line)
        self._size += len(line)
        self._note(entry)


def _is_of_its_task(document: Entry | Refusal) -> bool:
    """Tell whether a line names a task, and no files but those that the task may write."""
    return schema.may_write(document.task, document.files if isinstance(document, Entry) else ())


def _line(document: dict[str, Any]) -> bytes:
    text = json.dumps(document, allow_nan=False).encode()
    return b"%08x %b\n" % (zlib.crc32(text), text)


def _documents(path: Path) -> Iterator[FolderHead | Entry | Refusal | None]:
    """Head, entries and refusals of a journal, line by line; None for a line that is damaged or of another form."""
    if not path.is_file():
        return  # nothing is finished
    data = InputFile(path, "remove it, and run `phibench dataset make` again").read()
    for line in data.removesuffix(b"\n").split(b"\n") if data else ():
        check, _, text = line.partition(b" ")
        try:
            yield _LINES.validate_json(text, strict=True) if check == b"%08x" % zlib.crc32(text) else None
        except ValidationError:  # a line that a kill cut, or that somebody changed
            yield None


_LINES: TypeAdapter[FolderHead | Entry | Refusal] = TypeAdapter(FolderHead | Entry | Refusal)
