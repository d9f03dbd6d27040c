"""HTTP downloads within bounds of time and bytes, whatever the server does; redirects followed, gzip unpacked.

`requests` bounds the wait for one piece of an answer, not the number of pieces: a byte a minute, headers without end,
and `100 Continue` again and again hold it for ever. Here the socket itself is watched. Until the body begins, through
all redirects, time and bytes are bounded together; then the body has a deadline or a least rate. Only time that is
spent waiting for the server counts.
"""

from __future__ import annotations

import io
import socket
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from urllib.parse import urljoin, urlsplit

import requests
import urllib3
from requests.adapters import HTTPAdapter
from urllib3.connection import HTTPConnection, HTTPSConnection
from urllib3.connectionpool import HTTPConnectionPool, HTTPSConnectionPool

from phibench.scenes.validation import printable_line

CHUNK = 1 << 14  # what is lost at most where a connection breaks off


@dataclass(frozen=True)
class Patience:
    """Bounds of time on a server, and of what it may say before the body.

    Parameters
    ----------
    answer_s : from the connection to the end of the headers, redirects included
    document_s : from the connection to the end of a small document
    window_s, least_bytes_per_s : a body must bring this rate in every window; a modem brings 5000 bytes a second
    header_bytes : status lines and headers of all answers together
    redirects : most answers that name another address
    """

    answer_s: float = 60.0
    document_s: float = 60.0
    window_s: float = 60.0
    least_bytes_per_s: float = 2048.0
    header_bytes: int = 1 << 18
    redirects: int = 5


class HopelessError(Exception):
    """An answer that the next try would get again; the message goes on after the name of the source."""


class _HeldUpError(OSError):
    """A server that takes more time, or says more, than it may."""


class TransferPace:
    """Time and bytes that an exchange with a server may take: one for each file and try.

    Parameters
    ----------
    most : int
        Bytes that the body may have, as they lie on the disk.
    is_document : bool
        True if the whole exchange has a deadline, False if the body has a least rate.

    Attributes
    ----------
    fault : str
        What the server did when it was given up; empty before.
    """

    def __init__(self, patience: Patience, most: int, is_document: bool) -> None:
        self.patience, self.most, self._is_document = patience, most, is_document
        self._waited = self._window = 0.0
        self._in_window = 0
        self._left, self._in_body = patience.header_bytes, False
        self.fault = ""

    def begin_body(self) -> None:
        """Headers are read, and what follows is the body."""
        self._in_body, self._window, self._in_window = True, 0.0, 0
        self._left = 2 * self.most + self.patience.header_bytes  # chunks of 16 bytes have as many of their lengths

    def seconds(self) -> float:
        """Seconds that the next piece may take; an `OSError` where none is left."""
        bounds = self.patience
        left = bounds.window_s - self._window if self._in_body else bounds.answer_s - self._waited
        if self._is_document:
            left = min(left, bounds.document_s - self._waited)
        if left > 0.0:
            return left
        begun = "sends its file too slowly" if self._in_body else "takes too long to begin its answer"
        raise self._held_up(f"{begun} ({self._waited:.0f} s)")

    def took(self, count: int, seconds: float) -> None:
        """Count a piece of the answer."""
        self._waited, self._window = self._waited + seconds, self._window + seconds
        self._in_window += count
        self._left -= count
        if self._left < 0:
            raise self._held_up("sends more than the file has" if self._in_body else "sends headers without end")
        if self._in_window >= self.patience.window_s * self.patience.least_bytes_per_s:
            self._window, self._in_window = 0.0, 0

    def _held_up(self, text: str) -> _HeldUpError:
        self.fault = text
        return _HeldUpError(text)


class _PacedFile(io.RawIOBase):
    """Bytes of a socket, each piece within what a pace allows."""

    def __init__(self, connected: socket.socket, pace: TransferPace) -> None:
        self._socket, self._pace = connected, pace
        self._raw = connected.makefile("rb", buffering=0)  # keeps the socket open for as long as it is read

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int | None:
        self._socket.settimeout(self._pace.seconds())
        start = time.monotonic()
        count: int | None = 0
        try:
            count = self._raw.readinto(buffer)
        except TimeoutError:
            self._pace.took(0, time.monotonic() - start)
            self._pace.seconds()
            raise
        self._pace.took(count or 0, time.monotonic() - start)
        return count

    def close(self) -> None:
        self._raw.close()
        super().close()


class _PacedSocket:
    """Socket whose file is paced; all else is the socket's own."""

    def __init__(self, connected: socket.socket, pace: TransferPace) -> None:
        self._socket, self._pace = connected, pace

    def makefile(self, *_: Any, **__: Any) -> io.BufferedReader:
        return io.BufferedReader(_PacedFile(self._socket, self._pace))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._socket, name)


