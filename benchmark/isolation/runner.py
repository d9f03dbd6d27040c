"""Runner of methods on a set of pairs, in their own processes or a function in this one; packages and files they used.

What a method does to its process costs the pair at hand, and the run goes on. The truth stays in this process: a
method's process gets the fields of `Pair` and nothing else. Where the system can do it, the process reads neither the
data set nor other files of the user, see `isolation`; elsewhere the score says that it was not isolated.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, TypeVar

from phibench.benchmark.isolation.answers import outcome_of
from phibench.benchmark.isolation.guest_process import MethodProcess
from phibench.benchmark.isolation.isolation import Isolation
from phibench.benchmark.isolation.method_provenance import loaded_names, packages_of
from phibench.benchmark.isolation.method_references import Reference, resolve
from phibench.benchmark.isolation.method_worker import answer_encoder, reply_of, require_method
from phibench.benchmark.isolation.pair_transport import AnyPair
from phibench.benchmark.isolation.run_limits import MethodError, RunLimits
from phibench.estimator.interface import Outcome
from phibench.estimator.pair_set import PairSet, tell_answered, truth_folders

T = TypeVar("T")


class ShownPairs(Protocol):
    """Pairs of either task as methods see them."""

    def pair(self, number: int) -> AnyPair:
        """Images of a pair."""


@dataclass(frozen=True)
class RunProvenance:
    """Packages and files with which a method's process ran.

    Attributes
    ----------
    packages : dict of str to str or None
        Version of every package that it has loaded, the interface's own among them: `method_provenance.packages_of`.
    files : dict of str to str or None
        SHA-256 of other files that were opened where it may read: `method_provenance.OpenedFiles`.
    files_complete : bool
        Every file is known that was opened there.
    """

    packages: dict[str, str | None]
    files: dict[str, str | None]
    files_complete: bool


class Harness:
    """Methods in processes of their own, kept warm from pair to pair; a context manager.

    Each pair is made once and shown to one method after the other; pairs are worked on side by side. Several built-in
    methods have one process together, in which they share the search for the spot; their answers are those that each
    gives alone.

    Parameters
    ----------
    methods : sequence of str or Reference
        ``my_phi.py:extract``, a built-in name, or that of an installed package's method.
    limits : RunLimits, optional
    workers : int
        Pairs that are worked on at a time. One method alone, and the built-in ones together, have as many processes;
        others have one each.
    hidden : sequence of Path
        Folders with the truth, which no method can read: `pair_set.truth_folders`.

    Raises
    ------
    MethodError
        If a method cannot be found; on entering, if one cannot be imported.
    """

    def __init__(
        self,
        methods: Sequence[str | Reference],
        limits: RunLimits | None = None,
        workers: int = 1,
        hidden: Sequence[Path] = (),
    ) -> None:
        if workers < 1:
            raise MethodError(f"workers = {workers}: must be 1 or more")
        self._references = [resolve(method) if isinstance(method, str) else method for method in methods]
        self._limits, self._workers, self._hidden = limits or RunLimits(), workers, hidden
        self._places = _together(self._references)
        self._draw_seconds = 0.0
        self._failed: list[dict[int, str]] = [{} for _ in self._references]
        self._asked = 0

    def __enter__(self) -> Harness:
        self._pools = [self._pool([self._references[place] for place in places]) for places in self._places]
        self._making, self._turns = _Turns(), [_Turns() for _ in self._pools]
        # one more than processes, so that a pair is made while the others are looked at
        self._threads = ThreadPoolExecutor(self._workers + 1, thread_name_prefix="phibench-method")
        try:
            for pool in self._pools:
                pool.start()  # a method that cannot be imported ends the run before it begins
        except BaseException:  # Ctrl-C too: no process stays
            self.__exit__(None, None, None)
            raise
        return self

    def _pool(self, references: Sequence[Reference]) -> _MethodPool:
        copies = self._workers if len(self._places) == 1 or len(references) > 1 else 1
        first, *others = references
        return _MethodPool([MethodProcess(first, self._limits, self._hidden, others) for _ in range(copies)])

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        for turns in (self._making, *self._turns):
            turns.stop()
        for pool in self._pools:
            pool.close()
        # Ctrl-C does not wait for a pair that is being made, 1 s or more; nobody will be asked for it
        self._threads.shutdown(wait=kind is None, cancel_futures=True)

    @property
    def isolations(self) -> list[str]:
        """Isolation of each method in a sentence; after entering."""
        told = self._in_order([[pool.isolation.sentence()] * len(at) for pool, at in self._pooled()])
        return list(told)

    @property
    def ran(self) -> list[RunProvenance]:
        """Packages and files of each method, so far; those of one process together have the same packages."""
        told = self._in_order([[pool.ran] * len(at) for pool, at in self._pooled()])
        return list(told)

    @property
    def stages(self) -> dict[str, float]:
        """CPU-seconds so far: "draw" of all pairs, and of built-in methods that share a process their stages."""
        parts = [stages for pool in self._pools for stages in pool.stages]
        names = dict.fromkeys(name for part in parts for name in part)
        return {"draw": self._draw_seconds, **{name: sum(part.get(name, 0.0) for part in parts) for name in names}}

    def _pooled(self) -> Iterator[tuple[_MethodPool, Sequence[int]]]:
        return zip(self._pools, self._places, strict=True)

    def _in_order(self, parts: Sequence[Sequence[T]]) -> tuple[T, ...]:
        """Values of each method in the methods' order, from those of each process."""
        found = {
            place: one
            for at, part in zip(self._places, parts, strict=True)
            for place, one in zip(at, part, strict=True)
        }
        return tuple(found[place] for place in range(len(found)))

    @property
    def failed_outputs(self) -> list[str]:
        """Output of each method for the first pair on which it failed and printed something; "" if there is none."""
        return [found[min(found)] if found else "" for found in self._failed]

    def outcomes(self, pairs: ShownPairs, numbers: Sequence[int]) -> Iterator[tuple[Outcome, ...]]:
        """Outcomes of every method for some pairs, in the order of `numbers`.

        Pairs are made one at a time and given out in this order, whatever the number of workers: a set need not be
        safe for threads, and one process alone sees the same pairs in the same order in every run. Pairs of the next
        call, asked for before these are answered, come after them.
        """
        first, self._asked = self._asked, self._asked + len(numbers)

        def one(place: int, number: int) -> tuple[Outcome, ...]:
            try:
                with self._making.turn(place):
                    start = time.thread_time()
                    pair = pairs.pair(number)
                    self._draw_seconds += time.thread_time() - start
            except BaseException:
                for skipped in self._turns:  # or those that come after would wait for it
                    with skipped.turn(place):
                        pass
                raise
            asked = zip(self._pools, self._turns, strict=True)
            done = self._in_order([pool.ask(pair, turns, place) for pool, turns in asked])
            tell_answered(pairs, number)
            for failed, outcome in zip(self._failed, done, strict=True):
                if outcome.failure and outcome.output:
                    failed[number] = outcome.output
            return done

        return _in_order([self._threads.submit(one, *item) for item in enumerate(numbers, first)])


