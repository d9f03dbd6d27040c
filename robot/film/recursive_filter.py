"""Recursive estimate of a film's point, frame by frame: an iterated extended Kalman filter.

State: where the line of sight of the first frame passes (a, b, in units of the distance), the inverse distance q along
it, and the error e that the fixed pattern adds to the position now, pixels. X = P + (r + a t_1 + b t_2) / q, with P and
r the first frame's ray and t_1, t_2 across it: in q the image is nearly linear from 0.3 m to infinity (J. Civera, A. J.
Davison, J. M. M. Montiel, "Inverse depth parametrization for monocular SLAM", IEEE Trans. Robotics 24, 932, 2008).

The pattern's error stays while the spot rests, and is forgotten as it moves on: e_k = s e_(k-1) + w, with
s = exp(-d^2 / 2 l^2) for a move of d px, and the variance of w that keeps the variance of e. The move is that of the
predicted position: measured ones differ by noise while the spot rests. Encoder noise counts as noise of the position.
While the carriage rests, its readings differ by noise, and the image does not follow them: q is then left as it is.
The same measurements as in `film_bundle`, one by one: the filter can be asked at any time.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from phibench.estimator.geometry.mirror_image import image_of
from phibench.estimator.geometry.reflection import room_rays
from phibench.estimator.geometry.triangulate import depth_of
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

PATTERN_PX = 1.0  # l: a move by which half of the pixels that locate a spot are others
# Squared innovation, two degrees of freedom: chance has more in 1 of 3000. Between red pixels the fit of a single frame
# may settle half a pixel away, and claims as little as a right one.
GATE = 16.0
_PRIOR_Q, _PRIOR_SIGMA_Q = 0.5, 0.4  # 1/m: from 0.6 m to beyond all rooms within two deviations
_RESTS = 5.0  # encoder's standard deviations from the first frame: what moves by less tells nothing of q
_ROUNDS = 8  # of linearisation about the mean
_SETTLED = 1e-2  # standard deviations: far below what the linear map of a frame errs by


@dataclass(frozen=True)
class FilterState:
    """Belief after some frames.

    Attributes
    ----------
    mean : array, shape (5,)
        a, b, q (1/m), and the pattern's error (px).
    covariance : array, shape (5, 5)
    start_m, axes : arrays, shape (3,) and (3, 3)
        P, and r, t_1, t_2 as rows, world.
    uv_px : array, shape (2,)
        Last position.
    offset_m : float
        Last reading of the carriage.
    first_offset_m : float
        First reading.
    frames : int
    chi2 : float
        Sum of squared innovations, two degrees of freedom a frame from the second on.
    """

    mean: Array
    covariance: Array
    start_m: Array = field(repr=False)
    axes: Array = field(repr=False)
    uv_px: Array
    offset_m: float
    first_offset_m: float
    frames: int = 1
    chi2: float = 0.0

    def point_m(self) -> Array:
        """Point of the mean, shape (3,)."""
        a, b, q = self.mean[:3]
        return np.asarray(self.start_m + np.array([1.0, a, b]) @ self.axes / q)

    def point_by_state(self) -> Array:
        """Derivative of the point by (a, b, q), shape (3, 3)."""
        a, b, q = self.mean[:3]
        along = np.array([1.0, a, b]) @ self.axes
        return np.stack([self.axes[1] / q, self.axes[2] / q, -along / q**2], axis=1)

    def depth(self, rig: Rig) -> tuple[float, float]:
        """D and its standard deviation, metres."""
        D, by_point = depth_of(rig, self.point_m())
        gradient = by_point @ self.point_by_state()
        return D, float(np.sqrt(gradient @ self.covariance[:3, :3] @ gradient))


def first_state(
    rig: Rig, uv_px: Array, noise_px2: Array, pattern_px2: Array, offset_m: float, sigma_m: float
) -> FilterState:
    """Belief after the first frame: the line of sight, and next to nothing about the distance.

    Parameters
    ----------
    rig : Rig
    uv_px : array, shape (2,)
    noise_px2, pattern_px2 : arrays, shape (2, 2)
        Covariance of what is new in every frame, and of what the pattern does.
    offset_m, sigma_m : float
        Reading of the carriage, and its standard deviation.
    """
    ray = room_rays(rig.at(0.0), uv_px)
    r = ray.direction_world
    helper = np.eye(3)[np.argmin(np.abs(r))]
    across = np.cross(r, helper) / np.linalg.norm(np.cross(r, helper))
    axes = np.stack([r, across, np.cross(r, across)])
    start = ray.origin_world_m + offset_m * np.array(rig.stroke_axis_world)
    state = FilterState(
        np.array([0.0, 0.0, _PRIOR_Q, 0.0, 0.0]), np.eye(5), start, axes, np.asarray(uv_px, float), offset_m, offset_m
    )
    _, J, by_offset = _image(rig, state, offset_m)
    sight = np.linalg.inv(J[:, :2])
    covariance = np.zeros((5, 5))  # of a, b and 1 / D, and of the pattern's shift in u and v
    covariance[2, 2] = _PRIOR_SIGMA_Q**2
    covariance[3:, 3:] = pattern_px2
    # a and b are what they are because the position errs by noise, reading and pattern
    new_px2 = noise_px2 + _by_encoder(covariance, _PRIOR_Q, by_offset, sigma_m)
    covariance[:2, :2] = sight @ (new_px2 + pattern_px2) @ sight.T
    covariance[:2, 3:] = -sight @ pattern_px2
    covariance[3:, :2] = covariance[:2, 3:].T
    return replace(state, covariance=covariance)


def updated(
    rig: Rig, state: FilterState, uv_px: Array, noise_px2: Array, pattern_px2: Array, offset_m: float, sigma_m: float
) -> FilterState:
    """Belief after one more frame; arguments as for `first_state`."""
    moved = float(np.linalg.norm(_image(rig, state, offset_m)[0] - _image(rig, state, state.offset_m)[0]))
    s = np.exp(-0.5 * (moved / PATTERN_PX) ** 2)
    F = np.diag([1.0, 1.0, 1.0, s, s])
    mean, P = F @ state.mean, F @ state.covariance @ F.T
    P[3:, 3:] += (1.0 - s * s) * pattern_px2
    x = mean
    rests = abs(offset_m - state.first_offset_m) < _RESTS * sigma_m
    for _ in range(_ROUNDS):
        predicted, J, by_offset = _image(rig, replace(state, mean=x), offset_m)
        H = np.hstack([J, np.eye(2)])
        if rests:
            H[:, 2] = 0.0
        R = noise_px2 + _by_encoder(P, x[2], by_offset, sigma_m)
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        innovation = uv_px - predicted - x[3:] - H @ (mean - x)
        before, x = x, mean + K @ innovation
        x[2] = max(x[2], 1e-3)  # 1 / D stays above 0: a kilometre
        if np.all(np.abs(x - before) <= _SETTLED * np.sqrt(np.diag(P))):
            break
    squared = float(innovation @ np.linalg.solve(S, innovation))
    if squared > GATE:
        return state
    left = np.eye(5) - K @ H
    covariance = left @ P @ left.T + K @ R @ K.T
    belief = replace(state, mean=x, covariance=covariance, chi2=state.chi2 + squared, frames=state.frames + 1)
    return replace(belief, uv_px=np.asarray(uv_px, float), offset_m=offset_m)


def _by_encoder(covariance: Array, q: float, by_offset: Array, sigma_m: float) -> Array:
    """Covariance of a position by the reading of the carriage, pixels^2.

    The image moves with the carriage in proportion to q: as long as that is unknown, by a deviation more.
    """
    return (sigma_m * (1.0 + np.sqrt(covariance[2, 2]) / q)) ** 2 * np.outer(by_offset, by_offset)


def _image(rig: Rig, state: FilterState, offset_m: float) -> tuple[Array, Array, Array]:
    """Position of the mean's point, its derivative by (a, b, q), shape (2, 3), and by the offset, shape (2,)."""
    axis = np.array(rig.stroke_axis_world)
    at = image_of(rig.at(0.0), state.point_m() - offset_m * axis)
    return at.uv_px, at.px_per_m @ state.point_by_state(), -at.px_per_m @ axis
