"""A method in a process of its own: what it may do to itself, what it may not see, and that the run goes on."""

from __future__ import annotations

import math
import mmap
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pytest
from helpers.processes import processes_under, wait_until
from helpers.sandbox_pairs import GOOD, HEADER, SHAPE, SmallPairs, method_file

from phibench.benchmark.isolation.guest_process import MethodProcess, environment
from phibench.benchmark.isolation.method_references import resolve
from phibench.benchmark.isolation.pair_transport import (
    LARGEST,
    LEAST_BYTES,
    Connection,
    MemoryFile,
    SharedPages,
    TransportError,
    needed_bytes,
    pack,
    unpack,
)
from phibench.benchmark.isolation.printed_output import stack_place
from phibench.benchmark.isolation.run_limits import MethodError, RunLimits
from phibench.benchmark.isolation.runner import Harness, outcomes, run_method
from phibench.estimator.dense.dense_interface import DensePair
from phibench.estimator.interface import FAILURES, Outcome, Pair
from phibench.estimator.pair_set import ImageTruth, PairTruth

LIMITS = RunLimits(seconds=3.0, memory_mb=1000.0)

# what the method does to each pair by its number; every second pair is answered, so that each failure is survived
MISDEEDS = {
    1: ("error", "raise KeyError('no such thing')"),
    3: ("timeout", "while True: pass"),
    5: ("crash", "os._exit(3)"),
    7: ("crash", "ctypes.string_at(0)"),
    9: ("memory", "np.ones(500_000_000)"),  # 4 GB; the limit is 1 GB above what was there
    11: ("mutated", "pair.down[0, 0] = 0"),
    13: ("mutated", "ctypes.memset(pair.down.ctypes.data, 0, 8)"),
    15: ("invalid", "return 'nonsense'"),
    17: ("invalid", "return Answer(Spot((float('nan'), 2.0)), Spot.missing('x'))"),
    19: ("error", "sys.exit()"),
}
LAST = 21


def misbehaving(folder: Path) -> str:
    lines = ["import ctypes, os, sys", "print('chatter ' * 25_000)", "print('on stderr', file=sys.stderr)"]
    lines += [f"if pair.number == {number}:\n    {deed}" for number, (_, deed) in MISDEEDS.items()]
    return method_file(folder, "\n".join([*lines, f"return {GOOD}"]))


@pytest.fixture(scope="module")
def survived(tmp_path_factory: pytest.TempPathFactory) -> list[Outcome]:
    return run_method(misbehaving(tmp_path_factory.mktemp("method")), SmallPairs(LAST), LIMITS)


def test_every_misdeed_costs_its_own_pair_alone(survived: list[Outcome]) -> None:
    assert [outcome.number for outcome in survived] == list(range(LAST))
    found = {outcome.number: outcome.failure for outcome in survived if outcome.failure}
    assert found == {number: failure for number, (failure, _) in MISDEEDS.items()}
    assert set(found.values()) == set(FAILURES)  # every kind there is was provoked
    good = [outcome for outcome in survived if not outcome.failure]
    assert len(good) == LAST - len(MISDEEDS)
    for outcome in good:
        assert outcome.answer is not None
        assert outcome.answer.down.uv_px == (outcome.number + 100.0, 2.0)
        assert 0.0 <= outcome.seconds < LIMITS.seconds


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (1, "KeyError: 'no such thing' (my_phi.py, line 10, in extract)"),
        (3, "no answer after 3 s, at my_phi.py, line 12, in extract"),
        (5, "the process left with exit code 3, without an answer"),
        (7, "the process died of SIGSEGV (a fault in compiled code) at my_phi.py, line 16, in extract"),
        (9, "more memory than the limit of 1000 MB of address space on top of the imports (--memory-mb)"),
        (11, "my_phi.py, line 20, in extract); the pair's images are read-only: work on a copy"),
        (13, "the method wrote into the pair's images: work on a copy"),
        (15, "the method returned a str: an Answer(down, up) is needed"),
        (17, "down.uv_px is (nan, 2) with status 'ok': give finite numbers, or Spot.missing('why')"),
        (19, "SystemExit (my_phi.py, line 28, in extract)"),
    ],
)
def test_the_message_says_what_happened_and_where(survived: list[Outcome], number: int, words: str) -> None:
    assert words in survived[number].message
    assert "\n" not in survived[number].message
    assert "Traceback" not in survived[number].message
    assert survived[number].answer is None


