"""Fetching of a released data set from a folder or HTTP server: archives verified, unpacked; resumable, all or nothing.

`release_source` brings each archive, whose SHA-256 `MANIFEST.json` holds. Archives are unpacked beside the final
folder, in OUT.part, after a look at all their headers. When all files have the hashes of the data set's own list, the
folder gets its name. Whatever ends a fetch before that leaves OUT.part alone, and the next one goes on where it ended.
What only its user can have put into OUT.part is never removed.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import tarfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, TYPE_CHECKING, Any

from rich.console import Console

from phibench.benchmark.release.release_parts import MANIFEST, Archive, ReleasedPart, chosen_parts, read_manifest_file
from phibench.benchmark.release.release_source import Partial, Source
from phibench.datasets.build.forecast import megabytes
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import FILE_NAME, SETTINGS_BYTES, InputFile
from phibench.datasets.common.progress import Steps, progress_console
from phibench.datasets.film.film_store import verify_films as film_faults
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import damaged_files, differing_files, read_checksums, writing_to
from phibench.datasets.store.files import sha256, write_text
from phibench.datasets.store.folder_lock import only_run
from phibench.datasets.store.temporary_folders import (
    TEMPORARY_PREFIX,
    OwnedFolder,
    folder_for_work,
    remove_leftovers,
    remove_tree,
)
from phibench.scenes.validation import nearest, printable_line

if TYPE_CHECKING:
    from phibench.benchmark.release.paced_http import Patience

_STATE, _SET, _ARCHIVES = "fetch.json", "set", "archives"
_TRIES = 3  # of an archive with a wrong hash
_CHUNK = 1 << 20  # bytes that are hashed and written at a time
_BLOCK = tarfile.BLOCKSIZE


@dataclass(frozen=True)
class Fetched:
    """Outcome: the data set's folder, its title, archives fetched now, and archives in all."""

    folder: Path
    title: str
    fetched: int
    archives: int


def fetch(
    name: str,
    out: str | Path,
    source: str | None = None,
    *,
    manifest_sha256: str | None = None,
    tries: int = _TRIES,
    patience: Patience | None = None,
    console: Console | None = None,
) -> Fetched:
    """Fetch one data set of a release.

    Parameters
    ----------
    name : title or last word of it: "phibench-v4-dev" or "dev"
    out : folder that the data set will be; not there yet, or this very data set
    source : folder of a release, or its HTTP address; by default that of `PHIBENCH_SOURCE`
    manifest_sha256 : SHA-256 that `MANIFEST.json` must have, for who got it from elsewhere
    tries : attempts at a file before the fetch ends
    patience : how long a server is waited for

    Raises
    ------
    DatasetError
        In one sentence: no source, no such name, something else in the folder, a source that cannot be reached or
        breaks off, a file with another hash. Nothing is then under the final name.
    """
    out, console, place = Path(out), console or progress_console(), Source.of(source, tries, patience)
    title, part = _listed(name, place, out, manifest_sha256)
    stage = out.with_name(f"{out.name}.part")
    if out.exists() or out.is_symlink():
        if _is_the_set(out, part):
            _remove_rest(stage)
            return Fetched(out, title, 0, len(part.archives))
        raise DatasetError(_what_it_is(out, title, part))
    with writing_to(stage):
        _claim(stage, title, part)
        with only_run(stage):
            fetched = _archives(place, stage, title, part, console)
            _check(stage, title, part, place, fetched == len(part.archives))
            (stage / _SET).rename(out)
    _remove_own(stage)
    return Fetched(out, title, fetched, len(part.archives))


