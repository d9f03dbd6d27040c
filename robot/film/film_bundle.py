"""Joint fit of one point and the carriage's offset in every frame of a film; outlier frames, and the expected sigma.

Unknowns are the point X and the offset p_k of each frame. Data are the positions (u, v)_k with the covariance of all
frames, pattern included, and the encoder's readings e_k = p_k + noise. An offset moves the point in the rig's frame by
-p a, a the stroke axis. The encoder's noise is so small that the image is linear in it. Offsets are therefore taken out
in closed form: the positions' covariance becomes

    S = C + J_p sigma^2 J_p^T + J_rig C_rig J_rig^T,    J_p = -du/dX a,

and X follows by generalised least squares. The offsets are e + sigma^2 J_p^T S^-1 (y - u(X)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.reflection import image_of
from phibench.estimator.geometry.rig_parameters import PARAMETERS, STROKE_PARAMETERS
from phibench.estimator.geometry.status import depth_interval
from phibench.estimator.geometry.triangulate import depth_exact, depth_of
from phibench.robot.film.film_positions import FilmPositions
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.misalignment import PARAMETERS as MISALIGNMENT
from phibench.scenes.rig import Rig

_STEPS = 30  # of Gauss and Newton; it ends at `_SETTLED_M`
_SETTLED_M = 1e-9  # of the point: far below any sigma
_LEAST_STROKE_M = 1e-3  # as a recipe's: what moves by less gives no depth
_PROPOSE = 8  # frames at each end: half of them may be astray, and one pair in four is right
_AGREE_PX = 3.0  # a faint spot behind a mosaic settles up to a pixel of its filter away


@dataclass(frozen=True)
class FilmDepth:
    """Point and depth from a film.

    Attributes
    ----------
    point_world_m : array, shape (3,)
    covariance_m2 : array, shape (3, 3)
    depth_m, sigma_m : float
        D and its standard deviation.
    offsets_m, offset_sigma_m : arrays, shape (N,)
        Carriage in every frame that has a position, after the fit.
    chi2 : float
        Sum of squares of the positions, with 2 N - 3 degrees of freedom.
    frames : int
        N.
    by_rig_m : array, shape (p,)
        Derivatives of D by `rig_parameters.PARAMETERS`, with which errors of one rig are common to several depths; 0
        for an exact rig.
    places_px : array, shape (all frames, 2)
        Fitted places y - C S^-1 (y - u(X)): the point's image, moved by what rig and carriage deviate by. NaN where
        there is no position.
    """

    point_world_m: Array
    covariance_m2: Array
    depth_m: float
    sigma_m: float
    offsets_m: Array
    offset_sigma_m: Array
    chi2: float
    frames: int
    by_rig_m: Array
    places_px: Array

    @property
    def interval_m(self) -> tuple[float, float]:
        """Ends in metres between which D lies with 95 %: `depth_interval`."""
        return depth_interval(self.depth_m, self.sigma_m)


def film_depth(
    rig: Rig,
    positions: FilmPositions,
    encoder_m: Array,
    encoder_sigma_m: float | Array,
    covariance_rig: Array | None = None,
) -> FilmDepth:
    """Fit the point of a film.

    Parameters
    ----------
    rig : Rig
        Nominal, or calibrated.
    encoder_m : array, shape (N,)
        Reading of the carriage at the time at which the spot's row was exposed.
    encoder_sigma_m : float, or array of shape (N,)
        Of a reading, vibration along the stroke included.
    covariance_rig : array, shape (p, p), optional
        Of `rig_parameters.PARAMETERS`.

    Raises
    ------
    DatasetError
        If fewer than two frames have a position, or the carriage does not move.
    """
    keep = np.flatnonzero(positions.good)
    readings = np.asarray(encoder_m, float)[keep]
    # depth comes from the stroke alone: frames of one offset give a direction
    if len(keep) < 2 or np.ptp(readings) < _LEAST_STROKE_M:
        raise DatasetError(
            f"film of {len(keep)} positions over {np.ptp(readings) if len(keep) else 0.0:.4f} m of the stroke: two "
            f"positions that are {_LEAST_STROKE_M:g} m apart are the least that give a depth"
        )
    few, sigma_m = positions.some(keep), np.broadcast_to(encoder_sigma_m, positions.good.shape)[keep]
    C, y = few.covariance_px2(), few.uv_px.ravel()
    X = _start(rig, few, readings)
    for _ in range(_STEPS):
        at = _predicted(rig, X, readings)
        S = cho_factor(_total(rig, X, readings, C, at.by_offset, sigma_m, covariance_rig))
        # normal equations with the covariance of positions, encoder and rig together
        information = at.by_point.T @ cho_solve(S, at.by_point)
        step = np.linalg.solve(information, at.by_point.T @ cho_solve(S, y - at.uv))
        # nearly all of a step is along the line of sight: half of the distance at most
        far = float(np.linalg.norm(X - rig.at(0.0).sphere_centre_m))
        X = X + step * min(1.0, 0.5 * far / max(float(np.linalg.norm(step)), 1e-12))  # no step: no division by 0
        if float(np.linalg.norm(step)) < _SETTLED_M:
            break
    places = np.full(positions.uv_px.shape, np.nan)
    # best estimate of each image place: the measured one, moved by its own share of the misfit
    places[keep] = (y - C @ cho_solve(S, y - _predicted(rig, X, readings).uv)).reshape(-1, 2)
    return _result(rig, X, readings, y, S, sigma_m, covariance_rig is not None, places)


def consensus_frames(rig: Rig, positions: FilmPositions, encoder_m: Array) -> BoolArray:
    """Frames whose positions agree with the point that most of them agree with, shape (N,).

    A fit of one frame may settle anywhere within reach. Each of some frames low on the stroke gives a point with each
    of some frames high on it; the point with the least mean distance, cut at a few pixels, counts.
    """
    good = np.flatnonzero(positions.good)
    if not len(good):
        return positions.good
    uv, readings = positions.uv_px[good], np.asarray(encoder_m, float)[good]
    order, third = np.argsort(readings), max(1, len(good) // 3)
    # the lowest and the highest third of the readings: long strokes tell the depth best
    low, high = (some[np.linspace(0, third - 1, _PROPOSE).astype(int)] for some in (order[:third], order[-third:]))
    pairs = np.array([(i, j) for i in low for j in high if readings[j] - readings[i] > _LEAST_STROKE_M], np.int64)
    if not len(pairs):
        return positions.good
    i, j = pairs.T
    axis = np.array(rig.stroke_axis_world)
    X = depth_exact(rig, readings[j] - readings[i], uv[i], uv[j]).point_world_m + readings[i, None] * axis
    at = image_of(rig.at(0.0), X[:, None] - readings[None, :, None] * axis).uv_px
    apart = np.nan_to_num(np.linalg.norm(at - uv, axis=2), nan=np.inf)
    # a cut-off distance: one frame far astray counts no more than one beyond the limit
    best = apart[np.argmin(np.minimum(apart, _AGREE_PX).mean(axis=1))]
    result = np.zeros(len(positions.uv_px), bool)
    result[good[best < _AGREE_PX]] = True
    return result if result.any() else positions.good


def deviations2(
    rig: Rig,
    point_world_m: Array,
    positions: FilmPositions,
    encoder_m: Array,
    encoder_sigma_m: float | Array,
    covariance_rig: Array | None = None,
) -> Array:
    """Squared deviation of each position from a point's image, in units of its own covariance, shape (N,).

    2 degrees of freedom each; NaN where there is no position. Arguments as of `film_depth`.
    """
    keep = np.flatnonzero(positions.good)
    few, readings = positions.some(keep), np.asarray(encoder_m, float)[keep]
    sigma_m = np.broadcast_to(encoder_sigma_m, positions.good.shape)[keep]
    at = _predicted(rig, point_world_m, readings)
    S = _total(rig, point_world_m, readings, few.covariance_px2(), at.by_offset, sigma_m, covariance_rig)
    each, apart = np.arange(len(keep)), few.uv_px - at.uv.reshape(-1, 2)
    # blocks of 2 x 2 on the diagonal: the covariance of each position by itself
    own = S.reshape(len(keep), 2, len(keep), 2)[each, :, each, :]
    result = np.full(len(positions.uv_px), np.nan)
    result[keep] = np.einsum("ni,nij,nj->n", apart, np.linalg.inv(own), apart)
    return result


@dataclass(frozen=True)
class _Prediction:
    """Positions (2 N,), their derivatives by the point (2 N, 3) and by each frame's offset (N, 2)."""

    uv: Array
    by_point: Array
    by_offset: Array


