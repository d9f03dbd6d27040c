"""Sources of a release's files, a folder or an HTTP address; archive downloads that go on after a break (`Partial`).

`pooch` tries again, and compares each archive with its SHA-256 in `MANIFEST.json`. The bytes come in bounds of time and
size (`paced_http`), and go on within an archive if the server gives ranges of bytes (RFC 9110, section 14).
"""

from __future__ import annotations

import logging
import os
import re
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from phibench.benchmark.release.release_parts import MANIFEST, Archive
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import SETTINGS_BYTES
from phibench.datasets.store.files import sha256
from phibench.scenes.validation import printable_line

if TYPE_CHECKING:
    import requests

    from phibench.benchmark.release.paced_http import Patience, TransferPace

SOURCE = "PHIBENCH_SOURCE"
"""Environment variable: the default place of releases, a folder or an HTTP address."""
_CHUNK = 1 << 20  # bytes of a local file at a time


@dataclass(frozen=True)
class Source:
    """Folder or HTTP address of a release.

    Parameters
    ----------
    name : as it is printed, without name and password
    place : folder, or address with all that it holds
    tries : attempts at a file
    patience : bounds of time, or None for those of `Patience`
    """

    name: str
    place: str = field(repr=False)
    is_folder: bool
    tries: int
    patience: Patience | None = None

    @classmethod
    def of(cls, given: str | None, tries: int, patience: Patience | None = None) -> Source:
        """Place that is given, or that of the environment.

        Raises
        ------
        DatasetError
            If it is neither a folder nor an address.
        """
        place = given or os.environ.get(SOURCE, "")
        if not place:
            raise DatasetError(f"no host is set: give --from with a folder or an address, or set {SOURCE}")
        if re.match("https?:", place, re.IGNORECASE):
            return cls(_address_name(place), place.rstrip("/"), False, tries, patience)
        if not Path(place).is_dir():
            told = re.sub(r"[^/]*:[^/]*@", "", place)  # a name and a password
            raise DatasetError(
                f"--from {told}: there is no such folder; give a folder, or an address with http:// or https://"
            )
        return cls(place, place, True, tries, patience)

    def get(self, name: str, folder: Path, archive: Archive | None) -> Path:
        """File of the release in `folder`; one that lies there with the right hash is kept.

        Raises
        ------
        DatasetError
            If it cannot be had, or has another hash than the manifest says.
        """
        import pooch
        import requests

        from phibench.benchmark.release.paced_http import HopelessError, Patience

        transfer = _Transfer(name, folder, archive, self.patience or Patience())
        place = Path(self.place).resolve().as_posix() if self.is_folder else self.place
        files = pooch.create(
            folder,
            place,
            registry={name: None if archive is None else f"sha256:{archive.sha256}"},
            urls={name: f"{place}/{name}"},
            retry_if_failed=0 if self.is_folder else self.tries - 1,
        )
        again = "run the same command again; archives that are there are kept"
        try:
            with _quiet(pooch.get_logger()):
                return Path(files.fetch(name, downloader=transfer.copy if self.is_folder else transfer.download))
        except HopelessError as error:
            raise DatasetError(f"{self.name} {error}; ask who gave it") from error
        except requests.HTTPError as error:
            raise DatasetError(f"{self.name} does not give {name}: {error}") from error
        except requests.RequestException as error:
            if transfer.fault:
                raise DatasetError(f"{self.name} {transfer.fault}: {name} was given up; {again}") from error
            if archive is None and isinstance(error, requests.ConnectionError):
                told = f"{self.name} does not answer: check the address, and that its server runs"
                raise DatasetError(told) from error
            raise DatasetError(f"{name} from {self.name} broke off: {_reason(error)}; {again}") from error
        except ValueError as error:  # pooch's word for another hash
            if archive is None:
                raise DatasetError(f"{name} of {self.name} {error}; ask who gave it") from error
            told = f"{name} from {self.name} is damaged: its SHA-256 is not the one in {MANIFEST}"
            raise DatasetError(f"{told}; {again}, and if it stays so, ask who gave the release") from error
        except FileNotFoundError as error:
            raise DatasetError(f"{self.name} has no {name}; it may be no release, or an unfinished one") from error


def _address_name(place: str) -> str:
    """Address as it is printed; one that no server can have is refused."""
    try:
        parts = urlsplit(place)
        port = "" if parts.port is None else f":{parts.port}"
        extra = parts.query or parts.fragment
    except ValueError as error:  # its text would quote a password
        raise DatasetError("--from: the address cannot be read; give http://HOST[:PORT][/FOLDER]") from error
    host = parts.hostname or ""
    name = printable_line(f"{parts.scheme}://{f'[{host}]' if ':' in host else host}{port}{parts.path.rstrip('/')}")
    if not host or parts.scheme not in ("http", "https"):
        raise DatasetError("--from: the address names no host; give http://HOST[:PORT][/FOLDER]")
    if extra:
        raise DatasetError(f"--from {name}: names of files are put at its end, so leave out '?', '#' and what follows")
    return name