def test_a_stack_of_c_functions_hides_no_line_of_the_method() -> None:
    """Python 3.14 prints it after the stack of Python; older ones print none."""
    python = "Fatal Python error: Segmentation fault\n\nCurrent thread 0x1 [python] (most recent call first):\n"
    frames = '  File "/lib/ctypes/__init__.py", line 624 in string_at\n  File "/x/my_phi.py", line 16 in extract\n'
    compiled = '\nCurrent thread\'s C stack trace (most recent call first):\n  Binary file "python", at f+0x4a [0x49]\n'
    for text in (python + frames, python + frames + compiled):
        assert stack_place(text, "/x/my_phi.py") == "my_phi.py, line 16, in extract"
    assert stack_place(compiled) == ""


def test_an_outcome_keeps_the_last_lines_that_the_method_printed(survived: list[Outcome]) -> None:
    for outcome in survived:
        assert "on stderr" in outcome.output
        assert "Fatal Python error" not in outcome.output
        assert all(len(line) <= 200 for line in outcome.output.splitlines())


NO_MEMORY = {
    "mmap": "import mmap; mmap.mmap(-1, 4_000_000_000)",
    "an errno": "import errno, os; raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))",
    "a thread": "import threading; threading.stack_size(2_000_000_000); threading.Thread(target=print).start()",
    "a cause": "try: bytes(4_000_000_000)\nexcept MemoryError as error: raise RuntimeError('no model') from error",
    "a library": "raise ImportError('libx.so: failed to map segment from shared object')",
}


@pytest.mark.slow
@pytest.mark.parametrize("deed", NO_MEMORY.values(), ids=NO_MEMORY)
def test_every_want_of_memory_is_memory_and_names_the_limit(tmp_path: Path, deed: str) -> None:
    reference = method_file(tmp_path, f"{deed}\nreturn {GOOD}")
    (outcome,) = run_method(reference, SmallPairs(1), LIMITS)
    assert outcome.failure == "memory"
    assert "the limit of 1000 MB" in outcome.message
    assert "my_phi.py, line" in outcome.message


def test_what_needs_more_passes_with_a_higher_limit(tmp_path: Path) -> None:
    reference = method_file(tmp_path, f"import mmap\nmmap.mmap(-1, 4_000_000_000).close()\nreturn {GOOD}")
    (outcome,) = run_method(reference, SmallPairs(1), RunLimits(seconds=3.0, memory_mb=20_000.0))
    assert outcome.failure == ""


def test_a_message_that_is_too_long_is_refused() -> None:
    near, far = socket.socketpair()
    near.sendall(struct.pack("!Q", LARGEST + 1))
    with near, far, pytest.raises(TransportError, match=f"of {LARGEST + 1} bytes exceeds the limit of {LARGEST}"):
        Connection(far).receive(1.0)


def test_the_harness_keeps_the_output_of_the_first_failure(tmp_path: Path) -> None:
    body = f"print('pair', pair.number)\nif pair.number in (2, 3): 1 / 0\nreturn {GOOD}"
    with Harness([method_file(tmp_path, body)], LIMITS, workers=2) as harness:
        done = [outcome for (outcome,) in harness.outcomes(SmallPairs(5), range(5))]
        assert harness.failed_outputs == ["pair 2"]
    assert [outcome.output for outcome in done] == [f"pair {number}" for number in range(5)]


def test_seconds_are_nan_where_the_method_did_not_come_back(survived: list[Outcome]) -> None:
    assert {n for n in range(LAST) if math.isnan(survived[n].seconds)} == {3, 5, 7}


