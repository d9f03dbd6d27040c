"""The value of a number at which a cost that grows with it reaches a given size: first crossing, not a slope."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from phibench.scenes.frames import Array

Cost = Callable[[float], Array]
"""Value above 0 to costs, any shape; infinite where the value cannot be."""


def first_crossing(cost: Cost, target: float, start: float, limit: float, factor: float) -> Array:
    """Smallest value up to `limit` whose cost is `target`, in the shape of the costs; NaN where there is none.

    Costs are taken at start, start factor, start factor^2, ...; between two of them a power law is interpolated, and
    below `start` the cost counts as proportional to the value. The error of the power law is at most
    (ln factor)^2 / 8 times the curvature of ln(cost) over ln(value). Before a value that cannot be, the last one that
    can be is given.

    Parameters
    ----------
    cost : callable
    target, start, limit : float, above 0
    factor : float, above 1
    """
    before, low = start, np.asarray(cost(start), float)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.where(low >= target, start * target / low, np.nan)
    while np.isnan(found).any() and before < limit:
        value = min(before * factor, limit)
        high = np.asarray(cost(value), float)
        new = np.isnan(found) & (high >= target)
        found = np.where(new, _between(before, value, low, high, target), found)
        before, low = value, high
    return found


def _between(a: float, b: float, low: Array, high: Array, target: float) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.log(target / low) / np.log(high / low)
    # no cost at all before: the crossing is anywhere in between, the upper end is taken
    share = np.where(np.isinf(high), 0.0, np.where(low > 0.0, share, 1.0))
    return a * (b / a) ** np.clip(share, 0.0, 1.0)
