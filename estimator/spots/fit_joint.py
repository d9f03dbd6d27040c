"""Joint maximum likelihood of both images (down, up) of a pair on raw pixels: one point of the room behind two spots.

Unknowns psi: u, v in the down image, 1 / D, then of the down and of the up image the flux and the background levels.
The fluxes are free, because speckle makes those of two exposures differ. The up position follows from `up_image`.
Fisher scoring is of the sum of both images' log likelihoods. Each image offers the minima that nine starts lead to, and
the constraint picks among the pairs of them: on a Bayer grid a faint spot has several.

Unknowns theta of one image: u, v of the whole image, flux, levels.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phibench.estimator.geometry.epipolar_line import up_image
from phibench.estimator.geometry.least_squares_depth import combine
from phibench.estimator.geometry.status import DepthEstimate, Status, StatusArray, first_fault, flag, keep
from phibench.estimator.spots.fit_raw import AT_ONCE, DAMPING, DECREMENT, LEAST_SNR, START_PX, SpotData
from phibench.estimator.spots.gaussian_spot import covariance_bound, limited_step, scoring_step
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig

_SCREENING_STEPS = 8
_BEST_MINIMA = 3  # of each image, whose pairs are tried
_PAIRS = 2  # that are followed to the end
_INVERSE_DEPTH_CHANGE = (0.5, 2.0)  # of 1 / D in one step


@dataclass(frozen=True)
class JointFit(DepthEstimate):
    """Joint fits of n pairs; NaN where the status is not OK.

    Parameters
    ----------
    uv_down_px, uv_up_px : shape (n, 2)
    covariance_down_px2, covariance_up_px2 : shape (n, 2, 2), under the constraint
    chi2 : shape (n,)
        By how much -2 log L exceeds that of the images fitted separately: one degree of freedom; large where the two
        spots are not one point, or the rig differs from the nominal one.
    """

    uv_down_px: Array
    uv_up_px: Array
    covariance_down_px2: Array
    covariance_up_px2: Array
    chi2: Array


@dataclass(frozen=True)
class _Minima:
    """Best minima of one image's misfit: theta (n, m, k), covariance (n, m, 2, 2), misfit (n, m)."""

    theta: Array
    covariance: Array
    value: Array


def fit_joint(
    rig: Rig, stroke_m: ArrayLike, down: SpotData, up: SpotData, start_down_px: Array, start_up_px: Array
) -> JointFit:
    """Fit both images of each pair together.

    Parameters
    ----------
    stroke_m : float or shape (n,), h
    down, up : SpotData, n each
        Of `spot_data`, with Gaussian laws, unknown levels and known widths.
    start_down_px, start_up_px : shape (n, 2)
        Positions within about a pixel, of a detection or of `fit_raw`.

    Returns
    -------
    JointFit
        Status NOT_FINITE, PARALLEL or DIVERGING (no pair of minima meets in front of the mirror), NO_SPOT (a flux
        below `LEAST_SNR` standard deviations), SPOT_CUT (outside a region), NOT_CONVERGED.

    Raises
    ------
    ValueError
        If there are not as many regions of one image as of the other.
    """
    n = len(down)
    if len(up) != n:
        raise ValueError(f"{n} regions of the down images and {len(up)} of the up images: one of each is needed a pair")
    h = np.broadcast_to(np.asarray(stroke_m, float), (n,))
    starts = [np.broadcast_to(np.asarray(start, float), (n, 2)) for start in (start_down_px, start_up_px)]
    parts = [np.arange(i, min(i + AT_ONCE, n)) for i in range(0, max(n, 1), AT_ONCE)]
    with np.errstate(all="ignore"):
        fits = [_fit(rig, h[p], down.rows(p), up.rows(p), starts[0][p], starts[1][p]) for p in parts]
    return JointFit(*(np.concatenate([getattr(fit, f.name) for fit in fits]) for f in fields(JointFit)))


def _fit(rig: Rig, h: Array, down: SpotData, up: SpotData, start_down: Array, start_up: Array) -> JointFit:
    first, second = _minima(down, start_down), _minima(up, start_up)
    best: Array | None = None
    for psi in _pairs(rig, h, first, second):
        psi, converged, value = _polished(rig, h, down, up, psi)
        state = np.column_stack([psi, converged, value])
        best = state if best is None else np.where((value < best[:, -1])[:, None], state, best)
    assert best is not None, "there is one pair at least"
    separate = first.value[:, 0] + second.value[:, 0]
    return _result(rig, h, down, up, best[:, :-2], best[:, -2] > 0.0, best[:, -1] - separate)


# -- one image -------------------------------------------------------------------------------------------------------


