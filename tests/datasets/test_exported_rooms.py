"""Rooms that a data set exports by itself: one of each kind, the same twice, kept, after a kill, and bad numbers."""

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import pytest
from helpers.inline_workers import InlineExecutor, InlineWorkerPool, make_inline
from helpers.processes import quiet

from phibench.datasets.common.errors import DatasetError, RecipeError
from phibench.datasets.make import dry_run, make
from phibench.datasets.merge_repair import merge
from phibench.datasets.plan.draws import draw_rooms
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.read import open_finished
from phibench.datasets.recipe.load import load_recipe, parse_recipe
from phibench.datasets.rooms.room_files import RoomFiles
from phibench.datasets.rooms.room_sources import UnexportedRoom, room_of
from phibench.datasets.store.checksums import data_files, read_checksums
from phibench.datasets.verify import verify

KINDS = Path(__file__).resolve().parents[1] / "tiny_kinds.toml"
TEXT = KINDS.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def made(kinds_dataset: Path) -> Path:
    """Data set of three rooms, rendered once (20 CPU-s). Read only: copy it to change it."""
    return kinds_dataset


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "copy"))


def exported(folder: Path) -> dict[str, str]:
    """SHA-256 of the exported files of a data set by name."""
    files = sorted((folder / "rooms" / "exported").iterdir())
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def sentence(act: Callable[[], object]) -> str:
    with pytest.raises(DatasetError) as caught:
        act()
    return str(caught.value)


def test_one_of_each_kind_is_made_and_verifies(made: Path) -> None:
    dataset = open_finished(made)
    assert [info.source["kind"] for info in dataset.rooms.infos.values()] == ["generated", "panorama", "mesh"]
    assert [sample.room.name for sample in dataset][1:] == [
        "panorama of generated:tinykinds:0:panorama:0",
        "mesh of generated:tinykinds:0:mesh:0",
    ]
    assert all(sample.ambient(position).max() > 0.0 for sample in dataset for position in ("down", "up"))
    assert set(data_files(made)) == set(read_checksums(made))
    report = verify(made, console=quiet())
    assert (report.faults, report.notes) == ((), ())


@pytest.mark.slow
def test_the_plan_without_files_is_the_one_with_them(made: Path) -> None:
    """Names of surfaces, spots and visibility: the stand-ins have the surfaces of the files to the bit."""
    without = make_plan(parse_recipe(TEXT))
    whole = make_plan(parse_recipe(TEXT), RoomFiles(made / "rooms"))
    assert without.pairs == whole.pairs
    assert without.spots == whole.spots
    standing, read = ([room_of(s, p.files.folder) for s in p.rooms.values()] for p in (without, whole))
    assert standing[2].digest == read[2].digest
    assert [shape.T_world_shape for shape in standing[1].surfaces] == [s.T_world_shape for s in read[1].surfaces]


def test_a_dry_run_makes_no_file_and_says_what_is_missing(made: Path, tmp_path: Path) -> None:
    assert "1 as panoramas and 1 as meshes are to be exported first" in dry_run(KINDS, tmp_path / "new", 1)
    assert not (tmp_path / "new").exists()
    text = dry_run(KINDS, made, 1)
    assert "to be exported" not in text
    assert "to make: nothing" in text


def test_a_killed_export_is_taken_up_again_with_the_same_bytes(made: Path, tmp_path: Path) -> None:
    """The run ends as by Ctrl-C after the first file; a file that a killed worker had begun lies beside it."""
    out = tmp_path / "out"
    original = InlineExecutor.next

    def stop(executor: InlineExecutor) -> object:
        if any((out / "rooms" / "exported").glob("*.exr")):
            raise KeyboardInterrupt
        return original(executor)

    with (
        patch("phibench.datasets.make.WorkerPool", InlineWorkerPool),
        patch.object(InlineExecutor, "next", stop),
        pytest.raises(KeyboardInterrupt),
    ):
        make(KINDS, out, workers=1, console=quiet())
    first = exported(out)
    assert len(first) == 1
    before = (out / "rooms" / "exported" / next(iter(first))).stat().st_mtime_ns
    (out / "rooms" / "exported" / ".phibench-tmp-killed.glb").write_bytes(b"half")
    make_inline(KINDS, out)
    assert exported(out) == exported(made)
    assert (out / "rooms" / "exported" / next(iter(first))).stat().st_mtime_ns == before
    assert read_checksums(out) == read_checksums(made)


@pytest.mark.slow
def test_more_samples_keep_the_files_and_add_those_of_their_rooms(made: Path, tmp_path: Path) -> None:
    """Two samples need the panorama alone; the third needs the mesh."""
    out = tmp_path / "out"
    make_inline(KINDS, out, samples=2)
    first = exported(out)
    assert [Path(name).suffix for name in first] == [".exr"]
    make_inline(KINDS, out)
    assert exported(out) == {**exported(made), **first} == exported(made)
    assert read_checksums(out) == read_checksums(made)


def test_shards_merge_to_the_same_bytes(made: Path, tmp_path: Path) -> None:
    """Each shard exports by itself."""
    shards = [make_inline(KINDS, tmp_path / f"shard-{k}", shard=f"{k}/2") for k in (1, 2)]
    merged = merge(tmp_path / "merged", shards, quiet())
    assert read_checksums(merged) == read_checksums(made)


def test_a_damaged_file_is_made_again(copy: Path, made: Path) -> None:
    mesh = next((copy / "rooms" / "exported").glob("*.glb"))
    mesh.write_bytes(mesh.read_bytes()[:-1] + b"!")
    make_inline(KINDS, copy)
    assert exported(copy) == exported(made)
    assert read_checksums(copy) == read_checksums(made)


@pytest.mark.slow
def test_another_seed_is_refused_and_leaves_the_folder_as_it_was(copy: Path) -> None:
    held = exported(copy)
    with patch("phibench.datasets.make.WorkerPool", InlineWorkerPool):
        assert "another seed" in sentence(lambda: make(KINDS, copy, workers=1, console=quiet(), seed=1))
    assert exported(copy) == held


def test_dev_and_test_share_no_exported_room() -> None:
    files = []
    for name in ("bench-dev", "bench-test"):
        sources = draw_rooms(load_recipe(name)).values()
        found = {source.room.stream: source.file for source in sources if isinstance(source, UnexportedRoom)}
        assert len(set(found.values())) == len(found) == 40
        files.append(found)
    assert not set(files[0]) & set(files[1])
    assert not set(files[0].values()) & set(files[1].values())


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("exported_panoramas = 1", "exported_panoramas = -1", "rooms.exported_panoramas"),
        ("exported_meshes = 1", "exported_meshes = 1.5", "rooms.exported_meshes"),
        ("panorama_rows = 64", "panorama_rows = 8", "rooms.panorama_rows"),
        ("count = 1\nexported_panoramas = 1\nexported_meshes = 1\n", "count = 0\n", "rooms.count"),
    ],
)
def test_bad_numbers_are_told(old: str, new: str, fault: str) -> None:
    with pytest.raises(RecipeError, match="has 1 fault") as caught:
        parse_recipe(TEXT.replace(old, new))
    assert f"  {fault}: " in str(caught.value)


def test_properties_without_a_room_rendered_as_it_is_are_no_fault() -> None:
    rooms = parse_recipe(TEXT.replace("count = 1\n", "count = 0\n")).rooms
    assert rooms is not None
    assert (rooms.generated, rooms.exported) == (0, 2)
