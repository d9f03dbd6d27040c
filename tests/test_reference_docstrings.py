"""Docstrings of the site's reference: every entry says what it is, and a group has one type."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from helpers.districts import tree
from helpers.docstring_entries import Documented, annotations, entries

ROOT = Path(__file__).resolve().parent.parent


def reference() -> list[Path]:
    """Modules of the site's reference, of the hooks' source: its imports are not all here."""
    hooks = ast.parse((ROOT / "docs" / "site_hooks.py").read_text(encoding="utf-8"))
    named = (
        node for node in hooks.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "REFERENCE"
    )
    modules = [module for group in ast.literal_eval(next(named).value).values() for module in group]
    return [ROOT / f"{module.removeprefix('phibench.').replace('.', '/')}.py" for module in modules]


def public(parent: ast.AST) -> Iterator[Documented]:
    for node in ast.iter_child_nodes(parent):
        if isinstance(node, Documented) and not node.name.startswith("_"):
            yield node
            yield from public(node)


def faults(file: Path) -> Iterator[str]:
    for node in public(tree(file)):
        types = annotations(node)
        for section, head, said in entries(ast.get_docstring(node) or ""):
            where = f"{file.relative_to(ROOT)}: {node.name}: {head}"
            if not said:
                yield f"{where}: says nothing"
            names = [name.strip() for name in head.split(" : ")[0].split(",")]
            if section in ("Parameters", "Attributes"):
                if " : " not in head:
                    yield f"{where}: has no type"
                if len({types[name] for name in names if name in types}) > 1:
                    yield f"{where}: has several types"


def test_every_entry_says_what_it_is_and_a_group_has_one_type() -> None:
    files = reference()
    assert len(files) > 20
    assert [fault for file in files for fault in faults(file)] == []
