"""Adding: a preset, a conic, a study, a method and a source of rooms to a copy of the checkout, which uses them.

CONTRIBUTING.md says how many files each takes. One process uses all of them: imports take most of the time.
"""

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from helpers.districts import DISTRICTS
from helpers.page_numbers import Published

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = (*DISTRICTS, "phibench", "tools")
MIRRORS = "SphereMirror|RevolvedMirror|FormedProfile|Profile"


@dataclass(frozen=True)
class Copy:
    """Code and settings of the checkout as links to their files; what is added is no link."""

    root: Path

    @classmethod
    def of_checkout(cls, root: Path) -> "Copy":
        for district in PACKAGE:
            for file in (ROOT / district).rglob("*"):
                link = root / file.relative_to(ROOT)
                if file.suffix in {".py", ".toml"}:
                    link.parent.mkdir(parents=True, exist_ok=True)
                    link.symlink_to(file)
                    compiled = link.parent / "__pycache__"  # is read, and not written
                    if not compiled.exists() and (file.parent / compiled.name).is_dir():
                        compiled.symlink_to(file.parent / compiled.name)
        for district in DISTRICTS:
            (root / "phibench" / district).symlink_to(root / district)
        return cls(root)

    def edit(self, path: str, *changes: tuple[str, str]) -> None:
        """Change a file, each text in the one place where it stands."""
        file = self.root / path
        text = file.read_text(encoding="utf-8")
        for old, new in changes:
            assert text.count(old) == 1, f"{path} has {text.count(old)} times: {old}"
            text = text.replace(old, new)
        file.unlink()
        file.write_text(text, encoding="utf-8")

    def added(self) -> set[str]:
        """Files that are no links."""
        files = (path for district in PACKAGE for path in (self.root / district).rglob("*"))
        return {path.relative_to(self.root).as_posix() for path in files if path.is_file() and not path.is_symlink()}

    def run(self, code: str, *arguments: str) -> str:
        """Output of code that imports the copy."""
        environment = {**os.environ, "PYTHONPATH": str(self.root), "PYTHONDONTWRITEBYTECODE": "1"}
        command = [sys.executable, "-c", code, *arguments]
        child = subprocess.run(
            command, cwd=self.root, env=environment, capture_output=True, text=True, timeout=120, check=False
        )
        assert child.returncode == 0, child.stderr
        return child.stdout


@dataclass(frozen=True)
class Addition:
    """What is added, the files that it takes, a use of it, and lines that the use says."""

    add: Callable[[Copy], None]
    files: tuple[str, ...]
    use: str
    says: str


# A preset: its easy pairs, its noise, recipes that name it, the reference of recipes and the Tab key know it.


def add_preset(copy: Copy) -> None:
    table = '[presets.night-raw8]\noutput = "raw"\nadc_bits = 8\nblack_level_dn = 4.0\n\n'
    copy.edit("render/sensor/settings_presets.toml", ("[presets.srgb8]", f"{table}[presets.srgb8]"))


USE_PRESET = """
from phibench.cli.main import main
from phibench.benchmark.isolation.easy_pairs import EasyPairs
from phibench.datasets.frames.frame_source import noise_draw
from phibench.datasets.recipe.tables import FramesTable
from tools.reference_page import recipe_page
print(EasyPairs("night-raw8").pair(0).down.max(), EasyPairs("bayer-raw").pair(0).down.max() > 255)
print(FramesTable(presets=["night-raw8"]).presets, noise_draw("night-raw8", 0) > 2**64, "'night-raw8'" in recipe_page())
print(max(len(row) for row in recipe_page().splitlines() if row.startswith("|")) <= 160)
main(["__complete", "score", "x", "--preset", "night"])
"""

# A conic: a recipe takes its name; simulator and estimator agree on the distance that its images give.


def add_conic(copy: Copy) -> None:
    line = '"oblate": MirrorShape(("vertex_radius_m", "conic"), 0.2, low=0.0),\n    '
    copy.edit("datasets/recipe/mirror_tables.py", ('"cone": MirrorShape(', f'{line}"cone": MirrorShape('))


USE_CONIC = """
import numpy as np
from phibench.datasets.recipe.recipe_scene import build_rig
from phibench.datasets.recipe.tables import RigTable
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.render.optics.truth import spot_truth
from phibench.scenes.laser import LaserSpot
from phibench.studies.mirror.tables import MirrorEntry
from tools.reference_page import recipe_page
rig = build_rig(RigTable.model_validate({"mirror": {"shape": "oblate", "rim_radius_m": 0.05}}))
spot = LaserSpot((2.0, 0.0, 0.5), (-1.0, 0.0, 0.0), 0.004)
down, up = (spot_truth(rig.at(h), spot, ()) for h in (0.0, 0.3))
pixels = (np.array([truth.u_px, truth.v_px]) for truth in (down, up))
print("* oblate: `vertex_radius_m` (0.06), `conic` above 0 (0.2)" in recipe_page())
print(rig.mirror.profile.conic, down.visible, abs(float(depth_exact(rig, 0.3, *pixels).depth_m) - 2.0) < 1e-9)
print(MirrorEntry(shape="oblate", conic=0.3).rig(0.05).mirror.profile.conic)
"""

