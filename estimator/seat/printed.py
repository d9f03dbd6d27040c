"""What a method prints: read all the time, so that it never has to wait, and only the end kept."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO

_KEPT_BYTES = 65536
_FRAME = re.compile(r'^  File "(.+)", line (\d+) in (.+)$')


class Printed:
    """Drains a pipe.

    Parameters
    ----------
    pipe : binary file
        What the process writes to its standard output and error.
    """

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe, self._tail = pipe, b""
        self._thread = threading.Thread(target=self._drain, daemon=True)
        self._thread.start()

    def text(self, wait_s: float = 0.0) -> str:
        """The last 64 kB; waits so long for the pipe to end."""
        self._thread.join(wait_s)
        return self._tail.decode(errors="replace")

    def _drain(self) -> None:
        with self._pipe:
            while part := self._pipe.read1(_KEPT_BYTES):  # type: ignore[attr-defined]
                self._tail = (self._tail + part)[-_KEPT_BYTES:]


def stack_place(text: str, file: str = "") -> str:
    """Place "my_phi.py, line 12, in f" in the last stack that faulthandler printed; of `file` if it is in there."""
    frames = list(_last_stack(text))
    own = [frame for frame in frames if frame[0] == file] or frames[:1]
    return f"{Path(own[0][0]).name}, line {own[0][1]}, in {own[0][2]}" if own else ""


def _last_stack(text: str) -> Iterator[tuple[str, str, str]]:
    """Frames (file, line, function), the innermost first."""
    for line in text[text.rfind("(most recent call first)") :].splitlines():
        if match := _FRAME.match(line):
            yield match[1], match[2], match[3]
