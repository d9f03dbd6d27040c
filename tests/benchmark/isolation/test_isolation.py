"""A method in its own room: what it cannot reach by any way that was tried, and what honest methods go on doing."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.landlock import FilePairs, landlock, needs_landlock, own_mounts
from helpers.listeners import as_nobody
from helpers.sandbox_pairs import GOOD, HEADER, SmallPairs, method_file

from phibench.benchmark.isolation.isolation import _NUMBERS, Isolation
from phibench.benchmark.isolation.run_limits import RunLimits
from phibench.benchmark.isolation.runner import run_method
from phibench.benchmark.scores.score import score
from phibench.estimator.interface import Answer, Spot

ROOT = Path(__file__).resolve().parents[3]
LIMITS = RunLimits(seconds=60.0)  # the machine may do other things: no test here is about time


ATTACKS = {
    "path": "open(TRUTH).read()",
    "descriptor of the folder": "os.open('truth.txt', os.O_RDONLY, dir_fd=os.open(DATA, os.O_RDONLY))",
    "inherited descriptors": "[n for n in os.listdir('/proc/self/fd') if linked(n).startswith(DATA)][0]",
    "symlink beside": "open(HERE / 'link.txt').read()",
    "own symlink": "(os.symlink(TRUTH, 'mine'), open('mine').read())",
    "hard link beside": "open(HERE / 'hard.txt').read()",
    "new hard link": "(os.link(TRUTH, 'hard'), open('hard').read())",
    "set below the method": "open(HERE / 'copy' / 'truth.txt').read()",
    "score beside": "open(HERE / 'earlier.parquet').read()",
    "parent's root": "open(f'/proc/{os.getppid()}/root{TRUTH}').read()",
    "parent's folder": "os.listdir(f'/proc/{os.getppid()}/cwd/')",
    "parent's descriptors": "os.listdir(f'/proc/{os.getppid()}/fd')",
    "parent's memory": "open(f'/proc/{os.getppid()}/mem', 'rb').read(1)",
    "parent's environment": "open(f'/proc/{os.getppid()}/environ').read()",
    "first process": "open(f'/proc/1/root{TRUTH}').read()",
    "own root": "open(f'/proc/self/root{TRUTH}').read()",
    "trace the parent": "called('ptrace', 16, os.getppid(), 0, 0)",
    "signal the parent": "os.kill(os.getppid(), 0)",
    "limits of the parent": "resource.prlimit(os.getppid(), resource.RLIMIT_NOFILE, (0, 0))",
    "mount": "called('mount', DATA.encode(), os.getcwd().encode(), b'none', 4096, None)",
    "namespace": "in_child(mount_in_a_namespace)",
    "chroot": "(os.chroot(DATA), open('/truth.txt').read())",
    "subprocess": "subprocess.run(['cat', TRUTH], capture_output=True, check=True)",
    "shell in a session": "subprocess.run('cat ' + TRUTH, shell=True, check=True, start_new_session=True)",
    "forked child": "forked()",
    "socket": "socket.create_connection(('127.0.0.1', PORT), 1.0)",
    "datagram": "socket.socket(type=socket.SOCK_DGRAM)",
    "raw socket": "socket.socket(socket.AF_PACKET, socket.SOCK_RAW)",
    "local socket": "socket.socket(socket.AF_UNIX).connect(SERVER)",
    "local datagram": "socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)",
    "shared memory of System V": "called('shmget', 4711, 4096, 0o1666)",
    "move": "(os.rename(TRUTH, 'moved'), open('moved').read())",
    "write into the set": "open(TRUTH, 'a')",
    "cut the truth": "os.truncate(TRUTH, 0)",
    "delete the truth": "os.remove(TRUTH)",
    "write beside the method": "open(HERE / 'new.txt', 'w')",
    "write into the packages": "open(np.__file__, 'a')",
    "write elsewhere": "open('/var/tmp/phibench-was-here', 'w')",
    "home": "os.listdir(os.path.expanduser('~'))",
    "permissions of the set": "os.chmod(DATA, 0)",
    "permissions of another file": "os.chmod(SERVER, 0o777)",
    "permissions of its own file": "os.chmod(__file__, 0o600)",
    "the same by descriptor": "os.fchmod(os.open(__file__, os.O_RDONLY), 0o600)",
    "permissions by number": "numbered(452, -100, __file__.encode(), 0o600, 0)",
    "owner": "os.chown(SERVER, os.getuid(), -1)",
    "owner of a link": "os.lchown(HERE / 'link.txt', os.getuid(), -1)",
    "owner by descriptor": "os.fchown(os.open(__file__, os.O_RDONLY), os.getuid(), -1)",
    "times of another file": "os.utime(SERVER, (1, 1))",
    "times of its own file": "os.utime(__file__, (1, 1))",
    "times by descriptor": "os.utime(os.open(__file__, os.O_RDONLY), (1, 1))",
    "attribute": "os.setxattr(__file__, 'user.kept', b'1')",
    "attribute by descriptor": "os.setxattr(os.open(__file__, os.O_RDONLY), 'user.kept', b'1')",
    "attribute by number": "numbered(463, -100, __file__.encode(), 0, b'user.kept', bytes(16), 16)",
    "flags of its own file": "fcntl.ioctl(os.open(__file__, os.O_RDONLY), 0x40086602, struct.pack('l', 0x40))",
    "watching": "called('inotify_init1', 0)",
    "watching the whole system": "called('fanotify_init', 0x200, 0)",
    "hint of its own file": "fcntl.fcntl(os.open(__file__, os.O_RDONLY), 1036, struct.pack('Q', 3))",
    "generation of its own file": "fcntl.ioctl(os.open(__file__, os.O_RDONLY), 0x40086604, struct.pack('l', 7))",
    "lease of its own file": "fcntl.fcntl(os.open(__file__, os.O_RDONLY), fcntl.F_SETLEASE, fcntl.F_RDLCK)",
    "processor time of the run": "time.clock_gettime((~RUNNER << 3) | 2)",
    "a signal when a folder changes": "fcntl.fcntl(os.open(HERE, os.O_RDONLY), fcntl.F_NOTIFY, fcntl.DN_ACCESS)",
}
HELPERS = """
import ctypes, fcntl, multiprocessing, os, resource, socket, struct, subprocess, time
from pathlib import Path

