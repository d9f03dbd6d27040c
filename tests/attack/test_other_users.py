"""Attack: another user of the machine tries to run code in the workers of whoever renders, by every open door."""

import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from helpers.listeners import as_nobody, listeners
from helpers.processes import SMALLEST, living, wait_for

from phibench.datasets.store import schema

needs_proc = pytest.mark.skipif(not Path("/proc/net/tcp").is_file(), reason="needs /proc")
needs_root = pytest.mark.skipif(getattr(os, "getuid", lambda: 1)() != 0, reason="only root can become another user")
BIN = Path(sys.executable).parent

DOORS = """
opened = []
for pid in map(int, sys.argv[1:]):
    for name in ("mem", "environ", "fd", "cwd", "root"):
        path = f"/proc/{pid}/{name}"
        try:
            os.listdir(path) if name in ("fd", "cwd", "root") else open(path, "r+b" if name == "mem" else "rb").close()
            opened.append(path)
        except (PermissionError, FileNotFoundError, ProcessLookupError):  # refused, or gone meanwhile
            pass
    try:
        os.kill(pid, signal.SIGCONT)
        opened.append(f"signal to {pid}")
    except (PermissionError, ProcessLookupError):
        pass
print(opened)
"""


@needs_proc
def test_what_listens_is_seen() -> None:
    """The look at sockets that the next test rests on: it names one of each kind."""
    with ExitStack() as stack:
        for family, kind, place in (
            (socket.AF_INET, socket.SOCK_STREAM, ("127.0.0.1", 0)),
            (socket.AF_INET, socket.SOCK_DGRAM, ("127.0.0.1", 0)),
            (socket.AF_UNIX, socket.SOCK_STREAM, f"\0phibench-{os.getpid()}"),
        ):
            one = stack.enter_context(socket.socket(family, kind))
            before = listeners(os.getpgrp())
            one.bind(place)
            if kind == socket.SOCK_STREAM:
                one.listen()
            assert len(listeners(os.getpgrp()) - before) == 1
        # a pair of sockets, as pipes of workers are, takes no connections
        before = listeners(os.getpgrp())
        for end in socket.socketpair():
            stack.enter_context(end)
        assert listeners(os.getpgrp()) == before


@needs_proc
@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_our_own_workers_listen_nowhere(tmp_path: Path, count: int) -> None:
    """From the start of a run to its end; another user gets into none of its processes either."""
    command = [sys.executable, "-m", "phibench", "dataset", "make", str(SMALLEST), "--out", str(tmp_path / "out")]
    command += ["--workers", str(count)]
    found, looks, most, tries = set[str](), 0, 0, not needs_root.args[0]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True) as run:
        while run.poll() is None:
            alive = living(run.pid)
            found |= listeners(run.pid)
            looks, most = looks + 1, max(most, len(alive))
            if tries and (tmp_path / "out" / schema.LOG).is_file() and len(alive) > count:
                done = as_nobody(DOORS, *(line.split()[0] for line in alive), imports="import signal, sys")
                assert done.stdout == "[]\n", done
                tries = False
            time.sleep(0.05)
    assert run.returncode == 0
    assert found == set()
    assert looks > 20
    assert most > count  # workers were there while we looked
    assert not tries  # another user has tried, where this one may become another


# A scheduler of others, with the keys of docs/cluster.md.

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "cluster.md").read_text(encoding="utf-8")

