"""Data sets with rooms of three kinds, generated, photographed and of a mesh: whole, without their files, damaged."""

import io
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.inline_workers import InlineWorkerPool, make_inline
from helpers.processes import quiet
from helpers.room_files import KINDS_TOML, write_files
from rich.console import Console

from phibench.datasets.build.dataset_build import plan_tasks
from phibench.datasets.build.forecast import forecast
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.make import dry_run, make
from phibench.datasets.merge_repair import merge, repair
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.read import open_finished
from phibench.datasets.recipe.load import load_recipe, recipe_files
from phibench.datasets.rooms.room_files import RoomError
from phibench.datasets.show import table
from phibench.datasets.store.checksums import data_files, read_checksums
from phibench.datasets.verify import verify

IDS = ["room000000", "panorama000000", "mesh000000"]
FILES = ["rooms/meshes/hall.glb", "rooms/office.png"]


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recipe beside its files. Read only."""
    path = write_files(tmp_path_factory.mktemp("kinds")) / "kinds.toml"
    path.write_text(KINDS_TOML)
    return path


@pytest.fixture(scope="module")
def made(recipe: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data set of the recipe. Read only: copy it to change it."""
    return make_inline(recipe, tmp_path_factory.mktemp("made") / "out")


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "copy"))


def sentence(act: Callable[[], object]) -> str:
    with pytest.raises(DatasetError) as caught:
        act()
    assert str(caught.value).isprintable()
    return str(caught.value)


def test_the_first_samples_show_all_kinds_and_the_set_verifies(made: Path) -> None:
    dataset = open_finished(made)
    assert [sample.row.room for sample in dataset] == list(dataset.rooms) == IDS
    assert [info.source["kind"] for info in dataset.rooms.infos.values()] == ["generated", "panorama", "mesh"]
    assert [sample.room.name for sample in dataset] == ["generated:kinds:0:room:0", "panorama", "mesh"]
    assert all(sample.ambient("up").max() > 0.0 for sample in dataset)
    assert [name for name in data_files(made) if name.startswith("rooms/")] == FILES
    assert set(data_files(made)) == set(read_checksums(made))
    report = verify(made, console=quiet())
    assert (report.faults, report.notes) == ((), ())


def test_the_table_of_samples_names_their_rooms(made: Path) -> None:
    console = Console(file=io.StringIO(), width=170)
    console.print(table(open_finished(made)))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert all(name in text for name in IDS)


def test_lamps_outside_a_room_are_one_sentence(tmp_path: Path) -> None:
    folder, out = write_files(tmp_path), tmp_path / "out"
    shutil.copytree(folder / "meshes", out / "rooms" / "meshes")
    (folder / "dark.toml").write_text(KINDS_TOML.replace("[0.0, 0.6, 2.55]", "[0.0, 0.6, 5.0]"))
    tasks = plan_tasks(make_plan(load_recipe(folder / "dark.toml"), recipe_files(folder / "dark.toml")), {})
    bake = tasks["bake mesh000000"]
    bake.function(out, *bake.arguments)
    view = next(task for name, task in tasks.items() if name.startswith("view mesh000000"))
    with pytest.raises(RoomError, match="room mesh000000: no light reaches the camera; move its lamps inside"):
        view.function(out, *view.arguments)


def test_images_and_truth_need_no_file_but_the_room_does(copy: Path) -> None:
    shutil.rmtree(copy / "rooms")
    dataset = open_finished(copy)
    for sample in dataset:
        assert np.isfinite(sample.expected_image("down")).all()
        assert sample.truth("up")["object_id"].max() >= 0
    assert dataset["random-000000"].room.name.startswith("generated")
    for number, name in ((1, "office.png"), (2, "meshes/hall.glb")):
        text = sentence(lambda number=number: dataset[number].room)  # type: ignore[misc]
        assert text.startswith(f"rooms.jsonl: {IDS[number]} cannot be built: {copy}/rooms/{name} is missing")
    faults = verify(copy, console=quiet()).faults
    assert {f"{name} is missing" for name in FILES} <= set(faults)


def test_a_changed_file_is_one_sentence_and_cannot_be_repaired(copy: Path) -> None:
    (copy / FILES[1]).write_bytes((copy / FILES[1]).read_bytes() + b" ")
    text = sentence(lambda: open_finished(copy)[1].room)
    assert f"{FILES[1]} is another file than the room was made from" in text
    assert f"{FILES[1]} is damaged: its SHA-256 is not the listed one" in verify(copy, console=quiet()).faults
    assert f"{FILES[1]} is another file" in sentence(lambda: repair(copy, console=quiet()))


