"""`phibench sensitivities`: what misalignments of the rig do to the estimates of a data set."""

from __future__ import annotations

from pathlib import Path


def sensitivities(directory: Path, *, out: Path | None = None) -> int:
    """Write dD/d(parameter) of every sample and estimator as a Parquet table.

    The estimate is made with the nominal rig, the parameter is one of the true rig: docs/misalignment.md has them all.

    Parameters
    ----------
    directory
        Folder of a data set.
    out
        Parquet file to write; by default sensitivities.parquet in the folder, as `dataset make` does.
    """
    from phibench.datasets import layout
    from phibench.datasets.read import open_finished
    from phibench.estimator.score import ESTIMATORS
    from phibench.estimator.sensitivity_table import columns, write_sensitivities

    dataset = open_finished(directory)
    out = directory / layout.SENSITIVITIES if out is None else out
    write_sensitivities(dataset, out)
    print(f"{out}: {len(dataset)} samples x {len(ESTIMATORS)} estimators, {len(columns())} columns")
    return 0