BEFORE = """
import asyncio, json, os, ssl, subprocess, sys, tempfile, urllib.request
from distributed import Client
from distributed.comm import connect
from distributed.security import Security

async def ask(address, **options):
    # what dask itself says to a scheduler, a worker and a nanny
    line = await connect(address, timeout=3, **options)
    try:
        await line.write({"op": "identity", "reply": True})
        return await asyncio.wait_for(line.read(), 3)
    finally:
        line.abort()

def page(port, path):
    return urllib.request.urlopen(f"http://127.0.0.1:{port}/{path}", timeout=5).read()

def run(address, security):
    with Client(address, security=security, timeout=5, set_as_default=False) as client:
        return client.run(os.getuid)

# Our own way in, which must work: it shows that the questions are right, and loads what nobody could not read later.
scheduler = json.load(open(sys.argv[3]))["address"]
own = Security()
assert asyncio.run(ask(scheduler, **own.get_connection_args("client")))["id"]
assert set(run(scheduler, own).values()) == {os.getuid()}
"""
ATTACK = """
ports, keys, reached = [int(x) for x in sys.argv[1].split(",")], sys.argv[2], []
folder = tempfile.mkdtemp()
mine = [os.path.join(folder, name) for name in ("key.pem", "cert.pem")]
subprocess.run(["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-subj",
                "/CN=phibench", "-keyout", mine[0], "-out", mine[1]], check=True, capture_output=True)
forged = Security(tls_ca_file=mine[1], tls_client_key=mine[0], tls_client_cert=mine[1], require_encryption=True)
blind = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
blind.check_hostname, blind.verify_mode = False, ssl.CERT_NONE
blind.load_cert_chain(mine[1], mine[0])
bare = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
bare.check_hostname, bare.verify_mode = False, ssl.CERT_NONE

NOT_TRIED = (ImportError, NameError, AttributeError, TypeError, AssertionError)

def told(what, result):
    # nothing where it was refused
    if isinstance(result, NOT_TRIED):
        return [(*what, f"not tried: {result!r}")]
    return [] if isinstance(result, BaseException) else [(*what, str(result)[:200])]

def tried(how):
    try:
        return how()
    except Exception as error:
        return error

async def ask_all():
    ways = {"plain": ("tcp", {"require_encryption": False}), "forged": ("tls", {"ssl_context": blind}),
            "without a certificate": ("tls", {"ssl_context": bare})}
    what = [(port, name) for port in ports for name in ways]
    asked = [asyncio.wait_for(ask(f"{ways[name][0]}://127.0.0.1:{port}", **ways[name][1]), 15) for port, name in what]
    return zip(what, await asyncio.gather(*asked, return_exceptions=True))

results = list(asyncio.run(ask_all()))
for port in ports:
    for path in ("info/main/workers.html", "metrics", "json/identity.json"):
        results.append(((port, path), tried(lambda: page(port, path))))
results.append(((ports[0], "client"), tried(lambda: run(f"tls://127.0.0.1:{ports[0]}", forged))))
for what, result in results:
    reached += told(what, result)
refused = len(results) - len(reached)
for path in (keys, keys + "/key.pem", keys + "/dask.yaml"):
    try:
        os.listdir(path) if path == keys else open(path).close()
        reached.append(path)
    except PermissionError:
        refused += 1
print(reached, refused)
"""


def workers_of(folder: Path) -> list[str]:
    """Addresses of workers that have come."""
    log = folder / "log"
    return re.findall("Register worker addr: (tls://[0-9.:]+)", log.read_text()) if log.is_file() else []


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[int, Path]]:
    """A scheduler and a worker as docs/cluster.md starts them; the group of their processes, and the folder."""
    block = re.search(r"<!-- keys -->\n((?:    .*\n|\n)+)", PAGE)
    start = re.search(r"<!-- loopback -->\n((?:    .*\n)+)", PAGE)
    assert block is not None
    assert start is not None
    scheduler, worker = (line.strip() for line in start[1].splitlines()[:2])
    keys = "\n".join(line[4:] for line in block[1].splitlines())
    script = (
        f"set -e\n{keys}\n{scheduler} 2> log &\nuntil [ -s out/scheduler.json ]; do sleep 0.1; done\n{worker} &\nwait\n"
    )
    environment = {**os.environ, "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}"}
    options = {"cwd": tmp_path, "env": environment, "stderr": subprocess.DEVNULL, "start_new_session": True}
    with subprocess.Popen(["bash", "-c", script], **options) as group:  # type: ignore[call-overload]
        try:
            wait_for(tmp_path / "out" / "scheduler.json")
            until = time.monotonic() + 120.0
            while len(workers_of(tmp_path)) < 2 and time.monotonic() < until:
                time.sleep(0.5)
            yield group.pid, tmp_path
        finally:
            os.killpg(group.pid, 9)


@needs_proc
@needs_root
@pytest.mark.slow
def test_another_user_is_refused_on_every_port_of_the_documented_scheduler(cluster: tuple[int, Path]) -> None:
    """Plain connections, certificates of one's own, pages of HTTP; whoever has the keys gets in."""
    group, folder = cluster
    found = listeners(group)
    assert all(name.startswith("tcp") for name in found)
    by_number = sorted({int(name.rsplit(":", 1)[1]) for name in found})
    file = folder / "out" / "scheduler.json"
    first = int(json.loads(file.read_text())["address"].rsplit(":", 1)[1])
    ports = [first, *(port for port in by_number if port != first)]
    assert first in by_number
    assert len(ports) >= 6  # of the scheduler, two workers, two nannies, and what HTTP is left
    environment = {"DASK_CONFIG": str(folder / "out" / "keys")}
    arguments = (",".join(map(str, ports)), folder / "out" / "keys", file)
    done = as_nobody(ATTACK, *arguments, imports=BEFORE, environment=environment)
    assert done.stdout.strip() == f"[] {6 * len(ports) + 1 + 3}", done.stdout + done.stderr
