"""Circle of a ball, fitted to how the light falls across its limb in sectors; starts from a circle found by edges.

A wall that goes on in the mirror leaves no edge at the limb: reflectance rises to 1 there. The light falls smoothly
inside, and an edge detector takes the place of the steepest fall, pixels inside the limb. Here the light of each sector
is a + b d outside, and a + s + e T + f T^2 inside, blurred, with T the angle by which the mirror turns the ray
(`edge_ring`). Centre, radius and blur are those that leave least; a, b, s, e and f are each sector's own (variable
projection, G. H. Golub and V. Pereyra, 1973). Sectors that this describes badly count less.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage, optimize

from phibench.calibration.outline.edge_ring import Circle
from phibench.scenes.frames import Array, BoolArray

# each sector has a light of its own; groups of the jackknife hold five, so that what the room does to neighbours stays
# together
_SECTORS, _GROUPS = 60, 12
# of the window about the limb, of the unrolled picture, of its samples, of the blur's table
_HALF_PX, _REACH_PX, _STEP_PX, _FINE_PX = 14.0, 40.0, 0.5, 0.05
_STARTS = ((0.0, 1.2), (0.0, 3.0), (5.0, 1.2), (5.0, 3.0), (10.0, 3.0))  # of the radius and of the blur, pixels
_BLUR_PX = (0.4, 8.0)  # a pixel's own blur, and that of a limb far out of focus
_ROUNDS, _STEPS = 3, 30
_ROBUST = 2.0  # of the usual residual
_LEAST_SHARE = 0.5  # of the sectors, in the picture
_STRAY = 0.02  # of the bend of the brightest sectors
_NOISE = 2.0  # mean squares that the fit leaves: the bend of a sector's light must be more to tell a place
_RIDGE = 1e-9  # of the normal equations: a sector of even light does not tell its five terms apart


@dataclass(frozen=True)
class LimbCircle:
    """A circle by the fall of the light.

    Attributes
    ----------
    circle_px : centre (u, v) and radius
    covariance_px2 : array, shape (3, 3), of u, v, radius
        The jackknife's over twelve parts of the turn.
    gain : float
        Mean over the sectors of the logarithm of what is left at the circle by edges over what is left here.
    leverage : array, shape (3, 3), of u, v, radius
        What the dark parts of the turn add to the variances of an error that each part has for itself; 0 for none.
    """

    circle_px: Circle
    covariance_px2: Array = field(repr=False)
    gain: float
    leverage: Array = field(default_factory=lambda: np.zeros((3, 3)), repr=False)


@dataclass(frozen=True)
class _Polar:
    """Mean light of sectors at distances from a curve, shape (sectors, n)."""

    turn_rad: Array
    d_px: Array
    light: Array
    inside: BoolArray


def limb_circle(light: Array, near: Circle, ellipse_px: tuple[float, float]) -> LimbCircle | None:
    """Circle within some pixels of another one; None where half of it is outside the picture.

    Parameters
    ----------
    light : array, shape (H, W), linear
    near : Circle
    ellipse_px : e1, e2 of r(t) = r + e1 cos 2t + e2 sin 2t, kept
    """
    polar = _polar(light, near, ellipse_px)
    if polar.inside.mean() < _LEAST_SHARE:
        return None
    fits = [_fit(polar, near[2], start) for start in _STARTS]
    best = min(fits, key=lambda one: one.left(polar).sum())
    theta = best.theta
    circle = (near[0] + float(theta[1]), near[1] + float(theta[2]), near[2] + float(theta[0]))
    gain = float(np.mean(_left_at(polar, near[2]) - best.left(polar)))
    return LimbCircle(circle, best.covariance(), gain, _leverage(polar, best))


def _leverage(polar: _Polar, fit: _Fit) -> Array:
    """Inverse of the mean of c c^T over the sectors by what their light tells, less that of a whole turn.

    Half a turn gives centre and radius only together: what the model errs there is several times as large in each.
    """
    window = np.abs(polar.d_px) <= _HALF_PX
    straight = np.stack([np.ones(int(window.sum())), polar.d_px[window]], axis=1)
    y = polar.light[:, window].T
    bent = np.square(y - straight @ np.linalg.lstsq(straight, y)[0]).mean(axis=0)
    # codes and JPEG round dark parts, and the light of bright ones strays into them
    left = np.square(fit.residual).mean(axis=1) + _STRAY**2 * float(np.quantile(bent, 0.9))
    told = polar.inside * np.clip(1.0 - _NOISE * left / np.maximum(bent, 1e-30), 0.0, 1.0)
    told = np.minimum(told / max(float(np.quantile(told, 0.8)), 1e-9), 1.0)
    C = np.stack([np.cos(polar.turn_rad), np.sin(polar.turn_rad), np.ones(_SECTORS)], axis=1)
    lit = np.linalg.inv((C.T * told) @ C / _SECTORS + 1e-6 * np.eye(3))
    return np.asarray(lit - np.diag([2.0, 2.0, 1.0]))


def _polar(light: Array, circle: Circle, ellipse_px: tuple[float, float]) -> _Polar:
    u, v, radius = circle
    parts = max(1, math.ceil(2.0 * np.pi * radius / _SECTORS))
    t = (np.arange(_SECTORS * parts) + 0.5) / (_SECTORS * parts) * 2.0 * np.pi
    d = np.arange(-_REACH_PX, _REACH_PX + _STEP_PX / 2.0, _STEP_PX)
    r = radius + d + (ellipse_px[0] * np.cos(2.0 * t) + ellipse_px[1] * np.sin(2.0 * t))[:, None]
    uu, vv = u + r * np.cos(t)[:, None], v + r * np.sin(t)[:, None]
    planes = ndimage.map_coordinates(light, [vv, uu], order=1, mode="nearest")
    rows, columns = light.shape
    near = np.abs(d) <= _HALF_PX + _STARTS[-1][0]
    there = ((uu > 2.0) & (uu < columns - 3.0) & (vv > 2.0) & (vv < rows - 3.0))[:, near].all(axis=1)
    turn = (np.arange(_SECTORS) + 0.5) / _SECTORS * 2.0 * np.pi
    shape = (_SECTORS, parts, len(d))
    return _Polar(turn, d, planes.reshape(shape).mean(axis=1), there.reshape(_SECTORS, parts).all(axis=1))


def _basis(x: Array, radius_px: float, blur_px: float) -> Array:
    """Blurred 1, d outside, step, T and T^2 at distances from the limb, shape (..., 5)."""
    # whole steps from 0: a table that moved with x would have a jump in place of a derivative
    steps = math.ceil((float(np.abs(x).max()) + 6.0 * blur_px) / _FINE_PX)
    d = np.arange(-steps, steps + 1) * _FINE_PX
    T = 2.0 * np.arccos(np.clip(1.0 + d / radius_px, 0.0, 1.0))
    sharp = np.stack([np.ones_like(d), np.maximum(d, 0.0), (d < 0.0).astype(float), T, T * T])
    soft = ndimage.gaussian_filter1d(sharp, blur_px / _FINE_PX, axis=1, mode="nearest")
    return np.stack([np.interp(x, d, row) for row in soft], axis=-1)


def _residual(y: Array, basis: Array) -> Array:
    """Light that the best coefficients of each sector leave, shape (sectors, n)."""
    turned = np.swapaxes(basis, -1, -2)
    normal = turned @ basis
    size = np.trace(normal, axis1=-2, axis2=-1)[:, None, None]
    coefficients = np.linalg.solve(normal + _RIDGE * size * np.eye(basis.shape[-1]), turned @ y[..., None])
    return np.asarray(y - (basis @ coefficients)[..., 0])


def _log_rms(residual: Array) -> Array:
    return np.asarray(0.5 * np.log(np.maximum(np.square(residual).mean(axis=1), 1e-30)))  # a flat sector leaves nothing


def _left_at(polar: _Polar, radius_px: float) -> Array:
    """Logarithm of what sectors leave with the limb at distance 0, with the best blur, of those in the picture."""
    window = np.abs(polar.d_px) <= _HALF_PX
    y, x = polar.light[:, window], polar.d_px[window]
    blurs = np.geomspace(0.7, 6.0, 8)
    left = [_log_rms(_residual(y, np.broadcast_to(_basis(x, radius_px, b), (*y.shape, 5)))) for b in blurs]
    inside = np.array(left)[:, polar.inside]
    return np.asarray(inside[int(np.argmin(np.median(inside, axis=1)))])


@dataclass(frozen=True)
class _Fit:
    theta: Array  # radius, u, v, logarithm of the blur
    residual: Array
    jacobian: Array
    weighted: Array

    def left(self, polar: _Polar) -> Array:
        """Logarithm of what the sectors in the picture leave."""
        return _log_rms(self.residual)[polar.inside]

    def covariance(self) -> Array:
        """Jackknife over parts of the turn, of u, v, radius, shape (3, 3)."""
        J = self.jacobian.reshape(_SECTORS, -1, len(self.theta))
        r = self.weighted.reshape(_SECTORS, -1)
        A, b = np.einsum("knp,knq->kpq", J, J), np.einsum("knp,kn->kp", J, r)
        left = []
        for group in range(_GROUPS):
            kept = np.arange(_SECTORS) * _GROUPS // _SECTORS != group
            left.append(np.linalg.lstsq(A[kept].sum(axis=0), b[kept].sum(axis=0), rcond=None)[0])
        spread = np.array(left)[:, [1, 2, 0]]
        spread = spread - spread.mean(axis=0)
        return np.asarray((_GROUPS - 1) / _GROUPS * spread.T @ spread)


def _fit(polar: _Polar, radius_px: float, start: tuple[float, float]) -> _Fit:
    theta = np.array([start[0], 0.0, 0.0, math.log(start[1])])
    C = np.stack([np.ones(_SECTORS), np.cos(polar.turn_rad), np.sin(polar.turn_rad)], axis=1)
    window = np.arange(-_HALF_PX, _HALF_PX + _STEP_PX / 2.0, _STEP_PX)
    for _ in range(_ROUNDS):
        place = np.rint(((C @ theta[:3])[:, None] + window - polar.d_px[0]) / _STEP_PX).astype(int)
        place = np.clip(place, 0, len(polar.d_px) - 1)
        y, d = np.take_along_axis(polar.light, place, axis=1), polar.d_px[place]

        def left(p: Array, y: Array = y, d: Array = d) -> Array:
            blur = float(np.clip(math.exp(min(p[3], 5.0)), *_BLUR_PX))
            return _residual(y, _basis(d - (C @ p[:3])[:, None], radius_px + float(p[0]), blur))

        rms = np.exp(_log_rms(left(theta)))
        usual = float(np.median(rms[polar.inside]))
        weight = polar.inside / np.maximum(np.hypot(rms, 0.5 * usual), 1e-15)  # half of the usual one: no sector rules

        def weighted(p: Array, weight: Array = weight, left: Callable[[Array], Array] = left) -> Array:
            return np.asarray((left(p) * weight[:, None]).ravel())

        solution = optimize.least_squares(
            weighted, theta, loss="soft_l1", f_scale=_ROBUST, x_scale=[1.0, 1.0, 1.0, 0.3], max_nfev=_STEPS
        )
        theta = solution.x
    return _Fit(theta, left(theta), solution.jac, solution.fun)
