"""What a score says of the method that ran: packages, opened files, and the hash of an installed package."""

from __future__ import annotations

import hashlib
import importlib.metadata
import sys
from pathlib import Path

import pytest
from helpers.sandbox_pairs import GOOD, HEADER, SmallPairs, method_file

from phibench.benchmark.isolation.method_provenance import OpenedFiles, package_sha256, packages_of
from phibench.benchmark.isolation.method_references import code_of_function
from phibench.benchmark.isolation.run_limits import RunLimits
from phibench.benchmark.isolation.runner import Harness, provenance_here

LIMITS = RunLimits(seconds=60.0)
linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells of opened files")


def written(path: Path, text: str) -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return hashlib.sha256(text.encode()).hexdigest()


@linux
def test_weights_are_hashed_whoever_opens_them(tmp_path: Path) -> None:
    """By Python at import, by a C library in the function, by a process of its own, and under --allow."""
    own, allowed = tmp_path / "own", tmp_path / "elsewhere"
    hashes = {
        "at_import.txt": written(own / "at_import.txt", "one"),
        "nets/by_c.onnx": written(own / "nets" / "by_c.onnx", "two"),
        "by_another.bin": written(own / "by_another.bin", "three"),
        "named_late.py": written(own / "named_late.py", "y = 1\n"),
        "allow: elsewhere/big.bin": written(allowed / "big.bin", "four"),
    }
    written(own / "unused.bin", "five")
    written(own / "helper.py", "x = 1\n")
    header = (
        f"{HEADER}import ctypes, importlib, subprocess\nfrom pathlib import Path\nimport helper\n"
        "HERE = Path(__file__).parent\nFIRST = (HERE / 'at_import.txt').read_text()\n"
    )
    body = (
        "libc = ctypes.CDLL(None)\n"
        "libc.open(bytes(HERE / 'nets' / ('by_' + 'c.onnx')), 0)\n"
        "subprocess.run(['cat', HERE / 'by_another.bin'], stdout=subprocess.DEVNULL, check=True)\n"
        "importlib.import_module('named' + '_late')\n"
        f"open({str(allowed / 'big.bin')!r}).read()\n"
        f"return {GOOD}"
    )
    reference = method_file(own, body, header=header)
    with Harness([reference], RunLimits(seconds=60.0, allow=(str(allowed),)), workers=2) as harness:
        outcomes = list(harness.outcomes(SmallPairs(3), range(3)))
    assert [one.failure for (one,) in outcomes] == [""] * 3
    (ran,) = harness.ran
    assert (ran.files, ran.files_complete) == (hashes, True)


@linux
def test_hidden_files_bytecode_and_what_is_gone(tmp_path: Path) -> None:
    for name in ("truth/a.json", "__pycache__/m.pyc", "kept.bin", "gone.bin", "a\nb.bin"):
        written(tmp_path / name, name)
    opened = OpenedFiles([("", tmp_path)], [tmp_path / "truth"])
    for path in sorted(path for path in tmp_path.rglob("*") if path.is_file()):
        path.read_bytes()
    (tmp_path / "gone.bin").unlink()
    opened.close()
    (tmp_path / "unused.bin").write_text("later")
    assert opened.hashes([tmp_path / "kept.bin"]) == {
        "a b.bin": hashlib.sha256(b"a\nb.bin").hexdigest(),
        "gone.bin": None,
    }
    assert opened.complete


@linux
def test_more_folders_than_are_watched_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("phibench.benchmark.isolation.method_provenance._FOLDERS", 2)
    for name in "abc":
        (tmp_path / name).mkdir()
    opened = OpenedFiles([("", tmp_path)])
    opened.close()
    assert not opened.complete


def test_packages_are_those_that_the_process_has_loaded(tmp_path: Path) -> None:
    """Also one that is imported late, in a function; modules beside the method are no packages."""
    written(tmp_path / "helper.py", "x = 1\n")
    late = method_file(tmp_path, f"import skimage.filters\nreturn {GOOD}", header=f"{HEADER}import helper\n")
    plain = method_file(tmp_path, f"return {GOOD}", "plain.py")
    with Harness([late, plain], LIMITS) as harness:
        list(harness.outcomes(SmallPairs(2), range(2)))
    first, second = harness.ran
    assert first.packages["scikit-image"] == importlib.metadata.version("scikit-image")
    assert first.packages["numpy"] == second.packages["numpy"] == importlib.metadata.version("numpy")
    assert "scikit-image" not in second.packages
    assert not {"helper", "phibench_method", "json", "skimage"} & set(first.packages)


