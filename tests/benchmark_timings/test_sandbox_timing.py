"""Time that the sandbox adds to a pair, `pytest --benchmark-enable --benchmark-only`; targets are stated only."""

from __future__ import annotations

import pickle
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.sandbox_pairs import GOOD, SmallPairs, method_file

from phibench.benchmark.isolation.guest_process import MethodProcess
from phibench.benchmark.isolation.method_references import resolve
from phibench.benchmark.isolation.pair_transport import Connection, MemoryFile, SharedPages, pack, unpack
from phibench.benchmark.isolation.run_limits import RunLimits
from phibench.estimator.interface import Pair


def large() -> Pair:
    """Four frames of 1280 x 720 x 3 bytes: 11 MB."""
    small = SmallPairs().pair(0)
    frames = [np.random.default_rng(k).integers(0, 255, (720, 1280, 3), np.uint8) for k in range(4)]
    return Pair(0, frames[0], frames[1], small.rig, 0.5, small.card, frames[2], frames[3])


@pytest.mark.benchmark(group="a pair's way")
def test_benchmark_shared_memory(benchmark) -> None:
    """Pack, private copy, comparison afterwards. Target: <= 20 ms, little against making the pair (0.3 s and more)."""
    pair, memory = large(), MemoryFile()
    pages = SharedPages(memory.reader)
    assert benchmark(lambda: unpack(pack(pair, memory), pages).unchanged())


@pytest.mark.benchmark(group="a pair's way")
def test_benchmark_socket(benchmark) -> None:
    """The alternative: the pair as a pickle through a socket, without any comparison."""
    pair = large()
    near, far = (Connection(end) for end in socket.socketpair())

    def there() -> object:
        message = pickle.dumps(pair, protocol=5)
        thread = threading.Thread(target=near.send, args=(message,))
        thread.start()
        received = pickle.loads(far.receive())
        thread.join()
        return received

    assert benchmark(there) is not None


@pytest.mark.benchmark(group="the sandbox")
def test_benchmark_empty_method_on_full_frames(benchmark, tmp_path: Path) -> None:
    """Target: <= 30 ms a pair."""
    process = MethodProcess(resolve(method_file(tmp_path, f"return {GOOD.replace('0, 0', '0, 0, 0')}")), RunLimits())
    pair = large()
    try:
        assert benchmark(lambda: process.ask(pair)).failure == ""
    finally:
        process.close()


@pytest.mark.benchmark(group="isolation")
def test_benchmark_isolation(benchmark, tmp_path: Path) -> None:
    """A process that isolates itself and leaves, against one that leaves. Target: <= 10 ms more at each start.

    By turns, and the shortest of each is compared: what else the machine does is longer than the difference.
    """
    text = "from phibench.benchmark.isolation.isolation import *\nif {}: assert isolate(Access()).complete"
    seconds: dict[bool, list[float]] = {False: [], True: []}

    def start(isolated: bool) -> None:
        began = time.perf_counter()
        subprocess.run([sys.executable, "-c", text.format(isolated)], cwd=tmp_path, check=True)
        seconds[isolated].append(time.perf_counter() - began)

    benchmark.pedantic(start, args=(True,), setup=lambda: start(False), rounds=30)
    plain, isolated = (1e3 * min(seconds[kind]) for kind in (False, True))
    print(f"\n{plain:.1f} ms, isolated {isolated:.1f} ms: {isolated - plain:.1f} ms more, ratio {isolated / plain:.2f}")
    benchmark.extra_info.update(more_ms=isolated - plain, ratio=isolated / plain)


@pytest.mark.benchmark(group="the sandbox")
def test_benchmark_restart(benchmark, tmp_path: Path) -> None:
    """What a failure costs besides its pair: a new process. Target: <= 1 s."""
    process = MethodProcess(resolve(method_file(tmp_path, "1 / 0")), RunLimits())
    pair = SmallPairs().pair(0)
    assert benchmark.pedantic(lambda: process.ask(pair), rounds=5).failure == "error"
    process.close()
