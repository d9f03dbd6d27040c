"""Worker processes by dask.distributed: our own on this machine, or those of a running scheduler.

One process and one Dr.Jit thread per worker, under a nanny that replaces it when it dies. Our own listen on the
loopback device only and end with this process. `python -m phibench.datasets.build.workers` prints what this Python
renders with: versions, variant, LLVM.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import ExitStack
from multiprocessing import resource_tracker
from pathlib import Path
from types import TracebackType
from typing import Any

from phibench.datasets.build.scheduler import Executor, Outcome
from phibench.datasets.build.tasks import Done, Failed, Task, fault_text, perform, worker_name
from phibench.datasets.build.view_task import start_renderer
from phibench.datasets.errors import DatasetError
from phibench.datasets.frames.request import whole_number
from phibench.datasets.parallel import ONE_THREAD
from phibench.datasets.store.files import write_text
from phibench.datasets.store.leftovers import OwnedFolder
from phibench.datasets.store.provenance import code_sha256, provenance

CONNECT_S = 10.0  # a scheduler that is up answers at once: a longer wait would only hide a wrong address
WORKERS_S = 60.0
# The queue of a cluster may replace a lost worker only after minutes. Finished work is on disk either way.
LOST_S = 300.0
DEATH_S = 10.0  # a nanny says at once how its worker died, on a busy machine a little later
_POLL_S = 0.005
_LEAST_S = 0.5  # between two looks for a scheduler that is still to start
_CENSUS_S = 2.0  # counting the workers is a call to the scheduler: not before every task
# dask lets glibc return memory at once; a view's arrays of 45 MB would then fault every page anew, 1 s a view
_MEMORY = {"MALLOC_TRIM_THRESHOLD_": 2**31, "MALLOC_MMAP_THRESHOLD_": 2**30, "MALLOC_TOP_PAD_": 2**26}
_DEATH = re.compile(r"Worker process (\d+) ((?:was killed by|exited with) .*)")
_STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_MISSING = "dask.distributed is not installed: run `pip install 'phibench[cluster]'`"


class DaskExecutor:
    """Connected workers; an `Executor` of tasks whose files go to `out`."""

    def __init__(self, client: Any, out: Path, deaths: _Deaths | None = None) -> None:
        from distributed import as_completed

        self.client = client
        self._out, self._deaths, self._code = out.resolve(), deaths, code_sha256()
        self._ended, self._tasks = as_completed(loop=client.loop), dict[str, Task]()
        self._count, self._counted, self._number = 0, -_CENSUS_S, 0

    def width(self) -> int:
        """Number of workers; asked now and then, they come and go."""
        if time.monotonic() - self._counted >= _CENSUS_S:
            self._count, self._counted = len(self.client.nthreads()), time.monotonic()
        return max(self._count, 1)

    def submit(self, task: Task) -> None:
        """Send a task; it is not repeated by dask."""
        self._number += 1
        # dask takes tasks of one key for one task: a task that is sent again needs a key of its own
        key = f"{task.name} #{self._number}"
        self._tasks[key] = task
        self._ended.add(self.client.submit(perform, task, self._out, self._code, key=key, pure=False, retries=0))

    def next(self) -> Outcome:
        """Wait for any task; its result is released at once."""
        self._wait()
        future = next(self._ended)
        task = self._tasks.pop(future.key)
        try:
            return task, self._outcome(future)
        finally:
            future.release()

    def _wait(self) -> None:
        """Wait until a task has ended; workers may go and come, but not stay away for ever."""
        seen = time.monotonic()
        while not self._ended.has_ready() and self.client.status == "running":
            time.sleep(_POLL_S)
            if time.monotonic() - self._counted >= _CENSUS_S:
                self.width()
            if self._count:
                seen = time.monotonic()
            elif time.monotonic() - seen > LOST_S:
                text = f"the scheduler has had no workers for {LOST_S:g} s"
                raise DatasetError(f"{text}; start some and run the same command again, finished work is kept")

    def _outcome(self, future: Any) -> Done | Failed:
        from distributed import KilledWorker

        if future.status in ("cancelled", "lost"):
            raise DatasetError("the scheduler has gone away; run the same command again, finished work is kept")
        error = future.exception()
        if error is None:
            outcome: Done | Failed = future.result()
            return outcome
        if isinstance(error, KilledWorker):
            cause = self._deaths.cause(error.last_worker.pid) if self._deaths else "see the worker's log"
            return Failed(cause, lethal=True)
        return Failed(f"{type(error).__name__}: {error}")


@contextlib.contextmanager
def local_workers(count: int, out: Path) -> Iterator[DaskExecutor]:
    """Start worker processes on this machine; leaving ends them, however it is left."""
    dask, distributed = _libraries()
    deaths = _Deaths()
    settings = {
        "distributed.scheduler.allowed-failures": 0,  # who is to blame is found out in `scheduler`
        # dask looks 15 s after a death whether its nanny has a worker, and ends the nanny if not, also while the
        # worker of a later death starts. A nanny that cannot replace its worker is met by LOST_S.
        "distributed.deploy.lost-worker-timeout": "1000 hours",
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
        "distributed.worker.memory.terminate": False,
        "distributed.comm.timeouts.connect": "60s",
        "distributed.worker.profile.enabled": False,
        "distributed.nanny.pre-spawn-environ": {**_MEMORY, **ONE_THREAD},
    }
    with OwnedFolder("workers") as folder, dask.config.set(settings), deaths.listening(), ExitStack() as stack:
        with _signals_kept_from_children():
            cluster = distributed.LocalCluster(
                n_workers=0,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
                memory_limit=0,
                silence_logs=logging.CRITICAL,
                local_directory=str(folder),
            )
            stack.enter_context(cluster)
        cluster.sync(_grow, cluster, count)
        client = stack.enter_context(distributed.Client(cluster, set_as_default=False))
        yield DaskExecutor(client, out, deaths)


async def _grow(cluster: Any, count: int) -> None:
    """Start the workers of an empty cluster, as its constructor would.

    An interrupted start goes on behind the shield, and leaving the cluster waits for it. A cancelled one would leave
    workers of which the cluster does not know: its end is then a traceback.
    """
    while len(cluster.worker_spec) < count:
        cluster.worker_spec.update(cluster.new_worker_spec())
    await asyncio.shield(cluster._correct_state())


@contextlib.contextmanager
def _signals_kept_from_children() -> Iterator[None]:
    """Hold signals that end a run back from this thread for now, and for ever from what begins in it.

    Threads and processes inherit what is blocked. Dask's thread and the workers that it starts so leave Ctrl-C and a
    signal to the whole group to this process, which then ends them. A signal that comes meanwhile is heard afterwards.
    """
    resource_tracker.ensure_running()  # it unblocks signals when it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _STOPS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def remote_workers(scheduler: str, out: Path) -> Iterator[DaskExecutor]:
    """Connect to a running scheduler, by its address or its scheduler file.

    Raises
    ------
    DatasetError
        If nothing answers there, or no worker comes.
    """
    _, distributed = _libraries()
    with _connect(distributed, scheduler) as client:
        try:
            client.wait_for_workers(1, timeout=WORKERS_S)
        except TimeoutError:
            raise DatasetError(
                f"the scheduler at {scheduler} has no workers after {WORKERS_S:g} s; start some"
            ) from None
        yield DaskExecutor(client, out)


def wait_for_workers(scheduler: str, seconds: int) -> None:
    """Wait until a scheduler answers and has a worker; the queue of a cluster may start both late.

    Parameters
    ----------
    scheduler : its address, or its scheduler file, which need not be there yet
    seconds : longest wait

    Raises
    ------
    DatasetError
        With what is missing after that time.
    """
    _, distributed = _libraries()
    until = time.monotonic() + whole_number("--wait-for-workers", seconds, 1)
    while True:
        left = until - time.monotonic()
        try:
            with _connect(distributed, scheduler) as client:
                client.wait_for_workers(1, timeout=max(min(left, WORKERS_S), _LEAST_S))
            return
        except TimeoutError:
            missing = f"the scheduler at {scheduler} has no workers; start some"
        except DatasetError as error:
            missing = str(error)
        if left <= _LEAST_S:
            raise DatasetError(f"after a wait of {seconds} s: {missing}")
        time.sleep(_LEAST_S)


def _connect(distributed: Any, scheduler: str) -> Any:
    path = Path(scheduler)
    is_file = scheduler.endswith(".json") or path.is_file()
    if is_file and not path.is_file():
        raise DatasetError(f"there is no scheduler file {path}; start `dask scheduler --scheduler-file {path}` first")
    where = {"scheduler_file": str(path)} if is_file else {"address": scheduler}
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        return distributed.Client(**where, timeout=CONNECT_S, set_as_default=False)
    except Exception as error:  # nonsense in an address or a file ends in many kinds
        text = f"no dask scheduler answers at {scheduler} within {CONNECT_S:g} s"
        raise DatasetError(f"{text} ({str(error).splitlines()[0] if str(error) else type(error).__name__})") from None


def _libraries() -> tuple[Any, Any]:
    try:
        import dask
        import distributed
    except ModuleNotFoundError as error:
        raise DatasetError(_MISSING) from error
    return dask, distributed


class _Deaths(logging.Handler):
    """Log handler that keeps how each worker died, as its nanny says."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._causes = dict[int, str]()

    def emit(self, record: logging.LogRecord) -> None:
        if found := _DEATH.match(record.getMessage()):
            self._causes[int(found[1])] = found[2]

    def cause(self, pid: int) -> str:
        """Return how a process died; the scheduler may know of its end before its nanny has said how."""
        until = time.monotonic() + DEATH_S
        while pid not in self._causes and time.monotonic() < until:
            time.sleep(_POLL_S)
        return self._causes.get(pid, "no cause known")

    @contextlib.contextmanager
    def listening(self) -> Iterator[None]:
        logger = logging.getLogger("distributed.nanny")
        before = logger.level, logger.propagate
        logger.setLevel(logging.INFO)
        logger.propagate = False
        logger.addHandler(self)
        try:
            yield
        finally:
            logger.removeHandler(self)
            logger.level, logger.propagate = before


