"""The engine of parts, with parts of a few bytes: killed, damaged, changed, refused; baked rooms as one such folder."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.processes import quiet

from phibench.datasets.build.journal import NO_HEAD, Entry, Journal
from phibench.datasets.build.task_runner import BroughtParts, bring_all
from phibench.datasets.build.tasks import BuildTask, TaskResult, task_key
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.film.moving_camera import _drawn_room, bake_rooms, open_baked_rooms
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import filling, with_checksums, write_documents
from phibench.render.room.light_map import BakeSettings, LightMap, texel_count
from phibench.scenes.room import Room

NAMES = ("a", "b", "c")


def write_part(out: Path, name: str, text: str, done: list[str]) -> TaskResult:
    """Task: two files, the second of which is named like a folder of the first."""
    if text == "impossible":
        raise DatasetError(f"{name} cannot be made")
    done.append(name)
    for file in (f"{name}/one", f"{name}/two"):
        (out / file).parent.mkdir(exist_ok=True)
        (out / file).write_text(text)
    return TaskResult((f"{name}/one", f"{name}/two"), {"length": len(text)})


def filled(out: Path, done: list[str], stop: Callable[[Path], object] = lambda _: None, **texts: str) -> BroughtParts:
    """Fill a folder as every product does."""

    def make(out: Path, *arguments: Any) -> TaskResult:
        stop(out)
        return write_part(out, *arguments)

    values = {name: texts.get(name, f"text of {name}") for name in NAMES}
    tasks = [
        BuildTask(f"shard {name}", task_key(text, "code", {}), make, (name, text, done))
        for name, text in values.items()
    ]
    with filling(out):
        brought = bring_all({task.name: task for task in tasks}, out, 1, quiet(), "parts")
        write_documents(out, with_checksums({"README.md": b"about"}, brought.hashes))
    return brought


def files(out: Path) -> dict[str, bytes]:
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in out.rglob("*") if path.is_file()}


@pytest.mark.parametrize("made_before", [0, 1, 2])
def test_a_killed_run_goes_on_to_the_same_bytes(tmp_path: Path, made_before: int) -> None:
    filled(tmp_path / "whole", [])
    done: list[str] = []

    def stop(out: Path) -> None:
        if len(done) == made_before:
            (out / ".phibench-tmp-half").write_bytes(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        filled(tmp_path / "out", done, stop)
    assert not (tmp_path / "out" / schema.CHECKSUMS).exists()
    assert filled(tmp_path / "out", done).made == tuple(f"shard {name}" for name in NAMES[made_before:])
    assert done == list(NAMES)
    assert files(tmp_path / "out") == files(tmp_path / "whole")


@pytest.mark.parametrize("file", ["b/one", "b/two"])
@pytest.mark.parametrize("spoil", [Path.unlink, lambda path: path.write_bytes(b"text of c")])
def test_a_damaged_part_alone_is_made_again(tmp_path: Path, file: str, spoil: Callable[[Path], object]) -> None:
    done: list[str] = []
    filled(tmp_path, done)
    before = files(tmp_path)
    spoil(tmp_path / file)
    assert filled(tmp_path, done).made == ("shard b",)
    assert files(tmp_path) == before
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    assert filled(tmp_path, done).made == ()
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()} == times


def test_a_part_of_another_key_or_with_a_damaged_line_is_made_again(tmp_path: Path) -> None:
    done: list[str] = []
    filled(tmp_path, done)
    assert filled(tmp_path, done, c="longer than before").made == ("shard c",)
    assert (tmp_path / "c" / "one").read_text() == "longer than before"
    journal = tmp_path / schema.JOURNAL
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(lines[0] + lines[1][:-9] + b"\n" + lines[2] + lines[3])
    assert filled(tmp_path, done, c="longer than before").made == ("shard a",)
    assert journal.read_bytes() == b"".join(lines)


def test_a_part_that_fails_costs_no_other(tmp_path: Path) -> None:
    out, done = tmp_path / "out", list[str]()
    with pytest.raises(DatasetError, match=r"^a cannot be made$"):
        filled(out, done, a="impossible")
    assert done == ["b", "c"]
    assert not (out / schema.CHECKSUMS).exists()
    assert Journal(out).refusals["shard a"].refused == "a cannot be made"
    filled(out, done)
    assert done == ["b", "c", "a"]
    filled(tmp_path / "whole", [])
    assert files(out) == files(tmp_path / "whole")


@pytest.mark.parametrize(
    ("task", "file", "allowed"),
    [
        ("shard data/train-0", "data/train-0", True),
        ("shard data/train-0", "data/train-0/a.png", True),
        ("shard data/train-0", "data/train-1", False),
        ("film a-h0.1", "films/a-h0.1/film.parquet", True),
        ("film a-h0.1", "films/b-h0.1/film.parquet", False),
        ("film a.h0", "films/aXh0/film.parquet", False),
        ("key k0_0.1", "views/k0_0.1.exr", True),
        ("archive ../x", "../x", False),
        ("room room000", "rooms.json", False),
        ("bake room", "lightmap.npz", True),
        ("bake other", "lightmap.npz", False),
        ("sample a", "previews/b.png", False),
        ("other a", "a", False),
    ],
)
def test_a_line_counts_only_with_files_that_its_part_may_write(
    tmp_path: Path, task: str, file: str, allowed: bool
) -> None:
    with Journal(tmp_path) as journal:
        journal.begin(NO_HEAD, [])
        journal.add(Entry(task, "key", {file: "0" * 64}))
    assert list(Journal(tmp_path).entries) == [task] * allowed
    assert Journal(tmp_path).damaged == [2] * (not allowed)


def test_baked_rooms_are_kept_one_by_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    baked: list[str] = []

    def light_map(view: object, room: Any, settings: BakeSettings) -> LightMap:
        if len(baked) == 1 and not (tmp_path / "again").exists():
            (tmp_path / "again").touch()
            raise KeyboardInterrupt
        baked.append(room.name)
        texels = texel_count(room, settings.texel_m)
        light = np.full((texels, 3), len(baked), np.float32)
        return LightMap(light, np.zeros_like(light), np.zeros(texels, bool))

    monkeypatch.setattr("phibench.datasets.build.bake_task.light_map", light_map)
    monkeypatch.setattr("phibench.datasets.build.view_task.start_renderer", dict)
    out, settings = tmp_path / "rooms", BakeSettings(texel_m=0.5, indirect_texel_m=1.0)
    with pytest.raises(KeyboardInterrupt):
        bake_rooms(out, 2, "a", settings=settings, workers=1, console=quiet())
    with pytest.raises(DatasetError, match="holds no baked rooms"):
        open_baked_rooms(out)
    bake_rooms(out, 2, "a", settings=settings, workers=1, console=quiet())
    assert len(baked) == 2
    before = files(out)
    (out / "room001.npz").write_bytes(b"damaged")
    with pytest.raises(DatasetError, match=re.escape("room001.npz")):
        open_baked_rooms(out)
    baked.pop()
    bake_rooms(out, 2, "a", settings=settings, workers=1, console=quiet())
    assert files(out) == before
    rooms = open_baked_rooms(out)
    assert [float(room.irradiance_w_m2.mean()) for room in rooms.values()] == [1.0, 2.0]
    assert [one["name"] for one in json.loads(before["rooms.json"])["rooms"]] == list(rooms)


@pytest.mark.parametrize("result", [None, 3, {"length": "long"}, [1]])
def test_a_result_of_another_form_is_one_sentence(result: object) -> None:
    brought = BroughtParts({name: Entry(name, "", {}, {"length": 3}) for name in NAMES}, ())
    assert brought.results(dict[str, int]) == [{"length": 3}] * 3
    damaged = BroughtParts({"a": Entry("a", "", {}, result)}, ())
    with pytest.raises(DatasetError, match=r"^journal\.txt has a damaged result of a part: .*again$") as caught:
        damaged.results(dict[str, int])
    assert "\n" not in str(caught.value)


def test_a_room_that_does_not_do_is_drawn_again() -> None:
    """`loop bake` asks so for rooms with targets that can be driven to; a rule that none keeps is a sentence."""
    seen: list[str] = []

    def third(room: Room) -> bool:
        seen.append(room.digest)
        return len(seen) == 3

    _, room = _drawn_room(third, "drawn again", 0)
    assert len(set(seen)) == 3
    assert room.digest == seen[-1]
    assert _drawn_room(None, "drawn again", 0)[1].digest == seen[0]
    with pytest.raises(DatasetError, match="does what is asked of it; take another stream"):
        _drawn_room(lambda _: False, "drawn again", 0)
