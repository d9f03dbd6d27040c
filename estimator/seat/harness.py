"""Run a method over a set of pairs. What it does to its own process costs the pair at hand, and the run goes on.

The truth stays in this process: the method's gets the fields of `Pair` and nothing else. That keeps honest code honest;
it is no sandbox. A method that wants to cheat can read any file that its user can.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

from phibench.estimator.bench.pair_set import PairSet
from phibench.estimator.seat.errors import MethodError
from phibench.estimator.seat.limits import Limits
from phibench.estimator.seat.outcome import Outcome
from phibench.estimator.seat.process import MethodProcess
from phibench.estimator.seat.reference import Reference
from phibench.estimator.seat.resolve import resolve


def run_method(
    reference: str | Reference, pairs: PairSet, limits: Limits | None = None, workers: int = 1
) -> list[Outcome]:
    """Outcomes of all pairs, in number order.

    Parameters
    ----------
    reference : str or Reference
        ``my_phi.py:extract``, a built-in name, or that of an installed package's method.
    pairs : PairSet
    limits : Limits, optional
    workers : int
        Processes of the method; each is given one pair at a time.

    Raises
    ------
    MethodError
        If the method cannot be found, imported or started.
    """
    return list(outcomes(reference, pairs, limits, workers))


def outcomes(
    reference: str | Reference,
    pairs: PairSet,
    limits: Limits | None = None,
    workers: int = 1,
    numbers: Sequence[int] | None = None,
) -> Iterator[Outcome]:
    """As `run_method`, one at a time, for some pairs or all of them; leaving the loop ends the processes.

    Pairs are made one at a time, whatever the number of workers: a set need not be safe for threads.
    """
    if workers < 1:
        raise MethodError(f"workers = {workers}: must be 1 or more")
    found = resolve(reference) if isinstance(reference, str) else reference
    wanted = range(len(pairs)) if numbers is None else numbers
    return _outcomes(found, pairs, limits or Limits(), min(workers, max(len(wanted), 1)), wanted)


def _outcomes(
    reference: Reference, pairs: PairSet, limits: Limits, workers: int, numbers: Sequence[int]
) -> Iterator[Outcome]:
    processes = [MethodProcess(reference, limits) for _ in range(workers)]
    free, making = queue.SimpleQueue[MethodProcess](), threading.Lock()
    for process in processes:
        free.put(process)

    def one(number: int) -> Outcome:
        with making:
            pair = pairs.pair(number)
        process = free.get()
        try:
            return process.ask(pair)
        finally:
            free.put(process)

    # one more than processes, so that a pair is made while the others are looked at
    pool = ThreadPoolExecutor(workers + 1, thread_name_prefix="phibench-method")
    try:
        processes[0].start()  # a method that cannot be imported ends the run before it begins
        yield from pool.map(one, numbers)
    finally:
        for process in processes:
            process.close()
        pool.shutdown(wait=True, cancel_futures=True)