Environment = dict[str, Any]
_UNLIKE = ("commit",)  # may differ between two equal runs
_IN_KEYS = ("numpy", "scipy", "mitsuba", "drjit", "OpenEXR", "pillow")


class NoRendererError(DatasetError):
    """Mitsuba cannot be used on this machine."""


def local_environment() -> Environment:
    """Environment of a fresh process on this machine.

    Raises
    ------
    NoRendererError
        If Mitsuba cannot be used.
    """
    command = [sys.executable, "-m", "phibench.datasets.build.workers"]
    child = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if child.returncode != 0:
        last = (child.stderr.strip().splitlines() or [f"exit status {child.returncode}"])[-1]
        raise NoRendererError(f"Mitsuba does not start on this machine ({last}); ask `phibench doctor`")
    return _checked({"this machine": json.loads(child.stdout.splitlines()[-1])})


def remote_environment(workers: DaskExecutor, out: Path) -> Environment:
    """Environment of all workers of a scheduler, which must be one and the same.

    Raises
    ------
    DatasetError
        If a worker lacks phibench or Mitsuba, has other versions than the rest, other code than this
        process, more than one thread, or does not see the folder.
    """
    if threaded := [name for name, count in workers.client.nthreads().items() if count != 1]:
        raise DatasetError(f"worker {threaded[0]} has more than one thread; start workers with --nthreads 1")
    probe = write_text(out.resolve() / f".phibench-tmp-{uuid.uuid4().hex}", "probe")
    try:
        return _checked(workers.client.run(describe, probe, on_error="return"))
    finally:
        probe.unlink(missing_ok=True)


