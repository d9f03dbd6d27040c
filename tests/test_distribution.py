"""What is handed out: source distribution, wheel, container, conda recipe, workflow, and the Pythons that they name."""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import threading
import tomllib
import venv
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from fnmatch import fnmatch
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.districts import DISTRICTS
from helpers.small_release import ask, part_of

from phibench.benchmark.release.release_make import release
from phibench.benchmark.sealed.sealed_set import seal

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("phibench", *DISTRICTS)
WORKFLOW = ROOT / ".github" / "workflows" / "checks.yml"


def project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def shipped() -> Iterator[Path]:
    """Every file of the five folders that is written, not made, relative to the root."""
    for folder in FOLDERS:
        for file in sorted((ROOT / folder).rglob("*")):
            if file.is_file() and "__pycache__" not in file.parts and file.suffix != ".pyc":
                yield file.relative_to(ROOT)


def place(file: Path) -> str:
    """Place in the wheel of a file of the checkout."""
    return file.as_posix() if file.parts[0] == "phibench" else f"phibench/{file.as_posix()}"


def test_the_wheel_takes_every_file_of_the_package() -> None:
    """Data beside the code (templates, recipes, tables, weights) fits one of the patterns."""
    patterns = project()["tool"]["setuptools"]["package-data"]["*"]
    data = [file for file in shipped() if file.suffix != ".py"]
    assert {".toml", ".j2", ".csv", ".md", ".typed"} <= {file.suffix for file in data}
    assert [file.as_posix() for file in data if not any(fnmatch(file.name, pattern) for pattern in patterns)] == []
    assert (ROOT / "phibench" / "py.typed").is_file()


def requirements(lines: list[str]) -> dict[str, str]:
    """Lowest version of every requirement, by its name in lower case."""
    return {name.lower(): low for name, low in (re.split(r"\s*>=\s*", line) for line in lines)}


def test_the_conda_recipe_asks_for_what_the_package_asks_for() -> None:
    recipe, here = yaml.safe_load((ROOT / ".ci" / "recipe.yaml").read_text(encoding="utf-8")), project()["project"]
    assert recipe["context"]["version"] == here["version"]
    other_names = {"matplotlib-base": "matplotlib", "openexr-python": "openexr"}
    asked = requirements(recipe["requirements"]["run"])
    assert f">={asked.pop('python')}" == here["requires-python"]
    assert {other_names.get(name, name): low for name, low in asked.items()} == requirements(here["dependencies"])
    entry = recipe["build"]["python"]["entry_points"]
    assert dict(line.split(" = ") for line in entry) == here["scripts"]


def test_the_workflow_runs_targets_that_exist_on_every_python() -> None:
    jobs = yaml.safe_load(WORKFLOW.read_text(encoding="utf-8"))["jobs"]
    runs = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    named = {match[1] for run in runs for match in re.finditer(r"^make ([a-z-]+)", run)}
    assert {"docs", "dist", "test-base", "test-wheel"} <= named
    assert named - targets == set()
    assert "bash .ci/run" in runs
    classifiers = [line.rpartition(" :: ")[2] for line in project()["project"]["classifiers"]]
    pythons = [version for version in classifiers if re.fullmatch(r"3\.\d+", version)]
    assert jobs["base"]["strategy"]["matrix"]["python"] == pythons
    assert f">={pythons[0]}" == project()["project"]["requires-python"]


def test_the_container_copies_and_makes_what_is_there() -> None:
    text = (ROOT / ".ci" / "Containerfile").read_text(encoding="utf-8")
    assert "make setup" in text
    assert "ENTRYPOINT" in text
    copied = [word for line in re.findall(r"^COPY (.*) \S+$", text, re.M) for word in line.split()]
    assert copied
    assert [word for word in copied if not (ROOT / word).exists()] == []


def run(*command: object, cwd: Path) -> str:
    """Output of a command that must succeed, without the checkout on its path."""
    own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    words = [str(word) for word in command]
    child = subprocess.run(words, cwd=cwd, env=own, capture_output=True, text=True, timeout=900, check=False)
    assert child.returncode == 0, child.stdout + child.stderr
    return child.stdout


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the source distribution and of the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("distributions")
    run(sys.executable, "-m", "build", "--outdir", folder, ROOT, cwd=folder)
    return folder


