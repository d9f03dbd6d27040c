"""Limits under which a method or a policy runs (`RunLimits`): time, memory, processes, files; and `MethodError`.

They are the same wherever others' code runs. A method that cannot be found, loaded or started is a `MethodError`.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any


class MethodError(ValueError):
    """A method that cannot be found, loaded or started; one sentence."""


@dataclass(frozen=True)
class RunLimits:
    """Limits of one method; the same wherever methods run.

    Parameters
    ----------
    seconds : float
        Wall clock for one pair.
    memory_mb : float
        Address space (RLIMIT_AS) on top of what the process has after the method was imported, 1e6 bytes; each process
        that the method starts has its own. Linux only: elsewhere the system does not keep it.
    start_seconds : float
        Wall clock for starting Python and importing the method.
    fresh : bool
        A process for each pair, instead of one for all.
    allow : tuple of str
        Files and folders that the method may read, besides the folder of its file.
    """

    seconds: float = 30.0
    memory_mb: float = 4096.0
    start_seconds: float = 120.0
    fresh: bool = False
    allow: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("seconds", "memory_mb", "start_seconds"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise MethodError(f"limit {name} = {value}: must be a finite number above 0")

    def document(self) -> dict[str, Any]:
        """For the record; of what is allowed the last part of the path, not where it lies."""
        return {**asdict(self), "allow": [Path(path).absolute().name for path in self.allow]}

    def memory_sentence(self, detail: str) -> str:
        """A failure for want of memory in one sentence, with the limit."""
        limit = f"the limit of {self.memory_mb:g} MB of address space on top of the imports (--memory-mb)"
        return f"more memory than {limit}: {detail}"
