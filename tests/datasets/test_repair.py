"""Repair makes again exactly what is damaged, and the data set has its old bytes."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.damage import AMBIENT, OTHER_SPOT, SPOT, TRUTH, flip_a_bit, swap, truncate
from helpers.folders import contents
from helpers.processes import quiet

from phibench.datasets.errors import DatasetError
from phibench.datasets.merge_repair import repair
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import checksums_text, read_checksums, write_checksums
from phibench.datasets.store.files import sha256
from phibench.datasets.verify import verify

PREVIEW = schema.preview_file("seen-near-h0.500")
MADE_BY = {
    AMBIENT: "view h0.000",
    schema.LIGHT_MAP: "bake room",
    TRUTH: "view h0.500",
    SPOT: "spot seen-near-h0.500",
    PREVIEW: "sample seen-near-h0.500",
    **{name: name for name in (schema.INFO, schema.MANIFEST, schema.TABLE, schema.RECIPE, schema.CHECKSUMS)},
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


@pytest.mark.parametrize("damage", [truncate, flip_a_bit, Path.unlink])
@pytest.mark.parametrize("name", MADE_BY)
@pytest.mark.parametrize("hide", [False, True], ids=["sums as they were", "sums made anew"])
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
