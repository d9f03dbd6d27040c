"""What one library file is: the order of versions, what its name suggests, where ours are kept."""

from pathlib import Path

import pytest

from phibench.render.setup import llvm_library
from phibench.render.setup.llvm_library import Llvm, Version


@pytest.mark.parametrize(
    ("name", "hint"),
    [("libLLVM-14.so.1", 14), ("libLLVM.so.19.1", 19), ("libLLVM-19.so", 19), ("libLLVM.so", 0), ("libLLVM.dylib", 0)],
)
def test_hints(name: str, hint: int) -> None:
    assert llvm_library.version_hint(Path(name)) == hint


def test_the_cache_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PHIBENCH_CACHE", "/a")
    monkeypatch.setenv("XDG_CACHE_HOME", "/b")
    monkeypatch.setenv("HOME", "/c")
    assert llvm_library.llvm_cache_folder() == Path("/a/llvm")
    monkeypatch.delenv("PHIBENCH_CACHE")
    assert llvm_library.llvm_cache_folder() == Path("/b/phibench/llvm")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert llvm_library.llvm_cache_folder() == Path("/c/.cache/phibench/llvm")


def test_versions_are_compared_as_numbers() -> None:
    versions: list[Version] = [(16, 0, 6), (17, 0, 0), (19, 0, 0), (100, 0, 0)]
    found = [Llvm(Path("x"), version) for version in versions]
    assert [one.is_candidate for one in found] == [False, True, True, True]
    assert [one.is_proven for one in found] == [False, False, True, True]
