"""Pairs of a set made ahead by other processes, so that making them keeps no method waiting.

Images come through shared memory, the rest over a socket, as pairs go to a method's process (`pair_transport`). The
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
import threading
import time
from collections import deque
from types import TracebackType
from typing import Any

from phibench.benchmark.isolation.pair_transport import (
    LEAST_BYTES,
    Connection,
    MemoryFile,
    SharedPages,
    TransportError,
    needed_bytes,
    pack,
    unpack,
)
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.parallel import ONE_THREAD
from phibench.estimator.interface import Pair
from phibench.estimator.pair_set import PairSet, PairTruth, truth_folders


class PrefetchedPairs:
    """Pairs of a set and their truths, made by other processes; pairs before they are asked for, in order.

    Making a pair takes as long as all built-in methods take on it. Its truth is made after all methods have answered it
    (`pair_set.CachedPairs`). A context manager; its processes end with this one.

    Parameters
    ----------
    pairs : PairSet
        Picklable.

    Attributes
    ----------
    seconds : dict
        CPU-seconds of the processes so far: "draw" and "bounds".
    """

    def __init__(self, pairs: PairSet, processes: int) -> None:
        self._pairs, self.folders = pairs, truth_folders(pairs)
        self.seconds = {"draw": 0.0, "bounds": 0.0}
        told = pickle.dumps(pairs)
        self._makers: list[_Maker] = []
        try:
            for _ in range(min(processes, len(pairs))):
                self._makers.append(_Maker(self.seconds))
        except OSError as error:
            self._end()
            what = f"no process that draws pairs can be started: {error.strerror or error}; take --workers 1"
            raise DatasetError(what) from error
        for first, maker in enumerate(self._makers):  # all import what they need by now, side by side
            maker.begin(told, first)

    def __enter__(self) -> PrefetchedPairs:
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
        maker = self._maker(number)
        following = number + len(self._makers)
        made: Pair = maker.pair(number, following if following < len(self) else None)
        return made

    def answered(self, number: int) -> bool:
        """Have the truth of a pair made; nobody waits for it here."""
        with contextlib.suppress(TransportError):  # told when the truth is wanted
            self._maker(number).ask(_TRUTH, number)
        return True

    def truth(self, number: int) -> PairTruth:
        """Exact answer of a pair."""
        truth: PairTruth = self._maker(number).result(_TRUTH, number)
        return truth

    def _maker(self, number: int) -> _Maker:
        return self._makers[number % len(self._makers)]

    def document(self) -> dict[str, Any]:
        """Provenance of the set."""
        return self._pairs.document()


_PAIR, _TRUTH = "draw", "bounds"  # what a process is asked for, and what its time is counted as


class _Maker:
    """A process that makes what it is asked for; images come through shared memory, the rest over a socket.

    One pair at a time is asked for, as there is one memory for images. Threads may ask.
    """

    def __init__(self, seconds: dict[str, float]) -> None:
        self._seconds = seconds
        self._socket, theirs = socket.socketpair()
        self._line, self._reader = Connection(self._socket), -1
        self._sending, self._receiving = threading.Lock(), threading.Lock()
        self._asked = deque[tuple[str, int]]()
        self._ahead: int | None = None
        self._results: dict[tuple[str, int], Any] = {}
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
        self._ask_ahead(first)

    def pair(self, number: int, following: int | None) -> Any:
        """Pair of a number; then the next one is asked for. Raises as `result`."""
        ahead, self._ahead = self._ahead, None
        if ahead not in (number, None):  # nobody wants it any more
            with contextlib.suppress(Exception):  # nobody asked: its error is nobody's
                self.result(_PAIR, ahead)
        made = self.result(_PAIR, number)
        if following is not None:
            self._ask_ahead(following)
        return made

    def _ask_ahead(self, number: int) -> None:
        self._ahead = number
        with contextlib.suppress(TransportError):  # told when the pair is wanted
            self.ask(_PAIR, number)

    def result(self, kind: str, number: int) -> Any:
        """A pair or a truth that was asked for, or is asked for now.

        Raises
        ------
        DatasetError
            If the process has died. What it raised itself is raised here.
        """
        wanted = kind, number
        try:
            self.ask(*wanted)
            with self._receiving:
                while wanted not in self._results:
                    reply = self._received()
                    self._results[self._asked[0]] = reply
                    self._asked.popleft()
                made = self._results.pop(wanted)
        except TransportError as error:
            what = "a process that draws pairs died; most often memory has run out: take fewer --workers"
            raise DatasetError(what) from error
        if isinstance(made, BaseException):
            raise made
        return made

    def ask(self, kind: str, number: int) -> None:
        """Ask for a pair or a truth, unless it is asked for or there."""
        with self._sending:
            if (kind, number) not in self._results and (kind, number) not in self._asked:
                self._asked.append((kind, number))
                self._line.send(f"{kind} {number}".encode())

    def _received(self) -> Any:
        kind, *told = pickle.loads(self._line.receive())
        if kind == "error":
            return told[0] if isinstance(told[0], BaseException) else DatasetError(str(told[0]))
        if kind == "memory":
            _, handles, _, _ = socket.recv_fds(self._socket, 1, 1)
            self._give_back()
            self._reader, self._pages = handles[0], SharedPages(handles[0])
            return self._received()
        made, seconds = told
        self._seconds[kind] += seconds
        return unpack(made, self._pages).pair if kind == _PAIR else made

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
    with contextlib.suppress(TransportError):  # the other side has hung up
        maker.answer_all()


class _Making:
    """The other side of `_Maker`."""

    def __init__(self, end: socket.socket) -> None:
        self._socket, self._line = end, Connection(end)
        self._memory: MemoryFile | None = None

    def answer_all(self) -> None:
        told, pairs = self._line.receive(most=1 << 30), None
        while True:
            kind, _, number = self._line.receive().decode().partition(" ")
            try:
                pairs = pairs or pickle.loads(told)
                start = time.process_time()
                made = pairs.pair(int(number)) if kind == _PAIR else pairs.truth(int(number))
                seconds = time.process_time() - start
                self._send(kind, self._packed(made) if kind == _PAIR else made, seconds)
            except TransportError:
                raise
            except Exception as error:
                self._send("error", _picklable(error))

    def _packed(self, pair: Pair) -> bytes:
        """The message of a pair, whose images lie in the memory that both sides have."""
        if self._memory is None or self._memory.size < needed_bytes(pair):
            self._memory = MemoryFile(max(needed_bytes(pair), LEAST_BYTES))
            self._send("memory")
            socket.send_fds(self._socket, [b"m"], [self._memory.reader])
        return pack(pair, self._memory)

    def _send(self, *told: object) -> None:
        self._line.send(pickle.dumps(told, protocol=5))


def _picklable(error: Exception) -> Exception | str:
    """The error, or what it says where it cannot be sent as it is."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # an error of a library, with a file handle in it
        return f"{type(error).__name__}: {error}"
    return error
