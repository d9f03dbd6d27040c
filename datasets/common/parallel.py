"""`map` over worker processes of one machine, and what such processes share: one thread each, memory given back.

Workers are spawned, never forked: a fork copies the locks of other threads and can hang. Each runs one BLAS thread, so
that N workers keep N cores busy. The number of workers changes no result. Data sets are made by
`datasets.build.workers` instead, because a task that kills its worker must cost no other task.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import reprlib
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from threading import Thread
from typing import TypeVar

from phibench.datasets.common.errors import DatasetError

Item = TypeVar("Item")
Result = TypeVar("Result")

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Environment variables, to be set before NumPy is loaded."""


def worker_count(workers: int | None) -> int:
    """Number of processes that is asked for; None is one for each core.

    Raises
    ------
    DatasetError
        If it is below 1.
    """
    count = workers if workers is not None else os.cpu_count() or 1
    if count < 1:
        raise DatasetError(f"--workers: workers = {count}, at least 1 is needed")
    return count


def parallel_map(
    function: Callable[[Item], Result], items: Iterable[Item], workers: int | None = None, *, in_order: bool = True
) -> Iterator[Result]:
    """Yield `function(item)` of every item; with one worker or one item in this process.

    Parameters
    ----------
    function
        Picklable: a module's function, or a `functools.partial` of one.
    items
        Picklable as well.
    workers : int, optional
        Processes; by default one per core.
    in_order : bool
        False yields results as they come.

    Raises
    ------
    DatasetError
        If a worker process dies.
    Exception
        Of the function, with a note that names the item. Items that have not begun are dropped.
    """
    listed = list(items)
    count = min(workers or os.cpu_count() or 1, len(listed))
    if count <= 1:
        for item in listed:
            with _naming(item):
                result = function(item)
            yield result
        return
    pool = ProcessPoolExecutor(count, get_context("spawn"), initializer=begin_worker)
    try:
        with environment_of_children(ONE_THREAD):  # processes start while items are handed over
            asked: dict[Future[Result], Item] = {pool.submit(function, item): item for item in listed}
        for future in asked if in_order else as_completed(asked):
            with _naming(asked[future]):
                result = future.result()
            yield result
    except BrokenProcessPool as error:
        raise DatasetError(
            f"a worker process died, one of {count}; most often memory has run out: take fewer workers"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def _naming(item: object) -> Iterator[None]:
    """Add the item to whatever goes wrong with it."""
    try:
        yield
    except Exception as error:
        error.add_note(f"while working on {reprlib.repr(item)}")
        raise


@contextlib.contextmanager
def environment_of_children(added: dict[str, str]) -> Iterator[None]:
    """Environment variables for child processes; variables that the user has set keep their values."""
    new = [name for name in added if name not in os.environ]
    os.environ.update({name: added[name] for name in new})
    try:
        yield
    finally:
        for name in new:
            del os.environ[name]


# parameters of mallopt by glibc's malloc.h, with values in bytes
_KEPT = {-1: 2**31 - 1, -2: 2**26, -3: 2**30}  # M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD


def keep_memory() -> None:
    """Let the C library (glibc) keep what this process frees: else each array of an image faults every page anew.

    That takes a quarter of a worker's time. A worker of dask needs it most: its settings return each 64 kB.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another library, or another system
        library = ctypes.CDLL(None)
        for parameter, value in _KEPT.items():
            library.mallopt(parameter, value)


def return_memory() -> None:
    """Give memory that is free back to the system, where the C library keeps it (glibc); 10 ms for 200 MB."""
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another library, or another system
        ctypes.CDLL(None).malloc_trim(0)


def begin_worker() -> None:
    """First step of a worker process of ours: it keeps its memory, and ends with its parent."""
    keep_memory()
    end_with_the_parent()


def end_with_the_parent() -> None:
    """End a worker at once on Ctrl-C, without a traceback, and when its parent is gone, even killed.

    Files that it was writing have temporary names. Workers of a killed parent would wait for work for ever.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    Thread(target=_follow_the_parent, daemon=True).start()


def _follow_the_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
