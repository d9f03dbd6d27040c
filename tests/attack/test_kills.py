"""Attack: a hundred kills at random moments; the same command again ends in the bytes of an undisturbed run."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from helpers.processes import SMALLEST

from phibench.datasets.store import schema

ROUND = 5
"""Kills before a run may end."""


@dataclass(frozen=True)
class Job:
    """A command that is killed.

    Attributes
    ----------
    kills : int
    command : of the folders or files that it reads and writes
    result : file or folder below those, which must have the same bytes
    """

    kills: int
    command: Callable[[Path, Path], list[str]]
    result: str


JOBS = {
    "make": Job(
        30, lambda _, out: ["dataset", "make", str(SMALLEST), "--out", str(out / "set"), "--workers", "2"], "set"
    ),
    "frames": Job(
        25,
        lambda given, out: ["dataset", "frames", str(given), "--out", str(out / "frames"), "--draws", "2"],
        "frames",
    ),
    "seal": Job(25, lambda given, out: ["seal", "make", str(given), "--out", str(out / "public")], "public"),
    "score": Job(
        20,
        lambda given, out: [
            *("score", str(given), "--method", "red_centroid", "--preset", "bayer-raw"),
            *("--out", str(out / "score.json")),
        ],
        "score.json",
    ),
}
LEFT = {"run.json", "log.jsonl", ".phibench-lock", "seal.json"}
"""What tells of the run itself and differs from run to run; a seal has a random salt."""


def started(job: Job, given: Path, out: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "phibench", *job.command(given, out)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True)


def finished(job: Job, given: Path, out: Path) -> float:
    """Run to the end; the seconds that it took."""
    start = time.monotonic()
    with started(job, given, out) as child:
        said = child.communicate(timeout=300)[0]
        assert child.returncode == 0, said.decode()
    return time.monotonic() - start


def result(job: Job, out: Path) -> dict[str, bytes]:
    """Bytes of every file of the result; of a score without the seconds that the method took."""
    place = out / job.result
    if place.is_file():
        records = pl.read_parquet(place.with_suffix(".parquet")).drop("seconds")
        return {
            place.name: json.dumps(without_times(json.loads(place.read_text()))).encode(),
            "records": records.write_csv().encode(),
        }
    files = [path for path in sorted(place.rglob("*")) if path.is_file() and path.name not in LEFT]
    found = {str(path.relative_to(place)): path.read_bytes() for path in files}
    if schema.CHECKSUMS in found:
        checked = subprocess.run(["sha256sum", "--quiet", "-c", schema.CHECKSUMS], cwd=place, capture_output=True)
        assert checked.returncode == 0, checked.stdout
        lines = found[schema.CHECKSUMS].splitlines()
        found[schema.CHECKSUMS] = b"\n".join(line for line in lines if not line.endswith(b"  seal.json"))
    return found


def without_times(document: Any) -> Any:
    """A score without what hangs on the seconds that its method took: metrics of time, and the hash of its records."""
    if isinstance(document, dict):
        kept = {key: x for key, x in document.items() if key not in ("seconds", "records_sha256")}
        return {key: without_times(x) for key, x in kept.items()}
    return [without_times(x) for x in document] if isinstance(document, list) else document


@pytest.mark.slow
@pytest.mark.parametrize("name", JOBS)
def test_killed_commands_end_in_the_same_bytes(name: str, secret_dataset: Path, tmp_path: Path) -> None:
    """Half of the kills hit the command alone, half its whole process group; nothing is left beside the result."""
    job, moments, met = JOBS[name], random.Random(name), 0
    given = Path(shutil.copytree(secret_dataset, tmp_path / "given"))
    (tmp_path / "whole").mkdir()
    lasts = finished(job, given, tmp_path / "whole")
    expected = result(job, tmp_path / "whole")
    assert expected
    for number in range(job.kills // ROUND):
        out = tmp_path / str(number)
        out.mkdir()
        for _ in range(ROUND):
            with started(job, given, out) as child:
                time.sleep(moments.uniform(0.05, 0.95) * lasts)
                whole = moments.random() < 0.5
                if child.poll() is None:
                    os.killpg(child.pid, signal.SIGKILL) if whole else child.kill()
                    met += 1
                child.communicate(timeout=60)
        if name != "seal" or not (out / job.result).exists():  # a sealed set is never written again
            finished(job, given, out)
        assert result(job, out) == expected
        assert {path.stem for path in out.iterdir()} == {Path(job.result).stem}
        shutil.rmtree(out)
    assert met >= job.kills // 2  # the others found a result that was whole already, or a quicker machine
