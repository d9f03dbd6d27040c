"""Values that the Tab key completes: those that there are, by what is typed, without slow imports."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import pytest

from phibench.cli import main as cli
from phibench.cli import options

Python = Callable[..., subprocess.CompletedProcess[str]]


def completed(words: list[str], capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Values that the shell is offered for the last word."""
    capsys.readouterr()
    assert cli.main(["__complete", *words]) == 0
    lines = capsys.readouterr().out.splitlines()
    return [line.split("\t")[0] for line in lines if line and not line.startswith("\x1f")]


def test_values_that_are_completed_are_those_that_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    from phibench.benchmark.isolation.method_references import GROUP
    from phibench.benchmark.release.release_parts import PARTS
    from phibench.datasets.recipe.tables import Preset
    from phibench.estimator.methods.registry import KNOWN
    from phibench.robot.loop.policies import POLICIES

    assert completed(["score", "x", "--preset", ""], capsys) == list(get_args(Preset))
    assert completed(["score", "x", "--method", ""], capsys)[: len(KNOWN)] == list(KNOWN)
    assert options.POLICIES == tuple(POLICIES)
    assert options.PARTS == tuple(part.name for part in PARTS)
    assert {f"{options.TITLE}{part}" for part in options.PARTS} == {part.title for part in PARTS}
    assert options.METHOD_PACKAGES == GROUP


@pytest.mark.parametrize(
    ("line", "some", "none"),
    [
        ("dataset make ", "bench-dev smoke mine.toml", "bench-films deep/other.toml"),
        ("dataset make de", "deep/other.toml", "mine.toml"),
        ("dataset make deep/", "deep/other.toml", "mine.toml"),
        ("film make ", "bench-films mine.toml", "bench-dev"),
        ("recipe show ", "bench-dev bench-films", "mine.toml"),
        ("score x --preset ", "mjpeg mono-raw", "ideal"),
        ("dataset frames x --preset ", "mjpeg yuyv", "layers"),
        ("dataset panorama x --preset ", "layers mjpeg", "yuyv"),
        ("film show x --preset ", "mjpeg yuyv", "ideal"),
        ("score x --method ", "chain_fit detect mine.py", "mine.toml"),
        ("score x --method chain_fit --method ", "chain_fit detect mine.py", "mine.toml"),
        ("bench x --method ", "chain_fit detect", "mine.py"),
        ("method check ", "chain_fit mine.py", "mine.toml"),
        ("fetch ", "dev phibench-v4-dev drives", "mine.py"),
        ("release --part ", "dev drives", "phibench-v4-dev"),
        ("loop run ", "greedy random mine.py", "mine.toml"),
        ("loop run --policy ", "greedy random mine.py", "mine.toml"),
    ],
)
def test_values_are_completed(
    line: str, some: str, none: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("mine.toml", "mine.py", "deep/other.toml", ".hidden.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    values = completed(line.split(" "), capsys)
    assert set(some.split()) <= set(values)
    assert not {*none.split(), ".hidden.py"} & set(values)


@pytest.mark.slow
def test_bash_asks_for_values(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The script of bash calls the command, whose name is on the path."""
    assert cli.main(["completion", "bash"]) == 0
    script = tmp_path / "phibench.bash"
    script.write_text(capsys.readouterr().out)
    command = tmp_path / "phibench"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m phibench "$@"\n')
    command.chmod(0o755)
    line = "COMP_WORDS=(phibench score x --method ch); COMP_CWORD=4; _phibench; echo ${COMPREPLY[*]}"
    bash = ["bash", "--noprofile", "--norc", "-c", f"source {script}\n{line}"]
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    child = subprocess.run(
        bash, capture_output=True, text=True, timeout=60, check=False, env={**os.environ, "PATH": path}
    )
    assert (child.stdout, child.stderr) == ("chain_fit\n", "")


def test_completion_imports_nothing_slow(python: Python) -> None:
    """A Tab key waits for it: 0.25 CPU-s, half of them for the parser of arguments."""
    slow = "numpy scipy polars pydantic mitsuba drjit PIL skimage pooch requests dask"
    child = python(
        "import sys\nfrom phibench.cli.main import main\n"
        f"main(sys.argv[1:])\nprint([name for name in '{slow}'.split() if name in sys.modules])",
        *("__complete", "score", "x", "--method", ""),
    )
    assert "chain_fit" in child.stdout
    assert child.stdout.splitlines()[-1] == "[]"


@pytest.mark.slow
def test_the_script_of_zsh_calls_what_it_defines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As a file of `fpath` it is the function `_phibench` itself; sourced, it names its function to `compdef`."""
    assert cli.main(["completion", "zsh"]) == 0
    script = tmp_path / "_phibench"
    script.write_text(capsys.readouterr().out)
    if (zsh := shutil.which("zsh")) is None:
        assert script.read_text().rstrip().endswith("fi")
        assert '_cyclopts_phibench "$@"' in script.read_text()
        return
    start = f"fpath=({tmp_path} $fpath); autoload -Uz _phibench; _arguments() {{ print called; }}; "
    for code, said in (
        (f"{start}words=(phibench ''); CURRENT=2; _phibench; exit 0", "called"),
        (f"compdef() {{ print $*; }}; source {script}; exit 0", "_cyclopts_phibench phibench"),
    ):
        child = subprocess.run([zsh, "-f", "-c", code], capture_output=True, text=True, check=False)
        assert said in child.stdout, child.stderr
