"""Progress for people: a bar with the time left on a terminal, a line every 30 s elsewhere.

`Steps` counts; `StillRunning` speaks where nothing counts.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn
from rich.progress_bar import ProgressBar
from rich.table import Column

LINE_EVERY_S = 30.0  # in a log file
_BAR_EVERY_S = 1.0  # on a terminal
_TELLER = "phibench progress"  # name of the threads of `Steps`, by which `StillRunning` knows that one tells
_BAR_COLUMNS = 16


def progress_console() -> Console:
    """Console for progress, the standard error; brackets and colons in a path are no markup."""
    return Console(stderr=True, markup=False, emoji=False)


class Steps:
    """Count of steps, as a context manager. A thread tells how far they are, even while a single step takes long.

    Parameters
    ----------
    left_s : callable, optional
        Seconds left; by default the steps are taken to be equal.
    running : callable, optional
        What is being done, in words.
    announce : bool
        Print a line at the start too, for a single step that takes long.
    """

    def __init__(
        self,
        console: Console,
        title: str,
        total: int,
        left_s: Callable[[], float] | None = None,
        running: Callable[[], str] | None = None,
        announce: bool = False,
    ) -> None:
        self._console, self._title, self._total = console, title, total
        self._forecast_s, self._running = left_s, running
        self._announce = announce
        self._done, self._started, self._share = 0, time.monotonic(), 0.0
        self._bar = _bar(console) if console.is_terminal else None
        self._end = threading.Event()
        self._teller = threading.Thread(target=self._keep_telling, name=_TELLER, daemon=True)

    def __enter__(self) -> Steps:
        if self._bar is not None:
            self._bar.start()
            self._task = self._bar.add_task(self._title, total=self._total, share=0.0, left="")
        elif self._announce:
            self._tell()
        self._teller.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self._end.set()
        self._teller.join()
        if self._bar is not None:
            if kind is None:
                self._tell()
            self._bar.stop()
        elif kind is None:
            self._tell()

    def advance(self) -> None:
        """Count one step."""
        self.reach(self._done + 1)

    def reach(self, done: int) -> None:
        """So many steps are done."""
        self._done = done
        if self._bar is not None:
            self._bar.update(self._task, completed=done)

    def _keep_telling(self) -> None:
        while not self._end.wait(LINE_EVERY_S if self._bar is None else _BAR_EVERY_S):
            self._tell()

    def _tell(self) -> None:
        left_s, elapsed_s = self._left_s(), time.monotonic() - self._started
        left = f"about {left_s:.0f} s left" if left_s is not None else ""
        running = self._running() if self._running is not None and self._done < self._total else ""
        if self._bar is not None:
            # a step may take as long as all others together: the bar goes by time
            share = elapsed_s / (elapsed_s + left_s) if left_s is not None else self._done / max(self._total, 1)
            self._share = max(self._share, share)
            self._bar.update(self._task, share=self._share, left=", ".join(filter(None, (left, running))))
            return  # the bar's own line tells it
        parts = [f"{self._done}/{self._total} after {elapsed_s:.0f} s", left]
        parts.append(f"running: {running}" if running else "")
        self._console.print(f"{self._title}: {', '.join(filter(None, parts))}", highlight=False, soft_wrap=True)

    def _left_s(self) -> float | None:
        """Seconds that the rest will take; None at the end, and where nothing tells."""
        if self._done >= self._total or (self._forecast_s is None and not self._done):
            return None  # nothing is left, or nothing has been done to judge by
        if self._forecast_s is not None:
            return self._forecast_s()
        return (time.monotonic() - self._started) / self._done * (self._total - self._done)


@contextmanager
def stages(console: Console, title: str) -> Iterator[Callable[[str], None]]:
    """Line with the stage of what takes some seconds, on a terminal alone; gives what each stage is told to."""
    if not console.is_terminal:
        yield lambda stage: None
        return
    now = [""]
    with Steps(console, title, 1, running=lambda: now[0]) as steps:
        yield lambda stage: now.__setitem__(0, stage)
        steps.advance()


class StillRunning:
    """Line every 30 s that something still runs, as a context manager: for what cannot count its steps.

    It is silent while `Steps` tells how far they are.

    Parameters
    ----------
    title : str
        What runs.
    every_s : float
        Seconds of silence before a line.
    """

    def __init__(self, console: Console, title: str, every_s: float = LINE_EVERY_S) -> None:
        self._console, self._title, self._every_s = console, title, every_s
        self._started = time.monotonic()
        self._end = threading.Event()
        self._teller = threading.Thread(target=self._keep_telling, daemon=True)

    def __enter__(self) -> StillRunning:
        self._teller.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self._end.set()
        self._teller.join()

    def _keep_telling(self) -> None:
        heard = self._started
        while not self._end.wait(self._every_s / 30.0):  # late by a thirtieth at most
            now = time.monotonic()
            if any(thread.name == _TELLER for thread in threading.enumerate()):
                heard = now
            elif now - heard >= self._every_s:
                heard = now
                text = f"{self._title}: running for {now - self._started:.0f} s"
                self._console.print(text, highlight=False, soft_wrap=True)


class _ShareColumn(ProgressColumn):
    """Bar of the share of the time that has passed."""

    def render(self, task: Task) -> ProgressBar:
        return ProgressBar(total=1.0, completed=task.fields["share"], width=_BAR_COLUMNS)


def _bar(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        _ShareColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}", table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1)),
        console=console,
        expand=True,
    )
