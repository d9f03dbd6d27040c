"""What a method may read: truth near it, folders around the data set, places that are hidden; what is said of it."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.districts import DISTRICTS, statements, tree
from helpers.landlock import FilePairs, landlock, needs_landlock, own_mounts
from helpers.listeners import as_nobody
from helpers.sandbox_pairs import GOOD, HEADER, SmallPairs, method_file

from phibench.benchmark.isolation import readable_files
from phibench.benchmark.isolation.isolation import Access, Isolation
from phibench.benchmark.isolation.method_references import resolve
from phibench.benchmark.isolation.readable_files import access_of, truth_near
from phibench.benchmark.isolation.run_limits import MethodError, RunLimits
from phibench.benchmark.isolation.runner import Harness, run_method
from phibench.datasets.store.schema import RECORDS_SO_FAR, SEALED_TRUTH, TruthFile, TruthFolder

ROOT = Path(__file__).resolve().parents[3]
LIMITS = RunLimits(seconds=60.0)  # the machine may do other things: no test here is about time


# -- what may be read ----------------------------------------------------------------------------------------------


def test_a_method_inside_the_data_set_is_refused(tmp_path: Path) -> None:
    inner = tmp_path / "data" / "mine"
    inner.mkdir(parents=True)
    method = method_file(inner, f"return {GOOD}")
    with pytest.raises(
        MethodError, match=r"the file of method 'my_phi:extract' lies in .*/data, which holds the truth"
    ):
        Harness([method], hidden=(tmp_path / "data",)).__enter__()
    elsewhere = tmp_path / "linked"
    elsewhere.symlink_to(inner)  # by another name, too
    with pytest.raises(MethodError, match="move it out"):
        access_of(resolve(f"{elsewhere}/my_phi.py:extract"), RunLimits(), (tmp_path / "data",))


@needs_landlock
def test_of_a_folder_around_the_data_set_the_rest_is_read(tmp_path: Path) -> None:
    data = tmp_path / "out" / "data"
    data.mkdir(parents=True)
    for file in (data / "truth.txt", tmp_path / "out" / "weights.txt", tmp_path / "beside.py"):
        file.write_text("WORD = 1")
    header = f"{HEADER}import os\nfrom pathlib import Path\nimport beside\nOUT = Path({str(tmp_path / 'out')!r})\n"
    body = f"""
assert (OUT / 'weights.txt').read_text() == 'WORD = 1'
try:
    print(open(OUT / 'data' / 'truth.txt').read())
except OSError:
    print('denied')
return {GOOD}
"""
    for allow in ((), (str(tmp_path),)):  # an ancestor that is allowed does not allow the data set
        pairs = FilePairs(1, folders=(data,))
        (outcome,) = run_method(method_file(tmp_path, body, header=header), pairs, RunLimits(60.0, allow=allow))
        assert (outcome.output, outcome.failure) == ("denied", "")


@pytest.mark.parametrize(("name", "words"), [("data/x", "lies in .*/data, which"), ("none", "no such file or folder")])
def test_what_may_not_be_allowed_is_refused(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / "data" / "x").mkdir(parents=True)
    method = resolve("red_centroid")
    with pytest.raises(MethodError, match=words) as caught:
        access_of(method, RunLimits(allow=(str(tmp_path / name),)), (tmp_path / "data",))
    assert str(caught.value).startswith("--allow ")


@needs_landlock
def test_hidden_places_have_neither_names_nor_times(tmp_path: Path) -> None:
    """Where mounts are a process's own. The name of a sample may hold its D, and times of access tell what is read."""
    if not own_mounts():
        pytest.skip("this system gives a process no mounts of its own: names can be guessed and times seen")
    for folder in ("data", "method"):
        (tmp_path / folder).mkdir()
    (tmp_path / "data" / "d2.180").write_text("truth")
    (tmp_path / "method" / "beside.txt").write_text("1")
    (tmp_path / "method" / "beside.txt").touch()
    os.utime(tmp_path / "method" / "beside.txt", (1.0, 2.0))  # a time of access that the next reader would change
    body = f"""
import os
from pathlib import Path
here, data = Path(__file__).parent, Path({str(tmp_path / "data")!r})
print((data / 'd2.180').exists(), os.access(data, os.W_OK))
print((here / 'beside.txt').read_text(), os.statvfs(here).f_flag & 1)
print(Path('mine').write_text('1'), os.statvfs('.').f_flag & 1)
return {GOOD}
"""
    pairs = FilePairs(1, folders=(tmp_path / "data",))
    (outcome,) = run_method(method_file(tmp_path / "method", body), pairs, LIMITS)
    assert outcome.output.splitlines() == ["False False", "1 1", "1 0"], outcome
    assert (tmp_path / "method" / "beside.txt").stat().st_atime == 1.0


