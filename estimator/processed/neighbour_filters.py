"""Sharpening and denoising of colour planes as matrices; edge-preserving denoising as mean and slope under noise.

Denoising that spares edges changes Y' of pixel i by share x the sum of b_j f(Y'_j - Y'_i) over the pixels j of a
binomial blur with the weights b; f(d) = d exp(-d^2 / 2 T^2). With a Gaussian d of mean m and variance v,
q = T^2 / (T^2 + v) and e = q^(3/2) exp(-m^2 / 2 (T^2 + v)),

    E f = m e,    dE f / dm = e (1 - m^2 / (T^2 + v)),

and the covariance of f(d) with any other Gaussian is that slope times the covariance of d (C. M. Stein, 1981). The mean
and the covariance with what lies before are therefore exact for Gaussian codes. Left out is the variance of f(d) beyond
its regression, of the order of b^2 v^2 / T^2: variances are 1 % too small at v = 0.08 T^2, and 2 to 4 % at T^2 / 3 and
T^2 (20 000 draws of flat patches, edges and spots).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.camera_codes import YCC_FROM_RGB
from phibench.scenes.frames import Array

_LUMA = YCC_FROM_RGB[0]
_TAPS = {1: (0.25, 0.5, 0.25), 2: (0.0625, 0.25, 0.375, 0.25, 0.0625)}


def denoise_margin_px(card: SensorCard) -> int:
    """Pixels on each side that denoising takes away from a window."""
    of_luma = card.denoise_reach_px if card.denoise_luma > 0.0 else 0
    return max(of_luma, 1 if card.denoise_chroma > 0.0 else 0)


def spares_edges(card: SensorCard) -> bool:
    """Denoising is not linear."""
    return card.denoise_luma > 0.0 and card.denoise_threshold_codes is not None


def neighbours(outer: tuple[int, int], card: SensorCard) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Matrices of the unsharp mask, and of the linear part of denoising, on three planes.

    Each takes what it looks at away from all sides; the second goes on from the first's planes. Unit matrices without.
    """
    h, w = outer
    sharp = sparse.csr_array(sparse.eye_array(3 * h * w))
    if card.sharpen_amount > 0.0:
        blur, cut = _blurred(h, w, 1), _cut(h, w, 1)
        mask = (1.0 + card.sharpen_amount) * cut - card.sharpen_amount * blur
        sharp, h, w = sparse.csr_array(sparse.kron(sparse.eye_array(3), mask)), h - 2, w - 2
    reach = denoise_margin_px(card)
    cut = _cut(h, w, reach)
    smooth = sparse.kron(sparse.eye_array(3), cut)
    luma = sparse.csr_array(np.tile(_LUMA, (3, 1)))
    if card.denoise_chroma > 0.0:
        change = _cut(h - 2, w - 2, reach - 1) @ (_blurred(h, w, 1) - _cut(h, w, 1))
        smooth = smooth + card.denoise_chroma * sparse.kron(sparse.eye_array(3) - luma, change)
    if card.denoise_luma > 0.0 and card.denoise_threshold_codes is None:
        inner = reach - card.denoise_reach_px
        blur = _cut(h - 2 * card.denoise_reach_px, w - 2 * card.denoise_reach_px, inner) @ _luma_blur(h, w, card)
        smooth = smooth + card.denoise_luma * sparse.kron(luma, blur - cut)
    return sharp, sparse.csr_array(smooth)


def _luma_blur(h: int, w: int, card: SensorCard) -> sparse.csr_array:
    down, across = _luma_taps(card)
    return sparse.csr_array(sparse.kron(_band(h, down), _band(w, across)))


def _luma_taps(card: SensorCard) -> tuple[Array, Array]:
    """Taps of the blur of Y' along columns and along rows."""
    across = np.array(_TAPS[card.denoise_reach_px])
    alone = np.zeros(len(across))
    alone[card.denoise_reach_px] = 1.0
    return card.denoise_vertical * across + (1.0 - card.denoise_vertical) * alone, across


def _blurred(h: int, w: int, reach: int) -> sparse.csr_array:
    """Binomial blur of a plane, less `reach` pixels on each side."""
    return sparse.csr_array(sparse.kron(_band(h, np.array(_TAPS[reach])), _band(w, np.array(_TAPS[reach]))))


def _cut(h: int, w: int, reach: int) -> sparse.csr_array:
    """A plane less `reach` pixels on each side."""
    alone = np.zeros(2 * reach + 1)
    alone[reach] = 1.0
    return sparse.csr_array(sparse.kron(_band(h, alone), _band(w, alone)))


