"""The architecture: the order of the districts and of their folders, and only render knows Mitsuba.

The package's own files, in `phibench/`, stand last: they may import everything, and nothing imports them.
"""

import ast
import graphlib
import importlib
import subprocess
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from fnmatch import fnmatch
from pathlib import Path

import grimp
import pytest
from helpers.districts import DISTRICTS, statements, tree

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
datasets/common
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
datasets/manifest_check
datasets/show datasets/sample_page datasets/verify datasets/merge_repair datasets/training
estimator/interface
estimator/pair_set estimator/drawn_pairs
estimator/geometry
estimator/spots
estimator/processed
estimator/learned
estimator/limits estimator/methods
estimator/dense
calibration/sensor_fit
calibration/outline
calibration/rig
calibration/captures
benchmark/isolation
benchmark/pair_sets
benchmark/scores
benchmark/reports
benchmark/dense
benchmark/scored_dataset benchmark/make_dataset
benchmark/sealed
benchmark/export
benchmark/release
robot/film
robot/loop
studies/paper
studies
phibench/cli
phibench
"""
LEVEL = {unit: level for level, line in enumerate(ORDER.split("\n")) for unit in line.split()}
QUESTION_WORDS = {"What", "Where", "How", "Whether", "Which", "That"}
RENDERERS = {"mitsuba", "drjit"}
MAY_IMPORT_RENDERERS = ("render/room", "render/setup")
# The simulator and the estimator share numbers, not mathematics; only studies render.
RENDERS = (
    *("render", "datasets", "benchmark/sealed/dense_set", "benchmark/export", "benchmark/release"),
    *("studies", "phibench/__"),
)


def sources(root: Path) -> list[Path]:
    return sorted(file for folder in (*DISTRICTS, PACKAGE) for file in (root / folder).rglob("*.py"))


def module_name(root: Path, file: Path) -> str:
    parts = file.relative_to(root).with_suffix("").parts
    own = parts[1:] if parts[0] == PACKAGE else parts
    return ".".join((PACKAGE, *(part for part in own if part != "__init__")))


def unit_of(parts: Sequence[str]) -> str:
    """Unit of the longest path in `ORDER` that a module's parts begin with; nothing if there is none."""
    return next((unit for n in (2, 1) if (unit := "/".join(parts[:n])) in LEVEL), "")


def may_import(here: Sequence[str], there: Sequence[str]) -> bool:
    mine, theirs = unit_of(here), unit_of(there)
    if not mine or not theirs or (there[0] == "render" and not "/".join(here).startswith(("scenes", *RENDERS))):
        return False
    return mine == theirs or LEVEL[theirs] < LEVEL[mine]


def unit_parts(module: str) -> list[str]:
    """Path of a module as `ORDER` writes it: the package's own files keep the package's name."""
    parts = module.split(".")
    return parts[1:] if len(parts) > 1 and parts[1] in DISTRICTS else parts


def faults_of(graph: grimp.ImportGraph) -> list[str]:
    """Imports that a graph holds and the order forbids."""
    roots = {PACKAGE, *(f"{PACKAGE}.{name}" for name in DISTRICTS)}
    ours = sorted(name for name in graph.modules - roots if name.startswith(f"{PACKAGE}."))
    faults = [f"{name}: has no place in the order" for name in ours if not unit_of(unit_parts(name))]
    edges = [(name, target) for name in ours for target in sorted(graph.find_modules_directly_imported_by(name))]
    for name, target in edges:
        mine, root = unit_parts(name), target.partition(".")[0]
        if root in RENDERERS and unit_of(mine) not in MAY_IMPORT_RENDERERS:
            faults.append(f"{name}: imports {root} outside {' and '.join(MAY_IMPORT_RENDERERS)}")
        elif root in ("tests", *DISTRICTS):
            faults.append(f"{name}: imports {root}, which is no package of ours")
        elif root == PACKAGE and unit_of(mine) and not may_import(mine, unit_parts(target)):
            faults.append(f"{name}: may not import {target}")
    inner = [(name, target) for name, target in edges if target.startswith(f"{PACKAGE}.")]
    return [*faults, *circles(inner), *circles([(folder_of(a), folder_of(b)) for a, b in inner])]


def folder_of(module: str) -> str:
    return module.rpartition(".")[0]


