"""Kriging of the room behind a spot between a film's laser-off frames, and its test by leaving each frame out.

In the pose of a frame each pixel sees of the room what it sees in frames with the laser off of nearly the same pose.
Kriging interpolates between them (`room_weights`): a pixel's room is a constant plus a Gaussian process of the place of
the spot's image, to which the room around it keeps, with the covariance S^2 exp(-d^2 / 2 l^2) for places d px apart.
Where the carriage rests all frames are averaged; where it moves, the neighbours count. The weights of a frame have the
sum 1, so that DSNU cancels, and PRNU of the room as well: what is left of the pattern is that of the spot's own light.
`held_out_chi2` tells whether frames with the laser off, each interpolated from the others, agree within their noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.estimator.spots.raw_pixels import PixelNoise
from phibench.scenes.frames import Array, BoolArray

LENGTH_PX = 1.5  # l: edges of the room, blurred by 0.9 px, are interpolated to a tenth of their noise
STRUCTURE = 300.0  # S^2 over the noise of a pixel: edges of 800 e behind 50 e
_FARTHEST_PX = 2.0 * LENGTH_PX  # from a frame with the laser off: beyond it the room is not known
_ANY_LEVEL = 1e6  # variance of an even level, over the noise: it is free, and kriging leaves it out


@dataclass(frozen=True)
class RoomWeights:
    """Interpolation of the room between M frames with the laser off, for N frames.

    Attributes
    ----------
    weights : array, shape (N, M)
        Each row has the sum 1.
    moved_px : array, shape (N,)
        Standard deviation of what the room's image has moved by beyond the interpolation.
    """

    weights: Array
    moved_px: Array


def room_weights(places_px: Array, off_px: Array) -> RoomWeights:
    """Kriging of the room.

    Parameters
    ----------
    places_px, off_px : arrays, shape (N, 2) and (M, 2)
        Of the spot's image in each frame, seen or not.
    """
    between, to = _correlation(off_px, off_px), _correlation(places_px, off_px)
    K = _ANY_LEVEL + STRUCTURE * between + np.eye(len(off_px))
    weights = np.linalg.solve(K, (_ANY_LEVEL + STRUCTURE * to).T).T
    weights = weights / weights.sum(axis=1, keepdims=True)
    unknown = 1.0 - 2.0 * np.sum(weights * to, axis=1) + np.sum((weights @ between) * weights, axis=1)
    return RoomWeights(weights, LENGTH_PX * np.sqrt(np.maximum(unknown, 0.0)))


def has_near_off_frame(places_px: Array, off_px: Array) -> BoolArray:
    """Frames with the laser off in nearly the same pose, shape (N,): arguments as of `room_weights`."""
    apart = np.linalg.norm(places_px[:, None] - off_px, axis=2)
    return np.asarray(apart.min(axis=1) < _FARTHEST_PX)


def _correlation(a: Array, b: Array) -> Array:
    apart2 = np.sum((a[:, None] - b[None]) ** 2, axis=-1)
    return np.asarray(np.exp(-0.5 * apart2 / LENGTH_PX**2))


def held_out_chi2(off_e: Array, off_px: Array, noise: PixelNoise) -> Array:
    """Squared differences of every frame with the laser off to what the others say, over their variance: means (M,).

    The first and the last frame have neighbours on one side only.

    Parameters
    ----------
    off_e : array, shape (M, h, w)
        Windows of equal pixels.
    off_px : array, shape (M, 2)
    noise : PixelNoise
        Of one frame, without a fixed pattern.
    """
    result = []
    for k in range(len(off_e)):
        others = np.delete(np.arange(len(off_e)), k)
        (weights,) = room_weights(off_px[k : k + 1], off_px[others]).weights
        room = np.tensordot(weights, off_e[others], 1)
        variance = noise.variance_e2(room) * (1.0 + weights @ weights)
        result.append(float(np.mean((off_e[k] - room) ** 2 / variance)))
    return np.array(result)
