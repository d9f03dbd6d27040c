"""The architecture: the order of the districts and of their folders, and only render knows Mitsuba.

The package's own files, in `phibench/`, stand last: they may import everything, and nothing imports them.
"""

import ast
import graphlib
import importlib
import subprocess
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from pathlib import Path

import pytest
from helpers.districts import DISTRICTS

Python = Callable[..., subprocess.CompletedProcess[str]]

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "phibench"
# Every unit may import itself and the units on the lines above its own; a single file counts as a unit.
ORDER = """
scenes
scenes/motion scenes/worlds
render/optics
render/sensor
render/film
render/setup
render/room
render/plugins
datasets/errors
datasets/parallel datasets/progress datasets/input_files datasets/version datasets/shown_text
datasets/camera_pictures
datasets/rooms
datasets/recipe
datasets/plan
datasets/store
datasets/frames
datasets/read
datasets/exposures
datasets/build
datasets/make
datasets/scene
datasets/film
datasets/show datasets/sample_page datasets/verify datasets/merge_repair datasets/training
estimator/interface
estimator/pair_set
estimator/geometry
estimator/spots
estimator/processed
estimator/learned
estimator/limits estimator/methods
estimator/draw_pairs
calibration/sensor_fit
calibration/outline
calibration/rig
calibration/captures
benchmark/release
benchmark/isolation
benchmark/pair_sets
benchmark/scores
benchmark/scored_dataset
benchmark/sealed
benchmark/export
benchmark/demo
robot/film
robot/loop
studies/paper
studies
phibench/cli
estimator/seat
phibench
"""
LEVEL = {unit: level for level, line in enumerate(ORDER.split("\n")) for unit in line.split()}
QUESTION_WORDS = {"What", "Where", "How", "Whether", "Which", "That"}
RENDERERS = {"mitsuba", "drjit"}
MAY_IMPORT_RENDERERS = ("render/room", "render/setup")
# The simulator and the estimator share numbers, not mathematics; only studies render.
RENDERS = ("render", "datasets", "benchmark/export", "benchmark/release", "studies", "phibench/__")


def sources(root: Path) -> list[Path]:
    return sorted(file for folder in (*DISTRICTS, PACKAGE) for file in (root / folder).rglob("*.py"))


def module_name(root: Path, file: Path) -> str:
    parts = file.relative_to(root).with_suffix("").parts
    own = parts[1:] if parts[0] == PACKAGE else parts
    return ".".join((PACKAGE, *(part for part in own if part != "__init__")))


def imports(file: Path) -> Iterator[tuple[int, str]]:
    """Yield (level, dotted name) of every import, wherever it stands; ``from a import b`` gives ``a.b``."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((0, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ((node.level, f"{node.module or ''}.{alias.name}".lstrip(".")) for alias in node.names)


def unit_of(parts: tuple[str, ...]) -> str:
    """Unit of the longest path in `ORDER` that a module's parts begin with; nothing if there is none."""
    return next((unit for n in (2, 1) if (unit := "/".join(parts[:n])) in LEVEL), "")


def may_import(here: tuple[str, ...], there: tuple[str, ...]) -> bool:
    mine, theirs = unit_of(here), unit_of(there)
    if not mine or not theirs or (there[0] == "render" and not "/".join(here).startswith(("scenes", *RENDERS))):
        return False
    return mine == theirs or LEVEL[theirs] < LEVEL[mine]


def faults_of(root: Path, file: Path) -> Iterator[str]:
    here = file.relative_to(root)
    own = here.with_suffix("").parts
    if not unit_of(own):
        yield f"{here}: has no place in the order"
        return
    for level, name in imports(file):
        parts = tuple(name.split("."))
        if level or parts[0] in DISTRICTS:
            yield f"{here}: relative or unqualified import of {name or '.'}"
        elif parts[0] == "tests":
            yield f"{here}: imports the tests"
        elif parts[0] in RENDERERS and unit_of(own) not in MAY_IMPORT_RENDERERS:
            yield f"{here}: imports {parts[0]} outside {' and '.join(MAY_IMPORT_RENDERERS)}"
        elif parts[0] == PACKAGE and (len(parts) < 3 or not may_import(own, parts[parts[1] in DISTRICTS :])):
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
    paths = [file.relative_to(root) for file in sources(root)]
    found += [
        f"{path}: no __init__.py here" for path in paths if path.name == "__init__.py" and path.parts[0] in DISTRICTS
    ]
    if loop := cycle(root):
        found.append(f"cycle: {loop}")
    return found


def test_pytest_looks_into_every_folder_of_tests(pytestconfig: pytest.Config) -> None:
    """Its defaults leave out folders called "build"."""
    left_out = pytestconfig.getini("norecursedirs")
    folders = {part for file in (ROOT / "tests").rglob("test_*.py") for part in file.relative_to(ROOT).parts[:-1]}
    assert {"tests", "build"} <= folders
    assert not [name for name in folders if any(fnmatch(name, pattern) for pattern in left_out)]


def test_the_tree_obeys_every_rule() -> None:
    assert len(sources(ROOT)) > 5
    assert faults(ROOT) == []


