"""Worker processes, our own or those of a scheduler of dask; and the environment and versions that they render with.

One process and one Dr.Jit thread per worker. Our own get tasks through a pipe each and listen nowhere: whoever could
connect to a scheduler would run code as its user, and other users of a machine share its loopback device. They end with
this process. `python -m phibench.datasets.build.workers` prints what this Python renders with: versions, variant, LLVM.
"""

from __future__ import annotations

import contextlib
import gc
import json
import logging
import signal
import subprocess
import sys
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import TracebackType
from typing import Any

from phibench.datasets.build.tasks import BuildTask, Done, Executor, Failed, Outcome, fault_text, perform, worker_name
from phibench.datasets.build.view_task import start_renderer
from phibench.datasets.common.errors import DatasetError, whole_number
from phibench.datasets.common.parallel import ONE_THREAD, begin_worker, environment_of_children
from phibench.datasets.store.files import write_text
from phibench.datasets.store.provenance import code_sha256, provenance

CONNECT_S = 10.0  # a scheduler that is up answers at once: a longer wait would only hide a wrong address
WORKERS_S = 60.0  # for the first worker, by default: `--wait-for-workers`
# The queue of a cluster may replace a lost worker only after minutes. Finished work is on disk either way.
LOST_S = 300.0
DEATH_S = 10.0  # a worker whose pipe has ended is on its way out
_POLL_S = 0.005  # between looks for a task that has ended: short beside any task
_LEAST_S = 0.5  # between two looks for a scheduler that is still to start
_CENSUS_S = 2.0  # counting the workers is a call to the scheduler: not before every task
_STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_MISSING = "dask.distributed is not installed: run `pip install 'phibench[cluster]'`"


class DaskExecutor:
    """Workers of a scheduler of dask; an `Executor` of tasks whose files go to `out`."""

    def __init__(self, client: Any, out: Path) -> None:
        from distributed import as_completed

        self.client = client
        self._out, self._code = out.resolve(), code_sha256()
        self._ended, self._tasks = as_completed(loop=client.loop), dict[str, BuildTask]()
        self._count, self._counted, self._number = 0, -_CENSUS_S, 0

    def width(self) -> int:
        """Number of workers; asked now and then, they come and go."""
        if time.monotonic() - self._counted >= _CENSUS_S:
            self._count, self._counted = len(self.client.nthreads()), time.monotonic()
        return max(self._count, 1)

    def submit(self, task: BuildTask) -> None:
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
            return Failed("see the worker's log", lethal=True)
        return Failed(f"{type(error).__name__}: {error}")


class LocalExecutor:
    """Worker processes of our own; an `Executor` of tasks whose files go to `out`.

    A worker has one task at a time, and its own pipe: its death costs that task alone, and the next task starts another
    worker in its place.
    """

    def __init__(self, count: int, out: Path) -> None:
        self._count, self._out, self._code = count, out.resolve(), code_sha256()
        self._idle, self._waiting = list[_Worker](), deque[BuildTask]()
        self._busy = dict[object, tuple[_Worker, BuildTask]]()  # by the end of the pipe

    def width(self) -> int:
        """Number of workers; those that are not needed yet are not started."""
        return self._count

    def submit(self, task: BuildTask) -> None:
        """Give a task to a worker that is free, or queue it."""
        self._waiting.append(task)
        self._deal_out()

    def next(self) -> Outcome:
        """Wait for any task; the worker has its next one before the outcome is looked at."""
        worker, task = self._busy.pop(wait([worker.line for worker, _ in self._busy.values()])[0])
        outcome = worker.outcome()
        if outcome is None:
            outcome = Failed(worker.end(), lethal=True)
        else:
            self._idle.append(worker)
        self._deal_out()
        return task, outcome

    def _deal_out(self) -> None:
        while self._waiting and len(self._busy) < self._count:
            worker = self._idle.pop() if self._idle else _Worker(perform, self._out, self._code)
            task = self._waiting.popleft()
            self._busy[worker.line] = worker, task  # first, so that an interrupted run ends this worker too
            worker.begin(task)

    def close(self) -> None:
        """End all workers, also in the middle of a task: what they were writing has temporary names."""
        workers = [*self._idle, *(worker for worker, _ in self._busy.values())]
        self._idle.clear()
        self._busy.clear()
        for worker in workers:
            worker.kill()
        for worker in workers:
            worker.end()


