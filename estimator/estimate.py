"""A depth with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from phibench.estimator.status import Status, StatusArray, flag
from phibench.scenes.frames import Array


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


def covariance_of(sigma_1: ArrayLike, sigma_2: ArrayLike, correlation: ArrayLike = 0.0) -> Array:
    """Covariance matrix, shape (..., 2, 2), of two values from their standard deviations and correlation."""
    s1, s2, rho = np.broadcast_arrays(*(np.asarray(x, float) for x in (sigma_1, sigma_2, correlation)))
    cross = rho * s1 * s2
    return np.stack([np.stack([s1 * s1, cross], -1), np.stack([cross, s2 * s2], -1)], -2)


def stroke_status(stroke_m: ArrayLike) -> StatusArray:
    """Status of strokes: NOT_FINITE, OUT_OF_RANGE unless above 0."""
    h = np.asarray(stroke_m, float)
    return flag((~np.isfinite(h), Status.NOT_FINITE), (~(h > 0.0), Status.OUT_OF_RANGE))
