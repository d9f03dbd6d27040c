"""Flipped bits in every kind of file of a data set: 300 in each, one at a time, none unseen."""

import io
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.damage import flip_bit, unseen_flips
from rich.console import Console

from phibench.datasets.store import schema
from phibench.datasets.verify import verify
from phibench.estimator.geometry.sensitivity_table import keep_sensitivities

pytestmark = pytest.mark.slow


@pytest.fixture
def copy(smallest_dataset: Path, tmp_path: Path) -> Path:
    folder = Path(shutil.copytree(smallest_dataset, tmp_path / "copy"))
    keep_sensitivities(folder)
    return folder


def test_files_hashes_and_journal_tell_every_flip(copy: Path) -> None:
    assert unseen_flips(copy, 300) == {}


@pytest.mark.parametrize("name", [schema.SENSITIVITIES, schema.INFO, schema.MANIFEST, schema.TABLE, schema.JOURNAL])
def test_the_whole_verification_survives_and_tells_every_flip(copy: Path, name: str) -> None:
    """As the command runs it: damaged documents are opened too, and none may end in anything but a report."""
    random, size, missed = np.random.default_rng(1), (copy / name).stat().st_size, []
    for bit in map(int, random.integers(0, 8 * size, 10)):
        flip_bit(copy / name, bit)
        if verify(copy, False, Console(file=io.StringIO())).ok:
            missed.append(bit)
        flip_bit(copy / name, bit)
    assert missed == []
