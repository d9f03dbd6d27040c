"""Making data sets: complete, repeatable to the byte, and nothing lost when something goes wrong."""

import errno
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections import namedtuple
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers.inline_workers import make_inline
from helpers.processes import SMALLEST, left_of, quiet, said, wait_until
from rich.console import Console

from phibench.datasets import make
from phibench.datasets.build import dataset_build, spot_task
from phibench.datasets.build.dataset_build import plan_tasks
from phibench.datasets.build.forecast import forecast
from phibench.datasets.common import progress
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.common.progress import Steps
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.recipe.load import load_recipe
from phibench.datasets.rooms.room_sources import room_of
from phibench.datasets.store import checksums, schema
from phibench.datasets.store.checksums import damaged_files, data_files, read_checksums
from phibench.datasets.store.layers import read_exr
from phibench.datasets.store.metadata import read_manifest
from phibench.datasets.store.schema import ManifestRow
from phibench.datasets.store.temporary_folders import TEMPORARY_PREFIX
from phibench.render.optics.certificate import Certificate, certify
from phibench.render.setup.variant import asked_variant
from phibench.scenes.laser import LaserSpot

Usage = namedtuple("Usage", "total used free")


def test_everything_is_there(smallest_dataset: Path) -> None:
    plan = make_plan(load_recipe(SMALLEST))
    views = {schema.view_file(p.pose_id, name) for p in plan.poses for name in ("ambient", "truth", "preview")}
    spots = {schema.spot_file(pair.sample_id, position) for pair in plan.pairs for position in ("down", "up")}
    spots.remove("spots/half-hidden-h1.400-down.exr")  # a crate hides it
    previews = {schema.preview_file(pair.sample_id) for pair in plan.pairs}
    single = {
        schema.INFO,
        schema.MANIFEST,
        schema.TABLE,
        schema.RECIPE,
        schema.RIGS,
        schema.ROOMS,
        schema.CROISSANT,
        schema.light_map_file("room"),
    }
    listed = set(read_checksums(smallest_dataset))
    assert listed == views | spots | previews | single == set(data_files(smallest_dataset))
    assert damaged_files(smallest_dataset) == []
    assert (smallest_dataset / schema.RECIPE).read_bytes() == SMALLEST.read_bytes()


def test_the_sums_are_those_of_sha256sum(smallest_dataset: Path) -> None:
    child = subprocess.run(["sha256sum", "--quiet", "-c", schema.CHECKSUMS], cwd=smallest_dataset, capture_output=True)
    assert child.returncode == 0, child.stdout


def test_the_info_says_what_made_it(smallest_dataset: Path) -> None:
    info = json.loads((smallest_dataset / schema.INFO).read_text())
    provenance = info["provenance"]
    assert provenance["variant"] == asked_variant()
    assert int(provenance["llvm"].split(".")[0]) >= 17
    assert provenance["threads_per_process"] == 1
    assert provenance["packages"]["mitsuba"]
    assert len(provenance["code_sha256"]) == 64
    assert json.loads((smallest_dataset / schema.RUN).read_text())["seconds"] > 0.0


def test_two_runs_are_byte_identical_whatever_the_number_of_workers(smallest_dataset: Path, tmp_path: Path) -> None:
    again = make.make(SMALLEST, tmp_path / "again", workers=2, console=quiet())
    entries = [json.loads(line) for line in (again / schema.LOG).read_text().splitlines()]
    assert len({entry["worker"] for entry in entries}) == 2
    assert (again / schema.CHECKSUMS).read_text() == (smallest_dataset / schema.CHECKSUMS).read_text()
    assert len(read_checksums(again)) >= 15
    # The comparison can fail: another seed gives other ambient light and the same truth.
    text = SMALLEST.read_text().replace("seed = 0", "seed = 1")
    (tmp_path / "other.toml").write_text(text)
    other = make_inline(tmp_path / "other.toml", tmp_path / "other")
    changed = {name for name, digest in read_checksums(other).items() if digest != read_checksums(again)[name]}
    assert schema.view_file("h0.000", "ambient") in changed
    assert schema.view_file("h0.000", "truth") not in changed
    assert [_without_noise(row) for row in read_manifest(other)] == [
        _without_noise(row) for row in read_manifest(again)
    ]


