"""Shards: any division gives the bytes of an undivided run, and a merge of what does not fit is refused."""

import json
import shutil
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from helpers.drawn_values import drawing
from helpers.folders import contents
from helpers.inline_workers import InlineWorkerPool
from helpers.processes import SMALLEST, quiet

from phibench.datasets.build.journal import Journal
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.make import make
from phibench.datasets.merge_repair import merge
from phibench.datasets.plan import sampling
from phibench.datasets.plan.plan import make_plan, shard_plan
from phibench.datasets.read import open_dataset
from phibench.datasets.recipe.load import check_recipe, load_recipe
from phibench.datasets.rooms.room_sources import RoomSource, room_of
from phibench.datasets.store import schema
from phibench.datasets.verify import verify
from phibench.scenes.rig import POSITIONS
from phibench.scenes.room import Room

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Path]]:
    """Both halves. Read only: copy them to change them."""
    folder = tmp_path_factory.mktemp("shards")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("phibench.datasets.make.WorkerPool", InlineWorkerPool)
        yield [make(SMALLEST, folder / f"s{i}", workers=1, console=quiet(), shard=f"{i}/2") for i in (1, 2)]


@pytest.fixture
def shards(made: list[Path], tmp_path: Path, inline: None) -> list[Path]:
    return [Path(shutil.copytree(shard, tmp_path / shard.name)) for shard in made]


def test_merged_shards_are_the_undivided_run(shards: list[Path], smallest_dataset: Path, tmp_path: Path) -> None:
    for order in (shards, shards[::-1]):
        out = merge(tmp_path / order[0].name / "merged", order, quiet())
        assert contents(out) == contents(smallest_dataset)
        merge(out, order, quiet())  # again, into the same folder
        assert contents(out) == contents(smallest_dataset)
        shutil.rmtree(out)


def test_a_shard_is_a_data_set(shards: list[Path]) -> None:
    for i, shard in enumerate(shards, 1):
        dataset = open_dataset(shard)
        assert (len(dataset), len(dataset.info.poses), dataset.info.shard) == (1, 2, f"{i}/2")
        assert dataset.samples[0].expected_image("up").shape == (3, 90, 160)
        assert verify(shard, console=quiet()).faults == ()


def test_a_merged_folder_goes_on_as_a_made_one(shards: list[Path], tmp_path: Path) -> None:
    out = merge(tmp_path / "merged", shards, quiet())
    console = quiet()
    make(SMALLEST, out, workers=1, console=console)
    assert "nothing to do" in console.file.getvalue()  # type: ignore[attr-defined]


def test_a_job_array_with_one_folder_does_not_eat_itself(
    shards: list[Path], smallest_dataset: Path, tmp_path: Path
) -> None:
    one, whole = shards[0], Path(shutil.copytree(smallest_dataset, tmp_path / "whole"))
    for out, count, cause in (
        (one, "3 finished tasks (1 spot, 1 view, 1 sample)", "shard 1/2"),
        (whole, "3 finished tasks (1 spot, 1 view, 1 sample)", "no shard"),
    ):
        before = contents(out)
        with pytest.raises(DatasetError, match="--replace") as caught:
            make(SMALLEST, out, workers=1, console=quiet(), shard="2/2")
        assert f"holds {count} that this run would delete or make again, they were made with {cause};" in str(
            caught.value
        )
        assert contents(out) == before
    # what both shards have is no loss, and a shard may grow to the whole
    make(SMALLEST, one, workers=1, console=quiet())
    assert contents(one) == contents(smallest_dataset)
    make(SMALLEST, whole, workers=1, console=quiet(), shard="2/2", replace=True)
    assert contents(whole) == contents(shards[1])


def test_a_merge_deletes_no_finished_work(shards: list[Path], tmp_path: Path) -> None:
    out = Path(shutil.copytree(shards[0], tmp_path / "other"))
    rewritten(out / schema.JOURNAL, "view h0.500", lambda line: {**line, "key": "of another recipe"})
    before = contents(out)
    with pytest.raises(DatasetError, match=r"holds 1 finished task \(1 view\) .*; give another folder$"):
        merge(out, shards, quiet())
    assert contents(out) == before