HERE = Path(__file__).parent

def called(name, *arguments):
    if getattr(ctypes.CDLL(None, use_errno=True), name)(*arguments) == -1:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

def numbered(number, *arguments):
    call = ctypes.CDLL(None, use_errno=True).syscall
    if call(ctypes.c_long(number), *(ctypes.c_long(x) if isinstance(x, int) else x for x in arguments)) == -1:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

def linked(number):
    return os.readlink(f'/proc/self/fd/{number}') if os.path.lexists(f'/proc/self/fd/{number}') else ''

def forked():
    context = multiprocessing.get_context('fork')
    with context.Pool(1) as pool:
        return pool.apply(Path(TRUTH).read_text)

def mount_in_a_namespace():
    called('unshare', 0x10020000)
    called('mount', DATA.encode(), os.getcwd().encode(), b'none', 4096, None)

def in_child(deed):
    # a fork has one thread, which the kernel wants for a namespace
    child = os.fork()
    if child == 0:
        try:
            deed()
            os._exit(0)
        except OSError as error:
            os._exit(error.errno)
    if code := os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]):
        raise OSError(code, os.strerror(code))

def attack(text):
    try:
        return f'reached {eval(text)!r}'
    except BaseException as error:
        return f'denied {type(error).__name__} {error}'