def _without_noise(row: ManifestRow) -> dict[str, object]:
    return row.model_dump(exclude={"down": {"noise"}, "up": {"noise"}})


@pytest.mark.usefixtures("inline")
def test_a_finished_data_set_is_left_alone_and_a_damaged_one_made_again(smallest_dataset: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(smallest_dataset, tmp_path / "copy"))
    console = quiet()
    (copy / "scores.json").write_text("{}")  # somebody's file is no reason to start over
    make.make(SMALLEST, copy, workers=1, console=console)
    assert "nothing to do" in said(console)
    (copy / schema.MANIFEST).unlink()
    (copy / schema.view_file("h0.500", "truth")).write_bytes(b"")
    (copy / f"{TEMPORARY_PREFIX}left.exr").write_bytes(b"")
    console = quiet()
    make.make(SMALLEST, copy, workers=2, console=console)
    assert "to make: 1 view; about 0.2 MB" in said(console)
    assert "7 of 8 tasks are done" in said(console)
    assert "tasks: 1/1" in said(console)
    assert (copy / schema.CHECKSUMS).read_text() == (smallest_dataset / schema.CHECKSUMS).read_text()
    assert list(copy.rglob(TEMPORARY_PREFIX + "*")) == []


# Refusals: one sentence, before anything is rendered.


def refusal(out: Path, recipe: Path = SMALLEST, workers: int | None = 1) -> str:
    with pytest.raises(DatasetError) as caught:
        make.make(recipe, out, workers=workers, console=quiet())
    return str(caught.value)


