"""Electrons of the raw pixels behind processed images: tone curve, sharpening, matrix and chroma means undone.

`unprocessed_electrons` undoes each step but denoising and the loss of chroma. The rest is for a room behind an image
whose chroma the camera has averaged (yuyv, and JPEG of 4:2:2 and 4:2:0):

Bilinear demosaicing keeps each pixel's own colour, but the means of chroma over two or four pixels do not: where a
room changes within a pixel or two, the mosaic makes false colours, and an own colour comes back wrong by up to a
third of its step. A room that is taken for the image's own colours has lost its chroma twice after the model's chain,
and the difference looks like light of the spot: fits beside a steep edge were 0.3 to 0.6 px off, 6 claimed sigma.

`electrons_before_chroma_loss` looks for the raw pixels whose own colours come out of demosaicing, curve and chroma
means as the image has them: x <- x + (seen - own colours of x) (P. H. van Cittert, Z. Phys. 69, 298, 1931). An
own colour keeps 0.7 to 0.85 of its change in that way, so that the error falls by a factor of 3 to 6 in each round.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.camera_codes import (
    CHROMA_STEP,
    RGB_FROM_YCC,
    YCC_FROM_RGB,
    block_means,
    light_of,
    rgb_codes,
    tone_of,
    tone_slope,
)
from phibench.estimator.spots.image_planes import demosaiced_planes, full_scale_e
from phibench.estimator.spots.raw_pixels import bayer_filters
from phibench.scenes.frames import Array

_UNSHARP_STEPS = 24  # each multiplies the error by amount / (1 + amount): 4e-12 in all at 0.5
_ROUNDS = 4  # 0.3 to the power of 4 is 1 % of the loss; more rounds add noise of the codes' rounding


def unprocessed_electrons(images: NDArray[Any], origin: NDArray[np.int64], card: SensorCard) -> tuple[Array, Array]:
    """Electrons of each pixel's own colour and the variance that 8 bits add, electrons squared, shape (n, h, w) each.

    Undoes, from the end: Y'CbCr, sharpening, tone curve, colour matrix, white balance. Denoising and the loss of chroma
    stay.

    Parameters
    ----------
    images : shape (n, h, w, 3), codes 0 to 255, whole or not; (n, h, w, 2) of "yuyv"
    origin : shape (n, 2)
        Image pixel (u, v) of the first column and row.
    """
    filters = bayer_filters(origin + card.mosaic_phase, images.shape[1:3])
    rgb = np.stack([rgb_codes(image, card, corner) for image, corner in zip(images, origin, strict=True)])
    code = np.clip(_unsharpened(np.asarray(rgb, float), card.sharpen_amount) / 255.0, 0.0, 1.0)
    linear = light_of(code, card)
    spread = np.sqrt(np.sum(RGB_FROM_YCC**2, axis=1)) if card.output == "yuyv" else np.ones(3)
    # a cut code has slope 0: its light is not known
    width = spread / (255.0 * np.maximum(tone_slope(linear, card), 1e-3))
    inverse = np.linalg.inv(np.asarray(card.colour_matrix)) / np.asarray(card.white_balance)[:, None]
    own = inverse[filters] * full_scale_e(card)  # (n, h, w, 3): row of the inverse for the pixel's filter
    return np.sum(own * linear, axis=3), np.sum((own * width) ** 2, axis=3) / 12.0


def mean_unprocessed_electrons(
    images: NDArray[Any], origin: NDArray[np.int64], card: SensorCard
) -> tuple[Array, Array]:
    """Mean over frames of `unprocessed_electrons`, and the variance that 8 bits add to it; images (n, f, h, w, c)."""
    frames = [unprocessed_electrons(images[:, k], origin, card) for k in range(images.shape[1])]
    x, variance = (sum(parts) / len(frames) for parts in zip(*frames, strict=True))
    return np.asarray(x), np.asarray(variance) / len(frames)


def _unsharpened(codes: Array, amount: float) -> Array:
    """Solution x of x + amount (x - blur x) = codes, shape (n, h, w, 3), by fixed-point iteration."""
    x = codes
    if amount > 0.0:
        for _ in range(_UNSHARP_STEPS):
            blurred = convolve1d(
                convolve1d(x, (0.25, 0.5, 0.25), axis=1, mode="mirror"), (0.25, 0.5, 0.25), 2, mode="mirror"
            )
            x = (codes + amount * blurred) / (1.0 + amount)
    return x


def chroma_step(card: SensorCard) -> tuple[int, int]:
    """Rows and columns of pixels that share a chroma sample."""
    if card.output == "yuyv":
        return 1, 2
    return CHROMA_STEP[card.jpeg_subsampling] if card.output == "mjpeg" else (1, 1)


def electrons_before_chroma_loss(seen_e: Array, origin: NDArray[np.int64], card: SensorCard) -> Array:
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
    linear = np.einsum("ij,jhw->ihw", mix, demosaiced_planes(raw, (u, v)))
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
    chroma = _weighted(ycc[1:], card) if card.output == "yuyv" else block_means(ycc[1:], (down, across))
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
