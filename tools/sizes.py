"""Line counts of the library by top folder: code, docstrings, blanks, imports, comments: `python -m tools.sizes`."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DISTRICTS = ("scenes", "render", "datasets", "estimator", "calibration", "benchmark", "robot", "studies", "tools")
KINDS = ("code", "docstring", "blank", "import", "comment")


def kinds(file: Path) -> Iterator[str]:
    """What each line of a file is; blank lines of a docstring belong to it."""
    text = file.read_text(encoding="utf-8")
    lines = [line.strip() for line in text.splitlines()]
    kind = ["blank" if not line else "comment" if line.startswith("#") else "code" for line in lines]
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            _set(kind, node, "import")
        elif isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            _set(kind, node.body[0], "docstring")
    yield from kind


def _set(kind: list[str], node: ast.stmt, name: str) -> None:
    last = node.end_lineno or node.lineno
    kind[node.lineno - 1 : last] = [name] * (last - node.lineno + 1)


def main() -> None:
    """Print a row for each district, and one for all of them."""
    files = {name: list((ROOT / name).rglob("*.py")) for name in DISTRICTS}
    files["phibench"] = [*(ROOT / "phibench").glob("*.py"), *(ROOT / "phibench" / "cli").glob("*.py")]
    rows = {name: Counter(kind for file in own for kind in kinds(file)) for name, own in files.items()}
    print(f"{'':12s}{'lines':>10s}" + "".join(f"{kind:>10s}" for kind in KINDS))
    for name, row in {**rows, "all": sum(rows.values(), Counter[str]())}.items():
        print(f"{name:12s}{row.total():10d}" + "".join(f"{row[kind]:10d}" for kind in KINDS))


if __name__ == "__main__":
    main()
