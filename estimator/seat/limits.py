"""What a method may take."""

from __future__ import annotations

import math
from dataclasses import dataclass

from phibench.estimator.seat.errors import MethodError


@dataclass(frozen=True)
class Limits:
    """Limits of one method.

    Parameters
    ----------
    seconds : float
        Wall clock for one pair.
    memory_mb : float
        Address space (RLIMIT_AS) on top of what the process has after the method was imported, 1e6 bytes; each process
        that the method starts has its own. Linux only: elsewhere the system does not keep it.
    start_seconds : float
        Wall clock for starting Python and importing the method.
    """

    seconds: float = 30.0
    memory_mb: float = 4096.0
    start_seconds: float = 120.0

    def __post_init__(self) -> None:
        for name in ("seconds", "memory_mb", "start_seconds"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise MethodError(f"limit {name} = {value}: must be a finite number above 0")
