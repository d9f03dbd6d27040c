"""`sensitivities.parquet`: dD/d(parameter) per sample and estimator, beside the data set that it was computed from.

The estimators are not this folder's business: the command line has the table written after the data set is finished
(`phibench dataset make`, `phibench sensitivities`). It is therefore not listed in SHA256SUMS, whose bytes follow from
the recipe alone; instead the table's metadata hold the SHA-256 of SHA256SUMS, which tells what it belongs to.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from phibench.datasets import layout
from phibench.datasets.errors import DatasetError
from phibench.datasets.files import sha256

if TYPE_CHECKING:
    from polars import DataFrame

DIGEST = "phibench.dataset_sha256"
"""Key of the metadata."""


def metadata_of(folder: Path) -> dict[str, str]:
    """Metadata of a table for the data set in a folder as it is now."""
    return {DIGEST: sha256(folder / layout.SUMS)}


def sensitivity_fault(folder: Path) -> str | None:
    """One sentence on a table that is damaged or of another state of the data set; None if there is no fault."""
    import polars

    path = folder / layout.SENSITIVITIES
    if not path.is_file():
        return None
    try:
        digest = polars.read_parquet_metadata(path).get(DIGEST)
        polars.scan_parquet(path).select(polars.all().count()).collect()
    except (polars.exceptions.PolarsError, OSError) as error:
        why = str(error).splitlines()[0]
        return f"{layout.SENSITIVITIES} cannot be read: {why}; run `phibench sensitivities` again"
    if digest != metadata_of(folder)[DIGEST]:
        return f"{layout.SENSITIVITIES} belongs to another state of this data set; run `phibench sensitivities` again"
    return None


def read_sensitivities(folder: Path) -> DataFrame:
    """Table of a data set.

    Raises
    ------
    DatasetError
        If there is none, or it is not that of this data set.
    """
    import polars

    if not (folder / layout.SENSITIVITIES).is_file():
        raise DatasetError(f"{folder} has no {layout.SENSITIVITIES}; run `phibench sensitivities {folder}`")
    if fault := sensitivity_fault(folder):
        raise DatasetError(f"{folder}: {fault}")
    return polars.read_parquet(folder / layout.SENSITIVITIES)
