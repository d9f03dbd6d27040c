"""Archives of a release: files of a data set shared out among tar files whose bytes follow from names and contents.

Members of an archive are sorted, and have one time, one owner and one mode.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import tarfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO

from phibench.datasets.build.tasks import BuildTask, TaskResult
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import read_checksums
from phibench.datasets.store.files import sha256, write_atomic

_TIME_S = 315532800  # 1980-01-01, as all files of a sealed set have


def packed_files(folder: Path, with_journal: bool) -> dict[str, str]:
    """Files to be packed with their SHA-256, sorted by name: what SHA256SUMS lists, itself, and a journal."""
    listed = read_checksums(folder)
    extra = [schema.CHECKSUMS, *([schema.JOURNAL] if with_journal else [])]
    hashes = listed | {name: sha256(folder / name) for name in extra if (folder / name).is_file()}
    return dict(sorted(hashes.items()))


def archive_tasks(title: str, folder: Path, files: Mapping[str, str], most_bytes: int) -> dict[str, BuildTask]:
    """Tasks that write the archives of a part, by the archive's name.

    Parameters
    ----------
    title : folder that an archive unpacks to
    folder : where the files lie
    files : names with their SHA-256, as of `packed_files`
    most_bytes : an archive holds files up to this size, or one larger file

    Raises
    ------
    DatasetError
        If a file is missing.
    """
    tasks = {}
    for number, names in enumerate(_shares(folder, files, most_bytes)):
        name, share = f"{title}-{number:03d}.tar", {name: files[name] for name in names}
        key = json_digest([title, list(share.items())])
        tasks[name] = BuildTask(f"archive {name}", key, write_archive, (name, title, folder, share))
    return tasks


def json_digest(document: object) -> str:
    """SHA-256 of a document as JSON."""
    return hashlib.sha256(json.dumps(document).encode()).hexdigest()


def _shares(folder: Path, members: Mapping[str, str], most: int) -> Iterator[list[str]]:
    """Members of each archive, in their order."""
    share: list[str] = []
    size = 0
    for name in members:
        path = folder / name
        if not path.is_file():
            raise DatasetError(f"{folder}: {name} is missing; run `phibench dataset verify` to see all faults")
        bytes_here = path.stat().st_size
        if share and size + bytes_here > most:
            yield share
            share, size = [], 0
        share.append(name)
        size += bytes_here
    if share:
        yield share


def write_archive(out: Path, archive: str, title: str, folder: Path, members: Mapping[str, str]) -> TaskResult:
    """Task: write an archive of a folder's files, each with its SHA-256.

    Raises
    ------
    DatasetError
        If one has another hash.
    """
    write_atomic(out / archive, lambda path: _write_tar(path, title, folder, members))
    return TaskResult((archive,))


def _write_tar(path: Path, title: str, folder: Path, members: Mapping[str, str]) -> None:
    """Tar whose bytes depend on names and contents alone; every file is checked on its way."""
    with path.open("wb") as file, tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name in members:
            with (folder / name).open("rb") as source:
                entry = tarfile.TarInfo(f"{title}/{name}")
                entry.size, entry.mtime, entry.mode = os.fstat(source.fileno()).st_size, _TIME_S, 0o644
                reader = _Hashing(source)
                tar.addfile(entry, reader)
            if reader.digest.hexdigest() != members[name]:
                what = f"{folder}: {name} is damaged: its SHA-256 is not the one in {schema.CHECKSUMS}"
                raise DatasetError(f"{what}; run `phibench dataset repair {folder}`")


class _Hashing(io.RawIOBase):
    """File that is hashed while it is read."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self.digest = file, hashlib.sha256()

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(size)
        self.digest.update(data)
        return data