"""


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """What came of every attack, by its name."""
    base = tmp_path_factory.mktemp("attacked")
    data, method = base / "data", base / "method"
    copy = method / "copy"
    for folder in (data, method, copy):
        folder.mkdir()
    truth = data / "truth.txt"
    for file in (truth, copy / "truth.txt", copy / "dataset.json", method / "earlier.parquet"):
        file.write_text("secret")
    (method / "earlier.json").write_text('{\n "kind": "phibench score"}')
    (method / "link.txt").symlink_to(truth)
    (method / "hard.txt").hardlink_to(truth)
    with socket.create_server(("127.0.0.1", 0)) as server, socket.socket(socket.AF_UNIX) as local:
        local.bind(str(base / "server"))
        local.listen()
        names = {
            "TRUTH": str(truth),
            "DATA": str(data),
            "PORT": server.getsockname()[1],
            "SERVER": str(base / "server"),
            "RUNNER": os.getpid(),
        }
        header = HEADER + HELPERS + "".join(f"{name} = {value!r}\n" for name, value in names.items())
        # a line of output for each pair: an outcome keeps the last lines only
        body = f"print(attack({list(ATTACKS.values())!r}[pair.number]))\nreturn {GOOD}"
        pairs = FilePairs(len(ATTACKS), folders=(data,))
        done = run_method(method_file(method, body, header=header), pairs, LIMITS)
    yield {name: outcome.output or outcome.message for name, outcome in zip(ATTACKS, done, strict=True)}
    assert truth.read_text() == "secret"
    assert not Path("/var/tmp/phibench-was-here").exists()


@needs_landlock
@pytest.mark.parametrize("name", ATTACKS)
def test_an_attack_is_denied(attacked: dict[str, str], name: str) -> None:
    """For want of a right, that is, and not because the attack is wrong: the same attack reaches its aim outside."""
    assert attacked[name].splitlines()[-1].startswith("denied")
    # the parent's descriptors are closed; a tool that fails; a path in a child's sandbox; a hidden place is empty, and
    # all others are read-only, where the mounts are a process's own
    expected = ("PermissionError", "IndexError", "CalledProcessError", "Invalid cross-device link")
    if own_mounts():
        expected += ("FileNotFoundError", "Read-only file system")
    assert any(word in attacked[name] for word in expected), attacked[name]


# The same where Landlock lets signals out, before Linux 6.12; PARENT is what the supervisor is to a method.
OUTWARD = {
    "signal": "os.kill(PARENT, 9)",
    "signal, upper half of the argument": "called('kill', PARENT | 1 << 32, 9)",
    "signal to its group": "os.killpg(PARENT, 9)",
    "signal to all": "os.kill(-1, 0)",
    "signal to a thread": "called('tkill', PARENT, 9)",
    "signal to a thread of a process": "called('tgkill', PARENT, PARENT, 9)",
    "signal with a value": "called('rt_sigqueueinfo', PARENT, 10, INFORMATION)",
    "signal with a value to a thread": "called('rt_tgsigqueueinfo', PARENT, PARENT, 10, INFORMATION)",
    "signal by a descriptor": "signal.pidfd_send_signal(os.pidfd_open(PARENT), 9)",
    "signal when a file is ready": "fcntl.fcntl(FILE, 8, PARENT)",
    "the same with a kind of owner": "fcntl.fcntl(FILE, 15, struct.pack('ii', 1, PARENT))",
    "the same of a socket": "fcntl.ioctl(FILE, 0x8901, struct.pack('i', PARENT))",
    "its older name": "fcntl.ioctl(FILE, 0x8902, struct.pack('i', PARENT))",
    "limits": "resource.prlimit(PARENT, resource.RLIMIT_NOFILE, (0, 0))",
    "priority": "os.setpriority(os.PRIO_PROCESS, PARENT, 19)",
    "priority of its group": "os.setpriority(os.PRIO_PGRP, os.getpgid(PARENT), 19)",
    "priority of all of the user": "os.setpriority(os.PRIO_USER, 0, 19)",
    "cores": "os.sched_setaffinity(PARENT, {0})",
    "way of scheduling": "os.sched_setscheduler(PARENT, os.SCHED_IDLE, os.sched_param(0))",
    "parameters of scheduling": "os.sched_setparam(PARENT, os.sched_param(0))",
    "the same by attributes": "called('sched_setattr', PARENT, struct.pack('IIQiIQQQ', 48, 5, 0, 0, 0, 0, 0, 0), 0)",
    "priority at the disk": "called('ioprio_set', 1, PARENT, 3 << 13)",
    "priority of its group at the disk": "called('ioprio_set', 2, os.getpgid(PARENT), 3 << 13)",
    "processor time": "time.clock_gettime((~PARENT << 3) | 2)",
    "waiting for processor time": "called('clock_nanosleep', (~PARENT << 3 | 2) & 0xFFFFFFFF, 0, bytes(16), 0)",
    "a timer of processor time": "called('timer_create', (~PARENT << 3 | 2) & 0xFFFFFFFF, None, bytes(8))",
}
INWARD = {
    "terminate a program": "ended(subprocess.Popen(['sleep', '60']))",
    "terminate a process": "forked()",
    "signal to itself": "os.kill(os.getpid(), 0)",
    "signal to its own group": "os.killpg(0, 0)",
    "raise a signal": "signal.raise_signal(signal.SIGURG)",
    "signal to its thread": "signal.pthread_kill(threading.get_ident(), 0)",
    "own limits": "resource.setrlimit(resource.RLIMIT_CORE, (0, 0))",
    "limits that are read": "resource.prlimit(os.getpid(), resource.RLIMIT_CORE)",
    "flags of a file": "fcntl.fcntl(FILE, fcntl.F_SETFL, os.O_NONBLOCK)",
    "bytes that wait": "fcntl.ioctl(FILE, 0x541B, bytes(4))",
    "own priority": "os.setpriority(os.PRIO_PROCESS, 0, 19)",
    "own priority by its number": "os.setpriority(os.PRIO_PROCESS, os.getpid(), 19)",
    "own cores": "os.sched_setaffinity(0, os.sched_getaffinity(0))",
    "own way of scheduling": "os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))",
    "own priority at the disk": "called('ioprio_set', 1, 0, 3 << 13)",
    "own processor time": "(time.process_time(), time.thread_time(), time.clock_gettime((~os.getpid() << 3) | 2))",
    "processor time of its thread": "time.clock_gettime(time.pthread_getcpuclockid(threading.get_ident()))",
    "a timer of its own": "called('timer_create', 1, None, bytes(8))",
}
IMPORTED = """
import ctypes, fcntl, multiprocessing.connection, multiprocessing.popen_fork, os, resource, signal, socket, struct
import subprocess, sys, threading, time
from phibench.benchmark.isolation import isolation
"""
OLD_KERNEL = """
isolation._ABI_SCOPE = 99
numbers = isolation._NUMBERS[os.uname().machine]
PARENT, FILE, INFORMATION = os.getpid(), socket.socketpair()[0], struct.pack('iii', 10, 0, -1) + bytes(116)