def circles(edges: Iterable[tuple[str, str]]) -> list[str]:
    """Return one circle of a graph that has any: of modules, or of the folders that they lie in."""
    behind: dict[str, set[str]] = {}
    for name, target in edges:
        behind.setdefault(name, set()).update({target} - {name})
    try:
        graphlib.TopologicalSorter(behind).prepare()
    except graphlib.CycleError as error:
        return [f"circle: {' -> '.join(error.args[1])}"]
    return []


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    """Every import of the package, also within functions. The districts are namespaces: grimp takes each as a root."""
    roots = [f"{PACKAGE}.{name}" for name in (*DISTRICTS, "cli")]
    return grimp.build_graph(*roots, include_external_packages=True, cache_dir=None)


def test_pytest_looks_into_every_folder_of_tests(pytestconfig: pytest.Config) -> None:
    """Its defaults leave out folders called "build"."""
    left_out = pytestconfig.getini("norecursedirs")
    folders = {part for file in (ROOT / "tests").rglob("test_*.py") for part in file.relative_to(ROOT).parts[:-1]}
    assert {"tests", "build"} <= folders
    assert not [name for name in folders if any(fnmatch(name, pattern) for pattern in left_out)]


def test_the_tree_obeys_every_rule(graph: grimp.ImportGraph) -> None:
    ours = [name for name in graph.modules if name.startswith(f"{PACKAGE}.")]
    files = {module_name(ROOT, file) for file in sources(ROOT)} - {PACKAGE, f"{PACKAGE}.__main__"}
    assert files <= set(ours)
    assert graph.count_imports() > 3000
    assert faults_of(graph) == []


def test_nothing_imports_the_top_and_no_folder_is_a_package() -> None:
    """What grimp cannot tell: the package's own name is the root of every import, and districts are namespaces."""
    for file in sources(ROOT):
        found = list(imports(file))
        names = [name for _, name in found]
        assert all(level == 0 for level, _ in found), f"{file}: relative import"
        if file.parent != ROOT / PACKAGE:
            assert [name for name in names if name == PACKAGE or name.startswith(f"{PACKAGE}.__")] == [], file
            assert [name for name in names if name.startswith(f"{PACKAGE}.") and name.count(".") < 2] == [], file
        assert file.name != "__init__.py" or file.relative_to(ROOT).parts[0] == PACKAGE, f"{file}: no __init__.py here"


