"""Supervisor of a method's process: starts the worker, and ends it with all that it has started.

Run as ``python -m phibench.benchmark.isolation.supervisor SOCKET MEMORY``. It starts the worker and does nothing but
wait. When the worker ends, or the runner hangs up or dies, it kills all that the worker has started and removes the
working folder. On Linux it is a child subreaper: a daemon in a session of its
own (setsid) becomes its child when its parent dies. The worker is killed if its supervisor dies (parent-death signal).
It ends as the worker did: with the same exit code, or of the same signal.

Little but the standard library is imported here, so that the process is small and the worker starts from it quickly.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import select
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from phibench.datasets.store.temporary_folders import remove_tree

HUNG_UP = 97
"""Exit code of a supervisor whose runner hung up before the worker ended."""
KILL_SECONDS = 10.0
"""For processes that start others while they are killed."""
_PROC = Path("/proc")
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36  # linux/prctl.h
_LOOK_SECONDS = 1.0  # the runner's death is looked for this often, should no signal or hang-up tell


def main() -> None:
    """Start the worker, wait for its end or the runner's, and leave nothing behind."""
    line, reader = (int(text) for text in sys.argv[1:])
    runner, own, folder = os.getppid(), os.getpid(), Path.cwd()
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)
    worker = os.fork()
    if worker == 0:
        _be_worker(own, line, reader)
        return
    status = _wait(worker, line, runner)
    end_descendants(worker)
    remove_tree(folder)
    _leave_as(status)


def _be_worker(supervisor: int, line: int, reader: int) -> None:
    """Become the process in which the method runs."""
    os.setsid()  # what it sends to its own group does not reach the supervisor
    _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != supervisor:  # it died before it could have told
        os._exit(1)
    with contextlib.suppress(OSError):  # where memory runs out, the system ends this process first, and not the run
        Path("/proc/self/oom_score_adj").write_text("1000")
    from phibench.benchmark.isolation.isolation import isolated_by  # after the fork: the supervisor stays small

    isolation = isolated_by(sys.stdin)
    from phibench.benchmark.isolation.method_worker import (
        main as work,  # its libraries may start threads: after the isolation
    )

    work(line, reader, isolation)


def _wait(worker: int, line: int, runner: int) -> int | None:
    """Wait status of the worker; None if the runner hung up, died or sent SIGTERM before."""
    told, tell = os.pipe()
    os.set_blocking(told, False)
    os.set_blocking(tell, False)
    stopped: list[int] = []
    signal.set_wakeup_fd(tell)  # a signal ends the wait below
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.signal(signal.SIGUSR1, lambda *_: _send(worker, signal.SIGUSR1))  # the runner asks for the method's stack
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(number, lambda number, _: stopped.append(number))
    events = select.poll()
    events.register(told, select.POLLIN)
    events.register(line, 0)  # a hang-up is told unasked
    while True:
        for pid, status in _ended():
            if pid == worker:
                return status
        if stopped or os.getppid() != runner:
            return None  # the run was stopped, or is gone
        for handle, _ in events.poll(int(1000 * _LOOK_SECONDS)):
            if handle == line:
                return None  # the run has hung up
            with contextlib.suppress(BlockingIOError):
                os.read(told, 4096)  # signals are one byte each


def _ended() -> Iterator[tuple[int, int]]:
    """Children that have ended, the method's orphans included, with their wait statuses."""
    with contextlib.suppress(ChildProcessError):  # no children are left
        while True:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                return  # those that are left still run
            yield pid, status


def end_descendants(worker: int) -> None:
    """Kill all descendants of this process, whatever their sessions, and the worker's group; until none is left.

    Orphans become children of this process: whoever kills its children again and again reaches all. A look at them is
    faster than a process can start others, a look at all processes of a busy machine is not.
    """
    own, end = os.getpid(), time.monotonic() + KILL_SECONDS
    groups = {worker}
    while time.monotonic() < end:
        known = len(groups)
        for pid, group in (_children(own) or _descendants(own)).items():
            groups.add(group)
            _send(pid, signal.SIGKILL)
        for group in groups - {os.getpgrp()}:  # as a whole: a process that is being forked does not get away
            with contextlib.suppress(OSError):  # the group has ended
                os.killpg(group, signal.SIGKILL)
        list(_ended())
        if sys.platform != "linux":  # without a subreaper there is no more to be known
            return
        try:
            os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        except ChildProcessError:  # without a child there is no descendant
            return
        if len(groups) == known:
            time.sleep(0.001)  # a group that was killed takes a moment to end


def _children(parent: int) -> dict[int, int]:
    """Process groups of children, by process, of those that have ended as well; none where the system does not tell."""
    groups = {}
    with contextlib.suppress(OSError, ValueError):  # the kernel was built without that list
        for pid in map(int, (_PROC / f"{parent}/task/{parent}/children").read_text().split()):
            with contextlib.suppress(OSError):
                groups[pid] = os.getpgid(pid)
    return groups


def _descendants(ancestor: int) -> dict[int, int]:
    """Process groups of all living descendants, by process; none where the system has no /proc."""
    parents, groups = {}, {}
    for entry in _PROC.glob("[0-9]*/stat"):
        with contextlib.suppress(OSError, ValueError, IndexError):  # gone meanwhile
            state, parent, group = entry.read_text(errors="replace").rpartition(")")[2].split()[:3]
            if state not in "ZX":
                pid = int(entry.parent.name)
                parents[pid], groups[pid] = int(parent), int(group)
    descendants, added = set[int](), {ancestor}
    while added:
        added = {pid for pid, parent in parents.items() if parent in added} - descendants
        descendants |= added
    return {pid: groups[pid] for pid in descendants}


def processes_in(folder: str) -> Iterator[int]:
    """Processes of this user that work in a folder or have it as their TMPDIR; none where there is no /proc."""
    mark = os.fsencode(f"TMPDIR={folder}") + b"\0"
    for entry in _PROC.glob("[0-9]*"):
        with contextlib.suppress(OSError):  # a process that ended, or of another user
            place = (entry / "cwd").readlink()
            if f"{place}/".startswith(f"{folder}/") or mark in (entry / "environ").read_bytes():
                yield int(entry.name)


def _send(pid: int, number: int) -> None:
    with contextlib.suppress(OSError):  # it has ended
        os.kill(pid, number)


def _leave_as(status: int | None) -> None:
    """End as the worker did."""
    code = HUNG_UP if status is None else os.waitstatus_to_exitcode(status)
    if code < 0:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # the worker's own core file is enough
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code if code >= 0 else HUNG_UP)


def _prctl(option: int, value: int) -> None:
    """Linux alone has it; elsewhere the process group and the hang-up are what there is."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):  # a system without prctl
            ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


if __name__ == "__main__":
    main()
