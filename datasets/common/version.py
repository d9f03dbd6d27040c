"""Version of phibench, and the state of the checkout that it runs from."""

from __future__ import annotations

import subprocess
import tomllib
from importlib import metadata
from pathlib import Path


def own_version() -> str:
    """Version of phibench: in a checkout that of its `pyproject.toml`, else that of the installed distribution.

    An editable installation keeps the version of the day on which it was made. "0+unknown" where only the package's
    files are on the path.
    """
    project = _root() / "pyproject.toml"
    if project.is_file():
        return str(tomllib.loads(project.read_text(encoding="utf-8"))["project"]["version"])
    try:
        return metadata.version("phibench")
    except metadata.PackageNotFoundError:  # a copy that was never installed
        return "0+unknown"


def program_version() -> str:
    """Name and version of the program, "phibench 0.2.0"; of a checkout also the commit and whether it was changed."""
    state = checkout_state()
    return f"phibench {own_version()}" + (f" ({state})" if state else "")


def checkout_state() -> str:
    """State of the checkout in words, "commit 0123456789, changed since"; "" for an installed package."""
    commit = _git("rev-parse", "--verify", "--quiet", "HEAD")
    if not commit:
        return ""  # an installed copy, or no commit yet
    changed = _git("status", "--porcelain", "--untracked-files=no")
    return f"commit {commit[:10]}{', changed since' if changed else ''}"


def _root() -> Path:
    """Root of the checkout; for an installed package the package's folder, which has none of the root's files."""
    return Path(__file__).resolve().parents[2]


def _git(*arguments: str) -> str:
    """Output of a git command in the checkout; "" where there is no checkout, or no git."""
    if not (_root() / ".git").exists():
        return ""  # a parent folder's repository is not ours
    try:
        command = ["git", "-C", str(_root()), *arguments]
        result = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):  # no git, or a drive that hangs
        return ""
    return result.stdout.strip()
