"""What the kernel here lets an isolated method be kept from, and pairs that come from folders."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest
from helpers.sandbox_pairs import SmallPairs


def landlock() -> bool:
    """Tell whether this kernel has Landlock, by its own word."""
    return sys.platform.startswith("linux") and ctypes.CDLL(None).syscall(444, None, 0, 1) > 0


@cache
def own_mounts() -> bool:
    """The system lets a process have mounts of its own; some containers do not, and --fresh then denies /dev/shm."""
    command = (
        "from pathlib import Path; from phibench.benchmark.isolation.isolation import _Kernel; "
        "print(_Kernel().own_mounts(Path.cwd()))"
    )
    return subprocess.run([sys.executable, "-c", command], capture_output=True, text=True).stdout.strip() == "True"


needs_landlock = pytest.mark.skipif(
    not landlock(), reason="this kernel has no Landlock: methods are not isolated here, and the score says so"
)


@dataclass(frozen=True)
class FilePairs(SmallPairs):
    """Small pairs that are said to come from folders."""

    folders: tuple[Path, ...] = ()


# Each is an expression in the method; TRUTH is the path of the truth. What it gives is printed.