@pytest.fixture(scope="module")
def clean(distributions: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the programs of an environment that has the wheel alone, with what it asks for."""
    folder = tmp_path_factory.mktemp("clean")
    venv.create(folder, with_pip=True)
    wheel = next(distributions.glob("*.whl"))
    run(folder / "bin/pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt", wheel, cwd=folder)
    code = "import importlib.util as u; print([name for name in ('mitsuba', 'drjit') if u.find_spec(name)])"
    assert run(folder / "bin/python", "-c", code, cwd=folder) == "[]\n"
    return folder / "bin"


@pytest.mark.slow
def test_distributions_hold_what_they_should(distributions: Path) -> None:
    wheel, source = (next(distributions.glob(f"*.{end}")) for end in ("whl", "tar.gz"))
    inside = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert inside == {place(file) for file in shipped()}
    with tarfile.open(source) as archive:
        there = {name.partition("/")[2] for name in archive.getnames()}
    needed = {"Makefile", "constraints.txt", "tests/conftest.py", "docs/install.md", ".ci/run", "CITATION.cff"}
    assert needed | {file.as_posix() for file in shipped()} <= there


@pytest.mark.slow
def test_a_wheel_scores_in_a_clean_environment(clean: Path, bench_dataset: Path, tmp_path: Path) -> None:
    """A method written, checked and scored without Mitsuba; the score names the wheel's version."""
    phibench, elsewhere = clean / "phibench", tmp_path / "elsewhere"
    elsewhere.mkdir()
    shutil.copytree(bench_dataset, tmp_path / "data")
    version = f"phibench {project()['project']['version']}"
    assert run(phibench, "--version", cwd=elsewhere) == f"{version}\n"
    run(phibench, "method", "new", "my_phi.py", cwd=elsewhere)
    assert "nothing wrong" in run(phibench, "method", "check", "my_phi.py:extract", cwd=elsewhere)
    method = ("--method", "my_phi.py:extract", "--preset", "mono-raw", "--draws", "1")
    run(phibench, "score", tmp_path / "data", *method, "--out", "mine.json", cwd=elsewhere)
    assert (elsewhere / "mine.parquet").is_file()
    score = json.loads((elsewhere / "mine.json").read_text(encoding="utf-8"))
    assert score["program"] == version
    assert score["method"]["packages"]["phibench"] == score["provenance"]["packages"]["phibench"] == version.split()[1]


@pytest.mark.slow
def test_a_wheel_fetches_verifies_and_scores_rooms_of_three_kinds(
    clean: Path, kinds_dataset: Path, tmp_path: Path
) -> None:
    """From a release on the loopback: a generated room, a panorama and a mesh, read without the renderer."""
    made = release(ask(tmp_path, [part_of("kinds", "tiny_kinds.toml", "pairs")], use=[kinds_dataset]), seal)
    assert list(made.manifest.parts) == ["phibench-v4-kinds"]
    phibench = clean / "phibench"
    with loopback(tmp_path / "public") as address:
        run(phibench, "fetch", "kinds", "--from", address, "--out", "set", cwd=tmp_path)
    rooms = [json.loads(line) for line in (tmp_path / "set" / "rooms.jsonl").read_text().splitlines()]
    assert {room["source"]["kind"] for room in rooms} == {"generated", "panorama", "mesh"}
    run(phibench, "dataset", "verify", "set", cwd=tmp_path)
    run(phibench, "score", "set", "--method", "detect", "--preset", "bayer-raw", "--out", "mine.json", cwd=tmp_path)
    score = json.loads((tmp_path / "mine.json").read_text(encoding="utf-8"))
    assert (score["pairs"], sum(score["failures"].values())) == (3, 0)


@contextmanager
def loopback(folder: Path) -> Iterator[str]:
    """Serve a folder on the loopback; its address."""
    handler = partial(SimpleHTTPRequestHandler, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}/"
        finally:
            server.shutdown()
            thread.join()
