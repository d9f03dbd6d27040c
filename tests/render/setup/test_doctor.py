"""The doctor finds every fault, says what to do about it, and survives whatever happens in its children."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from phibench.render.setup import doctor, selftest
from phibench.render.setup.child_program import fault_of
from phibench.render.setup.doctor import Diagnosis

Python = Callable[..., subprocess.CompletedProcess[str]]
DOCTOR = "import sys; from phibench.render.setup.doctor import main; sys.exit(main())"


def lines_of(output: str, word: str) -> list[str]:
    return [line for line in output.splitlines() if line.startswith(word)]


def test_a_good_machine_is_found_good(python: Python) -> None:
    child = python(DOCTOR)
    assert child.returncode == 0, child.stdout + child.stderr
    assert "values as expected" in child.stdout
    assert lines_of(child.stdout, "fault") == []


def test_a_bad_llvm_is_one_fault_and_the_image_is_not_tried(python: Python, tmp_path: Path) -> None:
    bad = tmp_path / "libLLVM-14.so.1"
    bad.write_bytes(b"")
    child = python(DOCTOR, DRJIT_LIBLLVM_PATH=str(bad))
    assert child.returncode == 1, child.stderr
    llvm, image = lines_of(child.stdout, "fault")
    assert f"DRJIT_LIBLLVM_PATH names {bad}" in llvm
    assert "unset it" in llvm
    assert "set right first LLVM" in image


def without(*names: str) -> str:
    """Code that hides packages."""
    return (
        "import sys; from importlib import metadata; find = metadata.version\n"
        "def version(name):\n"
        f"    if name in {names}: raise metadata.PackageNotFoundError(name)\n"
        "    return find(name)\n"
        "metadata.version = version\n"
        f"sys.modules.update(dict.fromkeys({names}))\n"
    )


def test_an_installation_for_scoring_only_is_in_order(python: Python) -> None:
    child = python(without("mitsuba", "drjit") + DOCTOR, DRJIT_LIBLLVM_PATH="/nowhere")
    assert child.returncode == 0, child.stdout + child.stderr
    assert lines_of(child.stdout, "fault") == []
    [line] = [line for line in child.stdout.splitlines() if "scoring works; rendering needs" in line]
    assert "pip install 'phibench[render]'" in line
    rows = [line.split("│")[1:-1] for line in child.stdout.splitlines() if "not installed" in line]
    assert [[cell.strip() for cell in row] for row in rows] == [
        [name, "not installed", "optional"] for name in ("mitsuba", "drjit")
    ]
    assert "Traceback" not in child.stderr


def test_scoring_only_with_a_missing_package_is_a_fault(python: Python) -> None:
    child = python(without("mitsuba", "drjit", "polars") + DOCTOR)
    assert child.returncode == 1, child.stdout + child.stderr
    assert "scoring works" not in child.stdout
    assert "fault: polars is not installed" in child.stdout


def test_half_a_renderer_is_a_fault_with_the_command_to_run(python: Python) -> None:
    child = python(without("mitsuba", "no-such-thing") + DOCTOR)
    assert child.returncode == 1, child.stderr
    assert "fault: mitsuba is not installed: run `pip install 'phibench[render]'`." in child.stdout
    assert "Traceback" not in child.stderr


def test_another_variant_needs_no_llvm(python: Python) -> None:
    child = python(DOCTOR, PHIBENCH_VARIANT="scalar_rgb", DRJIT_LIBLLVM_PATH="/nowhere")
    assert len(lines_of(child.stdout, "warning: LLVM")) == 1
    assert lines_of(child.stdout, "fault") == []
    assert child.returncode == 0, child.stdout + child.stderr


def test_a_child_that_aborts_hangs_or_fails_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]))
    programs = {
        "aborts": "import os, sys\nprint('LLVM ERROR: x', file=sys.stderr)\nprint('0x1', file=sys.stderr)\nos.abort()",
        "hangs": "import time\ntime.sleep(60)",
        "fails": "raise ValueError('so it is')",
        "misses": "try:\n    raise ImportError('libx.so: cannot open' + ' shared object file')\nfinally:\n    nothing",
        "quits": "import sys\nsys.exit(3)",
        "works": "import os, sys\nsys.exit(os.environ['GIVEN'] + sys.argv[1] != 'ab')",
    }
    for name, code in programs.items():
        (tmp_path / f"child_{name}.py").write_text(code)
    assert fault_of("child_aborts", timeout_s=30) == "LLVM ERROR: x (killed by signal 6)"
    assert fault_of("child_hangs", timeout_s=0.5) == "not done after 0.5 s"
    assert fault_of("child_fails", timeout_s=30) == "ValueError: so it is (exit status 1)"
    missing = "ImportError: libx.so: cannot open shared object file (exit status 1)"
    assert fault_of("child_misses", timeout_s=30) == missing
    assert fault_of("child_quits", timeout_s=30) == "no message (exit status 3)"
    assert fault_of("child_works", "b", timeout_s=30, environment={"GIVEN": "a"}) == ""


def test_versions_are_compared_with_the_pins() -> None:
    installed = doctor.metadata.version("numpy")
    assert doctor.package_finding("numpy", installed).state == "ok"
    assert doctor.package_finding("numpy", None).state == "ok"
    other = doctor.package_finding("numpy", "0.1")
    assert (other.state, f"numpy is {installed}, tested with 0.1" in other.advice) == ("warning", True)
    assert doctor.package_finding("no-such-thing", "1").state == "fault"
    extra = list(doctor.package_findings({"pytest": "0.1", "no-such-thing": "1"}))
    assert [finding.subject for finding in extra if finding.state != "ok"] == ["pytest"]


def test_the_pins_of_this_checkout_are_read() -> None:
    pinned = doctor.pinned_versions()
    assert pinned["mitsuba"] == "3.9.1"
    assert set(doctor.CORE) | set(doctor.RENDER) <= set(pinned)


def test_an_old_python_and_a_full_disk_are_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.python_finding((3, 10, 9)).state == "fault"
    assert doctor.python_finding(sys.version_info[:3]).state == "ok"
    monkeypatch.setattr(doctor, "LEAST_DISK_GIB", 0.0)
    assert doctor.disk_finding(tmp_path).state == "ok"
    monkeypatch.setattr(doctor, "LEAST_DISK_GIB", 1e9)
    assert doctor.disk_finding(tmp_path).state == "warning"


def test_the_status_is_that_of_the_worst_finding(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = "/a/very/long/[bold]path/" + "x" * 300
    for state, status in (("ok", 0), ("warning", 0), ("fault", 1)):
        findings = [Diagnosis("a", "fine"), Diagnosis("b", path, state, f"look at {path}.")]  # type: ignore[arg-type]
        monkeypatch.setattr(doctor, "examine", lambda findings=findings: iter(findings))
        assert doctor.main() == status
        assert f"{state}: look at {path}.\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("ball", "sky", "complaint"),
    [
        (1.0, 1.0, ""),
        (1.03, 1.0, "the ball"),
        (0.97, 1.0, "the ball"),
        (1.0, 1.001, "the sky"),
        (float("nan"), 1.0, "the ball"),
        (1.0, float("nan"), "the sky"),
    ],
)
def test_a_wrong_image_is_noticed(ball: float, sky: float, complaint: str) -> None:
    image = np.full((selftest.SIZE_PX,) * 2, selftest.SKY * sky, dtype=np.float32)
    image[5:11, 5:11] = selftest.ALBEDO * selftest.SKY * ball
    fault = selftest.compare(image)
    assert fault.startswith(complaint) if complaint else fault == ""