class _Transfer:
    """One file on its way; `fault` is why a server was given up, in the last try."""

    def __init__(self, name: str, folder: Path, archive: Archive | None, patience: Patience) -> None:
        self._name, self._archive, self._patience = name, archive, patience
        self._partial = None if archive is None else Partial(folder, archive)
        self._most = SETTINGS_BYTES if archive is None else archive.size
        self._pace: TransferPace | None = None

    @property
    def fault(self) -> str:
        return "" if self._pace is None else self._pace.fault

    def copy(self, path: str, target: str, _pooch: Any) -> None:
        """Copy a file of a folder: a regular one, and no larger than it may be."""
        from phibench.benchmark.release.paced_http import HopelessError

        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        with os.fdopen(handle, "rb") as source, Path(target).open("wb") as copy:
            status = os.fstat(handle)
            if not stat.S_ISREG(status.st_mode):
                raise HopelessError(f"holds {self._name}, which is no ordinary file")
            if status.st_size > self._most:
                raise ValueError(f"has {status.st_size} bytes: at most {self._most} are read")
            left = self._most
            while left and (data := source.read(min(_CHUNK, left))):
                left -= len(data)
                copy.write(data)

    def download(self, url: str, target: str, _pooch: Any) -> None:
        """Put what a server sends into the file `target`."""
        from phibench.benchmark.release.paced_http import body_pieces, server_answer

        if self._partial is not None:
            self._partial.download(url, target, self._new_pace)
            return
        pace = self._new_pace()
        with server_answer(url, {}, pace) as response, Path(target).open("wb") as file:
            _require_file(response)
            try:
                for piece in body_pieces(response, pace):
                    file.write(piece)
            except ValueError as error:
                raise ValueError(f"has more than {self._most} bytes, the most that are read of its kind") from error

    def _new_pace(self) -> TransferPace:
        from phibench.benchmark.release.paced_http import TransferPace

        self._pace = TransferPace(self._patience, self._most, is_document=self._archive is None)
        return self._pace


def _require_file(response: requests.Response) -> None:
    """Refuse an answer that is not a whole file; the library's own sentence would quote the address."""
    import requests

    if response.status_code != 200:
        told = f"{response.status_code} {response.reason or ''}".strip()
        raise requests.HTTPError(printable_line(told, 100), response=response)


class Partial:
    """First bytes of an archive, kept under a name made of its SHA-256 until the archive is whole.

    Parameters
    ----------
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

    def download(self, url: str, target: str, new_pace: Callable[[], TransferPace]) -> None:
        """Put the whole archive into the file `target`, from the bytes that are there and the rest of the server's.

        Bytes that were put together from two answers are taken with the right SHA-256 only; else all are asked for.

        Raises
        ------
        requests.RequestException
            If the connection breaks off, or the server refuses; what came stays.
        ValueError
            If the server sends more than the archive has.
        """
        from phibench.benchmark.release.paced_http import server_answer

        if not (self.size and self.validator.is_file() and self._completed(url, new_pace())):
            pace = new_pace()
            with server_answer(url, {}, pace) as response:
                _require_file(response)
                self._take_whole(response, pace)
        self.path.replace(target)
        self.validator.unlink(missing_ok=True)

    def _completed(self, url: str, pace: TransferPace) -> bool:
        """Ask for the bytes that are missing; False if the server does not give them, or if they do not fit."""
        from phibench.benchmark.release.paced_http import server_answer

        begun = self.size
        if begun < self._archive.size:
            asked = {"Range": f"bytes={begun}-", "If-Range": self.validator.read_text("ascii", "ignore")}
            with server_answer(url, {key: value for key, value in asked.items() if value}, pace) as response:
                if response.status_code == 200:  # no ranges here, or another file by now
                    self._take_whole(response, pace)
                    return True
                if response.status_code not in (206, 412, 416):  # 503, say: what is there may still do
                    _require_file(response)
                if not response.headers.get("Content-Range", "").startswith(f"bytes {begun}-"):
                    return False  # the server knows no ranges: from the beginning
                self._take(response, pace, "ab")
        return sha256(self.path) == self._archive.sha256

    def _take_whole(self, response: requests.Response, pace: TransferPace) -> None:
        self.validator.unlink(missing_ok=True)
        self.path.unlink(missing_ok=True)
        if response.headers.get("Content-Encoding", "identity") == "identity":
            tag, changed = response.headers.get("ETag", ""), response.headers.get("Last-Modified", "")
            strong = tag if tag.startswith('"') else changed  # a weak tag will not do
            self.validator.write_text(strong, "ascii", "ignore")
        self._take(response, pace, "wb")

    def _take(self, response: requests.Response, pace: TransferPace, mode: str) -> None:
        import requests

        from phibench.benchmark.release.paced_http import body_pieces

        with self.path.open(mode) as file:
            for piece in body_pieces(response, pace):
                file.write(piece)
                if file.tell() > self._archive.size:
                    self.validator.unlink(missing_ok=True)
                    raise ValueError(f"{self._archive.name} has more bytes than {MANIFEST} says")
        # a range may be shorter than what was asked for, and without a length nobody else notices the end
        ended_early = response.status_code == 206 or "Content-Length" not in response.headers
        if ended_early and self.size < self._archive.size:
            raise requests.ConnectionError(f"{self._archive.name} ended early")


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
