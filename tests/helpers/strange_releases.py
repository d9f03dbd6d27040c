"""Releases of a few bytes that are wrong in one way, and servers that answer with any bytes at any pace."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import socket
import tarfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

TITLE = "phibench-v4-tiny"
Member = tuple[tarfile.TarInfo, bytes]


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def member(name: str, data: bytes = b"x", kind: bytes = tarfile.REGTYPE, target: str = "") -> Member:
    info = tarfile.TarInfo(name)
    info.type, info.linkname, info.size = kind, target, len(data) if kind == tarfile.REGTYPE else 0
    return info, data


def packed(members: list[Member], form: int = tarfile.USTAR_FORMAT) -> bytes:
    """Bytes of an archive."""
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w", format=form) as tar:
        for info, data in members:
            tar.addfile(info, io.BytesIO(data))
    return file.getvalue()


def tiny_release(
    folder: Path,
    content: Mapping[str, bytes] | None = None,
    *,
    sums: bytes | None = None,
    archive: bytes | None = None,
    **entry: Any,
) -> Path:
    """Write a release of one set of few files, as a sealed one; `entry` replaces values of its line in the manifest."""
    files = {"seal.json": b"{}", "frames/a.png": b"a picture"} if content is None else content
    text = "".join(f"{digest(data)}  {name}\n" for name, data in sorted(files.items())).encode()
    packed_files = {**files, "SHA256SUMS": text if sums is None else sums}
    data = (
        packed([member(f"{TITLE}/{name}", part) for name, part in packed_files.items()]) if archive is None else archive
    )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{TITLE}-000.tar").write_bytes(data)
    listed = {
        "kind": "sealed",
        "recipe_sha256": "0" * 64,
        "samples": 1,
        "files": len(packed_files),
        "size": max(1, sum(map(len, packed_files.values()))),
        "sums_sha256": digest(packed_files["SHA256SUMS"]),
        "archives": [{"name": f"{TITLE}-000.tar", "size": len(data), "sha256": digest(data)}],
    }
    manifest = {"format": "phibench release 1", "benchmark": "4.0", "phibench": "0"}
    (folder / "MANIFEST.json").write_text(json.dumps({**manifest, "parts": {TITLE: {**listed, **entry}}}))
    return folder


Say = Callable[[bytes], None]
Answer = Callable[[str, Say], None]
"""Answer to a path, by a function that sends bytes; it ends the test's server as soon as the client has gone."""


@contextmanager
def strange_server(answer: Answer) -> Iterator[str]:
    """Address of a server on the loopback device that says what it likes, one thread for each client."""
    listener = socket.create_server(("127.0.0.1", 0))
    listener.settimeout(0.05)
    ended = threading.Event()

    def serve(client: socket.socket) -> None:
        def say(data: bytes) -> None:
            if ended.is_set():
                raise BrokenPipeError
            client.sendall(data)

        with client, contextlib.suppress(OSError):
            client.settimeout(5.0)
            asked = b""
            while b"\r\n\r\n" not in asked and (data := client.recv(4096)):
                asked += data
            answer(asked.split(b" ")[1].decode("latin-1"), say)

    def listen() -> None:
        while not ended.is_set():
            with contextlib.suppress(TimeoutError):
                clients.append(threading.Thread(target=serve, args=(listener.accept()[0],)))
                clients[-1].start()

    clients: list[threading.Thread] = []
    listening = threading.Thread(target=listen)
    listening.start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        ended.set()
        listening.join()
        listener.close()
        for client in clients:
            client.join()


def file_answer(data: bytes, *headers: str) -> bytes:
    """Bytes of a plain answer."""
    lines = ["HTTP/1.1 200 OK", f"Content-Length: {len(data)}", "Connection: close", *headers]
    return "\r\n".join([*lines, "", ""]).encode("latin-1") + data


def trickle(say: Say, data: bytes, pause_s: float = 0.02) -> None:
    """Say the same again and again, slowly."""
    while True:
        say(data)
        time.sleep(pause_s)
