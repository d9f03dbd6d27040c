"""Isolated processes of others' code: `GuestProcess` of a method or policy, `MethodProcess` that is asked for pairs.

The process gets a short environment, in which no data set's path stands, and an empty working directory. It stays warm
from pair to pair. After a failure it is killed with all that it started, and the next pair gets a new one.

Nothing that comes back is trusted: replies that repeat another nonce are dropped, texts are escaped and cut.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from phibench.benchmark.isolation.answers import MESSAGE_LENGTH, most_bytes, outcome_of
from phibench.benchmark.isolation.isolation import Access, Isolation
from phibench.benchmark.isolation.method_provenance import MOST_NAMES, OpenedFiles
from phibench.benchmark.isolation.method_references import Reference
from phibench.benchmark.isolation.method_worker import lacks_memory
from phibench.benchmark.isolation.pair_transport import (
    LEAST_BYTES,
    AnyPair,
    Connection,
    MemoryFile,
    TransportError,
    needed_bytes,
    pack,
    repeat_message,
)
from phibench.benchmark.isolation.printed_output import OutputTail, advised_message, last_lines, stack_place
from phibench.benchmark.isolation.readable_files import access_of
from phibench.benchmark.isolation.run_limits import MethodError, RunLimits
from phibench.benchmark.isolation.supervisor import HUNG_UP, KILL_SECONDS, processes_in
from phibench.datasets.common.parallel import ONE_THREAD
from phibench.datasets.store.temporary_folders import OwnedFolder
from phibench.estimator.dense.dense_interface import DensePair
from phibench.estimator.interface import Outcome
from phibench.scenes.validation import printable_line

_NO_PAIR: AnyPair | None = None


_KEPT = re.compile(
    r"PATH|HOME|USER|LOGNAME|SHELL|LANG|LC_\w+|TZ|VIRTUAL_ENV|PYTHONHOME|LD_LIBRARY_PATH|DYLD_LIBRARY_PATH|XDG_CACHE_HOME"
    r"|(OMP(?!_PROC_BIND|_PLACES)|MKL|OPENBLAS|NUMBA|CUDA|NVIDIA|TORCH|TF|JAX|XLA)_\w+"
)
"""Of OpenMP not what binds threads to cores: a process may bind its first thread alone."""


def environment(folder: str, inherited: Mapping[str, str]) -> dict[str, str]:
    """Environment of a method's process: names that libraries need, and a folder of its own for temporary files.

    Parameters
    ----------
    folder : str
        The working directory.
    inherited : mapping
        The parent's environment.
    """
    kept = {name: value for name, value in inherited.items() if _KEPT.fullmatch(name)}
    paths = [str(Path(place).absolute()) for place in inherited.get("PYTHONPATH", "").split(os.pathsep) if place]
    if paths:
        kept["PYTHONPATH"] = os.pathsep.join(paths)
    python = {"PYTHONDONTWRITEBYTECODE": "1", "PYTHONUNBUFFERED": "1"}  # what it prints is read before it dies
    caches = {"MPLCONFIGDIR": folder, "NUMBA_CACHE_DIR": folder}  # Matplotlib and Numba raise if they cannot write
    return {**ONE_THREAD, **kept, "PWD": folder, "TMPDIR": folder, **caches, **python}


_SUPERVISOR = "phibench.benchmark.isolation.supervisor"
_REPLY_BYTES = 1 << 20  # an answer has some hundreds
_MOST_STALE = 64  # replies to other questions that are dropped before the process is given up
_END_SECONDS = KILL_SECONDS + 1.0  # the supervisor needs the first part
_STACK_SECONDS = 0.3  # for a stack to be printed, and for the pipe to end
_NOT_RESTARTED = ("", "invalid")  # the process is as sound as before


class MethodProcess:
    """A method that is kept warm between pairs, and started anew after a failure; or several built-in ones.

    Built-in methods may have one process together. They get a pair once and share what they begin with
    (`spot_search.SharedWork`). A method of another's has its process alone: nothing that it does reaches others.

    Parameters
    ----------
    hidden : sequence of Path
        Folders with the truth, which the method cannot read.
    others : sequence of Reference
        Further methods of the process, built-in like the first.

    Raises
    ------
    MethodError
        If the method lies in one of them, or a path that is allowed does; or if methods of others would share it.
    """

    def __init__(
        self, reference: Reference, limits: RunLimits, hidden: Sequence[Path] = (), others: Sequence[Reference] = ()
    ) -> None:
        self._reference, self._references, self._limits = reference, (reference, *others), limits
        if others and any(one.kind != "built-in" for one in self._references):
            raise MethodError("built-in methods alone share a process: ask methods of your own one by one")
        self.stages: dict[str, float] = {}
        self.loaded = set[str]()
        """Names of modules that the process has told of: `method_provenance.loaded_names`."""
        self._access, self._isolation = access_of(reference, limits, hidden), Isolation(reason="it did not start")
        self._lock, self._closed = threading.Lock(), False
        self._process: GuestProcess | None = None

    @property
    def reference(self) -> Reference:
        """The method, or the first of several."""
        return self._reference

    @property
    def isolation(self) -> Isolation:
        """Isolation of the process that was started last."""
        return self._isolation

    def start(self, size: int = 0) -> None:
        """Start the process and import the method, unless it is there already.

        Parameters
        ----------
        size : int
            Bytes that the images of a pair take.

        Raises
        ------
        MethodError
            If the method cannot be imported or its process does not start in time.
        """
        if self._process is not None:
            return  # it runs already
        with self._lock:
            if self._closed:
                raise MethodError(f"method '{self._reference.name}' was stopped")
            process = self._process = GuestProcess(max(2 * size, LEAST_BYTES), self._access)
        try:
            self._isolation = process.load(self._references, self._limits)
        except BaseException:  # Ctrl-C too: no process stays
            self.end()
            raise
        self.loaded |= process.loaded

    def watch(self) -> OpenedFiles:
        """Watch over the files that the method may read and that no package holds, from now on."""
        places = [(f"allow: {Path(name).absolute().name}", Path(name)) for name in self._limits.allow]
        if self._reference.kind == "file":
            places.insert(0, ("", Path(self._reference.place).parent))
        return OpenedFiles(places, [Path(path) for path in self._access.hidden])

    def ask(self, pair: AnyPair, method: int = 0) -> Outcome:
        """Give a method one pair; never raises for what the method does."""
        try:
            outcome = self._asked(pair, method)
        except Exception as error:  # one pair must never end a run, whatever was not thought of
            text = f"{type(error).__name__}: {error}"
            outcome = Outcome(pair.number, None, math.nan, "crash", f"the method's process cannot be used: {text}")
        if self._limits.fresh or outcome.failure not in _NOT_RESTARTED:
            self.end()
        message = printable_line(outcome.message, MESSAGE_LENGTH)
        if outcome.failure == "error":
            message = advised_message(message, self._isolation, outcome.output, self._access.hidden)
        return replace(outcome, message=message)

    def ask_each(self, pair: AnyPair) -> tuple[Outcome, ...]:
        """Give one pair to the methods, one after the other."""
        return tuple(self.ask(pair, method) for method in range(len(self._references)))

    def _asked(self, pair: AnyPair, method: int) -> Outcome:
        size = needed_bytes(pair)
        if self._process is not None and not self._process.is_ready(size):
            self.end()
        try:
            self.start(size)
        except MethodError as error:
            return Outcome(pair.number, None, math.nan, "crash", f"the method's process did not start again: {error}")
        process = self._process
        if process is None:  # ended by `close` in between
            return Outcome(pair.number, None, math.nan, "crash", "the run was stopped")
        file = self._reference.place if self._reference.kind == "file" else ""
        outcome = process.ask(pair, self._limits, file, method)
        if len(self.loaded) < MOST_NAMES:
            self.loaded |= process.loaded
        if len(self._references) > 1:
            self._add(process.stages, self._references[method].name)
        return outcome

    def _add(self, stages: dict[str, float], name: str) -> None:
        for stage, seconds in stages.items():
            stage = stage or name
            self.stages[stage] = self.stages.get(stage, 0.0) + seconds

    def end(self) -> None:
        """Kill the process with all that it started; the next question starts another."""
        with self._lock:
            process, self._process = self._process, None
            if process is not None:
                process.kill()

    def close(self) -> None:
        """End for good."""
        with self._lock:
            self._closed = True
        self.end()


class GuestProcess:
    """A process that runs, under a supervisor and isolated: of methods, or of a policy.

    What comes back is JSON of bounded size, and has a deadline for the whole message; none of it is unpickled.

    Parameters
    ----------
    size : int
        Bytes for the images of a pair.
    access : Access
        Files that it may read.
    serves : str
        Module of ours whose `serve` answers in the process; "" for the one of methods.
    """

    def __init__(self, size: int, access: Access, serves: str = "") -> None:
        self._serves, self._kind = serves, "policy" if serves else "method"
        if os.name != "posix":
            raise MethodError("code of others runs in processes of its own on Linux and macOS only")
        ours, theirs = socket.socketpair()
        self._connection, self._memory = Connection(ours), MemoryFile(size)
        self._shares, self._held, self.stages = False, _NO_PAIR, dict[str, float]()
        self.loaded = frozenset[str]()
        self._owned = OwnedFolder("method")
        self._folder = str(self._owned.path)
        try:
            with theirs:
                self._process = self._started(access, theirs.fileno(), self._memory.reader)
        except OSError as error:
            self._give_back()
            raise MethodError(f"no process can be started for a {self._kind}: {error.strerror or error}") from error
        assert self._process.stdout is not None
        self._output = OutputTail(self._process.stdout)

    def _started(self, access: Access, *handles: int) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            [sys.executable, "-m", _SUPERVISOR, *map(str, handles)],
            pass_fds=handles,
            cwd=self._folder,
            env=environment(self._folder, os.environ),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # not hit by Ctrl-C
        )
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError), process.stdin as pipe:  # it ended at once: `load` tells why
            pipe.write(access.text().encode())
        return process

    def _give_back(self) -> None:
        self._connection.close()
        self._memory.close()
        self._owned.close()

    def load(self, references: Sequence[Reference], limits: RunLimits) -> Isolation:
        """Let the process import its methods; its isolation, which it tells before any code of a method runs."""
        nonce, end, reference = secrets.token_hex(8), time.monotonic() + limits.start_seconds, references[0]
        self._shares = len(references) > 1
        order = {
            "nonce": nonce,
            "references": [asdict(each) for each in references],
            "memory_mb": limits.memory_mb,
            "serves": self._serves,
        }
        try:
            isolation = Isolation(**json.loads(self._connection.receive(limits.start_seconds)))
            self._connection.send(json.dumps(order).encode(), limits.start_seconds)
            reply = self._reply(nonce, end)
            fault = reply.get("fault")
        except TimeoutError:
            place = self._place(reference.place)
            raise MethodError(
                f"{self._kind} '{reference.name}' is not imported after {limits.start_seconds:g} s{place}: "
                "do the work in the function, not at import"
            ) from None
        except TransportError:
            why = f"{self.death(reference.place)}{self._last_line()}"
            raise MethodError(f"{self._kind} '{reference.name}' cannot be imported: {why}") from None
        if fault != "":
            raise MethodError(advised_message(printable_line(str(fault), MESSAGE_LENGTH), isolation))
        self.loaded = _names(reply)
        return isolation

    def is_ready(self, size: int) -> bool:
        """Tell that a pair of so many bytes can be asked, and that nothing is left of the one before."""
        return size <= self._memory.size and self._connection.is_silent()

    def ask(self, pair: AnyPair, limits: RunLimits, file: str, method: int = 0) -> Outcome:
        """Answer or failure of a method for one pair."""
        nonce, before, self.stages = secrets.token_hex(8), self._output.count(), {}
        message = repeat_message(nonce, method) if self._held is pair else pack(pair, self._memory, nonce, method)
        self._held = pair if self._shares else _NO_PAIR
        start = time.monotonic()  # by this clock alone: the method's process could tell any time
        try:
            most = most_bytes(pair.shape) if isinstance(pair, DensePair) else _REPLY_BYTES
            reply = self.exchange(message, nonce, pair.number, limits.seconds, most)
        except TimeoutError:
            output = last_lines(self._output.text(since=before))  # before the stack is printed, too
            late = f"no answer after {limits.seconds:g} s{self._place(file)}"
            return Outcome(pair.number, None, math.nan, "timeout", late, output)
        except TransportError:
            return self._dead(pair, limits, file, before)
        seconds = time.monotonic() - start
        self.loaded = _names(reply) or self.loaded
        if self._shares:  # built-in methods tell the truth; of others nothing but the answer counts
            seconds += reply["reused_seconds"]
            self.stages = {**reply["stages"], "": reply["own_seconds"]}
        outcome = outcome_of(pair, reply, seconds)
        return replace(outcome, output=last_lines(self._output.text(since=before)))

    def exchange(
        self, message: bytes, nonce: str, number: int, seconds: float, most: int = _REPLY_BYTES
    ) -> dict[str, Any]:
        """Reply of at most so many bytes to a message, which repeats nonce and number, in time; raises as `_reply`."""
        end = time.monotonic() + seconds
        self._connection.send(message, seconds)
        return self._reply(nonce, end, number, most)

    def kill(self) -> None:
        """End the process with all that it started and give back what it held; never raises."""
        self._connection.hang_up()  # the supervisor then kills what there is
        try:
            self._process.wait(_END_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.returncode == -signal.SIGKILL:  # perhaps before it had killed what was below it
            for pid in processes_in(self._folder):
                with contextlib.suppress(OSError):  # ended in the meantime
                    os.kill(pid, signal.SIGKILL)
        self._output.close()
        self._give_back()

    def _reply(self, nonce: str, end: float, number: int | None = None, most: int = _REPLY_BYTES) -> dict[str, Any]:
        """Reply to a question; what else comes on the line is dropped.

        Raises
        ------
        TimeoutError
            If there is none at `end`, a time of the monotonic clock.
        TransportError
            If the other side is gone or sends anything but the reply.
        """
        for _ in range(_MOST_STALE):
            left = max(end - time.monotonic(), 1e-3)  # 0 would mean to wait for ever
            try:
                reply = json.loads(self._connection.receive(left, most))
            except (ValueError, RecursionError):  # no JSON, or brackets without end
                continue
            if isinstance(reply, dict) and (reply.get("nonce"), reply.get("number")) == (nonce, number):
                return reply
        raise TransportError("too many replies that belong to no question")

    def _dead(self, pair: AnyPair, limits: RunLimits, file: str, before: int) -> Outcome:
        failure, message = "crash", self.death(file)
        text = self._output.text(since=before)
        if lacks_memory(text):
            failure, message = "memory", limits.memory_sentence(message)
        return Outcome(pair.number, None, math.nan, failure, message, last_lines(text))

    def death(self, file: str) -> str:
        """The end of the process in a few words."""
        text = self._output.text(_STACK_SECONDS)
        with contextlib.suppress(subprocess.TimeoutExpired):  # it still runs
            self._process.wait(_STACK_SECONDS)
        code = self._process.poll()
        if code in (None, HUNG_UP):
            return "the process broke its connection to the runner"
        if code >= 0:
            return f"the process left with exit code {code}, without an answer"
        place = stack_place(text, file)
        return f"the process died of {_signal_name(-code)}" + (f" at {place}" if place else "")

    def _place(self, file: str) -> str:
        """The line at which a process is that still runs."""
        with contextlib.suppress(ProcessLookupError):  # it has ended
            self._process.send_signal(signal.SIGUSR1)
        place = stack_place(self._output.text(_STACK_SECONDS), file)
        return f", at {place}" if place else ""

    def _last_line(self) -> str:
        lines = self._output.text().strip().splitlines()
        return f"; its last words: {lines[-1]}" if lines else ""


def _names(reply: dict[str, Any]) -> frozenset[str]:
    """Modules that a reply tells of; empty if it tells of none, or not in the form of names."""
    told = reply.get("loaded")
    names = told[:MOST_NAMES] if isinstance(told, list) else []
    return frozenset(name for name in names if isinstance(name, str) and name == printable_line(name))


def _signal_name(number: int) -> str:
    try:
        name = signal.Signals(number).name
    except ValueError:  # a real-time signal between the first and the last has no name
        return f"signal {number}"
    meaning = {
        "SIGSEGV": "a fault in compiled code",
        "SIGABRT": "compiled code gave up",
        "SIGKILL": "killed from outside, perhaps by the system for want of memory",
    }
    return f"{name} ({meaning[name]})" if name in meaning else name