def versions(environment: Environment) -> Environment:
    """Part of an environment that enters the keys of tasks."""
    packages = {name: environment["packages"][name] for name in _IN_KEYS}
    kept = {key: environment[key] for key in ("python", "machine", "variant", "llvm", "threads_per_process")}
    return {**kept, "packages": packages}


def describe(probe: Path | None = None) -> Environment:
    """Environment of this process; ``{"fault": ...}`` where it cannot render or does not see `probe`."""
    if probe is not None and not probe.is_file():
        return {"fault": f"it does not see the folder {probe.parent}: use one that all machines share"}
    try:
        rendering = start_renderer()
    except Exception as error:
        return {"fault": fault_text(error)}
    return {
        **{key: value for key, value in provenance().items() if key not in _UNLIKE},
        **rendering,
        "worker": worker_name(),
    }


def _checked(found: dict[str, Any]) -> Environment:
    """Return the one environment of all."""
    for name, environment in found.items():
        if isinstance(environment, ModuleNotFoundError):
            raise DatasetError(f"worker {name} has no {environment.name}: install phibench[render,cluster] there")
        if isinstance(environment, BaseException):
            raise DatasetError(f"worker {name} failed: {environment}")
        if "fault" in environment:
            raise NoRendererError(f"{name} cannot render: {environment['fault']}")
        if environment["code_sha256"] != code_sha256():
            raise DatasetError(f"worker {name} runs other code than this process: install the same version on both")
    bare = {name: {k: v for k, v in e.items() if k != "worker"} for name, e in found.items()}
    first = next(iter(bare))
    for name, environment in bare.items():
        if environment != bare[first]:
            unlike = [key for key in environment if environment[key] != bare[first].get(key)]
            raise DatasetError(f"workers {first} and {name} differ in {', '.join(unlike)}: their images would too")
    return bare[first]


class WorkerPool:
    """Workers for one folder, as a context manager; leaving it ends our own and lets others' go.

    Parameters
    ----------
    out : folder that tasks write to
    count : processes on this machine, at most
    scheduler : address or scheduler file of a running scheduler, which is used instead
    """

    def __init__(self, out: Path, count: int, scheduler: str | None = None) -> None:
        self._out, self._count, self._scheduler = out, count, scheduler
        self._stack = ExitStack()
        self._remote: DaskExecutor | None = None

    def __enter__(self) -> WorkerPool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    @property
    def width(self) -> int:
        """Number of tasks that run at a time."""
        return self._count if self._remote is None else self._remote.width()

    def environment(self) -> Environment:
        """Environment of the workers: versions, variant, LLVM."""
        if self._scheduler is None:
            return local_environment()
        self._remote = self._stack.enter_context(remote_workers(self._scheduler, self._out))
        return remote_environment(self._remote, self._out)

    def executor(self, tasks: int) -> Executor:
        """Workers for that many tasks."""
        if self._remote is not None:
            return self._remote
        return self._stack.enter_context(local_workers(min(self._count, tasks), self._out))


if __name__ == "__main__":
    print(json.dumps(describe()))