def test_a_lost_copy_is_put_back_by_the_recipe_alone(copy: Path, recipe: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is rendered again: all other files keep their times."""
    (copy / FILES[0]).unlink()
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*.exr")}
    monkeypatch.setattr("phibench.datasets.make.WorkerPool", InlineWorkerPool)
    make(recipe, copy, 1, quiet())
    assert {path: path.stat().st_mtime_ns for path in copy.rglob("*.exr")} == before
    assert verify(copy, truth_layers=False, console=quiet()).ok


def test_the_recipe_of_a_data_set_finds_the_copies(made: Path, recipe: Path) -> None:
    plans = [make_plan(load_recipe(path), recipe_files(path)) for path in (recipe, made / "recipe.toml")]
    assert plans[0].rooms == plans[1].rooms
    assert plans[0].pairs == plans[1].pairs


def test_files_may_lie_in_another_folder(
    copy: Path, recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("phibench.datasets.make.WorkerPool", InlineWorkerPool)
    alone = Path(shutil.copyfile(recipe, tmp_path / "alone.toml"))
    with pytest.raises(DatasetError, match=r"alone\.toml has 2 faults:\n .*office\.png is missing; put a file.* there"):
        dry_run(alone, tmp_path / "new")
    told = dry_run(alone, tmp_path / "new", room_files=recipe.parent)
    assert "3 of 3 pairs will be visible" in told
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*")}
    make(alone, copy, 1, quiet(), room_files=recipe.parent)  # complete already
    assert {path: path.stat().st_mtime_ns for path in copy.rglob("*") if path in before} == before


def test_the_forecast_of_a_bake_is_the_mean_over_rooms(recipe: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of four rooms two are generated and differ; of many of a kind some, evenly chosen, stand for all."""
    monkeypatch.setattr("phibench.datasets.build.forecast.is_cached", lambda *_: False)
    plan = make_plan(load_recipe(recipe), recipe_files(recipe))
    drawn = plan.rooms["room000000"]
    other = replace(drawn, stream=(*drawn.stream, "another"))
    many = {f"room{k:06}": (drawn, other)[k % 2] for k in range(12)}
    rooms = {**plan.rooms, "room000001": other, **many}
    tasks = [task for task in plan_tasks(make_plan(plan.recipe, plan.files), {}).values() if task.kind == "bake"]

    def seconds(*names: str) -> float:
        return forecast(replace(plan, rooms={name: rooms[name] for name in names}), tasks).seconds["bake"]

    alone = {name: seconds(name) for name in (*IDS, "room000001")}
    assert len(set(alone.values())) == 4
    assert seconds(*alone) == pytest.approx(sum(alone.values()) / 4)
    assert seconds(*many) == pytest.approx((alone["room000000"] + alone["room000001"]) / 2)


def test_cached_is_said_of_light_maps_in_the_cache_alone(recipe: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bake that takes less than a second is no cached one, and one room in the cache speaks for no other."""
    plan = make_plan(load_recipe(recipe), recipe_files(recipe))
    tasks = [task for task in plan_tasks(make_plan(plan.recipe, plan.files), {}).values() if task.kind == "bake"]

    def said(found: bool, rooms: dict[str, Any]) -> str:
        monkeypatch.setattr("phibench.datasets.build.forecast.is_cached", lambda *_: found)
        return forecast(replace(plan, rooms=rooms), tasks).text(1, 1e-3)

    rooms = dict(plan.rooms)
    assert "(cached)" in said(True, rooms)
    assert "(under 1 s each)" in said(False, rooms)
    assert "cached" not in said(True, {**rooms, "room000001": rooms["room000000"]})


def test_another_file_under_the_same_name_is_other_work(
    copy: Path, recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("phibench.datasets.make.WorkerPool", InlineWorkerPool)
    folder = Path(shutil.copytree(recipe.parent, tmp_path / "other"))
    (folder / "office.png").write_bytes((folder / "office.png").read_bytes() + b" ")
    text = sentence(lambda: make(folder / "kinds.toml", copy, 1, quiet()))
    assert "finished tasks" in text
    assert "--replace" in text
    assert verify(copy, truth_layers=False, console=quiet()).ok


@pytest.mark.slow
def test_two_workers_and_merged_shards_give_the_same_bytes(made: Path, recipe: Path, tmp_path: Path) -> None:
    make(recipe, tmp_path / "two", 2, quiet())
    shards = [make(recipe, tmp_path / f"shard{i}", 2, quiet(), shard=f"{i}/2") for i in (1, 2)]
    merge(tmp_path / "merged", shards, quiet())
    assert all(verify(shard, truth_layers=False, console=quiet()).ok for shard in shards)
    for other in ("two", "merged"):
        assert read_checksums(tmp_path / other) == read_checksums(made)
