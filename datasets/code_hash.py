"""Hash of the code behind a function: its module and every module of phibench that it imports, near or far.

The tables that a module keeps beside itself count as code: `sensor_presets.toml` belongs to `sensor.py`.

Editing the progress bar then changes no key, editing the lens changes the keys of all that is seen through it.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from functools import cache, lru_cache
from pathlib import Path

_ROOT = Path(__file__).resolve().parent.parent
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
    found, waiting = set[str](), [module]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += _imported(name)
    return frozenset(found)


@cache
def _imported(module: str) -> tuple[str, ...]:
    return tuple(_imports(ast.parse(_file(module).read_text(encoding="utf-8"))))


def _imports(tree: ast.AST) -> Iterator[str]:
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
