"""The studies by name, in the order in which they are read."""

from __future__ import annotations

import importlib
from typing import Any

from phibench.datasets.errors import DatasetError
from phibench.estimator.studies.study import Study
from phibench.scenes.names import nearest

NAMES = ("noise", "misalignment", "baseline", "cause", "isotropy", "stroke")


def find_study(name: str) -> Study[Any]:
    """Study of a name; each module `studies/NAME.py` has its `STUDY`.

    Raises
    ------
    DatasetError
        If there is none.
    """
    if name not in NAMES:
        raise DatasetError(f"no study '{name}'; {nearest(name, NAMES)}")
    found = importlib.import_module(f"phibench.estimator.studies.{name}").STUDY
    assert isinstance(found, Study)
    return found