# A study: its folder is its command. Its page is written by hand, its document by a full run.

STUDY = '''"""Study `echo`: its own setting."""

import polars as pl

from phibench.studies.framework import Finding, Settings, Study, StudyDatasets, StudyResult


class EchoSettings(Settings):
    """Settings of the study."""

    depth_m: float


def run(settings: EchoSettings, datasets: StudyDatasets) -> StudyResult:
    """Run the study."""
    table = pl.DataFrame({"depth_m": [settings.depth_m]})
    return StudyResult({"table": table}, (Finding("depth", settings.depth_m, unit="m"),))


STUDY = Study("echo", "Echo", "Does a setting come back?", EchoSettings, run)
'''
STUDY_PAGE = """# Echo

<!-- from: depth; settings.depth_m -->
The setting of 2.5 m comes back as 2.5 m.
"""


def add_study(copy: Copy) -> None:
    folder = copy.root / "studies" / "echo"
    folder.mkdir()
    (folder / "study.py").write_text(STUDY, encoding="utf-8")
    (folder / "settings.toml").write_text("depth_m = 2.5\n\n[quick]\ndepth_m = 1.5\n", encoding="utf-8")
    page = copy.root / "docs" / "studies" / "echo.md"
    page.parent.mkdir(parents=True)
    page.write_text(STUDY_PAGE, encoding="utf-8")


USE_STUDY = """
import pathlib
from phibench.cli.main import main
from phibench.cli.studies import study_sentences
print(study_sentences()["echo"], main(["study", "echo", "--quick", "--out", "echo"]))
print([line for line in pathlib.Path("echo/findings.md").read_text().splitlines() if "depth" in line])
print(main(["study", "echo", "--out", "echo-full", "--publish", "docs/studies"]))
"""

# A method: it is listed, completed and called. Its function is there already; one of one's own needs no entry.


def add_method(copy: Copy) -> None:
    function = 'each_spot(at_the_red_peak("laplacian_blob"), hints=True)'
    entry = f'BuiltIn("faint_blob", {function}, "a blob", "a test"),\n    '.replace('("faint', '(\n        "faint', 1)
    copy.edit(
        "estimator/methods/registry.py",
        ('BuiltIn(\n        "red_centroid"', f'{entry}BuiltIn(\n        "red_centroid"'),
    )


USE_METHOD = """
import numpy as np
from phibench.cli.main import main
from phibench.benchmark.isolation.easy_pairs import EasyPairs
from phibench.estimator.methods.registry import METHODS
pairs = EasyPairs("srgb8")
print(np.hypot(*np.subtract(METHODS["faint_blob"](pairs.pair(0)).down.uv_px, pairs.truth(0).down.uv_px)) < 0.5)
main(["__complete", "score", "x", "--method", "faint"])
"""

# A source of rooms: a recipe lists it, the plan deals samples to it, and its document gives the same room.

ROOM = '''@dataclass(frozen=True)
class BareRoom:
    """A room of the catalogue without boards."""

    name: str
    kind: Literal["bare"] = "bare"

    def build(self, folder: Path | None = None) -> Room:
        """The room itself."""
        return ROOMS[self.name](())


@dataclass(frozen=True)
class UnexportedRoom'''
TABLE = '''class BareTable(Table):
    """One bare room."""

    name: str


class RoomsTable(Table):'''


def add_rooms(copy: Copy) -> None:
    copy.edit(
        "datasets/rooms/room_sources.py",
        ("@dataclass(frozen=True)\nclass UnexportedRoom", ROOM),
        ("| MeshRoom | UnexportedRoom", "| MeshRoom | BareRoom | UnexportedRoom"),
    )
    field = "bare: Annotated[tuple[BareTable, ...], Field(strict=False)] = ()\n    "
    copy.edit(
        "datasets/recipe/room_tables.py",
        ("class RoomsTable(Table):", TABLE),
        ("exported_panoramas: int", f"{field}exported_panoramas: int"),
    )
    bare = '[(f"bare{k}", BareRoom(one.name)) for k, one in enumerate(table.bare)]'
    copy.edit(
        "datasets/plan/draws.py",
        ("    GeneratedRoom,\n", "    BareRoom,\n    GeneratedRoom,\n"),
        ("zip_longest(generated, panoramas, meshes)", f"zip_longest(generated, panoramas, meshes, {bare})"),
    )
    recipe = (ROOT / "tests" / "tiny_worlds.toml").read_text(encoding="utf-8")
    rooms = re.compile(r"\[rooms\]\ncount = 2\n\n\[rooms.properties\]\n(\w.*\n)*")
    recipe, count = rooms.subn('[[rooms.bare]]\nname = "lab"\n', recipe)
    assert count == 1
    (copy.root / "bare.toml").write_text(recipe, encoding="utf-8")


