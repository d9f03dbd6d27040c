"""Depth from two reflected rays, the midpoint of their common perpendicular; and all estimators of D by name.

Ray k (1 down, 2 up) leaves the mirror at P_k with the direction r_k: X = P_k + t_k r_k, world frame, metres. Where a
glass tube is around the mirror, it leaves the glass at P_k. D is the
horizontal distance of the point from the vertical line through the sphere centre at the down position. Leading axes of
all arguments broadcast together. `least_squares_depth` takes the same rays and weighs them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from phibench.datasets.common.shown_text import ShortForm, short_text
from phibench.estimator.geometry.mirror_geometry import geometry_of
from phibench.estimator.geometry.paper_depth import PARALLEL_SINE, depth_approx
from phibench.estimator.geometry.phi import CONVENTIONS
from phibench.estimator.geometry.reflection import room_rays, room_rays_jacobian
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


@dataclass(frozen=True, repr=False)
class PointEstimate(ShortForm, DepthEstimate):
    """A depth with the point it belongs to.

    Parameters
    ----------
    point_world_m : array, shape (..., 3)
        Midpoint of the common perpendicular of the two rays.
    gap_m : array, shape (...)
        Length of that perpendicular: by how much the rays miss each other.
    """

    point_world_m: Array
    gap_m: Array

    def _shown(self) -> dict[str, Any]:
        states, counts = np.unique(self.status, return_counts=True)
        return {
            "depth D": f"{short_text(np.asarray(self.depth_m))} m",
            "sigma of D": f"{short_text(np.asarray(self.sigma_m))} m",
            "point": f"{short_text(np.asarray(self.point_world_m))} m",
            "gap": f"{short_text(np.asarray(self.gap_m))} m",
            "status": ", ".join(
                f"{Status(one).name}{f' {n}' if self.status.size > 1 else ''}"
                for one, n in zip(states.tolist(), counts.tolist(), strict=True)
            ),
        }


@dataclass(frozen=True)
class Meeting:
    """Midpoint of the common perpendicular of two rays.

    Parameters
    ----------
    depth_m : array, shape (...)
        D.
    gap_m : array, shape (...)
        Signed length of the perpendicular.
    point_world_m : array, shape (..., 3)
        The midpoint.
    status : array, shape (...)
        Of the rays and of their meeting.
    """

    depth_m: Array
    gap_m: Array
    point_world_m: Array
    status: StatusArray


@dataclass(frozen=True)
class _Rays:
    """Both rays, world frame, shape (..., 3)."""

    P1: Array
    r1: Array
    P2: Array
    r2: Array
    status: StatusArray


@dataclass(frozen=True)
class _Tangents:
    """Derivatives of `_Rays` by (u1, v1, u2, v2), shape (..., 4, 3)."""

    P1: Array
    r1: Array
    P2: Array
    r2: Array


@dataclass(frozen=True)
class _Perpendicular:
    """Common perpendicular: w = P2 - P1, n = r1 x r2, nn = n . n, and where on the rays its ends are."""

    w: Array
    n: Array
    nn: Array
    t1: Array
    t2: Array


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
        The nominal rig, one for both images: a motion between them (`rig.motion`) is not used.
    stroke_m : array, shape (...)
        Stroke h.
    uv_down_px, uv_up_px : array, shape (..., 2)
        Pixels.
    covariance_down_px2, covariance_up_px2 : array, shape (..., 2, 2)
        Of (u, v), independent of each other, both or none.

    Returns
    -------
    PointEstimate
        sigma by the analytic derivatives of the point. The midpoint is the least-squares point for equal weights.
    """
    at = meeting(rig, stroke_m, uv_down_px, uv_up_px)
    with np.errstate(all="ignore"):
        _, gradient = meeting_gradients(rig, stroke_m, uv_down_px, uv_up_px)
        sigma = propagate(gradient, _joint_covariance(covariance_down_px2, covariance_up_px2))
    depth, point, gap = (keep(x, at.status) for x in (at.depth_m, at.point_world_m, np.abs(at.gap_m)))
    return PointEstimate(depth, keep(sigma, at.status), at.status, point, gap)


