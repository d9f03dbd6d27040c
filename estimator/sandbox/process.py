"""What a method prints: read all the time, so that it never has to wait, and only the end kept.

What a method's process is given of the machine: a short environment, in which no data set's path stands.

One method in a process of its own: started, asked, ended.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from phibench.datasets.parallel import ONE_THREAD
from phibench.estimator.interface import Outcome, Pair
from phibench.estimator.sandbox.answers import AnswerError, checked
from phibench.estimator.sandbox.resolve import MethodError, Reference, RunLimits
from phibench.estimator.sandbox.transport import Channel, ChannelError, MemoryFile, pack

_KEPT_BYTES = 65536
_FRAME = re.compile(r'^  File "(.+)", line (\d+) in (.+)$')


class Printed:
    """Drains a pipe.

    Parameters
    ----------
    pipe : binary file
        What the process writes to its standard output and error.
    """

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe, self._tail = pipe, b""
        self._thread = threading.Thread(target=self._drain, daemon=True)
        self._thread.start()

    def text(self, wait_s: float = 0.0) -> str:
        """The last 64 kB; waits so long for the pipe to end."""
        self._thread.join(wait_s)
        return self._tail.decode(errors="replace")

    def _drain(self) -> None:
        with self._pipe:
            while part := self._pipe.read1(_KEPT_BYTES):  # type: ignore[attr-defined]
                self._tail = (self._tail + part)[-_KEPT_BYTES:]


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
    return {**ONE_THREAD, **kept, "PWD": folder, "TMPDIR": folder, "PYTHONDONTWRITEBYTECODE": "1"}


_CHILD = "phibench.estimator.sandbox.worker"
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
        self._channel, self._memory = Channel(ours), MemoryFile()
        self._folder = tempfile.TemporaryDirectory(prefix="phibench-method-", ignore_cleanup_errors=True)
        handles = (theirs.fileno(), self._memory.reader)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", _CHILD, *map(str, handles)],
                pass_fds=handles,
                cwd=self._folder.name,
                env=environment(self._folder.name, os.environ),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # a group of its own: killed as a whole, and not hit by Ctrl-C
            )
        assert self._process.stdout is not None
        self._printed = Printed(self._process.stdout)

    def load(self, reference: Reference, limits: RunLimits) -> None:
        """Let the process import the method."""
        order = {"reference": asdict(reference), "memory_bytes": limits.memory_mb * 1e6}
        try:
            self._channel.send(json.dumps(order).encode(), limits.start_seconds)
            fault = json.loads(self._channel.receive(limits.start_seconds))["fault"]
        except TimeoutError:
            place = self._place(reference.place)
            raise MethodError(
                f"method '{reference.name}' is not imported after {limits.start_seconds:g} s{place}: "
                "do the work in the function, not at import"
            ) from None
        except (ChannelError, ValueError):
            raise MethodError(
                f"method '{reference.name}' cannot be imported: {self._death(reference.place)}{self._last_line()}"
            ) from None
        if fault:
            raise MethodError(fault)

    def ask(self, pair: Pair, limits: RunLimits, file: str) -> Outcome:
        """Answer or failure for one pair."""
        start = time.monotonic()
        try:
            self._channel.send(pack(pair, self._memory), limits.seconds)
            reply = json.loads(self._channel.receive(max(limits.seconds - (time.monotonic() - start), 1e-3)))
        except TimeoutError:
            return Outcome(
                pair.number, None, math.nan, "timeout", f"no answer after {limits.seconds:g} s{self._place(file)}"
            )
        except (ChannelError, ValueError):
            return self._dead(pair, file)
        return outcome_of(pair, reply)

    def kill(self) -> None:
        """Kill the whole group and give back what it held."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._channel.close()
        self._memory.close()
        self._folder.cleanup()

    def _dead(self, pair: Pair, file: str) -> Outcome:
        message = self._death(file)
        failure = "memory" if "bad_alloc" in self._printed.text() else "crash"
        return Outcome(pair.number, None, math.nan, failure, message)

    def _death(self, file: str) -> str:
        """How the process ended."""
        text = self._printed.text(_STACK_SECONDS)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_STACK_SECONDS)
        code = self._process.poll()
        if code is None:
            return "the process broke its line to the harness"
        if code >= 0:
            return f"the process left with exit code {code}, without an answer"
        place = stack_place(text, file)
        return f"the process died of {_signal_name(-code)}" + (f" at {place}" if place else "")

    def _place(self, file: str) -> str:
        """Where a process is that still runs."""
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(signal.SIGUSR1)
        place = stack_place(self._printed.text(_STACK_SECONDS), file)
        return f", at {place}" if place else ""

    def _last_line(self) -> str:
        lines = self._printed.text().strip().splitlines()
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
