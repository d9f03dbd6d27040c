"""LLVM from Debian's or Ubuntu's own packages: installed with root, unpacked into our cache without.

Every step goes through the ordinary ``apt-get``, so mirrors, proxies and signatures are what the machine is set up for.
"""

import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

from phibench.render.llvm_library import LlvmError, cache_folder, probe

PACKAGES = ("libllvm19", "libllvm20", "libllvm21", "libllvm22")
"""In the order of preference: 19 is what this project is tested with."""

_STALE_S = 86400.0
_PARTIAL = ".partial-"


class AptError(LlvmError):
    """A step of apt-get or dpkg-deb failed."""


def is_offered() -> bool:
    """Return whether this machine has the tools at all."""
    return shutil.which("apt-get") is not None and shutil.which("dpkg-deb") is not None


def fetch() -> None:
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
    unpack(cache_folder())


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
    """Return what `package` needs and the system does not have."""
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
