"""Command that checks the installation: Python, packages, LLVM, cores, disk, and one rendered image of known values.

Run ``python -m phibench.render.setup.doctor``. Every fault comes with one line that says what to do. Nothing is
changed.

The exit code is 1 if something is broken. It is 0 where neither mitsuba nor drjit is installed: scoring needs neither,
and one line says what rendering needs. One of the two without the other is broken.
"""

from __future__ import annotations

import os
import platform
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from phibench.render.setup.child_program import GET_LIBRARY, MISSING_LIBRARY, fault_of
from phibench.render.setup.llvm import find_llvm
from phibench.render.setup.llvm_library import LlvmError, prove
from phibench.render.setup.variant import asked_variant

State = Literal["ok", "optional", "warning", "fault"]

CORE = (
    "cyclopts",
    "filelock",
    "Jinja2",
    "matplotlib",
    "numpy",
    "OpenEXR",
    "pillow",
    "polars",
    "pydantic",
    "rich",
    "scikit-image",
    "scipy",
)
RENDER = ("mitsuba", "drjit")
OLDEST_PYTHON = (3, 11)
LEAST_DISK_GIB = 2.0
_RENDER_S = 180.0
_COLOURS: dict[State, str] = {"ok": "green", "optional": "dim", "warning": "yellow", "fault": "red"}


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """One line of the table; `advice` says what to do about it."""

    subject: str
    value: str
    state: State = "ok"
    advice: str = ""


def examine() -> Iterator[Diagnosis]:
    """Look at everything, cheap things first."""
    yield python_finding(sys.version_info[:3])
    packages = list(package_findings(pinned_versions()))
    yield from packages
    if is_scoring_only():
        yield cores_finding()
        yield disk_finding(Path.cwd())
        yield scoring_finding(after=packages)
        return
    variant = asked_variant()
    yield Diagnosis("variant", variant)
    llvm = llvm_finding(is_needed=variant.startswith("llvm"))
    yield llvm
    yield cores_finding()
    yield disk_finding(Path.cwd())
    yield image_finding(after=[*packages, llvm])


def python_finding(version: tuple[int, ...]) -> Diagnosis:
    """Judge the version of Python."""
    text = f"{'.'.join(map(str, version))} on {platform.system()} {platform.machine()}"
    if version >= OLDEST_PYTHON:
        return Diagnosis("Python", text)
    oldest = ".".join(map(str, OLDEST_PYTHON))
    return Diagnosis("Python", text, "fault", f"Python is too old: make the environment with Python {oldest} or later.")


def pinned_versions() -> dict[str, str]:
    """Read ``constraints.txt`` of the checkout; empty where the package was installed without one."""
    file = Path(__file__).resolve().parents[2] / "constraints.txt"
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    return dict(line.strip().split("==", 1) for line in lines if "==" in line)


def package_findings(pinned: dict[str, str]) -> Iterator[Diagnosis]:
    """Compare what is installed with what this checkout was tested with."""
    for name in CORE:
        yield package_finding(name, pinned.get(name))
    for name in RENDER:
        absent = is_scoring_only()
        yield Diagnosis(name, "not installed", "optional") if absent else package_finding(name, pinned.get(name))
    for name in sorted(set(pinned) - set(CORE) - set(RENDER)):
        finding = package_finding(name, pinned[name])
        # What the tests or the checks need may be absent; what is there should be what was tested.
        if finding.state == "warning":
            yield finding


def package_finding(name: str, pinned: str | None) -> Diagnosis:
    """Judge one package: absent is a fault, another version than the pinned one a warning."""
    try:
        installed = metadata.version(name)
    except metadata.PackageNotFoundError:
        extra = "phibench[render]" if name in RENDER else "phibench"
        return Diagnosis(name, "not installed", "fault", f"{name} is not installed: run `pip install '{extra}'`.")
    if pinned in (None, installed):
        return Diagnosis(name, installed)
    advice = f"{name} is {installed}, tested with {pinned}: run `pip install -c constraints.txt {name}`."
    return Diagnosis(name, installed, "warning", advice)


