"""`sensitivities.parquet` beside a data set: written once, read back, told from one that is out of date or damaged."""

from __future__ import annotations

import io
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from helpers.damage import flip_bit
from helpers.folders import contents
from helpers.valid_files import sensitivity_table
from rich.console import Console

import phibench
from phibench.cli.main import main
from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import open_finished
from phibench.datasets.store import schema
from phibench.datasets.store.checksums import stray_files
from phibench.datasets.store.sensitivity_file import read_sensitivities, sensitivity_bytes, sensitivity_fault
from phibench.datasets.verify import verify
from phibench.estimator.geometry.sensitivity_table import columns, keep_sensitivities
from phibench.estimator.geometry.triangulate import ESTIMATORS


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
    assert stray_files(copy) == []
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


TABLES: dict[str, tuple[Callable[[pl.DataFrame], pl.DataFrame], str]] = {
    "no word": (lambda table: table.drop("cause"), "has no column 'cause'"),
    "a number for a word": (lambda table: table.with_columns(cause=pl.lit(1.0)), "a column 'cause' of type Float64"),
    "another column": (lambda table: table.with_columns(pl.lit(1.0).alias("\x1b[31m")), "is none of this table"),
    "a text for a number": (lambda table: table.with_columns(truth_m_per_cx_px=pl.lit("1")), "of type String is none"),
    "no name": (
        lambda table: table.with_columns(sample_id=pl.lit(None, pl.String)),
        "'sample_id' holds what is no",
    ),
    "an escape code": (lambda table: table.with_columns(cause=pl.lit("\x1b[31m")), "'cause' holds what is no name"),
    "a long name": (lambda table: table.with_columns(estimator=pl.lit("a" * 201)), "'estimator' holds what is no name"),
    "infinite": (lambda table: table.with_columns(depth_m=pl.lit(np.inf)), "'depth_m' holds a number that is not"),
    "not a number": (lambda table: table.with_columns(estimate_m=pl.lit(np.nan)), "'estimate_m' holds a number"),
    "many values": (lambda table: table.select(pl.all().repeat_by(9).explode()), "values are read"),
}


@pytest.mark.parametrize(("change", "words"), TABLES.values(), ids=TABLES)
def test_a_strange_table_is_refused_though_signed(
    tmp_path: Path, change: Callable[[pl.DataFrame], pl.DataFrame], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("phibench.datasets.common.input_files.TABLE_VALUES", 100)
    (tmp_path / schema.CHECKSUMS).write_bytes(b"")
    path = tmp_path / schema.SENSITIVITIES
    path.write_bytes(sensitivity_bytes(sensitivity_table(), tmp_path))
    assert read_sensitivities(tmp_path).equals(sensitivity_table())
    path.write_bytes(sensitivity_bytes(change(sensitivity_table()), tmp_path))
    with pytest.raises(DatasetError, match=re.escape(words)) as caught:
        read_sensitivities(tmp_path)
    assert str(caught.value).startswith(f"{path} ")
    assert str(caught.value).endswith("; run `phibench dataset sensitivities` again")
    assert sensitivity_fault(tmp_path) == str(caught.value).removeprefix(f"{tmp_path}/")
