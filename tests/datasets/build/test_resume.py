"""Going on where a run ended: only what changed or was lost is made again, with the bytes of an undisturbed run."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers.folders import contents, done
from helpers.processes import SMALLEST, left_of, quiet, said

from phibench.datasets.build.dataset_build import claimed_folder
from phibench.datasets.build.journal import Entry, FolderHead, Journal
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.make import make
from phibench.datasets.read import open_finished
from phibench.datasets.store import schema
from phibench.datasets.store.folder_lock import only_run
from phibench.datasets.store.provenance import _tables, closure, code_behind
from phibench.datasets.store.temporary_folders import TEMPORARY_PREFIX

RUN = (
    "import sys\nfrom phibench.datasets.make import make\n"
    "if __name__ == '__main__':\n    make(sys.argv[1], sys.argv[2], workers=int(sys.argv[3]))"
)


@pytest.fixture
def copy(smallest_dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(smallest_dataset, tmp_path / "copy"))


def again(out: Path, *changes: tuple[str, str], replace: bool = False) -> list[str]:
    """Make with a changed recipe; the tasks that were done."""
    text = SMALLEST.read_text()
    for old, new in changes:
        assert text.count(old) == 1
        text = text.replace(old, new)
    recipe = out.parent / "changed.toml"
    recipe.write_text(text)
    (out / schema.LOG).write_text("")
    make(recipe, out, workers=1, console=quiet(), replace=replace)
    return done(out)


@pytest.mark.usefixtures("inline")
def test_bytes_do_not_depend_on_who_does_the_work(smallest_dataset: Path, tmp_path: Path) -> None:
    assert contents(make(SMALLEST, tmp_path / "out", workers=1, console=quiet())) == contents(smallest_dataset)


SAMPLES = ["sample half-hidden-h1.400", "sample seen-near-h0.500"]
SPOTS = ["spot half-hidden-h1.400", "spot seen-near-h0.500"]
BAKE = ["bake room"]
VIEWS = ["view h0.000", "view h0.500", "view h1.400"]


LOST = "that this run would delete or make again, they were made with another"
CHANGES = (
    ("seed = 0", "seed = 0  # a comment", [], ""),
    (
        "depth_m = 1.975",
        "depth_m = 1.975\ndiameter_m = 6e-3",
        [SAMPLES[1], SPOTS[1]],
        f"2 finished tasks (1 spot, 1 sample) {LOST} [targets];",
    ),
    (
        "bounces = 2",
        "bounces = 1",
        BAKE + SAMPLES + VIEWS,
        f"6 finished tasks (1 bake, 3 views, 2 samples) {LOST} [ambient];",
    ),
    ("cells_per_pixel = 2", "cells_per_pixel = 3", SAMPLES + VIEWS, "5 finished tasks (3 views, 2 samples)"),
    (
        "seed = 0",
        "seed = 8231",  # which may be a secret
        SAMPLES + VIEWS,
        f"5 finished tasks (3 views, 2 samples) {LOST} seed; give another folder, or add `--replace` to delete them",
    ),
    ("power_w = 64e-3", "power_w = 2e-3", SAMPLES + SPOTS, "4 finished tasks (2 spots, 2 samples)"),
    ("[0.5]", "[0.5, 1.4]", ["sample seen-near-h1.400", "spot seen-near-h1.400"], ""),
    (
        "[0.5",
        "[0.6",
        ["sample seen-near-h0.600", "spot seen-near-h0.600", "view h0.600"],
        f"3 finished tasks (1 spot, 1 view, 1 sample) {LOST} [experiments];",
    ),
)
"""Old text, new text, tasks that are made again, and what a run without --replace says would be lost."""


def allowed(copy: Path, lost: str, *changes: tuple[str, str]) -> list[str]:
    """Tasks that are done; where finished work would be lost, it is counted first, and nothing is touched."""
    if lost:
        before = contents(copy)
        with pytest.raises(DatasetError) as caught:
            again(copy, *changes)
        assert f"{copy} holds {lost}" in str(caught.value)
        assert [word for word in ("\n", "8231", "[dataset]") if word in str(caught.value)] == []
        assert contents(copy) == before
    return again(copy, *changes, replace=bool(lost))


@pytest.mark.slow
@pytest.mark.usefixtures("inline")
def test_only_what_changes_one_after_the_other_change_is_made_again(copy: Path) -> None:
    made = []
    for count, (_, _, expected, lost) in enumerate(CHANGES, 1):
        assert allowed(copy, lost, *((old, new) for old, new, *_ in CHANGES[:count])) == expected
        made += expected
    fresh = make(copy.parent / "changed.toml", copy.parent / "fresh", workers=1, console=quiet())
    assert contents(copy) == contents(fresh)  # also: nothing of what was removed is left
    assert set(made) >= {*BAKE, *SAMPLES, *SPOTS, *VIEWS}


@pytest.mark.slow
@pytest.mark.usefixtures("inline")
@pytest.mark.parametrize(("old", "new", "expected", "lost"), CHANGES)
def test_only_what_a_change_changes_is_made_again(
    copy: Path, old: str, new: str, expected: list[str], lost: str
) -> None:
    assert allowed(copy, lost, (old, new)) == expected
    fresh = make(copy.parent / "changed.toml", copy.parent / "fresh", workers=1, console=quiet())
    assert contents(copy) == contents(fresh)  # also: nothing of what was removed is left


@pytest.mark.usefixtures("inline")
def test_a_room_whose_lamps_go_out_loses_its_light_map(copy: Path) -> None:
    dark = ("[ambient]", '[room]\nname = "dark"\n\n[ambient]')
    assert "bake room" in again(copy, dark, replace=True)  # its line of rooms.jsonl, and no light
    assert not (copy / schema.light_map_file("room")).exists()
    assert open_finished(copy).rooms.info("room").lit is False
    assert schema.light_map_file("room") not in (copy / schema.CHECKSUMS).read_text()


@pytest.mark.usefixtures("inline")
def test_names_and_times_of_files_prove_nothing(copy: Path) -> None:
    spot = copy / schema.spot_file("seen-near-h0.500", "up")
    for when in (0.0, time.time() + 1e8):
        for path in copy.rglob("*"):
            os.utime(path, (when, when))
        assert again(copy) == []
    data = spot.read_bytes()
    spot.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    os.utime(spot, (0.0, 0.0))
    assert again(copy) == [SPOTS[1]]
    assert spot.read_bytes() == data


@pytest.mark.slow
@pytest.mark.usefixtures("inline")
@pytest.mark.parametrize("line", range(1, 9))
def test_a_damaged_line_of_the_journal_costs_its_task_only(copy: Path, smallest_dataset: Path, line: int) -> None:
    lines = (copy / schema.JOURNAL).read_bytes().splitlines(keepends=True)
    assert len(lines) == 9
    lines[line] = lines[line].replace(b'"', b"'", 1)
    (copy / schema.JOURNAL).write_bytes(b"".join(lines))
    assert len(again(copy)) == 1
    assert contents(copy) == contents(smallest_dataset)


def test_a_torn_last_line_is_as_if_it_were_not_there(tmp_path: Path) -> None:
    last = Entry("view b", "k", {schema.view_file("b", "truth"): "0"}, [1.5, None])
    with Journal(tmp_path) as journal:
        journal.begin(FolderHead("{}", ""), [])
        journal.add(Entry("view a", "k", {}))
        journal.add(last)
    whole = (tmp_path / schema.JOURNAL).read_bytes()
    start = whole.index(b"view b")
    for end in range(start, len(whole) - 1):
        (tmp_path / schema.JOURNAL).write_bytes(whole[:end])
        assert list(Journal(tmp_path).entries) == ["view a"]
    (tmp_path / schema.JOURNAL).write_bytes(whole)
    assert Journal(tmp_path).entries["view b"] == last


def test_a_line_with_another_number_is_damaged(tmp_path: Path) -> None:
    """Its form is right, and only the check sum tells: the result would enter the manifest."""
    with Journal(tmp_path) as journal:
        journal.begin(FolderHead("{}", ""), [])
        journal.add(Entry("view a", "k", {}))
        journal.add(Entry("view b", "k", {}, [1.5, None]))
    whole = (tmp_path / schema.JOURNAL).read_bytes()
    assert whole.count(b"[1.5, null]") == 1
    (tmp_path / schema.JOURNAL).write_bytes(whole.replace(b"[1.5, null]", b"[1.6, null]"))
    assert list(Journal(tmp_path).entries) == ["view a"]


def test_a_key_covers_the_code_behind_a_task_and_no_other() -> None:
    view, spot = closure("phibench.datasets.build.view_task"), closure("phibench.datasets.build.spot_task")
    assert {"phibench.render.room.ambient_layer", "phibench.scenes.camera", "phibench.datasets.store.layers"} <= view
    assert "phibench.render.optics.certificate" in spot - view
    assert "phibench.render.room.ambient_layer" in view - spot
    assert not {"phibench.datasets.make", "phibench.datasets.common.progress", "phibench.datasets.build.workers"} & (
        view | spot
    )
    # the sensor's numbers, which the noise budget takes from a table beside the code
    assert "phibench.render.sensor.settings" in view - spot
    assert [path.name for path in _tables("phibench.render.sensor.settings")] == ["settings_presets.toml"]
    assert code_behind("phibench.datasets.build.view_task") != code_behind("phibench.datasets.build.spot_task")


# Two runs into one folder, and runs that are killed.


def start(out: Path, workers: int = 2) -> "subprocess.Popen[str]":
    command = [sys.executable, "-c", RUN, str(SMALLEST), str(out), str(workers)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True, text=True)


def test_a_second_run_is_refused_and_a_killed_one_holds_nothing(tmp_path: Path) -> None:
    code = (
        "import sys, time\nfrom pathlib import Path\nfrom phibench.datasets.store.folder_lock import only_run\n"
        "with only_run(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(DatasetError, match=rf"another run \(process {holder.pid}\) is writing") as caught:
            make(SMALLEST, tmp_path, workers=1, console=quiet())
        assert "\n" not in str(caught.value)
        holder.kill()
    with only_run(tmp_path):
        pass


def test_what_a_run_leaves_that_is_killed_at_once_is_no_obstacle(tmp_path: Path) -> None:
    for name in (schema.LOCK, schema.WORKING, f"{TEMPORARY_PREFIX}probe", f"{TEMPORARY_PREFIX}abc.txt"):
        (tmp_path / name).write_bytes(b"")
    with claimed_folder(tmp_path, "smallest"):
        pass
    (tmp_path / "mine.txt").write_bytes(b"")
    with pytest.raises(DatasetError, match="holds no data set"), claimed_folder(tmp_path, "smallest"):
        pass


TASKS = 8  # of the smallest recipe; the first line of its journal is the head


def finished_lines(out: Path) -> int:
    journal = out / schema.JOURNAL
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


def kill_and_repeat(out: Path, kills: int, workers: int) -> int:
    """Kill runs after random numbers of their own tasks, then let one end; how many were killed before their end.

    Moments count tasks, not seconds: how long a run takes is the machine's affair.
    """
    moments, killed = random.Random(kills), 0
    for _ in range(kills):
        before = finished_lines(out)
        last = before + moments.randint(1, max(1, TASKS - before))
        with start(out, workers) as child:
            while finished_lines(out) < last and child.poll() is None:
                time.sleep(0.01)
            time.sleep(moments.uniform(0.0, 0.1))
            killed += child.poll() is None
            child.kill()  # the parent only: its workers must leave by themselves
            child.communicate(timeout=60)
        if finished_lines(out) > TASKS - 1:  # nothing is left to be killed: begin anew
            shutil.rmtree(out)
    with start(out, workers) as child:
        _, errors = child.communicate(timeout=300)
        assert child.returncode == 0, errors
    assert left_of(child.pid) == []
    return killed


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs /proc")
@pytest.mark.parametrize(("kills", "workers"), [(1, 1), pytest.param(24, 2, marks=pytest.mark.slow)])
def test_killed_runs_end_in_the_same_bytes(smallest_dataset: Path, tmp_path: Path, kills: int, workers: int) -> None:
    out = tmp_path / "out"
    killed = kill_and_repeat(out, kills, workers)
    assert killed >= max(1, kills // 2)  # the last tasks are short: a run may end within the tenth of a second
    assert contents(out) == contents(smallest_dataset)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_runs_killed_one_by_one_from_the_start_lose_nothing(smallest_dataset: Path, tmp_path: Path, seed: int) -> None:
    """Each kill, of the whole process group, meets a folder that was begun anew: early and late moments are met."""
    moments = random.Random(seed)
    for attempt in range(7):
        out = tmp_path / str(attempt)
        with start(out) as child:
            time.sleep(moments.uniform(3.0, 12.0))
            os.killpg(child.pid, signal.SIGKILL)
            child.communicate(timeout=60)
        make(SMALLEST, out, workers=2, console=(console := quiet()))
        assert contents(out) == contents(smallest_dataset), said(console)
