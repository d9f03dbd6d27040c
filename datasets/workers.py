"""A small pool of worker processes for long tasks: no orphans, a dead worker is an error and not a hang.

Workers are spawned, never forked (Dr.Jit has threads). They do not hear Ctrl-C, which the parent answers by ending
them, and end by themselves when the parent is gone.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from phibench.datasets.errors import DatasetError

_END_S = 5.0


@dataclass(frozen=True)
class Task:
    """A call of a module-level function with arguments that can be pickled; `name` is for people."""

    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...] = ()


class WorkerError(DatasetError):
    """A task that failed, or a worker that died."""


class Pool:
    """Worker processes, as a context manager; leaving it ends them.

    Parameters
    ----------
    count : int
        Number of processes.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._workers: list[_Worker] = []

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.end()
        self._workers.clear()

    def run(self, tasks: Sequence[Task]) -> Iterator[tuple[Task, Any]]:
        """Yield each task with its result, in the order in which they end.

        Raises
        ------
        WorkerError
            If a task raises or its worker dies; the message says which task and why.
        """
        waiting = list(reversed(tasks))
        while len(self._workers) < min(self._count, len(tasks)):
            self._workers.append(_Worker())
        while waiting or any(worker.task for worker in self._workers):
            for worker in self._workers:
                if waiting and worker.task is None:
                    worker.start(waiting.pop())
            for worker in self._ready():
                yield worker.result()

    def _ready(self) -> list[_Worker]:
        busy = {worker.connection: worker for worker in self._workers if worker.task}
        return [busy[connection] for connection in wait(list(busy)) if connection in busy]


class _Worker:
    """One process and the connection to it. A connection that ends means that the process died."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.task: Task | None = None
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        with _no_interrupt():
            self._process.start()
        theirs.close()

    def start(self, task: Task) -> None:
        self.task = task
        try:
            self.connection.send(task)
        except OSError:
            raise self._died(task) from None

    def result(self) -> tuple[Task, Any]:
        task, self.task = self.task, None
        assert task is not None, "only busy workers are asked"
        try:
            fault, value = self.connection.recv()
        except (EOFError, OSError):
            raise self._died(task) from None
        if fault is not None:
            raise WorkerError(f"{task.name} failed: {fault}")
        return task, value

    def end(self) -> None:
        self.connection.close()
        self._process.terminate()
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _died(self, task: Task) -> WorkerError:
        self._process.join(_END_S)
        code = self._process.exitcode
        how = f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit code {code}"
        return WorkerError(
            f"the worker process died ({how}) during: {task.name}; out of memory, or a fault of the renderer"
        )


def _serve(connection: Connection) -> None:
    """Run tasks until the parent closes the connection."""
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    with contextlib.suppress(EOFError, OSError):
        while True:
            connection.send(_outcome(connection.recv()))


def _outcome(task: Task) -> tuple[str | None, Any]:
    """Fault and value: errors meant for people as their message, others with their traceback."""
    try:
        return None, task.function(*task.arguments)
    except Exception as error:
        told = isinstance(error, OSError | MemoryError) or type(error).__module__.startswith("phibench")
        return (str(error) or type(error).__name__) if told else traceback.format_exc(), None


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


@contextlib.contextmanager
def _no_interrupt() -> Iterator[None]:
    """Processes started inside never see SIGINT: they inherit the blocked signal."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
