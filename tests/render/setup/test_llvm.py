"""LLVM: the right one is chosen, a wrong one never, and fetching leaves either a whole tree or none."""

import _ctypes
import os
import shutil
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from phibench.render.setup import llvm, llvm_library
from phibench.render.setup.llvm_library import Llvm, LlvmError

Python = Callable[..., subprocess.CompletedProcess[str]]
FOLDER = "usr/lib/x86_64-linux-gnu"


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with nothing on it: an empty cache, one empty system folder, no wishes of the user."""
    (tmp_path / "system").mkdir()
    monkeypatch.setenv("PHIBENCH_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv(llvm.ENVIRONMENT, raising=False)
    monkeypatch.delenv("CONDA_PREFIX", raising=False)
    monkeypatch.setattr(llvm, "SYSTEM_FOLDERS", (str(tmp_path / "system"),))
    return tmp_path


@pytest.fixture
def pretend(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Let a file's content be the version it reports; `proof` names the majors that pass the proof."""

    def probe(path: Path) -> Llvm | None:
        words = path.read_text().split(".")
        return Llvm(path, (int(words[0]), int(words[1]), int(words[2]))) if len(words) == 3 else None

    def set_up(*, proof: tuple[int, ...] = (17, 18, 19, 20, 21, 22)) -> None:
        def prove(found: Llvm) -> str:
            return "" if found.version[0] in proof else "it aborts"

        for module in (llvm,):
            monkeypatch.setattr(module, "probe", probe)
        monkeypatch.setattr(llvm, "prove", prove)

    return set_up


