"""Tasks that a test process has done before: their files and results, by the task's name and key.

A task is a pure function of its key, which `test_two_runs_are_byte_identical_whatever_the_number_of_workers` and the
tests of workers and kills show by rendering again. Tests of journals, orders, refusals and repairs need not. The same
holds for the answers that `verify` computes again.
What a test has patched is code that no key knows: an answer holds only where all modules are as they were.
"""

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from phibench.datasets.build.tasks import BuildTask, Made
from phibench.datasets.store.files import write_bytes

# what tasks run, and not what runs tasks
_CODE = re.compile(
    r"phibench\.(scenes|render)\.|phibench\.datasets\.(rooms\.|build\.\w+_task$|store\.(layers|pictures)$)"
)
_MOST_BYTES = 200_000_000
_KEPT: dict[tuple[str, str, int], tuple[Made, dict[str, bytes]]] = {}
_ANSWERS: dict[tuple[Any, ...], Any] = {}
_STATES: list[list[Any]] = []  # they hold what they name, so that no address is given twice


def _state() -> int:
    """Number of the state of all modules that a task may run: another one where anything in them is another object."""
    modules = sorted(name for name in sys.modules if _CODE.match(name))
    held = [value for name in modules for value in vars(sys.modules[name]).values()]
    for number, state in enumerate(_STATES):
        if len(state) == len(held) and all(one is other for one, other in zip(state, held, strict=True)):
            return number
    _STATES.append(held)
    return len(_STATES) - 1


def remembered_answer(*asked: Any) -> Any:
    """`answer_spot` that is computed once for each view, spot and room: `verify` asks for what was just made."""
    from phibench.datasets.build import spot_task

    key = (_state(), *asked)
    if key not in _ANSWERS:
        answer = spot_task.answer_spot(*asked)
        _ANSWERS[(_state(), *asked)] = answer  # after it: it may have imported modules
        return answer
    return _ANSWERS[key]


@dataclass(frozen=True)
class Remembered:
    """Function of a task that is called once for each name and key."""

    task: BuildTask

    def __call__(self, out: Path, *arguments: Any) -> Made:
        """Write the files that the task wrote before, or do it."""
        if not self.task.key:  # an export of a room: what it depends on stands in no key
            return self.task.function(out, *arguments)
        if known := _KEPT.get((self.task.name, self.task.key, _state())):
            made, files = known
            for name, data in files.items():
                write_bytes(out / name, data)
            return made
        made = self.task.function(out, *arguments)
        files = {name: (out / name).read_bytes() for name in made.files}
        if sum(len(data) for _, held in _KEPT.values() for data in held.values()) < _MOST_BYTES:
            _KEPT[self.task.name, self.task.key, _state()] = made, files  # after it: it may have imported modules
        return made
