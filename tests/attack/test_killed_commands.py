"""Commands that are killed leave folders behind; the same command again finishes, and removes them."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers.processes import SMALLEST

pytestmark = pytest.mark.slow


def start(temporary: Path, *tokens: object) -> "subprocess.Popen[bytes]":
    temporary.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "phibench", *map(str, tokens)]
    return subprocess.Popen(command, env={**os.environ, "TMPDIR": str(temporary)}, stderr=subprocess.DEVNULL)


def kill_when_there(child: "subprocess.Popen[bytes]", folder: Path, pattern: str, stop: int) -> None:
    """Send a signal as soon as a folder of the command lies there."""
    deadline = time.monotonic() + 120.0
    while not list(folder.glob(pattern)):
        assert child.poll() is None, "the command ended too early"
        assert time.monotonic() < deadline
        time.sleep(0.01)
    child.send_signal(stop)
    assert child.wait(60) != 0


def left_by_phibench(folder: Path) -> list[str]:
    """Names in a folder that are ours."""
    return sorted(path.name for path in folder.iterdir() if "phibench" in path.name)


@pytest.mark.parametrize("stop", [signal.SIGKILL, signal.SIGTERM])
def test_make(tmp_path: Path, stop: int) -> None:
    temporary, out = tmp_path / "temporary", tmp_path / "out"
    order = ("dataset", "make", SMALLEST, "--out", out, "--workers", 1)
    kill_when_there(start(temporary, *order), out, "log.jsonl", stop)
    assert start(temporary, *order).wait(300) == 0
    assert left_by_phibench(temporary) == []
    assert left_by_phibench(out) == []


def test_seal(secret_dataset: Path, tmp_path: Path) -> None:
    shutil.copytree(secret_dataset, tmp_path / "set")
    beside = tmp_path / "beside"
    beside.mkdir()
    order = ("seal", "make", tmp_path / "set", "--out", beside / "public")
    kill_when_there(start(tmp_path / "temporary", *order), beside, ".phibench-tmp-seal-*/frames/*", signal.SIGKILL)
    assert len(left_by_phibench(beside)) == 1
    assert start(tmp_path / "temporary", *order).wait(300) == 0
    assert [path.name for path in beside.iterdir()] == ["public"]
