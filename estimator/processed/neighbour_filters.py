"""Sharpening and denoising of planes of codes: as matrices, and, where edges are spared, as means over their noise.

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
from scipy.ndimage import convolve1d

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.camera_codes import CHROMA_STEP, RGB_FROM_YCC, YCC_FROM_RGB, averaged, light_of, tone_of
from phibench.estimator.spots.image_planes import demosaiced, full_scale_e
from phibench.estimator.spots.raw_pixels import bayer_filters
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


# Raw pixels of a room behind an image whose chroma the camera has averaged (yuyv, and JPEG of 4:2:2 and 4:2:0).
#
# Bilinear demosaicing keeps each pixel's own colour, but the means of chroma over two or four pixels do not: where a
# room changes within a pixel or two, the mosaic makes false colours, and an own colour comes back wrong by up to a
# third of its step. A room that is taken for the image's own colours has lost its chroma twice after the model's chain,
# and the difference looks like light of the spot: fits beside a steep edge were 0.3 to 0.6 px off, 6 claimed sigma.
#
# `regained` looks for the raw pixels whose own colours come out of demosaicing, curve and chroma means as the image has
# them: x <- x + (seen - own colours of x) (P. H. van Cittert, Z. Phys. 69, 298, 1931). An own colour keeps 0.7 to 0.85
# of its change in that way, so that the error falls by a factor of 3 to 6 in each round.


_ROUNDS = 4  # 0.3 to the power of 4 is 1 % of the loss; more rounds add noise of the codes' rounding


def chroma_step(card: SensorCard) -> tuple[int, int]:
    """Rows and columns of pixels that share a chroma sample."""
    if card.output == "yuyv":
        return 1, 2
    return CHROMA_STEP[card.jpeg_subsampling] if card.output == "mjpeg" else (1, 1)


def regained(seen_e: Array, origin: NDArray[np.int64], card: SensorCard) -> Array:
    """Electrons of the raw pixels, shape (n, h, w).

    Parameters
    ----------
    seen_e : shape (n, h, w)
        Electrons behind each pixel's own colour in the image.
    origin : shape (n, 2)
        Image pixel (u, v) of the first column and row.
    """
    if chroma_step(card) == (1, 1):
        return seen_e
    return np.stack([_regained(seen, corner, card) for seen, corner in zip(seen_e, origin, strict=True)])


def _regained(seen: Array, corner: NDArray[np.int64], card: SensorCard) -> Array:
    x = seen
    for _ in range(_ROUNDS):
        x = x + (seen - _own_colours(x, corner, card))
    return x


def _own_colours(raw: Array, corner: NDArray[np.int64], card: SensorCard) -> Array:
    """Electrons behind each pixel's own colour after demosaicing, curve and chroma means, shape (h, w)."""
    u, v = (int(k) for k in corner + np.asarray(card.mosaic_phase))
    mix = np.asarray(card.colour_matrix) * np.asarray(card.white_balance) / full_scale_e(card)
    linear = np.einsum("ij,jhw->ihw", mix, demosaiced(raw, (u, v)))
    code = tone_of(np.clip(linear, 0.0, 1.0), card)
    light = light_of(np.clip(_mean_chroma(code, corner, card), 0.0, 1.0), card)
    filters = bayer_filters(np.array([[u, v]]), raw.shape)[0]
    return np.asarray(np.einsum("hwj,jhw->hw", np.linalg.inv(mix)[filters], light))


def _mean_chroma(rgb: Array, corner: NDArray[np.int64], card: SensorCard) -> Array:
    """R, G, B, shape (3, h, w), with the chroma of each sample's pixels."""
    down, across = chroma_step(card)
    (u, v), (h, w) = corner, rgb.shape[1:]
    top, left = int(v) % down, int(u) % across
    pads = [(0, 0), (top, -(top + h) % down), (left, -(left + w) % across)]
    ycc = np.einsum("ij,jhw->ihw", YCC_FROM_RGB, np.pad(rgb, pads, mode="edge"))
    chroma = _weighted(ycc[1:], card) if card.output == "yuyv" else averaged(ycc[1:], (down, across))
    for axis, step in ((1, down), (2, across)):
        if step > 1:
            chroma = _doubled(chroma, axis, smooth=card.output == "mjpeg")
    ycc[1:] = chroma
    return np.einsum("ij,jhw->ihw", RGB_FROM_YCC, ycc)[:, top : top + h, left : left + w]


def _weighted(chroma: Array, card: SensorCard) -> Array:
    """Chroma at even columns, as a camera of yuyv weights what is beside them."""
    return np.asarray(convolve1d(chroma, card.chroma_taps, axis=2, mode="nearest")[:, :, ::2])


def _doubled(samples: Array, axis: int, smooth: bool) -> Array:
    """Samples on twice as many pixels: repeated as a decoder of yuyv does, or by libjpeg's triangle filter."""
    each = np.repeat(samples, 2, axis)
    if not smooth:
        return each
    padded = np.moveaxis(np.pad(each, [(2, 2) if k == axis else (0, 0) for k in range(3)], mode="edge"), axis, -1)
    beside = np.where(np.arange(each.shape[axis]) % 2 == 0, padded[..., :-4], padded[..., 4:])
    return 0.75 * each + 0.25 * np.moveaxis(beside, -1, axis)  # libjpeg's triangle filter between chroma samples
