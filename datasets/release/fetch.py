"""Fetching of a released data set from a folder or an HTTP server: verified, resumable, all or nothing.

`pooch` downloads each archive and checks its SHA-256, which `MANIFEST.json` holds. Archives are unpacked beside the
final folder, in OUT.part. When all files have the hashes of the data set's own list, the folder gets its name.
Whatever ends a fetch before that leaves OUT.part alone. The next one goes on where it ended: within an archive, too, if
the server gives ranges of bytes (RFC 9110, section 14).
"""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from rich.console import Console

from phibench.datasets.build.forecast import megabytes
from phibench.datasets.errors import DatasetError
from phibench.datasets.input_files import FILE_NAME, SETTINGS_BYTES, InputFile
from phibench.datasets.progress import Steps, progress_console
from phibench.datasets.release.benchmark import MANIFEST, Archive, ReleasedPart, chosen_parts, read_manifest_file
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import differing_files, read_checksums
from phibench.datasets.store.files import WriteError, only_run, sha256, write_text
from phibench.datasets.store.leftovers import OwnedFolder, folder_for_work, remove_tree
from phibench.scenes.validation import nearest, printable_line

if TYPE_CHECKING:
    import requests

SOURCE = "PHIBENCH_SOURCE"
"""Environment variable: the default place of releases, a folder or an HTTP address."""
_STATE, _SET, _ARCHIVES = "fetch.json", "set", "archives"
_TIMEOUT_S = 60.0
_TRIES = 3
_CHUNK = 1 << 20
_NETWORK_CHUNK = 1 << 14  # what is lost at most where a connection breaks off


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

    Raises
    ------
    DatasetError
        In one sentence: no source, no such name, something else in the folder, a source that cannot be reached or
        breaks off, a file with another hash. Nothing is then under the final name.
    """
    out, console, place = Path(out), console or progress_console(), _Source.of(source, tries)
    title, part = _listed(name, place, out, manifest_sha256)
    if out.exists() or out.is_symlink():
        if _is_the_set(out, part):
            return Fetched(out, title, 0, len(part.archives))
        raise DatasetError(_what_it_is(out, title, part))
    stage = out.with_name(f"{out.name}.part")
    try:
        _claim(stage, title, part)
        with only_run(stage):
            fetched = _archives(place, stage, title, part, console)
            _check(stage, title, part, place)
            (stage / _SET).rename(out)
    except OSError as error:
        text = str(error) if isinstance(error, WriteError) else f"could not write to {stage}: {error}"
        raise DatasetError(f"{text}; then run the same command again") from error
    remove_tree(stage)
    return Fetched(out, title, fetched, len(part.archives))


def _listed(name: str, place: _Source, out: Path, manifest_sha256: str | None) -> tuple[str, ReleasedPart]:
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
    if stage.is_dir() and any(not path.name.startswith(".") for path in stage.iterdir()):
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
    begun = sum(_Partial(stage / _ARCHIVES, archive).size for archive in part.archives)
    left = part.size + max(archive.size for archive in part.archives) - _size(stage / _SET) - begun
    if free < left:
        raise DatasetError(f"{title} needs {megabytes(left)} more in {stage.parent}, and {megabytes(free)} are free")


def _write_state(stage: Path, state: dict[str, Any]) -> None:
    write_text(stage / _STATE, json.dumps(state, indent=1) + "\n")


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _archives(place: _Source, stage: Path, title: str, part: ReleasedPart, console: Console) -> int:
    """Fetch and unpack the archives that are missing; return how many."""
    state = InputFile(stage / _STATE, f"remove {stage}", limit_bytes=SETTINGS_BYTES).json()
    done = [text for text in state.get("unpacked", []) if isinstance(text, str)]
    todo = [archive for archive in part.archives if archive.sha256 not in done]
    (stage / _SET).mkdir(exist_ok=True)
    _remove_strays(stage / _ARCHIVES, todo)

    current: Archive | None = None

    def running() -> str:
        begun = 0 if current is None else _Partial(stage / _ARCHIVES, current).size
        return f"{current.name}, {megabytes(begun)} of {megabytes(current.size)}" if current and begun else ""

    with Steps(console, title, len(todo), running=running) as steps:
        for current in todo:
            path = place.get(current.name, stage / _ARCHIVES, current)
            unpack(path, stage / _SET, title, part.size)
            done.append(current.sha256)
            _write_state(stage, state | {"unpacked": done})
            path.unlink()  # a disk need not hold all archives beside the set
            steps.advance()
    return len(todo)


def _remove_strays(folder: Path, archives: list[Archive]) -> None:
    """Remove what a killed fetch left of `pooch`'s own temporary files; the run holds the folder alone."""
    parts = [_Partial(folder, archive) for archive in archives]
    kept = {folder / archive.name for archive in archives}
    kept |= {path for part in parts for path in (part.path, part.validator)}
    for path in set(folder.glob("*")) - kept:
        path.unlink()


