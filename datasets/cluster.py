"""Worker processes by dask.distributed: our own on this machine, or those of a running scheduler.

One process and one Dr.Jit thread per worker, under a nanny that replaces it when it dies. Our own listen on the
loopback device only and end with this process. The same code serves both; only the opening differs.
"""

from __future__ import annotations

import contextlib
import logging
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from phibench.datasets.dispatch import Outcome
from phibench.datasets.errors import DatasetError
from phibench.datasets.one_thread import ONE_THREAD
from phibench.datasets.provenance import code_sha256
from phibench.datasets.task import Done, Failed, Task, perform

CONNECT_S = 10.0
WORKERS_S = 60.0
LOST_S = 300.0
_POLL_S = 0.005
_CENSUS_S = 2.0
# dask lets glibc return memory at once; a view's arrays of 45 MB would then fault every page anew, 1 s a view
_MEMORY = {"MALLOC_TRIM_THRESHOLD_": 2**31, "MALLOC_MMAP_THRESHOLD_": 2**30, "MALLOC_TOP_PAD_": 2**26}
_MISSING = "dask.distributed is not installed: run `pip install 'phibench[cluster]'`"


class Workers:
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
            return Failed(self._deaths.last if self._deaths else "see the worker's log", lethal=True)
        return Failed(f"{type(error).__name__}: {error}")


@contextlib.contextmanager
def local_workers(count: int, out: Path) -> Iterator[Workers]:
    """Start worker processes on this machine; leaving ends them, however it is left."""
    dask, distributed = _libraries()
    deaths = _Deaths()
    settings = {
        "distributed.scheduler.allowed-failures": 0,  # who is to blame is found out in `dispatch`
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
        "distributed.worker.memory.terminate": False,
        "distributed.comm.timeouts.connect": "60s",
        "distributed.worker.profile.enabled": False,
        "distributed.nanny.pre-spawn-environ": {**_MEMORY, **ONE_THREAD},
    }
    with tempfile.TemporaryDirectory(prefix="phibench-") as folder, dask.config.set(settings), deaths.listening():
        cluster = distributed.LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
            memory_limit=0,
            silence_logs=logging.CRITICAL,
            local_directory=folder,
        )
        with cluster, distributed.Client(cluster, set_as_default=False) as client:
            client.run(_hear_no_interrupt)
            client.register_plugin(_deaf_plugin())
            yield Workers(client, out, deaths)


@contextlib.contextmanager
def remote_workers(scheduler: str, out: Path) -> Iterator[Workers]:
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
        yield Workers(client, out)


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


def _hear_no_interrupt() -> None:
    """Leave Ctrl-C to the parent, which then ends its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _deaf_plugin() -> Any:
    """Make a plugin that does the same in the workers that come later."""
    from distributed import WorkerPlugin

    class Deaf(WorkerPlugin):
        def setup(self, worker: Any) -> None:
            _hear_no_interrupt()

    return Deaf()


class _Deaths(logging.Handler):
    """Hears from the nannies how a worker died."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.last = "no cause known"

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if " was killed by " in text or " exited with " in text:
            self.last = text.split(" ", 3)[-1]

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
