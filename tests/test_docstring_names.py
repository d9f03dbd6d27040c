"""Dotted names in docstrings and comments: every module, class, function and field that one points to exists."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from helpers.districts import DISTRICTS

ROOT = Path(__file__).resolve().parent.parent
NAME = re.compile(r"`((?:phibench\.)?[a-z_]+(?:\.[A-Za-z_]\w*)+)(?:\(.*?\))?`")
ROOMS: dict[str, list[Path]] = {}
for _room in (room for top in DISTRICTS for room in [ROOT / top, *(ROOT / top).rglob("*")] if room.is_dir()):
    ROOMS.setdefault(_room.name, []).append(_room)
# folders whose name is that of an argument as well: `frames.down`, `sensor.output`, a recipe's `mirror.form`
ARGUMENTS = {"frames", "limits", "mirror", "misalignment", "rig", "room", "sensor"}
FILE_ENDS = {"py", "toml", "json", "jsonl", "md", "html", "js", "exr", "npz", "parquet", "png", "csv", "yuyv"}


def sources() -> list[Path]:
    return sorted(file for folder in DISTRICTS for file in (ROOT / folder).rglob("*.py"))


@cache
def tree(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def named(file: Path) -> Iterator[str]:
    """Dotted names that begin with a folder of the library, in docstrings and comments."""
    for name in NAME.findall(file.read_text(encoding="utf-8")):
        parts = name.removeprefix("phibench.").split(".")
        if parts[0] in ROOMS.keys() - ARGUMENTS and parts[-1] not in FILE_ENDS:
            yield name


def exists(name: str) -> bool:
    """True if a folder of the first part's name, or the library, holds what the other parts say."""
    parts = name.removeprefix("phibench.").split(".")
    if parts[0] in DISTRICTS:
        return holds(ROOT, parts)
    return any(holds(room, parts[1:]) for room in ROOMS[parts[0]])


def holds(place: Path, parts: list[str]) -> bool:
    """Walk folders, then a module's names, then a class's."""
    while parts and (place / parts[0]).is_dir():
        place, parts = place / parts[0], parts[1:]
    if not parts:
        return True
    module = place / f"{parts[0]}.py"
    if not module.is_file():
        return False
    body: list[ast.stmt] = tree(module).body
    for part in parts[1:]:
        found = [node for node in body if part in defined(node)]
        if not found:
            return False
        body = found[0].body if isinstance(found[0], ast.ClassDef) else []
    return True


def defined(node: ast.stmt) -> set[str]:
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return {node.name}
    if isinstance(node, ast.Assign):
        return {target.id for target in node.targets if isinstance(target, ast.Name)}
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
        return {node.target.id}
    if isinstance(node, ast.Import | ast.ImportFrom):
        return {alias.asname or alias.name for alias in node.names}
    return set()


def test_names_in_docstrings_exist() -> None:
    seen = [(file, name) for file in sources() for name in named(file)]
    assert len(seen) > 40
    assert [f"{file.relative_to(ROOT)}: {name}" for file, name in seen if not exists(name)] == []


@pytest.mark.parametrize(
    ("name", "there"),
    [
        ("estimator.phi", False),
        ("estimator.geometry.phi", True),
        ("geometry.phi.phi_ray", True),
        ("estimator.interface.Pair.stroke_m", True),
        ("phibench.estimator.interface.Pair.strokes", False),
    ],
)
def test_the_search_sees_faults(name: str, there: bool) -> None:
    assert exists(name) == there
