"""Two runs that start together, and a folder that goes away while a run writes to it."""

import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.processes import SMALLEST, quiet

from phibench.datasets import make
from phibench.datasets.build import sample_task
from phibench.datasets.build.journal import FolderHead, Journal
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.recipe.load import load_recipe
from phibench.datasets.store import checksums, folder_lock, schema
from phibench.datasets.store.folder_lock import only_run


def test_of_two_runs_that_start_together_one_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A short form of `tests/attack/test_starts.py`, by threads: who is refused must not disturb who is not."""
    plan, rounds, outcomes = make_plan(load_recipe(SMALLEST)), 15, [[""] * 15, [""] * 15]
    start = threading.Barrier(2)
    monkeypatch.setattr(folder_lock, "_AT_ONCE_S", 0.02)

    def one(me: int) -> None:
        for number in range(rounds):
            start.wait(30.0)
            try:
                make.make_from_plan(plan, "", tmp_path / str(number), 1, quiet())
            except DatasetError as error:
                outcomes[me][number] = str(error)

    def hold(_plan: Any, _recipe: str, out: Path, *_: object) -> list[str]:
        me = int(threading.current_thread().name)
        outcomes[me][int(out.name)] = "won"
        while not outcomes[1 - me][int(out.name)]:
            pass
        return []

    monkeypatch.setattr(make, "_make", hold)
    threads = [threading.Thread(target=one, args=(me,), name=str(me)) for me in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    for number, pair in enumerate(zip(*outcomes, strict=True)):
        refused = f"another run (process {os.getpid()}) is writing to {tmp_path / str(number)}; wait until it has ended"
        assert sorted(pair) == sorted(["won", refused])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (f"{os.getpid()} {os.uname().nodename}", f" (process {os.getpid()})"),
        ("123 elsewhere", " (process 123 on elsewhere)"),
        (f"{2**22 + 1} {os.uname().nodename}", ""),  # larger than any number that Linux gives
        ("9" * 40, ""),
        ("", ""),
        ("-1 ", ""),
    ],
    ids=("this process", "elsewhere", "too large", "far too large", "empty", "negative"),  # the same in every process
)
def test_a_lock_that_does_not_tell_its_holder_is_no_wrong_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, told: str
) -> None:
    monkeypatch.setattr(folder_lock, "_NAMED_S", 0.06)
    with only_run(tmp_path):
        (tmp_path / schema.LOCK).write_text(text)
        with pytest.raises(DatasetError, match="another run") as caught, only_run(tmp_path):
            pass
    assert str(caught.value) == f"another run{told} is writing to {tmp_path}; wait until it has ended"


# A folder that goes away.


def refusal(out: Path) -> str:
    with pytest.raises(DatasetError) as caught:
        make.make(SMALLEST, out, workers=1, console=quiet())
    assert "\n" not in str(caught.value)
    assert not (out / schema.CHECKSUMS).exists()
    return str(caught.value)


def move(out: Path) -> None:
    out.rename(out.with_name("moved"))


def replace(out: Path) -> None:
    """A folder that was begun anew stands in its place."""
    move(out)
    out.mkdir()
    Journal(out).begin(FolderHead("{}", ""), [])


@pytest.mark.usefixtures("inline")
@pytest.mark.parametrize("away", [shutil.rmtree, move, replace])
def test_a_folder_that_goes_while_tasks_run_ends_the_run(
    smallest_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, away: Callable[[Path], None]
) -> None:
    out, save = Path(shutil.copytree(smallest_dataset, tmp_path / "out")), sample_task.save_png
    shutil.rmtree(out / "previews")

    def gone(path: Path, picture: Any) -> None:
        monkeypatch.setattr(sample_task, "save_png", save)
        away(out)
        save(path, picture)

    monkeypatch.setattr(sample_task, "save_png", gone)
    assert "was removed or moved while this run wrote to it" in refusal(out)


@pytest.mark.usefixtures("inline")
@pytest.mark.parametrize("away", [shutil.rmtree, lambda out: (out / schema.view_file("h0.500", "truth")).unlink()])
@pytest.mark.parametrize("moment", ["before the documents", "before the sums", "after the sums"])
def test_the_last_step_looks_for_every_file(
    smallest_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, away: Callable[[Path], None], moment: str
) -> None:
    """A finished folder, of which one document is to be written anew, loses files at the latest moments."""
    out = Path(shutil.copytree(smallest_dataset, tmp_path / "out"))
    (out / schema.TABLE).unlink()
    last = {"before the documents": schema.TABLE, "before the sums": schema.TABLE, "after the sums": schema.CHECKSUMS}
    write = checksums.write_bytes

    def writing(path: Path, data: bytes) -> Path:
        if path.name != last[moment]:
            return write(path, data)
        if moment == "before the documents":
            away(out)
        write(path, data)
        if moment != "before the documents":
            away(out)
        return path

    monkeypatch.setattr(checksums, "write_bytes", writing)
    text = refusal(out)
    assert " files are gone from " in text
    assert "run the same command again" in text
