"""Test whether frames are raw: noise correlation between pixels and between frames, row flicker, steps of a JPEG.

Frames that were demosaiced, smoothed, shrunk, sharpened or compressed have less noise, or more, than the sensor gave,
and so have frames that a camera averages over time. A photon transfer of them has a wrong gain, and its line fits. What
tells them is the correlation of neighbours, which such a step makes with the loss of noise: a filter that keeps the
level takes a white variance V to V / (1 + sum of the correlations of a pixel with all others).

Lines and bands are no such likeness: they reach far, and are measured beside it. Bands that change from frame to frame
are a lamp's on mains, seen by a rolling shutter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn

from phibench.scenes.frames import Array

_SIDE_PX, _FRAMES = 512, 8  # of the middle of as many frames: 2e6 values tell a likeness of 0.003
_NEAR = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0))
_FAR = 7  # odd: to a pixel of another filter, as from one to its neighbour
_SIGMAS = 6.0
_LEAST = 0.01  # of a likeness, 2 % of the gain
_BESIDE, _BESIDE_SIGMAS = 0.004, 5.0  # of the mean of both sides, 1.6 % of the gain
_SUM_SIGMAS = 4.0
MOST = 0.2  # from which on frames are no raw ones
_BROAD = 0.5  # of the largest likeness: what reaches so far is light
_JPEG_PX, _JPEG_FRAMES, _JPEG_STEPS = 256, 4, range(1, 13)
_JPEG_SIGMAS, _JPEG_TERMS = 9.0, 3  # of one of 63 terms; so many of them
_STEP_NOISE = 0.67  # noise over step, from which on 2e-4 of a step is left in the mean cosine
_UNEVEN = 0.05  # rms of noise over signal, from block to block
_BANDS = 0.05  # of the noise


@dataclass(frozen=True)
class NoiseLikeness:
    """Likeness of one level's noise.

    Attributes
    ----------
    near : correlations with the pixels of `_NEAR`, less that of one far away, shape (6,)
    near_sigma : of each
    far : largest correlation with a pixel 7 columns or rows away
    after, after_sigma : correlation of a pixel's noise in one frame and the next
    bands_dn2, bands_sigma_dn2 : variance that whole rows have in common
    noise_dn2 : variance of the noise
    jpeg : terms of the cosine transform of 8 x 8 pixels lie on steps, as JPEG leaves them
    """

    near: Array
    near_sigma: float
    far: float
    after: float
    after_sigma: float
    bands_dn2: float
    bands_sigma_dn2: float
    noise_dn2: float
    jpeg: bool


def noise_likeness(frames: NDArray[Any], filters: int) -> NoiseLikeness:
    """Likeness of the noise of one level.

    Parameters
    ----------
    frames : array, shape (n, h, w), n >= 2
    filters : int
        Side of the mosaic's cell in pixels: 1 or 2.
    """
    v, u = (max((size - _SIDE_PX) // 4 * 2, 0) for size in frames.shape[1:])
    x = frames[:_FRAMES, v : v + _SIDE_PX, u : u + _SIDE_PX].astype(float)
    n, h, w = x.shape
    x -= x.mean(axis=0)
    x -= x.mean(axis=(1, 2), keepdims=True)
    x *= np.sqrt(n / (n - 1.0))
    noise_dn2 = float(np.square(x).mean())
    rows = x.mean(axis=2)
    bands, bands_sigma = float(np.square(rows).mean()) - noise_dn2 / w, noise_dn2 / w * np.sqrt(2.0 / ((n - 1) * h))
    z = x - rows[..., None]
    for i, j in np.ndindex(filters, filters):  # filters differ in noise
        site = z[:, i::filters, j::filters]
        site /= max(float(np.sqrt(np.square(site).mean())), 1e-9)
    far = {(0, 1): _product(z, 0, _FAR), (1, 0): _product(z, _FAR, 0)}
    ways = [far[0, 1] if rows_off == 0 else far[1, 0] if not columns_off else 0.0 for rows_off, columns_off in _NEAR]
    near = np.array([_product(z, *lag) - way for lag, way in zip(_NEAR, ways, strict=True)])
    sigma = ((n - 1) * h * w) ** -0.5
    after = float(np.mean(z[1:] * z[:-1])) + 1.0 / (n - 1)  # about their own mean, white frames have -1 / (n - 1)
    near_sigma, jpeg = 2.0**0.5 * sigma, lies_on_jpeg_steps(frames)
    return NoiseLikeness(near, near_sigma, max(far.values()), after, sigma, bands, bands_sigma, noise_dn2, jpeg)


@dataclass(frozen=True)
class RawNoise:
    """Verdict of the likeness of all levels on the gain.

    Attributes
    ----------
    doubt : float
        Relative standard deviation of the gain.
    finding : str
        Sentence; "" where the noise is that of single pixels.
    not_raw : bool
        The frames are no raw ones.
    """

    doubt: float = 0.0
    finding: str = ""
    not_raw: bool = False


def raw_noise(levels: Sequence[NoiseLikeness], uneven: Sequence[tuple[float, float]], dark_rows_dn2: float) -> RawNoise:
    """Weigh the likeness of flat levels.

    Parameters
    ----------
    levels : sequence of NoiseLikeness
    uneven : of `BlockSums.uneven`, of levels and filters
    dark_rows_dn2 : variance that rows have in common without light
    """
    weight = np.array([one.near_sigma**-2.0 for one in levels])
    near = weight @ np.array([one.near for one in levels]) / weight.sum()
    after = float(weight @ np.array([one.after for one in levels]) / weight.sum())
    sigma, after_sigma = weight.sum() ** -0.5, sum(one.after_sigma**-2.0 for one in levels) ** -0.5
    said, doubts = [], []
    seen = np.abs(near) > max(_LEAST, _SIGMAS * sigma)
    seen[:2] |= abs(near[:2].mean()) > max(_BESIDE, _BESIDE_SIGMAS * sigma / np.sqrt(2.0))
    if seen.any():
        doubts.append(abs(2.0 * float(near[seen].sum())))
        said.append(
            f"the noise of neighbouring pixels is alike (correlation {near[np.argmax(np.abs(near))]:+.2f}): the frames "
            "were smoothed, sharpened, shrunk or compressed after the converter, which changes noise and gain"
        )
    total = abs(float(near.sum()))
    if not seen.any() and total > _SUM_SIGMAS * sigma * len(_NEAR) ** 0.5:
        doubts.append(2.0 * total)  # too little to be said, too much for chance
    if abs(after) > max(_LEAST, _SIGMAS * after_sigma):
        doubts.append(2.0 * abs(after) / max(1.0 - abs(after), MOST))
        said.append(
            f"the noise of one frame is in the next (correlation {after:+.2f}): the camera averages frames, or single "
            "frames came twice; switch its noise reduction off"
        )
    bands = [
        (one.bands_dn2 - dark_rows_dn2) / one.noise_dn2
        for one in levels
        if one.bands_dn2 - dark_rows_dn2 > max(_BANDS * one.noise_dn2, _SIGMAS * one.bands_sigma_dn2)
    ]
    if bands:
        doubts.append(max(bands))
        said.append(
            f"rows jump together from frame to frame, {100.0 * max(bands):.0f} % of a level's variance: the lamp "
            "flickers with the mains; take one on direct current, or exposure times that are multiples of 10 ms"
        )
    excess, chance = np.mean(uneven, axis=0)
    if excess > max(_UNEVEN**2, _SIGMAS * chance / len(uneven) ** 0.5):
        doubts.append(float(excess**0.5))
        said.append(
            f"noise over signal differs by {100.0 * excess**0.5:.0f} % rms from part to part: the camera "
            "or a program evens out its shading, and the gain is a mean"
        )
    most = max(float(np.abs(near).max()), abs(after))
    if max(one.far for one in levels) > _BROAD * most > _BROAD * MOST:
        said = ["light moves over the picture from frame to frame: fix lamp, camera and surface"]
    return RawNoise(float(np.hypot.reduce(doubts)) if doubts else 0.0, "; ".join(said), most > MOST)


def lies_on_jpeg_steps(frames: NDArray[Any]) -> bool:
    """Tell whether frames, shape (n, h, w), passed through a JPEG whose blocks begin at their corner.

    A term on multiples of q, rounded to codes behind it, has the mean cosine exp(-pi^2 / 6 q^2) of its angle 2 pi / q;
    a raw one has none.
    """
    v, u = (max((size - _JPEG_PX) // 16 * 8, 0) for size in frames.shape[1:])
    x = frames[:_JPEG_FRAMES, v : v + _JPEG_PX, u : u + _JPEG_PX].astype(float)
    n, h, w = len(x), x.shape[1] // 8, x.shape[2] // 8
    blocks = x[:, : 8 * h, : 8 * w].reshape(n, h, 8, w, 8).swapaxes(2, 3).reshape(n, h * w, 8, 8)
    terms = dctn(blocks, axes=(2, 3), norm="ortho").reshape(n, h * w, 64)[..., 1:]
    noise = np.sqrt(terms.var(axis=0, ddof=1).mean(axis=0))
    for step in _JPEG_STEPS:
        free = noise > _STEP_NOISE * step
        sigmas = np.cos(2.0 * np.pi / step * terms[..., free]).mean(axis=(0, 1)) * np.sqrt(2.0 * n * h * w)
        if (sigmas > _JPEG_SIGMAS).sum() >= _JPEG_TERMS or sigmas.sum() > _JPEG_SIGMAS * np.sqrt(max(free.sum(), 1)):
            return True
    return False


def _product(z: Array, rows: int, columns: int) -> float:
    one, other = (z, z[:, rows:]) if rows else (z, z)
    one = one[:, : one.shape[1] - rows] if rows else one
    if columns < 0:
        one, other = one[..., -columns:], other[..., :columns]
    elif columns:
        one, other = one[..., :-columns], other[..., columns:]
    return float(np.mean(one * other))