def _minima(data: SpotData, start_px: Array) -> _Minima:
    """Minima that nine starts lead to, the deepest first; several may be the same."""
    n, k = len(data), data.unknowns
    grid = START_PX * np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1)), -1).reshape(-1, 2)
    many = data.rows(np.repeat(np.arange(n), len(grid)))
    theta = np.repeat(_guess(data, start_px), len(grid), axis=0)
    theta[:, :2] += np.tile(grid, (n, 1))
    for _ in range(_SCREENING_STEPS):
        theta = _step(theta, *_scores(many, theta))
    value = many.misfit(_in_region(many, theta)).reshape(n, -1)
    order = np.argsort(value, axis=1)[:, :_BEST_MINIMA]
    each = np.arange(n)[:, None]
    best = theta.reshape(n, -1, k)[each, order]
    flat = data.rows(np.repeat(np.arange(n), order.shape[1]))
    polished = best.reshape(-1, k)
    for _ in range(_SCREENING_STEPS):
        polished = _step(polished, *_scores(flat, polished))
    _, fisher = _scores(flat, polished)
    shape = (n, order.shape[1])
    covariance = covariance_bound(fisher).reshape(*shape, 2, 2)
    values = flat.misfit(_in_region(flat, polished)).reshape(shape)
    again = np.argsort(values, axis=1)
    return _Minima(polished.reshape(*shape, k)[each, again], covariance[each, again], values[each, again])


def _guess(data: SpotData, start_px: Array) -> Array:
    """Position as given; background: median per level; flux: what is above it, three standard deviations at least."""
    regions, pixels = data.regions, data.pixels
    above, levels = regions.x_e.copy(), []
    for i in range(pixels.levels.shape[1]):
        mask = regions.used & (pixels.levels[:, i] > 0.0)
        level = np.nanmedian(np.where(mask, regions.x_e, np.nan), axis=(1, 2))
        levels.append(np.nan_to_num(level))
        above -= levels[-1][:, None, None] * pixels.levels[:, i]
    seen = regions.used * pixels.response
    share = np.sum(seen, axis=(1, 2)) / np.maximum(np.sum(regions.used, axis=(1, 2)), 1)
    # a start: a flux of 0 has no derivative by the position
    flux = np.maximum(np.sum(regions.used * above * pixels.response, axis=(1, 2)) / np.maximum(share, 1e-6), 100.0)
    return np.column_stack([start_px, flux, *levels])


def _scores(data: SpotData, theta: Array) -> tuple[Array, Array]:
    """Score, shape (n, k), and Fisher matrix, shape (n, k, k)."""
    mean, derivatives = data.pixels.at(_in_region(data, theta))
    n, k = theta.shape
    weight = data.regions.used * data.law.information(mean)
    flat = derivatives.reshape(n, k, -1)
    weighted = flat * weight.reshape(n, 1, -1)
    score = (weighted @ (data.regions.x_e - mean).reshape(n, -1, 1))[..., 0]
    return score, weighted @ np.swapaxes(flat, 1, 2)


def _in_region(data: SpotData, theta: Array) -> Array:
    """Unknowns with the position from the region's first pixel."""
    return np.column_stack([theta[:, :2] - data.regions.origin_px, theta[:, 2:]])


def _step(theta: Array, score: Array, fisher: Array) -> Array:
    """One limited step of Fisher scoring."""
    return limited_step(theta, scoring_step(fisher, score))


# -- both images: psi = u, v, 1 / D, flux and levels of the down image, flux and levels of the up image --------------


def _pairs(rig: Rig, h: Array, down: _Minima, up: _Minima) -> list[Array]:
    """Starts psi of the pairs of minima with the least misfit and chi^2 together."""
    n, m = down.value.shape
    one, two = (i.ravel() for i in np.meshgrid(np.arange(m), np.arange(m), indexing="ij"))
    joint = combine(
        rig, h[:, None], down.theta[:, one, :2], down.covariance[:, one], up.theta[:, two, :2], up.covariance[:, two]
    )
    total = down.value[:, one] + up.value[:, two] + np.where(np.isfinite(joint.chi2), joint.chi2, np.inf)
    order = np.argsort(total, axis=1, kind="stable")[:, :_PAIRS]
    each = np.arange(n)
    starts = []
    for pick in order.T:
        q = 1.0 / joint.depth_m[each, pick]
        parts = (joint.uv_down_px[each, pick], q, down.theta[each, one[pick], 2:], up.theta[each, two[pick], 2:])
        starts.append(np.column_stack(parts))
    return starts


def _split(rig: Rig, h: Array, psi: Array, k: int) -> tuple[Array, Array, Array, StatusArray]:
    """Unknowns of the down and the up image, the up position's derivatives, and a status."""
    image = up_image(rig, h, psi[:, :2], psi[:, 2])
    down = np.column_stack([psi[:, :2], psi[:, 3 : k + 1]])
    return down, np.column_stack([image.uv_px, psi[:, k + 1 :]]), image.jacobian, image.status