def exact_gradient(rig: Rig, stroke_m: ArrayLike, uv_down_px: Array, uv_up_px: Array) -> Array:
    """dD/d(u1, v1, u2, v2) of `depth_exact`, shape (..., 4), metres per pixel, analytic; NaN where D is."""
    _, gradient = meeting_gradients(rig, stroke_m, uv_down_px, uv_up_px)
    return keep(gradient, meeting(rig, stroke_m, uv_down_px, uv_up_px).status)


def depth_of(rig: Rig, point_world_m: Array) -> tuple[float, Array]:
    """D of one point, and its derivative by the point, shape (3,)."""
    radial = point_world_m[:2] - rig.at(0.0).sphere_centre_m[:2]
    D = float(np.hypot(*radial))
    return D, np.array([*(radial / D), 0.0])


def meeting(rig: Rig, stroke_m: ArrayLike, uv_down_px: Array, uv_up_px: Array) -> Meeting:
    """Midpoint of the two rays, with values where the status is not OK, too."""
    rays = _rays(rig, stroke_m, uv_down_px, uv_up_px)
    with np.errstate(all="ignore"):
        at = _perpendicular(rays)
        X = _midpoint(rays, at)
        radial = X[..., :2] - rig.at(0.0).sphere_centre_m[:2]
        D = np.hypot(radial[..., 0], radial[..., 1])
        gap = np.sum(at.w * at.n, axis=-1) / np.sqrt(at.nn)
        behind = ~((at.t1 > 0.0) & (at.t2 > 0.0))
        # |r1 x r2| is the sine of the angle between the rays
        fault = flag((at.nn < PARALLEL_SINE**2, Status.PARALLEL), (behind, Status.DIVERGING))
    return Meeting(D, gap, X, first_fault(rays.status, fault))


def meeting_gradients(rig: Rig, stroke_m: ArrayLike, uv_down_px: Array, uv_up_px: Array) -> tuple[Array, Array]:
    """Derivatives of the signed gap and of D by (u1, v1, u2, v2), shape (..., 4) each, metres per pixel, analytic."""
    rays, d = _rays(rig, stroke_m, uv_down_px, uv_up_px), _tangents(rig, uv_down_px, uv_up_px)
    with np.errstate(all="ignore"):
        at = _perpendicular(rays)
        radial = _midpoint(rays, at)[..., :2] - rig.at(0.0).sphere_centre_m[:2]
        D = np.hypot(radial[..., 0], radial[..., 1])
        dX = _midpoint_tangent(rays, d, at)
        by_depth = np.sum(dX[..., :2] * radial[..., None, :], axis=-1) / D[..., None]
        # P2 + t2 r2 - P1 - t1 r1 = e m; m is a unit vector across both rays: m . dm = m . r1 = m . r2 = 0
        m = (at.n / np.sqrt(at.nn)[..., None])[..., None, :]
        t1, t2 = at.t1[..., None, None], at.t2[..., None, None]
        by_gap = np.sum((d.P2 - d.P1 + t2 * d.r2 - t1 * d.r1) * m, axis=-1)
    return by_gap, by_depth


def _rays(rig: Rig, stroke_m: ArrayLike, uv_down_px: Array, uv_up_px: Array) -> _Rays:
    """Both reflected rays; a stroke moves origins along the axis and turns nothing."""
    view, h = rig.at(0.0), np.asarray(stroke_m, float)
    down, up = room_rays(view, uv_down_px), room_rays(view, uv_up_px)
    raised = up.origin_world_m + h[..., None] * np.array(rig.stroke_axis_world)
    status = first_fault(down.status, up.status, stroke_status(h))
    return _Rays(down.origin_world_m, down.direction_world, raised, up.direction_world, status)


def _tangents(rig: Rig, uv_down_px: Array, uv_up_px: Array) -> _Tangents:
    J1, J2 = (room_rays_jacobian(rig.at(0.0), uv) for uv in (uv_down_px, uv_up_px))
    return _Tangents(
        _columns(J1.origin_m_per_px, 0),
        _columns(J1.direction_per_px, 0),
        _columns(J2.origin_m_per_px, 2),
        _columns(J2.direction_per_px, 2),
    )