def _together(references: Sequence[Reference]) -> list[list[int]]:
    """Places of the methods that have a process together: the built-in ones of spots; every other has its own."""
    built_in = [place for place, reference in enumerate(references) if reference.shares]
    return [[place] for place in range(len(references)) if place not in built_in] + [built_in] * bool(built_in)


_WAKE_SECONDS = 0.2  # between looks at whether somebody pressed Ctrl-C


def _in_order(asked: list[Future[tuple[Outcome, ...]]]) -> Iterator[tuple[Outcome, ...]]:
    """Results in order; Ctrl-C is heard while one is waited for.

    Polars, once imported, has waits on locks restarted after SIGINT (SA_RESTART), and a wait without end would not
    return to Python before the method does.
    """
    for future in asked:
        while not future.done():
            wait([future], _WAKE_SECONDS)
        yield future.result()


class _Turns:
    """Order of threads: they pass one after the other, by their places."""

    def __init__(self) -> None:
        self._condition, self._now, self._stopped = threading.Condition(), 0, False

    @contextmanager
    def turn(self, place: int) -> Iterator[None]:
        """Wait for all places before this one."""
        with self._condition:
            self._condition.wait_for(lambda: self._now == place or self._stopped)
            if self._stopped:
                raise CancelledError
        try:
            yield
        finally:
            with self._condition:
                self._now += 1
                self._condition.notify_all()

    def stop(self) -> None:
        """Let nobody pass any more: those before may never come."""
        with self._condition:
            self._stopped = True
            self._condition.notify_all()


