"""Nothing half-written ever stands under a final name."""

import contextlib
import errno
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.store import files, folder_lock, schema
from phibench.datasets.store.files import (
    remove_temporary,
    require_writable,
    sha256,
    write_atomic,
    write_bytes,
    write_text,
)
from phibench.datasets.store.folder_lock import only_run, working
from phibench.datasets.store.layers import write_exr
from phibench.datasets.store.temporary_folders import TEMPORARY_PREFIX, folder_for_work


def test_bytes_text_and_hash(tmp_path: Path) -> None:
    path = write_text(tmp_path / "deep" / "er" / "a.txt", "é\n")
    assert path.read_bytes() == b"\xc3\xa9\n"
    assert sha256(write_bytes(path, b"abc")) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert [p.name for p in path.parent.iterdir()] == ["a.txt"]


@pytest.mark.parametrize("stop", [DatasetError("no"), KeyboardInterrupt()])
def test_refused_work_leaves_no_empty_folder(tmp_path: Path, stop: BaseException) -> None:
    """Folders that were there stay, and so does one that holds anything; a passing file goes with a refusal alone."""
    (tmp_path / "old").mkdir()
    for name in ("new", "old"):
        with pytest.raises(type(stop)), folder_for_work(tmp_path / name / "a" / "b"):
            raise stop
    assert [path.name for path in tmp_path.rglob("*")] == ["old"]
    for top, names in (("new", ["draws"]), ("full", ["draws", "work"])):
        with contextlib.suppress(type(stop)), folder_for_work(tmp_path / top / "a" / "b", ("draws",)) as folder:
            for name in names:
                (folder / name).touch()
            raise stop
    assert (tmp_path / "new").exists() == isinstance(stop, KeyboardInterrupt)
    assert sorted(path.name for path in (tmp_path / "full" / "a" / "b").iterdir()) == ["draws", "work"]


def test_asking_whether_a_file_can_be_written_makes_nothing(tmp_path: Path) -> None:
    require_writable(tmp_path / "a" / "b" / "c.json")
    (tmp_path / "file").touch()
    for bad, reason in (("file/b/c.json", "Not a directory"), (f"{'x' * 300}/c.json", "File name too long")):
        with pytest.raises(DatasetError, match=f"cannot be written: {reason}"):
            require_writable(tmp_path / bad)
    assert [path.name for path in tmp_path.rglob("*")] == ["file"]


def test_permissions_are_those_of_an_ordinary_file(tmp_path: Path) -> None:
    (tmp_path / "plain").write_bytes(b"")
    made = write_bytes(tmp_path / "made", b"")
    assert made.stat().st_mode == (tmp_path / "plain").stat().st_mode


