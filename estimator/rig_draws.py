"""What the tolerance of a rig does to D beyond first order: rigs drawn in pairs of opposite deviations.

The error of D of a rig that deviates by p is e(p) = g p + p H p / 2 + third order + ... Of the pair p, -p, half the sum
of both errors is the even part, to which the linear prediction is blind, and half the difference is the odd part: the
linear one with the third order. The even part matters where the linear part passes through 0: a tilt of half a degree
does so near h = 0.3 D; the third order adds 28 % to the linear part at D = 2.18 m, h = 0.45 m and takes 14 % off at
1.4 m. The even part is no scatter about 0: its mean, some -40 mm for a rig as built at D = 2.18 m and h = 0.9 m, is a
bias of `depth_general`, which takes D at the believed rig.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.stats import qmc

from phibench.estimator.calibration.parameters import PARAMETERS, changed, stroke_of
from phibench.estimator.depth_general import depth_general
from phibench.estimator.mirror_image import image_of
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

_PAIRS = 32  # within 2.5 % of what 128 give
_STEP = 0.1  # of a sigma, for first derivatives: third order is then 1 % of what it is at one sigma
_SEED = 0  # the scramble is part of the rule, not a noise draw
_LOG_STEP = 0.35  # the part is smooth in the logarithm of the stroke: interpolated between


def covariance_root(covariance: Array) -> Array:
    """Matrix A with A A^T = C, shape (p, p), of a covariance that may be singular and has mixed units."""
    scale = np.sqrt(np.diag(covariance))
    safe = np.where(scale > 0.0, scale, 1.0)
    value, vector = np.linalg.eigh(covariance / np.outer(safe, safe))
    return np.asarray(safe[:, None] * vector * np.sqrt(np.maximum(value, 0.0)))


def beyond_first_order_m(
    rig: Rig,
    strokes_m: Array,
    points_m: Array,
    covariance_down_px2: Array,
    covariance_up_px2: Array,
    covariance_rig: Array,
    stroke_sigma_m: float,
) -> Array:
    """What the mean square error of D over rigs and points has beyond first order, shape (n,); its root, metres.

    Even part squared, bias included, plus odd part squared less linear part squared of the same rigs; 0 where the
    higher orders make the error smaller than the linear one.

    Parameters
    ----------
    rig : Rig, the believed one
    strokes_m : shape (n,), rising
    points_m : shape (m, 3)
    covariance_down_px2, covariance_up_px2 : shapes (1 or n, m, 2, 2)
    covariance_rig : shape (p, p)
    stroke_sigma_m : float
    """
    if not np.any(covariance_rig):
        return np.zeros(len(strokes_m))
    chosen = _chosen(strokes_m)
    h, up_px2 = strokes_m[chosen], np.broadcast_to(covariance_up_px2, (len(strokes_m), *covariance_up_px2.shape[1:]))
    root, normals = covariance_root(covariance_rig), _normals(_PAIRS)
    deviations = np.concatenate([normals @ root.T, _STEP * root.T])
    seen = [_seen(rig, v, h, points_m) for v in (*deviations, *-deviations)]
    down, up, true = (np.stack(column) for column in zip(*seen, strict=True))
    C_down, C_up = covariance_down_px2, up_px2[chosen]
    found = depth_general(rig, h[:, None], down, up, C_down, C_up, covariance_rig, np.asarray(stroke_sigma_m))
    square_m2 = _between(strokes_m, h, _beyond_m2(found.depth_m - true, normals))
    return np.asarray(np.sqrt(np.maximum(square_m2, 0.0)))


def _beyond_m2(errors_m: Array, normals: Array) -> Array:
    """Mean square beyond first order, shape (n,), of errors (2 (k + p), n, m): rigs, steps, and their opposites."""
    plus, minus = np.split(errors_m, 2)
    even, odd = 0.5 * (plus + minus), 0.5 * (plus - minus)
    k = len(normals)
    linear = np.einsum("kp,pnm->knm", normals, odd[k:] / _STEP)
    return np.asarray(np.mean(even[:k] ** 2 + odd[:k] ** 2 - linear**2, axis=(0, 2)))


def _between(strokes_m: Array, known_m: Array, values: Array) -> Array:
    """Values at strokes, from those at known ones, smoothly in the logarithm; NaN beyond the finite ones."""
    finite = np.isfinite(values)
    if finite.sum() < 2:  # nothing to interpolate between
        return np.where(np.isin(strokes_m, known_m[finite]), values[finite].sum(), np.nan)
    smooth = PchipInterpolator(np.log(known_m[finite]), values[finite], extrapolate=False)
    return np.asarray(smooth(np.log(strokes_m)))


def _seen(rig: Rig, values: Array, strokes_m: Array, points_m: Array) -> tuple[Array, Array, Array]:
    """Down pixels (1, m, 2), up pixels (n, m, 2) and true D (1, m) of a rig that deviates."""
    true = changed(rig, values)
    view, axis = true.at(0.0), np.array(true.stroke_axis_world)
    offsets = stroke_of(strokes_m, values)
    lowered = points_m - offsets[:, None, None] * axis
    up = image_of(view, lowered).uv_px
    down = np.broadcast_to(image_of(view, points_m).uv_px, up.shape)
    away = points_m[:, :2] - view.sphere_centre_m[:2]
    return down, up, np.hypot(away[:, 0], away[:, 1])[None]


def _chosen(strokes_m: Array) -> NDArray[np.int64]:
    """Indices of strokes of which no two neighbours are further apart than the step, the ends among them."""
    goals = np.arange(np.log(strokes_m[0]), np.log(strokes_m[-1]), _LOG_STEP)
    nearest = np.searchsorted(np.log(strokes_m), goals, side="right") - 1
    return np.unique([*nearest.tolist(), 0, len(strokes_m) - 1]).astype(np.int64)


@lru_cache(maxsize=1)
def _normals(count: int) -> Array:
    """Quasi-random normal numbers, shape (count, p)."""
    p = len(PARAMETERS)
    engine = qmc.Sobol(p, scramble=True, rng=_SEED)
    return np.asarray(qmc.MultivariateNormalQMC(np.zeros(p), engine=engine, rng=_SEED).random(count))