def _predicted(rig: Rig, X: Array, offsets: Array) -> _Prediction:
    axis = np.array(rig.stroke_axis_world)
    at = image_of(rig.at(0.0), X - offsets[:, None] * axis)
    return _Prediction(at.uv_px.ravel(), at.px_per_m.reshape(-1, 3), -at.px_per_m @ axis)


def _total(
    rig: Rig, X: Array, offsets: Array, C: Array, by_offset: Array, sigma_m: Array, covariance_rig: Array | None
) -> Array:
    total = C.copy()
    each = np.arange(len(offsets))
    blocks = total.reshape(len(offsets), 2, len(offsets), 2)
    blocks[each, :, each, :] += sigma_m[:, None, None] ** 2 * by_offset[:, :, None] * by_offset[:, None, :]
    if covariance_rig is not None:
        J = rig_derivatives(rig, X, offsets, by_offset)
        total += J @ covariance_rig @ J.T
    return total


def rig_derivatives(rig: Rig, X: Array, offsets: Array, by_offset: Array) -> Array:
    """Derivatives of all positions by `rig_parameters.PARAMETERS`, shape (2 N, p); offset 0 is the down position."""
    columns = []
    for name in PARAMETERS:
        if name in STROKE_PARAMETERS:
            share = offsets if name == "stroke_relative" else offsets / offsets.max()  # of a stroke that long
            columns.append((share[:, None] * by_offset).ravel())
            continue
        parameter = MISALIGNMENT[name]
        after, before = (_predicted(parameter.apply(rig, sign * parameter.step), X, offsets).uv for sign in (1.0, -1.0))
        columns.append((after - before) / (2.0 * parameter.step))
    return np.stack(columns, axis=1)