class _MethodPool:
    """Processes of one method, or of some together, of which each looks at one pair at a time."""

    def __init__(self, processes: list[MethodProcess]) -> None:
        self._processes, self._free = processes, queue.SimpleQueue[MethodProcess]()
        for process in processes:
            self._free.put(process)
        self._opened = processes[0].watch()

    def start(self) -> None:
        self._processes[0].start()

    @property
    def ran(self) -> RunProvenance:
        names = set[str]().union(*(process.loaded for process in self._processes))
        reference = self._processes[0].reference
        files = self._opened.hashes(reference.files())
        return RunProvenance(packages_of(names), files, self._opened.complete)

    @property
    def isolation(self) -> Isolation:
        return self._processes[0].isolation

    @property
    def stages(self) -> list[dict[str, float]]:
        return [process.stages for process in self._processes]

    def ask(self, pair: AnyPair, turns: _Turns, place: int) -> tuple[Outcome, ...]:
        with turns.turn(place):
            process = self._free.get()
        try:
            return process.ask_each(pair)
        finally:
            self._free.put(process)
            self._opened.look()

    def close(self) -> None:
        for process in self._processes:
            process.close()
        self._opened.close()


def run_method(
    reference: str | Reference, pairs: PairSet, limits: RunLimits | None = None, workers: int = 1
) -> list[Outcome]:
    """Outcomes of one method on all pairs, in number order; parameters and errors as for `Harness`."""
    return list(outcomes(reference, pairs, limits, workers))


def outcomes(
    reference: str | Reference,
    pairs: PairSet,
    limits: RunLimits | None = None,
    workers: int = 1,
    numbers: Sequence[int] | None = None,
) -> Iterator[Outcome]:
    """As `run_method`, one at a time, for some pairs or all of them; leaving the loop ends the processes."""
    wanted = range(len(pairs)) if numbers is None else numbers
    harness = Harness([reference], limits, min(workers, max(len(wanted), 1)), truth_folders(pairs))
    return _outcomes(harness, pairs, wanted)


def _outcomes(harness: Harness, pairs: PairSet, numbers: Sequence[int]) -> Iterator[Outcome]:
    with harness:
        for (outcome,) in harness.outcomes(pairs, numbers):
            yield outcome


def outcomes_here(method: Callable[[Any], Any]) -> Callable[[ShownPairs, Sequence[int]], Iterator[tuple[Outcome]]]:
    """Ask a function in this process, without limits: `Harness.outcomes` for one method in a notebook or debugger.

    What it raises is the failure of that pair; Ctrl-C ends the run.

    Raises
    ------
    MethodError
        If the function cannot be called with one pair.
    """
    require_method(method, function_name(method))

    def one(pair: AnyPair) -> tuple[Outcome]:
        reply = reply_of(lambda: method(pair), encode=answer_encoder(pair))
        return (outcome_of(pair, reply, reply["seconds"]),)

    return lambda pairs, numbers: (one(pairs.pair(number)) for number in numbers)


def function_name(method: Callable[[Any], Any]) -> str:
    """Name under which a function is scored."""
    return str(getattr(method, "__name__", type(method).__name__))


def provenance_here() -> RunProvenance:
    """Packages of a function in this process; files that it opened before are not known."""
    return RunProvenance(packages_of(loaded_names()), {}, False)
