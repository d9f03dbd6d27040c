"""Pairs of a set made ahead by other processes, so that making them keeps no method waiting.

Images come through shared memory, the rest over a socket, as pairs go to a method's process: `sandbox.transport`. The
processes belong to the runner: they know the truth, and no method can reach them.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any

from phibench.benchmark.isolation.transport import (
    LEAST_BYTES,
    Connection,
    MemoryFile,
    SharedPages,
    TransportError,
    needed_bytes,
    pack,
    unpack,
)
from phibench.datasets.errors import DatasetError
from phibench.datasets.parallel import ONE_THREAD
from phibench.estimator.interface import Pair
from phibench.estimator.pair_set import PairSet, PairTruth, truth_folders


class PairsAhead:
    """Pairs of a set and their truths, made by other processes before they are asked for in the order of their numbers.

    Making a pair takes as long as all built-in methods take on it. A context manager; its processes end with this one.

    Parameters
    ----------
    pairs : PairSet
        Picklable.
    processes : int

    Attributes
    ----------
    seconds : dict
        CPU-seconds of the processes so far: "draw" and "bounds".
    """

    def __init__(self, pairs: PairSet, processes: int) -> None:
        self._pairs, self.folders = pairs, truth_folders(pairs)
        self._truths: dict[int, PairTruth] = {}
        self.seconds = {"draw": 0.0, "bounds": 0.0}
        told = pickle.dumps(pairs)
        self._makers: list[_Maker] = []
        try:
            for _ in range(min(processes, len(pairs))):
                self._makers.append(_Maker())
        except OSError as error:
            self._end()
            what = f"no process that draws pairs can be started: {error.strerror or error}; take --workers 1"
            raise DatasetError(what) from error
        for first, maker in enumerate(self._makers):  # all import what they need by now, side by side
            maker.begin(told, first)

    def __enter__(self) -> PairsAhead:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self._end()

    def _end(self) -> None:
        for maker in self._makers:
            maker.end()

    def __len__(self) -> int:
        return len(self._pairs)

    def pair(self, number: int) -> Pair:
        """Pair of a number; the one that comes after those in the making is asked for."""
        maker = self._makers[number % len(self._makers)]
        following = number + len(self._makers)
        made = maker.made(number, following if following < len(self) else None)
        self._truths[number] = made.truth
        self.seconds["draw"] += made.draw_seconds
        self.seconds["bounds"] += made.truth_seconds
        return made.pair

    def truth(self, number: int) -> PairTruth:
        """Exact answer of a pair, made with it."""
        return self._truths.pop(number) if number in self._truths else self._pairs.truth(number)

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""
        return self._pairs.document()


@dataclass(frozen=True)
class _Made:
    pair: Pair
    truth: PairTruth
    draw_seconds: float
    truth_seconds: float


_NOTHING = -1  # is asked for


class _Maker:
    """A process that makes one pair at a time; images come through shared memory, the rest over a socket."""

    def __init__(self) -> None:
        self._socket, theirs = socket.socketpair()
        self._line, self._reader, self._asked = Connection(self._socket), -1, _NOTHING
        code = f"from {__name__} import make_pairs; make_pairs()"
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", code, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                env={**ONE_THREAD, **os.environ},
            )

    def begin(self, told: bytes, first: int) -> None:
        """Give the pickled set, and ask for the first pair."""
        with contextlib.suppress(TransportError):  # told when the pair is wanted
            self._line.send(told)
            self._ask(first)

    def made(self, number: int, following: int | None) -> _Made:
        """Pair of a number; then the next one is asked for.

        Raises
        ------
        DatasetError
            If the process has died. What it raised itself is raised here.
        """
        try:
            if self._asked not in (number, _NOTHING):
                self._received()  # nobody wants it any more
            if self._asked != number:
                self._ask(number)
            made = self._received()
            if following is not None:
                self._ask(following)
        except TransportError as error:
            what = "a process that draws pairs died; most often memory has run out: take fewer --workers"
            raise DatasetError(what) from error
        if isinstance(made, BaseException):
            raise made
        return made

    def _ask(self, number: int) -> None:
        self._line.send(str(number).encode())
        self._asked = number

    def _received(self) -> _Made | BaseException:
        kind, *told = pickle.loads(self._line.receive())
        if kind == "error":
            self._asked, error = _NOTHING, told[0]
            return error if isinstance(error, BaseException) else DatasetError(str(error))
        if kind == "memory":
            _, handles, _, _ = socket.recv_fds(self._socket, 1, 1)
            self._give_back()
            self._reader, self._pages = handles[0], SharedPages(handles[0])
            return self._received()
        self._asked = _NOTHING
        message, *others = told
        return _Made(unpack(message, self._pages).pair, *others)

    def _give_back(self) -> None:
        if self._reader >= 0:
            os.close(self._reader)
            self._reader = -1

    def end(self) -> None:
        """End the process; it does not finish a pair that nobody will be asked for."""
        self._process.kill()
        self._process.wait()
        self._line.hang_up()
        self._give_back()


def make_pairs() -> None:
    """Make the pairs that the other side asks for, until it hangs up: all that `_Maker`'s process does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other side decides
    maker = _Making(socket.socket(fileno=int(sys.argv[1])))
    with contextlib.suppress(TransportError):
        maker.answer_all()


class _Making:
    """The other side of `_Maker`."""

    def __init__(self, end: socket.socket) -> None:
        self._socket, self._line = end, Connection(end)
        self._memory: MemoryFile | None = None

    def answer_all(self) -> None:
        told, pairs = self._line.receive(most=1 << 30), None
        while True:
            number = int(self._line.receive())
            try:
                pairs = pairs or pickle.loads(told)
                self._answer(pairs, number)
            except TransportError:
                raise
            except Exception as error:
                self._send("error", _picklable(error))

    def _answer(self, pairs: PairSet, number: int) -> None:
        start = time.process_time()
        pair = pairs.pair(number)
        drawn = time.process_time()
        truth = pairs.truth(number)
        seconds = drawn - start, time.process_time() - drawn
        if self._memory is None or self._memory.size < needed_bytes(pair):
            self._memory = MemoryFile(max(needed_bytes(pair), LEAST_BYTES))
            self._send("memory")
            socket.send_fds(self._socket, [b"m"], [self._memory.reader])
        self._send("pair", pack(pair, self._memory), truth, *seconds)

    def _send(self, *told: object) -> None:
        self._line.send(pickle.dumps(told, protocol=5))


def _picklable(error: Exception) -> Exception | str:
    """The error, or what it says where it cannot be sent as it is."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return f"{type(error).__name__}: {error}"
    return error
