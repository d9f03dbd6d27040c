"""What several test files share."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def python() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run code in a fresh interpreter, from the root of the checkout; keywords set environment variables."""

    def run(code: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", code, *arguments]
        merged = {**os.environ, **environment}
        return subprocess.run(command, cwd=ROOT, env=merged, capture_output=True, text=True, timeout=300, check=False)

    return run


@pytest.fixture(scope="session")
def tiny_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data set of `tests/tiny.toml`, rendered once by two workers. Read only: copy it to change it."""
    from phibench.datasets.make import make

    return make(ROOT / "tests" / "tiny.toml", tmp_path_factory.mktemp("tiny") / "out", workers=2)


@pytest.fixture(scope="session")
def smoke_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data set of the shipped recipe `smoke`, rendered once. Read only: copy it to change it."""
    from phibench.datasets.make import make

    return make("smoke", tmp_path_factory.mktemp("smoke") / "out", workers=2)
