"""Task record, its key (a hash of its inputs), outcomes, the protocol of executors, and `perform`, which runs one.

A task is a pure function whose outputs are files.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import resource
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.parallel import keep_memory
from phibench.datasets.rooms.room_files import RoomError
from phibench.datasets.store.files import sha256
from phibench.datasets.store.folder_lock import working
from phibench.datasets.store.provenance import code_sha256
from phibench.scenes.validation import SceneError


@dataclass(frozen=True)
class TaskResult:
    """Result of a task's function: the files it wrote, relative to the folder, and a JSON document."""

    files: tuple[str, ...]
    result: Any = None


@dataclass(frozen=True)
class BuildTask:
    """One piece of work.

    Attributes
    ----------
    name : str
        Unique within a data set: the kind, a blank, and what it makes, such as ``view h0.425``.
    key : str
        SHA-256 of inputs, code and versions, and of the keys of `needs`.
    function : callable
        Of a module, called as ``function(out, *arguments)``; returns `TaskResult`. It writes every file atomically.
    arguments : tuple
        Can be pickled; no paths.
    needs : tuple of str
        Tasks whose files it reads.
    """

    name: str
    key: str
    function: Callable[..., TaskResult]
    arguments: tuple[Any, ...] = ()
    needs: tuple[str, ...] = ()

    @property
    def kind(self) -> str:
        """First word of the name."""
        return self.name.split(" ", 1)[0]


@dataclass(frozen=True)
class Done:
    """A task that ended well: SHA-256 by file, its result, and what it cost."""

    files: dict[str, str]
    result: Any
    seconds: float
    peak_mb: float
    worker: str
    cpu_s: float = 0.0


@dataclass(frozen=True)
class Failed:
    """A task that ended badly.

    Attributes
    ----------
    cause : str
        For people.
    lethal : bool
        Its worker died.
    refused : bool
        The fault is that of a sample, or of the room of a few: neither of the program nor of the machine.
    """

    cause: str
    lethal: bool = field(default=False, kw_only=True)
    refused: bool = field(default=False, kw_only=True)


Outcome = tuple[BuildTask, Done | Failed]


class Executor(Protocol):
    """Anything that runs tasks."""

    def width(self) -> int:
        """Return the number of tasks that run at a time."""

    def submit(self, task: BuildTask) -> None:
        """Begin a task, or queue it."""

    def next(self) -> Outcome:
        """Wait for any submitted task; `Failed.lethal` means that its worker died."""


def task_key(inputs: Any, code: str, versions: Mapping[str, Any], needs: tuple[str, ...] = ()) -> str:
    """Key of a task: `inputs` as JSON, hash of the code, versions of what it runs on, keys of what it needs."""
    document = {"inputs": inputs, "code": code, "versions": versions, "needs": needs}
    return hashlib.sha256(json.dumps(document, sort_keys=True, allow_nan=False).encode()).hexdigest()


def perform(task: BuildTask, out: Path, code: str | None = None) -> Done | Failed:
    """Do a task in this process. Errors meant for people come back as their message, others with their traceback.

    `code` is the hash of the code that the sender runs; another one here is refused.
    """
    if code is not None and code != code_sha256():
        return Failed(f"worker {worker_name()} runs other code than the sender: install the same version on both")
    keep_memory()  # a worker of dask begins without us
    began, began_cpu = time.perf_counter(), time.process_time()
    try:
        with working(out):
            made = task.function(out, *task.arguments)
            files = {name: sha256(out / name) for name in made.files}
    except Exception as error:  # whatever a task does, the others go on
        return Failed(fault_text(error), refused=_is_refusal(error))
    seconds, cpu_s = time.perf_counter() - began, time.process_time() - began_cpu
    return Done(files, made.result, round(seconds, 3), _peak_mb(), worker_name(), round(cpu_s, 3))


def worker_name() -> str:
    """Name of this process for logs."""
    return f"{os.uname().nodename}:{os.getpid()}"


def fault_text(error: Exception) -> str:
    """Message of an error that is meant for people, the traceback of any other."""
    if isinstance(error, RuntimeError) and "out of memory" in str(error):  # Dr.Jit's, of a GPU
        return f"the device has too little memory ({str(error).splitlines()[0]}): render with --variant llvm"
    told = isinstance(error, OSError | MemoryError) or type(error).__module__.startswith("phibench")
    return (str(error) or type(error).__name__) if told else traceback.format_exc()


def _is_refusal(error: Exception) -> bool:
    """Tell whether an error says that a sample cannot be made; a room's file that has gone is no such error."""
    return isinstance(error, DatasetError | SceneError) and not isinstance(error, RoomError)


def log_entry(task: BuildTask, outcome: Done | Failed) -> dict[str, Any]:
    """One line of `log.jsonl`, without the time."""
    entry = {"task": task.name, "key": task.key, "ok": isinstance(outcome, Done), **asdict(outcome)}
    return {key: value for key, value in entry.items() if key not in ("files", "result", "lethal", "refused")}


def _peak_mb() -> float:
    """Largest resident memory of this process so far, MB.

    Linux' ru_maxrss starts at what the parent had before exec, so that /proc is asked first.
    """
    with contextlib.suppress(OSError, StopIteration):  # not Linux
        lines = Path("/proc/self/status").read_text().splitlines()
        return round(int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) * 1024.0 / 1e6, 1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak * (1.0 if sys.platform == "darwin" else 1024.0) / 1e6, 1)
