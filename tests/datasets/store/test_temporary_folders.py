"""What a killed process left is removed by the next one; what a running one uses, and what is not ours, stays."""

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from phibench.datasets.store.files import require_writable
from phibench.datasets.store.temporary_folders import OwnedFolder, remove_leftovers, remove_tree

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs flock")

FOLDERS = """
import sys, time
from pathlib import Path
from phibench.datasets.store.temporary_folders import OwnedFolder
beside = OwnedFolder("seal", Path(sys.argv[1]))
with OwnedFolder("method") as folder:
    (folder / "deep").mkdir()
    (folder / "deep" / "file").write_bytes(b"1")
    print("works", flush=True)
    time.sleep(60)
"""
FILE = """
import sys, time
from pathlib import Path
from phibench.datasets.store.files import write_atomic
def write(path):
    path.write_bytes(b"half")
    print("works", flush=True)
    time.sleep(60)
write_atomic(Path(sys.argv[1]) / "score.json", write)
"""


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The system's folder for temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr("tempfile.tempdir", None)
    return folder


@pytest.fixture(params=[FOLDERS, FILE], ids=["folders", "file"])
def running(request: pytest.FixtureRequest, temporary: Path) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", request.param, str(temporary)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "works\n"
        yield child
        child.kill()


def clean(folder: Path) -> None:
    """Do as the next run does."""
    with OwnedFolder("method"):
        require_writable(folder / "score.json")


def test_only_what_a_dead_process_left_is_removed(running: subprocess.Popen[str], temporary: Path) -> None:
    before = sorted(temporary.rglob("*"))
    assert len(before) in (1, 4)
    clean(temporary)
    assert sorted(temporary.rglob("*")) == before
    running.kill()  # with SIGKILL nothing is cleaned up
    running.wait()
    assert sorted(temporary.rglob("*")) == before
    clean(temporary)
    assert list(temporary.iterdir()) == []


def test_what_is_not_ours_stays(temporary: Path) -> None:
    """Folders that users call alike, links under our names, and what lies behind them.

    Versions up to 0.2 left "phibench-" and "phibench-method-" with eight letters and no lock: so are data sets called.
    """
    alike = ("phibench-smoke", "phibench-tutorial", "phibench-method-gaussian", "phibench-proof-abcd1234")
    for name in (*alike, "phibench-tmp-notes", "phibench-tmp-method-abcd12345"):
        (temporary / name).mkdir()
        (temporary / name / "mine").write_bytes(b"")
        os.utime(temporary / name, (0.0, 0.0))  # age does not make it ours
    (temporary / "behind").mkdir()
    (temporary / "phibench-tmp-method-abcd1234").symlink_to(temporary / "behind")
    os.mkfifo(temporary / "phibench-tmp-method-abcd5678")
    before = sorted(temporary.rglob("*"))
    clean(temporary)
    assert sorted(temporary.rglob("*")) == before


def test_a_folder_of_another_user_stays(temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    left = temporary / "phibench-tmp-method-abcd1234"
    left.mkdir()
    monkeypatch.setattr(os, "geteuid", lambda: left.stat().st_uid + 1)
    remove_leftovers(temporary)
    assert left.exists()
    monkeypatch.undo()
    remove_leftovers(temporary)
    assert not left.exists()


def test_many_that_come_together_each_keep_their_folder(temporary: Path) -> None:
    """A folder that is swept between its making and its locking is made again."""
    lost: list[Path] = []

    def come() -> None:
        for _ in range(50):
            with OwnedFolder("method", temporary) as folder:
                (folder / "file").write_bytes(b"1") if folder.is_dir() else lost.append(folder)

    threads = [threading.Thread(target=come) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert lost == []
    assert list(temporary.iterdir()) == []


def test_a_folder_that_got_another_name_stays(tmp_path: Path) -> None:
    with OwnedFolder("seal", tmp_path) as folder:
        (folder / "file").write_bytes(b"1")
        folder.replace(tmp_path / "public")
    assert [path.name for path in tmp_path.rglob("*")] == ["public", "file"]


def test_removing_a_folder_follows_no_link_and_needs_no_permission(tmp_path: Path) -> None:
    precious, folder = tmp_path / "precious", tmp_path / "folder"
    (folder / "closed" / "below").mkdir(parents=True)
    precious.mkdir()
    (precious / "file").touch()
    (folder / "link").symlink_to(precious)
    (folder / "closed" / "below" / "link").symlink_to(precious)
    os.mkfifo(folder / "pipe")
    (folder / "closed").chmod(0)
    inner = os.open(folder, os.O_RDONLY)
    for _ in range(1500):  # deeper than Python recurses and than a path may be long
        os.mkdir("deep", dir_fd=inner)
        outer, inner = inner, os.open("deep", os.O_RDONLY, dir_fd=inner)
        os.close(outer)
    os.close(inner)
    remove_tree(folder)
    assert not folder.exists()
    assert (precious / "file").exists()
    remove_tree(folder)  # gone already
    folder.symlink_to(precious)
    remove_tree(folder)
    assert (precious / "file").exists()
