"""Posterior of a pair's point (u, v, 1 / D) from likelihood maps of both images, and of one spot's place by itself.

Fits choose a place. Where a likelihood has a flat valley or several minima, the chosen place has a larger mean square
error than the mean over the posterior, and a covariance at it says too little. Here both images' likelihoods are
multiplied on a grid, the up position following from `up_image`, and means, covariances and an interval are taken.

The prior is flat in u, v and 1 / D, in which the images move nearly evenly, within `FARTHEST_M`. The depth is the mean
of D itself: of all numbers it has the smallest mean square error of D under the posterior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from phibench.estimator.geometry.epipolar_line import up_image
from phibench.estimator.geometry.status import Status
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

FARTHEST_M = 50.0  # of D; what is farther cannot be told from it by any pair
MISFIT_RANGE = 30.0  # above the least misfit: beyond it lies 3e-7 of a posterior of two unknowns
_WALL = 2.0 * MISFIT_RANGE  # above which a misfit is not told from a larger one
_COARSE = (17, 17, 41)  # nodes along u, v, 1 / D that find where the posterior is
_FINE = (41, 41, 81)  # over the part that holds the posterior; 1 / D is the longest valley
_SINGLE = 4  # nodes of a single image's posterior for each step of its map
_NODES = (4, 4, 6)  # of the polynomial that stands for `up_image`, exact on them
_MOST_AT_SIDES = 0.01  # part of the posterior that may lie within a step of a map's sides


@dataclass(frozen=True)
class LikelihoodMap:
    """Misfit of one image over the position of its spot, all else profiled out.

    Attributes
    ----------
    u_px, v_px : shapes (n,) and (m,), even steps, in the image
    misfit : shape (m, n), -2 log likelihood up to a constant
    """

    u_px: Array
    v_px: Array
    misfit: Array

    @property
    def least(self) -> float:
        """Smallest misfit on the nodes."""
        return float(self.misfit.min())


@dataclass(frozen=True)
class JointPosterior:
    """Posterior of one pair.

    Attributes
    ----------
    uv_down_px, uv_up_px : shape (2,), means
    covariance_down_px2, covariance_up_px2 : shape (2, 2)
    depth_m, sigma_m : float, mean and standard deviation of D
    interval_m : 2 floats, between which D lies with 95 %; 2.5 % on either side
    misfit : float
        By how much -2 log L of both images at one point exceeds that of the images separately: one degree of freedom.
    status : Status
        OK; NOT_CONVERGED where the maps do not hold the posterior; otherwise that of `depth_exact`.
    """

    uv_down_px: Array
    uv_up_px: Array
    covariance_down_px2: Array
    covariance_up_px2: Array
    depth_m: float
    sigma_m: float
    interval_m: tuple[float, float]
    misfit: float
    status: Status


def joint_posterior(rig: Rig, stroke_m: float, down: LikelihoodMap, up: LikelihoodMap) -> JointPosterior:
    """Posterior of the point behind two spots.

    Parameters
    ----------
    stroke_m : float, h
    down, up : LikelihoodMap
        That hold the positions with all that has a likelihood worth counting.
    """
    start = depth_exact(rig, stroke_m, _best(down), _best(up))
    if start.status != Status.OK:
        return _failed(Status(int(start.status)))
    box = _first_box(rig, stroke_m, down, up, 1.0 / float(start.depth_m))
    if box is None:
        return _failed(Status.DIVERGING)
    splines = _spline(down), _spline(up)
    for counts in (_COARSE, _COARSE):
        on = _evaluated(rig, stroke_m, down, up, splines, box, counts)
        if on is None:
            return _failed(Status.DIVERGING)
        box = _significant(on)
    on = _evaluated(rig, stroke_m, down, up, splines, box, _FINE)
    return _failed(Status.DIVERGING) if on is None else _moments(on)


@dataclass(frozen=True)
class _Grid:
    """Axes u, v, 1 / D; up positions, shape (2, i, j, k); misfits, shape (i, j, k), and whether a map ends there."""

    axes: list[Array]
    up_px: Array
    total: Array
    at_sides: NDArray[np.bool_]


def _evaluated(
    rig: Rig,
    stroke_m: float,
    down: LikelihoodMap,
    up: LikelihoodMap,
    splines: tuple[Array, Array],
    box: list[tuple[float, float]],
    counts: tuple[int, int, int],
) -> _Grid | None:
    """Misfits of both images on a grid; None where the up image shows nothing of it."""
    axes = [np.linspace(low, high, count) for (low, high), count in zip(box, counts, strict=True)]
    up_px = _up_positions(rig, stroke_m, axes)
    if up_px is None:
        return None
    total, at_sides = _misfits(down, up, splines, axes, up_px)
    return _Grid(axes, up_px, total, at_sides) if np.isfinite(total).any() else None


def single_posterior(one: LikelihoodMap) -> tuple[Array, Array] | None:
    """Mean (u, v), shape (2,), and covariance, shape (2, 2), of one image by itself; None beyond its map."""
    axes = [np.linspace(axis[0], axis[-1], _SINGLE * (len(axis) - 1) + 1) for axis in (one.u_px, one.v_px)]
    u, v = np.meshgrid(*axes, indexing="ij")
    above, within = _at(one, _spline(one), u, v)
    weight = np.exp(-0.5 * (above - float(above.min())))
    weight /= float(weight.sum())
    if float(weight[within < 1.0].sum()) > _MOST_AT_SIDES:
        return None
    places = np.stack([u.ravel(), v.ravel()])
    mean = places @ weight.ravel()
    off = places - mean[:, None]
    return mean, (off * weight.ravel()) @ off.T


def _best(one: LikelihoodMap) -> Array:
    row, column = np.unravel_index(int(np.argmin(one.misfit)), one.misfit.shape)
    return np.array([one.u_px[column], one.v_px[row]])


def _first_box(
    rig: Rig, stroke_m: float, down: LikelihoodMap, up: LikelihoodMap, q: float
) -> list[tuple[float, float]] | None:
    """Ends of u, v and 1 / D between which both maps have places."""
    image = up_image(rig, stroke_m, _best(down), q)
    if image.status != Status.OK:
        return None
    G = np.asarray(image.jacobian)
    extent = [np.array([np.ptp(image_map.u_px), np.ptp(image_map.v_px)]) for image_map in (down, up)]
    along = G[:, 2] / float(G[:, 2] @ G[:, 2])
    reach = float(np.abs(along) @ (extent[1] + np.abs(G[:, :2]) @ extent[0]))
    return [
        (float(down.u_px[0]), float(down.u_px[-1])),
        (float(down.v_px[0]), float(down.v_px[-1])),
        (max(q - reach, 1.0 / FARTHEST_M), q + reach),
    ]


def _up_positions(rig: Rig, stroke_m: float, axes: list[Array]) -> Array | None:
    """Up positions on the product of axes, shape (2, i, j, k), by a polynomial through some of them; None outside."""
    nodes = [_chebyshev(axis[0], axis[-1], count) for axis, count in zip(axes, _NODES, strict=True)]
    u, v, q = np.meshgrid(*nodes, indexing="ij")
    image = up_image(rig, stroke_m, np.stack([u, v], axis=-1), q)
    if (image.status != Status.OK).any():
        return None
    weights = [_lagrange(node, axis) for node, axis in zip(nodes, axes, strict=True)]
    return np.asarray(np.einsum("abcx,ia,jb,kc->xijk", image.uv_px, *weights, optimize=True))


def _chebyshev(low: float, high: float, count: int) -> Array:
    x = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    return np.asarray(0.5 * (low + high) + 0.5 * (high - low) * x)


def _lagrange(nodes: Array, x: Array) -> Array:
    """Value at x, shape (n,), of the polynomial that is 1 at one node and 0 at the others, shape (n, nodes)."""
    rows = [np.prod([(x - b) / (a - b) for k, b in enumerate(nodes) if k != i], axis=0) for i, a in enumerate(nodes)]
    return np.stack(rows, axis=1)


def _spline(one: LikelihoodMap) -> Array:
    """Spline of the root of the misfit, which is smooth where a spline of the misfit would swing beside steep walls."""
    above = np.minimum(one.misfit - one.least, _WALL)
    return np.asarray(spline_filter(np.sqrt(1.0 + above), order=3, mode="nearest"))


def _at(one: LikelihoodMap, spline: Array, u: Array, v: Array) -> tuple[Array, Array]:
    """Misfit above the least at places of one shape, and how many steps inside the map they lie."""
    column = (u - one.u_px[0]) / (one.u_px[1] - one.u_px[0])
    row = (v - one.v_px[0]) / (one.v_px[1] - one.v_px[0])
    within = np.minimum(np.minimum(column, len(one.u_px) - 1 - column), np.minimum(row, len(one.v_px) - 1 - row))
    places = np.stack([row.ravel(), column.ravel()])
    root = map_coordinates(spline, places, order=3, mode="nearest", prefilter=False).reshape(u.shape)
    return root**2 - 1.0, within


def _misfits(
    down: LikelihoodMap, up: LikelihoodMap, splines: tuple[Array, Array], axes: list[Array], up_px: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Misfit of both images, shape (i, j, k), infinite outside the up map; and what lies within a step of a side."""
    u, v = np.meshgrid(axes[0], axes[1], indexing="ij")
    first, off_down = _at(down, splines[0], u, v)
    second, off_up = _at(up, splines[1], up_px[0], up_px[1])
    total = np.where(off_up >= 0.0, first[:, :, None] + second, np.inf)
    return total, np.minimum(off_down[:, :, None], off_up) < 1.0


