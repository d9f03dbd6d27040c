"""Repair makes again exactly what is damaged, and the data set has its old bytes."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.damage import AMBIENT, OTHER_SPOT, SPOT, TRUTH, flip_a_bit, swap, truncate, write_checksums
from helpers.folders import contents
from helpers.processes import quiet, within

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.merge_repair import repair
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import checksums_text, read_checksums
from phibench.datasets.store.files import sha256
from phibench.datasets.verify import verify

PREVIEW = schema.preview_file("seen-near-h0.500")
MADE_BY = {
    AMBIENT: "view h0.000",
    schema.light_map_file("room"): "bake room",
    TRUTH: "view h0.500",
    SPOT: "spot seen-near-h0.500",
    PREVIEW: "sample seen-near-h0.500",
    **{
        name: name
        for name in (schema.INFO, schema.MANIFEST, schema.TABLE, schema.RECIPE, schema.ROOMS, schema.CHECKSUMS)
    },
}
pytestmark = pytest.mark.usefixtures("inline")


@pytest.fixture
def copy(smallest_dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(smallest_dataset, tmp_path / "copy"))


def sign_what_is_there(folder: Path) -> None:
    """SHA256SUMS over the files as they are now, without those that are gone."""
    names = [name for name in read_checksums(folder) if (folder / name).is_file()]
    (folder / schema.CHECKSUMS).write_text(checksums_text({name: sha256(folder / name) for name in names}))


def mend(folder: Path) -> list[str]:
    return repair(folder, workers=1, console=quiet())


DAMAGES = (truncate, flip_a_bit, Path.unlink)
CASES = [
    # quick: two damages of every file, one of them signed, so that every damage meets a third of all files either way
    pytest.param(name, damage, hide, marks=() if (k + n + hide) % 3 == 0 else pytest.mark.slow)
    for k, name in enumerate(MADE_BY)
    for n, damage in enumerate(DAMAGES)
    for hide in (False, True)
]


@pytest.mark.parametrize(("name", "damage", "hide"), CASES)  # hide: the sums are made anew
def test_a_damaged_file_is_made_again(
    copy: Path, smallest_dataset: Path, name: str, damage: Callable[[Path], None], hide: bool
) -> None:
    damage(copy / name)
    if hide and name != schema.CHECKSUMS:
        sign_what_is_there(copy)
    found = mend(copy)
    assert found[0] == MADE_BY[name]
    assert set(found) <= {MADE_BY[name], schema.CHECKSUMS}
    assert contents(copy) == contents(smallest_dataset)
    assert mend(copy) == []


def test_swapped_files_are_put_right(copy: Path, smallest_dataset: Path) -> None:
    swap(copy, SPOT, OTHER_SPOT)
    swap(copy, AMBIENT, schema.view_file("h0.500", "ambient"))
    write_checksums(copy)
    assert mend(copy)[:3] == ["spot seen-near-h0.500", "view h0.000", "view h0.500"]
    assert contents(copy) == contents(smallest_dataset)
    assert verify(copy, console=quiet()).ok


def test_everything_at_once(copy: Path, smallest_dataset: Path) -> None:
    for number, path in enumerate(sorted(path for path in copy.rglob("*.*") if path.name != schema.JOURNAL)):
        (truncate, flip_a_bit, Path.unlink)[number % 3](path) if path.is_file() and path.stat().st_size > 4 else None
    mend(copy)
    assert contents(copy) == contents(smallest_dataset)


def test_without_a_journal_all_is_done_again(copy: Path, smallest_dataset: Path) -> None:
    (copy / schema.JOURNAL).unlink()
    assert len(mend(copy)) >= 8
    assert contents(copy) == contents(smallest_dataset)


@pytest.mark.parametrize("damage", ["first line", "another line", "more at the end"])
def test_a_damaged_journal_is_written_anew(copy: Path, smallest_dataset: Path, damage: str) -> None:
    path = copy / schema.JOURNAL
    head, *rest = path.read_bytes().splitlines(keepends=True)
    if damage == "first line":
        head = head.replace(b'"', b"'", 1)
    elif damage == "another line":
        rest[0] = rest[0].replace(b'"', b"'", 1)
    elif damage == "more at the end":
        rest.append(b"not a line")
    path.write_bytes(b"".join([head, *rest]))
    assert mend(copy)
    assert contents(copy) == contents(smallest_dataset)
    assert mend(copy) == []


@pytest.mark.parametrize("content", [False, True], ids=["empty", "with content"])
def test_folders_in_place_of_files_give_way(copy: Path, smallest_dataset: Path, content: bool) -> None:
    """A folder that holds something is kept under another name."""
    names = sorted(contents(copy)) if content else [SPOT, PREVIEW, schema.MANIFEST, schema.CHECKSUMS]
    for name in names:
        (copy / name).unlink()
        (copy / name).mkdir()
        if content:
            (copy / name / "note.txt").write_text("mine")
    lost = {schema.INFO, schema.JOURNAL} & set(names)
    for name in lost:  # one of them and the recipe must be left
        (copy / name / "note.txt").unlink()
        (copy / name).rmdir()
        (copy / name).write_bytes((smallest_dataset / name).read_bytes())
    for name in (schema.LOG, schema.RUN, schema.LOCK):
        (copy / name).unlink(missing_ok=True)
        (copy / name).mkdir()
    mend(copy)
    assert contents(copy) == contents(smallest_dataset)
    kept = [path for path in copy.rglob("note.txt") if path.read_text() == "mine"]
    assert len(kept) == (len(names) - len(lost) if content else 0)


def test_fifos_circles_and_files_in_place_of_folders_give_way(copy: Path, smallest_dataset: Path) -> None:
    for name in (SPOT, schema.MANIFEST, schema.LOG):
        (copy / name).unlink()
        os.mkfifo(copy / name)
    for name in (AMBIENT, schema.TABLE):
        (copy / name).unlink()
        (copy / name).symlink_to(Path(name).name)
    shutil.rmtree(copy / "previews")
    (copy / "previews").write_text("mine")
    with within(100):
        mend(copy)
    assert contents(copy) == contents(smallest_dataset)
    assert (copy / "previews.aside-1").read_text() == "mine"


@pytest.mark.parametrize("journal", ["first line", "whole"])
def test_a_lost_info_follows_from_recipe_and_layers(copy: Path, smallest_dataset: Path, journal: str) -> None:
    (copy / schema.INFO).unlink()
    _, *rest = (copy / schema.JOURNAL).read_bytes().splitlines(keepends=True)
    (copy / schema.JOURNAL).write_bytes(b"".join(rest) if journal == "first line" else b"")
    done = mend(copy)
    assert (len(done) <= 3) == (journal == "first line"), done
    assert contents(copy) == contents(smallest_dataset)


def test_a_lost_info_does_not_follow_from_another_recipe(copy: Path) -> None:
    (copy / schema.INFO).unlink()
    (copy / schema.JOURNAL).unlink()
    text = (copy / schema.RECIPE).read_text()
    (copy / schema.RECIPE).write_text(text.replace("seed = 0", "seed = 1"))
    assert "is not the recipe of the layers" in refusal(copy)
    (copy / schema.RECIPE).write_text(text)
    (copy / schema.MANIFEST).write_text((copy / schema.MANIFEST).read_text().splitlines(keepends=True)[0])
    assert "holds a shard" in refusal(copy)
    shutil.rmtree(copy / "views")
    assert "holds no data set" in refusal(copy)


def refusal(folder: Path) -> str:
    with pytest.raises(DatasetError) as caught:
        mend(folder)
    return str(caught.value)


def test_what_cannot_be_repaired_is_refused(copy: Path, tmp_path: Path) -> None:
    assert "there is nothing to repair" in refusal(tmp_path / "none")
    head, *rest = (copy / schema.JOURNAL).read_bytes().splitlines(keepends=True)
    (copy / schema.JOURNAL).write_bytes(b"".join(rest))
    truth = (copy / schema.RECIPE).read_text()
    (copy / schema.RECIPE).write_text(truth.replace("bounces = 2", "bounces = 1"))
    assert "is not the recipe that dataset.json names" in refusal(copy)
    (copy / schema.RECIPE).unlink()
    assert "recipe.toml is missing" in refusal(copy)
    (copy / schema.RECIPE).write_text(truth)
    info = json.loads((copy / schema.INFO).read_text())
    info["provenance"]["packages"]["numpy"] = "1.0"
    (copy / schema.INFO).write_text(json.dumps(info))
    assert "was made with other packages" in refusal(copy)
    assert head.startswith(b"")
