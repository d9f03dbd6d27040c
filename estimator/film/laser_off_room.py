"""Room behind a moving spot, pixel by pixel, from frames of the same film with the laser off.

In the pose of a frame each pixel sees what it sees in frames with the laser off of nearly the same pose. Kriging
interpolates between them: a pixel's room is a constant plus a Gaussian process of the place of the spot's image, to
which the room around it keeps, with the covariance S^2 exp(-d^2 / 2 l^2) for places d px apart. Where the carriage
rests all frames are averaged; where it moves, the neighbours count. The weights of a frame have the sum 1, so that DSNU
cancels, and PRNU of the room as well: what is left of the pattern is that of the spot's own light.

The film proves it: frames with the laser off, each interpolated from the others, agree within their noise
(`held_out_chi2`).
"""

from __future__ import annotations

import numpy as np

from phibench.estimator.spots.raw_pixels import PixelNoise
from phibench.scenes.frames import Array

LENGTH_PX = 1.5  # l: edges of the room, blurred by 0.9 px, are interpolated to a tenth of their noise
STRUCTURE = 300.0  # S^2 over the noise of a pixel: edges of 800 e behind 50 e
FARTHEST_PX = 2.0 * LENGTH_PX  # from a frame with the laser off: beyond it the room is not known
_ANY_LEVEL = 1e6


def room_weights(places_px: Array, off_px: Array) -> Array:
    """Weights of M frames with the laser off, shape (N, M), for the room in N frames; each row has the sum 1.

    Parameters
    ----------
    places_px, off_px : arrays, shape (N, 2) and (M, 2)
        Of the spot's image in each frame, seen or not.
    """
    K = _covariance(off_px, off_px) + np.eye(len(off_px))
    weights = np.linalg.solve(K, _covariance(off_px, places_px)).T
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _covariance(a: Array, b: Array) -> Array:
    apart2 = np.sum((a[:, None] - b[None]) ** 2, axis=-1)
    return np.asarray(_ANY_LEVEL + STRUCTURE * np.exp(-0.5 * apart2 / LENGTH_PX**2))


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
        (weights,) = room_weights(off_px[k : k + 1], off_px[others])
        room = np.tensordot(weights, off_e[others], 1)
        variance = noise.variance_e2(room) * (1.0 + weights @ weights)
        result.append(float(np.mean((off_e[k] - room) ** 2 / variance)))
    return np.array(result)
