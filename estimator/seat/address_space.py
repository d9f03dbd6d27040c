"""Limit of the address space of this process, for a while (POSIX; kept by Linux)."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_STATM = Path("/proc/self/statm")


def size_bytes() -> int:
    """Address space in use; 0 where the system does not tell."""
    if not _STATM.is_file():
        return 0
    return int(_STATM.read_text().split()[0]) * resource.getpagesize()


@contextmanager
def limited(limit_bytes: int) -> Iterator[None]:
    """Keep RLIMIT_AS at a limit; taken off afterwards, so that what went wrong can be told."""
    if not _STATM.is_file():
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    lowest = min((x for x in (limit_bytes, soft, hard) if x != resource.RLIM_INFINITY), default=limit_bytes)
    resource.setrlimit(resource.RLIMIT_AS, (lowest, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