def _joint_scores(rig: Rig, h: Array, down: SpotData, up: SpotData, psi: Array) -> tuple[Array, Array, Array]:
    """Score and Fisher matrix of psi by the chain rule, and the up position's derivatives."""
    k = down.unknowns
    theta_down, theta_up, G, _ = _split(rig, h, psi, k)
    s1, F1 = _scores(down, theta_down)
    s2, F2 = _scores(up, theta_up)
    A, B = np.zeros((len(psi), k, psi.shape[1])), np.zeros((len(psi), up.unknowns, psi.shape[1]))
    A[:, [0, 1], [0, 1]] = 1.0
    A[:, np.arange(2, k), np.arange(3, k + 1)] = 1.0
    B[:, :2, :3] = G
    B[:, np.arange(2, up.unknowns), np.arange(k + 1, psi.shape[1])] = 1.0
    At, Bt = np.swapaxes(A, 1, 2), np.swapaxes(B, 1, 2)
    score = (At @ s1[..., None] + Bt @ s2[..., None])[..., 0]
    return score, At @ F1 @ A + Bt @ F2 @ B, G


def _joint_misfit(rig: Rig, h: Array, down: SpotData, up: SpotData, psi: Array) -> Array:
    theta_down, theta_up, _, _ = _split(rig, h, psi, down.unknowns)
    return down.misfit(_in_region(down, theta_down)) + up.misfit(_in_region(up, theta_up))


def _polished(rig: Rig, h: Array, down: SpotData, up: SpotData, psi: Array) -> tuple[Array, BoolArray, Array]:
    """Go on until the step is small against the standard deviation; psi, whether it is, and the misfit."""
    psi, moving = psi.copy(), np.flatnonzero(np.isfinite(psi).all(axis=1))
    done = np.zeros(len(psi), bool)
    for damping in DAMPING:
        if moving.size == 0:
            break
        score, fisher, G = _joint_scores(rig, h[moving], down.rows(moving), up.rows(moving), psi[moving])
        step = scoring_step(fisher, score)
        small = np.sum(step * score, axis=1) < DECREMENT
        psi[moving] = _limited(psi[moving], step, G, damping, down.unknowns)
        done[moving[small]] = True
        moving = moving[~small]
    return psi, done, _joint_misfit(rig, h, down, up, psi)


def _limited(psi: Array, step: Array, G: Array, damping: float, k: int) -> Array:
    """Psi after a step that moves neither spot by more than half a pixel."""
    up_px = np.einsum("nij,nj->ni", np.nan_to_num(G), step[:, :3])
    largest = np.maximum(np.abs(step[:, :2]).max(axis=1), np.abs(up_px).max(axis=1))
    new = limited_step(psi, step, damping, moved_px=largest, fluxes=(3, k + 1))
    low, high = (change * psi[:, 2] for change in _INVERSE_DEPTH_CHANGE)
    new[:, 2] = np.clip(new[:, 2], low, high)
    return new


def _result(
    rig: Rig, h: Array, down: SpotData, up: SpotData, psi: Array, converged: BoolArray, chi2: Array
) -> JointFit:
    k = down.unknowns
    theta_down, theta_up, G, geometry = _split(rig, h, psi, k)
    _, fisher, _ = _joint_scores(rig, h, down, up, psi)
    C = covariance_bound(np.nan_to_num(fisher), keep=psi.shape[1])
    q, C3 = psi[:, 2], C[:, :3, :3]
    sure = (psi[:, 3] > LEAST_SNR * np.sqrt(C[:, 3, 3])) & (psi[:, k + 1] > LEAST_SNR * np.sqrt(C[:, k + 1, k + 1]))
    status = first_fault(
        flag((~np.isfinite(psi).all(axis=1), Status.NOT_FINITE)),
        geometry,
        flag(
            (~sure, Status.NO_SPOT),
            (~(_inside(down, theta_down) & _inside(up, theta_up)), Status.SPOT_CUT),
            (~converged, Status.NOT_CONVERGED),
        ),
    )
    C_up = G @ C3 @ np.swapaxes(G, 1, 2)
    sigma = np.sqrt(C3[:, 2, 2]) / (q * q)
    values = (1.0 / q, sigma, psi[:, :2], theta_up[:, :2], C3[:, :2, :2], C_up, chi2)
    depth, sigma, *rest = (keep(value, status) for value in values)
    return JointFit(depth, sigma, status, *rest)


def _inside(data: SpotData, theta: Array) -> NDArray[np.bool_]:
    """Positions that lie in their regions, shape (n,), bool."""
    h, w = data.regions.x_e.shape[1:]
    middle = data.regions.origin_px + np.array([(w - 1) / 2, (h - 1) / 2])
    return np.asarray((np.abs(theta[:, :2] - middle) <= np.array([w, h]) / 2).all(axis=1))
