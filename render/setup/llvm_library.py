"""One LLVM shared library: version, loading, proof with Dr.Jit; and the cache folders, where fetched ones lie.

The version is read out of the library itself, in a child process. A file name proves nothing (``libLLVM.so``), and a
library that crashes while it is loaded must not take this process with it. Only the standard library is used here.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from phibench.render.setup.child_program import fault_of


def cache_root() -> Path:
    """Return the cache folder: PHIBENCH_CACHE, or phibench under XDG_CACHE_HOME or ``~/.cache``, in this order."""
    if own := os.environ.get("PHIBENCH_CACHE"):
        return Path(own).absolute()
    base = os.environ.get("XDG_CACHE_HOME")
    # Not Path.home(), which raises for a user without a home: such a folder is reported where it cannot be made.
    home = os.path.expanduser("~")  # noqa: PTH111
    return Path(base or f"{home}/.cache").absolute() / "phibench"


Version = tuple[int, int, int]

OLDEST_PROVEN = 19
"""Dr.Jit 1.5 was tried with LLVM 19 and 22, and is taken to work with what came between and after."""
OLDEST_UNPROVEN = 17
"""LLVM 17 and 18 are untried: used only when nothing better can be had and the proof passes on this very machine."""

_PROBE_S = 20.0
_PROVE_S = 120.0
_PROBE = """
import ctypes, sys
parts = [ctypes.c_uint() for _ in range(3)]
ctypes.CDLL(sys.argv[1]).LLVMGetVersion(*map(ctypes.byref, parts))
print(*(part.value for part in parts))
"""


class LlvmError(RuntimeError):
    """No usable LLVM. The message is one sentence: what is wrong, where, and what to do."""


@dataclass(frozen=True, slots=True)
class Llvm:
    """One LLVM shared library.

    Attributes
    ----------
    path : Path
        The file.
    version : tuple of int
        What the library itself says it is: major, minor, patch.
    companions : tuple of Path
        Libraries it needs that were fetched with it because the system has none of its own. They are loaded first.
    """

    path: Path
    version: Version
    companions: tuple[Path, ...] = ()

    @property
    def label(self) -> str:
        """The version as people write it, such as ``19.1.7``."""
        return ".".join(map(str, self.version))

    @property
    def is_proven(self) -> bool:
        """True if this version is known to work with Dr.Jit 1.5."""
        return self.version[0] >= OLDEST_PROVEN

    @property
    def is_candidate(self) -> bool:
        """True if this version may work: the proof decides."""
        return self.version[0] >= OLDEST_UNPROVEN


def version_hint(path: Path) -> int:
    """Return the major version that a file name suggests, 0 for none: good for an order of trial, for nothing else."""
    found = re.search(r"libLLVM(?:-|\.so\.)(\d+)", path.name)
    return int(found.group(1)) if found else 0


def llvm_cache_folder() -> Path:
    """Return the folder for LLVMs of our own, in the user's cache."""
    return cache_root() / "llvm"


def companions_of(path: Path) -> tuple[Path, ...]:
    """Return the other libraries of the fetched tree that `path` is part of; none for a library of the system."""
    cache = llvm_cache_folder()
    if not path.is_relative_to(cache) or path.parent == cache:
        return ()
    tree = cache / path.relative_to(cache).parts[0]
    found = {file for pattern in ("usr/lib/*/lib*.so*", "lib/*/lib*.so*") for file in tree.glob(pattern)}
    return tuple(sorted(file for file in found if not file.is_symlink() and "libLLVM" not in file.name))


_ASKED: dict[tuple[object, ...], Llvm] = {}  # by path, time of change, size and companions: `make` asks three times


def probe(path: Path) -> Llvm | None:
    """Load a library in a child process and ask it for its version (about 30 ms), once while its file stays as it is.

    Returns
    -------
    Llvm or None
        None for what cannot be loaded, crashes, or has no ``LLVMGetVersion``: that function came with LLVM 16.
    """
    try:
        state, companions = path.stat(), companions_of(path)
    except OSError:
        return None
    key = (path, state.st_mtime_ns, state.st_size, companions)
    if key not in _ASKED and (found := _answer(path, companions)):
        _ASKED[key] = found
    return _ASKED.get(key)


def _answer(path: Path, companions: tuple[Path, ...]) -> Llvm | None:
    search = os.pathsep.join(sorted({str(companion.parent) for companion in companions}))
    environment = {**os.environ, "LD_LIBRARY_PATH": search} if companions else None
    command = [sys.executable, "-I", "-S", "-c", _PROBE, str(path)]
    try:
        # An older release says on stderr that the symbol is missing: an expected answer, so it is not shown.
        answer = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=_PROBE_S, check=False)
    except subprocess.TimeoutExpired:
        return None
    numbers = answer.stdout.split()
    if answer.returncode != 0 or len(numbers) != 3:
        return None
    major, minor, patch = map(int, numbers)
    return Llvm(path, (major, minor, patch), companions)


def load(path: Path) -> None:
    """Load the companions and the library into this process, where Dr.Jit finds them by their names.

    Raises
    ------
    LlvmError
        If one of them cannot be loaded (a dependency was removed, the cache of another machine).
    """
    waiting: tuple[Path, ...] = companions_of(path)
    while waiting:
        # They need one another in an order that only the loader knows: go round until nothing is left or nothing moves.
        failures = {companion: fault for companion in waiting if (fault := _load_one(companion))}
        if len(failures) == len(waiting):
            raise LlvmError(_cannot_load(waiting[0], failures[waiting[0]]))
        waiting = tuple(failures)
    if fault := _load_one(path):
        raise LlvmError(_cannot_load(path, fault))


def _load_one(path: Path) -> str:
    """Load one library for all that come after it, and return what went wrong, or nothing."""
    try:
        # Companions must be visible to the library that needs them; LLVM's own symbols carry versions and do not clash.
        ctypes.CDLL(str(path), ctypes.RTLD_GLOBAL)
    except OSError as error:
        return str(error)
    return ""


def _cannot_load(path: Path, fault: str) -> str:
    return f"{path} cannot be loaded ({fault}): run `python -m phibench.render.setup.llvm` to get an LLVM that can."


def prove(llvm: Llvm) -> str:
    """Compile and run a small kernel in a child process: an abort inside LLVM cannot be caught any other way.

    Returns
    -------
    str
        Empty if it works, otherwise the reason in a few words.
    """
    with tempfile.TemporaryDirectory(prefix="phibench-tmp-proof-") as home, _held(home):
        # Dr.Jit keeps compiled kernels under HOME: with a fresh one the kernel is really compiled by this library.
        environment = {"HOME": home, "DRJIT_LIBLLVM_PATH": str(llvm.path)}
        return fault_of("phibench.render.setup.selftest", str(llvm.path), timeout_s=_PROVE_S, environment=environment)


@contextlib.contextmanager
def _held(folder: str) -> Iterator[None]:
    """Lock a temporary folder: `datasets/store/temporary_folders.py` removes one that nobody holds."""
    import fcntl

    handle = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # where locks do not work, nobody removes anything
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)
