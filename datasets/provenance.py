"""Where a data set comes from: versions, commit, hash of the code. Nothing that changes between two equal runs."""

from __future__ import annotations

import hashlib
import platform
import subprocess
from functools import lru_cache
from importlib import metadata
from pathlib import Path

PACKAGES = ("phibench", "numpy", "scipy", "mitsuba", "drjit", "OpenEXR", "pydantic", "polars", "pillow")
_FOLDERS = ("scenes", "render", "datasets")


def provenance() -> dict[str, str | dict[str, str | None] | None]:
    """Versions of Python and packages (None: not installed), git commit, SHA-256 of the code that makes data."""
    return {
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "packages": {name: _version(name) for name in PACKAGES},
        "commit": _commit(),
        "code_sha256": code_sha256(),
    }


@lru_cache
def code_sha256() -> str:
    """SHA-256 over all Python files of scenes, render and datasets, by name."""
    root = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256()
    for path in sorted(path for folder in _FOLDERS for path in (root / folder).glob("*.py")):
        digest.update(f"{path.parent.name}/{path.name}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Commit of the checkout that this file belongs to; None for an installed package or without git."""
    folder = Path(__file__).resolve().parent
    if not (folder.parent / ".git").exists():
        return None
    try:
        command = ["git", "-C", str(folder), "rev-parse", "--verify", "--quiet", "HEAD"]
        result = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() or None