def test_several_workers_give_the_same_in_the_same_order(tmp_path: Path) -> None:
    body = f"import time\ntime.sleep(0.2 if pair.number == 0 else 0.0)\nif pair.number == 2: 1 / 0\nreturn {GOOD}"
    reference = method_file(tmp_path, body)
    one, three = (run_method(reference, SmallPairs(6), LIMITS, workers) for workers in (1, 3))
    assert [outcome.number for outcome in three] == list(range(6))
    assert [(o.answer, o.failure, o.message) for o in one] == [(o.answer, o.failure, o.message) for o in three]
    assert [o.failure for o in one] == ["", "", "error", "", "", ""]


def test_pairs_asked_for_ahead_are_made_one_at_a_time_and_in_order(tmp_path: Path) -> None:
    """A set need not be safe for threads: those of the next call wait for the last ones of this call."""
    made: list[int] = []
    inside: list[int] = []

    class Watched(SmallPairs):
        def pair(self, number: int) -> Pair:
            inside.append(len(made))
            time.sleep(0.02)
            made.append(number)
            return super().pair(number)

    with Harness([method_file(tmp_path, f"return {GOOD}")], LIMITS, workers=3) as harness:
        first, then = (harness.outcomes(Watched(), part) for part in ([3, 1, 4, 0], [2, 5]))
        answers = [outcome.answer for part in (first, then) for (outcome,) in part]
    assert made == [3, 1, 4, 0, 2, 5]
    assert inside == list(range(6))  # nobody begins before the one before has ended
    assert [answer.down.uv_px[0] for answer in answers if answer and answer.down.uv_px] == [100.0 + n for n in made]


def test_a_process_stays_warm_until_it_fails(tmp_path: Path) -> None:
    body = "import os\nif pair.number == 2: 1 / 0\nreturn Answer(Spot((float(os.getpid()), 0.0)), Spot.missing('x'))"
    done = run_method(method_file(tmp_path, body), SmallPairs(5), LIMITS)
    pids = [o.answer.down.uv_px[0] if o.answer and o.answer.down.uv_px else None for o in done]
    assert pids[0] == pids[1] != pids[3] == pids[4]
    assert pids[2] is None
    assert float(os.getpid()) not in pids


def test_what_a_method_starts_dies_with_it(tmp_path: Path) -> None:
    """The hang is in a process that the method started: it must not outlive the pair."""
    child = "subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])"
    body = f"import subprocess, sys\nchild = {child}\nprint(child.pid, flush=True)\nchild.wait()"
    (outcome,) = run_method(method_file(tmp_path, body), SmallPairs(1), RunLimits(seconds=3.0))
    assert outcome.failure == "timeout"
    assert not is_alive(int(outcome.output))  # it did run: it has told its number


def test_leaving_the_loop_ends_the_process(tmp_path: Path) -> None:
    body = "import os\nreturn Answer(Spot((float(os.getpid()), 0.0)), Spot.missing('x'))"
    run = outcomes(method_file(tmp_path, body), SmallPairs(50), LIMITS, workers=2)
    first = next(run)
    run.close()
    assert first.answer is not None
    assert first.answer.down.uv_px is not None
    assert not is_alive(int(first.answer.down.uv_px[0]))


