"""Rooms of a data set: each sample has its own, each is built from its line, and a bad line is one sentence."""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from helpers.damage import sign, write_checksums
from helpers.inline_workers import InlineWorkerPool
from helpers.processes import SMALLEST, quiet

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.make import make_from_plan
from phibench.datasets.plan.draws import draw_rooms
from phibench.datasets.plan.plan import POSITIONS, Plan, make_plan, pose_of
from phibench.datasets.read import open_dataset, open_finished
from phibench.datasets.recipe.load import load_recipe
from phibench.datasets.rooms.room_sources import NamedRoom, room_of
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import data_files, read_checksums
from phibench.datasets.store.json_forms import from_json, to_json
from phibench.datasets.verify import verify

IDS = ("lit-0", "dark-1")


def two_rooms() -> Plan:
    """Plan of `tests/smallest.toml` whose second sample is in a dark room of its own."""
    plan = make_plan(load_recipe(SMALLEST))
    lit = plan.rooms["room"]
    assert isinstance(lit, NamedRoom)
    pairs = tuple(replace(pair, room=room) for pair, room in zip(plan.pairs, IDS, strict=True))
    poses = {pair.pose_id(position): pair for pair in pairs for position in POSITIONS}
    offsets = {pose.pose_id: pose for pose in plan.poses}
    return replace(
        plan,
        rooms=dict(zip(IDS, (lit, replace(lit, name="dark")), strict=True)),
        pairs=pairs,
        poses=tuple(
            replace(offsets[name.removeprefix(f"{pair.room}-")], pose_id=name, room=pair.room)
            for name, pair in poses.items()
        ),
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Two samples in two rooms. Read only: copy it to change it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("phibench.datasets.make.WorkerPool", InlineWorkerPool)
        out = tmp_path_factory.mktemp("rooms") / "out"
        make_from_plan(two_rooms(), SMALLEST.read_text(), out, 1, quiet())
        yield out


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "copy"))


def lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / schema.ROOMS).read_text().splitlines()]


def rewrite(folder: Path, documents: list[dict[str, Any]]) -> None:
    (folder / schema.ROOMS).write_text("".join(json.dumps(document) + "\n" for document in documents))


def test_every_sample_has_its_own_room(made: Path) -> None:
    dataset, plan = open_finished(made), two_rooms()
    assert list(dataset.rooms) == list(plan.rooms) == [sample.row.room for sample in dataset]
    for sample, pair in zip(dataset, plan.pairs, strict=True):
        assert sample.room == room_of(plan.rooms[pair.room])
        assert sample.row.down.pose == pose_of("rig", 0.0, pair.room) == f"{pair.room}-h0.000"
        names = dataset.rooms.info(pair.room).object_names
        assert names == sample.room.object_names(sample.view("up"))
    lit, dark = dataset
    assert lit.ambient("up").max() > 0.0 == dark.ambient("up").max()
    assert "2 rooms" in repr(dataset)


def test_a_light_map_for_each_room_that_has_light(made: Path) -> None:
    assert {name for name in data_files(made) if name.endswith(".npz")} == {"lightmaps/lit-0.npz"}
    assert set(data_files(made)) == set(read_checksums(made))
    assert [info["lit"] for info in lines(made)] == [True, False]


def test_the_only_room_of_several_is_refused(made: Path) -> None:
    dataset = open_dataset(made)
    with pytest.raises(DatasetError, match=r"has 2 rooms; take each sample's own, `sample\.room`$"):
        _ = dataset.room
    assert dataset[1:].room == dataset[1].room  # these samples share one
    with pytest.raises(DatasetError, match=r"rooms\.jsonl has no room 'lit'; did you mean 'lit-0'\?"):
        dataset.rooms["lit"]


def test_a_data_set_of_two_rooms_has_no_faults_but_that_its_recipe_gives_one(made: Path) -> None:
    assert verify(made, truth_layers=True, console=quiet()).faults == (
        *(f"{row.sample_id}: room is {row.room}, the recipe gives room" for row in open_dataset(made).rows),
        f"{schema.ROOMS}: the rooms are not those of the recipe",
        f"{schema.INFO}: the poses are not those of the recipe",
    )


