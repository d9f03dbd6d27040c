"""The user's cache: what can be made again at any time."""

from __future__ import annotations

import os
from pathlib import Path


def cache_root() -> Path:
    """Return the cache folder: PHIBENCH_CACHE, or phibench under XDG_CACHE_HOME or ``~/.cache``, in this order."""
    if own := os.environ.get("PHIBENCH_CACHE"):
        return Path(own).absolute()
    base = os.environ.get("XDG_CACHE_HOME")
    # Not Path.home(), which raises for a user without a home: such a folder is reported where it cannot be made.
    home = os.path.expanduser("~")  # noqa: PTH111
    return Path(base or f"{home}/.cache").absolute() / "phibench"