INTERRUPTED = """
import sys
import polars  # its SIGINT handler restarts waits
from helpers.sandbox_pairs import SmallPairs
from phibench.cli import main
from phibench.benchmark.isolation.runner import outcomes

def score(tokens, **_):
    for outcome in outcomes(tokens[0], SmallPairs(3)):
        print(int(outcome.answer.down.uv_px[0]), flush=True)

main.app = score
sys.exit(main.main(sys.argv[1:]))
"""
SAID = {signal.SIGINT: "Interrupted: stopped at your request.\n", signal.SIGTERM: "Stopped by SIGTERM.\n"}


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)])
def test_the_end_of_the_parent_leaves_nothing_behind(tmp_path: Path, number: signal.Signals, code: int) -> None:
    """The method is in C code and has Python's lock, and a daemon of its own session: nothing that it hears helps."""
    body = (
        "import ctypes, os, time\nif pair.number == 1:\n    if os.fork() == 0:\n        os.setsid()\n"
        "    open(os.path.join(os.environ['TMPDIR'], 'asleep'), 'w').close()\n    ctypes.PyDLL(None).sleep(600)\n"
        "return Answer(Spot((float(os.getpid()), 0.0)), Spot.missing('x'))"
    )
    (tmp_path / "temporary").mkdir()
    paths = os.pathsep.join([str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths, "TMPDIR": str(tmp_path / "temporary")}
    command = [sys.executable, "-c", INTERRUPTED, method_file(tmp_path, body)]
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        assert parent.stderr is not None
        method = int(parent.stdout.readline())
        wait_until(lambda: any((tmp_path / "temporary").rglob("asleep")), "the method's sleep")
        start = time.monotonic()
        parent.send_signal(number)
        assert parent.wait(60) == code  # a wait that is restarted would take the method's ten minutes
        took_s = time.monotonic() - start
        assert parent.stderr.read() == SAID.get(number, "")
    print(f"{number.name}: ended after {took_s:.2f} s")
    end = time.monotonic() + (0.0 if number != signal.SIGKILL else 20.0)
    while (is_alive(method) or list(processes_under(tmp_path))) and time.monotonic() < end:
        time.sleep(0.1)
    assert not is_alive(method)
    assert not list(processes_under(tmp_path))
    assert not list((tmp_path / "temporary").iterdir())


def is_alive(pid: int) -> bool:
    """Whether a process is there; one that has ended and that nobody has asked after is not."""
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False


# -- what a method sees ----------------------------------------------------------------------------------------------

LOOK_AROUND = """
import gc, json, os, sys
seen, names = [repr(sys.argv), repr(dict(os.environ)), os.getcwd(), repr(os.listdir())], set()
waiting, known = [pair], set()
while waiting:
    thing = waiting.pop()
    if id(thing) in known or isinstance(thing, np.ndarray):
        continue
    known.add(id(thing))
    seen.append(repr(thing))
    if hasattr(thing, '__dict__'):
        names |= set(vars(thing))
        waiting += list(vars(thing).values())
    if isinstance(thing, (tuple, list)):
        waiting += list(thing)
bad = [name for name in FORBIDDEN if name in names]
bad += [name for name in sys.modules if 'bench.truth' in name or 'mitsuba' in name]
bad += [type(thing).__name__ for thing in gc.get_objects() if type(thing).__name__ in ('PairTruth', 'SpotTruth')]
bad += [word for word in ('/data/set', 'secret') if word in ' '.join(seen)]
return Answer(Spot.missing('bad: ' + ' '.join(bad)), Spot((float(len(names)), 0.0)))
"""


@dataclass(frozen=True)
class SecretPairs(SmallPairs):
    """Pairs that carry more than a pair should, as a subclass with the data set's path."""

    def pair(self, number: int) -> Pair:
        plain = super().pair(number)
        return WithSecret(**{field.name: getattr(plain, field.name) for field in fields(Pair)}, secret="/data/set")


@dataclass(frozen=True)
class WithSecret(Pair):
    secret: str = ""


@pytest.mark.parametrize("planted", ["", "focus_distance_m"])  # the second is there: the search finds what there is
def test_a_method_sees_nothing_of_the_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, planted: str) -> None:
    """Names that a pair shares with the truth (number, stroke_m, ...) are the nominal ones; no other is there."""
    monkeypatch.setenv("OUT", "/data/set")
    monkeypatch.setenv("PHIBENCH_TRUTH", "/data/set")
    monkeypatch.chdir(tmp_path)
    header = f"{HEADER}FORBIDDEN = {[*sorted(forbidden()), planted]!r}\n"
    (outcome,) = run_method(method_file(tmp_path, LOOK_AROUND, header=header), SecretPairs(1), LIMITS)
    assert outcome.failure == "", outcome.message
    assert outcome.answer is not None
    assert outcome.answer.down.status == f"bad: {planted}".rstrip()
    assert outcome.answer.up.uv_px is not None
    assert outcome.answer.up.uv_px[0] > 40  # names: the walk reached rig, camera, mirror, card
    assert len(forbidden()) > 15