def unpack(archive: Path, folder: Path, title: str, most: int) -> None:
    """Unpack an archive of plain files below `title/`; anything else in it is refused before it is written.

    Parameters
    ----------
    most : bytes that the members may have together

    Raises
    ------
    DatasetError
        For a link, a device, a name that leads out of the folder or comes twice, or too many bytes.
    """
    seen, left = set[str](), most
    try:
        with tarfile.open(archive, "r:") as tar:
            for member in tar:
                name = member.name.removeprefix(f"{title}/")
                if not member.isreg() or name == member.name or not re.fullmatch(FILE_NAME, name) or name in seen:
                    told = printable_line(member.name, 80)
                    raise DatasetError(f"{archive.name} holds '{told}', which no release has; nothing of it is used")
                seen.add(name)
                left -= member.size
                if left < 0:
                    raise DatasetError(f"{archive.name} holds more bytes than {MANIFEST} says; nothing of it is used")
                source = tar.extractfile(member)
                assert source is not None  # it is a regular file
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                with source, (folder / name).open("wb") as target:
                    shutil.copyfileobj(source, target, _CHUNK)
    except tarfile.TarError as error:
        raise DatasetError(f"{archive.name} is no tar file: {error}; ask who made the release") from error


def _check(stage: Path, title: str, part: ReleasedPart, place: _Source) -> None:
    """Compare all files with the data set's own list; on any fault all archives are fetched again the next time."""
    folder = stage / _SET
    sums = folder / schema.CHECKSUMS
    faults = [f"{schema.CHECKSUMS} is not the one that {MANIFEST} names"]
    if sums.is_file() and sha256(sums) == part.sums_sha256:
        listed = read_checksums(folder)
        there = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
        strange = sorted(there - set(listed) - {schema.CHECKSUMS, schema.JOURNAL})
        faults = differing_files(folder, listed) + [f"{name} is not listed" for name in strange]
    if faults:
        remove_tree(folder)
        _write_state(stage, {"title": title, "sums_sha256": part.sums_sha256, "unpacked": []})
        raise DatasetError(f"{title} from {place.name} is damaged: {faults[0]}; run the same command again")


# Where files come from.


@dataclass(frozen=True)
class _Source:
    """Folder or HTTP address of a release."""

    name: str
    is_folder: bool
    tries: int

    @classmethod
    def of(cls, given: str | None, tries: int) -> _Source:
        place = given or os.environ.get(SOURCE, "")
        if not place:
            raise DatasetError(f"no host is set: give --from with a folder or an address, or set {SOURCE}")
        if urlsplit(place).scheme in ("http", "https"):
            return cls(place.rstrip("/"), False, tries)
        if not Path(place).is_dir():
            raise DatasetError(
                f"--from {place}: there is no such folder; give a folder, or an address with http:// or https://"
            )
        return cls(place, True, tries)

    def get(self, name: str, folder: Path, archive: Archive | None) -> Path:
        """File of the release in `folder`; one that lies there with the right hash is kept.

        Raises
        ------
        DatasetError
            If it cannot be had, or has another hash than the manifest says.
        """
        import pooch
        import requests

        digest = None if archive is None else f"sha256:{archive.sha256}"
        url = f"{Path(self.name).resolve().as_posix()}/{name}" if self.is_folder else f"{self.name}/{name}"
        files = pooch.create(
            folder,
            self.name,
            registry={name: digest},
            urls={name: url},
            retry_if_failed=0 if self.is_folder else self.tries - 1,
        )
        download = _copy if self.is_folder else pooch.HTTPDownloader(timeout=_TIMEOUT_S)
        if archive is not None and not self.is_folder:
            download = _Partial(folder, archive).download
        again = "run the same command again; archives that are there are kept"
        try:
            with _quiet(pooch.get_logger()):
                return Path(files.fetch(name, downloader=download))
        except requests.HTTPError as error:
            raise DatasetError(f"{self.name} does not give {name}: {printable_line(str(error), 200)}") from error
        except requests.ConnectionError as error:
            if archive is None:
                raise DatasetError(
                    f"{self.name} does not answer: check the address, and that its server runs"
                ) from error
            raise DatasetError(f"{name} from {self.name} broke off: {_reason(error)}; {again}") from error
        except requests.RequestException as error:
            raise DatasetError(f"{name} from {self.name} broke off: {_reason(error)}; {again}") from error
        except ValueError as error:  # pooch's word for another hash
            if archive is None:
                raise
            told = f"{name} from {self.name} is damaged: its SHA-256 is not the one in {MANIFEST}"
            raise DatasetError(f"{told}; {again}, and if it stays so, ask who gave the release") from error
        except FileNotFoundError as error:
            raise DatasetError(f"{self.name} has no {name}; it may be no release, or an unfinished one") from error