def llvm_finding(*, is_needed: bool) -> Diagnosis:
    """Find an LLVM and prove it; without one only the variants that need none can be used."""
    state: State = "fault" if is_needed else "warning"
    try:
        llvm = find_llvm()
    except LlvmError as error:
        return Diagnosis("LLVM", "none usable", state, f"LLVM: {error}")
    text = f"{llvm.label} at {llvm.path}"
    if not is_installed("drjit"):
        return Diagnosis("LLVM", f"{text}, untried without drjit")
    if fault := prove(llvm):
        return Diagnosis("LLVM", text, state, f"LLVM {llvm.label} fails the proof, {fault}: {_remedy(fault)}.")
    return Diagnosis("LLVM", text)


def _remedy(fault: str) -> str:
    return GET_LIBRARY if MISSING_LIBRARY in fault else "run `python -m phibench.render.setup.llvm`"


def is_installed(name: str) -> bool:
    """Return whether a distribution is there, without importing it."""
    try:
        metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    return True


def is_scoring_only() -> bool:
    """Return whether nothing that renders is installed: a choice, where half of it would be a fault."""
    return not any(is_installed(name) for name in RENDER)


def scoring_finding(after: list[Diagnosis]) -> Diagnosis:
    """Say what an installation without the renderer can do, unless something it needs is already found missing."""
    if any(finding.state == "fault" for finding in after):
        return Diagnosis("use", "scoring only, once the faults are set right")
    advice = f"scoring works; rendering needs {' and '.join(RENDER)}: run `pip install 'phibench[render]'`."
    return Diagnosis("use", "scoring works, no renderer", "warning", advice)


def cores_finding() -> Diagnosis:
    """Count the cores that this process may use."""
    return Diagnosis("cores", str(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()))


def disk_finding(folder: Path) -> Diagnosis:
    """Judge the free space where data sets are written by default."""
    free = shutil.disk_usage(folder).free / 2**30
    text = f"{free:.1f} GiB free in the current folder"
    if free >= LEAST_DISK_GIB:
        return Diagnosis("disk", text)
    return Diagnosis(
        "disk", text, "warning", f"only {free:.1f} GiB are free here: write data sets elsewhere with `--out`."
    )


def image_finding(after: list[Diagnosis]) -> Diagnosis:
    """Render the known image in a child process, unless something it needs is already found missing."""
    if causes := [finding.subject for finding in after if finding.state == "fault"]:
        advice = f"no test image was rendered: set right first {', '.join(causes)}."
        return Diagnosis("test image", "not tried", "fault", advice)
    if fault := fault_of("phibench.render.setup.selftest", timeout_s=_RENDER_S):
        advice = f"the test image failed, {fault}: run `python -m phibench.render.setup.selftest` to see all of it."
        return Diagnosis("test image", "wrong", "fault", advice)
    return Diagnosis("test image", "rendered, values as expected")


def show(findings: list[Diagnosis]) -> None:
    """Print the table, then one line per warning or fault."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(show_header=False)
    table.add_column()
    table.add_column(overflow="fold")  # a path must stay whole
    table.add_column()
    for finding in findings:
        table.add_row(finding.subject, escape(finding.value), f"[{_COLOURS[finding.state]}]{finding.state}[/]")
    console = Console()
    console.print(table)
    for finding in findings:
        if finding.advice:
            # Not wrapped and without markup: one line, with paths and brackets as they are.
            console.print(f"{finding.state}: {finding.advice}", markup=False, highlight=False, soft_wrap=True)


def main() -> int:
    """Examine, show, and return 0 if there is no fault."""
    findings = list(examine())
    show(findings)
    return 1 if any(finding.state == "fault" for finding in findings) else 0


if __name__ == "__main__":
    sys.exit(main())
