"""Real workers: faults and deaths, nobody left behind, and a scheduler of others on the loopback device."""

import concurrent.futures
import contextlib
import gc
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
import weakref
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers.folders import contents
from helpers.listeners import listeners
from helpers.processes import SMALLEST, left_of, living, quiet, said, wait_for

from phibench.datasets.build import workers
from phibench.datasets.build.task_runner import schedule
from phibench.datasets.build.tasks import BuildTask, Done, Failed, TaskResult
from phibench.datasets.build.workers import _checked, describe, local_environment, local_workers
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.make import make
from phibench.datasets.store import schema

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs" / "cluster.md").read_text(encoding="utf-8")
BIN = Path(sys.executable).parent


def square(out: Path, number: int) -> TaskResult:
    time.sleep(0.05)
    return TaskResult((), number * number)


def die(out: Path, signum: int) -> TaskResult:
    time.sleep(0.2)
    os.kill(os.getpid(), signum)
    time.sleep(60.0)
    return TaskResult(())


def leave(out: Path, status: int) -> TaskResult:
    os._exit(status)


def bug(out: Path) -> TaskResult:
    raise ZeroDivisionError


def told(out: Path) -> TaskResult:
    raise DatasetError("no such spot")


LASTING = """
import sys, time
from pathlib import Path
from phibench.datasets.build.tasks import TaskResult, BuildTask
from phibench.datasets.build.workers import local_workers

def last(out, number):
    (out / f"begun-{number}").touch()
    time.sleep(300.0)
    return TaskResult(())

if __name__ == "__main__":
    with local_workers(2, Path(sys.argv[1])) as pool:
        for number in range(2):
            pool.submit(BuildTask(f"last {number}", "", last, (number,)))
        pool.next()
"""
"""A program with two workers, both in tasks that do not end."""


def tasks() -> list[BuildTask]:
    """Twelve innocents, two that kill their worker, two with faults, one that needs a killer."""
    innocent = [BuildTask(f"square {i}", "", square, (i,)) for i in range(12)]
    guilty = [
        BuildTask("kill 9", "", die, (9,)),
        BuildTask("kill 11", "", die, (11,)),
        BuildTask("bug", "", bug),
        BuildTask("told", "", told),
    ]
    return [*innocent[:3], *guilty, *innocent[3:], BuildTask("reader", "", square, (1,), ("kill 9",))]


@pytest.mark.parametrize("count", [pytest.param(1, marks=pytest.mark.slow), 2])  # each: 6 deaths of a worker
def test_who_kills_workers_is_named_and_all_others_finish(tmp_path: Path, count: int) -> None:
    with local_workers(count, tmp_path) as pool:
        outcomes = {task.name: outcome for task, outcome in schedule(tasks(), pool)}
    good = {name: outcome.result for name, outcome in outcomes.items() if isinstance(outcome, Done)}
    assert good == {f"square {i}": i * i for i in range(12)}
    causes = {name: outcome.cause for name, outcome in outcomes.items() if isinstance(outcome, Failed)}
    assert "died every time, 3 in all (was killed by signal 9)" in causes["kill 9"]
    assert "died every time, 3 in all (was killed by signal 11)" in causes["kill 11"]
    assert "ZeroDivisionError" in causes["bug"]
    assert causes["told"] == "no such spot"
    assert causes["reader"] == "not made, because kill 9 failed"


def test_a_death_costs_its_own_task_alone_and_another_worker_comes(tmp_path: Path) -> None:
    """Its neighbours neither die nor wait; whoever lets go of its pipe counts as dead, and so does one that exits."""
    with local_workers(2, tmp_path) as pool:
        for task in (BuildTask("kill", "", die, (9,)), *(BuildTask(f"square {i}", "", square, (i,)) for i in range(4))):
            pool.submit(task)
        outcomes = {task.name: outcome for task, outcome in (pool.next() for _ in range(5))}
        pool.submit(BuildTask("leave", "", leave, (3,)))
        assert pool.next()[1] == Failed("exited with status 3", lethal=True)
    assert outcomes.pop("kill") == Failed("was killed by signal 9", lethal=True)
    assert {name: outcome.result for name, outcome in outcomes.items() if isinstance(outcome, Done)} == {
        f"square {i}": i * i for i in range(4)
    }


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs /proc")
def test_workers_leave_when_their_parent_is_killed(tmp_path: Path) -> None:
    program = tmp_path / "lasting.py"  # a file: workers import their tasks from it
    program.write_text(LASTING)
    with subprocess.Popen([sys.executable, str(program), str(tmp_path)], start_new_session=True) as parent:
        for number in range(2):
            wait_for(tmp_path / f"begun-{number}")
        assert len(living(parent.pid)) >= 3
        assert listeners(parent.pid) == set()  # nobody can connect: tests/attack/test_other_users.py
        parent.kill()
        parent.wait()
    assert left_of(parent.pid) == []


