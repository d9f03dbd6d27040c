"""What is handed out: source distribution, wheel, container, conda recipe, workflow, and the Pythons that they name."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("phibench", "scenes", "render", "datasets", "estimator")
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
    """Data beside the code (templates, recipes, tables, weights) belongs to a package and fits one of its patterns."""
    setuptools = project()["tool"]["setuptools"]
    patterns, folders = setuptools["package-data"], setuptools["package-dir"]
    left_out, kinds = [], set()
    for file in shipped():
        if file.suffix == ".py":
            continue
        package = next((name for name, folder in folders.items() if Path(folder) == file.parent), "")
        kinds.add(file.suffix)
        if not any(fnmatch(file.name, pattern) for pattern in [*patterns["*"], *patterns.get(package, ())]):
            left_out.append(file.as_posix())
        assert package in setuptools["packages"], f"{file.parent} is no package of pyproject.toml"
    assert {".toml", ".j2", ".csv", ".md", ".typed"} <= kinds
    assert left_out == []


def test_every_folder_with_code_is_typed() -> None:
    folders = {file.parent for file in shipped() if file.suffix == ".py"}
    assert len(folders) > 30
    assert [folder.as_posix() for folder in sorted(folders) if not (ROOT / folder / "py.typed").is_file()] == []


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
    assert {"docs", "dist", "test-base"} <= named
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


@pytest.mark.slow
def test_a_wheel_scores_in_a_clean_environment(bench_dataset: Path, tmp_path: Path) -> None:
    """Source distribution, wheel from it, an environment without Mitsuba, a method written, checked and scored."""

    def run(*command: object, cwd: Path = tmp_path) -> str:
        words = [str(word) for word in command]
        child = subprocess.run(words, cwd=cwd, env=own, capture_output=True, text=True, timeout=900, check=False)
        assert child.returncode == 0, child.stdout + child.stderr
        return child.stdout

    own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    run(sys.executable, "-m", "build", "--outdir", tmp_path / "dist", ROOT)
    wheel, source = (next((tmp_path / "dist").glob(f"*.{end}")) for end in ("whl", "tar.gz"))
    inside = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert inside == {place(file) for file in shipped()}
    with tarfile.open(source) as archive:
        there = {name.partition("/")[2] for name in archive.getnames()}
    needed = {"Makefile", "constraints.txt", "tests/conftest.py", "docs/install.md", ".ci/run", "CITATION.cff"}
    assert needed | {file.as_posix() for file in shipped()} <= there

    venv.create(tmp_path / "clean", with_pip=True)
    run(tmp_path / "clean/bin/pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt", wheel)
    phibench, elsewhere = tmp_path / "clean/bin/phibench", tmp_path / "elsewhere"
    elsewhere.mkdir()
    shutil.copytree(bench_dataset, tmp_path / "data")
    assert run(phibench, "--version", cwd=elsewhere) == f"phibench {project()['project']['version']}\n"
    code = "import importlib.util as u; print(u.find_spec('mitsuba'))"
    assert run(tmp_path / "clean/bin/python", "-c", code, cwd=elsewhere) == "None\n"
    run(phibench, "method", "new", "my_phi.py", cwd=elsewhere)
    assert "nothing wrong" in run(phibench, "method", "check", "my_phi.py:extract", cwd=elsewhere)
    method = ("--method", "my_phi.py:extract", "--preset", "mono-raw", "--draws", "1")
    run(phibench, "score", tmp_path / "data", *method, "--out", "mine.json", cwd=elsewhere)
    assert (elsewhere / "mine.json").is_file()
    assert (elsewhere / "mine.parquet").is_file()
