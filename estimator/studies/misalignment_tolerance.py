"""Tolerance table: which value of each parameter costs a given part of D."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from phibench.datasets.errors import DatasetError
from phibench.estimator.studies.misaligned import (
    CALIBRATED,
    NOMINAL,
    Calibrate,
    Places,
    calibrated_errors,
    errors,
)
from phibench.estimator.studies.tolerance import first_crossing
from phibench.scenes.checks import SceneError
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import PARAMETERS, Misalignment
from phibench.scenes.rig import Rig

STATISTICS = ("rms", "worst")
Errors = Callable[[Misalignment], Array]


@dataclass(frozen=True)
class Search:
    """How a tolerance is looked for.

    Parameters
    ----------
    cost : float
        Relative change of D that is allowed.
    start, largest : float
        First and last value, in units of the study's magnitude; the parameter's own limit also ends the search.
    factor : float
        Between values.
    """

    cost: float
    start: float
    largest: float
    factor: float


def tolerance_rows(
    nominal: Rig, places: Places, search: Search, coarse: Search, calibrate: Calibrate
) -> Iterator[dict[str, Any]]:
    """One row per parameter, estimator, D and statistic over azimuths and signs; value None where it is never reached.

    Parameters
    ----------
    nominal, places, calibrate
    search : for the estimators that believe the nominal rig
    coarse : for the calibrated one, which takes a second a value
    """

    def by_nominal(m: Misalignment) -> Array:
        return errors(nominal, m, places)

    def by_calibrated(m: Misalignment) -> Array:
        return calibrated_or_lost(nominal, m, places, calibrate)[None]

    for names, of, how in ((NOMINAL, by_nominal, search), ((CALIBRATED,), by_calibrated, coarse)):
        aligned = of(Misalignment())
        for parameter in PARAMETERS:
            values = tolerance(nominal, parameter, of, aligned, how)
            for i, estimator in enumerate(names):
                for j, depth in enumerate(places.depths_m):
                    for k, statistic in enumerate(STATISTICS):
                        yield _row(parameter, estimator, float(depth), places, statistic, values[k, i, j])


def signs(nominal: Rig, parameter: str, size: float) -> tuple[float, ...]:
    """Signs that a parameter of a size can have: a mirror cannot be smoother than smooth."""
    return tuple(sign for sign in (1.0, -1.0) if _possible(nominal, Misalignment(**{parameter: sign * size})))


def _possible(nominal: Rig, m: Misalignment) -> bool:
    try:
        nominal.perturbed(m)
    except SceneError:
        return False
    return True


def tolerance(nominal: Rig, parameter: str, of: Errors, aligned: Array, search: Search) -> Array:
    """Values at which the cost is reached, shape (statistics, estimators, d); NaN where it never is."""
    one = PARAMETERS[parameter]

    def cost(value: float) -> Array:
        both = [of(Misalignment(**{parameter: s * value})) - aligned for s in signs(nominal, parameter, value)]
        # a rig that cannot be costs nothing: the search ends without a crossing
        return over_azimuths(np.concatenate(both, axis=-1) if both else np.zeros(aligned.shape))

    limit = min(search.largest * one.study, one.limit)
    return first_crossing(cost, search.cost, search.start * one.study, limit, search.factor)


def over_azimuths(changes: Array) -> Array:
    """Rms and largest magnitude over the last axis, shape (2, ...); infinite where a spot has no estimate."""
    known = np.where(np.isfinite(changes), np.abs(changes), np.inf)
    return np.stack([np.sqrt(np.mean(known**2, axis=-1)), np.max(known, axis=-1)])


def calibrated_or_lost(nominal: Rig, m: Misalignment, places: Places, calibrate: Calibrate) -> Array:
    """Errors of the calibrated estimator; NaN where the rig cannot be or be calibrated."""
    try:
        return calibrated_errors(nominal, m, places, calibrate)
    except (SceneError, DatasetError, np.linalg.LinAlgError):
        return np.full(places.points_m.shape[:-1], np.nan)


def _row(
    parameter: str, estimator: str, depth_m: float, places: Places, statistic: str, value: float
) -> dict[str, Any]:
    one, reached = PARAMETERS[parameter], bool(np.isfinite(value))
    return {
        "parameter": parameter,
        "unit": one.unit,
        "estimator": estimator,
        "depth_m": depth_m,
        "stroke_m": places.stroke_m,
        "height_m": places.height_m,
        "statistic": statistic,
        "value": float(value) if reached else None,
        "value_over_study": float(value) / one.study if reached else None,
    }
