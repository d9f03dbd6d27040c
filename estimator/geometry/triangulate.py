"""Exact depth: where the two rays that leave the mirror meet.

Ray k (1 down, 2 up): X = P_k + t_k r_k, world frame, metres. D is the horizontal distance of the point from the
vertical line through the sphere centre at the down position. Vectorised over leading axes that broadcast together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from phibench.estimator.geometry.paper_depth import PARALLEL_SINE
from phibench.estimator.geometry.reflection import reflect, reflect_jacobian
from phibench.estimator.geometry.status import (
    DepthEstimate,
    Status,
    StatusArray,
    first_fault,
    flag,
    keep,
    propagate,
    stroke_status,
)
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError

_ALIGNED_M = 1e-9  # camera, sphere centre and stroke axis count as vertical within this


@dataclass(frozen=True)
class PointEstimate(DepthEstimate):
    """A depth with the point it belongs to.

    Parameters
    ----------
    point_world_m : shape (..., 3), midpoint of the common perpendicular of the two rays
    gap_m : shape (...), length of that perpendicular: by how much the rays miss each other
    """

    point_world_m: Array
    gap_m: Array


@dataclass(frozen=True)
class _Rays:
    """P, r of both rays, shape (..., 3), and their derivatives by (u1, v1, u2, v2), shape (..., 4, 3)."""

    P1: Array
    r1: Array
    P2: Array
    r2: Array
    dP1: Array
    dr1: Array
    dP2: Array
    dr2: Array
    status: StatusArray


def depth_exact(
    rig: Rig,
    stroke_m: ArrayLike,
    uv_down_px: Array,
    uv_up_px: Array,
    covariance_down_px2: Array | None = None,
    covariance_up_px2: Array | None = None,
) -> PointEstimate:
    """Depth from the midpoint of the common perpendicular of the two reflected rays; for every rig.

    Parameters
    ----------
    rig : Rig
        One for both images, the one that is nominal: a motion between them (`rig.motion`) is not used.
    stroke_m : shape (...), h
    uv_down_px, uv_up_px : shape (..., 2), pixels
    covariance_down_px2, covariance_up_px2 : shape (..., 2, 2), of (u, v), independent of each other, both or none

    Returns
    -------
    PointEstimate
        sigma by the analytic derivatives of the point. The midpoint is the least-squares point for equal weights.
    """
    D, gradient, X, gap, status = _midpoint(rig, stroke_m, uv_down_px, uv_up_px)
    with np.errstate(all="ignore"):
        sigma = propagate(gradient, _joint_covariance(covariance_down_px2, covariance_up_px2))
    return PointEstimate(keep(D, status), keep(sigma, status), status, keep(X, status), keep(gap, status))


def exact_gradient(rig: Rig, stroke_m: ArrayLike, uv_down_px: Array, uv_up_px: Array) -> Array:
    """dD/d(u1, v1, u2, v2) of `depth_exact`, shape (..., 4), metres per pixel, analytic; NaN where D is."""
    _, gradient, _, _, status = _midpoint(rig, stroke_m, uv_down_px, uv_up_px)
    return keep(gradient, status)


def depth_in_plane(
    rig: Rig,
    stroke_m: ArrayLike,
    uv_down_px: Array,
    uv_up_px: Array,
    covariance_down_px2: Array | None = None,
    covariance_up_px2: Array | None = None,
) -> DepthEstimate:
    """Depth from the two rays' slopes in the vertical plane; the azimuths of the pixels are not used.

    With theta_k from the downward vertical and (rho_k, z_k) the reflection points,
    D = ((z_2 - z_1) sin theta_1 sin theta_2 + rho_2 cos theta_2 sin theta_1 - rho_1 cos theta_1 sin theta_2)
    / sin(theta_1 - theta_2): eq. (4) with rho_k in place of R sin(phi_k).

    Parameters and result as for `depth_exact`.

    Raises
    ------
    SceneError
        If camera centre, sphere centre and stroke axis do not lie on one vertical.
    """
    _require_aligned(rig)
    rays = _rays(rig, stroke_m, uv_down_px, uv_up_px)
    with np.errstate(all="ignore"):
        D, gradient, q, rho = _meet_in_plane(rays, rig.at(0.0).sphere_centre_m[:2])
        meet = flag((np.abs(q) < PARALLEL_SINE, Status.PARALLEL), (~(rho < D), Status.DIVERGING))
        status = first_fault(rays.status, meet)
        sigma = propagate(gradient, _joint_covariance(covariance_down_px2, covariance_up_px2))
    return DepthEstimate(keep(D, status), keep(sigma, status), status)


def _midpoint(
    rig: Rig, stroke_m: ArrayLike, uv_down_px: Array, uv_up_px: Array
) -> tuple[Array, Array, Array, Array, StatusArray]:
    """D, its gradient by the pixels, the midpoint, the gap, and the status."""
    rays = _rays(rig, stroke_m, uv_down_px, uv_up_px)
    with np.errstate(all="ignore"):
        w = rays.P2 - rays.P1
        n = np.cross(rays.r1, rays.r2)
        nn = np.sum(n * n, axis=-1)
        t1, t2 = (np.sum(np.cross(w, r) * n, axis=-1) / nn for r in (rays.r2, rays.r1))
        X = 0.5 * (rays.P1 + t1[..., None] * rays.r1 + rays.P2 + t2[..., None] * rays.r2)
        gap = np.abs(np.sum(w * n, axis=-1)) / np.sqrt(nn)
        radial = X[..., :2] - rig.at(0.0).sphere_centre_m[:2]
        D = np.hypot(radial[..., 0], radial[..., 1])
        dX = _midpoint_tangent(rays, w, n, nn, t1, t2)
        gradient = np.sum(dX[..., :2] * radial[..., None, :], axis=-1) / D[..., None]
        meet = flag((nn < PARALLEL_SINE**2, Status.PARALLEL), (~((t1 > 0.0) & (t2 > 0.0)), Status.DIVERGING))
    return D, gradient, X, gap, first_fault(rays.status, meet)


def _meet_in_plane(rays: _Rays, centre: Array) -> tuple[Array, Array, Array, Array]:
    """D = N / q, its gradient (..., 4) by the pixels, q, and the larger of the two rho."""
    rho1, drho1 = _length(rays.P1[..., :2] - centre, rays.dP1[..., :2])
    rho2, drho2 = _length(rays.P2[..., :2] - centre, rays.dP2[..., :2])
    S1, dS1 = _length(rays.r1[..., :2], rays.dr1[..., :2])
    S2, dS2 = _length(rays.r2[..., :2], rays.dr2[..., :2])
    C1, C2, dC1, dC2 = -rays.r1[..., 2], -rays.r2[..., 2], -rays.dr1[..., 2], -rays.dr2[..., 2]
    rise, drise = (rays.P2 - rays.P1)[..., 2], (rays.dP2 - rays.dP1)[..., 2]
    q = S1 * C2 - C1 * S2
    D = (rise * S1 * S2 + rho2 * C2 * S1 - rho1 * C1 * S2) / q
    # -- product rule, with an axis for the four pixel coordinates
    z, p1, p2, s1, s2, c1, c2, depth = (x[..., None] for x in (rise, rho1, rho2, S1, S2, C1, C2, D))
    dN = drise * s1 * s2 + drho2 * c2 * s1 - drho1 * c1 * s2
    dN += dS1 * (z * s2 + p2 * c2) + dS2 * (z * s1 - p1 * c1) + dC2 * p2 * s1 - dC1 * p1 * s2
    dq = dS1 * c2 + s1 * dC2 - dC1 * s2 - c1 * dS2
    return D, (dN - depth * dq) / q[..., None], q, np.maximum(rho1, rho2)


def _rays(rig: Rig, stroke_m: ArrayLike, uv_down_px: Array, uv_up_px: Array) -> _Rays:
    """Both reflected rays; a stroke moves origins along the axis and turns nothing."""
    view = rig.at(0.0)
    down, up = reflect(view, uv_down_px), reflect(view, uv_up_px)
    h = np.asarray(stroke_m, float)
    shift = h[..., None] * np.array(rig.stroke_axis_world)
    J1, J2 = reflect_jacobian(view, uv_down_px), reflect_jacobian(view, uv_up_px)
    return _Rays(
        down.origin_world_m,
        down.direction_world,
        up.origin_world_m + shift,
        up.direction_world,
        _columns(J1.origin_m_per_px, 0),
        _columns(J1.direction_per_px, 0),
        _columns(J2.origin_m_per_px, 2),
        _columns(J2.direction_per_px, 2),
        first_fault(down.status, up.status, stroke_status(h)),
    )


def _columns(jacobian: Array, start: int) -> Array:
    """Jacobian (..., 3, 2) as tangents (..., 4, 3) by (u1, v1, u2, v2), zero besides two rows from `start`."""
    tangents = np.zeros((*jacobian.shape[:-2], 4, 3))
    tangents[..., start : start + 2, :] = np.swapaxes(jacobian, -1, -2)
    return tangents


def _midpoint_tangent(rays: _Rays, w: Array, n: Array, nn: Array, t1: Array, t2: Array) -> Array:
    """Derivative of the midpoint by (u1, v1, u2, v2), shape (..., 4, 3): product rule, line by line."""
    r1, r2, w, n = (x[..., None, :] for x in (rays.r1, rays.r2, w, n))
    t1, t2, nn = (x[..., None] for x in (t1, t2, nn))
    dw = rays.dP2 - rays.dP1
    dn = np.cross(rays.dr1, r2) + np.cross(r1, rays.dr2)
    dnn = 2.0 * np.sum(n * dn, axis=-1)
    dt1 = (_triple(dw, r2, n) + _triple(w, rays.dr2, n) + _triple(w, r2, dn) - t1 * dnn) / nn
    dt2 = (_triple(dw, r1, n) + _triple(w, rays.dr1, n) + _triple(w, r1, dn) - t2 * dnn) / nn
    first = rays.dP1 + dt1[..., None] * r1 + t1[..., None] * rays.dr1
    second = rays.dP2 + dt2[..., None] * r2 + t2[..., None] * rays.dr2
    return 0.5 * (first + second)


def _triple(a: Array, b: Array, c: Array) -> Array:
    """(a x b) . c over the last axis."""
    return np.asarray(np.sum(np.cross(a, b) * c, axis=-1))


def _length(vector: Array, tangents: Array) -> tuple[Array, Array]:
    """Length (...) of vectors (..., 2) and its derivatives (..., 4) from tangents (..., 4, 2)."""
    length = np.hypot(vector[..., 0], vector[..., 1])
    return length, np.sum(vector[..., None, :] * tangents, axis=-1) / length[..., None]


def _joint_covariance(down_px2: Array | None, up_px2: Array | None) -> Array | None:
    """Block-diagonal covariance (..., 4, 4) of (u1, v1, u2, v2)."""
    if down_px2 is None and up_px2 is None:
        return None
    if down_px2 is None or up_px2 is None:
        raise ValueError("a pixel covariance is needed for both positions or for neither")
    down, up = np.asarray(down_px2, float), np.asarray(up_px2, float)
    joint = np.zeros((*np.broadcast_shapes(down.shape[:-2], up.shape[:-2]), 4, 4))
    joint[..., :2, :2] = down
    joint[..., 2:, 2:] = up
    return joint


def _require_aligned(rig: Rig) -> None:
    view = rig.at(0.0)
    offset = np.linalg.norm((view.sphere_centre_m - view.camera_centre_m)[:2])
    tilt = np.linalg.norm(rig.stroke_axis_world[:2])
    if offset > _ALIGNED_M or tilt > _ALIGNED_M or rig.stroke_axis_world[2] < 0.0:
        raise SceneError(
            f"depth_in_plane: sphere centre {offset:.2e} m beside the vertical through the camera, stroke axis tilted "
            f"by {tilt:.2e} rad; both must be below {_ALIGNED_M:g}. Use depth_exact for such a rig"
        )
