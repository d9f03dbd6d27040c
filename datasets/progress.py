"""Progress for people: a bar with the time left on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

LINE_EVERY_S = 30.0


class Steps:
    """A count of equal steps, as a context manager.

    Parameters
    ----------
    console : Console
    title : str
    total : int
    """

    def __init__(self, console: Console, title: str, total: int) -> None:
        self._console, self._title, self._total = console, title, total
        self._done, self._started = 0, time.monotonic()
        self._told = self._started
        self._bar = _bar(console) if console.is_terminal else None

    def __enter__(self) -> Steps:
        if self._bar is not None:
            self._bar.start()
            self._task = self._bar.add_task(self._title, total=self._total)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        if self._bar is not None:
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
        elif self._done < self._total and time.monotonic() - self._told >= LINE_EVERY_S:
            self._tell()

    def _tell(self) -> None:
        self._told = time.monotonic()
        seconds = self._told - self._started
        left = f", about {seconds / self._done * (self._total - self._done):.0f} s left" if self._done else ""
        done = f"{self._done}/{self._total} after {seconds:.0f} s"
        self._console.print(f"{self._title}: {done}{left if self._done < self._total else ''}", highlight=False)


def _bar(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
    )