def test_a_plan_of_two_rooms_is_done_once(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its results are taken from the journal; a lost line is made again by its room's task alone."""
    monkeypatch.setattr("phibench.datasets.make.WorkerPool", InlineWorkerPool)
    assert make_from_plan(two_rooms(), SMALLEST.read_text(), copy, 1, quiet()) == []
    before = (copy / schema.ROOMS).read_bytes()
    (copy / schema.ROOMS).unlink()
    journal = (copy / schema.JOURNAL).read_text()
    assert journal.count("bake dark-1") == 1
    (copy / schema.JOURNAL).write_text(journal.replace("bake dark-1", "bake dark-2"))
    done = make_from_plan(two_rooms(), SMALLEST.read_text(), copy, 1, quiet())
    assert "bake dark-1" in done
    assert [name for name in done if name.startswith(("spot", "view lit", "bake lit"))] == []
    assert (copy / schema.ROOMS).read_bytes() == before


# Faults, on a data set of one room.


@pytest.fixture
def one(smallest_dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(smallest_dataset, tmp_path / "one"))


def sentence(act: Callable[[], object]) -> str:
    with pytest.raises(DatasetError) as caught:
        act()
    assert str(caught.value).isprintable()
    return str(caught.value)


def test_a_missing_or_damaged_file_is_one_sentence(one: Path) -> None:
    path, text = one / schema.ROOMS, (one / schema.ROOMS).read_text()
    path.write_text(text + " ")
    assert "rooms.jsonl is damaged: its SHA-256" in sentence(lambda: open_finished(one))
    for damage in (text[:-30], "{}\n", text.replace('"digest"', '"sum"'), text.replace(':"room"', ':"../room"', 1)):
        path.write_text(damage)
        assert "rooms.jsonl line 1 is damaged: " in sentence(lambda: open_dataset(one))
    path.write_text("")
    assert "rooms.jsonl has 0 rooms instead of 1" in sentence(lambda: open_dataset(one))
    path.write_text(text * 2)
    assert "rooms.jsonl line 2 is damaged: room 'room' is there already" in sentence(lambda: open_dataset(one))
    path.unlink()
    assert "rooms.jsonl is missing" in sentence(lambda: open_dataset(one))
    assert "rooms.jsonl is missing" in sentence(lambda: open_finished(one))


CHANGES: dict[str, tuple[dict[str, Any], str]] = {
    "another digest": ({"digest": "0" * 64}, "room is another room here than where the data set was made"),
    "no such room": ({"source": {"name": "lap", "targets": [], "kind": "named"}}, "no room is called 'lap'; did you"),
    "no such kind": ({"source": {"name": "lab", "targets": [], "kind": "drawn"}}, "kind"),
    "no source": ({"source": {}}, "name"),
    "a board too much": ({"source": {"name": "lab", "targets": [7], "kind": "named"}}, "targets"),
}


@pytest.mark.parametrize(("change", "words"), CHANGES.values(), ids=CHANGES)
def test_a_line_that_gives_no_room_or_another_is_one_sentence(one: Path, change: dict[str, Any], words: str) -> None:
    rewrite(one, [{**lines(one)[0], **change}])
    sign(one)
    dataset = open_finished(one)  # rooms are built when they are asked for
    for ask in (lambda: dataset.room, lambda: dataset[0].room, lambda: dataset.rooms["room"]):
        text = sentence(ask)
        assert text.startswith("rooms.jsonl: room ")
        assert words in text
    assert [fault for fault in verify(one, truth_layers=False, console=quiet()).faults if words in fault]


@pytest.mark.parametrize("field", ["lit", "object_names"])
def test_what_a_line_says_besides_its_source_is_verified(one: Path, field: str) -> None:
    [line] = lines(one)
    line[field] = False if field == "lit" else line[field][::-1]
    rewrite(one, [line])
    write_checksums(one)
    faults = verify(one, truth_layers=False, console=quiet()).faults
    assert f"rooms.jsonl: {field} of room is not that of its source" in faults


def test_another_source_than_the_recipes_is_found(one: Path) -> None:
    [line] = lines(one)
    line["source"]["targets"][0]["azimuth_rad"] += 1e-6
    line["digest"] = room_of(NamedRoom("dark", ())).digest
    rewrite(one, [line])
    sign(one)
    faults = verify(one, truth_layers=False, console=quiet()).faults
    assert "rooms.jsonl: room is not the room that the recipe gives" in faults


@pytest.mark.parametrize(("number", "is_read"), [(2**62 + 12345, True), (2**129 - 1, True), (2**129, False)])
def test_rooms_of_secret_seeds_are_read(number: int, is_read: bool) -> None:
    """A secret seed stands in the name of a generated room's streams; it was refused, and such sets with it."""
    recipe = load_recipe("bench-test")
    source = next(iter(draw_rooms(recipe).values()))
    document = to_json(source)
    document["stream"] = [document["stream"][0], number, *document["stream"][2:]]
    if is_read:
        assert from_json(type(source), document).stream[1] == number
    else:
        with pytest.raises(DatasetError, match="not allowed"):
            from_json(type(source), document)
