"""Finding and importing a method: every fault is one clear sentence."""

from __future__ import annotations

import hashlib
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from helpers.sandbox_pairs import GOOD, SmallPairs, method_file

from phibench.benchmark.isolation import method_references as resolving
from phibench.benchmark.isolation.method_references import resolve
from phibench.benchmark.isolation.method_worker import load_method
from phibench.benchmark.isolation.run_limits import MethodError


@pytest.fixture(autouse=True)
def untouched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Importing a method changes this process: the path is restored."""
    monkeypatch.setattr(sys, "path", list(sys.path))


def written(folder: Path, text: str) -> str:
    (folder / "my_phi.py").write_text(text, encoding="utf-8")
    return f"{folder / 'my_phi.py'}:extract"


def test_a_file_is_found_hashed_and_not_run(tmp_path: Path) -> None:
    reference = written(tmp_path, f"open({str(tmp_path / 'ran')!r}, 'w')\ndef extract(pair):\n    return 1\n")
    found = resolve(reference)
    assert found.kind == "file"
    assert found.name == "my_phi:extract"
    assert found.sha256 == hashlib.sha256((tmp_path / "my_phi.py").read_bytes()).hexdigest()
    assert not (tmp_path / "ran").exists()  # the parent knows the truth and must not run the file
    assert str(tmp_path) not in str(found.document())
    assert load_method(found)(None) == 1  # type: ignore[arg-type, comparison-overlap]
    assert (tmp_path / "ran").exists()


def test_a_file_with_a_strange_name_is_refused_by_a_printable_one(tmp_path: Path) -> None:
    name = "[b]\x1b[2J\udcff.py"
    (tmp_path / name).write_text("def extract(pair):\n    return 1\n")
    with pytest.raises(MethodError, match="printable signs") as caught:
        resolve(f"{tmp_path / name}:extract")
    assert str(caught.value).isprintable()
    (tmp_path / "[b].py").write_text("def extract(pair):\n    return 1\n")
    found = resolve(f"{tmp_path / '[b].py'}:extract")
    assert found.name == "[b]:extract"
    assert load_method(found)(None) == 1  # type: ignore[arg-type, comparison-overlap]


def test_a_file_that_was_edited_in_the_meantime_is_refused(tmp_path: Path) -> None:
    found = resolve(written(tmp_path, "def extract(pair):\n    return 1\n"))
    written(tmp_path, "def extract(pair):\n    return 2\n")
    with pytest.raises(MethodError, match="was changed or removed"):
        load_method(found)
    (tmp_path / "my_phi.py").unlink()
    with pytest.raises(MethodError, match="was changed or removed"):
        load_method(found)


def test_a_relative_path_is_made_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written(tmp_path, "def extract(pair): return 1")
    monkeypatch.chdir(tmp_path)
    assert resolve("my_phi.py:extract").place == str(tmp_path / "my_phi.py")


def test_a_file_may_import_its_neighbour_and_define_a_dataclass(tmp_path: Path) -> None:
    (tmp_path / "beside_my_phi.py").write_text("WORD = 5\n")
    text = (
        "from __future__ import annotations\nfrom dataclasses import dataclass\nfrom beside_my_phi import WORD\n"
        "@dataclass\nclass A:\n    x: int\ndef extract(pair): return A(WORD).x\n"
    )
    assert load_method(resolve(written(tmp_path, text)))(None) == 5  # type: ignore[arg-type, comparison-overlap]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("my_fi.py:extract", "my_fi.py is not there; `phibench method new my_fi.py` writes an example"),
        ("my_phi.py", "say which function is meant, such as my_phi.py:extract"),
        ("my_phi.py:", "say which function is meant, such as my_phi.py:extract"),
        ("folder.py:extract", "folder.py is a folder"),
        ("red_centriod", "no method 'red_centriod': did you mean 'red_centroid'?"),
        ("zzz", "no method 'zzz': `phibench method list` lists what there is"),
        ("", "no method ''"),
    ],
)
def test_what_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, words: str) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.py").mkdir()
    (tmp_path / "my_phi.py").touch()
    with pytest.raises(MethodError) as caught:
        resolve(name)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "def extract(pair):\n    return (1,\n",
            "my_phi.py, line 2: '(' was never closed: Python cannot read the file",
        ),
        ("def extract(pair):\nreturn 1\n", "my_phi.py, line 2: expected an indented block"),
        ("x = 1\0\n", "Python cannot read the file"),
        (
            "import no_such_package\n",
            "my_phi.py cannot be imported: ModuleNotFoundError: No module named 'no_such_package'",
        ),
        ("x = 1\ny = x / 0\n", "ZeroDivisionError: division by zero (my_phi.py, line 2, in <module>)"),
        ("import sys\nsys.exit(1)\n", "my_phi.py cannot be imported: SystemExit: 1"),
        ("def extrakt(pair):\n    return 1\n", "my_phi.py has no function 'extract': did you mean 'extrakt'?"),
        ("def zzz(pair):\n    return 1\n", "no function 'extract': it has zzz"),
        ("", "no function 'extract': it has no function at all"),
        ("extract = 5\n", "my_phi.py:extract is of type int, not a function"),
        ("class extract:\n    pass\n", "my_phi.py:extract is a class"),
        ("def extract():\n    return 1\n", "my_phi.py:extract() must take one pair and nothing else"),
        ("def extract(down, up):\n    return 1\n", "my_phi.py:extract(down, up) must take one pair"),
        ("def extract(*, pair):\n    return 1\n", "must take one pair"),
        ("def extract(pair):\n    yield 1\n", "coroutine or generator"),
    ],
)
def test_what_is_wrong_with_a_file(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(MethodError) as caught:
        load_method(resolve(written(tmp_path, text)))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "def extract(pair, side=5): return 1",
        "extract = lambda p: 1",
        "class A:\n  def __call__(self, p): return 1\nextract = A()",
    ],
)
def test_what_takes_one_pair_is_taken(tmp_path: Path, text: str) -> None:
    assert load_method(resolve(written(tmp_path, text)))(None) == 1  # type: ignore[arg-type, comparison-overlap]


def test_built_in_methods_have_a_hash_of_the_code_behind_them() -> None:
    found = resolve("red_centroid")
    assert found.kind == "built-in"
    assert found.sha256 is not None
    assert len(found.sha256) == 64
    assert callable(load_method(found))


class FakeDistribution:
    name, version = "their-package", "2.1"


def registered(monkeypatch: pytest.MonkeyPatch, *points: tuple[str, str]) -> None:
    found = [EntryPoint(name, value, resolving.GROUP)._for(FakeDistribution()) for name, value in points]  # type: ignore[attr-defined]
    monkeypatch.setattr(resolving, "entry_points", lambda group: found if group == resolving.GROUP else [])


def test_installed_packages_register_by_entry_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "their_module.py").write_text("def find(pair):\n    return 7\n")
    monkeypatch.syspath_prepend(tmp_path)
    registered(monkeypatch, ("theirs", "their_module:find"), ("broken", "no_such_module:find"))
    found = resolve("theirs")
    assert (found.kind, found.version) == ("package", "their-package 2.1")
    assert load_method(found)(None) == 7  # type: ignore[arg-type, comparison-overlap]
    with pytest.raises(MethodError, match="method 'broken' cannot be imported: ModuleNotFoundError"):
        load_method(resolve("broken"))
    with pytest.raises(MethodError, match="did you mean 'theirs'"):
        resolve("their")


def test_two_methods_of_one_name_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    registered(monkeypatch, ("a", "x:y"), ("a", "z:y"), ("red_centroid", "x:y"))
    with pytest.raises(MethodError, match=r"'a' is registered by their-package 2\.1 and by"):
        resolve("a")
    with pytest.raises(MethodError, match="'red_centroid' is built in, and their-package"):
        resolve("red_centroid")


def test_an_optional_method_without_its_package_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("phibench.estimator.methods.registry.find_spec", lambda name: None)
    with pytest.raises(MethodError, match="pip install photutils"):
        resolve("photutils_centroid_2dg")


def test_a_fault_of_loading_reaches_the_user_through_the_harness(tmp_path: Path) -> None:
    from phibench.benchmark.isolation.runner import run_method

    with pytest.raises(MethodError, match=r"my_phi\.py has no function 'extrakt': did you mean 'extract'"):
        run_method(method_file(tmp_path, f"return {GOOD}").replace(":extract", ":extrakt"), SmallPairs(1))
