"""The districts of the library, and the syntax trees of their files."""

import ast
from functools import cache
from pathlib import Path

DISTRICTS = ("scenes", "render", "datasets", "estimator", "calibration", "benchmark", "robot", "studies")
"""Folders of the library, each above the ones before it; `phibench/` holds links to them, and the command line."""


@cache
def tree(file: Path) -> ast.Module:
    """Syntax tree of a file; tests of one process share it, as they walk through all files."""
    return ast.parse(file.read_text(encoding="utf-8"))
