"""Who does the work: processes of our own, or a running scheduler's. Opened only when it is needed."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

from phibench.datasets.cluster import Workers, local_workers, remote_workers
from phibench.datasets.dispatch import Executor
from phibench.datasets.environment import Environment, local_environment, remote_environment


class Crew:
    """Workers for one folder, as a context manager; leaving it ends our own and lets others' go.

    Parameters
    ----------
    out : folder that tasks write to
    count : processes on this machine, at most
    scheduler : address or scheduler file of a running scheduler, which is used instead
    """

    def __init__(self, out: Path, count: int, scheduler: str | None = None) -> None:
        self._out, self._count, self._scheduler = out, count, scheduler
        self._stack = ExitStack()
        self._remote: Workers | None = None

    def __enter__(self) -> Crew:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    @property
    def width(self) -> int:
        """How many tasks run at a time."""
        return self._count if self._remote is None else self._remote.width()

    def environment(self) -> Environment:
        """What the workers render with."""
        if self._scheduler is None:
            return local_environment()
        self._remote = self._stack.enter_context(remote_workers(self._scheduler, self._out))
        return remote_environment(self._remote, self._out)

    def executor(self, tasks: int) -> Executor:
        """Workers for that many tasks."""
        if self._remote is not None:
            return self._remote
        return self._stack.enter_context(local_workers(min(self._count, tasks), self._out))