def imports(file: Path) -> Iterator[tuple[int, str]]:
    """Yield (level, dotted name) of every import, wherever it stands; ``from a import b`` gives ``a.b``."""
    for node in statements(tree(file)):
        if isinstance(node, ast.Import):
            yield from ((0, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ((node.level, f"{node.module or ''}.{alias.name}".lstrip(".")) for alias in node.names)


def graph_of(*edges: tuple[str, str]) -> grimp.ImportGraph:
    graph = grimp.ImportGraph()
    for name in {name for edge in edges for name in edge}:
        graph.add_module(name)
    for name, target in edges:
        graph.add_import(importer=name, imported=target)
    return graph


@pytest.mark.parametrize(
    ("name", "target", "complaint"),
    [
        ("scenes.a", "phibench.render.optics.truth", "may not import phibench.render"),
        ("scenes.a", "phibench.datasets.read", "may not import phibench.datasets"),
        ("render.optics.a", "phibench.render.sensor.light", "may not import phibench.render"),
        ("render.optics.a", "mitsuba", "imports mitsuba outside render/room and render/setup"),
        ("render.room.a", "phibench.datasets.read", "may not import phibench.datasets"),
        ("render.room.a", "phibench.estimator.geometry.phi", "may not import phibench.estimator"),
        ("datasets.store.a", "phibench.datasets.build.tasks", "may not import phibench.datasets"),
        ("datasets.show", "phibench.datasets.verify", "may not import phibench.datasets.verify"),
        ("datasets.build.a", "phibench.estimator.geometry.phi", "may not import phibench.estimator"),
        ("estimator.spots.a", "phibench.render.optics.truth", "may not import phibench.render"),
        ("estimator.geometry.a", "phibench.estimator.spots.detect", "may not import phibench.estimator"),
        ("estimator.limits.a", "phibench.estimator.methods.registry", "may not import phibench.estimator"),
        ("datasets.read", "mitsuba", "imports mitsuba outside"),
        ("studies.a", "drjit.llvm", "imports drjit outside"),
        ("scenes.a", "scenes.rig", "imports scenes, which is no package of ours"),
        ("datasets.read", "tests.oracles", "imports tests"),
        ("datasets.shed", "numpy", "has no place in the order"),
        ("estimator.shed.a", "numpy", "has no place in the order"),
    ],
)
def test_each_rule_catches_what_it_forbids(name: str, target: str, complaint: str) -> None:
    faults = faults_of(graph_of((f"{PACKAGE}.{name}", target)))
    assert len(faults) == 1
    assert complaint in faults[0]


@pytest.mark.parametrize(
    ("name", "targets"),
    [
        ("render.room.a", ["mitsuba", "drjit.llvm", "phibench.scenes.rig"]),
        ("datasets.build.a", ["phibench.render.optics.truth", "phibench.scenes.rig"]),
        ("estimator.interface", ["numpy", "phibench.datasets.read", "phibench.scenes.rig"]),
        ("studies.a", ["phibench.render.optics.truth"]),
    ],
)
def test_what_is_allowed_passes(name: str, targets: list[str]) -> None:
    assert faults_of(graph_of(*((f"{PACKAGE}.{name}", target) for target in targets))) == []


def test_circles_of_modules_and_of_folders_are_caught() -> None:
    edges = [("phibench.scenes.a", "phibench.scenes.b"), ("phibench.scenes.b", "phibench.scenes.c")]
    assert faults_of(graph_of(*edges)) == []
    assert "circle" in faults_of(graph_of(*edges, ("phibench.scenes.c", "phibench.scenes.a")))[0]
    # A folder's root that stands partly below, partly above its sub-package.
    through = [("phibench.datasets.make", "phibench.datasets.store.files")]
    assert faults_of(graph_of(*through)) == []
    assert "circle" in faults_of(graph_of(*through, ("phibench.datasets.store.a", "phibench.datasets.b")))[-1]


def write(root: Path, path: str, source: str) -> None:
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(source, encoding="utf-8")


def test_the_tree_has_few_large_rooms() -> None:
    """At most 4.0 files per 1000 lines and 16 in a folder, no file name twice (but for the fixed roles of a study).

    Studies and commands have files of the same names: their folder says of what. A public class has its name alone.
    """
    files = [file.relative_to(ROOT) for file in sources(ROOT)]
    lines = sum((ROOT / file).read_text(encoding="utf-8").count("\n") for file in files)
    assert len(files) <= 4.0 * lines / 1000.0
    folders = Counter(file.parent for file in files)
    assert {str(folder): n for folder, n in folders.items() if n > 16} == {}
    stems = Counter(file.stem for file in files if file.parts[0] != "studies" and "cli" not in file.parts)
    assert {file.stem for file in files if file.parent == Path(PACKAGE)} == {"__init__", "__main__"}
    assert [stem for stem, n in stems.items() if n > 1] == []
    bodies = [tree(ROOT / file).body for file in files]
    classes = Counter(node.name for body in bodies for node in body if isinstance(node, ast.ClassDef))
    assert len(classes) > 600
    assert [name for name, n in classes.items() if n > 1 and not name.startswith("_")] == []


def test_docstrings_begin_with_a_noun_or_a_verb() -> None:
    """A docstring names its subject first; a question word hides it."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    texts = [
        (file.relative_to(ROOT), text)
        for file in sources(ROOT)
        for node in statements(tree(file))
        if isinstance(node, documented) and (text := ast.get_docstring(node))
    ]
    assert len(texts) > 1000
    assert [f"{path}: {text.splitlines()[0]}" for path, text in texts if text.split()[0] in QUESTION_WORDS] == []


WITHOUT = """
import importlib, importlib.abc, sys

class Nowhere(importlib.abc.MetaPathFinder):
    asked = []

    def find_spec(self, name, *_):
        if name.partition(".")[0] in ("mitsuba", "drjit"):
            self.asked.append(name)
            raise ModuleNotFoundError(name, name=name)

sys.meta_path.insert(0, Nowhere())
for name in sys.argv[1:]:
    importlib.import_module(name)
print(Nowhere.asked)
import mitsuba
"""
"""Program that imports modules where there is no Mitsuba and says who looked for it, then looks for it itself."""


def test_every_module_imports_without_mitsuba_and_does_not_look_for_it(python: Python) -> None:
    """Reading and scoring work without it; nothing heavy at import, in render/ neither: it comes after its LLVM."""
    child = python(WITHOUT, *(module_name(ROOT, file) for file in sources(ROOT)))
    assert child.stdout.strip() == "[]", child.stderr
    # The block itself works, so the line above could have failed.
    assert "ModuleNotFoundError: mitsuba" in child.stderr


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