Do = Callable[[BuildTask, Path, str | None], Done | Failed]


class _Worker:
    """A process and our end of its pipe."""

    def __init__(self, do: Do, out: Path, code: str) -> None:
        context = get_context("spawn")
        self.line, self._far = context.Pipe()
        # a daemon: it ends with this process wherever that ends, and no task starts processes of its own
        self._process = context.Process(target=_serve, args=(self._far, do, out, code), daemon=True)

    def begin(self, task: BuildTask) -> None:
        """Send a task, the first one to a new process; if the worker has just died, `outcome` tells."""
        if self._process.pid is None:
            with _signals_kept_from_children(), environment_of_children(ONE_THREAD):
                self._process.start()
                self._far.close()  # ours: the pipe then ends with the worker
        with contextlib.suppress(OSError):  # a worker that died at once: `result` tells
            self.line.send(task)

    def outcome(self) -> Done | Failed | None:
        """Outcome of the task; None if the worker has died."""
        try:
            outcome: Done | Failed = self.line.recv()
        except (EOFError, OSError):  # the pipe ended in the middle
            return None
        return outcome

    def kill(self) -> None:
        """End the process at once."""
        if self._process.pid is not None:
            self._process.kill()

    def end(self) -> str:
        """Close the pipe and collect the process; how it ended, in words."""
        self.line.close()
        if self._process.pid is None:
            return "never began"
        self._process.join(DEATH_S)
        status = self._process.exitcode
        if status is None:  # it lives on, without its pipe
            self._process.kill()
            self._process.join()
            return "closed its pipe"
        return f"was killed by signal {-status}" if status < 0 else f"exited with status {status}"


def _serve(line: Connection, do: Do, out: Path, code: str) -> None:
    """Do tasks until the pipe ends."""
    begin_worker()
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _STOPS)
    with contextlib.suppress(EOFError):  # the run has hung up: nothing is left to do
        while True:
            line.send(do(line.recv(), out, code))


@contextlib.contextmanager
def local_workers(count: int, out: Path) -> Iterator[LocalExecutor]:
    """Workers on this machine, started as tasks need them; leaving ends them, however it is left."""
    executor = LocalExecutor(count, out)
    try:
        yield executor
    finally:
        executor.close()


@contextlib.contextmanager
def _signals_kept_from_children() -> Iterator[None]:
    """Hold signals that end a run back from this thread for now, and from a process that begins until it serves.

    Processes inherit what is blocked. Ctrl-C while a worker imports its modules would end in a traceback of its own. A
    signal that comes meanwhile is heard afterwards.
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
    distributed = _library()
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
    distributed = _library()
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
    if _wants_key(path if is_file else None, scheduler):
        raise DatasetError(f"the scheduler at {scheduler} asks for a key (tls): set DASK_CONFIG to its folder")
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        return distributed.Client(**where, timeout=CONNECT_S, set_as_default=False)
    except Exception as error:  # nonsense in an address or a file ends in many kinds
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    # the failed client lies in a cycle, and takes dask's lock of loops when it is deleted: where that happens while the
    # next client has this lock, both wait for ever
    gc.collect()
    raise DatasetError(f"no dask scheduler answers at {scheduler} within {CONNECT_S:g} s ({reason})")


def _wants_key(file: Path | None, address: str) -> bool:
    """Tell a scheduler with TLS if dask's settings name no certificate of a client: its own words are a traceback."""
    from dask import config

    if file is not None:
        with contextlib.suppress(OSError, ValueError, AttributeError):  # a file that is being written, or not yet there
            address = str(json.loads(file.read_text(encoding="utf-8")).get("address"))
    settings = ("distributed.comm.tls.client.cert", "distributed.client.security-loader")
    return address.startswith("tls:") and not any(config.get(name, None) for name in settings)


def _library() -> Any:
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise DatasetError(_MISSING) from error
    return distributed


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
    except Exception as error:  # told as a fault of this worker
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
