"""Forecast and price of a large data set, made through a scheduler of dask with kills; some samples are compared.

python docs/measure_scale.py docs/pairs_of_scale.toml out/scale --compare 20

Kills take turns: a worker, then the command, which is started again. In the end the folder is verified, and the files
of the first samples are compared with those of a small run without scheduler and kills.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import resource
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

BIN = Path(sys.executable).parent
KILLS = (0.05, 0.15, 0.3, 0.45, 0.65, 0.85)  # shares of the tasks that are finished then
FORECAST = re.compile(r"^to make: .*$", re.MULTILINE)
MARKS = (".exr", ".npz", ".png")  # what is rendered


def finished(out: Path) -> int:
    """Tasks in the journal of the folder `out`."""
    journal = out / "journal.txt"
    return journal.read_bytes().count(b'{"task"') if journal.is_file() else 0


def processes_below(parent: int) -> list[int]:
    """Ids of the processes below `parent`, nearest first."""
    text = subprocess.run(["ps", "-eo", "pid=,ppid="], capture_output=True, text=True, check=True).stdout
    children: dict[int, list[int]] = {}
    for line in text.splitlines():
        pid, above = map(int, line.split())
        children.setdefault(above, []).append(pid)
    below = list(children.get(parent, []))
    for pid in below:
        below += children.get(pid, [])
    return below


def kill_a_worker(workers: int) -> None:
    """Kill the process with the most memory below the nannies, which is one that renders."""
    below = processes_below(workers)
    sizes = {pid: int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in below}
    os.kill(max(sizes, key=sizes.__getitem__), signal.SIGKILL)


def start(stack: ExitStack, words: list[str]) -> subprocess.Popen[bytes]:
    """A process that ends with the stack."""
    child = subprocess.Popen(words, stderr=subprocess.DEVNULL)
    stack.callback(child.wait)
    stack.callback(child.terminate)  # a nanny then ends its workers and waits for them
    return child


def make_with_kills(command: list[str], out: Path, workers: int, log: Path) -> int:
    """Run the command till it ends by itself; how many kills there were."""
    tasks, kills = None, 0
    while True:
        with log.open("ab") as stream:
            child = subprocess.Popen(command, stderr=stream, stdout=stream)
        while child.poll() is None:
            time.sleep(1.0)
            text = log.read_text(errors="replace")
            tasks = tasks or next((int(found) for found in re.findall(r"tasks: \d+/(\d+)", text)), None)
            if tasks and kills < len(KILLS) and finished(out) > KILLS[kills] * tasks:
                kills += 1
                if kills % 2:
                    kill_a_worker(workers)
                else:
                    child.kill()
        if child.returncode != -signal.SIGKILL:
            if child.returncode:
                sys.exit(f"the command ended with {child.returncode}; see {log}")
            return kills


def hashes(out: Path, samples: Path) -> dict[str, str]:
    """SHA-256 of each rendered file of `out` that is in the folder `samples`, too."""
    names = sorted(str(path.relative_to(samples)) for path in samples.rglob("*") if path.suffix in MARKS)
    return {name: hashlib.sha256((out / name).read_bytes()).hexdigest() for name in names}


def main() -> None:
    """Read the options, make, verify, compare, and print what it cost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recipe", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--samples", type=int)
    parser.add_argument("--compare", type=int, default=20, help="samples of the small run")
    options = parser.parse_args()
    phibench = [str(BIN / "phibench"), "dataset"]
    count = [] if options.samples is None else ["--samples", str(options.samples)]
    log = options.out.with_suffix(".log")
    log.write_bytes(b"")
    begin = time.monotonic()
    with TemporaryDirectory() as folder:
        with ExitStack() as stack:
            file = f"{folder}/scheduler.json"
            local = ["--protocol", "tcp", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
            start(stack, [str(BIN / "dask"), "scheduler", *local, "--scheduler-file", file])
            dask = ["--nthreads", "1", "--nworkers", "2", "--memory-limit", "0", "--no-dashboard"]
            workers = start(stack, [str(BIN / "dask"), "worker", "--scheduler-file", file, *dask])
            wait = ["--scheduler", file, "--wait-for-workers", "120"]
            make = [*phibench, "make", str(options.recipe), "--out", str(options.out), *count]
            kills = make_with_kills([*make, *wait], options.out, workers.pid, log)
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        wall = time.monotonic() - begin
        subprocess.run([*phibench, "verify", str(options.out)], check=True)
        small = Path(folder) / "small"
        few = ["--samples", str(options.compare)]
        subprocess.run([*phibench, "make", str(options.recipe), "--out", str(small), *few], check=True)
        same, there = hashes(small, small), hashes(options.out, small)
    size = sum(path.stat().st_size for path in options.out.rglob("*") if path.is_file())
    print(FORECAST.findall(log.read_text())[0])
    print(f"{finished(options.out)} tasks, {kills} kills, {wall / 60:.1f} min, {size / 1e6:.0f} MB")
    print(f"{(used.ru_utime + used.ru_stime) / 60:.1f} CPU-min of all processes")
    print(f"{sum(same[name] == there[name] for name in same)} of {len(same)} rendered files have the same bytes")


if __name__ == "__main__":
    main()
