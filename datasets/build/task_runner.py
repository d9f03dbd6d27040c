"""Runner of a folder's tasks in order of their needs (`bring_all`): keeps finished ones, retries those of dead workers.

`journal.txt` proves which parts are whole: a line for each, with its key (a hash of all that it depends on) and the
SHA-256 of its files. `run_tasks` makes the parts that are not. So a run that was killed goes on, more is added, and
damage is mended by the same call.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError
from rich.console import Console

from phibench.datasets.build.journal import NO_HEAD, Entry, Journal, Refusal, is_intact
from phibench.datasets.build.tasks import BuildTask, Done, Executor, Failed, Outcome, log_entry, perform
from phibench.datasets.build.workers import local_workers
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.input_files import first_fault
from phibench.datasets.common.progress import Steps
from phibench.datasets.store import schema

Result = TypeVar("Result")


def intact(entries: Sequence[Entry], out: Path) -> list[bool]:
    """`is_intact` of many parts."""
    with ThreadPoolExecutor(2) as pool:  # hashing lets go of the interpreter
        return list(pool.map(lambda entry: is_intact(entry, out), entries))


def unfinished_tasks(tasks: Mapping[str, BuildTask], journal: Journal, out: Path) -> list[str]:
    """Names of the tasks whose entry is missing, of another key, or belies the files."""
    held = [e for name, task in tasks.items() if (e := journal.entries.get(name)) is not None and e.key == task.key]
    good = {entry.task for entry, whole in zip(held, intact(held, out), strict=True) if whole}
    return [name for name in tasks if name not in good]


def run_tasks(
    tasks: Sequence[BuildTask],
    journal: Journal,
    executor: Executor,
    steps: Steps,
    settle: Callable[[BuildTask, Done | Failed], object],
) -> dict[str, Failed]:
    """Do tasks, with a line of the journal for each; return those that failed. `settle` hears of each as it ends.

    A task that is refused has a line of its own in the journal, unless one that it needs has failed.
    """
    failures: dict[str, Failed] = {}
    with steps:
        for task, outcome in schedule(tasks, executor):
            journal.require()  # what tasks write to a folder that is gone is lost, whatever they return
            if isinstance(outcome, Done):
                journal.add(Entry(task.name, task.key, outcome.files, outcome.result))
            else:
                if outcome.refused and not any(need in failures for need in task.needs):
                    journal.add(Refusal(task.name, task.key, outcome.cause))
                failures[task.name] = outcome
            settle(task, outcome)
            steps.advance()
    return failures


def log_outcome(out: Path, task: BuildTask, outcome: Done | Failed) -> None:
    """Add a line to a folder's diary: when a task ended, what it took, and who did it."""
    with (out / schema.LOG).open("a", encoding="utf-8") as log:
        log.write(json.dumps({"time": datetime.now(UTC).isoformat(), **log_entry(task, outcome)}) + "\n")


# Order: a few tasks per worker at a time, dependencies first.

AHEAD = 3  # tasks submitted per worker: one runs, two wait, so that no worker is idle
TRIALS = 3  # of a task whose worker died


def schedule(tasks: Iterable[BuildTask], executor: Executor) -> Iterator[Outcome]:
    """Yield every task with its outcome, as they end. Needs that are not among `tasks` count as done.

    Nothing grows with the number of tasks. When a worker dies, one of the tasks that it had been given is to blame. All
    of them are retried last, each alone, so that a task that kills its worker takes no other one with it. A task that
    kills its worker every time is reported.
    """
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
                continue  # it may have ended the worker: it is tried alone, after the others
        elif suspects:
            task = suspects.popleft()
            outcome = _alone(task, executor)
        else:
            return  # all are done
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


# Folders that hold nothing but independent parts, and documents about them.


@dataclass(frozen=True)
class BroughtParts:
    """Outcome: the entry of every part, in the order of the tasks, and the names of those that were made now."""

    entries: Mapping[str, Entry]
    made: tuple[str, ...]

    @property
    def hashes(self) -> dict[str, str]:
        """SHA-256 by file."""
        return {name: digest for entry in self.entries.values() for name, digest in entry.files.items()}

    def results(self, kind: type[Result]) -> list[Result]:
        """Result of every part.

        Raises
        ------
        DatasetError
            If a line of the journal holds another one.
        """
        try:
            return TypeAdapter(list[kind]).validate_python([entry.result for entry in self.entries.values()])  # type: ignore[valid-type]
        except ValidationError as error:
            told = f"{schema.JOURNAL} has a damaged result of a part: {first_fault(error)}"
            raise DatasetError(f"{told}; remove the file and run the same command again") from error


def bring_all(
    tasks: Mapping[str, BuildTask],
    out: Path,
    workers: int | None,
    console: Console,
    title: str,
    *,
    state: Path | None = None,
    sign: str = schema.CHECKSUMS,
    diary: bool = False,
) -> BroughtParts:
    """Make those of a folder's parts that are not whole, on this machine.

    Parameters
    ----------
    tasks : by name
    out : folder, held by `filling`
    workers : processes; by default one per core
    title : of the progress
    state : folder of the journal; by default `out`
    sign : file that says that the folder is finished; it goes before a part is made
    diary : whether `log.jsonl` is kept; its lines name this machine, so that a folder for others has none

    Raises
    ------
    DatasetError
        With the cause of the first part that failed; the others are made first.
    """
    with Journal(state or out) as journal:
        todo = unfinished_tasks(tasks, journal, out)
        if todo:
            (out / sign).unlink(missing_ok=True)
            journal.begin(NO_HEAD, [name for name in tasks if name not in set(todo)])
            with executor(min(workers or os.cpu_count() or 1, len(todo)), out) as workforce:
                settle = partial(log_outcome, out) if diary else lambda *_: None
                steps = Steps(console, title, len(todo))
                failures = run_tasks([tasks[name] for name in todo], journal, workforce, steps, settle)
            if failures:
                raise DatasetError(next(iter(failures.values())).cause)
        journal.refusals.clear()
        if not journal.is_written(NO_HEAD, tasks):
            journal.begin(NO_HEAD, tasks)  # in the order of the tasks: the same bytes in whatever order they end
        return BroughtParts({name: journal.entries[name] for name in tasks}, tuple(todo))


@contextlib.contextmanager
def executor(workers: int, out: Path) -> Iterator[Executor]:
    """Worker processes of this machine; for one alone, this process."""
    if workers > 1:
        with local_workers(workers, out) as workforce:
            yield workforce
    else:
        yield OwnProcess(out)


class OwnProcess:
    """An `Executor` that does tasks in this process, one after the other."""

    def __init__(self, out: Path) -> None:
        self._out, self._waiting = out, deque[BuildTask]()

    def width(self) -> int:
        """One."""
        return 1

    def submit(self, task: BuildTask) -> None:
        """Queue a task."""
        self._waiting.append(task)

    def next(self) -> Outcome:
        """Do the next task."""
        task = self._waiting.popleft()
        return task, perform(task, self._out)