class _PacedAdapter(HTTPAdapter):
    """Transport of `requests` whose sockets are paced, behind a proxy as well."""

    def __init__(self, pace: TransferPace) -> None:
        class Plain(HTTPConnection):
            def connect(self) -> None:
                super().connect()
                self.sock = _PacedSocket(self.sock, pace)

        class Secure(HTTPSConnection):
            def connect(self) -> None:
                super().connect()
                self.sock = _PacedSocket(self.sock, pace)

        plain = type("Pool", (HTTPConnectionPool,), {"ConnectionCls": Plain})
        secure = type("SecurePool", (HTTPSConnectionPool,), {"ConnectionCls": Secure})
        self._pools = {"http": plain, "https": secure}
        super().__init__()

    def init_poolmanager(self, *args: Any, **kwargs: Any) -> None:
        super().init_poolmanager(*args, **kwargs)
        self.poolmanager.pool_classes_by_scheme = self._pools

    def proxy_manager_for(self, proxy: str, **kwargs: Any) -> Any:
        manager = super().proxy_manager_for(proxy, **kwargs)
        manager.pool_classes_by_scheme = self._pools
        return manager


@contextmanager
def server_answer(url: str, headers: dict[str, str], pace: TransferPace) -> Iterator[requests.Response]:
    """Server's answer after its redirects, the body not yet read, and not to be packed for the way.

    Raises
    ------
    requests.RequestException
        If there is none.
    HopelessError
        If it leads to addresses that are not followed.
    """
    with requests.Session() as session:
        adapter = _PacedAdapter(pace)
        for scheme in ("http://", "https://"):
            session.mount(scheme, adapter)
        response = _followed(session, url, {"Accept-Encoding": "identity", **headers}, pace)
        try:
            pace.begin_body()
            yield response
        finally:
            response.close()


def _followed(session: requests.Session, url: str, headers: dict[str, str], pace: TransferPace) -> requests.Response:
    for _ in range(pace.patience.redirects + 1):
        response = _asked(session, url, headers, pace.patience.answer_s)
        target = session.get_redirect_target(response)
        if target is None:
            return response
        response.close()
        url = _redirected(url, target)
    raise HopelessError(f"leads from address to address, more than {pace.patience.redirects} times")


def _asked(session: requests.Session, url: str, headers: dict[str, str], timeout_s: float) -> requests.Response:
    try:
        return session.get(url, headers=headers, stream=True, timeout=timeout_s, allow_redirects=False)
    except requests.exceptions.InvalidURL as error:
        raise HopelessError(f"leads to {shown_address(url)}, which is no address of a server") from error
    except requests.RequestException:
        raise
    except (ValueError, urllib3.exceptions.HTTPError) as error:  # names of hosts that no library's check has seen
        raise HopelessError(f"leads to {shown_address(url)}, which is no address of a server") from error


def _redirected(url: str, target: str) -> str:
    """Address that an answer names; a secure one does not lead to one that is not."""
    try:
        new = urljoin(url, target)
        scheme, host = urlsplit(new).scheme, urlsplit(new).hostname
    except ValueError as error:
        raise HopelessError("leads to an address that cannot be read") from error
    if scheme not in ("http", "https") or not host:
        raise HopelessError(f"leads to {shown_address(new)}; only http:// and https:// are followed")
    if urlsplit(url).scheme == "https" and scheme == "http":
        raise HopelessError(f"leads from https:// to {shown_address(new)}, which is not secure; give that as --from")
    return new


def shown_address(url: str) -> str:
    """Address as it may be printed: without name, password, query and fragment."""
    try:
        parts = urlsplit(url)
        port = f":{parts.port}" if parts.port is not None else ""
        return printable_line(f"{parts.scheme}://{parts.hostname or ''}{port}{parts.path}", 200)
    except ValueError:
        return "an address that cannot be read"


def body_pieces(response: requests.Response, pace: TransferPace) -> Iterator[bytes]:
    """Pieces of a body, unpacked where the server has packed it with gzip unasked; together they are bounded.

    Raises
    ------
    requests.ConnectionError
        If it breaks off.
    HopelessError
        If it is packed otherwise.
    ValueError
        If it is larger than the pace allows; all but the last piece have come.
    """
    packing = response.headers.get("Content-Encoding", "identity").strip().lower()
    if packing not in ("identity", "", "gzip", "x-gzip"):
        raise HopelessError(f"packs its files as '{printable_line(packing, 40)}', which was not asked for")
    pieces = _pieces(response)
    count = 0
    for piece in _unpacked(pieces) if "gzip" in packing else pieces:
        count += len(piece)
        if count > pace.most:
            raise ValueError("more bytes than there may be")
        yield piece


def _pieces(response: requests.Response) -> Iterator[bytes]:
    try:
        while piece := response.raw.read(CHUNK, decode_content=False):
            yield piece
    except (urllib3.exceptions.HTTPError, OSError) as error:
        raise requests.ConnectionError(error) from error


def _unpacked(pieces: Iterator[bytes]) -> Iterator[bytes]:
    unpacker = zlib.decompressobj(16 + zlib.MAX_WBITS)  # 16: the header is gzip's
    try:
        for piece in pieces:
            while piece and not unpacker.eof:
                yield unpacker.decompress(piece, CHUNK)  # a thousandfold is possible: never more than a chunk at once
                piece = unpacker.unconsumed_tail
        yield unpacker.flush()
    except zlib.error as error:
        raise requests.ConnectionError("it is packed wrongly") from error
    if not unpacker.eof:
        raise requests.ConnectionError("it ended early")