def _band(size: int, taps: Array) -> sparse.csr_array:
    """Filter of some taps, shape (size - taps + 1, size)."""
    shape = (size - len(taps) + 1, size)
    return sparse.csr_array(sparse.diags_array(list(taps), offsets=list(range(len(taps))), shape=shape))


# -- denoising that spares edges -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EdgeSparing:
    """Changes of Y' on a window by denoising that spares edges: q pixels, k differences of each.

    Attributes
    ----------
    luma : sparse, shape (s, 3 p)
        From codes of R, G, B to Y' after the unsharp mask, on the window and the pixels around it.
    back : sparse, its transpose
    centre : shape (q,), places of the window's pixels in s
    near : shape (k, q), places of their neighbours
    weights : shape (k,)
    """

    luma: sparse.csr_array
    back: sparse.csr_array
    centre: NDArray[np.int64]
    near: NDArray[np.int64]
    weights: Array
    threshold_codes: float

    def means(self, codes: Array, spread: sparse.csr_array) -> tuple[Array, Array]:
        """Mean changes of Y', shape (q,), and their derivatives by each difference, shape (k, q).

        Parameters
        ----------
        codes : shape (3 p,), means
        spread : sparse, shape (3 p, r)
            From independent noise of variance 1 to the codes.
        """
        y, noise = self.luma @ codes, self.luma @ spread
        C = np.asarray((noise @ noise.T).toarray())
        own = np.diagonal(C)
        v = own[self.centre] + own[self.near] - 2.0 * C[self.centre, self.near]
        m = y[self.near] - y[self.centre]
        total = self.threshold_codes**2 + v
        # mean of d exp(-d^2 / 2 T^2) over the Gaussian noise v of d: the exponent's width grows to T^2 + v
        e = (self.threshold_codes**2 / total) ** 1.5 * np.exp(-0.5 * m**2 / total) * self.weights[:, None]
        return (m * e).sum(axis=0), e * (1.0 - m**2 / total)

    def changes(self, slopes: Array, codes: Array) -> Array:
        """Changes of Y', shape (..., q), with small changes of the codes, shape (..., 3 p), by `means`' derivatives."""
        y = (self.luma @ codes.reshape(-1, codes.shape[-1]).T).T
        total = np.einsum("kq,mkq->mq", slopes, y[:, self.near] - y[:, None, self.centre])
        return np.asarray(total.reshape(*codes.shape[:-1], -1))

    def of_codes(self, slopes: Array, outputs: Array) -> Array:
        """Outputs by codes, shape (3 p, n), of outputs by changes of Y', shape (q, n): the transpose of `changes`."""
        k, q = self.near.shape
        rows = np.concatenate([self.near.ravel(), self.centre])
        columns = np.concatenate([np.tile(np.arange(q), k), np.arange(q)])
        values = np.concatenate([slopes.ravel(), -slopes.sum(axis=0)])
        by_luma = sparse.csr_array((values, (rows, columns)), shape=(self.luma.shape[0], q)) @ outputs
        return np.asarray(self.back @ by_luma)


def edge_sparing(sharp: sparse.csr_array, outer: tuple[int, int], card: SensorCard) -> EdgeSparing | None:
    """Changes of Y' after the unsharp mask `sharp` of planes of `outer` pixels; None where denoising is linear."""
    if not spares_edges(card):
        return None
    down, across = _luma_taps(card)
    cut, reach, around = int(card.sharpen_amount > 0.0), card.denoise_reach_px, denoise_margin_px(card)
    h, w = outer[0] - 2 * cut, outer[1] - 2 * cut
    places = np.arange(h * w).reshape(h, w)
    inner = [slice(around, side - around) for side in (h, w)]
    near, weights = [], []
    for i, row in enumerate(down):
        for j, column in enumerate(across):
            if (i, j) != (reach, reach) and row * column > 0.0:
                near.append(np.roll(places, (reach - i, reach - j), (0, 1))[inner[0], inner[1]].ravel())
                weights.append(row * column)
    luma = sparse.csr_array(sparse.kron(sparse.csr_array(_LUMA[None]), sparse.eye_array(h * w)) @ sharp)
    centre = places[inner[0], inner[1]].ravel()
    threshold = float(card.denoise_threshold_codes or 0.0)
    return EdgeSparing(luma, sparse.csr_array(luma.T), centre, np.stack(near), np.array(weights), threshold)
