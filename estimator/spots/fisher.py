"""Fisher matrices of spots, their covariance bound, and the limited step of Fisher scoring.

A Fisher matrix is over the unknowns of a spot, u and v first. Leading axes of all arrays are spots or hypotheses.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from phibench.scenes.frames import Array

_CONDITION = 1e12  # of the scaled matrix; beyond it the unknowns cannot be told apart
_RELATIVE_RIDGE, _RIDGE = 1e-9, 1e-12  # added to the diagonal: unknowns that nothing tells apart stop no step
STEP_PX = 0.5  # the longest step of a position: beyond it a spot of 0.7 px is no parabola
_FLUX_FALL = 0.1  # a flux falls to no less in one step
_WIDTH_CHANGE = (0.7, 1.4)  # of a free width in one step
_WIDTH_RANGE_PX = (0.15, 10.0)  # of a free width: narrower ones are a point on any pixel, wider ones a part of the room
_TINY = 1e-300  # instead of 0 as a divisor


def fisher_matrix(derivatives: Array, information: Array) -> Array:
    """Fisher matrix, shape (..., k, k): sum over pixels of (dmu/da)(dmu/db) J(mu).

    Parameters
    ----------
    derivatives : shape (..., k, h, w), derivatives of the mean by k unknowns
    information : shape (..., h, w), information of each pixel about its mean
    """
    flat = derivatives.reshape(*derivatives.shape[:-2], -1)
    return np.asarray((flat * information.reshape(*information.shape[:-2], 1, -1)) @ np.swapaxes(flat, -1, -2))


def covariance_bound(fisher: Array, keep: int = 2) -> Array:
    """Cramer-Rao bound of the first `keep` unknowns while the others are unknown too, shape (..., keep, keep).

    NaN where the matrix is singular or holds what is not finite.
    """
    with np.errstate(all="ignore"):
        scale = 1.0 / np.sqrt(np.diagonal(fisher, axis1=-2, axis2=-1))
        scaled = fisher * scale[..., :, None] * scale[..., None, :]
        finite = np.asarray(np.isfinite(scaled).all(axis=(-2, -1)))
        # the unit matrix keeps what cannot be inverted from stopping the others
        safe = np.where(finite[..., None, None], scaled, np.eye(fisher.shape[-1]))
        good = finite & (np.linalg.cond(safe) < _CONDITION)
        inverse = np.linalg.inv(np.where(good[..., None, None], safe, np.eye(fisher.shape[-1])))
        bound = (inverse * scale[..., :, None] * scale[..., None, :])[..., :keep, :keep]
    return np.where(good[..., None, None], bound, np.nan)


def scoring_step(fisher: Array, score: Array) -> Array:
    """Step of Fisher scoring, F^-1 s, shape (m, k); 0 for what is not finite.

    Parameters
    ----------
    fisher : shape (m, k, k)
    score : shape (m, k)
    """
    matrix = np.where(np.isfinite(fisher), fisher, 0.0)
    diagonal = np.einsum("mkk->mk", matrix)  # a view
    diagonal *= 1.0 + _RELATIVE_RIDGE
    diagonal += _RIDGE
    return np.asarray(np.linalg.solve(matrix, np.nan_to_num(score)[..., None])[..., 0])


def limited(
    theta: Array,
    step: Array,
    damping: float = 1.0,
    *,
    moved_px: Array | None = None,
    most_px: float = STEP_PX,
    fluxes: Sequence[int] = (2,),
    free_width: bool = False,
) -> Array:
    """Unknowns after a limited step, shape (m, k); what would not be finite stays.

    Parameters
    ----------
    theta, step : shape (m, k)
    damping : float
        Of the whole step, at most 1.
    moved_px : shape (m,), optional
        How far the step moves a spot; by default the larger of its first two elements.
    most_px : float
        The step is shortened so that no spot moves further.
    fluxes : columns of fluxes, which may fall to a tenth
    free_width : bool
        The last column is a width; it changes by at most 40 % and stays within 0.15 to 10 px.
    """
    moved = np.abs(step[:, :2]).max(axis=1) if moved_px is None else moved_px
    new = theta + np.minimum(damping, most_px / np.maximum(moved, _TINY))[:, None] * step
    for flux in fluxes:
        new[:, flux] = np.maximum(new[:, flux], _FLUX_FALL * np.maximum(theta[:, flux], 1.0))
    if free_width:
        low, high = (change * theta[:, -1] for change in _WIDTH_CHANGE)
        new[:, -1] = np.clip(new[:, -1], low, high).clip(*_WIDTH_RANGE_PX)
    return np.where(np.isfinite(new), new, theta)