def put(path: Path, version: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(version)
    return path


# --- which one is chosen


@pytest.mark.parametrize(
    ("installed", "expected"),
    [
        ({"libLLVM-14.so.1": "old", "libLLVM.so.19.1": "19.1.7"}, 19),
        ({"libLLVM-18.so.1": "18.1.8", "libLLVM.so.19.1": "19.1.7"}, 19),
        ({"libLLVM-17.so.1": "17.0.6", "libLLVM-16.so.1": "16.0.6"}, 17),
        ({"libLLVM.so": "22.1.0"}, 22),
        # Names that lie: what the library says counts.
        ({"libLLVM.so.22.1": "15.0.7", "libLLVM-14.so.1": "20.1.2"}, 20),
    ],
)
def test_the_best_of_what_is_installed(
    machine: Path, pretend: Callable[..., None], installed: dict[str, str], expected: int
) -> None:
    pretend()
    for name, version in installed.items():
        put(machine / "system" / name, version)
    assert llvm.find_llvm().version[0] == expected


@pytest.mark.parametrize(
    "installed",
    [
        {},
        {"libLLVM-14.so.1": "old", "libLLVM-15.so.1": "old"},
        {"libLLVM-16.so.1": "16.0.6"},
        {"libLLVM.so.19.1": "16.0.6"},
        {"libLLVM.so.19.1": "not loadable"},
        {"libLLVM-18.so.1": "18.1.8"},  # its proof fails
    ],
)
def test_nothing_is_better_than_a_bad_one(
    machine: Path, pretend: Callable[..., None], installed: dict[str, str]
) -> None:
    pretend(proof=(16, 19))
    for name, version in installed.items():
        put(machine / "system" / name, version)
    with pytest.raises(LlvmError, match="no LLVM 19 or later was found") as caught:
        llvm.find_llvm()
    assert one_sentence(caught.value)


def test_the_order_is_user_cache_system(
    machine: Path, pretend: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend()
    system = put(machine / "system/libLLVM.so.22.1", "22.1.0")
    assert llvm.find_llvm().path == system
    cached = put(machine / "cache/llvm/libllvm19" / FOLDER / "libLLVM.so.19.1", "19.1.7")
    assert llvm.find_llvm().path == cached
    named = put(machine / "elsewhere/libLLVM.so", "20.1.0")
    monkeypatch.setenv(llvm.ENVIRONMENT, str(named))
    assert llvm.find_llvm().path == named


def test_an_unproven_one_in_the_cache_gives_way_to_a_proven_one(machine: Path, pretend: Callable[..., None]) -> None:
    pretend()
    put(machine / "cache/llvm/libllvm18" / FOLDER / "libLLVM.so.18.1", "18.1.8")
    proven = put(machine / "system/libLLVM.so.19.1", "19.1.7")
    assert llvm.find_llvm().path == proven


@pytest.mark.parametrize(
    ("content", "complaint"),
    [(None, "not a file"), ("old", "older than 16"), ("16.0.6", "LLVM 16"), ("18.1.8", "aborts")],
)
def test_a_bad_wish_of_the_user_is_refused_and_not_replaced(
    machine: Path, pretend: Callable[..., None], monkeypatch: pytest.MonkeyPatch, content: str | None, complaint: str
) -> None:
    pretend(proof=(19,))
    put(machine / "system/libLLVM.so.19.1", "19.1.7")
    named = machine / "named.so"
    if content:
        put(named, content)
    monkeypatch.setenv(llvm.ENVIRONMENT, str(named))
    monkeypatch.setattr(llvm, "fetch_llvm", lambda: pytest.fail("nothing is to be fetched against the user's wish"))
    with pytest.raises(LlvmError, match=complaint) as caught:
        llvm.ensure_llvm()
    assert str(named) in str(caught.value)
    assert one_sentence(caught.value)


def test_links_to_one_file_are_one_candidate(machine: Path) -> None:
    library = put(machine / "system/libLLVM.so.19.1", "19.1.7")
    for name in ("libLLVM-19.so", "libLLVM.so"):
        (machine / "system" / name).symlink_to(library)
    assert llvm.candidates() == [library]


def test_ensure_fetches_when_the_found_one_fails_the_proof(
    machine: Path, pretend: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend(proof=(20,))
    put(machine / "system/libLLVM.so.19.1", "19.1.7")
    cached = machine / "cache/llvm/libllvm20" / FOLDER / "libLLVM.so.20.1"
    monkeypatch.setattr(llvm, "is_offered", lambda: True)
    monkeypatch.setattr(llvm, "fetch_llvm", lambda: put(cached, "20.1.2"))
    with pytest.raises(LlvmError, match="fails the proof, it aborts"):
        llvm.ensure_llvm(fetch=False)
    assert llvm.ensure_llvm().path == cached


def one_sentence(error: Exception) -> bool:
    text = str(error)
    return "\n" not in text and text.endswith(".") and ": " in text


# --- real libraries


def test_the_one_of_this_machine_is_new_and_compiles() -> None:
    found = llvm.find_llvm()
    assert found.version >= (17, 0, 0)
    assert llvm_library.prove(found) == ""


@pytest.mark.parametrize("content", ["another library", "truncated", "empty"])
def test_a_name_proves_nothing(machine: Path, content: str) -> None:
    library = machine / "system/libLLVM.so.19.1"
    real = Path(_ctypes.__file__).read_bytes()
    library.write_bytes({"another library": real, "truncated": real[:500], "empty": b""}[content])
    assert llvm.candidates() == [library]
    assert llvm_library.probe(library) is None
    assert llvm_library.prove(Llvm(library, (19, 1, 7))) != ""
    with pytest.raises(LlvmError):
        llvm.find_llvm()


def test_a_library_is_asked_once_while_its_file_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What could not be loaded is asked again, and so is what changed; what is gone is none."""
    asked, library = list[Path](), put(tmp_path / "libLLVM.so", "one")

    def answer(path: Path, companions: tuple[Path, ...]) -> Llvm | None:
        asked.append(path)
        return Llvm(path, (19, 1, len(asked)), companions) if len(asked) > 1 else None

    monkeypatch.setattr(llvm_library, "_ASKED", {})
    monkeypatch.setattr(llvm_library, "_answer", answer)
    found = [llvm_library.probe(library) for _ in range(3)]
    assert found == [None, Llvm(library, (19, 1, 2), ()), Llvm(library, (19, 1, 2), ())]
    put(library, "another")
    assert llvm_library.probe(library) == Llvm(library, (19, 1, 3), ())
    library.unlink()
    assert llvm_library.probe(library) is None
    assert len(asked) == 3


OLD = sorted(
    {
        path.resolve()
        for folder in llvm.SYSTEM_FOLDERS
        for path in Path("/").glob(f"{folder[1:]}/libLLVM-1[0-6].so*")
        if path.is_file()
    }
)


@pytest.mark.skipif(not OLD, reason="this machine has no LLVM older than 17 that could be picked by mistake")
def test_the_old_ones_of_this_machine_are_never_picked(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in OLD:
        (machine / "system" / path.name).symlink_to(path)
    assert len(llvm.candidates()) == len(OLD)
    with pytest.raises(LlvmError, match="rejected"):
        llvm.find_llvm()
    for path in OLD:
        monkeypatch.setenv(llvm.ENVIRONMENT, str(path))
        with pytest.raises(LlvmError, match="DRJIT_LIBLLVM_PATH names"):
            llvm.find_llvm()


def test_use_sets_the_variable_and_loads_the_library(python: Python) -> None:
    code = (
        "import os; from phibench.render.setup.llvm import use_llvm; found = use_llvm()\n"
        "assert os.environ['DRJIT_LIBLLVM_PATH'] == str(found.path)\n"
        "from drjit.llvm import Float; import drjit as dr\n"
        "print(dr.sum(dr.minimum(dr.arange(Float, 5), 2.0), axis=None)[0])\n"
        "if os.path.exists('/proc/self/maps'):\n"
        "    used = {line.split()[-1] for line in open('/proc/self/maps') if 'libLLVM' in line}\n"
        "    assert used == {os.path.realpath(found.path)}, used\n"
    )
    child = python(code)
    assert (child.returncode, child.stdout.strip()) == (0, "7.0"), child.stderr


def test_a_library_that_cannot_be_loaded_is_one_sentence(machine: Path) -> None:
    library = put(machine / "system/libLLVM.so.19.1", "no library")
    with pytest.raises(LlvmError, match="cannot be loaded") as caught:
        llvm_library.load(library)
    assert one_sentence(caught.value)


def test_companions_are_the_other_libraries_of_the_same_tree(machine: Path) -> None:
    tree = machine / "cache/llvm/libllvm19" / FOLDER
    library, companion = put(tree / "libLLVM.so.19.1", ""), put(tree / "libz3.so.4", "")
    (tree / "libz3.so").symlink_to(companion)
    put(machine / "cache/llvm/libllvm20" / FOLDER / "libedit.so.2", "")
    assert llvm_library.companions_of(library) == (companion,)
    assert llvm_library.companions_of(put(machine / "system/libLLVM.so.19.1", "")) == ()


# --- fetching, with packaging tools that only pretend

APT = """#!/bin/sh
echo "$(basename "$0") $*" >> "$LOG"
lists="$STATE"; verb=
for word in "$@"; do
  case "$word" in
    Dir::State::Lists=*) lists="$STATE.own";;
    policy|update|download|install|-x) verb="$verb$word";;
    -s) verb=simulated-;;
    libllvm19|libllvm20) package="$word";;
  esac
