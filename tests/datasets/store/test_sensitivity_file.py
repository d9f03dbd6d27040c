"""`sensitivities.parquet` beside a data set: written once, read back, told from one that is out of date or damaged."""

from __future__ import annotations

import io
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.damage import flip_bit
from helpers.folders import contents
from rich.console import Console

import phibench
from phibench.datasets.errors import DatasetError
from phibench.datasets.read import open_finished
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import strays
from phibench.datasets.store.documents import sensitivity_fault
from phibench.datasets.verify import verify
from phibench.estimator.cli.main import main
from phibench.estimator.geometry.estimators import ESTIMATORS
from phibench.estimator.paper.sensitivity_table import columns, keep_sensitivities


@pytest.fixture
def copy(tiny_dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(tiny_dataset, tmp_path / "copy"))


def faults(folder: Path) -> tuple[str, ...]:
    return verify(folder, False, Console(file=io.StringIO())).faults


def test_it_is_written_once_read_and_in_order(copy: Path) -> None:
    path = keep_sensitivities(copy)
    assert path == copy / schema.SENSITIVITIES
    table = open_finished(copy).sensitivities()
    assert tuple(table.columns) == columns()
    assert len(table) == len(open_finished(copy)) * len(ESTIMATORS)
    assert strays(copy) == []
    assert faults(copy) == ()
    before = path.stat().st_mtime_ns
    assert keep_sensitivities(copy) == path
    assert path.stat().st_mtime_ns == before


@pytest.mark.usefixtures("inline")
def test_python_and_the_command_line_give_the_same_folder(tiny_dataset: Path, tmp_path: Path) -> None:
    one, other = (Path(shutil.copytree(tiny_dataset, tmp_path / name)) for name in ("python", "command"))
    recipe = one / schema.RECIPE
    assert phibench.make(recipe, one, console=Console(file=io.StringIO())) == one
    assert main(["dataset", "make", str(recipe), "--out", str(other)]) == 0
    assert (one / schema.SENSITIVITIES).read_bytes() == (other / schema.SENSITIVITIES).read_bytes()
    assert contents(one) == contents(other)


def test_a_table_of_another_state_is_noticed_and_made_again(copy: Path) -> None:
    keep_sensitivities(copy)
    sums = copy / schema.CHECKSUMS
    sums.write_text(sums.read_text() + f"{'0' * 64}  more.txt\n")
    with pytest.raises(DatasetError, match="belongs to another state of this data set"):
        open_finished(copy).sensitivities()
    assert any("sensitivities.parquet belongs to another state" in fault for fault in faults(copy))
    keep_sensitivities(copy)
    assert len(open_finished(copy).sensitivities()) > 0


def test_a_damaged_table_is_noticed(copy: Path) -> None:
    path = keep_sensitivities(copy)
    path.write_bytes(path.read_bytes()[:200])
    [fault] = faults(copy)
    assert fault.startswith("sensitivities.parquet is damaged")
    assert "\n" not in fault


def test_no_flipped_bit_of_the_table_goes_unseen(copy: Path) -> None:
    """Neither in numbers, whose pages have no checksum in Parquet, nor in names, types and hashes."""
    path = keep_sensitivities(copy)
    bits = np.random.default_rng(0).integers(0, 8 * path.stat().st_size, 300)
    for bit in map(int, bits):
        flip_bit(path, bit)
        assert sensitivity_fault(copy) is not None, bit
        flip_bit(path, bit)
    assert sensitivity_fault(copy) is None


def test_a_data_set_without_one_says_how_to_get_it(copy: Path) -> None:
    with pytest.raises(DatasetError, match=r"has no sensitivities\.parquet; run `phibench dataset sensitivities"):
        open_finished(copy).sensitivities()
    assert faults(copy) == ()
