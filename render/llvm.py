"""The LLVM that Dr.Jit compiles with: found, fetched if there is none, proven, and made known to Dr.Jit.

Dr.Jit 1.5 looks for an LLVM by file name and takes what it meets: 14 and older are refused, 15 and 16 abort the whole
process on machines with AVX-512. So one is chosen here, by the version that the library itself reports, before Dr.Jit
is imported. This module imports neither Dr.Jit nor Mitsuba.

Run ``python -m phibench.render.llvm`` to make sure of one.
"""

import argparse
import glob
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from phibench.render import llvm_apt
from phibench.render.llvm_library import (
    OLDEST_PROVEN,
    Llvm,
    LlvmError,
    cache_folder,
    load,
    probe,
    prove,
    version_hint,
)

ENVIRONMENT = "DRJIT_LIBLLVM_PATH"
"""What Dr.Jit reads. A user who sets it decides; `use_llvm` sets it for this process and its children."""

SYSTEM_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib/llvm-*/lib",
    "/usr/lib64",
    "/usr/lib64/llvm*/lib*",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)
_FILE_NAMES = ("libLLVM.so*", "libLLVM-*.so*", "libLLVM*.dylib")
_FETCH_IT = "run `python -m phibench.render.llvm`, which fetches one"
_INSTALL_IT = (
    "install one (Fedora: `dnf install llvm-libs`; macOS: `brew install llvm`; conda: `conda install libllvm19`) "
    f"or set {ENVIRONMENT} to its file"
)


def find_llvm() -> Llvm:
    """Find an LLVM that Dr.Jit can use, without fetching anything.

    The order is: what DRJIT_LIBLLVM_PATH names, our own cache, the system. 19 and later win over 17 and 18, which are
    taken only if they pass the proof; 16 and older are never taken.

    Raises
    ------
    LlvmError
        If there is none, or if DRJIT_LIBLLVM_PATH names an unusable one.
    """
    if named := os.environ.get(ENVIRONMENT):
        return _named(Path(named))
    unproven = []
    for path in candidates():
        llvm = probe(path)
        if llvm and llvm.is_proven:
            return llvm
        if llvm and llvm.is_candidate:
            unproven.append(llvm)
    for llvm in unproven:
        if not prove(llvm):
            return llvm
    raise LlvmError(_nothing_found())


def ensure_llvm(*, fetch: bool = True) -> Llvm:
    """Find an LLVM and prove it, or fetch one and prove that.

    Parameters
    ----------
    fetch : bool
        Whether the machine's package manager may be asked.

    Raises
    ------
    LlvmError
        If no LLVM passes the proof in the end.
    """
    try:
        return _proven(find_llvm())
    except LlvmError:
        if not fetch or os.environ.get(ENVIRONMENT) or not llvm_apt.is_offered():
            raise
    llvm_apt.fetch()
    return _proven(find_llvm())


def use_llvm() -> Llvm:
    """Choose an LLVM for this process and its children. To be called before Dr.Jit is imported.

    Raises
    ------
    LlvmError
        If there is none, or if it cannot be loaded.
    """
    llvm = find_llvm()
    load(llvm.path)
    os.environ[ENVIRONMENT] = str(llvm.path)
    return llvm


def candidates() -> list[Path]:
    """List the libraries to try, best first, each file once whatever links lead to it."""
    ours = _libraries(str(cache_folder() / "libllvm*" / "usr/lib/*"))
    conda = os.environ.get("CONDA_PREFIX")
    folders = (*SYSTEM_FOLDERS, f"{glob.escape(conda)}/lib") if conda else SYSTEM_FOLDERS
    system = (path for folder in folders for path in _libraries(folder))
    return [*_best_first(ours), *_best_first(system)]


def _libraries(folder_pattern: str) -> Iterator[Path]:
    for folder in sorted(glob.glob(folder_pattern)):
        for name in _FILE_NAMES:
            yield from (path.resolve() for path in Path(folder).glob(name) if path.is_file())


def _best_first(paths: Iterable[Path]) -> list[Path]:
    """Sort by the name alone, so that mostly the first trial is the last; what counts is what the trial says."""

    def rank(path: Path) -> tuple[bool, int, str]:
        hint = version_hint(path)
        return 0 < hint < OLDEST_PROVEN, -hint, str(path)

    return sorted(set(paths), key=rank)


def _named(path: Path) -> Llvm:
    """Return the library that the user names, or say why it cannot be used."""
    advice = f"unset it, or set it to the file of an LLVM {OLDEST_PROVEN} or later."
    if not path.is_file():
        raise LlvmError(f"{ENVIRONMENT} names {path}, which is not a file: {advice}")
    llvm = probe(path)
    if llvm is None or not llvm.is_candidate:
        what = f"LLVM {llvm.label}" if llvm else "no library, or an LLVM older than 16"
        raise LlvmError(f"{ENVIRONMENT} names {path}, which is {what} and would fail or abort in Dr.Jit: {advice}")
    if not llvm.is_proven and (fault := prove(llvm)):
        what = f"LLVM {llvm.label} and fails the proof, {fault}"
        raise LlvmError(f"{ENVIRONMENT} names {path}, which is {what}: {advice}")
    return llvm


def _proven(llvm: Llvm) -> Llvm:
    if fault := prove(llvm):
        raise LlvmError(
            f"LLVM {llvm.label} at {llvm.path} fails the proof, {fault}: set {ENVIRONMENT} to another, {OLDEST_PROVEN} "
            "or later."
        )
    return llvm


def _nothing_found() -> str:
    seen = sorted({hint for path in candidates() if (hint := version_hint(path))})
    rejected = f" (rejected: {', '.join(map(str, seen))})" if seen else ""
    advice = _FETCH_IT if llvm_apt.is_offered() else _INSTALL_IT
    return f"no LLVM {OLDEST_PROVEN} or later was found in {cache_folder()} or the system{rejected}: {advice}."


def main(arguments: list[str] | None = None) -> int:
    """Make sure of an LLVM and say which; exit status 1 and one sentence if there is none."""
    parser = argparse.ArgumentParser(prog="python -m phibench.render.llvm", description=main.__doc__)
    parser.add_argument("--no-fetch", action="store_true", help="only look, install or download nothing")
    options = parser.parse_args(arguments)
    try:
        llvm = ensure_llvm(fetch=not options.no_fetch)
    except LlvmError as error:
        print(f"phibench: {error}", file=sys.stderr)
        return 1
    print(f"LLVM {llvm.label} at {llvm.path} works.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
