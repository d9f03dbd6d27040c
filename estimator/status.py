"""What can be wrong with one ray, one angle or one depth."""

from __future__ import annotations

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
    conditions = np.broadcast_arrays(*(np.asarray(condition, bool) for condition, _ in cases))
    return np.asarray(np.select(conditions, [int(status) for _, status in cases], int(Status.OK)), np.int64)


def first_fault(*statuses: ArrayLike) -> StatusArray:
    """Return the first status that is not OK, elementwise."""
    arrays = np.broadcast_arrays(*(np.asarray(status, np.int64) for status in statuses))
    return np.asarray(np.select([array != Status.OK for array in arrays], arrays, int(Status.OK)), np.int64)


def keep(values: Array, status: StatusArray) -> Array:
    """Return `values` with NaN where the status is not OK; trailing axes of `values` follow those of `status`."""
    good = (status == Status.OK).reshape(status.shape + (1,) * (values.ndim - status.ndim))
    return np.where(good, values, np.nan)


def describe(status: int) -> str:
    """Return a status in words: "misses mirror"."""
    return Status(status).name.lower().replace("_", " ")