def _listed(name: str, place: Source, out: Path, manifest_sha256: str | None) -> tuple[str, ReleasedPart]:
    """Title and entry of a data set in the source's manifest."""
    with folder_for_work(out.parent), OwnedFolder("fetch", out.parent) as folder:
        path = place.get(MANIFEST, folder, None)
        if manifest_sha256 is not None and sha256(path) != manifest_sha256.lower():
            raise DatasetError(
                f"{MANIFEST} of {place.name} has another SHA-256 than {manifest_sha256}: it is another release"
            )
        manifest = read_manifest_file(path, f"{place.name} may be no release; ask who gave it")
    titles = {word: title for title in manifest.parts for word in (title, _last(title))}
    if name not in titles:
        known = {word for part in chosen_parts(()) for word in (part.name, part.title)}
        if name in known:
            raise DatasetError(f"{place.name} does not hold '{name}'; it has {', '.join(sorted(manifest.parts))}")
        raise DatasetError(f"there is no data set '{printable_line(name, 60)}' there; {nearest(name, sorted(titles))}")
    return titles[name], manifest.parts[titles[name]]


def _last(title: str) -> str:
    return re.sub(r"^phibench-v\d+-", "", title)


def _is_the_set(out: Path, part: ReleasedPart) -> bool:
    sums = out / schema.CHECKSUMS
    return sums.is_file() and sha256(sums) == part.sums_sha256 and not differing_files(out, read_checksums(out))


def _what_it_is(out: Path, title: str, part: ReleasedPart) -> str:
    """Sentence on a folder that is not the data set, or not any more."""
    sums = out / schema.CHECKSUMS
    if sums.is_file() and sha256(sums) == part.sums_sha256:
        file = differing_files(out, read_checksums(out))[0]
        return f"{out} is {title}, and damaged or changed: {file}; move the folder away, and fetch it again"
    return f"{out} holds something else than {title}; give another folder, `--out FOLDER`"


# The folder in which a data set grows.


def _claim(stage: Path, title: str, part: ReleasedPart) -> None:
    """Say what the folder is for; refuse one of something else, or of another data set."""
    meant = {"title": title, "sums_sha256": part.sums_sha256}
    if stage.is_dir() and (foreign := _foreign(stage)):
        told = f"{stage} holds other files, such as {printable_line(foreign, 80)}, and the set would grow there"
        raise DatasetError(f"{told}; move them away, or give another --out")
    if stage.is_dir() and any((stage / name).exists() for name in (_STATE, _SET, _ARCHIVES)):
        state = stage / _STATE
        if not state.is_file():
            raise DatasetError(
                f"{stage} holds other files, and the set would grow there; move it, or give another --out"
            )
        held = InputFile(state, f"remove {stage}", limit_bytes=SETTINGS_BYTES).json()
        if {key: held.get(key) for key in meant} != meant:
            raise DatasetError(f"{stage} holds a part of another data set or version; remove it, or give another --out")
    stage.mkdir(parents=True, exist_ok=True)
    if not (stage / _STATE).is_file():
        _write_state(stage, meant | {"unpacked": []})
    free = shutil.disk_usage(stage).free
    begun = sum(Partial(stage / _ARCHIVES, archive).size for archive in part.archives)
    left = part.size + max(archive.size for archive in part.archives) - _size(stage / _SET) - begun
    if free < left:
        raise DatasetError(f"{title} needs {megabytes(left)} more in {stage.parent}, and {megabytes(free)} are free")


_OWN_FILES = re.compile(r"[0-9a-f]{64}\.(part|validator)|tmp[a-z0-9_]{8}")
"""Begun archives, and what a killed fetch left of `pooch`'s own temporary files."""


def _foreign(stage: Path) -> str:
    """A file or folder in the stage that no fetch has put there; empty if there is none. Hidden ones count."""
    known = {_STATE, _SET, _ARCHIVES, schema.LOCK}
    for path in sorted(stage.iterdir()):
        if path.name not in known and not path.name.startswith(TEMPORARY_PREFIX):
            return path.name
    for path in sorted((stage / _ARCHIVES).glob("*")):
        if not (_OWN_FILES.fullmatch(path.name) or path.suffix == ".tar") or not path.is_file():
            return f"{_ARCHIVES}/{path.name}"
    return next((f"{_SET}/{name}" for name in _files(stage / _SET) if not re.fullmatch(FILE_NAME, name)), "")