def full_disk(*_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def interrupted(*_: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("stop", [full_disk, interrupted])
@pytest.mark.parametrize("place", ["write", "fsync", "replace"])
def test_any_failure_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: Callable[..., None], place: str
) -> None:
    path = write_bytes(tmp_path / "a", b"old")
    if place == "fsync":
        monkeypatch.setattr(files.os, "fsync", stop)
    elif place == "replace":
        monkeypatch.setattr(Path, "replace", stop)

    def write(temporary: Path) -> None:
        temporary.write_bytes(b"new, and only a pa")
        if place == "write":
            stop()

    with pytest.raises((OSError, KeyboardInterrupt)):
        write_atomic(path, write)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


@pytest.mark.skipif(sys.platform == "win32", reason="needs resource limits")
def test_a_full_disk_while_an_exr_is_written(tmp_path: Path) -> None:
    """A limit on the file size makes write(2) fail half-way, as a full disk does, without being root."""
    code = (
        "import resource, sys, numpy\nfrom pathlib import Path\nfrom phibench.datasets.store.layers import write_exr\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))\n"
        "write_exr(Path(sys.argv[1]), {'A': numpy.random.default_rng(0).random((200, 200))}, {})"
    )
    old = write_exr(tmp_path / "a.exr", {"A": np.zeros((2, 2))}, {}).read_bytes()
    child = subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.exr")], capture_output=True, text=True)
    last = child.stderr.splitlines()[-1]
    assert f"WriteError: could not write {tmp_path / 'a.exr'}: File too large; free some space" in last
    assert TEMPORARY_PREFIX not in last
    assert (tmp_path / "a.exr").read_bytes() == old
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_control_c_in_a_real_process(tmp_path: Path) -> None:
    code = (
        # children of a shell's background job ignore SIGINT
        "import signal, sys, time\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from pathlib import Path\nfrom phibench.datasets.store.files import write_atomic\n"
        "def write(path):\n    path.write_bytes(b'half')\n    print('writing', flush=True)\n    time.sleep(60)\n"
        "write_atomic(Path(sys.argv[1]), write)"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "a")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "writing\n"
        assert len(list(tmp_path.iterdir())) == 1
        child.send_signal(signal.SIGINT)
        _, errors = child.communicate(timeout=30)
    assert "KeyboardInterrupt" in errors
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_run_left_is_removed(tmp_path: Path) -> None:
    keep = write_bytes(tmp_path / "x" / "keep", b"")
    left = tmp_path / "x" / f"{TEMPORARY_PREFIX}abc.exr"
    left.write_bytes(b"")
    remove_temporary(tmp_path)
    assert keep.exists()
    assert not left.exists()


@pytest.mark.parametrize(
    ("code", "advice"), [(errno.ENOSPC, "free some space"), (errno.EACCES, "may write"), (errno.EIO, "another path")]
)
def test_a_write_error_names_the_target_the_reason_and_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, advice: str
) -> None:
    def fails(*_: object) -> None:
        raise OSError(code, os.strerror(code), "a-temporary-name")

    monkeypatch.setattr(files.os, "fsync", fails)
    with pytest.raises(files.WriteError) as caught:
        write_bytes(tmp_path / "a.json", b"")
    text = str(caught.value)
    assert [word for word in (str(tmp_path / "a.json"), os.strerror(code), advice) if word not in text] == []
    assert "temporary-name" not in text
    assert TEMPORARY_PREFIX not in text


def test_a_folder_that_is_a_file_is_a_write_error(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"")
    with pytest.raises(files.WriteError, match=r"could not write .*a/b/c\.txt"):
        write_bytes(tmp_path / "a" / "b" / "c.txt", b"")


HOLD = (
    "import sys, time\nfrom pathlib import Path\nfrom phibench.datasets.store.folder_lock import working\n"
    "with working(Path(sys.argv[1])):\n    print('works', flush=True)\n    time.sleep(60)"
)


def test_locks_leave_nothing_behind(tmp_path: Path) -> None:
    with only_run(tmp_path), working(tmp_path), working(tmp_path):
        assert len(list(tmp_path.iterdir())) == 3
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ZeroDivisionError), only_run(tmp_path), working(tmp_path):
        1 / 0  # noqa: B018
    assert list(tmp_path.iterdir()) == []
    (tmp_path / schema.WORKING).write_bytes(b"")  # of a version before 0.2
    with only_run(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_new_run_waits_for_the_workers_of_a_killed_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folder_lock, "PATIENCE_S", 0.2)
    with subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True) as worker:
        assert worker.stdout is not None
        assert worker.stdout.readline() == "works\n"
        with pytest.raises(DatasetError, match="workers of an earlier run are still writing"), only_run(tmp_path):
            pass
        assert len(list(tmp_path.iterdir())) == 1
        worker.kill()
    assert len(list(tmp_path.iterdir())) == 1  # killed: nobody removed it
    with only_run(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_one_of_many_that_come_together_gets_the_lock(tmp_path: Path) -> None:
    """The holder removes the file when it leaves: a lock on the removed file must not count."""
    inside, most = [], []

    def come() -> None:
        for _ in range(200):
            with contextlib.suppress(DatasetError), only_run(tmp_path):
                inside.append(1)
                most.append(len(inside))
                time.sleep(1e-5)
                inside.pop()

    threads = [threading.Thread(target=come) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(most) >= 20
    assert max(most) == 1
    assert list(tmp_path.iterdir()) == []