def rewritten(journal: Path, task: str, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    """Change the journal's line of a task, with a good CRC."""
    lines = []
    for line in journal.read_bytes().splitlines():
        document = json.loads(line.partition(b" ")[2])
        text = json.dumps(change(document) if document.get("task") == task else document).encode()
        lines.append(b"%08x %b\n" % (zlib.crc32(text), text))
    journal.write_bytes(b"".join(lines))


def forged(journal: Path, task: str, name: str) -> None:
    """Let the journal's line of a task name another file in place of its first one."""

    def change(line: dict[str, Any]) -> dict[str, Any]:
        names = [name, *list(line["files"])[1:]]
        return {**line, "files": dict(zip(names, line["files"].values(), strict=True))}

    rewritten(journal, task, change)


def test_a_merge_writes_nothing_but_the_files_of_its_tasks(shards: list[Path], tmp_path: Path) -> None:
    """Whatever a shard's journal says: attack with a file that lies where the name leads, with the right hash."""
    out, journal = tmp_path / "deep" / "er" / "merged", shards[0] / schema.JOURNAL
    honest, file = journal.read_bytes(), schema.view_file("h0.500", "ambient")
    for leads in ("../../x.exr", "../x.exr", str(tmp_path / "x.exr"), "views/../../x.exr", "views/../x.exr"):
        (shards[0] / leads).write_bytes((shards[0] / file).read_bytes())
    others = (schema.CHECKSUMS, schema.INFO, schema.JOURNAL, schema.view_file("h0.000", "ambient"), "", "views", "x\0")
    before = sorted(tmp_path.parent.rglob("*"))
    for name in ("../../x.exr", "../x.exr", str(tmp_path / "x.exr"), "views/../../x.exr", "views/../x.exr", *others):
        forged(journal, "view h0.500", name)
        assert "view h0.500" not in Journal(shards[0]).entries
        assert refusal(out, shards).startswith("the shards lack 1 tasks, such as view h0.500;")
        assert sorted(tmp_path.parent.rglob("*")) == before
    forged(journal, "view h0.500", file)  # the forgery as such is not what is refused
    assert journal.read_bytes() == honest
    merge(out, shards, quiet())


@pytest.mark.parametrize("n", [1, 2, 3, 7, 25])
def test_every_sample_has_one_owner(n: int) -> None:
    whole = make_plan(load_recipe("paper"))
    parts = [shard_plan(whole, f"{i}/{n}") for i in range(1, n + 1)]
    assert [pair for part in parts for pair in part.pairs] == list(whole.pairs)
    sizes = [len(part.pairs) for part in parts]
    assert max(sizes) - min(sizes) <= 1
    for part in parts:
        assert {pose.pose_id for pose in part.poses} == {pair.pose_id(p) for pair in part.pairs for p in POSITIONS}
        assert set(part.poses) <= set(whole.poses)  # seeds come from names


@pytest.mark.parametrize("shard", ["", "1", "0/2", "3/2", "1/0", "a/b", "-1/2", "1/2/3", "1.0/2"])
def test_what_is_no_shard_is_refused(shard: str) -> None:
    with pytest.raises(DatasetError, match="must be i/n"):
        shard_plan(make_plan(load_recipe("smoke")), shard)


def test_an_empty_shard_is_refused() -> None:
    with pytest.raises(DatasetError, match="shard 1/9 is empty: there are 3 samples"):
        shard_plan(make_plan(load_recipe("smoke")), "1/9")


def refusal(out: Path, shards: Sequence[Path]) -> str:
    with pytest.raises(DatasetError) as caught:
        merge(out, shards, quiet())
    assert not (out / schema.CHECKSUMS).exists()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_does_not_fit_is_refused(shards: list[Path], tmp_path: Path) -> None:
    first, second = shards
    out = tmp_path / "merged"
    assert "give the folders" in refusal(out, [])
    assert "shard 2/2 is missing" in refusal(out, [first])
    assert "shard 1/2 is given more than once" in refusal(out, [first, first, second])
    third = make(SMALLEST, tmp_path / "s3", workers=1, console=quiet(), shard="1/1")
    assert "different divisions" in refusal(out, [first, second, third])
    other = tmp_path / "other.toml"
    other.write_text(SMALLEST.read_text().replace("bounces = 2", "bounces = 1"))
    make(other, tmp_path / "s4", workers=1, console=quiet(), shard="2/2")
    assert "are of different recipes" in refusal(out, [first, tmp_path / "s4"])
    assert "is not a finished shard" in refusal(out, [first, tmp_path / "none"])
    file = second / schema.spot_file("half-hidden-h1.400", "up")
    file.write_bytes(file.read_bytes()[:-1])
    assert "is damaged; run `phibench dataset repair`" in refusal(out, shards)
    file.unlink()
    assert "is missing; run `phibench dataset repair`" in refusal(out, shards)
    (second / schema.CHECKSUMS).unlink()
    assert "is not a finished shard" in refusal(out, shards)


UNIFORM = {"uniform": [1420.0, 1440.0]}
RECIPES = {
    "rigs of their own": {"rig": {"fx_px": UNIFORM, "holder": {"kind": {"choice": ["none", "rods"]}}}},
    "misaligned": {"misalignment": {"tilt_x_rad": {"uniform": [-0.01, 0.01]}, "k1": 0.001}},
    "one rig": {},
    "two focal lengths": {"rig": {"fx_px": {"choice": [1420.0, 1440.0]}}},
    "strokes alone": {"misalignment": {"stroke_relative": {"uniform": [-0.01, 0.01]}}},
}


@pytest.mark.parametrize("name", RECIPES)
def test_a_shard_plans_its_own_samples_as_the_whole_does(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every number and name, those of rigs included; where samples may share a rig, all of them are drawn."""
    recipe, drawn, draw = check_recipe(drawing(samples=11, **RECIPES[name])), list[int](), sampling._Makers._sample

    def counted(makers: Any, number: int, *others: Any) -> Any:
        drawn.append(number)
        return draw(makers, number, *others)

    monkeypatch.setattr(sampling._Makers, "_sample", counted)
    whole = make_plan(recipe)
    assert set(drawn) == set(range(11))
    for i in range(1, 5):
        drawn.clear()
        part = make_plan(recipe, shard=f"{i}/4")
        assert part == shard_plan(whole, f"{i}/4")
        assert list(part.rigs) == list(shard_plan(whole, f"{i}/4").rigs)
        own = set(range(11 * (i - 1) // 4, 11 * i // 4))
        assert set(drawn) == (set(range(11)) if name in ("two focal lengths", "strokes alone") else own)
    with pytest.raises(DatasetError, match="shard 1/12 is empty: there are 11 samples"):
        make_plan(recipe, shard="1/12")


def test_a_shard_builds_no_room_of_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sample i stands in room i modulo 3; rooms keep the order in which they are drawn."""
    recipe, built = load_recipe(ROOT / "tiny_worlds.toml"), list[str]()

    def counted(source: RoomSource, folder: Path | None = None) -> Room:
        built.append(str(source))
        return room_of(source, folder)

    monkeypatch.setattr(sampling, "room_of", counted)
    whole = make_plan(recipe)
    count, samples = len(built), len(whole.pairs)
    assert count > 1
    for i in range(1, samples + 1):
        built.clear()
        part = make_plan(recipe, shard=f"{i}/{samples}")
        assert part == shard_plan(whole, f"{i}/{samples}")
        assert list(part.rooms) == list(shard_plan(whole, f"{i}/{samples}").rooms)
        assert len(built) == 1