USE_ROOMS = """
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.recipe.load import load_recipe
from phibench.datasets.rooms.room_sources import SOURCES
from phibench.datasets.store.json_forms import from_json, to_json
plan = make_plan(load_recipe("bare.toml"))
again = from_json(SOURCES["bare"], to_json(plan.rooms["bare0"]))
print(list(plan.rooms), {pair.room for pair in plan.pairs}, plan.room("bare0").digest == again.build().digest)
"""

ADDITIONS = {
    "preset": Addition(
        add_preset,
        ("render/sensor/settings_presets.toml",),
        USE_PRESET,
        "255 True\n('night-raw8',) True True\nTrue\nnight-raw8\n",
    ),
    "conic": Addition(add_conic, ("datasets/recipe/mirror_tables.py",), USE_CONIC, "True\n0.2 True True\n0.3\n"),
    "study": Addition(
        add_study,
        ("studies/echo/settings.toml", "studies/echo/study.py"),
        USE_STUDY,
        "Its own setting. 0\n['| depth | 1.50 | m |']\n",
    ),
    "method": Addition(add_method, ("estimator/methods/registry.py",), USE_METHOD, "True\nfaint_blob\n"),
    "source of rooms": Addition(
        add_rooms,
        ("datasets/plan/draws.py", "datasets/recipe/room_tables.py", "datasets/rooms/room_sources.py"),
        USE_ROOMS,
        "['bare0'] {'bare0'} True\n",
    ),
}
EACH = """
import contextlib, io, json, sys, traceback
said = {}
for name, code in json.loads(sys.argv[1]).items():
    with contextlib.redirect_stdout(io.StringIO()) as out:
        try:
            exec(code, {})
        except BaseException:
            print(traceback.format_exc())
    said[name] = out.getvalue()
print(json.dumps(said))
"""


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Copy:
    return Copy.of_checkout(tmp_path_factory.mktemp("adding") / "checkout")


@pytest.fixture(scope="module")
def outcome(copy: Copy) -> dict[str, tuple[set[str], str]]:
    """Files that each addition took, and what its use said."""
    took: dict[str, set[str]] = {}
    for name, addition in ADDITIONS.items():
        before = copy.added()
        addition.add(copy)
        took[name] = copy.added() - before
    said = json.loads(copy.run(EACH, json.dumps({name: addition.use for name, addition in ADDITIONS.items()})))
    return {name: (took[name], said[name]) for name in ADDITIONS}


@pytest.mark.parametrize("name", ADDITIONS)
def test_each_is_added_in_few_files_and_works(name: str, outcome: dict[str, tuple[set[str], str]]) -> None:
    took, said = outcome[name]
    assert took == set(ADDITIONS[name].files)
    assert set(ADDITIONS[name].says.splitlines()) <= set(said.splitlines()), said


def test_the_page_of_the_study_holds(outcome: dict[str, tuple[set[str], str]], copy: Copy) -> None:
    assert outcome["study"][1].endswith("\n0\n")
    published = Published(copy.root / "docs" / "studies")
    assert published.wrong("echo", STUDY_PAGE) == ([], 2)
    assert len(published.wrong("echo", STUDY_PAGE.replace("2.5 m.", "2.6 m."))[0]) == 1


def test_the_page_says_how_many() -> None:
    """Rows of CONTRIBUTING.md's table: what, number of files, and the files."""
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| (?:an? )?(?:sensor )?([\w ,]+?) \| (\d)(?: and a page)? \|", page, re.MULTILINE))
    assert {name: int(rows[name]) for name in ("preset", "conic", "method", "source of rooms")} == {
        name: len(ADDITIONS[name].files) for name in ("preset", "conic", "method", "source of rooms")
    }
    assert "| a study | 1 folder |" in page


# A mirror of a new kind: its factories are where it is added.


def test_the_type_of_a_mirror_is_asked_for_by_its_factories() -> None:
    """Of other places only `Rig.sphere` and `Rig.revolved` ask, which refuse in one sentence."""
    pattern = re.compile(rf"isinstance\([^)]*\b(?:{MIRRORS})\b|case (?:{MIRRORS})\(")
    files = (file for district in DISTRICTS for file in sorted((ROOT / district).rglob("*.py")))
    asked = [file.relative_to(ROOT).as_posix() for file in files for _ in pattern.findall(file.read_text("utf-8"))]
    factories = {
        "estimator/geometry/mirror_geometry.py",
        "render/optics/ray_tracer.py",
        "render/optics/reflection_point.py",
        "render/room/mirror_intersection.py",
    }
    assert [path for path in asked if path not in factories] == ["scenes/rig.py", "scenes/rig.py"]
    assert factories < set(asked)
    assert len(asked) <= 9  # a factory asks once for each kind
