"""Mitsuba is switched on once, with the right LLVM and one thread, or says in one sentence why not."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from phibench.render.setup.variant import CUDA, LLVM

Python = Callable[..., subprocess.CompletedProcess[str]]
ACTIVATE = "from phibench.render.setup.variant import LLVM, activate; mi = activate(LLVM)\n"
WITHOUT_LIBATOMIC = """
import sys
class Loader:
    def find_spec(self, name, path=None, target=None):
        if name == "drjit._drjit_ext":
            raise ImportError("libatomic.so.1: cannot open shared object file: No such file or directory")
sys.meta_path.insert(0, Loader())
"""
CHECKSUMS = """
import sys, drjit as dr
from drjit.llvm import Float, PCG32
if len(sys.argv) > 1: dr.set_thread_count(int(sys.argv[1]))
lots = PCG32(4_000_000)
cell, value = lots.next_uint32() % 3, lots.next_float32()
cells = dr.zeros(Float, 3)
dr.scatter_add(cells, dr.sin(value), cell)
print(*(float(x).hex() for x in cells), float(dr.sum(value, axis=None)[0]).hex())
"""


def test_one_thread_and_no_helpers(python: Python) -> None:
    code = ACTIVATE + CHECKSUMS + "import os\nprint(dr.thread_count(), mi.variant())"
    child = python(code)
    assert child.returncode == 0, child.stderr
    assert child.stdout.splitlines()[-1] == "1 llvm_ad_rgb"


def test_two_processes_agree_to_the_last_bit(python: Python) -> None:
    """A million float32 terms per cell: any other order of adding shows in the last bits."""
    outputs = {python(ACTIVATE + CHECKSUMS).stdout for _ in range(3)}
    assert len(outputs) == 1
    assert len(outputs.pop().split()) == 4


def test_the_sums_depend_on_the_order(python: Python) -> None:
    """The opposite: with helpers the same code gives other bits, so that the test above could have failed."""
    assert python(ACTIVATE + CHECKSUMS, "4").stdout != python(ACTIVATE + CHECKSUMS).stdout


def test_again_is_nothing_and_another_is_refused(python: Python) -> None:
    code = ACTIVATE + "assert activate() is mi\nactivate('scalar_rgb')"
    child = python(code)
    assert child.stderr.splitlines()[-1].endswith(
        "this process renders with llvm_ad_rgb and cannot change to scalar_rgb: start another process for that."
    )


def test_the_environment_overrules(python: Python) -> None:
    child = python(ACTIVATE + "print(mi.variant())", PHIBENCH_VARIANT="scalar_rgb", DRJIT_LIBLLVM_PATH="/nowhere")
    assert (child.returncode, child.stdout.strip()) == (0, "scalar_rgb"), child.stderr


NO_DRIVER = {"DRJIT_LIBCUDA_PATH": "/nowhere", "DRJIT_LIBOPTIX_PATH": "/nowhere"}
FAKE = """
int cuInit(unsigned flags) { return %d; }
int cuDeviceGetCount(int *count) { *count = %d; return 0; }
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler to make a driver that answers")
@pytest.mark.parametrize(("status", "devices", "expected"), [(0, 1, True), (0, 0, False), (100, 1, False)])
def test_a_gpu_is_there_if_a_driver_says_so_and_is_taken_only_if_asked_for(
    python: Python, tmp_path: Path, status: int, devices: int, expected: bool
) -> None:
    """Drivers that answer: a device, none, and an error; a GPU itself is not needed."""
    (tmp_path / "fake.c").write_text(FAKE % (status, devices))
    library = tmp_path / "fake.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, tmp_path / "fake.c"], check=True)
    code = "from phibench.render.setup.variant import asked_variant, has_gpu; print(has_gpu(), asked_variant())"
    places = {"DRJIT_LIBCUDA_PATH": str(library), "DRJIT_LIBOPTIX_PATH": str(library)}
    child = python(code, **places)
    assert child.stdout.split() == [str(expected), LLVM], child.stderr
    assert python(code, **places, PHIBENCH_VARIANT="cuda").stdout.split() == [str(expected), CUDA]
    assert python(code, **{**places, "DRJIT_LIBOPTIX_PATH": "/nowhere"}).stdout.split() == ["False", LLVM]


@pytest.mark.parametrize("name", ["llvm", LLVM])
def test_llvm_has_a_short_name(python: Python, name: str) -> None:
    child = python(ACTIVATE + "print(mi.variant())", PHIBENCH_VARIANT=name)
    assert child.stdout.strip() == LLVM, child.stderr


@pytest.mark.parametrize(
    ("code", "environment", "complaint"),
    [
        ("import sys; sys.modules['mitsuba'] = None\n" + ACTIVATE, {}, "run `pip install 'phibench[render]'`."),
        (ACTIVATE, {"PHIBENCH_VARIANT": "llvm_nonsense"}, "has no variant llvm_nonsense: choose one of llvm, cuda, "),
        (ACTIVATE, {"PHIBENCH_VARIANT": "cuda", **NO_DRIVER}, "CUDA is asked for, and no NVIDIA driver with OptiX"),
        (ACTIVATE, {"DRJIT_LIBLLVM_PATH": "/nowhere"}, "DRJIT_LIBLLVM_PATH names /nowhere, which is not a file"),
        ("import drjit\n" + ACTIVATE, {"DRJIT_LIBLLVM_PATH": ""}, "Dr.Jit was imported before its LLVM was chosen"),
        (WITHOUT_LIBATOMIC + ACTIVATE, {}, "Mitsuba cannot be loaded (libatomic.so.1: cannot open shared object file"),
        (WITHOUT_LIBATOMIC + ACTIVATE, {}, "apt-get install libatomic1"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(
    python: Python, code: str, environment: dict[str, str], complaint: str
) -> None:
    child = python(code, **environment)
    assert child.returncode == 1
    assert complaint in child.stderr.splitlines()[-1]
