"""What several test files share."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

# before NumPy is loaded: small matrices gain nothing from threads, and lose much where tests share the cores
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import pytest  # noqa: E402
from helpers.inline_workers import InlineCrew  # noqa: E402

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def python() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run code in a fresh interpreter, from the root of the checkout; keywords set environment variables."""

    def run(code: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", code, *arguments]
        merged = {**os.environ, **environment}
        return subprocess.run(command, cwd=ROOT, env=merged, capture_output=True, text=True, timeout=300, check=False)

    return run


@pytest.fixture
def inline(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `make` do its tasks in this process."""
    monkeypatch.setattr("phibench.datasets.make.Crew", InlineCrew)


@pytest.fixture(scope="session")
def tiny_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data set of `tests/tiny.toml`, rendered once by two workers. Read only: copy it to change it."""
    from phibench.datasets.make import make

    return make(ROOT / "tests" / "tiny.toml", tmp_path_factory.mktemp("tiny") / "out", workers=2)


@pytest.fixture(scope="session")
def smallest_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data set of `tests/smallest.toml`, rendered once by two workers. Read only: copy it to change it."""
    from phibench.datasets.make import make

    return make(ROOT / "tests" / "smallest.toml", tmp_path_factory.mktemp("smallest") / "out", workers=2)


@pytest.fixture(scope="session")
def misaligned_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data set of `tests/tiny.toml` with a tilt, a decentre, a form, a stroke too long and a yaw between the images."""
    from phibench.datasets.make import make

    folder, text = tmp_path_factory.mktemp("misaligned"), (ROOT / "tests" / "tiny.toml").read_text(encoding="utf-8")
    wrong = (
        "tilt_x_rad = 0.01",
        "decentre_y_m = 2e-3",
        "form_31c_m = 5e-5",
        "stroke_relative = 0.01",
        "yaw_rad = 0.02",
    )
    table = "\n".join(("[misalignment]", *wrong, "", ""))
    (folder / "recipe.toml").write_text(text.replace("[[targets]]", f"{table}[[targets]]", 1), encoding="utf-8")
    return make(folder / "recipe.toml", folder / "out", workers=2)


@pytest.fixture(scope="session")
def smoke_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data set of the shipped recipe `smoke`, rendered once. Read only: copy it to change it."""
    from phibench.datasets.make import make

    return make("smoke", tmp_path_factory.mktemp("smoke") / "out", workers=2)


@pytest.fixture(scope="session")
def bench_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data set of `tests/tiny_bench.toml`, rendered once. Read only: copy it to change it."""
    from phibench.datasets.make import make

    return make(ROOT / "tests" / "tiny_bench.toml", tmp_path_factory.mktemp("bench") / "out", workers=2)


@pytest.fixture(scope="session")
def method(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Reference of a method in a file: the brightest pixel; it fails on pair 1."""
    from helpers.sealed_sets import METHOD

    file = tmp_path_factory.mktemp("method") / "mine.py"
    file.write_text(METHOD)
    return f"{file}:extract"


@pytest.fixture(scope="session")
def sealed(bench_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Sealed set of 9 pairs, with its truth. Read only: copy it to change it."""
    from rich.console import Console

    from phibench.estimator.benchmark.sealed_set import seal

    folder = tmp_path_factory.mktemp("private")
    shutil.copytree(bench_dataset, folder / "set")
    return seal(folder / "set", folder / "public", console=Console(quiet=True))


@pytest.fixture(scope="session")
def submitted(sealed: Any, method: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Submission of `method` to `sealed`."""
    from phibench.estimator.benchmark.submission import submit

    out = tmp_path_factory.mktemp("submission") / "submission.json"
    done = submit(sealed.public, method, out)
    assert (done.pairs, done.answered) == (9, 8)
    return out