def _remove_own(stage: Path) -> None:
    """Remove the stage; what somebody has put there meanwhile stays, and the stage with it."""
    _remove_strays(stage / _ARCHIVES, [])
    remove_leftovers(stage)
    (stage / _STATE).unlink(missing_ok=True)
    for folder in (stage / _ARCHIVES, stage):
        with contextlib.suppress(OSError):  # files of the user lie there
            folder.rmdir()


def _remove_rest(stage: Path) -> None:
    """Remove what a fetch has left that was killed after it had given the set its name."""
    if stage.is_dir() and not (stage / _SET).exists() and not _foreign(stage):
        with contextlib.suppress(OSError, DatasetError):  # another fetch has it
            with only_run(stage):
                pass
            _remove_own(stage)


def _write_state(stage: Path, state: dict[str, Any]) -> None:
    write_text(stage / _STATE, json.dumps(state, indent=1) + "\n")


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _archives(place: Source, stage: Path, title: str, part: ReleasedPart, console: Console) -> int:
    """Fetch and unpack the archives that are missing; return how many."""
    state = InputFile(stage / _STATE, f"remove {stage}", limit_bytes=SETTINGS_BYTES).json()
    unpacked = state.get("unpacked")
    done = [text for text in unpacked if isinstance(text, str)] if isinstance(unpacked, list) else []
    todo = [archive for archive in part.archives if archive.sha256 not in done]
    (stage / _SET).mkdir(exist_ok=True)
    _remove_strays(stage / _ARCHIVES, todo)

    current: Archive | None = None

    def running() -> str:
        begun = 0 if current is None else Partial(stage / _ARCHIVES, current).size
        return f"{current.name}, {megabytes(begun)} of {megabytes(current.size)}" if current and begun else ""

    with Steps(console, title, len(todo), running=running) as steps:
        for current in todo:
            path = place.get(current.name, stage / _ARCHIVES, current)
            unpack_archive(path, stage / _SET, title, part.size, part.files)
            done.append(current.sha256)
            _write_state(stage, state | {"unpacked": done})
            path.unlink()  # a disk need not hold all archives beside the set
            steps.advance()
    return len(todo)


def _remove_strays(folder: Path, archives: Sequence[Archive]) -> None:
    """Remove what a killed fetch left of `pooch`'s own temporary files; the run holds the folder alone."""
    parts = [Partial(folder, archive) for archive in archives]
    kept = {path for part in parts for path in (part.path, part.validator)}
    for path in folder.glob("*"):
        if path not in kept and _OWN_FILES.fullmatch(path.name):
            path.unlink()


def unpack_archive(archive: Path, folder: Path, title: str, most: int, files: int) -> None:
    """Unpack an archive of plain files below `title/`; all names and sizes are looked at before a file is written.

    Parameters
    ----------
    most, files : bytes and files that the folder may have then, with those that are there

    Raises
    ------
    DatasetError
        For a link, a device, a name that leads out of the folder or comes twice, or too many files or bytes.
    """
    with archive.open("rb") as file:
        members, there = dict[str, tuple[int, int]](), set(_files(folder))
        for name, place, size in _members(file, archive.name, title):
            if name in members:
                raise _strange(archive.name, name)
            members[name] = (place, size)
            if len(members) > files:
                raise DatasetError(f"{archive.name} holds more files {_SAID}")
        names = there | set(members)
        if twice := sorted(names & {parent.as_posix() for name in names for parent in PurePosixPath(name).parents}):
            raise DatasetError(f"{archive.name} holds {twice[0]} as a file and as a folder; ask who made the release")
        if len(names) > files:
            raise DatasetError(f"{archive.name} and {folder} hold more files {_SAID}, or move away what is yours there")
        held = sum((folder / name).lstat().st_size for name in there - set(members))
        if held + sum(size for _, size in members.values()) > most:
            raise DatasetError(f"{archive.name} holds more bytes {_SAID}")
        for name, (place, size) in members.items():
            file.seek(place)
            _write_member(file, folder / name, size)


