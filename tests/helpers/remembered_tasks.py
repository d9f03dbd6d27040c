"""Tasks that a test process has done before: their files and results, by the task's name and key.

A task is a pure function of its key, which `test_two_runs_are_byte_identical_whatever_the_number_of_workers` and the
tests of workers and kills show by rendering again. Tests of journals, orders, refusals and repairs need not. The same
holds for the answers that `verify` computes again.
What a test has patched is code that no key knows: an answer holds only where all modules behind it are as they were.
"""

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from phibench.datasets.build.tasks import BuildTask, TaskResult
from phibench.datasets.store.files import write_bytes

# what tasks run, and not what runs tasks
_CODE = re.compile(
    r"phibench\.(scenes|render)\.|phibench\.datasets\.(rooms\.|build\.\w+_task$|store\.(layers|pictures)$)"
)
_TASK = re.compile(r"phibench\.datasets\.build\.\w+_task$")
_MOST_BYTES = 200_000_000
_KEPT: dict[tuple[str, str, int], tuple[TaskResult, dict[str, bytes]]] = {}
_ANSWERS: dict[tuple[Any, ...], Any] = {}
_STATES: list[list[Any]] = []  # they hold what they name, so that no address is given twice


def _state(own: str) -> int:
    """Number of the state of all modules that a task of a module may run: another one where anything is another object.

    Of the modules of tasks it is its own, and those that it takes something from: no view depends on a certificate.
    """
    modules = sorted(name for name in sys.modules if _CODE.match(name))
    if _TASK.match(own):
        taken = {own, *(getattr(value, "__module__", "") for value in vars(sys.modules[own]).values())}
        modules = [name for name in modules if name in taken or not _TASK.match(name)]
    held = [value for name in modules for value in vars(sys.modules[name]).values()]
    for number, state in enumerate(_STATES):
        if len(state) == len(held) and all(one is other for one, other in zip(state, held, strict=True)):
            return number
    _STATES.append(held)
    return len(_STATES) - 1


def remembered_answer(*asked: Any) -> Any:
    """`answer_spot` that is computed once for each view, spot and room: `verify` asks for what was just made."""
    from phibench.datasets.build import spot_task

    key = (_state(spot_task.__name__), *asked)
    if key not in _ANSWERS:
        answer = spot_task.answer_spot(*asked)
        _ANSWERS[(_state(spot_task.__name__), *asked)] = answer  # after it: it may have imported modules
        return answer
    return _ANSWERS[key]


@dataclass(frozen=True)
class Remembered:
    """Function of a task that is called once for each name and key."""

    task: BuildTask

    def __call__(self, out: Path, *arguments: Any) -> TaskResult:
        """Write the files that the task wrote before, or do it."""
        if not self.task.key:  # an export of a room: what it depends on stands in no key
            return self.task.function(out, *arguments)
        name, key, module = self.task.name, self.task.key, self.task.function.__module__
        if known := _KEPT.get((name, key, _state(module))):
            made, files = known
            for file, data in files.items():
                write_bytes(out / file, data)
            return made
        made = self.task.function(out, *arguments)
        files = {file: (out / file).read_bytes() for file in made.files}
        if sum(len(data) for _, held in _KEPT.values() for data in held.values()) < _MOST_BYTES:
            _KEPT[name, key, _state(module)] = made, files  # after it: it may have imported modules
        return made