ORDINARY = """
import ctypes, tempfile
ctypes.CDLL(None).prctl(4, 1, 0, 0, 0)  # /proc/self is its own again, as of a process that never was another user's
os.chdir(tempfile.mkdtemp())
print(_Kernel().own_mounts(Path.cwd(), [Path('/mnt')]))
for path in ('/', '.', '/dev/shm'):
    print(os.statvfs(path).f_flag & 1)
print(os.listdir('/mnt'))
Path('own').write_text('1')
os.remove('own')
os.chdir('/')
"""


@pytest.mark.skipif(getattr(os, "getuid", lambda: 1)() != 0, reason="only root can become another user")
def test_an_ordinary_user_gets_mounts_of_its_own_where_there_are_user_namespaces() -> None:
    """What root's mounts are to the tests above; some systems switch user namespaces off."""
    names = "from phibench.benchmark.isolation.isolation import _Kernel"
    imports = f"import ctypes, os, tempfile\nfrom pathlib import Path\n{names}"
    done = as_nobody(ORDINARY, imports=imports)
    if done.stdout.startswith("False"):
        pytest.skip("no user namespaces here")
    assert done.stdout.split("\n")[:5] == ["True", "1", "0", "0", "[]"], done.stderr


FAR = "a/b/c/d/e/f/g"


def test_truth_near_a_method_is_found(tmp_path: Path) -> None:
    """All of the store's own list, however deep; by itself each file of the second half."""
    for name in ("a/plain", FAR, *(f"whole/{kind.name}" for kind in TruthFolder), "single", "g"):
        (tmp_path / name).mkdir(parents=True, exist_ok=True)
    hidden = [*(f"whole/{kind.name}" for kind in TruthFolder), *(f"single/{kind}" for kind in TruthFile)]
    for name in (
        *(f"whole/{kind.name}/{kind}" for kind in TruthFolder),
        *(f"single/{kind}" for kind in TruthFile),
        *(
            "weights.parquet",
            "config.json",
            "a/seal_1.truth.json",
            "a/one.parquet",
            "a/b.so-far.parquet",
            f"{FAR}/frames.jsonl",
        ),
    ):
        (tmp_path / name).write_text("{}")
    (tmp_path / "a" / "one.json").write_text('{\n "kind": "phibench score"')
    (tmp_path / "config.parquet").write_text("not a score's: its JSON says nothing of one")
    found = {path.relative_to(tmp_path).as_posix() for path in truth_near(tmp_path)}
    single = {"a/seal_1.truth.json", "a/one.json", "a/one.parquet", "a/b.so-far.parquet", f"{FAR}/frames.jsonl"}
    assert found == {*single, *hidden}


