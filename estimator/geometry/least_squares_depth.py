"""Depth from two rays that need not meet, with everything that is uncertain, and a test whether they should meet.

Ray k (1 down, 2 up): X = P_k + t_k r_k, world frame. Pixels and rig parameters together, z, have a covariance C. The
two rays of the true z meet: the gap e(z), the signed length of their common perpendicular, is 0. The least-squares
solution moves z onto e = 0 by as little as C allows (condition equations; E. M. Mikhail, Observations and Least
Squares, 1976, ch. 9):

    z' = z - C e_z^T (e + e_z (z0 - z)) / (e_z C e_z^T),    chi^2 = e^2 / (e_z C e_z^T), one degree of freedom,

which is the weighted least-squares point in pixels, calibration included. D is then that of the meeting rays.
Everything is vectorised over leading axes that broadcast together.

D of two positions through the nominal rig, with its predicted error: of the pixels, and of a calibration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from phibench.estimator.geometry.paper_depth import PARALLEL_SINE
from phibench.estimator.geometry.reflection import reflect, reflect_jacobian
from phibench.estimator.geometry.rig_parameters import PARAMETERS, changed, steps, stroke_of
from phibench.estimator.geometry.status import (
    DepthEstimate,
    Status,
    StatusArray,
    first_fault,
    flag,
    keep,
    stroke_status,
)
from phibench.estimator.geometry.triangulate import depth_exact
from phibench.scenes.frames import Array
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


@dataclass(frozen=True)
class _Meeting:
    """Depth, gap and point for some z; gradients by z, last axis (u1, v1, u2, v2, parameters, stroke)."""

    depth: Array
    gap: Array
    point: Array
    status: StatusArray


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
    rig : Rig
    stroke_m : shape (...)
    uv_down_px, uv_up_px : shape (..., 2)
    covariance_down_px2, covariance_up_px2 : shape (..., 2, 2)
    covariance_rig : shape (p, p), optional
        Of `calibration.parameters.PARAMETERS`; none for an exact rig.
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
        chi2 = first.gap**2 / variance
        # the parameters' move is used to first order: rigs differ from one element to the next
        for _ in range(_ROUNDS):
            at = _meet(rig, h, z)
            remaining = at.gap + np.einsum("...i,...i->...", e_z, z0 - z)
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
        keep(at.depth, status),
        keep(sigma, status),
        status,
        spot,
        calibration,
        stroke,
        keep(at.point, status),
        keep(first.gap, status),
        keep(chi2, status),
        keep(p_value, status),
    )


def _joint(down_px2: Array, up_px2: Array, rig: Array, stroke_sigma_m: Array, lead: tuple[int, ...]) -> Array:
    """Block-diagonal covariance (..., n, n) of z."""
    p = len(rig)
    C = np.zeros((*lead, p + 5, p + 5))
    for start, block in ((0, down_px2), (2, up_px2), (4, rig)):
        block = np.asarray(block, float)
        stop = start + block.shape[-1]
        C[..., start:stop, start:stop] = block
    C[..., -1, -1] = stroke_sigma_m**2
    return C


def _part(g: Array, C: Array, part: slice) -> Array:
    return np.asarray(np.einsum("...i,...ij,...j->...", g[..., part], C[..., part, part], g[..., part]))


def _meet(rig: Rig, h: Array, z: Array) -> _Meeting:
    """Depth and gap for pixels z[:4]; a parameter that is not 0 enters by its gradient, see `_rig_gradients`."""
    offsets = z[..., 4:]
    base = _meet_exact(rig, h, z[..., :4])
    if not np.any(offsets):
        return base
    e_p, D_p, X_p = _rig_gradients(rig, h, z[..., :4])
    return _Meeting(
        base.depth + np.sum(D_p * offsets, axis=-1),
        base.gap + np.sum(e_p * offsets, axis=-1),
        base.point + np.einsum("...pi,...p->...i", X_p, offsets),
        base.status,
    )


def _gradients(rig: Rig, h: Array, z: Array) -> tuple[Array, Array]:
    """Derivatives of gap and depth by z, shape (..., n) each."""
    e_y, D_y = _pixel_gradients(rig, h, z[..., :4])
    e_p, D_p, _ = _rig_gradients(rig, h, z[..., :4])
    return np.concatenate([e_y, e_p], axis=-1), np.concatenate([D_y, D_p], axis=-1)


def _meet_exact(rig: Rig, h: Array, y: Array) -> _Meeting:
    view = rig.at(0.0)
    down, up = reflect(view, y[..., :2]), reflect(view, y[..., 2:4])
    P1, r1, r2 = down.origin_world_m, down.direction_world, up.direction_world
    P2 = up.origin_world_m + h[..., None] * np.array(rig.stroke_axis_world)
    t1, t2, gap, m, nn = _common_perpendicular(P2 - P1, r1, r2)
    X = P1 + t1[..., None] * r1 + 0.5 * gap[..., None] * m
    radial = X[..., :2] - view.sphere_centre_m[:2]
    meet = flag((nn < PARALLEL_SINE**2, Status.PARALLEL), (~((t1 > 0.0) & (t2 > 0.0)), Status.DIVERGING))
    status = first_fault(down.status, up.status, meet)
    return _Meeting(np.hypot(radial[..., 0], radial[..., 1]), gap, X, status)


def _common_perpendicular(w: Array, r1: Array, r2: Array) -> tuple[Array, Array, Array, Array, Array]:
    """t1, t2, e, unit m and |r1 x r2|^2 with t1 r1 + e m = w + t2 r2, w = P2 - P1."""
    n = np.cross(r1, r2)
    nn = np.sum(n * n, axis=-1)
    t1, t2 = (np.sum(np.cross(w, r) * n, axis=-1) / nn for r in (r2, r1))
    m = n / np.sqrt(nn)[..., None]
    return t1, t2, np.sum(w * m, axis=-1), m, nn


def _pixel_gradients(rig: Rig, h: Array, y: Array) -> tuple[Array, Array]:
    """Derivatives of e and D by (u1, v1, u2, v2), closed form.

    From t1 r1 + e m = w + t2 r2 by implicit differentiation: m . (dw + t2 dr2 - t1 dr1) = de, because m . dm = 0 and m
    stands on both rays; the two other components give dt1 and dt2.
    """
    view = rig.at(0.0)
    down, up = reflect(view, y[..., :2]), reflect(view, y[..., 2:4])
    J1, J2 = reflect_jacobian(view, y[..., :2]), reflect_jacobian(view, y[..., 2:4])
    r1, r2 = down.direction_world, up.direction_world
    w = up.origin_world_m + h[..., None] * np.array(rig.stroke_axis_world) - down.origin_world_m
    t1, t2, e, m, nn = _common_perpendicular(w, r1, r2)
    dP1, dr1 = (_padded(J, 0) for J in (J1.origin_m_per_px, J1.direction_per_px))
    dP2, dr2 = (_padded(J, 2) for J in (J2.origin_m_per_px, J2.direction_per_px))
    r1, r2, m, e = r1[..., None, :], r2[..., None, :], m[..., None, :], e[..., None]
    t1, t2, nn = t1[..., None], t2[..., None], nn[..., None]
    dn = np.cross(dr1, r2) + np.cross(r1, dr2)
    dm = (dn - np.sum(dn * m, axis=-1)[..., None] * m) / np.sqrt(nn)[..., None]
    rest = dP2 - dP1 + t2[..., None] * dr2 - t1[..., None] * dr1 - e[..., None] * dm  # = dt1 r1 - dt2 r2 + de m
    de = np.sum(rest * m, axis=-1)
    dt1 = np.sum(np.cross(rest, r2) * m, axis=-1) / np.sqrt(nn)
    dX = dP1 + dt1[..., None] * r1 + t1[..., None] * dr1 + 0.5 * (de[..., None] * m + e[..., None] * dm)
    X = down.origin_world_m + t1 * down.direction_world + 0.5 * e * m[..., 0, :]
    radial = X[..., :2] - view.sphere_centre_m[:2]
    D = np.hypot(radial[..., 0], radial[..., 1])
    return de, np.sum(dX[..., :2] * radial[..., None, :], axis=-1) / D[..., None]


def _rig_gradients(rig: Rig, h: Array, y: Array) -> tuple[Array, Array, Array]:
    """Derivatives of e, D and the point by the parameters and this pair's stroke, by central differences."""
    slopes: dict[str, list[Array]] = {"gap": [], "depth": [], "point": []}
    for i, size in enumerate(steps()):
        values = np.zeros(len(PARAMETERS))
        values[i] = size
        plus, minus = (_meet_exact(changed(rig, v), stroke_of(h, v), y) for v in (values, -values))
        for name, found in slopes.items():
            found.append((getattr(plus, name) - getattr(minus, name)) / (2.0 * size))
    own = PARAMETERS.index("stroke_m")
    gap, depth, point = (found + [found[own]] for found in slopes.values())
    return np.stack(gap, axis=-1), np.stack(depth, axis=-1), np.stack(point, axis=-2)


def _padded(jacobian: Array, start: int) -> Array:
    """Jacobian (..., 3, 2) as tangents (..., 4, 3) by (u1, v1, u2, v2)."""
    tangents = np.zeros((*jacobian.shape[:-2], 4, 3))
    tangents[..., start : start + 2, :] = np.swapaxes(jacobian, -1, -2)
    return tangents


_ROUND_PX2 = 0.1**2


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
    part = np.hypot(general.sigma_calibration_m, general.sigma_stroke_m)
    return NominalDepth(
        np.where(claimed, general.depth_m, plain.depth_m), general.sigma_m, np.where(claimed, part, unclaimed)
    )


def _calibration_sigma_m(rig: Rig, stroke_m: Array, uv_px: tuple[Array, Array], calibration: Array) -> Array:
    round_px2 = np.broadcast_to(_ROUND_PX2 * np.eye(2), (len(uv_px[0]), 2, 2))
    at = depth_general(rig, stroke_m, *uv_px, round_px2, round_px2, calibration)
    return np.hypot(at.sigma_calibration_m, at.sigma_stroke_m)