@pytest.mark.parametrize(
    ("path", "source", "complaint"),
    [
        ("scenes/a.py", "from phibench.render.optics.truth import truth", "may not import phibench.render"),
        ("scenes/a.py", "import phibench.datasets.read", "may not import phibench.datasets"),
        ("scenes/a.py", "import phibench", "may not import phibench"),
        (
            "render/optics/a.py",
            "from phibench.render.sensor.light import Light",
            "may not import phibench.render",
        ),
        ("render/optics/a.py", "import mitsuba as mi", "imports mitsuba outside render/room and render/setup"),
        ("render/room/a.py", "from phibench.datasets.read import Dataset", "may not import phibench.datasets"),
        ("render/room/a.py", "from phibench.estimator.geometry.phi import phi", "may not import phibench.estimator"),
        (
            "datasets/store/a.py",
            "from phibench.datasets.build.tasks import perform",
            "may not import phibench.datasets",
        ),
        ("datasets/show.py", "from phibench.datasets.verify import verify", "may not import phibench.datasets.verify"),
        ("datasets/build/a.py", "from phibench.estimator.geometry import phi", "may not import phibench.estimator"),
        ("estimator/spots/a.py", "from phibench.render.optics.truth import truth", "may not import phibench.render"),
        ("estimator/geometry/a.py", "from phibench.estimator.spots import detect", "may not import phibench.estimator"),
        (
            "estimator/methods/a.py",
            "def f():\n    import phibench.render.optics.truth",
            "may not import phibench.render",
        ),
        ("estimator/limits/a.py", "from phibench.estimator.methods import simple", "may not import phibench.estimator"),
        ("datasets/read.py", "def f():\n    import mitsuba as mi", "imports mitsuba outside"),
        ("studies/a.py", "from drjit.llvm import Float", "imports drjit outside"),
        ("scenes/a.py", "from . import rig", "relative or unqualified import"),
        ("scenes/a.py", "from .rig import Rig", "relative or unqualified import"),
        ("scenes/a.py", "from scenes.rig import Rig", "relative or unqualified import"),
        ("datasets/read.py", "import tests.oracles", "imports the tests"),
        ("datasets/shed.py", "", "has no place in the order"),
        ("estimator/shed/a.py", "", "has no place in the order"),
        ("datasets/store/__init__.py", "", "no __init__.py here"),
        ("phibench/cli/a.py", "from phibench import open_dataset", "may not import phibench.open_dataset"),
        ("phibench/cli/a.py", "import phibench.__main__", "may not import phibench.__main__"),
        ("studies/a.py", "from phibench.estimator.seat import pair", "may not import phibench.estimator"),
        ("phibench/__init__.py", "import mitsuba", "imports mitsuba outside"),
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
        ("render/room/a.py", "import mitsuba\nfrom drjit.llvm import Float\nfrom phibench.scenes.rig import Rig"),
        ("datasets/build/a.py", "from phibench.render.optics.truth import truth\nfrom phibench.scenes import rig"),
        ("estimator/interface.py", "import numpy\nfrom phibench.datasets.read import read\nimport phibench.scenes.rig"),
        ("studies/a.py", "from phibench.render.optics.truth import truth"),
        (
            "phibench/__init__.py",
            "from phibench.cli.main import main\nfrom phibench.datasets.read import read",
        ),
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


def test_the_tree_has_few_large_rooms() -> None:
    """At most 420 files, at most 16 in a folder, no file name twice (but for the fixed roles of a study).

    Studies and commands have files of the same names: their folder says of what. A public class has its name alone.
    """
    files = [file.relative_to(ROOT) for file in sources(ROOT)]
    assert len(files) <= 420
    folders = Counter(file.parent for file in files)
    assert {str(folder): n for folder, n in folders.items() if n > 16} == {}
    stems = Counter(file.stem for file in files if file.parts[0] != "studies" and "cli" not in file.parts)
    assert {file.stem for file in files if file.parent == Path(PACKAGE)} == {"__init__", "__main__"}
    assert [stem for stem, n in stems.items() if n > 1] == []
    bodies = [ast.parse((ROOT / file).read_text(encoding="utf-8")).body for file in files]
    classes = Counter(node.name for body in bodies for node in body if isinstance(node, ast.ClassDef))
    assert len(classes) > 600
    assert [name for name, n in classes.items() if n > 1 and not name.startswith("_")] == []


def test_docstrings_begin_with_a_noun_or_a_verb() -> None:
    """A docstring names its subject first; a question word hides it."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    texts = [
        (file.relative_to(ROOT), text)
        for file in sources(ROOT)
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, documented) and (text := ast.get_docstring(node))
    ]
    assert len(texts) > 1000
    assert [f"{path}: {text.splitlines()[0]}" for path, text in texts if text.split()[0] in QUESTION_WORDS] == []


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


@pytest.mark.parametrize("folder", DISTRICTS)
def test_our_folders_shadow_nobody_from_the_checkout(folder: str, tmp_path: Path, python: Python) -> None:
    """A folder without __init__.py gives way to a package of that name, even to one later on the path."""
    write(tmp_path, f"{folder}/__init__.py", "whose = 'theirs'")
    child = python(f"import {folder}; print({folder}.whose)", PYTHONPATH=str(tmp_path))
    assert child.stdout.strip() == "theirs", child.stderr


def test_every_folder_with_code_is_packaged() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    find = project["tool"]["setuptools"]["packages"]["find"]
    assert find == {"include": ["phibench", "phibench.*"], "namespaces": True}
    links = {path.name: path.resolve() for path in (ROOT / PACKAGE).iterdir() if path.is_symlink()}
    assert links == {name: ROOT / name for name in DISTRICTS}


def test_tests_are_no_part_of_the_package() -> None:
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("phibench.tests")


def test_the_pins_name_no_place() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").split()
    assert len(lines) > 20
    assert [line for line in lines if line.count("==") != 1 or set(line) & set("/@:")] == []
