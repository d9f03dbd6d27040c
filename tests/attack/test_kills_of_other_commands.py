"""Attack: kills of film make, export, release, fetch, loop bake, sensor fit and import; same bytes, nothing left."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from helpers.camera_files import write_pictures
from helpers.sensor_captures import drawn_sensor, write_raw_capture
from helpers.strange_releases import tiny_release

from phibench.datasets.read import open_dataset

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
ROUND = 5
OF_THE_RUN = {"run.json", "log.jsonl", ".phibench-lock"}
"""Files that tell of a run, and differ from run to run."""
RELEASE = """
import sys
from pathlib import Path
sys.path.insert(0, "tests")
from helpers.small_release import SMALL, ask
from phibench.benchmark.release.release_make import release
given, out = map(Path, sys.argv[1:])
release(ask(out, [SMALL], use=[given]), lambda *_: None)
"""


@dataclass(frozen=True)
class Job:
    """A command that is killed.

    Attributes
    ----------
    given : makes what the command reads, of the folders of both data sets and an empty one; gives its path
    command : words after Python's name, of what it reads and where it writes
    result : name of what it writes
    rounds : of five kills and a whole run each
    """

    given: Callable[[Path, Path, Path], Path]
    command: Callable[[Path, Path], list[object]]
    result: str
    rounds: int = 2


def _pairs(tiny: Path, folder: Path) -> Path:
    """Two rows of real pairs, of the pictures of one sample."""
    opened = open_dataset(tiny)
    sample = next(one for one in opened if one.row.down.visible and one.row.up.visible)
    write_pictures(opened, sample, folder, "mjpeg", 2)
    files = ",".join(f"{image}-0.jpg;{image}-1.jpg" for image in ("down", "up", "down_off", "up_off"))
    row = f"{files},{sample.row.stroke_m},{sample.row.depth_m},0.01\n"
    (folder / "pairs.csv").write_text(f"name,down,up,down_off,up_off,stroke_m,depth_m,depth_sigma_m\na,{row}b,{row}")
    return folder


def _release(_: Path, __: Path, folder: Path) -> Path:
    return tiny_release(folder / "release", {f"frames/{k:04d}.png": bytes([k % 256]) * 20_000 for k in range(1500)})


PHIBENCH = ["-m", "phibench"]
JOBS = {
    "film make": Job(
        lambda tiny, smallest, folder: ROOT / "tests" / "films.toml",
        lambda given, out: [*PHIBENCH, "film", "make", given, "--out", out / "set", "--workers", 1],
        "set",
    ),
    "export": Job(
        lambda tiny, smallest, folder: tiny,
        lambda given, out: [
            *(*PHIBENCH, "export", given, "--to", "parquet", "--out", out / "set", "--workers", 1),
            *("--pairs-per-shard", 1),
        ],
        "set",
    ),
    "release": Job(
        lambda tiny, smallest, folder: smallest,
        lambda given, out: ["-c", RELEASE, given, out],
        "public",
    ),
    "fetch": Job(
        _release,
        lambda given, out: [*PHIBENCH, "fetch", "tiny", "--from", given, "--out", out / "set"],
        "set",
    ),
    "loop bake": Job(
        lambda tiny, smallest, folder: folder,
        lambda given, out: [*PHIBENCH, "loop", "bake", "--out", out / "set", "--rooms", 1, "--workers", 1],
        "set",
        1,
    ),
    "sensor fit": Job(
        lambda tiny, smallest, folder: write_raw_capture(folder / "frames", drawn_sensor(1)),
        lambda given, out: [*PHIBENCH, "sensor", "fit", given, "--out", out / "sensor.toml"],
        "sensor.toml",
    ),
    "import": Job(
        lambda tiny, smallest, folder: _pairs(tiny, folder),
        lambda given, out: [*PHIBENCH, "import", given, "--out", out / "set"],
        "set",
    ),
}


def started(job: Job, given: Path, out: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, *map(str, job.command(given, out))]
    own = {"PHIBENCH_CACHE": str(out.with_name(f"{out.name}-cache"))}  # what is baked once would be copied
    return subprocess.Popen(
        command,
        cwd=ROOT,
        env={**os.environ, **own},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )


def finished(job: Job, given: Path, out: Path) -> float:
    """Run to the end; the seconds that it took."""
    start = time.monotonic()
    with started(job, given, out) as child:
        said = child.communicate(timeout=500)[0]
        assert child.returncode == 0, said.decode()
    return time.monotonic() - start


def bytes_of(place: Path) -> dict[str, bytes]:
    files = [place] if place.is_file() else [path for path in sorted(place.rglob("*")) if path.is_file()]
    return {
        path.relative_to(place.parent).as_posix(): path.read_bytes() for path in files if path.name not in OF_THE_RUN
    }


@pytest.mark.parametrize("name", JOBS)
def test_a_killed_command_ends_in_the_same_bytes(
    name: str, tiny_dataset: Path, smallest_dataset: Path, tmp_path: Path
) -> None:
    """Half of the kills hit the command alone, half its whole process group; nothing is left beside the result."""
    job, moments, met = JOBS[name], random.Random(name), 0
    for part in ("whole", "given"):
        (tmp_path / part).mkdir()
    given = job.given(tiny_dataset, smallest_dataset, tmp_path / "given")
    lasts = finished(job, given, tmp_path / "whole")
    expected = bytes_of(tmp_path / "whole" / job.result)
    beside = {path.name for path in (tmp_path / "whole").iterdir()}
    assert expected
    for number in range(job.rounds):
        out = tmp_path / str(number)
        out.mkdir()
        for _ in range(ROUND):
            if (out / job.result).exists() and name in ("import", "fetch", "sensor fit"):
                break  # it was whole: these write no second time
            with started(job, given, out) as child:
                time.sleep(moments.uniform(0.1, 0.6) * lasts)
                whole = moments.random() < 0.5
                if child.poll() is None:
                    os.killpg(child.pid, signal.SIGKILL) if whole else child.kill()
                    met += 1
                child.communicate(timeout=60)
        if not ((out / job.result).exists() and name == "import"):
            finished(job, given, out)
        assert bytes_of(out / job.result) == expected
        assert {path.name for path in out.iterdir()} == beside
    assert met >= job.rounds  # the others found a result that was whole already, or a quicker machine
