"""LLVM for Dr.Jit: found on the system, fetched if there is none, proven, and made known to Dr.Jit.

Dr.Jit 1.5 looks for an LLVM by file name and uses the first that it meets. It refuses 14 and older; 15 and 16 abort the
whole process on machines with AVX-512. So an LLVM is chosen here, by the version that the library itself reports,
before Dr.Jit is imported. This module imports neither Dr.Jit nor Mitsuba.

Where none is found, one is fetched from Debian's or Ubuntu's own packages: installed with root, unpacked into our cache
without. Every step goes through the ordinary ``apt-get``, so that mirrors, proxies and signatures are the machine's.

Run ``python -m phibench.render.setup.llvm`` to make sure of one.
"""

from __future__ import annotations

import argparse
import glob
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from phibench.render.setup.llvm_library import (
    OLDEST_PROVEN,
    Llvm,
    LlvmError,
    llvm_cache_folder,
    load,
    probe,
    prove,
    version_hint,
)

PACKAGES = ("libllvm19", "libllvm20", "libllvm21", "libllvm22")
"""In the order of preference: 19 is what this project is tested with."""

_STALE_S = 86400.0
_PARTIAL = ".partial-"


class AptError(LlvmError):
    """A step of apt-get or dpkg-deb failed."""


def is_offered() -> bool:
    """Return whether this machine has the tools at all."""
    return shutil.which("apt-get") is not None and shutil.which("dpkg-deb") is not None


def fetch_llvm() -> None:
    """Get LLVM onto this machine: for all users where that is allowed, else into our own cache.

    Raises
    ------
    LlvmError
        If neither works.
    """
    if os.geteuid() == 0:
        try:
            install()
            return
        except AptError:
            # Root of a container with a read-only system, or without a working dpkg: what a user can do, root can do.
            pass
    unpack(llvm_cache_folder())


def install() -> None:
    """Install the package with apt-get; needs root."""
    options = ["-o", "DPkg::Lock::Timeout=120"]
    try:
        _install(options)
    except AptError:  # the lists are missing, as in a fresh container, or older than the mirror
        _apt(["update"], options)
        _install(options)


def unpack(cache: Path) -> Path:
    """Download the package and what it needs, unpack them into a folder of `cache`, and return that folder. No root."""
    try:
        cache.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(cache)
        with tempfile.TemporaryDirectory(prefix=_PARTIAL, dir=cache) as name:
            return _unpack_in(Path(name), cache)
    except OSError as error:
        raise LlvmError(
            f"LLVM cannot be unpacked into {cache} ({error.strerror}): set PHIBENCH_CACHE to a folder of yours."
        ) from error


def _install(options: list[str]) -> None:
    _apt(["install", "-y", "--no-install-recommends", _first_offered(options)], options)


def _unpack_in(work: Path, cache: Path) -> Path:
    """Download and unpack in the folder `work`, then give the tree its final name in one step."""
    # Root's downloads would be made by another user, who may not write here.
    options = ["-o", "Debug::NoLocking=1", "-o", "APT::Sandbox::User=root", "-o", f"Dir::Cache={work / 'cache'}"]
    for folder in ("cache", "lists/partial"):
        (work / folder).mkdir(parents=True)
    try:
        package = _download(work, options)
    except AptError:  # no lists, or older than the mirror: only root may renew the system's, so keep lists of our own
        options += ["-o", f"Dir::State::Lists={work / 'lists'}"]
        _apt(["update"], options)
        package = _download(work, options)
    tree = work / "tree"
    for archive in sorted(work.glob("*.deb")):
        _run(["dpkg-deb", "-x", str(archive), str(tree)], work)
    return _settle(tree, cache / package)


def _download(work: Path, options: list[str]) -> str:
    """Download the package and its missing dependencies into `work`, and return the name of the package."""
    package = _first_offered(options)
    _apt(["download", package, *_missing(package, options)], options, work)
    return package


def _first_offered(options: list[str]) -> str:
    """Return the first of PACKAGES that the package lists have."""
    for package in PACKAGES:
        answer = _run(["apt-cache", *options, "policy", package])
        candidate = [line.split(":", 1)[1].strip() for line in answer.splitlines() if "Candidate:" in line]
        if candidate and candidate[0] != "(none)":
            return package
    raise AptError(
        f"the package lists of this machine offer none of {', '.join(PACKAGES)}: "
        "set DRJIT_LIBLLVM_PATH to an LLVM 19 or later."
    )


def _missing(package: str, options: list[str]) -> list[str]:
    """Packages that `package` needs and the system does not have."""
    plan = _apt(["-s", "install", "--no-install-recommends", package], options)
    steps = [line.split() for line in plan.splitlines() if line.startswith("Inst ")]
    # "Inst NAME [INSTALLED] (NEW ...)" is an upgrade: a second libc in one process would be worse than an old one.
    return [step[1] for step in steps if not step[2].startswith("[") and step[1].split(":")[0] != package]


def _settle(tree: Path, final: Path) -> Path:
    """Rename `tree` to `final`. Of two processes that fetch at once the second keeps what the first has made."""
    if any(probe(path) for path in final.glob("usr/lib/*/libLLVM*.so*")):
        return final
    shutil.rmtree(final, ignore_errors=True)
    tree.rename(final)
    return final


def _remove_abandoned(cache: Path) -> None:
    """Remove what a killed process has left; a day old, so that nobody is still at work in it."""
    for folder in cache.glob(f"{_PARTIAL}*"):
        if time.time() - folder.stat().st_mtime > _STALE_S:
            shutil.rmtree(folder, ignore_errors=True)


def _apt(arguments: list[str], options: list[str], folder: Path | None = None) -> str:
    return _run(["apt-get", "-q", *options, *arguments], folder)


def _run(command: list[str], folder: Path | None = None) -> str:
    """Run a packaging tool without questions and in English, and return what it prints."""
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive", "LC_ALL": "C"}
    done = subprocess.run(
        command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        complaints = [line for line in done.stderr.splitlines() if line.startswith("E:")] or done.stderr.splitlines()
        raise AptError(
            f"`{' '.join(command)}` failed ({complaints[0] if complaints else 'no message'}): "
            "set the fault right, or set DRJIT_LIBLLVM_PATH to an LLVM 19 or later."
        )
    return done.stdout


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
_FETCH_IT = "run `python -m phibench.render.setup.llvm`, which fetches one"
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
        if not fetch or os.environ.get(ENVIRONMENT) or not is_offered():
            raise
    fetch_llvm()
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
    ours = _libraries(str(llvm_cache_folder() / "libllvm*" / "usr/lib/*"))
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
    advice = _FETCH_IT if is_offered() else _INSTALL_IT
    return f"no LLVM {OLDEST_PROVEN} or later was found in {llvm_cache_folder()} or the system{rejected}: {advice}."


def main(arguments: list[str] | None = None) -> int:
    """Make sure of an LLVM and say which; exit status 1 and one sentence if there is none."""
    parser = argparse.ArgumentParser(prog="python -m phibench.render.setup.llvm", description=main.__doc__)
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