def called(name, *arguments):
    call = ctypes.CDLL(None, use_errno=True).syscall
    values = [ctypes.c_long(value) if isinstance(value, int) else value for value in arguments]
    if call(ctypes.c_long(numbers[name]), *values) == -1:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

def ended(child):
    child.terminate()
    assert child.wait(20) == -signal.SIGTERM

def forked():
    child = multiprocessing.get_context('fork').Process(target=time.sleep, args=(60,))
    child.start()
    child.terminate()
    child.join(20)
    assert child.exitcode == -signal.SIGTERM

os.setpgid(0, 0)
signal.signal(signal.SIGUSR1, signal.SIG_IGN)
if os.fork() == 0:
    os.setsid()
    assert isolation.isolate(isolation.Access()).network
    for name, text in eval(sys.argv[1]).items():
        try:
            eval(text)
            print(name, 'reached', flush=True)
        except OSError as error:
            print(name, type(error).__name__, flush=True)
    os._exit(0)
print(os.wait()[1], resource.getrlimit(resource.RLIMIT_NOFILE)[0] > 0)
"""


@pytest.mark.skipif(sys.platform != "linux" or os.uname().machine not in _NUMBERS, reason="no filter of calls here")
@pytest.mark.parametrize("user", ["this one", "nobody"])
def test_without_rules_for_signals_the_supervisor_is_out_of_reach(user: str) -> None:
    """Signals, limits, priorities, cores, clocks; what honest methods do to themselves and to their own goes on.

    Root may set no priority here without the filter either, an ordinary user may.
    """
    if user == "nobody" and os.getuid() != 0:
        pytest.skip("only root can become another user")
    command = [sys.executable, "-c", IMPORTED + OLD_KERNEL, repr(OUTWARD | INWARD)]
    done = (
        as_nobody(OLD_KERNEL, repr(OUTWARD | INWARD), imports=IMPORTED)
        if user == "nobody"
        else subprocess.run(command, capture_output=True, text=True, timeout=120)
    )
    expected = [f"{name} PermissionError" for name in OUTWARD] + [f"{name} reached" for name in INWARD]
    assert done.stdout.splitlines() == [*expected, "0 True"], done.stderr


# What honest methods do; each is an expression as above.
HONEST = {
    "numpy": "np.linalg.svd(np.eye(3))[1].sum()",
    "scipy": "__import__('scipy.optimize').optimize.brentq(lambda x: x - 1.0, 0.0, 3.0)",
    "opencv": "__import__('cv2').GaussianBlur(pair.down, (3, 3), 1.0).shape",
    "scikit-image": "__import__('skimage.feature').feature.blob_log(np.eye(9)).shape",
    "pillow": "__import__('PIL.Image').Image.fromarray(np.zeros((2, 2), np.uint8)).save('x.png')",
    "weights beside": "(HERE / 'weights.txt').read_text()",
    "weights that are allowed": "open(WEIGHTS).read()",
    "own file": "(open('x', 'w').write('1'), open('x').read(), os.rename('x', 'y'), os.mkdir('z'), os.listdir('.'))",
    "temporary files": "[tempfile.mkdtemp(), tempfile.NamedTemporaryFile().name]",
    "processes": "pooled()",
    "lock": "multiprocessing.Lock().acquire()",
    "shared memory": "shared()",
    "executor": "list(concurrent.futures.ThreadPoolExecutor(2).map(abs, [-1, 2]))",
    "python": "subprocess.run([sys.executable, '-c', 'import numpy'], check=True)",
    "tool": "subprocess.run('ls /usr | sort', shell=True, check=True, capture_output=True).stdout",
    "event loop": "asyncio.run(asyncio.sleep(0))",
    "clock": "datetime.datetime.now().astimezone().tzname()",
    "machine": "(os.cpu_count(), os.getloadavg(), open('/proc/self/status').read(), open('/proc/meminfo').read())",
    "random": "os.urandom(4)",
    "user": "os.path.expanduser('~')",
}
USUAL = """
import asyncio, concurrent.futures, datetime, multiprocessing, os, subprocess, sys, tempfile
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path

