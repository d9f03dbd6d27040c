"""Which tasks of a folder are left, and doing them, with a journal entry and a log line for each."""

from __future__ import annotations

import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

from phibench.datasets import layout
from phibench.datasets.crew import Crew
from phibench.datasets.dispatch import dispatch
from phibench.datasets.errors import DatasetError
from phibench.datasets.estimate import estimate
from phibench.datasets.files import sha256
from phibench.datasets.journal import Entry, Head, Journal
from phibench.datasets.output import check_disk
from phibench.datasets.plan import Plan
from phibench.datasets.progress import Steps
from phibench.datasets.task import Done, Failed, Task, log_entry

_TOLD = 20  # failures that are told in full


def unfinished(tasks: Mapping[str, Task], journal: Journal, out: Path) -> list[str]:
    """Names of the tasks whose entry is missing, of another key, or belies the files."""
    known = [name for name, task in tasks.items() if (e := journal.entries.get(name)) is not None and e.key == task.key]
    with ThreadPoolExecutor(2) as pool:  # hashing lets go of the interpreter
        good = dict(zip(known, pool.map(lambda name: is_intact(journal.entries[name], out), known), strict=True))
    return [name for name in tasks if not good.get(name)]


def is_intact(entry: Entry, out: Path) -> bool:
    """Whether all files of an entry are there with their bytes."""
    return all((out / name).is_file() and sha256(out / name) == digest for name, digest in entry.files.items())


def finish_tasks(
    plan: Plan,
    tasks: Mapping[str, Task],
    todo: list[str],
    journal: Journal,
    head: Head,
    out: Path,
    crew: Crew,
    console: Console,
) -> None:
    """Do the tasks of `todo`; say beforehand what that means.

    Raises
    ------
    DatasetError
        If the disk has no room, or, when all others are done, with the tasks that failed and why.
    """
    chosen = [tasks[name] for name in todo]
    cost, before = estimate(plan, chosen), {name: journal.entries[name] for name in todo if name in journal.entries}
    check_disk(out, cost.size, [name for entry in before.values() for name in entry.files])
    kept = f", {len(tasks) - len(todo)} of {len(tasks)} tasks are done" if len(todo) < len(tasks) else ""
    console.print(cost.text(crew.width) + kept, highlight=False, soft_wrap=True)
    left = set(todo)
    journal.begin(head, [name for name in tasks if name not in left])
    failures = _run(chosen, journal, out, crew, console)
    for name, entry in before.items():
        if name in journal.entries and journal.entries[name] != entry and journal.entries[name].key == entry.key:
            console.print(f"warning: {name} came out with other bytes than the first time", highlight=False)
    if failures:
        raise DatasetError(_report(failures, len(todo)))


def _run(tasks: list[Task], journal: Journal, out: Path, crew: Crew, console: Console) -> dict[str, Failed]:
    failures: dict[str, Failed] = {}
    with Steps(console, "tasks", len(tasks)) as steps, (out / layout.LOG).open("a", encoding="utf-8") as log:
        for task, outcome in dispatch(tasks, crew.executor(len(tasks))):
            if isinstance(outcome, Done):
                journal.add(Entry(task.name, task.key, outcome.files, outcome.result))
            else:
                failures[task.name] = outcome
            log.write(json.dumps({"time": datetime.now(UTC).isoformat(), **log_entry(task, outcome)}) + "\n")
            log.flush()
            steps.advance()
    return failures


def _report(failures: dict[str, Failed], count: int) -> str:
    lines = [f"  {name}: {failed.cause}" for name, failed in list(failures.items())[:_TOLD]]
    more = [f"  and {len(failures) - _TOLD} more, see {layout.LOG}"] if len(failures) > _TOLD else []
    first = (
        f"{len(failures)} of {count} tasks failed; what is finished is kept, run the same command again for the rest:"
    )
    return "\n".join([first, *lines, *more])
