"""Depth from two spots by weighted least squares with rig errors; both positions combined on the epipolar line; bound.

Ray k (1 down, 2 up): X = P_k + t_k r_k, world frame. Pixels and rig parameters together, z, have a covariance C. The
two rays of the true z meet: the gap e(z), the signed length of their common perpendicular, is 0. The least-squares
solution moves z onto e = 0 by as little as C allows (condition equations; E. M. Mikhail, Observations and Least
Squares, 1976, ch. 9):

    z' = z - C e_z^T (e + e_z (z0 - z)) / (e_z C e_z^T),    chi^2 = e^2 / (e_z C e_z^T), one degree of freedom.

This is the weighted least-squares point in pixels, calibration included. D is that of the meeting rays. Leading axes of
all arguments broadcast together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from phibench.estimator.geometry.epipolar_line import up_image
from phibench.estimator.geometry.rig_parameters import PARAMETERS, changed_rig, difference_steps, moves_rays, stroke_of
from phibench.estimator.geometry.status import DepthEstimate, Status, first_fault, flag, keep, stroke_status
from phibench.estimator.geometry.triangulate import Meeting, depth_exact, meeting, meeting_gradients
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig

_ROUNDS = 3  # the condition is nearly linear: the second moves the pixels by less than 1e-6 of the first


@dataclass(frozen=True)
class GeneralDepth(DepthEstimate):
    """A depth with the parts of its uncertainty and the test of the two rays.

    Attributes
    ----------
    sigma_spot_m, sigma_calibration_m, sigma_stroke_m : shape (...)
        Parts of `sigma_m`, from the pixels, the rig's parameters and this pair's stroke; their squares add up.
    point_world_m : shape (..., 3)
    gap_m : shape (...), e before the adjustment, signed
    chi2 : shape (...), one degree of freedom
    p_value : shape (...), probability of a larger chi2 for a rig as good as claimed
    """

    sigma_spot_m: Array
    sigma_calibration_m: Array
    sigma_stroke_m: Array
    point_world_m: Array
    gap_m: Array
    chi2: Array
    p_value: Array


def depth_general(
    rig: Rig,
    stroke_m: ArrayLike,
    uv_down_px: Array,
    uv_up_px: Array,
    covariance_down_px2: Array,
    covariance_up_px2: Array,
    covariance_rig: Array | None = None,
    stroke_sigma_m: ArrayLike = 0.0,
) -> GeneralDepth:
    """Depth by weighted least squares, for every rig.

    Parameters
    ----------
    stroke_m : shape (...)
    uv_down_px, uv_up_px : shape (..., 2)
    covariance_down_px2, covariance_up_px2 : shape (..., 2, 2)
    covariance_rig : shape (p, p), optional
        Of `rig_parameters.PARAMETERS`; none for an exact rig.
    stroke_sigma_m : shape (...)
        Of this pair's stroke, besides what the parameters say of all strokes.

    Raises
    ------
    ValueError
        If a covariance has another shape.
    """
    h = np.asarray(stroke_m, float)
    C_rig = np.zeros((len(PARAMETERS),) * 2) if covariance_rig is None else np.asarray(covariance_rig, float)
    if C_rig.shape != (len(PARAMETERS),) * 2:
        raise ValueError(f"covariance_rig has the shape {C_rig.shape}: {len(PARAMETERS)} parameters, see PARAMETERS")
    y = np.concatenate(np.broadcast_arrays(np.asarray(uv_down_px, float), np.asarray(uv_up_px, float)), axis=-1)
    lead = np.broadcast_shapes(y.shape[:-1], h.shape)
    C = _joint(covariance_down_px2, covariance_up_px2, C_rig, np.asarray(stroke_sigma_m, float), lead)
    with np.errstate(all="ignore"):
        z0 = np.zeros((*lead, C.shape[-1]))
        z0[..., :4] = y
        z, first = z0, _meet(rig, h, z0)
        e_z, D_z = _gradients(rig, h, z)
        variance = np.einsum("...i,...ij,...j->...", e_z, C, e_z)
        chi2 = first.gap_m**2 / variance
        # the parameters' move is used to first order: rigs differ from one element to the next
        for _ in range(_ROUNDS):
            at = _meet(rig, h, z)
            remaining = at.gap_m + np.einsum("...i,...i->...", e_z, z0 - z)
            variance = np.einsum("...i,...ij,...j->...", e_z, C, e_z)
            z = z0 - np.einsum("...ij,...j->...i", C, e_z) * (remaining / variance)[..., None]
            if not np.any(np.isfinite(remaining)):
                break
            e_z, D_z = _gradients(rig, h, z)
        at = _meet(rig, h, z)
        variance = np.einsum("...i,...ij,...j->...", e_z, C, e_z)
        # D' = D(z'): its gradient by the data z0
        gain = np.einsum("...i,...ij,...j->...", D_z, C, e_z) / variance
        g = D_z - gain[..., None] * e_z
        parts = [_part(g, C, part) for part in (slice(0, 4), slice(4, -1), slice(-1, None))]
        sigma = np.sqrt(sum(parts))
    status = first_fault(first.status, at.status, stroke_status(h))
    spot, calibration, stroke = (keep(np.sqrt(part), status) for part in parts)
    p_value = special.erfc(np.sqrt(chi2 / 2.0))
    return GeneralDepth(
        keep(at.depth_m, status),
        keep(sigma, status),
        status,
        spot,
        calibration,
        stroke,
        keep(at.point_world_m, status),
        keep(first.gap_m, status),
        keep(chi2, status),
        keep(p_value, status),
    )


_ROUND_PX2 = 0.1**2  # of the round spots that stand for those of a method without a covariance


@dataclass(frozen=True)
class NominalDepth:
    """Depths, shape (n,), NaN where there is none.

    Attributes
    ----------
    depth_m, sigma_m : shape (n,)
        All of the predicted error; NaN where no covariance of the pixels is claimed.
    calibration_sigma_m : shape (n,)
        The calibration's part of it at these pixels, whatever the pixels' covariance; 0 for a rig that counts as exact.
    """

    depth_m: Array
    sigma_m: Array
    calibration_sigma_m: Array


def nominal_depth(
    rig: Rig,
    stroke_m: Array,
    uv_px: tuple[Array, Array],
    covariance_px2: tuple[Array, Array],
    calibration: Array | None,
) -> NominalDepth:
    """Depths of pairs of positions, shape (n, 2) each.

    Without a calibration the rays' midpoint; with one the weighted point of `depth_general`, and the midpoint where no
    covariance is claimed.
    """
    plain = depth_exact(rig, stroke_m, *uv_px, *covariance_px2)
    if calibration is None:
        return NominalDepth(plain.depth_m, plain.sigma_m, np.zeros_like(plain.depth_m))
    (down, up), (C1, C2) = uv_px, covariance_px2
    general = depth_general(rig, stroke_m, down, up, C1, C2, calibration)
    claimed = np.isfinite(general.sigma_m)
    # equal weights where there is no claim: the calibration's part is then that of round spots of one size
    unclaimed = _calibration_sigma_m(rig, stroke_m, uv_px, calibration)
    rig_sigma_m = np.hypot(general.sigma_calibration_m, general.sigma_stroke_m)
    return NominalDepth(
        np.where(claimed, general.depth_m, plain.depth_m), general.sigma_m, np.where(claimed, rig_sigma_m, unclaimed)
    )


def _calibration_sigma_m(rig: Rig, stroke_m: Array, uv_px: tuple[Array, Array], calibration: Array) -> Array:
    round_px2 = np.broadcast_to(_ROUND_PX2 * np.eye(2), (len(uv_px[0]), 2, 2))
    at = depth_general(rig, stroke_m, *uv_px, round_px2, round_px2, calibration)
    return np.hypot(at.sigma_calibration_m, at.sigma_stroke_m)


def _joint(down_px2: Array, up_px2: Array, rig: Array, stroke_sigma_m: Array, lead: tuple[int, ...]) -> Array:
    """Block-diagonal covariance (..., n, n) of z."""
    p = len(rig)
    C = np.zeros((*lead, p + 5, p + 5))  # two pixels of two images, p of the rig, and the stroke
    for start, block in ((0, down_px2), (2, up_px2), (4, rig)):
        block = np.asarray(block, float)
        stop = start + block.shape[-1]
        C[..., start:stop, start:stop] = block
    C[..., -1, -1] = stroke_sigma_m**2
    return C


def _part(g: Array, C: Array, part: slice) -> Array:
    return np.asarray(np.einsum("...i,...ij,...j->...", g[..., part], C[..., part, part], g[..., part]))


def _meet(rig: Rig, h: Array, z: Array) -> Meeting:
    """Meeting for pixels z[:4]; a parameter that is not 0 enters by its gradient, see `_rig_gradients`."""
    offsets = z[..., 4:]
    base = meeting(rig, h, z[..., :2], z[..., 2:4])
    if not np.any(offsets):
        return base
    e_p, D_p, X_p = _rig_gradients(rig, h, z)
    return Meeting(
        base.depth_m + np.sum(D_p * offsets, axis=-1),
        base.gap_m + np.sum(e_p * offsets, axis=-1),
        base.point_world_m + np.einsum("...pi,...p->...i", X_p, offsets),
        base.status,
    )


def _gradients(rig: Rig, h: Array, z: Array) -> tuple[Array, Array]:
    """Derivatives of gap and depth by z, shape (..., n) each."""
    e_y, D_y = meeting_gradients(rig, h, z[..., :2], z[..., 2:4])
    e_p, D_p, _ = _rig_gradients(rig, h, z)
    return np.concatenate([e_y, e_p], axis=-1), np.concatenate([D_y, D_p], axis=-1)


def _rig_gradients(rig: Rig, h: Array, z: Array) -> tuple[Array, Array, Array]:
    """Derivatives of gap, D and point by the parameters and this pair's stroke, by central differences."""
    slopes: dict[str, list[Array]] = {"gap_m": [], "depth_m": [], "point_world_m": []}
    moving = moves_rays(rig)
    for i, size in enumerate(difference_steps()):
        if not moving[i]:
            for name, found in slopes.items():
                found.append(np.zeros_like(slopes[name][0]))  # the first, a stroke, moves rays of every rig
            continue
        values = np.zeros(len(PARAMETERS))
        values[i] = size
        plus, minus = (
            meeting(changed_rig(rig, v), stroke_of(h, v), z[..., :2], z[..., 2:4]) for v in (values, -values)
        )
        for name, found in slopes.items():
            found.append((getattr(plus, name) - getattr(minus, name)) / (2.0 * size))
    own = PARAMETERS.index("stroke_offset_m")
    gap, depth, point = (found + [found[own]] for found in slopes.values())
    return np.stack(gap, axis=-1), np.stack(depth, axis=-1), np.stack(point, axis=-2)


# Depth from a position and its covariance in each image, by generalised least squares under the epipolar constraint.
#
# Four coordinates stand against three unknowns: u and v of the down image, and 1 / D. The chi^2 of the one degree of
# freedom tests for one common point. `triangulate.depth_exact` takes the midpoint of the rays instead, where geometry
# weighs the coordinates, not their errors.


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