HELD = """
import sys, time
from pathlib import Path

if "spawn_main" in " ".join(sys.orig_argv):
    folder = Path(__file__).parent
    (folder / "begun").touch()
    while not (folder / "go").exists():
        time.sleep(0.01)
"""
"""A `sitecustomize` that holds every worker at its start until it is let go."""

START = """
import sys
from pathlib import Path
from phibench.datasets.build.tasks import TaskResult, BuildTask
from phibench.datasets.build.workers import local_workers
from phibench.cli import main as cli

def try_workers() -> None:
    with local_workers(2, Path(sys.argv[1])) as pool:
        for number in range(2):
            pool.submit(BuildTask(f"nothing {number}", "", TaskResult))
        print(pool.next(), "the workers are there")

cli.app.command(try_workers)
sys.exit(cli.main(["try-workers"]))
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs /proc")
@pytest.mark.parametrize(
    ("stop", "status", "sentence"),
    [
        (signal.SIGTERM, 143, "Stopped by SIGTERM.\n"),
        (signal.SIGINT, 130, "Interrupted: stopped at your request.\n"),
    ],
)
def test_a_signal_while_workers_start_ends_in_one_sentence(
    tmp_path: Path, stop: signal.Signals, status: int, sentence: str
) -> None:
    """To the whole group, as a terminal does: each worker would end in a traceback of its own."""
    (tmp_path / "sitecustomize.py").write_text(HELD)
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    with subprocess.Popen(
        [sys.executable, "-c", START, str(tmp_path)],
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    ) as child:
        wait_for(tmp_path / "begun")
        os.killpg(child.pid, stop)
        (tmp_path / "go").touch()
        said, errors = child.communicate(timeout=60)
    assert (said, errors) == ("", sentence)
    assert child.returncode == status
    assert left_of(child.pid) == []  # a worker may still be on its way out when its parent has ended


# A scheduler of others.


def commands(mark: str, folder: Path, tls: bool = False) -> list[list[str]]:
    """Commands of docs/cluster.md below a mark, for a smaller recipe and another folder; without TLS unless asked."""
    text = PAGE if tls else PAGE.replace(" --protocol tls", "")
    block = re.search(rf"<!-- {mark} -->\n((?:    .*\n)+)", text)
    assert block is not None
    lines = [shlex.split(line) for line in block[1].splitlines()]
    words = {"smoke": str(SMALLEST), "dask": str(BIN / "dask")}
    found = []
    for line in lines:
        program = [sys.executable, "-m", "phibench.cli.main"] if line[0] == "phibench" else [words[line[0]]]
        found.append([*program, *(words.get(word, re.sub("^out(?=/)", str(folder), word)) for word in line[1:])])
    return found


@contextlib.contextmanager
def running(*commands: list[str], **environment: str) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for command in commands:
            options = {"env": {**os.environ, **environment}, "stderr": subprocess.DEVNULL, "start_new_session": True}
            child = stack.enter_context(subprocess.Popen(command, **options))  # type: ignore[call-overload]
            stack.callback(child.wait)
            stack.callback(os.killpg, child.pid, signal.SIGTERM)
            if "scheduler" in command:
                wait_for(Path(command[command.index("--scheduler-file") + 1]))
        yield


@pytest.mark.slow
def test_the_documented_scheduler_gives_the_same_bytes(smallest_dataset: Path, tmp_path: Path) -> None:
    """With its key: a command that has none is refused."""
    scheduler, worker, run = commands("loopback", tmp_path, tls=True)
    assert "tls" in scheduler
    keys = re.search(r"<!-- keys -->\n((?:    .*\n|\n)+)", PAGE)
    assert keys is not None
    script = "\n".join(line[4:] for line in keys[1].splitlines())
    subprocess.run(["bash", "-ec", script], cwd=tmp_path, check=True, capture_output=True)
    own = {"DASK_CONFIG": str(tmp_path / "out" / "keys")}
    with running(scheduler, worker, **own):
        options: Any = {"capture_output": True, "text": True, "timeout": 300}
        done = subprocess.run(run, env={**os.environ, **own}, **options)
        assert done.returncode == 0, done.stderr
        assert contents(tmp_path / "smoke") == contents(smallest_dataset)
        without = subprocess.run(run, **options)
        assert without.returncode == 2
        assert "asks for a key (tls): set DASK_CONFIG to its folder" in without.stderr
        assert "Traceback" not in without.stderr
        again = subprocess.run(run, env={**os.environ, **own}, **options)
        assert "nothing to do" in again.stderr


@pytest.mark.slow
def test_the_documented_shards_give_the_same_bytes(smallest_dataset: Path, tmp_path: Path) -> None:
    for command in commands("loopback shards", tmp_path):
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
    assert contents(tmp_path / "smoke") == contents(smallest_dataset)


def refusal(out: Path, scheduler: str) -> str:
    with pytest.raises(DatasetError) as caught:
        make(SMALLEST, out, console=quiet(), scheduler=scheduler)
    assert not (out / schema.MANIFEST).exists()
    return str(caught.value)


def test_a_scheduler_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "CONNECT_S", 1.0)
    assert "no dask scheduler answers at tcp://127.0.0.1:9 within 1 s" in refusal(tmp_path, "tcp://127.0.0.1:9")
    assert "no dask scheduler answers at nonsense://x" in refusal(tmp_path, "nonsense://x")
    assert "there is no scheduler file" in refusal(tmp_path, str(tmp_path / "none.json"))
    (tmp_path / "bad.json").write_text("{}")
    (tmp_path / "worse.json").write_text("{")
    (tmp_path / "key.json").write_text('{"address": "tls://127.0.0.1:9"}')
    for name in ("tls://127.0.0.1:9", str(tmp_path / "key.json")):
        assert "asks for a key (tls)" in refusal(tmp_path / "out", name)
    for name in ("bad.json", "worse.json"):
        assert "no dask scheduler answers at" in refusal(tmp_path / "out", str(tmp_path / name))
    assert not (tmp_path / "out").exists()


def test_a_wait_for_a_scheduler_that_starts_late(tmp_path: Path) -> None:
    """The wait begins before scheduler and worker, and ends when both are there, or in a sentence."""
    scheduler, worker, _ = commands("loopback", tmp_path)
    with pytest.raises(DatasetError, match="after a wait of 1 s: there is no scheduler file"):
        workers.wait_for_workers(scheduler[-1], 1)
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(workers.wait_for_workers, scheduler[-1], 100)
        with running(scheduler):
            with pytest.raises(DatasetError, match=r"after a wait of 1 s: the scheduler at .* has no workers"):
                workers.wait_for_workers(scheduler[-1], 1)
            assert not waiting.done()
            with running(worker):
                assert waiting.result(timeout=100) is None


@pytest.mark.slow
def test_a_client_that_failed_is_gone_before_the_next_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Deleted while the next one starts, it would wait for dask's lock of loops, which that one has, for ever."""
    import distributed  # here: workers import this file

    made: list[weakref.ref[distributed.Client]] = []

    class Client(distributed.Client):  # type: ignore[misc]
        def __new__(cls, *_: Any, **__: Any) -> "Client":
            client: Client = super().__new__(cls)
            made.append(weakref.ref(client))
            return client

    monkeypatch.setattr(workers, "CONNECT_S", 0.3)
    gc.disable()  # nothing but the code itself deletes it
    try:
        with pytest.raises(DatasetError, match="no dask scheduler answers") as caught:
            workers._connect(SimpleNamespace(Client=Client), "tcp://127.0.0.1:9")
    finally:
        gc.enable()
    assert caught.value.__context__ is None  # an error's frames keep the client
    assert [client() for client in made] == [None]


