"""The pool of workers: results, faults, deaths, and nobody left behind."""

import multiprocessing
import operator
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from phibench.datasets.errors import DatasetError
from phibench.datasets.recipe_file import load_recipe
from phibench.datasets.workers import Pool, Task, WorkerError


def children() -> list[object]:
    return list(multiprocessing.active_children())


def test_all_results_come() -> None:
    with Pool(2) as pool:
        results = dict(pool.run([Task(str(i), operator.mul, (i, i)) for i in range(7)]))
        again = list(pool.run([Task("later", operator.add, (1, 2))]))
    assert sorted(results.values()) == [i * i for i in range(7)]
    assert [value for _, value in again] == [3]
    assert children() == []


@pytest.mark.parametrize(
    ("task", "words"),
    [
        (Task("dying", os._exit, (3,)), r"died \(exit code 3\) during: dying"),
        (Task("killed", signal.raise_signal, (9,)), r"died \(signal SIGKILL\) during: killed"),
        (Task("told", load_recipe, ("/nowhere.toml",)), "told failed: there is no recipe"),
        (Task("bug", operator.truediv, (1, 0)), "bug failed: Traceback"),
    ],
)
def test_a_fault_says_which_task_and_why(task: Task, words: str) -> None:
    with Pool(2) as pool, pytest.raises(WorkerError, match=words):
        list(pool.run([Task("fine", time.sleep, (0.1,)), task]))
    assert children() == []
    assert issubclass(WorkerError, DatasetError)


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs /proc")
def test_workers_leave_when_their_parent_is_killed() -> None:
    code = (
        "import time\nfrom phibench.datasets.workers import Pool, Task\n"
        "if __name__ == '__main__':\n    import os\n    pool = Pool(2)\n"
        "    list(pool.run([Task('a', os.getpid), Task('b', os.getpid)]))\n"
        "    print(*[w._process.pid for w in pool._workers], flush=True)\n"
        "    list(pool.run([Task('long', time.sleep, (300,))] * 2))"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pids = [int(word) for word in parent.stdout.readline().split()]
        assert len(pids) == 2
        time.sleep(0.5)
        assert all(alive(pid) for pid in pids)
        parent.kill()
        parent.wait()
    deadline = time.monotonic() + 20.0
    while any(alive(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(alive(pid) for pid in pids)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
