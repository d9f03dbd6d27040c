"""Depth of an aligned rig by the slopes of its rays in the vertical plane: an oracle of `depth_exact`."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from phibench.estimator.geometry import triangulate
from phibench.estimator.geometry.paper_depth import PARALLEL_SINE
from phibench.estimator.geometry.status import DepthEstimate, Status, first_fault, flag, keep, propagate
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig
from phibench.scenes.validation import SceneError

_ALIGNED_M = 1e-9  # camera, sphere centre and stroke axis count as vertical within this


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
    rays = triangulate._rays(rig, stroke_m, uv_down_px, uv_up_px)
    tangents = triangulate._tangents(rig, uv_down_px, uv_up_px)
    with np.errstate(all="ignore"):
        D, gradient, q, rho = _meet_in_plane(rays, tangents, rig.at(0.0).sphere_centre_m[:2])
        meet = flag((np.abs(q) < PARALLEL_SINE, Status.PARALLEL), (~(rho < D), Status.DIVERGING))
        status = first_fault(rays.status, meet)
        sigma = propagate(gradient, triangulate._joint_covariance(covariance_down_px2, covariance_up_px2))
    return DepthEstimate(keep(D, status), keep(sigma, status), status)


def _meet_in_plane(
    rays: triangulate._Rays, d: triangulate._Tangents, centre: Array
) -> tuple[Array, Array, Array, Array]:
    """D = N / q, its gradient (..., 4) by the pixels, q, and the larger of the two rho."""
    rho1, drho1 = _length(rays.P1[..., :2] - centre, d.P1[..., :2])
    rho2, drho2 = _length(rays.P2[..., :2] - centre, d.P2[..., :2])
    S1, dS1 = _length(rays.r1[..., :2], d.r1[..., :2])
    S2, dS2 = _length(rays.r2[..., :2], d.r2[..., :2])
    C1, C2, dC1, dC2 = -rays.r1[..., 2], -rays.r2[..., 2], -d.r1[..., 2], -d.r2[..., 2]
    rise, drise = (rays.P2 - rays.P1)[..., 2], (d.P2 - d.P1)[..., 2]
    q = S1 * C2 - C1 * S2
    D = (rise * S1 * S2 + rho2 * C2 * S1 - rho1 * C1 * S2) / q
    # -- product rule, with an axis for the four pixel coordinates
    z, p1, p2, s1, s2, c1, c2, depth = (x[..., None] for x in (rise, rho1, rho2, S1, S2, C1, C2, D))
    dN = drise * s1 * s2 + drho2 * c2 * s1 - drho1 * c1 * s2
    dN += dS1 * (z * s2 + p2 * c2) + dS2 * (z * s1 - p1 * c1) + dC2 * p2 * s1 - dC1 * p1 * s2
    dq = dS1 * c2 + s1 * dC2 - dC1 * s2 - c1 * dS2
    return D, (dN - depth * dq) / q[..., None], q, np.maximum(rho1, rho2)


def _length(vector: Array, tangents: Array) -> tuple[Array, Array]:
    """Length (...) of vectors (..., 2) and its derivatives (..., 4) from tangents (..., 4, 2)."""
    length = np.hypot(vector[..., 0], vector[..., 1])
    return length, np.sum(vector[..., None, :] * tangents, axis=-1) / length[..., None]


def _require_aligned(rig: Rig) -> None:
    view = rig.at(0.0)
    offset = np.linalg.norm((view.sphere_centre_m - view.camera_centre_m)[:2])
    tilt = np.linalg.norm(rig.stroke_axis_world[:2])
    if offset > _ALIGNED_M or tilt > _ALIGNED_M or rig.stroke_axis_world[2] < 0.0:
        raise SceneError(
            f"depth_in_plane: sphere centre {offset:.2e} m beside the vertical through the camera, stroke axis tilted "
            f"by {tilt:.2e} rad; both must be below {_ALIGNED_M:g}. Use depth_exact for such a rig"
        )
