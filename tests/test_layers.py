"""The architecture: data flows scenes -> render -> datasets -> estimator, and only render knows Mitsuba."""

import ast
import graphlib
import subprocess
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

Python = Callable[..., subprocess.CompletedProcess[str]]

ROOT = Path(__file__).resolve().parent.parent
MAY_IMPORT = {
    "scenes": {"scenes"},
    "render": {"scenes", "render"},
    "datasets": {"scenes", "render", "datasets"},
    "estimator": {"scenes", "datasets", "estimator"},
    "estimator/studies": {"scenes", "render", "datasets", "estimator"},
}
FOLDERS = ("scenes", "render", "datasets", "estimator")
RENDERERS = {"mitsuba", "drjit"}


def sources(root: Path) -> list[Path]:
    return sorted(file for folder in FOLDERS for file in (root / folder).rglob("*.py"))


def module_name(root: Path, file: Path) -> str:
    return ".".join(("phibench", *file.relative_to(root).with_suffix("").parts))


def imports(file: Path) -> Iterator[tuple[int, str]]:
    """Yield (level, dotted name) of every import, wherever it stands; ``from a import b`` gives ``a.b``."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((0, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ((node.level, f"{node.module or ''}.{alias.name}".lstrip(".")) for alias in node.names)


def rule_of(root: Path, file: Path) -> set[str]:
    parts = file.relative_to(root).parts
    return MAY_IMPORT["estimator/studies" if parts[:2] == ("estimator", "studies") else parts[0]]


def faults_of(root: Path, file: Path) -> Iterator[str]:
    here = file.relative_to(root)
    for level, name in imports(file):
        parts = name.split(".")
        if level or parts[0] in FOLDERS:
            yield f"{here}: relative or unqualified import of {name or '.'}"
        elif parts[0] == "tests":
            yield f"{here}: imports the tests"
        elif parts[0] in RENDERERS and here.parts[0] != "render":
            yield f"{here}: imports {parts[0]} outside render/"
        elif parts[0] == "phibench" and (len(parts) == 1 or parts[1] not in rule_of(root, file)):
            yield f"{here}: may not import {name}"


def cycle(root: Path) -> str:
    """Return the modules of one import cycle, or nothing."""
    files = {module_name(root, file): file for file in sources(root)}
    graph = {
        name: {target for _, imported in imports(file) if (target := nearest(imported, files)) not in ("", name)}
        for name, file in files.items()
    }
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return " -> ".join(error.args[1])
    return ""


def nearest(imported: str, files: dict[str, Path]) -> str:
    """Return the module that an import leads to: the name itself or, for a name inside a module, what is before it."""
    return next((name for name in (imported, imported.rpartition(".")[0]) if name in files), "")


def faults(root: Path) -> list[str]:
    found = [fault for file in sources(root) for fault in faults_of(root, file)]
    found += [f"{file.relative_to(root)}: no __init__.py here" for file in sources(root) if file.name == "__init__.py"]
    if loop := cycle(root):
        found.append(f"cycle: {loop}")
    return found


def test_the_tree_obeys_every_rule() -> None:
    assert len(sources(ROOT)) > 5
    assert faults(ROOT) == []


@pytest.mark.parametrize(
    ("path", "source", "complaint"),
    [
        ("scenes/a.py", "from phibench.render.setup.variant import activate", "may not import phibench.render"),
        ("scenes/a.py", "import phibench.datasets.read", "may not import phibench.datasets"),
        ("scenes/a.py", "import phibench", "may not import phibench"),
        ("render/a.py", "from phibench.datasets import read", "may not import phibench.datasets"),
        ("render/a.py", "from phibench.estimator.geometry.phi import phi", "may not import phibench.estimator"),
        ("datasets/a.py", "from phibench.estimator import phi", "may not import phibench.estimator"),
        ("estimator/a.py", "from phibench.render.optics.truth import truth", "may not import phibench.render"),
        (
            "estimator/methods/a.py",
            "def f():\n    import phibench.render.optics.truth",
            "may not import phibench.render",
        ),
        ("datasets/a.py", "def f():\n    import mitsuba as mi", "imports mitsuba outside render/"),
        ("estimator/studies/a.py", "from drjit.llvm import Float", "imports drjit outside render/"),
        ("scenes/a.py", "from . import rig", "relative or unqualified import"),
        ("scenes/a.py", "from .rig import Rig", "relative or unqualified import"),
        ("scenes/a.py", "from scenes.rig import Rig", "relative or unqualified import"),
        ("datasets/a.py", "import tests.oracles", "imports the tests"),
        ("datasets/__init__.py", "", "no __init__.py here"),
        ("estimator/methods/__init__.py", "", "no __init__.py here"),
    ],
)
def test_each_rule_catches_what_it_forbids(tmp_path: Path, path: str, source: str, complaint: str) -> None:
    write(tmp_path, path, source)
    found = faults(tmp_path)
    assert len(found) == 1
    assert complaint in found[0]


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("render/a.py", "import mitsuba\nfrom drjit.llvm import Float\nfrom phibench.scenes.rig import Rig"),
        ("datasets/a.py", "from phibench.render.optics.truth import truth\nfrom phibench.scenes import rig"),
        (
            "estimator/a.py",
            "import numpy\nfrom phibench.datasets.read import read\nfrom phibench.scenes.rig import Rig",
        ),
        ("estimator/studies/a.py", "from phibench.render.optics.truth import truth"),
    ],
)
def test_what_is_allowed_passes(tmp_path: Path, path: str, source: str) -> None:
    write(tmp_path, path, source)
    assert faults(tmp_path) == []


def test_a_cycle_is_caught(tmp_path: Path) -> None:
    write(tmp_path, "scenes/a.py", "from phibench.scenes.b import x")
    write(tmp_path, "scenes/b.py", "from phibench.scenes import c")
    assert faults(tmp_path) == []
    write(tmp_path, "scenes/c.py", "def f():\n    import phibench.scenes.a")
    assert [fault.split(":")[0] for fault in faults(tmp_path)] == ["cycle"]


def write(root: Path, path: str, source: str) -> None:
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(source, encoding="utf-8")


def test_reading_and_scoring_import_without_mitsuba(python: Python) -> None:
    files = [file for file in sources(ROOT) if file.relative_to(ROOT).parts[0] != "render"]
    names = [module_name(ROOT, file) for file in files]
    blocked = "import importlib, sys\nsys.modules.update(mitsuba=None, drjit=None)\n"
    child = python(blocked + "for name in sys.argv[1:]: importlib.import_module(name)", *names)
    assert child.returncode == 0, child.stderr
    # The block itself works, so the line above could have failed.
    assert python(blocked + "import mitsuba").returncode != 0


def test_importing_a_module_does_not_import_mitsuba(python: Python) -> None:
    """Nothing heavy at import, in render/ neither: Mitsuba must come after its LLVM."""
    names = [module_name(ROOT, file) for file in sources(ROOT)]
    code = (
        "import importlib, sys\nfor name in sys.argv[1:]: importlib.import_module(name)\nprint('drjit' in sys.modules)"
    )
    child = python(code, *names)
    assert child.returncode == 0, child.stderr
    assert child.stdout.strip() == "False"


@pytest.mark.parametrize("folder", FOLDERS)
def test_our_folders_shadow_nobody_from_the_checkout(folder: str, tmp_path: Path, python: Python) -> None:
    """A folder without __init__.py gives way to a package of that name, even to one later on the path."""
    write(tmp_path, f"{folder}/__init__.py", "whose = 'theirs'")
    child = python(f"import {folder}; print({folder}.whose)", PYTHONPATH=str(tmp_path))
    assert child.stdout.strip() == "theirs", child.stderr


def test_every_folder_with_code_is_packaged() -> None:
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["packages"]
    needed = {module_name(ROOT, file).rpartition(".")[0] for file in sources(ROOT)}
    assert needed - set(listed) == set()
    assert [name for name in listed if not (ROOT / name.removeprefix("phibench.").replace(".", "/")).is_dir()] == []


def test_the_pins_name_no_place() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").split()
    assert len(lines) > 20
    assert [line for line in lines if line.count("==") != 1 or set(line) & set("/@:")] == []