def test_slurm_jobs_are_ordered_and_ended() -> None:
    """The array without a scheduler stands first; jobs wait for others, and the last one ends them."""
    plain, served = re.split(r"^## Slurm: a scheduler and workers$", PAGE, flags=re.MULTILINE)
    assert "## Slurm: a job array without a scheduler" in plain
    for part, order in ((plain, ["afterok:$shards"]), (served, ["after:$scheduler"] * 2 + ["afterany:$make"])):
        assert re.findall(r"--dependency (\S+)", part) == order
    assert "--wait-for-workers" in served
    assert "scancel $scheduler $workers" in served


def test_workers_that_are_missing_or_do_not_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scheduler, worker, _ = commands("loopback", tmp_path)
    file = scheduler[-1]
    monkeypatch.setattr(workers, "WORKERS_S", 1.0)
    with running(scheduler):
        assert "has no workers after 1 s" in refusal(tmp_path / "out", file)
        monkeypatch.setattr(workers, "WORKERS_S", 60.0)
        with running([word if word != "1" else "2" for word in worker]):
            assert "has more than one thread" in refusal(tmp_path / "out", file)
        blocked = tmp_path / "blocked"
        (blocked / "mitsuba").mkdir(parents=True)
        (blocked / "mitsuba" / "__init__.py").write_text("raise ModuleNotFoundError('no', name='mitsuba')")
        path = os.pathsep.join([str(blocked), os.environ.get("PYTHONPATH", "")])
    with running(scheduler), running(worker, PYTHONPATH=path):
        text = refusal(tmp_path / "out", file)
        assert "cannot render: Mitsuba is not installed" in text
        assert text.count("\n") == 0