def test_a_method_that_spoils_its_modules_is_answered_all_the_same(tmp_path: Path) -> None:
    spoil = "sys.modules[7] = sys.modules['a' * 200] = sys.modules['b\\n'] = object()"
    body = f"{spoil}\nsys.modules['c'] = type('M', (), {{'__file__': '/x/c.py'}})()\nsys.modules['c'].__file__ = 3\n"
    with Harness([method_file(tmp_path, f"{body}return {GOOD}", header=f"{HEADER}import sys\n")], LIMITS) as harness:
        outcomes = [one for (one,) in harness.outcomes(SmallPairs(2), range(2))]
    assert [one.failure for one in outcomes] == ["", ""]
    assert "numpy" in harness.ran[0].packages


def installed(site: Path, name: str, files: dict[str, str], listed: bool = True) -> importlib.metadata.Distribution:
    """An installed package with its list of files."""
    info = site / f"{name.replace('-', '_')}-1.5.dist-info"
    written(info / "METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.5\n")
    for file, text in files.items():
        written(site / file, text)
    names = [*files, f"{info.name}/METADATA", f"{info.name}/RECORD", f"{info.name}/INSTALLER", "../../bin/tool"]
    if listed:
        written(info / "RECORD", "".join(f"{file},,\n" for file in names))
    written(info / "INSTALLER", "pip\n")
    return importlib.metadata.Distribution.at(info)


def test_parts_of_a_namespace_are_packages_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installed(tmp_path, "space-one", {"space/one/__init__.py": ""})
    installed(tmp_path, "space-two", {"space/two.py": ""})
    monkeypatch.syspath_prepend(tmp_path)
    assert packages_of(["space.two", "nowhere", "_finder"]) == {"nowhere": None, "space-two": "1.5"}
    assert packages_of(["space.one"]) == {"space-one": "1.5"}
    installed(tmp_path, "late", {"late.py": ""})  # while this process runs
    assert packages_of(["late"]) == {"late": "1.5"}


def test_the_hash_of_a_package_is_that_of_its_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = {"theirs/__init__.py": "", "theirs/find.py": "def find(pair): ...\n", "theirs/weights.bin": "1 2 3"}
    owner = installed(tmp_path / "a", "their-package", files)
    first = package_sha256(owner, "theirs.find")
    assert first is not None
    # elsewhere, by another installer, with bytecode: the same package
    again = installed(tmp_path / "b", "their-package", {**files, "theirs/find.pyc": "x"})
    written(tmp_path / "b" / "their_package-1.5.dist-info" / "INSTALLER", "uv\n")
    assert package_sha256(again, "theirs.find") == first
    written(tmp_path / "a" / "theirs" / "weights.bin", "1 2 4")
    assert package_sha256(owner, "theirs.find") not in (first, None)
    # editable, or without a list: the files that an import would find
    monkeypatch.syspath_prepend(tmp_path / "b")
    editable = installed(tmp_path / "c", "their-package", {"__editable__.their.pth": str(tmp_path / "b")})
    by_place = package_sha256(editable, "theirs.find")
    assert by_place == package_sha256(None, "theirs.find") != first
    written(tmp_path / "b" / "theirs" / "weights.bin", "1 2 5")
    assert package_sha256(editable, "theirs.find") not in (by_place, None)
    assert package_sha256(None, "no_such_module") is None
    assert "theirs" not in sys.modules


def test_a_function_in_this_process_has_the_hash_of_its_file(tmp_path: Path) -> None:
    def extract(pair: object) -> None: ...

    assert code_of_function(extract)["sha256"] == hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
    assert code_of_function(eval("lambda pair: None")) == {"sha256": None}
    assert provenance_here().packages["pytest"] == pytest.__version__


@linux
def test_a_watch_ends_with_its_run(tmp_path: Path) -> None:
    count = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(3):
        OpenedFiles([("", tmp_path)]).close()
    assert len(list(Path("/proc/self/fd").iterdir())) == count
