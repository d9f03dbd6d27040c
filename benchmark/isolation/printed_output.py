"""Printed output of a method's process: its end kept; source line of a stack; advice on files that are denied."""

from __future__ import annotations

import os
import re
import select
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

from phibench.benchmark.isolation.isolation import Isolation
from phibench.scenes.validation import printable_line

_KEPT_BYTES = 65536  # of what a method prints: its end tells why it failed
_LINES, _LINE_LENGTH = 20, 200  # of the output that an outcome keeps
_READS = 16  # of 64 kB at a time
_LOOK_MS = 500  # between looks at whether anybody listens
# Python 3.14 prints a stack of C functions after that of Python
_STACK = re.compile(r"(?<!C stack trace )\(most recent call first\)")


_FRAME = re.compile(r'^  File "(.+)", line (\d+) in (.+)$')


class OutputTail:
    """The end of what a process prints; its pipe is emptied all the time, so that the process never waits.

    Parameters
    ----------
    pipe : binary file
        Standard output and error of the process.
    """

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe, self._tail, self._count, self._ended = pipe, b"", 0, False
        self._lock = threading.Lock()
        os.set_blocking(pipe.fileno(), False)
        self._thread = threading.Thread(target=self._drain, daemon=True)
        self._thread.start()

    def text(self, wait_s: float = 0.0, since: int = 0) -> str:
        """Text after the first `since` bytes, 64 kB at most; waits so long for the pipe to end."""
        self._thread.join(wait_s)
        with self._lock:
            self._take()
            new = min(self._count - since, len(self._tail))
            return self._tail[len(self._tail) - new :].decode(errors="replace")

    def count(self) -> int:
        """Bytes that were printed so far."""
        with self._lock:
            self._take()
            return self._count

    def close(self) -> None:
        """Listen no more, even if a process that could not be ended holds the pipe."""
        with self._lock:
            self._ended = True

    def _drain(self) -> None:
        with self._pipe:
            events = select.poll()  # `select.select` knows the first 1024 files only
            events.register(self._pipe, select.POLLIN)
            while not self._ended:
                events.poll(_LOOK_MS)
                with self._lock:
                    self._take()

    def _take(self) -> None:
        """Read what is in the pipe; not for ever from a process that prints without end."""
        for _ in range(_READS):
            if self._ended:
                return
            try:
                data = os.read(self._pipe.fileno(), _KEPT_BYTES)
            except BlockingIOError:  # nothing more was printed
                return
            self._ended = not data
            self._count += len(data)
            self._tail = (self._tail + data)[-_KEPT_BYTES:]


def last_lines(text: str) -> str:
    """Last lines of an output, without the stack that a fatal signal prints."""
    own = text.partition("Fatal Python error:")[0].rstrip()
    return "\n".join(_cleaned(line) for line in own.splitlines()[-_LINES:])


def _cleaned(line: str) -> str:
    """A line with its indentation, and without what a terminal would obey."""
    text = line.replace("\t", "    ")
    return " " * (min(len(text) - len(text.lstrip(" ")), 40)) + printable_line(text, _LINE_LENGTH - 40)


def stack_place(text: str, file: str = "") -> str:
    """Place "my_phi.py, line 12, in f" in the last stack that faulthandler printed; of `file` if it is in there."""
    frames = list(_last_stack(text))
    own = [frame for frame in frames if frame[0] == file] or frames[:1]
    return f"{Path(own[0][0]).name}, line {own[0][1]}, in {own[0][2]}" if own else ""


def _last_stack(text: str) -> Iterator[tuple[str, str, str]]:
    """Frames (file, line, function), the innermost first."""
    starts = [match.start() for match in _STACK.finditer(text)] or [0]
    for line in text[starts[-1] :].splitlines():
        if match := _FRAME.match(line):
            yield match[1], match[2], match[3]


_OUT_OF_REACH = re.compile(r"PermissionError|permission denied|system error number 13\b|errno 13\b", re.IGNORECASE)
"""Words of Python and of libraries in other languages about a file that cannot be opened."""


_UNREAD = "can't open/read file"  # printed by OpenCV, which then gives None and raises nothing


def advised_message(message: str, isolation: Isolation, output: str = "", hidden: Sequence[str] = ()) -> str:
    """A message with what helps, if the rules of the isolation are what it or the printed lines may be about.

    A hidden place is empty for the process where the system allows that: its files "do not exist" then.
    """
    denied = _OUT_OF_REACH.search(message) or _UNREAD in output or any(place in message for place in hidden)
    if not isolation.files or not denied:
        return message
    return f"{message}; a method reads its own folder and has no network: --allow PATH lets it read more"