class _Partial:
    """First bytes of an archive, kept under a name made of its SHA-256 until the archive is whole.

    Parameters
    ----------
    folder : Path
    archive : Archive
        Name, size in bytes and SHA-256, as the manifest has them.

    Attributes
    ----------
    path, validator : Path
        The bytes, and the server's entity tag or time of change for them (empty if it names neither). Without the
        second file the first is of no use: a server had packed the bytes for the way, and ranges count packed ones.
    """

    def __init__(self, folder: Path, archive: Archive) -> None:
        self._archive = archive
        self.path, self.validator = folder / f"{archive.sha256}.part", folder / f"{archive.sha256}.validator"

    @property
    def size(self) -> int:
        """Bytes that are there."""
        return self.path.stat().st_size if self.path.is_file() else 0

    def download(self, url: str, target: str, _pooch: Any) -> None:
        """Put the whole archive into the file `target`, from the bytes that are there and the rest of the server's.

        Bytes that were put together from two answers are taken with the right SHA-256 only; else all are asked for.

        Raises
        ------
        requests.RequestException
            If the connection breaks off, or the server refuses; what came stays.
        ValueError
            If the server sends more than the archive has.
        """
        if not (self.size and self.validator.is_file() and self._completed(url)):
            with _answer(url, {}) as answer:
                answer.raise_for_status()
                self._take_whole(answer)
        self.path.replace(target)
        self.validator.unlink(missing_ok=True)

    def _completed(self, url: str) -> bool:
        """Ask for the bytes that are missing; False if the server does not give them, or if they do not fit."""
        begun = self.size
        if begun < self._archive.size:
            asked = {"Range": f"bytes={begun}-", "If-Range": self.validator.read_text("ascii", "ignore")}
            with _answer(url, {key: value for key, value in asked.items() if value}) as answer:
                if answer.status_code == 200:  # no ranges here, or another file by now
                    self._take_whole(answer)
                    return True
                if answer.status_code not in (206, 412, 416):  # 503, say: what is there may still do
                    answer.raise_for_status()
                if not answer.headers.get("Content-Range", "").startswith(f"bytes {begun}-"):
                    return False
                self._take(answer, "ab")
        return sha256(self.path) == self._archive.sha256

    def _take_whole(self, answer: requests.Response) -> None:
        self.validator.unlink(missing_ok=True)
        self.path.unlink(missing_ok=True)
        if answer.headers.get("Content-Encoding", "identity") == "identity":
            tag, changed = answer.headers.get("ETag", ""), answer.headers.get("Last-Modified", "")
            strong = tag if tag.startswith('"') else changed  # a weak tag will not do
            self.validator.write_text(strong, "ascii", "ignore")
        self._take(answer, "wb")

    def _take(self, answer: requests.Response, mode: str) -> None:
        import requests

        with self.path.open(mode) as file:
            for chunk in answer.iter_content(_NETWORK_CHUNK):
                file.write(chunk)
                if file.tell() > self._archive.size:
                    self.validator.unlink(missing_ok=True)
                    raise ValueError(f"{self._archive.name} has more bytes than {MANIFEST} says")
        # a range may be shorter than what was asked for, and without a length nobody else notices the end
        ended_early = answer.status_code == 206 or "Content-Length" not in answer.headers
        if ended_early and self.size < self._archive.size:
            raise requests.ConnectionError(f"{self._archive.name} ended early")


def _answer(url: str, headers: dict[str, str]) -> requests.Response:
    """Server's answer, its body not yet read, and not to be packed for the way."""
    import requests

    return requests.get(url, headers={"Accept-Encoding": "identity", **headers}, stream=True, timeout=_TIMEOUT_S)


def _copy(url: str, target: str, _pooch: Any) -> None:
    shutil.copyfile(url, target)


def _reason(error: Exception) -> str:
    """Kind of a failed connection, without the library's nested quotation of it."""
    return re.sub(r"(?<!^)(?=[A-Z])", " ", type(error).__name__).lower()


@contextmanager
def _quiet(logger: logging.Logger) -> Iterator[None]:
    """Keep a library's lines off the terminal, where our own progress is."""
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
