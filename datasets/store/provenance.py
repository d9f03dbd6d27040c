"""Provenance of data sets and results: versions of program and packages, commit, hashes of code and what it imports.

Nothing here differs between two equal runs. `code_behind` hashes a module and every module of phibench that it imports,
near or far. The tables that a module keeps beside itself count as code: `settings_presets.toml` belongs to
`settings.py`. Editing the progress bar then changes no key; editing the lens changes the keys of all that is seen
through it.
"""

from __future__ import annotations

import ast
import hashlib
import platform
import re
import subprocess
import tomllib
from collections.abc import Iterator
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path

# Version of phibench, and the state of the checkout that it runs from.


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
    root = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256()
    for path in sorted(path for folder in _FOLDERS for path in (root / folder).rglob("*.py")):
        digest.update(f"{path.relative_to(root).as_posix()}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()


@cache  # a process keeps the packages that it has loaded, and asks four times for a data set
def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Commit of the checkout that this file belongs to; None for an installed package or without git."""
    folder = Path(__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return None
    try:
        command = ["git", "-C", str(folder), "rev-parse", "--verify", "--quiet", "HEAD"]
        result = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):  # no git
        return None
    return result.stdout.strip() or None


# Code behind a module.


_ROOT = Path(__file__).resolve().parents[2]
_PACKAGE = "phibench."


@lru_cache
def code_behind(module: str) -> str:
    """SHA-256 over the source of a module, given by its full name, and of all that it imports from phibench."""
    digest = hashlib.sha256()
    for name in sorted(closure(module)):
        for path in (_file(name), *_tables(name)):
            digest.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def closure(module: str) -> frozenset[str]:
    """Full names of a module and of all that it imports from phibench, at its top or inside its functions."""
    modules, waiting = set[str](), [module]
    while waiting:
        name = waiting.pop()
        if name not in modules:
            modules.add(name)
            waiting += _imported(name)
    return frozenset(modules)


# Import statements alone are parsed: whole files take half a second. A test parses all files of the package whole.
_WORDS = re.compile(r'""".*?"""|#[^\n]*', re.DOTALL)
_STATEMENT = re.compile(r"^[ \t]*((?:from|import) phibench\b(?:[^\n(]|\([^)]*\))*)", re.MULTILINE)


@cache
def _imported(module: str) -> tuple[str, ...]:
    return tuple(imports_of(ast.parse(import_statements(_file(module).read_text(encoding="utf-8")))))


def import_statements(source: str) -> str:
    """Statements of a file of this package that import of phibench."""
    return "\n".join(_STATEMENT.findall(_WORDS.sub("", source)))


def imports_of(tree: ast.AST) -> Iterator[str]:
    """Full names of the modules of phibench that a tree imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if _is_ours(alias.name))
        elif isinstance(node, ast.ImportFrom) and node.module:
            inside = (f"{node.module}.{alias.name}" for alias in node.names)
            yield from (name for name in (node.module, *inside) if _is_ours(name))


def _is_ours(name: str) -> bool:
    return name.startswith(_PACKAGE) and _file(name).is_file()


def _tables(module: str) -> list[Path]:
    path = _file(module)
    return sorted(path.parent.glob(f"{path.stem}_*.toml"))


def _file(module: str) -> Path:
    return _ROOT.joinpath(*module.split(".")[1:]).with_suffix(".py")
