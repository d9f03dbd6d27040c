"""Names in docstrings and comments: a dotted one points to what exists, a type is that of the annotation."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from helpers.districts import DISTRICTS, statements, tree
from helpers.docstring_entries import annotations, entries

ROOT = Path(__file__).resolve().parent.parent
NAME = re.compile(r"`((?:phibench\.)?[a-z_]+(?:\.[A-Za-z_]\w*)+)(?:\(.*?\))?`")
ROOMS: dict[str, list[Path]] = {}
for _room in (room for top in DISTRICTS for room in [ROOT / top, *(ROOT / top).rglob("*")] if room.is_dir()):
    ROOMS.setdefault(_room.name, []).append(_room)
# folders whose name is that of an argument as well: `frames.down`, `sensor.output`, a recipe's `mirror.form`
ARGUMENTS = {"frames", "limits", "mirror", "misalignment", "rig", "room", "sensor"}
# words like `Rig` where a type begins: a capital, then a small letter
TYPE = re.compile(r"(?:^|\b(?:of|to|or) )([A-Z][a-z]\w*)")
NO_TYPES = {"None", "NaN", "Dr"}  # values, and Dr.Jit's own
FILE_ENDS = {"py", "toml", "json", "jsonl", "md", "html", "js", "exr", "npz", "parquet", "png", "csv", "yuyv"}


def sources() -> list[Path]:
    return sorted(file for folder in DISTRICTS for file in (ROOT / folder).rglob("*.py"))


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


# Types of entries such as `rig : Rig` or `rigs : sequence of Rig`.


@cache
def aliases() -> dict[str, str]:
    """Values of the names that modules give to types, as `AnyPair = Pair | DensePair`."""
    values: dict[str, str] = {}
    for node in (node for file in sources() for node in tree(file).body if isinstance(node, ast.Assign)):
        for name in defined(node):
            values[name] = f"{values.get(name, '')} {ast.unparse(node.value)}"
    return values


@cache
def classes() -> frozenset[str]:
    return frozenset(node.name for file in sources() for node in tree(file).body if isinstance(node, ast.ClassDef))


def wrong_types(module: ast.Module) -> Iterator[tuple[str, bool]]:
    """Every word for a type in a module's entries, and True where it is no part of the annotation.

    Excepted are `NO_TYPES`. An alias counts as what it stands for. Where there is no annotation, or `Any`, a class of
    the library or a name of the module is enough.
    """
    inside = list(statements(module))
    bound = classes().union(*(defined(node) for node in inside if isinstance(node, ast.stmt)))
    for node in (node for node in inside if isinstance(node, ast.ClassDef | ast.FunctionDef)):
        types = annotations(node)
        for section, head, _ in entries(ast.get_docstring(node) or ""):
            names, _, text = head.partition(" : ")
            words = set(TYPE.findall(text)) - NO_TYPES if section in ("Parameters", "Attributes") else ()
            for name, word in ((name, word) for name in names.split(", ") for word in words):
                known = set(re.findall(r"\w+", types.get(name, "Any")))
                known.update(*(re.findall(r"\w+", aliases().get(one, "")) for one in known))
                yield f"{node.name}: {head}", word not in (bound if "Any" in known else known)


def test_types_in_docstrings_are_those_of_the_annotations() -> None:
    seen = [(file, *found) for file in sources() for found in wrong_types(tree(file))]
    assert len(seen) > 400
    assert [f"{file.relative_to(ROOT)}: {entry}" for file, entry, wrong in seen if wrong] == []


@pytest.mark.parametrize(
    ("annotation", "entry", "wrong"),
    [
        ("Rig", "Rig", [False]),
        ("Rig", "Mirror", [True]),
        ("Sequence[SpotReading]", "sequence of Reading", [True]),
        ("dict[str, Rig] | None", "dict of str to Rig, or None", [False]),
        ("AnyPair", "Pair or DensePair", [False, False]),
        ("Any", "DensePair", [False]),
        ("Any", "NoClassOfOurs", [True]),
        ("Array", "array, shape (N, 3), in DN of Y'", []),
    ],
)
def test_the_search_sees_types(annotation: str, entry: str, wrong: list[bool]) -> None:
    text = f'"""Use it.\n\n    Parameters\n    ----------\n    one : {entry}\n    """'
    module = ast.parse(f"def use(one: {annotation}) -> None:\n    {text}\n")
    assert [found for _, found in wrong_types(module)] == wrong
