"""Map over processes: order, errors with their item, one BLAS thread, clean ends."""

import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from helpers.processes import left_of, living, wait_for

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.parallel import ONE_THREAD, parallel_map

Python = Callable[..., subprocess.CompletedProcess[str]]


def late(mark: Path, item: int) -> tuple[int, int]:
    """The first item ends when there is a mark."""
    if item == 0:
        wait_for(mark)
    (mark.parent / str(item)).touch()
    return item, os.getpid()


def inverse(item: int) -> float:
    return 1.0 / item


def threads(_item: int) -> list[str | None]:
    return [os.environ.get(name) for name in ONE_THREAD]


def begun(folder: Path, item: int) -> int:
    (folder / str(item)).touch()
    time.sleep(0.3)  # so that 15 times as long passes before 30 have begun
    return 1 // item


def death(item: int) -> int:
    if item == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def test_results_keep_the_order_and_come_from_workers(tmp_path: Path) -> None:
    found = list(parallel_map(partial(late, tmp_path / "4"), range(5), 2))
    assert [item for item, _ in found] == [0, 1, 2, 3, 4]
    assert os.getpid() not in {pid for _, pid in found}


def test_results_come_early_when_order_does_not_matter(tmp_path: Path) -> None:
    found = []
    for item, _ in parallel_map(partial(late, tmp_path / "seen"), range(5), 2, in_order=False):
        found.append(item)
        (tmp_path / "seen").touch()
    assert sorted(found) == [0, 1, 2, 3, 4]
    assert found[0] != 0


@pytest.mark.parametrize(("workers", "items"), [(1, [3, 4]), (4, [3]), (4, [])])
def test_one_worker_or_item_needs_no_process(workers: int, items: list[int], tmp_path: Path) -> None:
    assert list(parallel_map(partial(late, tmp_path / "none"), items, workers)) == [
        (item, os.getpid()) for item in items
    ]


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_names_its_item(workers: int) -> None:
    results = parallel_map(inverse, [4, 0, 2], workers)
    assert next(results) == 0.25
    with pytest.raises(ZeroDivisionError) as caught:
        next(results)
    assert caught.value.__notes__ == ["while working on 0"]


def test_after_an_error_the_rest_is_dropped(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError):
        list(parallel_map(partial(begun, tmp_path), range(40), 2))
    assert 0 < len(list(tmp_path.iterdir())) < 30


def test_workers_run_one_thread_each_and_the_caller_keeps_its_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ONE_THREAD:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MKL_NUM_THREADS", "3")  # who sets one keeps it
    before = dict(os.environ)
    assert list(parallel_map(threads, [1, 2], 2)) == [["1", "1", "3"]] * 2
    assert dict(os.environ) == before


def test_a_dead_worker_is_one_sentence() -> None:
    with pytest.raises(DatasetError, match="worker process died"):
        list(parallel_map(death, range(8), 2))


def test_ctrl_c_ends_quietly(tmp_path: Path) -> None:
    """An interrupt reaches all processes of the terminal's group, the workers too."""
    script = tmp_path / "main.py"
    script.write_text(
        "import sys, time\nfrom pathlib import Path\nfrom phibench.datasets.common.parallel import parallel_map\n"
        "def works(number):\n    Path(__file__).with_name(str(number)).touch()\n    time.sleep(60.0)\n"
        "if __name__ == '__main__':\n"
        "    try:\n        list(parallel_map(works, range(4), 2))\n"
        "    except KeyboardInterrupt:\n        sys.exit(130)\n"
    )
    child = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    for number in range(2):
        wait_for(tmp_path / str(number))
    os.killpg(child.pid, signal.SIGINT)
    _, errors = child.communicate(timeout=20.0)
    assert (child.returncode, errors) == (130, "")


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs /proc")
def test_workers_leave_when_their_parent_is_killed(tmp_path: Path) -> None:
    """One works, the other has nothing to do; neither can be told."""
    script = tmp_path / "main.py"
    script.write_text(
        "import time\nfrom phibench.datasets.common.parallel import parallel_map\n"
        "if __name__ == '__main__':\n"
        "    for _ in parallel_map(time.sleep, [0.0, 0.0, 0.0, 60.0], 2):\n        print('ready', flush=True)\n"
    )
    command = [sys.executable, str(script)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as parent:
        assert parent.stdout is not None
        assert [parent.stdout.readline() for _ in range(3)] == ["ready\n"] * 3
        assert len(living(parent.pid)) >= 3
        parent.kill()
        parent.wait()
        left = left_of(parent.pid)
        if left:  # else the test would wait for their end of the pipe
            os.killpg(parent.pid, signal.SIGKILL)
    assert left == []


FAULTS = """
import resource, threading
import numpy as np
from phibench.datasets.common.parallel import keep_memory

def work():
    image = np.ones((450, 500))  # 1.8 MB, less than what the system gives in huge pages
    for _ in range(50):
        image * 2.0 + 1.0

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

without = faults()
keep_memory()
print(without, faults())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is glibc's")
def test_a_worker_of_dask_keeps_the_memory_of_its_arrays() -> None:
    """dask starts workers with this variable. 50 arrays of 440 pages: 22 000 faults where each is returned."""
    child = subprocess.run(
        [sys.executable, "-c", FAULTS],
        env={**os.environ, "MALLOC_TRIM_THRESHOLD_": "65536"},
        capture_output=True,
        text=True,
        check=True,
    )
    without, kept = map(int, child.stdout.split())
    assert without > 20_000
    assert kept < 3_000  # pages of a few arrays and of the thread