HERE = Path(__file__).parent

def pooled():
    with multiprocessing.Pool(2) as pool:
        return pool.map(abs, [-1, 2])

def shared():
    memory = SharedMemory(create=True, size=16)
    memory.close()
    memory.unlink()
"""


IN_SHARED_MEMORY = ("processes", "lock", "shared memory")


@pytest.mark.slow
@pytest.mark.parametrize("fresh", [False, True])
def test_honest_methods_go_on_working(tmp_path: Path, fresh: bool) -> None:
    """All of it; where --fresh has no shared memory to give, what needs it is refused, and the rest goes on."""
    (tmp_path / "method").mkdir()
    (tmp_path / "method" / "weights.txt").write_text("1")
    (tmp_path / "allowed.txt").write_text("2")
    header = f"{HEADER}{USUAL}WEIGHTS = {str(tmp_path / 'allowed.txt')!r}\n"
    each = "    print(name, flush=True)\n    eval(text, globals(), dict(pair=pair))\n"
    denied = IN_SHARED_MEMORY if fresh and not own_mounts() else ()
    going_on = {name: text for name, text in HONEST.items() if name not in denied}
    body = f"for name, text in {going_on!r}.items():\n{each}"
    reference = method_file(tmp_path / "method", f"{body}print('done')\nreturn {GOOD}", header=header)
    limits = RunLimits(seconds=120.0, fresh=fresh, allow=(str(tmp_path / "allowed.txt"),))
    (outcome,) = run_method(reference, SmallPairs(1), limits)
    assert (outcome.failure, outcome.message) == ("", "")
    assert outcome.output.splitlines()[-1] == "done"
    for name in denied:
        reference = method_file(tmp_path / "method", f"eval({HONEST[name]!r})\nreturn {GOOD}", header=header)
        (outcome,) = run_method(reference, SmallPairs(1), limits)
        assert outcome.failure == "error"
        assert "PermissionError" in outcome.message


KEEPER = """
import os
from pathlib import Path
COUNT = 0