def forbidden() -> set[str]:
    """Fields of the truth that a pair does not have under the same name."""
    truth = {field.name for kind in (PairTruth, ImageTruth) for field in fields(kind)}
    return truth - {"number", "stroke_m", "down", "up", "jpeg_quality", "exposure_s", "calibration_covariance"}


def test_the_working_directory_is_fresh_and_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    body = "import os\nreturn Answer(Spot.missing(os.getcwd() + ' ' + str(os.listdir())), Spot.missing('x'))"
    (outcome,) = run_method(method_file(tmp_path, body), SmallPairs(1), LIMITS)
    assert outcome.answer is not None
    folder, listing = outcome.answer.down.status.split(" ", 1)
    assert listing == "[]"
    assert not folder.startswith(str(tmp_path))
    assert not Path(folder).exists()  # removed with the process


def test_environment_keeps_what_libraries_need_and_nothing_else() -> None:
    inherited = {"PATH": "/bin", "OMP_NUM_THREADS": "2", "OUT": "out/paper", "OLDPWD": "/data", "PYTHONPATH": "a"}
    kept = environment("/fresh", inherited)
    assert kept["PATH"] == "/bin"
    assert kept["OMP_NUM_THREADS"] == "2"
    assert kept["PWD"] == kept["TMPDIR"] == "/fresh"
    assert kept["PYTHONPATH"] == str(Path("a").absolute())
    assert not {"OUT", "OLDPWD"} & set(kept)


@pytest.mark.parametrize("sealed", [True, False])
def test_images_arrive_as_they_were_and_cannot_be_written(sealed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not sealed:  # as on macOS
        monkeypatch.delattr(os, "memfd_create", raising=False)

    sent, memory = SmallPairs().pair(3), MemoryFile()
    pages = SharedPages(memory.reader)
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 1024, (5, 7), np.uint16), rng.integers(0, 255, (4, 3, 3), np.uint8)[:, ::-1]]
    images.append(rng.integers(0, 1024, (500, 70), np.uint16))
    for image in images:  # the second is not contiguous; they become smaller and larger than what the file held before
        parcel = unpack(pack(type(sent)(3, image, image, sent.rig, 0.5, sent.card), memory), pages)
        np.testing.assert_array_equal(parcel.pair.down, image)
        assert parcel.pair.down.dtype == image.dtype
        assert parcel.pair.down_off is None
        assert parcel.pair.card == sent.card
        with pytest.raises(ValueError, match="read-only"):
            parcel.pair.down[0, 0] = 1
        with pytest.raises(ValueError, match="WRITEABLE"):
            parcel.pair.down.setflags(write=True)
        assert parcel.unchanged()
    memory.close()


def test_images_between_arrive_with_their_heights() -> None:
    small, memory = SmallPairs().pair(0), MemoryFile()
    down, up, *between = np.random.default_rng(2).integers(0, 255, (4, 6, 8, 3), np.uint8)
    sent = DensePair(1, down, up, small.rig, 0.5, small.card, between=np.stack(between), between_m=(0.1, 0.3))
    parcel = unpack(pack(sent, memory), SharedPages(memory.reader))
    np.testing.assert_array_equal(parcel.pair.between, np.stack(between))
    assert parcel.pair.between_m == (0.1, 0.3)
    assert not parcel.pair.between.flags.writeable
    memory.close()


def test_single_frames_arrive_beside_their_means() -> None:
    small, memory = SmallPairs().pair(0), MemoryFile()
    rng = np.random.default_rng(1)
    counts = {"down": 3, "up": 3, "down_off": 2, "up_off": 2}
    groups = {name: [rng.integers(0, 255, (6, 8, 3), np.uint8) for _ in range(n)] for name, n in counts.items()}
    sent = Pair.of_frames(4, groups, rig=small.rig, stroke_m=0.5, card=small.card)
    assert needed_bytes(sent) > sum(image.nbytes for group in groups.values() for image in group)
    parcel = unpack(pack(sent, memory), SharedPages(memory.reader))
    for name, group in groups.items():
        assert parcel.pair.count(name) == len(group)
        np.testing.assert_array_equal(parcel.pair.stack(name), np.stack(group))
        np.testing.assert_allclose(parcel.pair.images[name], np.mean(group, axis=0), rtol=1e-6)
        with pytest.raises(ValueError, match="read-only"):
            parcel.pair.stack(name)[0, 0, 0, 0] = 1
    assert parcel.unchanged()
    memory.close()


@pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="Linux alone has sealed memory")
def test_shared_memory_is_sealed() -> None:
    """Cut short, it would kill the runner with SIGBUS at its next pair."""
    memory = MemoryFile()
    handle = os.open(f"/proc/self/fd/{memory.reader}", os.O_RDWR)  # as a method can
    for change in (
        lambda: os.ftruncate(handle, 0),
        lambda: os.ftruncate(handle, 1 << 40),
        lambda: os.write(handle, b"x"),
    ):
        with pytest.raises(PermissionError):
            change()
    with pytest.raises(PermissionError):
        mmap.mmap(handle, 4096)
    os.close(handle)
    assert unpack(pack(SmallPairs().pair(0), memory), SharedPages(memory.reader)).unchanged()
    memory.close()


def test_a_pair_that_is_larger_than_the_memory_gets_a_process_with_more(tmp_path: Path) -> None:
    reference = method_file(tmp_path, "return Answer(Spot(pair.down.shape), Spot.missing('x'))")
    process = MethodProcess(resolve(reference), LIMITS)
    small, shape = SmallPairs().pair(0), (4000, 5000)
    large = Pair(0, np.zeros(shape, np.uint16), np.zeros(shape, np.uint16), small.rig, 0.5, small.card)
    assert needed_bytes(large) > LEAST_BYTES
    answers = [process.ask(pair).answer for pair in (small, large, small)]
    process.close()
    assert [answer.down.uv_px for answer in answers if answer] == [(48.0, 64.0), (4000.0, 5000.0), (48.0, 64.0)]


def test_a_kept_image_does_not_change_under_the_method(tmp_path: Path) -> None:
    header = f"{HEADER}KEPT = []\n"
    body = "KEPT.append(pair.down)\nreturn Answer(Spot((float(KEPT[0][0, 0]), 0.0)), Spot.missing('x'))"
    done = run_method(method_file(tmp_path, body, header=header), SmallPairs(3), LIMITS)
    assert [o.answer.down.uv_px[0] for o in done if o.answer and o.answer.down.uv_px] == [100.0, 100.0, 100.0]


# -- limits -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [{"seconds": 0.0}, {"memory_mb": -1.0}, {"start_seconds": math.nan}])
def test_limits_that_cannot_be(bad: dict[str, float]) -> None:
    with pytest.raises(MethodError, match="must be a finite number above 0"):
        RunLimits(**bad)
    with pytest.raises(MethodError, match="workers = 0"):
        outcomes("red_centroid", SmallPairs(1), workers=0)


def test_an_import_that_hangs_or_dies_is_said_before_the_first_pair(tmp_path: Path) -> None:
    hang = method_file(tmp_path, f"return {GOOD}", header="import time\ntime.sleep(60)\n")
    with pytest.raises(MethodError, match=r"not imported after 3 s, at my_phi\.py, line 2"):
        run_method(hang, SmallPairs(1), RunLimits(start_seconds=3.0))
    dead = method_file(tmp_path, f"return {GOOD}", header="import os\nprint('farewell', flush=True)\nos._exit(4)\n")
    with pytest.raises(MethodError, match=r"exit code 4.*last words: farewell"):
        run_method(dead, SmallPairs(1), LIMITS)


def test_images_of_small_pairs_differ() -> None:
    """The tests above would see a pair taken for another."""
    assert len({SmallPairs().pair(n).down[0, 0] for n in range(4)}) == 4
    assert SmallPairs().pair(0).down.shape == SHAPE