def test_a_folder_with_other_things_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("x")
    assert "not empty and holds no data set" in refusal(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    assert "is a file" in refusal(tmp_path / "thesis.tex")


def test_a_folder_with_another_data_set_is_refused(smallest_dataset: Path) -> None:
    before = (smallest_dataset / schema.CHECKSUMS).read_text()
    text = refusal(smallest_dataset, Path("smoke"))
    assert "holds 8 finished tasks of another data set ('smallest')" in text
    assert "--replace" in text
    assert (smallest_dataset / schema.CHECKSUMS).read_text() == before
    assert damaged_files(smallest_dataset) == []


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def denied(*_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(checksums, "write_bytes", denied)
    text = refusal(tmp_path / "out")
    assert "Permission denied" in text
    assert "\n" not in text


@pytest.mark.usefixtures("inline")
def test_no_room_on_the_disk_is_refused_with_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset_build.shutil, "disk_usage", lambda _: Usage(10**9, 10**9 - 200_000, 200_000))
    text = refusal(tmp_path / "out")
    assert "about 0.8 MB are needed and 0.2 MB are free" in text


def test_no_workers_is_refused(tmp_path: Path) -> None:
    assert "workers = 0" in refusal(tmp_path / "out", workers=0)


def test_the_estimate_of_the_size_is_honest(smallest_dataset: Path, smoke_dataset: Path) -> None:
    for folder, recipe in ((smallest_dataset, SMALLEST), (smoke_dataset, Path("smoke"))):
        size = sum((folder / name).stat().st_size for name in data_files(folder))
        plan = make_plan(load_recipe(recipe))
        assert 1.0 <= forecast(plan, plan_tasks(plan, {}).values()).size / size < 1.5


@pytest.mark.usefixtures("inline")
def test_a_sample_out_of_tolerance_is_refused_with_its_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def off_by_a_hundredth(*arguments: Any) -> Certificate:
        return replace(certify(*arguments), chief_difference_px=0.01, passed=False)

    monkeypatch.setattr(spot_task, "certify", off_by_a_hundredth)
    text = refusal(tmp_path / "out")
    cause = "is refused: a certificate is out of tolerance (down: chief ray 0.01 px (tolerance 1e-06)"
    assert f"  seen-near-h0.500 {cause}" in text
    assert "2 of 2 samples are refused" in text
    assert not (tmp_path / "out" / schema.CHECKSUMS).exists()
    assert not (tmp_path / "out" / schema.MANIFEST).exists()


def test_a_spot_that_no_mirror_point_reflects_is_flagged() -> None:
    plan = make_plan(load_recipe(SMALLEST))
    above = LaserSpot((0.0, 0.0, 2.5), (0.0, 0.0, -1.0), 3e-3)
    answer = spot_task.answer_spot(plan.rig.at(0.0), above, room_of(plan.rooms["room"]))
    assert answer.truth.cause == "no_reflection"
    assert answer.certificate is None
    assert not answer.on_image


@pytest.mark.usefixtures("inline")
def test_a_full_disk_in_the_middle_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(dataset_build, "write_documents", full)
    assert "No space left on device" in refusal(tmp_path / "out")
    assert complete_but_unfinished(tmp_path / "out") == 3 + 6


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs /proc")
def test_control_c_in_the_middle_loses_nothing(tmp_path: Path) -> None:
    """SIGINT to the whole process group, as a terminal does, while two workers render."""
    recipe, out = tmp_path / "slow.toml", tmp_path / "out"
    recipe.write_text(SMALLEST.read_text().replace("cells_per_pixel = 2", "cells_per_pixel = 32"))
    code = (
        "import sys\nfrom phibench.datasets.make import make\n"
        "if __name__ == '__main__':\n    make(sys.argv[1], sys.argv[2], workers=2)"
    )
    command = [sys.executable, "-c", code, str(recipe), str(out)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True, text=True) as child:
        wait_until(lambda: any(path.name[0] != "." for path in out.rglob("*.exr")), "a layer")
        os.killpg(child.pid, signal.SIGINT)
        _, errors = child.communicate(timeout=60)
    assert errors.count("KeyboardInterrupt") == 1  # the parent's, and none of a worker
    assert left_of(child.pid) == []
    assert complete_but_unfinished(out) >= 1


def complete_but_unfinished(out: Path) -> int:
    """What is there is whole, no temporary file is left, the folder does not pass for finished. Number of layers."""
    assert not (out / schema.CHECKSUMS).exists()
    assert [path.name for path in out.rglob(TEMPORARY_PREFIX + "*")] == []
    layers = list(out.rglob("*.exr"))
    for path in layers:
        read_exr(path)
    return len(layers)


# Before and while it runs.


@pytest.fixture
def now_s(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Clock of the progress; how long this machine takes for anything does not count."""
    now = [0.0]
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


def test_progress_without_a_terminal_is_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch, now_s: list[float]
) -> None:
    monkeypatch.setattr(progress, "LINE_EVERY_S", 0.01)
    console = quiet()
    with Steps(console, "views", 3, running=lambda: "view h0.500 (1 s)") as steps:
        wait_until(lambda: said(console), "a line while nothing ends")
        assert said(console).startswith("views: 0/3 after 0 s, running: view h0.500")
        for k in range(1, 4):
            now_s[0] += 0.45
            steps.advance()
            wait_until(lambda k=k: f"views: {k}/3 after" in said(console), "a line")
    lines = said(console).splitlines()
    assert any(line.startswith("views: 1/3 after 0 s, about 1 s left, running: view") for line in lines)
    assert lines[-1] == "views: 3/3 after 1 s"


def test_progress_on_a_terminal_goes_by_time_and_says_what_runs(
    monkeypatch: pytest.MonkeyPatch, now_s: list[float]
) -> None:
    """One of ten steps takes nine tenths of the time: half of the time later the bar is at its middle, not at 1/10."""
    monkeypatch.setattr(progress, "_BAR_EVERY_S", 0.02)
    console = Console(file=io.StringIO(), width=80, force_terminal=True, color_system=None, legacy_windows=False)
    with Steps(console, "tasks", 10, lambda: max(1.0 - now_s[0], 0.01), lambda: "bake room (60 s)" * 9):
        now_s[0] = 0.5
        wait_until(lambda: "s left, bake room" in said(console), "a word on what runs")
    lines = [line for line in re.split(r"[\r\n]|\x1b\[[\d?;]*[a-zA-Z]", said(console)) if line.startswith("tasks")]
    assert max(map(len, lines)) <= 80
    last = lines[-1]
    assert "0/10" in last
    assert "s left, bake room (60 s)" in last
    bar = re.sub("[^━╸╺]", "", last)
    assert 7 <= len(bar.rstrip("╺")) <= 9  # of 16


def test_stages_are_told_on_a_terminal_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "_BAR_EVERY_S", 0.02)
    console = Console(file=io.StringIO(), width=80, force_terminal=True, color_system=None, legacy_windows=False)
    with progress.stages(console, "measure") as told:
        told("fitting the spots")
        wait_until(lambda: "fitting the spots" in said(console), "the stage")
    with progress.stages(silent := quiet(), "measure") as told:
        told("fitting the spots")
    assert said(silent) == ""


@pytest.mark.usefixtures("inline")
def test_a_long_bake_is_not_silent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    console = quiet()

    def slow(*_: object) -> None:
        wait_until(lambda: "running: bake room" in said(console), "a line")
        raise DatasetError("that is all")

    monkeypatch.setattr(progress, "LINE_EVERY_S", 0.05)
    monkeypatch.setattr("phibench.datasets.build.bake_task.light_map", slow)
    with pytest.raises(DatasetError, match="that is all"):
        make.make(SMALLEST, tmp_path / "out", workers=1, console=console)
    assert re.search(r"s left, running: bake room \(\d+ s\)", said(console))


def test_a_single_long_step_is_announced() -> None:
    console = quiet()
    with Steps(console, "panorama", 1, announce=True) as steps:
        assert said(console) == "panorama: 0/1 after 0 s\n"
        steps.advance()
    assert said(console).splitlines()[-1].startswith("panorama: 1/1 after ")


@pytest.mark.slow
def test_the_preview_says_what_the_data_set_will_be(smallest_dataset: Path, tmp_path: Path) -> None:
    rows, text = read_manifest(smallest_dataset), make.dry_run(SMALLEST, tmp_path / "out", workers=2)
    assert list(tmp_path.iterdir()) == []
    lines = {line.split()[0]: line for line in text.splitlines()}
    hidden = 0
    for row in rows:
        for spot in (row.down, row.up):
            place = f"{spot.u_px:.1f}, {spot.v_px:.1f}" if spot.visible else spot.cause
            assert f"  {place}" in lines[row.sample_id]
            hidden += not spot.visible
        assert f" {row.depth_m:.3f} " in lines[row.sample_id]
    assert hidden == 1
    assert "1 of 2 pairs will be visible" in text
    assert re.search(
        r"to make: 2 spots, 1 bake of the room's light \((cached|under 1 s|\d+ s)\), 3 views, 2 samples; about", text
    )
    assert "a first guess" in text
    console = quiet()
    make.make(SMALLEST, shutil.copytree(smallest_dataset, tmp_path / "copy"), console=console)
    assert "1 of 2 pairs will not be visible in both images, such as half-hidden-h1.400 (down occluded" in said(console)


def test_the_preview_says_what_to_do_about_a_spot_that_a_rim_hides(tmp_path: Path) -> None:
    """The board that the rim hides is 0.8 m over a mirror that shows 3 degrees above the horizon."""
    text = SMALLEST.read_text().replace("[laser]", '[rig.mirror]\nshape = "hyperboloid"\n\n[laser]')
    recipe = tmp_path / "hyperboloid.toml"
    for height, lines in (("1.50", 1), ("0.50", 0)):
        recipe.write_text(
            text.replace("azimuth_deg = 100.0\nheight_m = 0.50", f"azimuth_deg = 100.0\nheight_m = {height}")
        )
        told = make.dry_run(recipe, tmp_path / "data")
        assert told.count("of seen-near-h0.500: the mirror ends at its rim") == lines
    recipe.write_text(text.replace("hyperboloid", "cone"))
    assert "a cone of 45 degrees shows nothing less than 90 degrees from straight down" in make.dry_run(
        recipe, tmp_path / "data"
    )


@pytest.mark.usefixtures("inline")
def test_the_preview_of_a_folder_with_a_data_set(smallest_dataset: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(smallest_dataset, tmp_path / "copy"))
    before = sorted((path, path.stat().st_mtime_ns) for path in copy.rglob("*"))
    assert "to make: nothing, 8 tasks in all" in make.dry_run(SMALLEST, copy)
    told = make.dry_run(_changed(tmp_path, "[0.5]", "[0.6]"), copy)
    assert "to make: 1 spot, 1 view, 1 sample;" in told
    assert f"will be refused: {copy} holds 3 finished tasks (1 spot, 1 view, 1 sample) that" in told
    assert "will be refused" not in make.dry_run(tmp_path / "changed.toml", copy, replace=True)
    assert sorted((path, path.stat().st_mtime_ns) for path in copy.rglob("*")) == before
    with pytest.raises(DatasetError, match="of another data set"):
        make.dry_run("smoke", copy)


def _changed(folder: Path, old: str, new: str) -> Path:
    text = SMALLEST.read_text()
    assert old in text
    (folder / "changed.toml").write_text(text.replace(old, new))
    return folder / "changed.toml"


@pytest.mark.slow
@pytest.mark.usefixtures("inline")
def test_without_mitsuba_frames_may_change_and_nothing_may_be_rendered(smallest_dataset: Path, tmp_path: Path) -> None:
    copy, blocked = Path(shutil.copytree(smallest_dataset, tmp_path / "copy")), tmp_path / "blocked"
    for name in ("mitsuba", "drjit"):
        (blocked / name).mkdir(parents=True)
        (blocked / name / "__init__.py").write_text(f"raise ModuleNotFoundError('none', name='{name}')")
    path = os.pathsep.join([str(blocked), os.environ.get("PYTHONPATH", "")])

    def run(recipe: Path, out: Path, replace: str = "") -> "subprocess.CompletedProcess[str]":
        code = (
            "import sys\nfrom phibench.datasets.make import make\n"
            "from phibench.datasets.common.errors import DatasetError\n"
            "try: make(*sys.argv[1:3], replace=bool(sys.argv[3]))\n"
            "except DatasetError as error: sys.exit(str(error))"
        )
        command = [sys.executable, "-c", code, str(recipe), str(out), replace]
        return subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path})

    frames = _changed(tmp_path, "[ambient]", '[frames]\npresets = ["mjpeg"]\n\n[ambient]')
    child = run(frames, copy)
    assert child.returncode == 0, child.stderr
    assert json.loads((copy / schema.INFO).read_text())["recipe"]["frames"]["presets"] == ["mjpeg"]
    assert damaged_files(copy) == []
    make.make(frames, copy, workers=1, console=(console := quiet()))  # with Mitsuba it is the same
    assert "nothing to do" in said(console)
    child = run(frames, tmp_path / "new")
    assert child.returncode == 1
    assert "Mitsuba is not installed" in child.stderr
    child = run(_changed(tmp_path, "bounces = 2", "bounces = 1"), copy, "--replace")
    assert child.returncode == 1
    assert "6 of 8 tasks are to be done, such as 'bake room', and" in child.stderr
    assert "Mitsuba is not installed" in child.stderr
    assert damaged_files(copy) == []
