"""Process of one method: started, asked for pairs, ended; and what it prints.

The process gets a short environment, in which no data set's path stands, and an empty working directory. It stays warm
from pair to pair. After a failure it is killed with all that it started, and the next pair gets a new one.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO, Any

from phibench.datasets.parallel import ONE_THREAD
from phibench.estimator.interface import Outcome, Pair
from phibench.estimator.sandbox.answers import AnswerError, checked
from phibench.estimator.sandbox.resolve import MethodError, Reference, RunLimits
from phibench.estimator.sandbox.transport import Connection, MemoryFile, TransportError, pack
from phibench.estimator.sandbox.worker import lacks_memory

_KEPT_BYTES = 65536
_READS = 16  # of 64 kB at a time
_LINES, _LINE_LENGTH = 20, 200  # of the output that an outcome keeps
_FRAME = re.compile(r'^  File "(.+)", line (\d+) in (.+)$')


class OutputTail:
    """The end of what a process prints; its pipe is emptied all the time, so that the process never waits.

    Parameters
    ----------
    pipe : binary file
        Standard output and error of the process.
    """

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe, self._tail, self._count, self._ended = pipe, b"", 0, False
        self._lock = threading.Lock()
        os.set_blocking(pipe.fileno(), False)
        self._thread = threading.Thread(target=self._drain, daemon=True)
        self._thread.start()

    def text(self, wait_s: float = 0.0, since: int = 0) -> str:
        """Text after the first `since` bytes, 64 kB at most; waits so long for the pipe to end."""
        self._thread.join(wait_s)
        with self._lock:
            self._take()
            new = min(self._count - since, len(self._tail))
            return self._tail[len(self._tail) - new :].decode(errors="replace")

    def count(self) -> int:
        """Bytes that were printed so far."""
        with self._lock:
            self._take()
            return self._count

    def _drain(self) -> None:
        with self._pipe:
            while not self._ended:
                select.select([self._pipe], [], [])
                with self._lock:
                    self._take()

    def _take(self) -> None:
        """Read what is in the pipe; not for ever from a process that prints without end."""
        for _ in range(_READS):
            if self._ended:
                return
            try:
                part = os.read(self._pipe.fileno(), _KEPT_BYTES)
            except BlockingIOError:
                return
            self._ended = not part
            self._count += len(part)
            self._tail = (self._tail + part)[-_KEPT_BYTES:]


def last_lines(text: str) -> str:
    """Last lines of an output, without the stack that a fatal signal prints."""
    own = text.partition("Fatal Python error:")[0].rstrip()
    return "\n".join(line[:_LINE_LENGTH] for line in own.splitlines()[-_LINES:])


def stack_place(text: str, file: str = "") -> str:
    """Place "my_phi.py, line 12, in f" in the last stack that faulthandler printed; of `file` if it is in there."""
    frames = list(_last_stack(text))
    own = [frame for frame in frames if frame[0] == file] or frames[:1]
    return f"{Path(own[0][0]).name}, line {own[0][1]}, in {own[0][2]}" if own else ""


def _last_stack(text: str) -> Iterator[tuple[str, str, str]]:
    """Frames (file, line, function), the innermost first."""
    for line in text[text.rfind("(most recent call first)") :].splitlines():
        if match := _FRAME.match(line):
            yield match[1], match[2], match[3]


_KEPT = re.compile(
    r"PATH|HOME|USER|LOGNAME|SHELL|LANG|LC_\w+|TZ|VIRTUAL_ENV|PYTHONHOME|LD_LIBRARY_PATH|DYLD_LIBRARY_PATH|XDG_CACHE_HOME"
    r"|(OMP|MKL|OPENBLAS|NUMBA|CUDA|NVIDIA|TORCH|TF|JAX|XLA)_\w+"
)


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
    paths = [str(Path(part).absolute()) for part in inherited.get("PYTHONPATH", "").split(os.pathsep) if part]
    if paths:
        kept["PYTHONPATH"] = os.pathsep.join(paths)
    python = {"PYTHONDONTWRITEBYTECODE": "1", "PYTHONUNBUFFERED": "1"}  # what it prints is read before it dies
    return {**ONE_THREAD, **kept, "PWD": folder, "TMPDIR": folder, **python}


_WORKER = "phibench.estimator.sandbox.worker"
_STACK_SECONDS = 0.3  # for a stack to be printed, and for the pipe to end
_NOT_RESTARTED = ("", "invalid")  # the process is as sound as before


class MethodProcess:
    """A method that is kept warm between pairs, and started anew after a failure.

    Parameters
    ----------
    reference : Reference
    limits : RunLimits
    """

    def __init__(self, reference: Reference, limits: RunLimits) -> None:
        self._reference, self._limits = reference, limits
        self._lock, self._closed = threading.Lock(), False
        self._process: _Running | None = None

    def start(self) -> None:
        """Start the process and import the method, unless it is there already.

        Raises
        ------
        MethodError
            If the method cannot be imported or its process does not start in time.
        """
        if self._process is not None:
            return
        with self._lock:
            if self._closed:
                raise MethodError(f"method '{self._reference.name}' was stopped")
            self._process = _Running()
        try:
            self._process.load(self._reference, self._limits)
        except MethodError:
            self.end()
            raise

    def ask(self, pair: Pair) -> Outcome:
        """Give the method one pair; never raises for what the method does."""
        try:
            self.start()
        except MethodError as error:
            return Outcome(pair.number, None, math.nan, "crash", f"the method's process did not start again: {error}")
        process = self._process
        if process is None:  # ended by `close` in between
            return Outcome(pair.number, None, math.nan, "crash", "the run was stopped")
        file = self._reference.place if self._reference.kind == "file" else ""
        outcome = process.ask(pair, self._limits, file)
        if outcome.failure not in _NOT_RESTARTED:
            self.end()
        return outcome

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


class _Running:
    """A process that runs."""

    def __init__(self) -> None:
        if os.name != "posix":
            raise MethodError("methods run in processes of their own on Linux and macOS only")
        ours, theirs = socket.socketpair()
        self._connection, self._memory = Connection(ours), MemoryFile()
        self._folder = tempfile.TemporaryDirectory(prefix="phibench-method-", ignore_cleanup_errors=True)
        handles = (theirs.fileno(), self._memory.reader)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", _WORKER, *map(str, handles)],
                pass_fds=handles,
                cwd=self._folder.name,
                env=environment(self._folder.name, os.environ),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # a group of its own: killed as a whole, and not hit by Ctrl-C
            )
        assert self._process.stdout is not None
        self._output = OutputTail(self._process.stdout)

    def load(self, reference: Reference, limits: RunLimits) -> None:
        """Let the process import the method."""
        order = {"reference": asdict(reference), "memory_mb": limits.memory_mb}
        try:
            self._connection.send(json.dumps(order).encode(), limits.start_seconds)
            fault = json.loads(self._connection.receive(limits.start_seconds))["fault"]
        except TimeoutError:
            place = self._place(reference.place)
            raise MethodError(
                f"method '{reference.name}' is not imported after {limits.start_seconds:g} s{place}: "
                "do the work in the function, not at import"
            ) from None
        except (TransportError, ValueError):
            raise MethodError(
                f"method '{reference.name}' cannot be imported: {self._death(reference.place)}{self._last_line()}"
            ) from None
        if fault:
            raise MethodError(fault)

    def ask(self, pair: Pair, limits: RunLimits, file: str) -> Outcome:
        """Answer or failure for one pair."""
        start, before = time.monotonic(), self._output.count()
        try:
            self._connection.send(pack(pair, self._memory), limits.seconds)
            reply = json.loads(self._connection.receive(max(limits.seconds - (time.monotonic() - start), 1e-3)))
        except TimeoutError:
            output = last_lines(self._output.text(since=before))  # before the stack is printed, too
            message = f"no answer after {limits.seconds:g} s{self._place(file)}"
            return Outcome(pair.number, None, math.nan, "timeout", message, output)
        except (TransportError, ValueError):
            return self._dead(pair, limits, file, before)
        return replace(outcome_of(pair, reply), output=last_lines(self._output.text(since=before)))

    def kill(self) -> None:
        """Kill the whole group and give back what it held."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._connection.close()
        self._memory.close()
        self._folder.cleanup()

    def _dead(self, pair: Pair, limits: RunLimits, file: str, before: int) -> Outcome:
        failure, message = "crash", self._death(file)
        text = self._output.text(since=before)
        if lacks_memory(text):
            failure, message = "memory", limits.memory_sentence(message)
        return Outcome(pair.number, None, math.nan, failure, message, last_lines(text))

    def _death(self, file: str) -> str:
        """The end of the process in a few words."""
        text = self._output.text(_STACK_SECONDS)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_STACK_SECONDS)
        code = self._process.poll()
        if code is None:
            return "the process broke its connection to the runner"
        if code >= 0:
            return f"the process left with exit code {code}, without an answer"
        place = stack_place(text, file)
        return f"the process died of {_signal_name(-code)}" + (f" at {place}" if place else "")

    def _place(self, file: str) -> str:
        """The line at which a process is that still runs."""
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(signal.SIGUSR1)
        place = stack_place(self._output.text(_STACK_SECONDS), file)
        return f", at {place}" if place else ""

    def _last_line(self) -> str:
        lines = self._output.text().strip().splitlines()
        return f"; its last words: {lines[-1]}" if lines else ""


def outcome_of(pair: Pair, reply: dict[str, Any]) -> Outcome:
    """Outcome of a pair from the reply of `worker.reply_of`; what is no answer is the failure "invalid"."""
    seconds = float(reply["seconds"])
    if reply["failure"]:
        return Outcome(pair.number, None, seconds, reply["failure"], reply["message"])
    try:
        return Outcome(pair.number, checked(reply["answer"]), seconds)
    except AnswerError as error:
        return Outcome(pair.number, None, seconds, "invalid", str(error))


def _signal_name(number: int) -> str:
    name = signal.Signals(number).name
    meaning = {
        "SIGSEGV": "a fault in compiled code",
        "SIGABRT": "compiled code gave up",
        "SIGKILL": "killed from outside, perhaps by the system for want of memory",
    }
    return f"{name} ({meaning[name]})" if name in meaning else name