def _columns(jacobian: Array, start: int) -> Array:
    """Jacobian (..., 3, 2) as tangents (..., 4, 3) by (u1, v1, u2, v2), zero besides two rows from `start`."""
    tangents = np.zeros((*jacobian.shape[:-2], 4, 3))
    tangents[..., start : start + 2, :] = np.swapaxes(jacobian, -1, -2)
    return tangents


def _perpendicular(rays: _Rays) -> _Perpendicular:
    w, n = rays.P2 - rays.P1, np.cross(rays.r1, rays.r2)
    nn = np.sum(n * n, axis=-1)
    # w x r_2 . n and w x r_1 . n over n . n: Cramer's rule for P1 + t1 r1 + e m = P2 + t2 r2
    t1, t2 = (np.sum(np.cross(w, r) * n, axis=-1) / nn for r in (rays.r2, rays.r1))
    return _Perpendicular(w, n, nn, t1, t2)


def _midpoint(rays: _Rays, at: _Perpendicular) -> Array:
    return 0.5 * (rays.P1 + at.t1[..., None] * rays.r1 + rays.P2 + at.t2[..., None] * rays.r2)


def _midpoint_tangent(rays: _Rays, d: _Tangents, at: _Perpendicular) -> Array:
    """Derivative of the midpoint by (u1, v1, u2, v2), shape (..., 4, 3): product rule, line by line."""
    r1, r2, w, n = (x[..., None, :] for x in (rays.r1, rays.r2, at.w, at.n))
    t1, t2, nn = (x[..., None] for x in (at.t1, at.t2, at.nn))
    dw = d.P2 - d.P1
    dn = np.cross(d.r1, r2) + np.cross(r1, d.r2)
    dnn = 2.0 * np.sum(n * dn, axis=-1)
    dt1 = (_triple(dw, r2, n) + _triple(w, d.r2, n) + _triple(w, r2, dn) - t1 * dnn) / nn
    dt2 = (_triple(dw, r1, n) + _triple(w, d.r1, n) + _triple(w, r1, dn) - t2 * dnn) / nn
    first = d.P1 + dt1[..., None] * r1 + t1[..., None] * d.r1
    second = d.P2 + dt2[..., None] * r2 + t2[..., None] * d.r2
    return 0.5 * (first + second)


def _triple(a: Array, b: Array, c: Array) -> Array:
    """(a x b) . c over the last axis."""
    return np.asarray(np.sum(np.cross(a, b) * c, axis=-1))


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


# Estimators by name.

Estimator = Callable[[Rig, float, Array, Array], DepthEstimate]


def paper_estimator(convention: str, rig: Rig, stroke_m: float, uv_down_px: Array, uv_up_px: Array) -> DepthEstimate:
    """Eq. (4) with phi in one convention; on a mirror of revolution, with its profile."""
    phi1, phi2 = _phis(convention, rig, stroke_m, uv_down_px, uv_up_px)
    return geometry_of(rig.mirror).paper_depth(phi1, phi2, stroke_m)


def approx_estimator(convention: str, rig: Rig, stroke_m: float, uv_down_px: Array, uv_up_px: Array) -> DepthEstimate:
    """Eq. (5) with phi in one convention."""
    phi1, phi2 = _phis(convention, rig, stroke_m, uv_down_px, uv_up_px)
    return depth_approx(phi1, phi2, stroke_m)


ESTIMATORS: dict[str, Estimator] = {
    **{f"paper_{name}": partial(paper_estimator, name) for name in CONVENTIONS},
    "approx_ray": partial(approx_estimator, "ray"),
    "exact": depth_exact,
}


def _phis(convention: str, rig: Rig, stroke_m: float, down_px: Array, up_px: Array) -> tuple[Array, Array]:
    phi = CONVENTIONS[convention]
    return phi(rig.at(0.0), down_px), phi(rig.at(stroke_m), up_px)
