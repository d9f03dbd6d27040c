"""Workers that do their tasks in the process of the test, each task once."""

from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch


class InlineWorkerPool:
    """Does tasks in this process, one after the other: for tests of what is done, not of who does it."""

    width = 1

    def __init__(self, out: Path, *_: object) -> None:
        self._out = out

    def __enter__(self) -> "InlineWorkerPool":
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def environment(self) -> dict[str, object]:
        from phibench.datasets.build.workers import describe

        return {key: value for key, value in describe().items() if key != "worker"}

    def executor(self, _: int) -> "InlineExecutor":
        return InlineExecutor(self._out)


def make_inline(recipe: str | Path, out: Path, **options: Any) -> Path:
    """Data set, rendered in this process: the same bytes as by workers, without starting them."""
    from phibench.datasets.make import make

    with patch("phibench.datasets.make.WorkerPool", InlineWorkerPool), patch(PROBE, nothing):
        return make(recipe, out, workers=1, **options)


PROBE = "phibench.datasets.build.forecast._probe"
"""Work that a forecast times: what it says in seconds is the subject of its own tests."""


def nothing() -> None:
    """Take no time."""


class InlineExecutor:
    """Executor of `InlineWorkerPool`."""

    newest_first = False

    def __init__(self, out: Path) -> None:
        self._out, self._waiting = out, deque[Any]()

    def width(self) -> int:
        return 1

    def submit(self, task: Any) -> None:
        self._waiting.append(task)

    def next(self) -> Any:
        from helpers.remembered_tasks import Remembered

        from phibench.datasets.build.tasks import perform

        task = self._waiting.pop() if self.newest_first else self._waiting.popleft()
        return task, perform(replace(task, function=Remembered(task)), self._out)
