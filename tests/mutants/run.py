"""Proof that the tests see faults: `make mutants` applies each fault of `faults.toml` alone and runs its tests.

A fault that no test sees fails the run, and so does one whose text is not found exactly once: the library has moved on
and the fault must be written anew. The checkout itself is not touched; everything happens in copies.

    python tests/mutants/run.py                 # all faults
    python tests/mutants/run.py "sign of"       # those whose name contains this
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

ROOT = Path(__file__).resolve().parents[2]
FAULTS = Path(__file__).with_name("faults.toml")
LEAST = 40
PROCESSES = 2
TIMEOUT_S = 1200.0
_SEEN, _PASSED, _TOO_SLOW = 1, 0, -1  # exit codes of pytest: some test failed, all passed


@dataclass(frozen=True)
class Fault:
    """One replacement in one file, and the tests that must see it."""

    name: str
    file: str
    find: str
    replace: str
    tests: tuple[str, ...]

    def apply(self, root: Path) -> None:
        path = root / self.file
        text = path.read_text(encoding="utf-8")
        if text.count(self.find) != 1:
            raise ValueError(f"its text stands {text.count(self.find)} times in {self.file}: write the fault anew")
        path.write_text(text.replace(self.find, self.replace), encoding="utf-8")


def read_faults(path: Path = FAULTS) -> list[Fault]:
    tables = tomllib.loads(path.read_text(encoding="utf-8"))["fault"]
    faults = [Fault(**{**table, "tests": tuple(table["tests"])}) for table in tables]
    assert len({fault.name for fault in faults}) == len(faults) >= LEAST
    return faults


def copy_of_checkout(folder: Path) -> Path:
    """Copy of what git knows and of new files, links kept."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, check=True, capture_output=True, text=True,
    ).stdout.split("\0")  # fmt: skip
    for name in filter(None, listed):
        source, target = ROOT / name, folder / name
        if source.is_symlink() or source.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target, follow_symlinks=False)
    return folder


def pytest(root: Path, tests: Sequence[str]) -> int:
    """Exit code of a run on the package below `root`, which the path puts before an installed one."""
    environment = {**os.environ, "PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    try:
        done = subprocess.run(command, cwd=root, env=environment, capture_output=True, timeout=TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return _TOO_SLOW
    return done.returncode


def verdict(fault: Fault) -> tuple[bool, str]:
    start = monotonic()
    with tempfile.TemporaryDirectory(prefix="phibench-mutant-") as folder:
        root = copy_of_checkout(Path(folder))
        try:
            fault.apply(root)
        except ValueError as error:
            return False, str(error)
        code = pytest(root, fault.tests)
    texts = {_SEEN: "dies", _PASSED: "LIVES", _TOO_SLOW: "NO ANSWER"}
    return code == _SEEN, f"{texts.get(code, f'pytest exit code {code}')} after {monotonic() - start:.0f} s"


def control(faults: Sequence[Fault]) -> bool:
    """Whether all tests that are used pass without a fault."""
    tests = sorted({test for fault in faults for test in fault.tests})
    with tempfile.TemporaryDirectory(prefix="phibench-mutant-") as folder:
        return pytest(copy_of_checkout(Path(folder)), tests) == _PASSED


def main(arguments: Sequence[str]) -> int:
    faults = [fault for fault in read_faults() if not arguments or any(word in fault.name for word in arguments)]
    if not faults:
        print(f"no fault has '{arguments[0]}' in its name")
        return 2
    with ThreadPoolExecutor(PROCESSES) as pool:
        sound = pool.submit(control, faults)
        results = []
        for fault, (dead, text) in zip(faults, pool.map(verdict, faults), strict=True):
            results.append(dead)
            print(f"{text:>20}  {fault.name}", flush=True)
    print(f"without a fault: {'all tests pass' if sound.result() else 'TESTS FAIL'}")
    print(f"{sum(results)} of {len(results)} faults die")
    return 0 if all(results) and sound.result() else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
