"""Sockets on which processes listen, and code that runs as another user."""

import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

NOBODY = 65534
_LISTENING, _ACCEPTING = "0A", 1 << 16  # state of TCP; flag of a socket of the UNIX family, see proc(5)


def listeners(group: int) -> set[str]:
    """Sockets of a process group that take connections or datagrams: "tcp 127.0.0.1:8786", "unix @name"."""
    held = set(_sockets(group))
    return {name for inode, name in (*_internet(), *_unix()) if inode in held}


def _sockets(group: int) -> Iterator[str]:
    """Inodes of the open sockets of a group."""
    for path in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # gone meanwhile
            if path.joinpath("stat").read_text().rsplit(")", 1)[1].split()[2] != str(group):
                continue
            for entry in path.joinpath("fd").iterdir():
                with contextlib.suppress(OSError):
                    target = str(entry.readlink())
                    if target.startswith("socket:["):
                        yield target[8:-1]


def _internet() -> Iterator[tuple[str, str]]:
    for kind in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/net/{kind}").read_text().splitlines()[1:]:
            fields = line.split()
            place, port = fields[1].split(":")
            if fields[3] == _LISTENING or kind.startswith("udp"):
                shown = socket.inet_ntoa(bytes.fromhex(place)[::-1]) if len(place) == 8 else place
                yield fields[9], f"{kind} {shown}:{int(port, 16)}"


def _unix() -> Iterator[tuple[str, str]]:
    for line in Path("/proc/net/unix").read_text().splitlines()[1:]:
        fields = line.split()
        if int(fields[3], 16) & _ACCEPTING:
            yield fields[6], f"unix {fields[7] if len(fields) > 7 else ''}"


def as_nobody(
    code: str, *arguments: object, imports: str = "", environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run code as the user `nobody`; `imports` before the change, as modules may be out of that user's reach."""
    change = f"\nimport os\nos.setgroups([]); os.setgid({NOBODY}); os.setuid({NOBODY})\n"
    command = [sys.executable, "-c", imports + change + code, *map(str, arguments)]
    variables = {**os.environ, **(environment or {})}
    return subprocess.run(command, cwd="/", env=variables, capture_output=True, text=True, timeout=500, check=False)


@contextlib.contextmanager
def accepting() -> Iterator[int]:
    """Port of the loopback device on which this process takes connections."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]
