"""The districts of the library, and the syntax trees of their files."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

DISTRICTS = ("scenes", "render", "datasets", "estimator", "calibration", "benchmark", "robot", "studies")
"""Folders of the library, each above the ones before it; `phibench/` holds links to them, and the command line."""


@cache
def tree(file: Path) -> ast.Module:
    """Syntax tree of a file; tests of one process share it, as they walk through all files."""
    return ast.parse(file.read_text(encoding="utf-8"))


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a node and the statements in it, at any depth; expressions, most of a tree, are not looked into."""
    yield node
    for name in ("body", "orelse", "finalbody", "handlers", "cases"):
        inner = getattr(node, name, ())
        for child in inner if isinstance(inner, list) else ():
            yield from statements(child)
