"""Runs of `phibench dataset make` as processes, and what they say."""

import contextlib
import io
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from rich.console import Console

SMALLEST = Path(__file__).resolve().parents[1] / "smallest.toml"


def quiet() -> Console:
    return Console(file=io.StringIO(), width=200)


def said(console: Console) -> str:
    return console.file.getvalue()  # type: ignore[attr-defined]


def living(group: int) -> list[str]:
    """Processes of a group that are not zombies waiting for somebody to collect them: pid, state, parent, group, ..."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # gone meanwhile
            name, rest = path.read_text().rsplit(")", 1)
            state, _, its_group = rest.split()[:3]
            if its_group == str(group) and state != "Z":
                found.append(name)
    return found


def left_of(group: int, seconds: float = 20.0) -> list[str]:
    """Processes of a group that live on, after some time to end in."""
    deadline = time.monotonic() + seconds
    while (left := living(group)) and time.monotonic() < deadline:
        time.sleep(0.1)
    return left


def processes_under(folder: Path) -> Iterator[int]:
    """Processes whose folder for temporary files lies in a folder, as that of every method's process does."""
    mark = os.fsencode(f"TMPDIR={folder}{os.sep}")
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # gone meanwhile, or another user's
            variables = (entry / "environ").read_bytes().split(b"\0")
            if int(entry.name) != os.getpid() and any(x.startswith(mark) for x in variables):
                yield int(entry.name)


def wait_until(done: Callable[[], object], what: str, seconds: float = 60.0) -> None:
    """Wait for an event; the seconds only end a test that would wait for ever."""
    deadline = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < deadline, f"{what} did not come"
        time.sleep(0.02)


def wait_for(path: Path, seconds: float = 60.0) -> None:
    wait_until(path.exists, str(path), seconds)


@contextlib.contextmanager
def within(seconds: int) -> Iterator[None]:
    """Interrupt what waits for ever."""

    def late(*_: object) -> None:
        raise TimeoutError(f"not done within {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
