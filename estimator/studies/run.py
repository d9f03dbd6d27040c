"""Running a study: settings and data sets in, a folder out."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from phibench.datasets.errors import DatasetError
from phibench.datasets.files import require_writable
from phibench.estimator.studies.folder import DOCUMENT, write_study
from phibench.estimator.studies.material import Material
from phibench.estimator.studies.registry import find_study
from phibench.estimator.studies.result import Result
from phibench.estimator.studies.settings import read_settings

DATA = "data"


def run_study(
    name: str,
    out: Path,
    quick: bool = False,
    settings: Path | None = None,
    data: Path | None = None,
    workers: int | None = None,
    console: Console | None = None,
) -> Result:
    """Run a study and write its folder.

    Parameters
    ----------
    name : name of the study
    out : folder
    quick : take the reduced settings
    settings : TOML file in place of the study's own
    data : folder of the data sets; by default `data` in `out`
    workers : processes that render
    console : where progress goes; by default the standard error

    Raises
    ------
    DatasetError
        If there is no such study, its settings have faults, or its data sets cannot be had or lack what it needs.
    """
    study = find_study(name)
    chosen = read_settings(study, quick, settings)
    if workers is not None and workers < 1:
        raise DatasetError(f"--workers {workers}: at least 1 is needed")
    if data is not None and data.exists() and not data.is_dir():
        raise DatasetError(f"--data {data} is a file; give the folder of the data sets")
    require_writable(out / DOCUMENT)
    result = study.run(chosen, Material(data or out / DATA, console or Console(stderr=True), workers))
    write_study(out, study, chosen, quick, result)
    return result
