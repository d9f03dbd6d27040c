"""What the tests of sealed sets share."""

from __future__ import annotations

from pathlib import Path

import pytest

from phibench.benchmark.sealed.dense_set import first_pairs, write_dense_set
from phibench.datasets.read import open_finished


@pytest.fixture(scope="session")
def dense_set(kinds_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Dense set of the first two of three samples. Read only."""
    return write_dense_set(first_pairs(open_finished(kinds_dataset), 2), tmp_path_factory.mktemp("dense") / "set")
