"""Task scheduler: submits a few tasks per worker at a time, dependencies first.

Nothing grows with the number of tasks. When a worker dies, one of the tasks that it had been given is to blame. All of
them are retried last, each alone, so that a task that kills its worker takes no other one with it. A task that kills
its worker every time is reported.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterable, Iterator
from typing import Protocol

from phibench.datasets.build.tasks import BuildTask, Done, Failed

AHEAD = 3  # tasks submitted per worker: one runs, two wait, so that no worker is idle
TRIALS = 3  # of a task whose worker died
Outcome = tuple[BuildTask, Done | Failed]


class Executor(Protocol):
    """Anything that runs tasks."""

    def width(self) -> int:
        """Return the number of tasks that run at a time."""

    def submit(self, task: BuildTask) -> None:
        """Begin a task, or queue it."""

    def next(self) -> Outcome:
        """Wait for any submitted task; `Failed.lethal` means that its worker died."""


def schedule(tasks: Iterable[BuildTask], executor: Executor) -> Iterator[Outcome]:
    """Yield every task with its outcome, as they end. Needs that are not among `tasks` count as done."""
    queue, suspects, flying = _Queue(tasks), deque[BuildTask](), 0
    while True:
        while flying < AHEAD * executor.width() and queue.ready:
            executor.submit(queue.ready.popleft())
            flying += 1
        if flying:
            task, outcome = executor.next()
            flying -= 1
            if isinstance(outcome, Failed) and outcome.lethal:
                suspects.append(task)
                continue
        elif suspects:
            task = suspects.popleft()
            outcome = _alone(task, executor)
        else:
            return
        yield task, outcome
        yield from queue.settle(task, outcome)


def _alone(task: BuildTask, executor: Executor) -> Done | Failed:
    """Do a suspect while nothing else runs; it has seen one worker die already."""
    cause = ""
    for _ in range(TRIALS - 1):
        executor.submit(task)
        _, outcome = executor.next()
        if not isinstance(outcome, Failed) or not outcome.lethal:
            return outcome
        cause = outcome.cause
    return Failed(
        f"its worker process died every time, {TRIALS} in all ({cause}); out of memory, or a fault of the renderer"
    )


class _Queue:
    """Tasks that wait, and those whose needs are met, in the given order."""

    def __init__(self, tasks: Iterable[BuildTask]) -> None:
        tasks = list(tasks)
        names = {task.name for task in tasks}
        self._missing = {task.name: sum(need in names for need in task.needs) for task in tasks}
        self._readers = defaultdict[str, list[BuildTask]](list)
        for task in tasks:
            for need in task.needs:
                self._readers[need].append(task)
        self.ready = deque(task for task in tasks if not self._missing[task.name])

    def settle(self, task: BuildTask, outcome: Done | Failed) -> Iterator[Outcome]:
        """Let those go that waited for a task; if it failed, yield them as failed, and what waits for them."""
        released = list[BuildTask]()
        for reader in self._readers.pop(task.name, ()):
            if isinstance(outcome, Failed):
                if self._missing.pop(reader.name, None) is not None:
                    failed = Failed(f"not made, because {task.name} failed", refused=outcome.refused)
                    yield reader, failed
                    yield from self.settle(reader, failed)
            elif reader.name in self._missing:
                self._missing[reader.name] -= 1
                if not self._missing[reader.name]:
                    released.append(reader)
        self.ready.extendleft(reversed(released))  # a worker still holds what they need: the room
