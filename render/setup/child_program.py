"""Runs a module of the package in a child process, which may abort or hang; says its fault in one line (`fault_of`).

Only the standard library is used here.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping


def fault_of(module: str, *arguments: str, timeout_s: float, environment: Mapping[str, str] | None = None) -> str:
    """Run ``python -m module arguments`` and return what went wrong in one line; empty if it exits with 0.

    Parameters
    ----------
    module : str
        The full name of a module.
    *arguments : str
        Its command line.
    timeout_s : float
        The child is killed after this many seconds.
    environment : mapping of str to str, optional
        Set on top of this process's environment.
    """
    command = [sys.executable, "-m", module, *arguments]
    merged = {**os.environ, **(environment or {})}
    try:
        child = subprocess.run(
            command,
            env=merged,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"not done after {timeout_s:g} s"
    return "" if child.returncode == 0 else f"{_complaint(child.stderr)} ({_ending(child.returncode)})"


def _complaint(stderr: str) -> str:
    """Return the line that matters: LLVM prints its fatal error before a stack, Python prints its own last.

    A library of the system that Dr.Jit misses is named by an error in the middle.
    """
    lines = [line.strip() for line in stderr.splitlines() if line.strip()]
    fatal = [line for line in lines if line.startswith("LLVM ERROR") or MISSING_LIBRARY in line]
    return (fatal or lines[-1:] or ["no message"])[0]


def _ending(returncode: int) -> str:
    return f"killed by signal {-returncode}" if returncode < 0 else f"exit status {returncode}"


MISSING_LIBRARY = "cannot open shared object file"
"""What the loader of Linux says of a library that is not there."""


GET_LIBRARY = "install the library that it misses (Debian, Ubuntu: `apt-get install libatomic1`)"
"""What to do then: Dr.Jit needs libatomic, which comes with a compiler and with little else."""