def _start(rig: Rig, positions: FilmPositions, readings: Array) -> Array:
    """Point of the mean positions near both ends of the stroke."""
    order = np.argsort(readings)
    count = max(1, len(order) // 4)
    ends = [order[:count], order[-count:]]
    uv, offset = ([values[end].mean(axis=0) for end in ends] for values in (positions.uv_px, readings))
    estimates = depth_exact(rig, offset[1] - offset[0], *uv)
    if not np.isfinite(estimates.point_world_m).all():
        raise DatasetError("the rays of the film's ends do not meet before the rig: its positions are no spot's")
    return np.asarray(estimates.point_world_m + offset[0] * np.array(rig.stroke_axis_world))


def _result(
    rig: Rig,
    X: Array,
    readings: Array,
    y: Array,
    S: tuple[Array, bool],
    sigma_m: Array,
    calibrated: bool,
    places_px: Array,
) -> FilmDepth:
    at = _predicted(rig, X, readings)
    covariance = np.linalg.inv(at.by_point.T @ cho_solve(S, at.by_point))
    D, gradient = depth_of(rig, X)
    by_rig_m = np.zeros(len(PARAMETERS))
    if calibrated:  # a rig that moves the images as u moves the fitted point as -u
        weights = cho_solve(S, at.by_point @ (covariance @ gradient))
        by_rig_m = -weights @ rig_derivatives(rig, X, readings, at.by_offset)
    residual = y - at.uv
    whitened = cho_solve(S, residual)
    # rows of J_p, one block of two per frame
    J = np.zeros((len(y), len(readings)))
    J.reshape(len(readings), 2, len(readings))[np.arange(len(readings)), :, np.arange(len(readings))] = at.by_offset
    offsets = readings + sigma_m**2 * (J.T @ whitened)
    gain = cho_solve(S, J)
    from_point = J.T @ cho_solve(S, at.by_point)
    variance = (
        sigma_m**2
        - sigma_m**4 * np.einsum("ik,ik->k", J, gain)
        + sigma_m**4 * np.einsum("ki,ij,kj->k", from_point, covariance, from_point)
    )
    return FilmDepth(
        X,
        covariance,
        D,
        float(np.sqrt(gradient @ covariance @ gradient)),
        offsets,
        np.sqrt(np.maximum(variance, 0.0)),
        float(residual @ whitened),
        len(readings),
        by_rig_m,
        places_px,
    )


def expected_sigma_m(
    rig: Rig,
    point_world_m: Array,
    offsets_m: Array,
    positions: FilmPositions,
    encoder_sigma_m: float | Array,
    covariance_rig: Array | None = None,
) -> float:
    """Standard deviation of D that positions of these covariances allow: the bound of a film of such frames."""
    at = _predicted(rig, point_world_m, offsets_m)
    C, sigma_m = positions.covariance_px2(), np.broadcast_to(encoder_sigma_m, positions.good.shape)
    S = cho_factor(_total(rig, point_world_m, offsets_m, C, at.by_offset, sigma_m, covariance_rig))
    covariance = np.linalg.inv(at.by_point.T @ cho_solve(S, at.by_point))
    _, gradient = depth_of(rig, point_world_m)
    return float(np.sqrt(gradient @ covariance @ gradient))
