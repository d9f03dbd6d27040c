"""Status codes of array kernels, their order and words; depths with standard deviation, interval and pull.

A kernel never raises for one bad element: it gives NaN and the first `Status` that is not OK. A disparity is nearly
linear in 1 / D, so that sigma of D goes as D squared: intervals and pulls are in D, or in 1 / D where sigma is large.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phibench.scenes.frames import Array

StatusArray = NDArray[np.int64]


class Status(IntEnum):
    """Outcome of one element of an array kernel; everything but OK comes with NaN."""

    OK = 0
    NOT_FINITE = 1  # an input is NaN or infinite, or the lens model has no ray for the pixel
    OUT_OF_RANGE = 2  # an angle outside [0, 90] degrees or a stroke that is not above 0
    MISSES_MIRROR = 3
    GRAZING = 4  # on the outline of the mirror, where the derivatives grow without limit
    ON_AXIS = 5  # the ray returns to the camera: no azimuth, no depth
    PARALLEL = 6  # the two rays meet at infinity
    DIVERGING = 7  # the two lines meet behind the mirror, not on the rays
    NO_SPOT = 8  # no light in the difference of the frames
    SPOT_CUT = 9  # the spot reaches the edge of the image
    NOT_ISOLATED = 10  # no empty border found around the spot
    NOT_CONVERGED = 11  # a fit did not come to rest
    SATURATED = 12  # too few pixels below saturation for the unknowns of a fit


def flag(*cases: tuple[ArrayLike, Status]) -> StatusArray:
    """Return the status of the first condition that holds, elementwise, and OK where none does.

    Parameters
    ----------
    *cases : pairs (condition, status)
        Conditions are boolean arrays that broadcast together.
    """
    conditions = [np.asarray(condition, bool) for condition, _ in cases]
    status = np.full(np.broadcast_shapes(*(condition.shape for condition in conditions)), int(Status.OK), np.int64)
    for condition, (_, value) in reversed(list(zip(conditions, cases, strict=True))):  # the first is written last
        np.copyto(status, int(value), where=condition)
    return status


def first_fault(*statuses: ArrayLike) -> StatusArray:
    """Return the first status that is not OK, elementwise."""
    arrays = [np.asarray(status, np.int64) for status in statuses]
    first = np.full(np.broadcast_shapes(*(array.shape for array in arrays)), int(Status.OK), np.int64)
    for array in reversed(arrays):
        np.copyto(first, array, where=array != int(Status.OK))
    return first


def keep(values: Array, status: StatusArray) -> Array:
    """Return `values` with NaN where the status is not OK; trailing axes of `values` follow those of `status`."""
    good = (status == int(Status.OK)).reshape(status.shape + (1,) * (values.ndim - status.ndim))
    return np.where(good, values, np.nan)


def describe(status: int) -> str:
    """Return a status in words: "misses mirror"."""
    return Status(status).name.lower().replace("_", " ")


@dataclass(frozen=True)
class DepthEstimate:
    """Depths D, shape (...).

    Parameters
    ----------
    depth_m : shape (...), metres
    sigma_m : shape (...), standard deviation to first order, NaN if no input covariance was given
    status : shape (...), values of `Status`
    """

    depth_m: Array
    sigma_m: Array
    status: StatusArray


def propagate(gradient: Array, covariance: Array | None) -> Array:
    """Return sqrt(g C g^T), shape (...), for gradients (..., n) and covariances (..., n, n); NaN without covariance."""
    if covariance is None:
        return np.full(gradient.shape[:-1], np.nan)
    return np.sqrt(np.einsum("...i,...ij,...j->...", gradient, np.asarray(covariance, float), gradient))


def stroke_status(stroke_m: ArrayLike) -> StatusArray:
    """Status of strokes: NOT_FINITE, OUT_OF_RANGE unless above 0."""
    h = np.asarray(stroke_m, float)
    return flag((~np.isfinite(h), Status.NOT_FINITE), (~(h > 0.0), Status.OUT_OF_RANGE))


LINEAR = 0.05
"""Sigma of D over D up to which intervals and pulls are those of D itself."""
_NORMAL_95 = 1.959964  # quantile 0.975 of the standard normal law


def depth_pull(depth_m: ArrayLike, sigma_m: ArrayLike, true_m: ArrayLike) -> Array:
    """Errors over their standard deviations, positive where D is too large; shapes as they broadcast.

    Beyond `LINEAR` it is that of 1 / D, whose sigma is sigma / D^2.
    """
    D, sigma, true = (np.asarray(x, float) for x in (depth_m, sigma_m, true_m))
    pull = (D - true) / sigma
    return np.asarray(np.where(sigma > LINEAR * D, pull * D / true, pull))


def depth_interval(depth_m: float, sigma_m: float) -> tuple[float, float]:
    """Ends in metres between which D lies with 95 %; the far one is infinite where 1 / D may be 0."""
    if sigma_m <= LINEAR * depth_m:
        return depth_m - _NORMAL_95 * sigma_m, depth_m + _NORMAL_95 * sigma_m
    half = _NORMAL_95 * sigma_m / depth_m
    return depth_m / (1.0 + half), depth_m / (1.0 - half) if half < 1.0 else np.inf