@pytest.mark.slow
def test_workers_that_all_go_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A task that waits for workers that never come back ends in a sentence, not in waiting."""
    scheduler, worker, _ = commands("loopback", tmp_path)
    monkeypatch.setattr(workers, "LOST_S", 5.0)
    with running(scheduler), contextlib.ExitStack() as stack:
        first = stack.enter_context(contextlib.ExitStack())
        first.enter_context(running(worker))
        pool = stack.enter_context(workers.remote_workers(scheduler[-1], tmp_path / "out"))
        first.close()
        pool.submit(BuildTask("view x", "", dict))
        with pytest.raises(DatasetError, match="no workers for 5 s; start some and run the same command again"):
            pool.next()


def test_environments_that_differ_are_refused() -> None:
    here = describe()
    assert _checked({"a": here, "b": {**here, "worker": "x"}}) == {k: v for k, v in here.items() if k != "worker"}
    for change, words in (
        ({"llvm": "LLVM 1"}, "workers a and b differ in llvm"),
        ({"code_sha256": "0"}, "worker b runs other code"),
        ({"fault": "no LLVM"}, "b cannot render: no LLVM"),
    ):
        with pytest.raises(DatasetError, match=words):
            _checked({"a": here, "b": {**here, **change}})
    with pytest.raises(DatasetError, match="worker b has no phibench"):
        _checked({"a": here, "b": ModuleNotFoundError("No module", name="phibench")})
    with pytest.raises(DatasetError, match="does not see the folder"):
        _checked({"a": describe(Path("/nowhere/probe"))})


def test_this_machine_is_asked_in_another_process() -> None:
    assert local_environment()["code_sha256"] == describe()["code_sha256"]


def test_every_task_is_logged(smallest_dataset: Path) -> None:
    entries = [json.loads(line) for line in (smallest_dataset / schema.LOG).read_text().splitlines()]
    assert len(entries) == 8
    for entry in entries:
        assert entry["ok"]
        assert entry["seconds"] > 0.0
        assert 50.0 < entry["peak_mb"] < 5000.0
        assert {"time", "task", "key", "worker"} < set(entry)


@pytest.mark.usefixtures("inline")
def test_a_worker_that_fails_half_way_leaves_the_rest_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(
            "phibench.datasets.build.sample_task.save_png", lambda *_: (_ for _ in ()).throw(OSError(28, "full"))
        )
        with pytest.raises(DatasetError, match="2 of 8 tasks failed"):
            make(SMALLEST, tmp_path / "out", workers=1, console=quiet())
    console = quiet()
    make(SMALLEST, tmp_path / "out", workers=2, console=console)
    assert "to make: 2 samples" in said(console)