done
case "$verb" in
  policy)
    test -e "$lists" || exit 0
    if test "$package" = libllvm20; then echo "  Candidate: 1:20.1.2"; else echo "  Candidate: (none)"; fi;;
  update) test -z "$OFFLINE" || { echo "E: no network" >&2; exit 100; }; touch "$lists";;
  simulated-install)
    echo "Inst libz3-4 (4.8)"; echo "Inst libc6 [2.36] (2.41)"; echo "Inst libllvm20 (1:20)"
    echo "Conf libz3-4 (4.8)";;
  install) test -e "$lists" || { echo "E: Unable to locate" >&2; exit 100; }; touch "$STATE.installed";;
  download) touch libllvm20.deb libz3-4.deb;;
  -x)
    mkdir -p "$3/FOLDER"
    case "$2" in
      */libllvm20.deb) echo 20.1.2 > "$3/FOLDER/libLLVM.so.20.1";;
      *) echo a companion > "$3/FOLDER/libz3-4.so";;
    esac;;
esac
""".replace("FOLDER", FOLDER)


@pytest.fixture
def tools(machine: Path, monkeypatch: pytest.MonkeyPatch, pretend: Callable[..., None]) -> Path:
    """Put false packaging tools on the PATH; what they were asked stands in `log`."""
    pretend()
    for name in ("apt-get", "apt-cache", "dpkg-deb"):
        script = put(machine / "bin" / name, APT)
        script.chmod(script.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{machine / 'bin'}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("LOG", str(machine / "log"))
    monkeypatch.setenv("STATE", str(machine / "lists"))
    monkeypatch.setenv("OFFLINE", "")
    return machine


def asked(tools: Path, word: str) -> list[str]:
    lines = (tools / "log").read_text().splitlines()
    return [line for line in lines if word in line.split()]


def test_unpacking_renews_lists_of_its_own_and_takes_what_is_missing(tools: Path) -> None:
    tree = llvm.unpack(llvm_library.llvm_cache_folder())
    assert tree == tools / "cache/llvm/libllvm20"
    found = llvm.find_llvm()
    assert found.path == tree / FOLDER / "libLLVM.so.20.1"
    assert llvm_library.companions_of(found.path) == (tree / FOLDER / "libz3-4.so",)
    (download,) = asked(tools, "download")
    assert download.split()[-3:] == ["download", "libllvm20", "libz3-4"]
    assert not (tools / "lists").exists()  # the system's lists are not ours to renew
    assert len(asked(tools, "update")) == 1


def test_unpacking_uses_the_lists_of_the_system_where_there_are_some(tools: Path) -> None:
    put(tools / "lists", "")
    llvm.unpack(llvm_library.llvm_cache_folder())
    assert asked(tools, "update") == []


def test_a_failed_fetch_leaves_nothing_and_can_be_repeated(tools: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = llvm_library.llvm_cache_folder()
    monkeypatch.setenv("OFFLINE", "yes")
    with pytest.raises(LlvmError, match="no network") as caught:
        llvm.unpack(cache)
    assert one_sentence(caught.value)
    assert list(cache.iterdir()) == []
    monkeypatch.setenv("OFFLINE", "")
    assert llvm.unpack(cache).is_dir()
    assert [path.name for path in cache.iterdir()] == ["libllvm20"]


def test_a_broken_tree_is_replaced_and_a_good_one_is_kept(tools: Path) -> None:
    library = put(tools / "cache/llvm/libllvm20" / FOLDER / "libLLVM.so.20.1", "broken")
    llvm.unpack(llvm_library.llvm_cache_folder())
    assert library.read_text().strip() == "20.1.2"
    put(library, "20.9.9")
    llvm.unpack(llvm_library.llvm_cache_folder())
    assert library.read_text() == "20.9.9"


def test_what_a_killed_process_left_goes_after_a_day(tools: Path) -> None:
    cache = llvm_library.llvm_cache_folder()
    old, young = put(cache / ".partial-a/x", ""), put(cache / ".partial-b/x", "")
    os.utime(old.parent, (0, 0))
    llvm.unpack(cache)
    assert (old.parent.exists(), young.parent.exists()) == (False, True)


def test_root_installs_for_all_after_renewing_the_lists(tools: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    llvm.fetch_llvm()
    assert (tools / "lists.installed").exists()
    assert not (tools / "cache").exists()


def test_root_that_may_not_install_unpacks(tools: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tools / "bin/apt-get"
    script.write_text(APT.replace('touch "$STATE.installed"', "exit 100"))
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    llvm.fetch_llvm()
    assert llvm.find_llvm().path.is_relative_to(tools / "cache")


def test_a_user_never_asks_to_install(tools: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    llvm.fetch_llvm()
    assert [line for line in asked(tools, "install") if "-s" not in line.split()] == []
    assert asked(tools, "download") != []


def test_a_cache_that_cannot_be_written_is_one_sentence(tools: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PHIBENCH_CACHE", str(put(tools / "file", "")))
    with pytest.raises(LlvmError, match="set PHIBENCH_CACHE") as caught:
        llvm.unpack(llvm_library.llvm_cache_folder())
    assert one_sentence(caught.value)


@pytest.mark.slow
@pytest.mark.skipif(not llvm.is_offered(), reason="fetching is for machines with apt-get; others install by hand")
def test_a_real_fetch_without_root_is_found_and_proven(machine: Path) -> None:
    try:
        tree = llvm.unpack(llvm_library.llvm_cache_folder())
    except llvm.AptError as error:
        if "resolve" in str(error) or "onnect" in str(error):
            pytest.skip(f"no network: {error}")
        raise
    found = llvm.ensure_llvm(fetch=False)
    assert found.path.is_relative_to(tree)
    assert found.is_proven
    assert [path.name for path in llvm_library.llvm_cache_folder().iterdir()] == [tree.name]
    shutil.rmtree(tree)