def test_truth_in_a_folder_of_the_search_path_is_hidden(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A checkout in PYTHONPATH is readable, and the scores and sets that lie in it are not."""
    method = method_file(tmp_path, f"return {GOOD}")
    checkout = tmp_path.parent / f"{tmp_path.name}-checkout"
    (checkout / "out" / "set").mkdir(parents=True)
    for name in ("dataset.json", "a.so-far.parquet", "module.py"):
        (checkout / "out" / ("set" if name == "dataset.json" else ".") / name).write_text("{}")
    assert str(checkout / "out" / "set") not in access_of(resolve(method), RunLimits()).hidden
    monkeypatch.setenv("PYTHONPATH", str(checkout))
    hidden = access_of(resolve(method), RunLimits()).hidden
    assert {str(checkout / "out" / name) for name in ("set", "a.so-far.parquet")} <= set(hidden)
    assert str(checkout / "out" / "module.py") not in hidden


def test_a_method_beside_what_makes_a_folder_one_of_truth_is_refused(tmp_path: Path) -> None:
    for kind in TruthFolder:
        (tmp_path / kind.name).mkdir()
        (tmp_path / kind.name / kind).write_text("{}")
        method = method_file(tmp_path / kind.name, f"return {GOOD}")
        with pytest.raises(MethodError, match=rf"which holds the truth \({kind}\): move it out"):
            access_of(resolve(method), RunLimits())


def test_a_folder_with_too_much_to_look_through_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readable_files, "_MOST_ENTRIES", 5)
    for number in range(4):
        (tmp_path / str(number)).touch()
    assert truth_near(tmp_path) == []
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "one").touch()
    with pytest.raises(MethodError, match="more than 5 files, too many to look for the truth in: put the method into"):
        truth_near(tmp_path)


NAMES = re.compile(r"[\w.{}-]+\.(json|jsonl|parquet|csv|npz|npy)")
OPEN = {
    "submission.json": "answers of a method to a sealed dense set: no truth",
    "croissant.json": "says what a set holds, and hashes",
    "run.json": "time and workers",
    "log.jsonl": "time and causes of tasks",
    "request.json": "how frames were drawn",
    "seal.json": "public half of a sealed set",
    "dense_seal.json": "public half of a sealed dense set",
    "pairs.jsonl": "public pairs of a sealed set; an imported set and a frames set are hidden whole",
    "done.json": "key and hashes of a film",
    "light{:02d}.npz": "light of a film, which is hidden whole",
    "fetch.json": "state of a download",
    "MANIFEST.json": "names and hashes of archives",
    "direct_url.json": "an installer's",
    "published.csv": "table of the paper, shipped with this package",
    "{preset}-{name}.json": "a score: told by its content",
    "learned_sweep.npz": "weights of a built-in method, shipped with this package",
    "my_phi.json": "a score of the demo: told by its content",
}
"""Names that a method may read, and why."""


def test_every_file_that_is_written_is_on_the_list_or_open() -> None:
    """A new format has to be put into one of the two; the list is that of the store."""
    listed = {SEALED_TRUTH, RECORDS_SO_FAR, *map(str, TruthFolder), *map(str, TruthFile)}
    named = set()
    for file in sorted(path for folder in DISTRICTS for path in (ROOT / folder).rglob("*.py")):
        if "studies" in file.parts:
            continue
        for node in statements(tree(file)):
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                for one in ast.walk(node.value):
                    if isinstance(one, ast.Constant) and isinstance(one.value, str) and NAMES.fullmatch(one.value):
                        named.add(one.value)
    assert {"dataset.json", "frames.jsonl"} <= named
    assert named - listed - set(OPEN) == set()
    assert not set(OPEN) & listed


# -- what is said --------------------------------------------------------------------------------------------------

WITHOUT = """
import sys, os
from phibench.benchmark.isolation import isolation
{change}
result = isolation.isolate(isolation.Access())
print(result.complete, result.sentence())
"""


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("isolation._CREATE = 9999", "False not isolated: this kernel has no Landlock"),  # no such system call
        ("sys.platform = 'darwin'", "False not isolated: only Linux isolates a process"),
        (
            "import threading, time; threading.Thread(target=time.sleep, args=(9,), daemon=True).start()",
            "False not isolated: threads were started",
        ),
        ("isolation._RIGHTS = {1: 40}", "False not isolated: the kernel refused the rules"),  # unknown rights
    ],
)
def test_a_process_that_is_not_isolated_says_so(tmp_path: Path, change: str, words: str) -> None:
    text = WITHOUT.format(change=change)
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, cwd=tmp_path, input="")
    if landlock() or "Landlock" in words:
        assert done.stdout.startswith(words), done.stderr


@needs_landlock
def test_the_harness_says_that_a_method_is_isolated(tmp_path: Path) -> None:
    with Harness([method_file(tmp_path, f"return {GOOD}")], LIMITS) as harness:
        assert harness.isolations == [Isolation(True, True, True).sentence()]


@needs_landlock
def test_a_missing_right_is_told_with_what_helps(tmp_path: Path) -> None:
    (tmp_path / "method").mkdir()
    (tmp_path / "weights.txt").write_text("1")
    read = f"open({str(tmp_path / 'weights.txt')!r})"
    (outcome,) = run_method(method_file(tmp_path / "method", f"{read}\nreturn {GOOD}"), SmallPairs(1), LIMITS)
    assert outcome.message.endswith("--allow PATH lets it read more")
    late = method_file(tmp_path / "method", f"return {GOOD}", "late.py", f"{HEADER}{read}\n")
    with pytest.raises(MethodError, match=r"Permission denied: .*: --allow PATH lets it read more"):
        run_method(late, SmallPairs(1), LIMITS)


_WRAPPED = """
try:
    open({path!r})
except OSError as error:
    raise RuntimeError("no weights") from error
"""


@pytest.mark.slow
@needs_landlock
@pytest.mark.parametrize(
    ("body", "words", "reached"),
    [
        (_WRAPPED, "RuntimeError: no weights, because of PermissionError: [Errno 13] Permission denied", False),
        # as other languages' libraries say it
        ("raise RuntimeError('Load model from {path} failed:system error number 13')", "system error number 13", False),
        ("print('imread_({path}): can\\'t open/read file'); None.shape", "has no attribute 'shape'", False),
        ("raise RuntimeError('system error number 130')", "number 130", True),
        ("open('beside.txt')", "Path(__file__).with_name('...')", True),
    ],
)
def test_a_file_out_of_reach_is_told_however_a_library_says_it(
    tmp_path: Path, body: str, words: str, reached: bool
) -> None:
    (tmp_path / "method").mkdir()
    (tmp_path / "weights.txt").write_text("1")
    text = body.format(path=str(tmp_path / "weights.txt"))
    (outcome,) = run_method(method_file(tmp_path / "method", text), SmallPairs(1), LIMITS)
    assert outcome.failure == "error"
    assert words in outcome.message
    assert ("--allow PATH" not in outcome.message) == reached
    assert "my_phi.py, line " in outcome.message


def test_limits_go_into_the_record_without_paths(tmp_path: Path) -> None:
    document = RunLimits(fresh=True, allow=(str(tmp_path / "weights"),)).document()
    assert document["fresh"] is True
    assert document["allow"] == ["weights"]


def test_a_path_that_is_not_utf8_reaches_the_process() -> None:
    access = Access((os.fsdecode(b"/tmp/\xff"),), ("/data",), True)
    assert Access.of(access.text()) == access
