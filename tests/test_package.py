"""The public interface: what `import phibench` gives, at which price, and the old names of one version."""

import ast
import html
import inspect
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

import phibench
from phibench.benchmark.isolation.run_limits import MethodError
from phibench.benchmark.isolation.runner import outcomes_here
from phibench.datasets.common.errors import DatasetError
from phibench.estimator import interface
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError

ROOT = Path(__file__).resolve().parent.parent
Python = Callable[..., subprocess.CompletedProcess[str]]
METHOD = """
import numpy as np
from phibench import Answer, Pair, Spot

def extract(pair: Pair) -> Answer:
    v, u = np.unravel_index(int(pair.down.argmax()), pair.down.shape)
    return Answer(Spot((float(u), float(v))), Spot.missing("not looked for"))
"""


def extract(pair: phibench.Pair) -> phibench.Answer:
    v, u = np.unravel_index(int(pair.down.argmax()), pair.down.shape)
    return phibench.Answer(phibench.Spot((float(u), float(v))), phibench.Spot.missing("not looked for"))


def test_the_public_names_are_there() -> None:
    assert {name: getattr(phibench, name) for name in ("Pair", "Answer", "Spot")} == {
        name: getattr(interface, name) for name in ("Pair", "Answer", "Spot")
    }
    assert len(set(phibench.__all__) - {"__version__"}) == 12
    assert set(phibench.__all__) <= set(dir(phibench))
    assert all(callable(getattr(phibench, name)) for name in phibench.__all__ if name != "__version__")
    with pytest.raises(AttributeError, match="no attribute 'open'; it has Answer"):
        phibench.open  # noqa: B018
    assert list(inspect.signature(phibench.score).parameters)[:3] == ["dataset", "method", "preset"]


