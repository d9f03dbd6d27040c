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