_SAID = f"than {MANIFEST} says; nothing of it is used, so ask who made the release"


def _members(file: IO[bytes], archive: str, title: str) -> Iterator[tuple[str, int, int]]:
    """Name, place and size of each member of a tar file as `release_make` writes it: one header of 512 bytes each.

    `tarfile` would also follow headers that say more of the next member: longer names, other sizes, holes.
    """
    end = file.seek(0, os.SEEK_END)
    place = 0
    while place < end:
        file.seek(place)
        try:
            member = tarfile.TarInfo.frombuf(file.read(_BLOCK), "utf-8", "surrogateescape")
        except tarfile.HeaderError as error:
            if type(error).__name__ == "EOFHeaderError":  # zeros: the end
                return
            raise DatasetError(f"{archive} is no tar file: {error}; ask who made the release") from error
        name = member.name.removeprefix(f"{title}/")
        is_plain = member.type in (tarfile.REGTYPE, tarfile.AREGTYPE) and member.size >= 0
        if not is_plain or name == member.name or not re.fullmatch(FILE_NAME, name):
            raise _strange(archive, member.name)
        if place + _BLOCK + member.size > end:
            raise DatasetError(f"{archive} is no tar file: it ends within {name}; ask who made the release")
        yield name, place + _BLOCK, member.size
        place += _BLOCK + -(-member.size // _BLOCK) * _BLOCK


def _strange(archive: str, name: str) -> DatasetError:
    what = f"{archive} holds '{printable_line(name, 80)}', which no release has"
    return DatasetError(f"{what}; nothing of it is used, so ask who made the release")


def _write_member(file: IO[bytes], path: Path, size: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)  # a link in its place would lead elsewhere
    with path.open("xb") as target:
        while size:
            data = file.read(min(size, _CHUNK))
            target.write(data)
            size -= len(data)


def _files(folder: Path) -> list[str]:
    """Names of all that lies in a folder and below, but folders."""
    paths = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    return sorted(path.relative_to(folder).as_posix() for path in paths)


def _check(stage: Path, title: str, part: ReleasedPart, place: Source, is_fresh: bool) -> None:
    """Compare all files with the data set's own list; on a damaged one all archives are fetched again the next time.

    Parameters
    ----------
    is_fresh : bool
        True if all archives were unpacked in this run: what differs then was packed so.
    """
    folder = stage / _SET
    sums = folder / schema.CHECKSUMS
    faults = [f"{schema.CHECKSUMS} is not the one that {MANIFEST} names"]
    if sums.is_file() and sha256(sums) == part.sums_sha256:
        listed = read_checksums(folder)
        if strange := sorted(set(_files(folder)) - set(listed) - {schema.CHECKSUMS, schema.JOURNAL}):
            told = f"{folder} holds {printable_line(strange[0], 80)}, which is not listed in {schema.CHECKSUMS}"
            raise DatasetError(f"{told}; move it away if it is yours, or else ask who made the release")
        other = film_faults if part.kind == "films" else lambda folder: differing_files(folder, listed)
        faults = damaged_files(folder) if part.kind == "pairs" else other(folder)
    if faults:
        remove_tree(folder)
        _write_state(stage, {"title": title, "sums_sha256": part.sums_sha256, "unpacked": []})
        if is_fresh:
            told = f"its archives are those of {MANIFEST}, but {faults[0]}"
            raise DatasetError(f"{title} from {place.name} contradicts itself: {told}; ask who made the release")
        raise DatasetError(f"{title} from {place.name} is damaged: {faults[0]}; run the same command again")
