"""Depth from a position and its covariance in each image, by generalised least squares under the epipolar constraint.

Four coordinates stand against three unknowns: u and v of the down image, and 1 / D. The chi^2 of the one degree of
freedom tests for one common point. `triangulate.depth_exact` takes the midpoint of the rays instead, where geometry
weighs the coordinates, not their errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from phibench.estimator.geometry.mirror_image import up_image
from phibench.estimator.geometry.status import DepthEstimate, Status, first_fault, flag, keep
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig

_STEPS = 30  # of Gauss-Newton: a start of D that is off by a factor 2^n takes n of them
_DECREMENT = 1e-16  # squared distance from the minimum in standard deviations
_FACTOR = 2.0  # by which 1 / D may change in a step


@dataclass(frozen=True)
class CombinedEstimate(DepthEstimate):
    """A depth with the positions that fit to it.

    Parameters
    ----------
    uv_down_px, uv_up_px : shape (..., 2)
    covariance_down_px2, covariance_up_px2 : shape (..., 2, 2)
        Of the positions under the constraint; the up position's is singular in no direction that the data leave free.
    chi2 : shape (...), one degree of freedom
    """

    uv_down_px: Array
    uv_up_px: Array
    covariance_down_px2: Array
    covariance_up_px2: Array
    chi2: Array


def combine(
    rig: Rig,
    stroke_m: ArrayLike,
    uv_down_px: Array,
    covariance_down_px2: Array,
    uv_up_px: Array,
    covariance_up_px2: Array,
) -> CombinedEstimate:
    """Combine the answers of any method for both images.

    Parameters
    ----------
    rig : Rig
    stroke_m : shape (...), h
    uv_down_px, uv_up_px : shape (..., 2)
    covariance_down_px2, covariance_up_px2 : shape (..., 2, 2), independent of each other

    Returns
    -------
    CombinedEstimate
        Status of `depth_exact`, from which it starts; NOT_FINITE for a covariance without inverse, NOT_CONVERGED.
    """
    shape = np.broadcast_shapes(np.shape(stroke_m), np.shape(uv_down_px)[:-1], np.shape(uv_up_px)[:-1])
    h = np.broadcast_to(np.asarray(stroke_m, float), shape)
    down, up = (np.broadcast_to(np.asarray(uv, float), (*shape, 2)) for uv in (uv_down_px, uv_up_px))
    start = depth_exact(rig, h, down, up)
    with np.errstate(all="ignore"):
        W1, W2 = information(covariance_down_px2), information(covariance_up_px2)
        uv, q, converged = _minimised(rig, h, down, up, W1, W2, 1.0 / start.depth_m)
        image = up_image(rig, h, uv, q)
        C = np.linalg.inv(_invertible(joint_information(W1, W2, image.jacobian)))
        chi2 = _quadratic(W1, down - uv) + _quadratic(W2, up - image.uv_px)
    bad = ~(np.isfinite(W1).all(axis=(-1, -2)) & np.isfinite(W2).all(axis=(-1, -2)))
    status = first_fault(
        start.status, flag((bad, Status.NOT_FINITE)), image.status, flag((~converged, Status.NOT_CONVERGED))
    )
    G = image.jacobian
    values = (1.0 / q, np.sqrt(C[..., 2, 2]) / (q * q), uv, image.uv_px, C[..., :2, :2], G @ C @ _t(G), chi2)
    depth, sigma, uv1, uv2, C1, C2, misfit = (keep(np.asarray(value), status) for value in values)
    return CombinedEstimate(depth, sigma, status, uv1, uv2, C1, C2, misfit)


@dataclass(frozen=True)
class JointBound:
    """Bound of a pair whose two spots are one point of the room: three unknowns, (u, v) of the down image and 1 / D.

    Attributes
    ----------
    covariance_down_px2, covariance_up_px2 : shape (..., 2, 2), of (u, v)
    variance_depth_m2 : shape (...), of D
    information : shape (..., 3, 3), of (u, v, 1 / D): W1 + G^T W2 G
    jacobian : shape (..., 2, 3), G: derivatives of the up position by the three
    """

    covariance_down_px2: Array
    covariance_up_px2: Array
    variance_depth_m2: Array
    information: Array
    jacobian: Array


def joint_bound(
    rig: Rig,
    stroke_m: ArrayLike,
    uv_down_px: Array,
    depth_m: ArrayLike,
    covariance_down_px2: Array,
    covariance_up_px2: Array,
) -> JointBound:
    """Bound of both positions and of D when the epipolar constraint is used; NaN where there is none.

    The covariances are bounds of (u, v) with flux and background unknown; these are the images' own, so that the
    information of both about (u, v, 1 / D) adds. No part is above the bound of `limits.position_bound.depth_limit` and
    of the single images, which takes the four coordinates for four unknowns.
    """
    q = 1.0 / np.asarray(depth_m, float)
    G = up_image(rig, stroke_m, uv_down_px, q).jacobian
    W1, W2 = information(covariance_down_px2), information(covariance_up_px2)
    A = _invertible(joint_information(W1, W2, G))
    C = np.linalg.inv(A)
    down, up, variance = (np.asarray(x, float) for x in (C[..., :2, :2], G @ C @ _t(G), C[..., 2, 2] / q**4))
    return JointBound(down, up, variance, A, G)


def information(covariance: Array) -> Array:
    """Inverse of covariances, shape (..., 2, 2); NaN where there is none."""
    C = np.asarray(covariance, float)
    with np.errstate(all="ignore"):
        good = np.isfinite(C).all(axis=(-1, -2)) & (np.linalg.det(np.nan_to_num(C)) > 0.0)
    inverse = np.linalg.inv(np.where(good[..., None, None], C, np.eye(C.shape[-1])))
    return np.where(good[..., None, None], inverse, np.nan)


def joint_information(down: Array, up: Array, jacobian: Array) -> Array:
    """Information about (u, v, 1 / D), shape (..., 3, 3), from that about the positions, shape (..., 2, 2)."""
    joint = _t(jacobian) @ up @ jacobian
    joint[..., :2, :2] += down
    return joint


def _minimised(
    rig: Rig, h: Array, down: Array, up: Array, W1: Array, W2: Array, q: Array
) -> tuple[Array, Array, BoolArray]:
    """Gauss-Newton from the down position and the midpoint's depth: (u, v), 1 / D and whether it came to rest."""
    uv, q = down.copy(), np.array(q)
    decrement = np.full(q.shape, np.inf)
    for _ in range(_STEPS):
        image = up_image(rig, h, uv, q)
        A = joint_information(W1, W2, image.jacobian)
        b = _apply(_t(image.jacobian) @ W2, up - image.uv_px)
        b[..., :2] += _apply(W1, down - uv)
        step = np.linalg.solve(_invertible(A), b[..., None])[..., 0]
        uv, q = uv + step[..., :2], np.clip(q + step[..., 2], q / _FACTOR, q * _FACTOR)
        # -2 b is the gradient of chi^2: step . b is the squared distance from the minimum in standard deviations
        decrement = np.sum(step * b, axis=-1)
        if not np.any(decrement > _DECREMENT):
            break
    # rounding may hold the last step above `_DECREMENT`; 1e-12 is still a millionth of a standard deviation
    return uv, q, np.asarray(decrement < 1e4 * _DECREMENT)


def _quadratic(W: Array, x: Array) -> Array:
    return np.asarray(np.einsum("...i,...ij,...j->...", x, W, x))


def _apply(M: Array, x: Array) -> Array:
    return np.asarray((M @ x[..., None])[..., 0])


def _t(M: Array) -> Array:
    return np.asarray(np.swapaxes(M, -1, -2))


def _invertible(M: Array) -> Array:
    """The matrices, and one of NaN for those that have no inverse, which stop no others."""
    finite = np.asarray(np.isfinite(M).all(axis=(-1, -2)))
    good = np.asarray(finite & (np.abs(np.linalg.det(np.where(finite[..., None, None], M, 0.0))) > 0.0))
    return np.where(good[..., None, None], M, np.nan)