def test_type_checkers_and_editors_see_the_same_names() -> None:
    """The block that only they read imports every public name from the module that gives it at run time."""
    tree = ast.parse(Path(phibench.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    seen = {alias.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert seen == phibench._HOMES
    assert set(seen) | {"__version__"} == set(phibench.__all__)


def test_the_page_names_every_public_name_and_no_other() -> None:
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8").split("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \|", page, re.M)
    assert sorted(rows) == sorted(phibench.__all__)


def test_the_import_loads_nothing_else(python: Python) -> None:
    child = python("import sys, phibench; print({'numpy', 'pydantic', 'phibench.datasets'} & set(sys.modules))")
    assert child.stdout.strip() == "set()", child.stderr
    # The set is not empty because nothing could be in it.
    child = python("import sys, phibench; phibench.Pair; print('numpy' in sys.modules)")
    assert child.stdout.strip() == "True", child.stderr


def test_no_public_name_loads_the_renderer(python: Python) -> None:
    child = python("import sys\nfrom phibench import *\nprint({'mitsuba', 'drjit', 'torch'} & set(sys.modules), make)")
    assert child.stdout.startswith("set() <function make"), child.stderr


def test_the_version_is_that_of_the_checkout(python: Python) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert phibench.__version__ == project["version"]
    said = python("from phibench.cli.main import main; main(['--version'])").stdout.strip()
    assert re.fullmatch(rf"phibench {project['version']}( \(commit [0-9a-f]{{10}}(, changed since)?\))?", said)
    assert ("commit" in said) == (ROOT / ".git").exists()


def test_the_citation_is_that_of_this_version() -> None:
    """CITATION.cff and README's BibTeX have the version of the project, the date of its changes, and one title."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    dates = re.findall(rf"^## \[{re.escape(version)}\] - (\d{{4}}-\d\d-\d\d)$", changes, re.M)
    card = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    cited = (card["title"], str(card["version"]), str(card["date-released"]))
    assert cited[1:] == (version, dates[0])
    (entry,) = re.findall(
        r"^@software\{phibench,\n(.*?)^\}$", (ROOT / "README.md").read_text(encoding="utf-8"), re.M | re.S
    )
    fields = dict(re.findall(r"(\w+) = \{(.*)\},?$", entry, re.M))
    assert (fields["title"], fields["version"], fields["date"]) == cited
    assert fields["year"] == cited[2][:4]


def test_the_module_is_the_command_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "phibench", "--help"]
    child = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert (child.returncode, child.stdout.split()[:3]) == (0, ["Usage:", "phibench", "COMMAND"]), child.stderr


def test_phi_is_that_of_the_rendered_truth(tiny_dataset: Path) -> None:
    """The renderer traces rays; the estimator solves the reflection. The file has float32: half of its step is 6e-8."""
    sample = phibench.open_dataset(tiny_dataset)[0]
    truth = sample.truth("up")
    v, u = np.nonzero(truth["object_id"] >= 0)
    assert len(u) > 100
    pixels = np.stack([u, v], axis=-1)
    for name in ("ray", "normal", "incidence"):
        found = phibench.phi(sample.view("up"), pixels, name)
        assert np.abs(found - truth[f"phi_{name}_rad"][v, u]).max() < 6.1e-8
    assert np.array_equal(phibench.phi(sample.rig, pixels[:5]), phibench.phi(sample.rig.at(0.0), pixels[:5]))
    assert phibench.phi(sample.rig, pixels[0]).shape == ()
    assert np.isnan(phibench.phi(sample.rig, (-1e4, 0.0)))


@pytest.mark.parametrize(
    ("uv", "convention", "reason"),
    [
        ((1.0, 2.0), "rays", "no convention 'rays' of phi; .*ray"),
        (3.0, "ray", r"uv_px: must be numbers of shape \(..., 2\)"),
        ((1.0, 2.0, 3.0), "ray", "uv_px"),
        ("middle", "ray", "uv_px"),
    ],
)
def test_phi_refuses_in_one_sentence(uv: object, convention: str, reason: str) -> None:
    with pytest.raises(SceneError, match=reason):
        phibench.phi(Rig(), uv, convention)


def test_every_result_is_shown_by_a_short_table(tiny_dataset: Path) -> None:
    """At the end of a cell: at most 25 lines of 120 characters, as text and in a notebook."""
    dataset = phibench.open_dataset(tiny_dataset)
    sample = dataset[0]
    spots = [phibench.find_spot(sample.expected_image(place)) for place in ("down", "up")]
    many = [np.tile(spot.uv_px, (1000, 1)) for spot in spots]
    easy, answer = phibench.EasyPairs(count=2), phibench.Answer(phibench.Spot((1.0, 2.0)), phibench.Spot.missing("no"))
    results = [
        dataset,
        dataset[:1],
        sample,
        sample.spot("down"),
        sample.camera_frames("mono-raw"),
        *spots,
        phibench.depth_exact(sample.rig, sample.row.stroke_m, spots[0].uv_px, spots[1].uv_px),
        phibench.depth_exact(sample.rig, sample.row.stroke_m, *many),
        easy,
        easy.pair(0),
        easy.truth(0),
        dataset.pairs("mono-raw"),
        phibench.PairDataset(tiny_dataset, "mono-raw"),
        answer,
        answer.down,
        phibench.score(easy_set := dataset[:1], "red_centroid", "mono-raw", draws=1),
    ]
    assert len(easy_set) == 1
    for result in results:
        lines = repr(result).splitlines()
        assert len(lines) <= 25, type(result)
        assert max(map(len, lines)) <= (260 if result is answer else 120), type(result)
        assert result._repr_html_() == f"<pre>{html.escape(repr(result))}</pre>"
    assert "red_centroid: 1 pair mono-raw" in repr(results[-1])
    assert "rms error" in repr(results[-1])
    assert repr(results[6 - 1]).splitlines()[1] == f"  position  ({spots[0].uv_px[0]:.6g}, {spots[0].uv_px[1]:.6g}) px"


def test_a_function_and_its_file_get_the_same_score(bench_dataset: Path, tmp_path: Path) -> None:
    file, out = tmp_path / "mine.py", tmp_path / "mine.json"
    file.write_text(METHOD)
    theirs = phibench.score(bench_dataset, f"{file}:extract", "mono-raw", draws=1, out=out)
    ours = phibench.score(phibench.open_dataset(bench_dataset), extract, "mono-raw", draws=1)
    columns = [name for name in ours.records.columns if not name.startswith("seconds")]
    assert len(columns) > 10
    assert ours.records.select(columns).equals(theirs.records.select(columns))
    assert len(ours.records) == len(theirs.records) > 0
    assert (ours.document.method.name, ours.document.method.kind) == ("extract", "function")
    assert out.is_file()
    assert theirs.document.records == "mine.parquet"


def test_a_part_of_a_data_set_is_scored(bench_dataset: Path) -> None:
    dataset = phibench.open_dataset(bench_dataset)
    scored = phibench.score(dataset[:1], extract, "mono-raw", draws=1)
    assert set(scored.records["sample_id"]) == {dataset[0].row.sample_id}


def test_mistakes_of_a_function_are_failures_of_its_pairs(bench_dataset: Path) -> None:
    def wrong(pair: phibench.Pair) -> phibench.Answer:
        raise ValueError("no spot")

    def writes(pair: phibench.Pair) -> phibench.Answer:
        pair.down[0, 0] = 1
        return extract(pair)

    dataset = phibench.open_dataset(bench_dataset)[:1]
    for method, failure in ((wrong, "error"), (writes, "mutated"), (lambda pair: 3, "invalid")):
        document = phibench.score(dataset, method, "mono-raw", draws=1).document
        assert document.failures[failure] == document.pairs > 0
    with pytest.raises(MethodError, match="FILE"):
        phibench.score(dataset, extract, "mono-raw", workers=2)
    with pytest.raises(MethodError, match="must take one pair"):
        outcomes_here(lambda: extract)  # type: ignore[arg-type, misc]
    with pytest.raises(DatasetError, match="there is no folder"):
        phibench.score("nowhere", extract)


@pytest.mark.parametrize(
    ("options", "processes"),
    [
        ({}, 2),
        ({"keyword": "accuracy_of_the_fit"}, None),
        ({"keyword": ""}, None),
        ({"numprocesses": 0}, 0),
        ({"capture": "no"}, None),
        ({"usepdb": True}, None),
    ],
)
def test_two_processes_share_the_proofs_of_readme(
    options: dict[str, object], processes: int | None, pytestconfig: pytest.Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`pytest -k accuracy`, as README has it; what is printed (`-s`) or debugged stays in one."""
    (ours,) = (plugin for plugin in pytestconfig.pluginmanager.get_plugins() if hasattr(plugin, "PROOFS"))
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    monkeypatch.setattr("os.cpu_count", lambda: 4)
    told = {"keyword": "accuracy", "numprocesses": None, "capture": "fd", "usepdb": False, "dist": "no", **options}
    config = SimpleNamespace(option=SimpleNamespace(**told))
    ours.pytest_cmdline_main(config)
    assert config.option.numprocesses == processes
    assert (config.option.dist == "worksteal") == (processes == 2)


def test_only_files_without_the_word_are_left_unread_for_the_proofs(pytestconfig: pytest.Config) -> None:
    (ours,) = (plugin for plugin in pytestconfig.pluginmanager.get_plugins() if hasattr(plugin, "PROOFS"))
    proofs, others = (SimpleNamespace(option=SimpleNamespace(keyword=word)) for word in ("accuracy", "phi"))
    files = sorted((ROOT / "tests").rglob("test_*.py"))
    read = {file for file in files if not ours.pytest_ignore_collect(file, proofs)}
    assert {file for file in files if "def test_accuracy" in file.read_text(encoding="utf-8")} <= read
    assert set((ROOT / "tests" / "accuracy").glob("test_*.py")) <= read
    assert len(read) < len(files) / 2
    assert not any(ours.pytest_ignore_collect(file, others) for file in files)
