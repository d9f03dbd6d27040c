"""Table of how D reacts to each error of the rig: a row per sample and estimator, and its file in a data set."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from phibench.datasets.read import Dataset, Sample, open_finished
from phibench.datasets.store import schema
from phibench.datasets.store.files import write_bytes
from phibench.datasets.store.sensitivity_file import sensitivity_bytes, sensitivity_fault
from phibench.estimator.geometry.sensitivities import PARAMETERS, sensitivities
from phibench.estimator.geometry.triangulate import ESTIMATORS
from phibench.scenes.rig import POSITIONS

Row = dict[str, str | float | None]
TRUTH = ("decentre_x_m", "decentre_y_m")
"""The only parameters on which the true D depends."""


def sensitivity_rows(samples: Iterable[Sample]) -> Iterator[Row]:
    """One row per sample and estimator; numbers are None where a spot is not visible or there is no estimate.

    Columns
    -------
    sample_id, estimator : str
    cause : str
        Why a spot is not visible, "none" if both are.
    depth_m, estimate_m : float
        True D, and the estimate with nominal rig and stroke from the exact pixels.
    estimate_m_per_<parameter> : float
        d(estimate)/d(parameter), metres per unit of the parameter: its name ends in m, rad or px, or it is a number.
    truth_m_per_<parameter> : float
        d(true D)/d(parameter), for `TRUTH`; 0 for all others.
    """
    for sample in samples:
        yield from _rows(sample)


def write_sensitivities(dataset: Dataset, out: Path) -> Path:
    """Write the table of a data set as Parquet; its metadata say of which state of the data set it is."""
    import polars

    types = dict.fromkeys(columns(), polars.Float64) | dict.fromkeys(_WORDS, polars.String)
    table = polars.DataFrame(list(sensitivity_rows(dataset)), schema={name: types[name] for name in columns()})
    return write_bytes(out, sensitivity_bytes(table, dataset.folder))


def keep_sensitivities(folder: Path) -> Path:
    """Write the table into a finished data set's folder, unless the one there is good."""
    path = folder / schema.SENSITIVITIES
    if path.is_file() and sensitivity_fault(folder) is None:
        return path
    return write_sensitivities(open_finished(folder), path)


def columns() -> tuple[str, ...]:
    """Names of the columns, in order."""
    numbers = (f"estimate_m_per_{name}" for name in PARAMETERS)
    return (*_WORDS, "depth_m", "estimate_m", *numbers, *(f"truth_m_per_{name}" for name in TRUTH))


_WORDS = ("sample_id", "estimator", "cause")


def _rows(sample: Sample) -> Iterator[Row]:
    """Rows of one sample, one for each estimator."""
    row = sample.row
    hidden = [f"{name}: {row.position(name).cause}" for name in POSITIONS if not row.position(name).visible]
    words: Row = {"sample_id": row.sample_id, "cause": ", ".join(hidden) or "none"}
    if hidden:
        empty = {**dict.fromkeys(columns()), **words, "depth_m": row.depth_m}
        yield from ({**empty, "estimator": estimator} for estimator in ESTIMATORS)
        return
    rigs = sample.nominal_rig, row.nominal_stroke_m, sample.rig, row.stroke_m
    for estimator, change in sensitivities(ESTIMATORS, *rigs, np.array(row.spot_world_m)).items():
        truth = dict(zip(PARAMETERS, change.truth_gradient, strict=True))
        yield {
            **words,
            "estimator": estimator,
            "depth_m": row.depth_m,
            "estimate_m": _number(change.estimate_m),
            **{f"estimate_m_per_{p}": _number(x) for p, x in zip(PARAMETERS, change.estimate_gradient, strict=True)},
            **{f"truth_m_per_{p}": _number(truth[p]) for p in TRUTH},
        }


def _number(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None