def counted():
    global COUNT
    COUNT += 1
    seen = [COUNT, len(os.listdir('.'))]
    for place in ('/dev/shm', '.', '/tmp', '/var/tmp'):
        file = Path(place) / f'phibench-test-{os.stat(__file__).st_ino}'
        seen.append(0)
        try:
            seen[-1] = int(file.exists() and file.read_text() == 'kept')
            file.write_text('kept')
        except OSError:
            pass
    return seen
"""


@pytest.mark.slow
@pytest.mark.parametrize(("fresh", "count"), [(True, 1), (False, 3)])
def test_fresh_is_a_process_and_a_folder_for_each_pair(tmp_path: Path, fresh: bool, count: int) -> None:
    """What is kept in memory, in the folder, in shared memory and in temporary folders is lost."""
    if fresh and not landlock():
        pytest.skip("this kernel has no Landlock: a method can write files that outlive it")
    reference = method_file(tmp_path, f"print(counted())\nreturn {GOOD}", header=HEADER + KEEPER)
    done = run_method(reference, SmallPairs(3), RunLimits(seconds=60.0, fresh=fresh))
    lists = [json.loads(outcome.output) for outcome in done]
    assert [one[0] for one in lists] == ([1, 1, 1] if fresh else [1, 2, 3])
    if fresh:
        assert lists == [[1, 0, 0, 0, 0, 0]] * 3
    else:
        assert lists[-1][3] == 1  # the probe sees what is kept
    assert lists[-1][0] == count


@pytest.mark.slow
@needs_landlock
def test_the_truth_of_a_data_set_is_not_read_while_it_is_scored(smallest_dataset: Path, tmp_path: Path) -> None:
    """What was measured before: rms 0.001 px, efficiency 374, and no word of it."""
    (tmp_path / "beside.py").write_text("")
    manifest = next(smallest_dataset.glob("*.parquet"))
    header = f"{HEADER}import beside\nfrom pathlib import Path\n"
    method = method_file(tmp_path, f"Path({str(manifest)!r}).read_bytes()\nreturn {GOOD}", header=header)
    scored = score(smallest_dataset, method, "mono-raw", pairs=1, limits=LIMITS)
    assert scored.document.failures["error"] == 1
    assert scored.document.isolation == Isolation(True, True, True).sentence()
    assert list(scored.document.method.modules) == ["beside.py"]
    here = score(smallest_dataset, lambda pair: Answer(Spot.missing("x"), Spot.missing("x")), "mono-raw", pairs=1)
    assert here.document.isolation == "not isolated: a function runs in this process"
