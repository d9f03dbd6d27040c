"""Finished work that only SHA256SUMS vouches for, because the journal is lost."""

import shutil
from pathlib import Path

import pytest
from helpers.folders import contents
from helpers.processes import SMALLEST, quiet

from phibench.datasets.build.dataset_build import plan_tasks
from phibench.datasets.build.earlier_runs import lost_work_text
from phibench.datasets.build.journal import Journal
from phibench.datasets.build.workers import versions
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.make import make
from phibench.datasets.merge_repair import repair
from phibench.datasets.plan.plan import make_plan
from phibench.datasets.recipe.load import parse_recipe
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import read_checksums
from phibench.datasets.store.metadata import dataset_info, read_info


@pytest.fixture
def copy(smallest_dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(smallest_dataset, tmp_path / "copy"))


def lost(folder: Path, old: str = "", new: str = "") -> str | None:
    """Work that a run with a changed recipe, in the same environment, would lose."""
    plan = make_plan(parse_recipe(SMALLEST.read_text().replace(old, new)))
    environment = read_info(folder).provenance
    keys = {name: task.key for name, task in plan_tasks(plan, versions(environment)).items()}
    return lost_work_text(folder, keys, Journal(folder), dataset_info(plan, environment))


def test_a_set_without_its_journal_is_finished_work(copy: Path) -> None:
    (copy / schema.JOURNAL).unlink()
    files = sum(schema.is_task_file(name) for name in read_checksums(copy))
    assert lost(copy, "seed = 0", "seed = 1") == (
        f"{copy} holds {files} finished files, such as lightmap.npz, that this run would delete or make again, "
        "they were made with another seed"
    )
    assert lost(copy) is None  # the same bytes again
    assert lost(copy, "[0.5]", "[0.5, 1.4]") is None
    assert lost(copy, "[ambient]", '[frames]\npresets = ["mjpeg"]\n\n[ambient]') is None
    (copy / schema.view_file("h0.500", "truth")).write_bytes(b"")
    assert f"holds {files - 1} finished files" in str(lost(copy, "seed = 0", "seed = 1"))
    (copy / schema.RECIPE).write_text("")  # it no longer says what made it
    assert f"holds {files - 1} finished files" in str(lost(copy))
    (copy / schema.CHECKSUMS).unlink()
    assert lost(copy, "seed = 0", "seed = 1") is None


def test_lines_that_the_journal_has_lost_are_asked_of_the_sums(copy: Path) -> None:
    lines = (copy / schema.JOURNAL).read_bytes().splitlines(keepends=True)
    (copy / schema.JOURNAL).write_bytes(lines[0])
    assert "finished files" in str(lost(copy, "seed = 0", "seed = 1"))
    assert lost(copy) is None


def test_what_is_damaged_is_no_loss(copy: Path) -> None:
    assert "(3 views, 2 samples)" in str(lost(copy, "seed = 0", "seed = 1"))
    (copy / schema.view_file("h0.500", "truth")).write_bytes(b"")
    (copy / schema.preview_file("seen-near-h0.500")).unlink()
    assert "(2 views, 1 sample)" in str(lost(copy, "seed = 0", "seed = 1"))


@pytest.mark.usefixtures("inline")
def test_a_set_that_was_cut_off_is_finished_without_its_seed(copy: Path, smallest_dataset: Path) -> None:
    """Its journal is all that is needed: who drew a secret seed need not have kept it."""
    (copy / schema.CHECKSUMS).unlink()
    for name in (schema.INFO, schema.MANIFEST, schema.TABLE, schema.RECIPE, schema.RIGS, schema.ROOMS):
        (copy / name).unlink()
    shutil.rmtree(copy / "previews")
    assert "sample seen-near-h0.500" in repair(copy, workers=1, console=quiet())
    assert contents(copy) == contents(smallest_dataset)


@pytest.mark.slow
@pytest.mark.usefixtures("inline")
def test_another_name_is_refused_without_a_journal_too(copy: Path, tmp_path: Path) -> None:
    (copy / schema.JOURNAL).unlink()
    other, before = tmp_path / "other.toml", (copy / schema.CHECKSUMS).read_bytes()
    other.write_text(SMALLEST.read_text().replace('"smallest"', '"other"'))
    with pytest.raises(
        DatasetError, match=r"holds another data set \(.smallest.\); give another folder, or .*--replace"
    ):
        make(other, copy, workers=1, console=quiet())
    assert (copy / schema.CHECKSUMS).read_bytes() == before
    make(other, copy, workers=1, console=quiet(), replace=True)
    assert contents(copy) == contents(make(other, tmp_path / "fresh", workers=1, console=quiet()))
