"""What a method's reference stands for: its file with the modules beside it, all hashed."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.sandbox_pairs import GOOD, HEADER, SmallPairs, method_file

from phibench.benchmark.isolation.method_references import resolve
from phibench.benchmark.isolation.run_limits import MethodError, RunLimits
from phibench.benchmark.isolation.runner import run_method

LIMITS = RunLimits(seconds=60.0)  # the machine may do other things: no test here is about time


def package(folder: Path) -> str:
    """A method that imports what lies beside it, some of it by way of others; the reference to it."""
    files = {
        "fits.py": "import numpy\nfrom shapes import gauss\n",
        "shapes/__init__.py": "",
        "shapes/gauss.py": "from . import width\nfrom .units import mm\n",
        "shapes/width.py": "",
        "shapes/units.py": "import fits\nmm = 1\n",  # a circle
        "shapes/unused.py": "",
        "later.py": "",
        "other.py": "",
        "broken.py": "def (",
    }
    for name, text in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    return method_file(folder, f"import later\nreturn {GOOD}", header=f"{HEADER}import os, json, fits\n")


def test_the_modules_beside_a_method_are_hashed_with_it(tmp_path: Path) -> None:
    found = resolve(package(tmp_path))
    assert [name for name, _ in found.modules] == [
        "fits.py",
        "later.py",
        "shapes/__init__.py",
        "shapes/gauss.py",
        "shapes/units.py",
        "shapes/width.py",
    ]
    document = found.document()
    assert document["modules"]["later.py"] == resolve(f"{tmp_path}/later.py:x").sha256
    assert str(tmp_path) not in str(document)
    broken = method_file(tmp_path, f"return {GOOD}", "uses.py", f"{HEADER}import broken\n")
    assert [name for name, _ in resolve(broken).modules] == ["broken.py"]


@pytest.mark.parametrize("change", ["edit", "remove"])
def test_a_changed_module_beside_a_method_is_refused(tmp_path: Path, change: str) -> None:
    found = resolve(package(tmp_path))
    assert found.changed() == ""
    file = tmp_path / "shapes" / "width.py"
    if change == "edit":
        file.write_text("WIDTH = 2")
    else:
        file.unlink()
    assert found.changed() == "width.py"
    with pytest.raises(MethodError, match=r"width\.py was changed or removed after it was looked up"):
        run_method(found, SmallPairs(1), LIMITS)