def _significant(on: _Grid) -> list[tuple[float, float]]:
    """Ends of the axes that hold all within the range of misfits, and a step more."""
    near = on.total < on.total.min() + MISFIT_RANGE
    box = []
    for i, axis in enumerate(on.axes):
        others = tuple(k for k in range(3) if k != i)
        index = np.flatnonzero(near.any(axis=others))
        low, high = max(index[0] - 1, 0), min(index[-1] + 1, len(axis) - 1)
        box.append((float(axis[low]), float(axis[high])))
    return box


def _moments(on: _Grid) -> JointPosterior:
    axes, up_px, total, at_sides = on.axes, on.up_px, on.total, on.at_sides
    least = float(total.min())
    weight = np.exp(-0.5 * (total - least))
    weight /= float(weight.sum())
    if float(weight[at_sides].sum()) > _MOST_AT_SIDES:
        return _failed(Status.NOT_CONVERGED)
    u, v, q = (weight.sum(axis=tuple(k for k in range(3) if k != i)) for i in range(3))
    plane = weight.sum(axis=2)
    mean = np.array([axes[0] @ u, axes[1] @ v])
    du, dv = axes[0] - mean[0], axes[1] - mean[1]
    mixed = float(du @ plane @ dv)
    C_down = np.array([[du**2 @ u, mixed], [mixed, dv**2 @ v]])
    flat = up_px.reshape(2, -1)
    up_mean = flat @ weight.ravel()
    off = flat - up_mean[:, None]
    C_up = (off * weight.ravel()) @ off.T
    depth = 1.0 / axes[2]
    mean_m = float(depth @ q)
    sigma_m = float(np.sqrt(np.maximum((depth - mean_m) ** 2 @ q, 0.0)))
    below = np.concatenate([[0.0], np.cumsum(0.5 * (q[1:] + q[:-1]))])
    # 1 / D falls with D: its upper quantile is the near end of the interval
    near, far = (1.0 / float(np.interp(p * below[-1], below, axes[2])) for p in (0.975, 0.025))
    return JointPosterior(mean, up_mean, C_down, C_up, mean_m, sigma_m, (near, far), least, Status.OK)


def _failed(status: Status) -> JointPosterior:
    two, four = np.full(2, np.nan), np.full((2, 2), np.nan)
    return JointPosterior(two, two, four, four, np.nan, np.nan, (np.nan, np.nan), np.nan, status)
