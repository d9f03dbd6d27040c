"""Entries of numpy docstrings, and the types that the code gives what they describe."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

SECTIONS = ("Parameters", "Attributes", "Returns", "Raises")
Documented = ast.ClassDef | ast.FunctionDef


def annotations(node: Documented) -> dict[str, str]:
    """Types by the names of a function's arguments, or of a class's fields, properties and arguments."""
    if isinstance(node, ast.FunctionDef):
        every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        return {one.arg: ast.unparse(one.annotation) for one in every if one.annotation is not None}
    found = {}
    for part in node.body:
        if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
            found[part.target.id] = ast.unparse(part.annotation)
        if isinstance(part, ast.FunctionDef) and part.name == "__init__":
            found |= annotations(part)
        elif isinstance(part, ast.FunctionDef) and part.returns is not None:
            found[part.name] = ast.unparse(part.returns)
    return found


def entries(text: str) -> Iterator[tuple[str, str, str]]:
    """Section, first line and description of every entry of a docstring."""
    parts = re.split(r"^([A-Z]\w+)\n-{3,}\n", text, flags=re.M)
    for section, body in zip(parts[1::2], parts[2::2], strict=True):
        if section in SECTIONS:
            for entry in re.split(r"\n(?=\S)", body.strip("\n")):
                head, _, said = entry.partition("\n")
                yield section, head, said.strip()
