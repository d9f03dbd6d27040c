"""Codes of processed images: tone curves and Y'CbCr 4:2:2 on the estimator's side.

* A tone curve takes linear light, full scale 1, to encoded R, G, B: sRGB (IEC 61966-2-1), Rec. 709 (ITU-R BT.709), or
  a measured table whose points straight lines join. `card.transfer_function` says which.
* "yuyv" images are bytes, shape (H, W, 2): Y' of each pixel, and in turns Cb (even columns) and Cr of a pair of pixels
  (ITU-R BT.601). `rgb_codes` is what a viewer makes of them, `ycbcr_codes` the numbers themselves; nothing is lost.

The simulator has its own (`render.sensor.processing`); tests compare the two.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.jpeg_coefficients import RGB_FROM_YCC, YCC_FROM_RGB
from phibench.scenes.frames import Array

_KNEE, _SLOPE = 0.0031308, 12.92  # of the sRGB curve's straight part
_ALPHA, _BETA = 1.099296826809442, 0.018053968510807  # of Rec. 709: the power's factor, and where it begins
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(9)  # exact for polynomials up to the order 17 of Gaussian noise
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()


# -- tone curves -----------------------------------------------------------------------------------------------------


def linear_to_srgb(linear: NDArray[Any]) -> NDArray[Any]:
    """sRGB values in [0, 1] of linear light, cut to [0, 1]; any shape."""
    x = np.clip(linear, 0.0, 1.0)
    return np.asarray(np.where(x <= _KNEE, _SLOPE * x, 1.055 * x ** (1.0 / 2.4) - 0.055))


def srgb_to_linear(encoded: Array) -> Array:
    """Linear light of sRGB values in [0, 1]; any shape."""
    y = np.asarray(encoded, float)
    return np.asarray(np.where(y <= _SLOPE * _KNEE, y / _SLOPE, ((np.maximum(y, 0.0) + 0.055) / 1.055) ** 2.4))


def srgb_slope(linear: Array) -> Array:
    """Derivative of `linear_to_srgb`, any shape; 0 outside [0, 1]."""
    x = np.asarray(linear, float)
    inside = (x >= 0.0) & (x <= 1.0)
    power = 1.055 / 2.4 * np.maximum(x, _KNEE) ** (1.0 / 2.4 - 1.0)  # the power has no slope at 0, where it is not used
    return np.asarray(np.where(inside, np.where(x <= _KNEE, _SLOPE, power), 0.0))


def tone_of(linear: NDArray[Any], card: SensorCard) -> NDArray[Any]:
    """Encoded values in [0, 1] of linear light, cut to [0, 1], by the card's curve; any shape."""
    if card.transfer_function == "srgb":
        return linear_to_srgb(linear)
    x = np.clip(linear, 0.0, 1.0)
    if card.transfer_function == "rec709":
        return np.asarray(np.where(x < _BETA, 4.5 * x, _ALPHA * np.maximum(x, _BETA) ** 0.45 - (_ALPHA - 1.0)))
    return np.asarray(np.interp(x, *_points(card)))


def light_of(encoded: NDArray[Any], card: SensorCard) -> Array:
    """Linear light of encoded values in [0, 1], by the card's curve; any shape."""
    y = np.asarray(encoded, float)
    if card.transfer_function == "srgb":
        return srgb_to_linear(y)
    if card.transfer_function == "rec709":
        power = (np.maximum(y, 0.0) + (_ALPHA - 1.0)) / _ALPHA
        return np.asarray(np.where(y < 4.5 * _BETA, y / 4.5, power ** (1.0 / 0.45)))
    return np.asarray(np.interp(y, *_points(card)[::-1]))


def tone_slope(linear: Array, card: SensorCard) -> Array:
    """Derivative of `tone_of`, any shape; 0 outside [0, 1]; at a table's point that of the line above it."""
    if card.transfer_function == "srgb":
        return srgb_slope(linear)
    x = np.asarray(linear, float)
    if card.transfer_function == "rec709":
        slope = np.where(x < _BETA, 4.5, 0.45 * _ALPHA * np.maximum(x, _BETA) ** -0.55)
    else:
        from_x, to_y = _points(card)
        line = np.clip(np.searchsorted(from_x, x, side="right") - 1, 0, len(from_x) - 2)
        slope = (np.diff(to_y) / np.diff(from_x))[line]
    return np.asarray(np.where((x >= 0.0) & (x <= 1.0), slope, 0.0))


def _points(card: SensorCard) -> tuple[Array, Array]:
    """Linear and encoded values of a measured table."""
    linear, encoded = np.transpose(np.array(card.transfer_points, float))
    return linear, encoded


@dataclass(frozen=True)
class NoisyCode:
    """Encoded value of a Gaussian, arrays of the shape of its mean.

    Attributes
    ----------
    mean : E f(x)
    by_mean : its derivative by the mean of x, E f'(x)
    by_sigma : its derivative by the standard deviation of x
    variance : of f(x)
    """

    mean: Array
    by_mean: Array
    by_sigma: Array
    variance: Array


def noisy_code(mean: Array, sigma: Array, card: SensorCard) -> NoisyCode:
    """Encoded value of linear light with a Gaussian error, by Gauss-Hermite quadrature with 9 nodes.

    Derivatives by Stein's lemma: E f' = E f z / s, d E f / ds = E f (z^2 - 1) / s, z the standardised error. Where the
    curve is cut within the error, at 0 and 1, the quadrature is good to some per cent of the error.

    Parameters
    ----------
    mean, sigma : arrays of the same shape, full scale 1; sigma above 0
    card : SensorCard
    """
    f = tone_of(mean[..., None] + sigma[..., None] * _NODES, card)
    first = f @ _WEIGHTS
    by_mean = f @ (_WEIGHTS * _NODES) / sigma
    by_sigma = f @ (_WEIGHTS * (_NODES**2 - 1.0)) / sigma
    return NoisyCode(first, by_mean, by_sigma, (f - first[..., None]) ** 2 @ _WEIGHTS)


# -- Y'CbCr 4:2:2 ----------------------------------------------------------------------------------------------------

_MIDDLE = 128.0  # code of chroma 0


def _scale(card: SensorCard) -> tuple[float, Array]:
    """Y' of black, and codes of Y', Cb, Cr per code of R, G, B."""
    limited = card.ycbcr_range == "limited"
    return (16.0, np.array([219.0, 224.0, 224.0]) / 255.0) if limited else (0.0, np.ones(3))  # BT.601


def rgb_codes(image: NDArray[Any], card: SensorCard, origin_px: ArrayLike = (0, 0)) -> NDArray[Any]:
    """Codes of R, G, B, shape (..., H, W, 3), of a processed image; "yuyv" ones are float and not cut to 0 to 255.

    Both pixels of a pair get its chroma; one whose partner lies outside gets the missing value of the pair beside.

    Parameters
    ----------
    image : shape (..., H, W, 3), or (..., H, W, 2) of "yuyv"
    card : SensorCard
    origin_px : (u, v)
        Of the first column and row in the whole image: where the pairs begin.
    """
    if card.output != "yuyv":
        return image
    black, scale = _scale(card)
    ycc = np.empty((*image.shape[:-1], 3))
    ycc[..., 0] = image[..., 0] - black
    u = int(np.asarray(origin_px)[0]) + np.arange(image.shape[-2])
    for k in (0, 1):
        column = u // 2 * 2 + k - u[0]
        column = np.where(column < 0, column + 2, np.where(column >= len(u), column - 2, column))
        ycc[..., 1 + k] = image[..., np.clip(column, 0, len(u) - 1), 1] - _MIDDLE
    return np.asarray((ycc / scale) @ RGB_FROM_YCC.T)


def rgb_picture(image: NDArray[Any], card: SensorCard, origin_px: ArrayLike = (0, 0)) -> NDArray[np.uint8]:
    """As `rgb_codes`, rounded and cut to 8 bits."""
    if card.output != "yuyv" and image.dtype == np.uint8:
        return image
    return np.clip(np.rint(rgb_codes(image, card, origin_px)), 0.0, 255.0).astype(np.uint8)


def ycbcr_codes(image: NDArray[Any]) -> Array:
    """Y', Cb and Cr of a "yuyv" image, shape (H, W, 2), W even, that begins at an even column; shape (2 H W,)."""
    second = image[..., 1]
    return np.concatenate([image[..., 0].ravel(), second[:, ::2].ravel(), second[:, 1::2].ravel()]).astype(float)


def ycbcr_transform(shape: tuple[int, int], card: SensorCard) -> tuple[sparse.csr_array, Array]:
    """Matrix from codes of R, G, B, planes of (h + 2, w + 2), to `ycbcr_codes` of (h, w), and what is added.

    The planes have a pixel more on each side: a chroma sample takes `card.chroma_taps` of its pair and the column to
    the left of it.
    """
    h, w = shape
    black, scale = _scale(card)
    mix = scale[:, None] * YCC_FROM_RGB
    rows = sparse.diags_array([1.0], offsets=[1], shape=(h, h + 2))
    every = sparse.diags_array([1.0], offsets=[1], shape=(w, w + 2))
    pairs = np.zeros((w // 2, w + 2))
    for k, tap in enumerate(card.chroma_taps):
        pairs[np.arange(w // 2), 2 * np.arange(w // 2) + k] = tap
    places = [sparse.kron(rows, columns) for columns in (every, sparse.csr_array(pairs), sparse.csr_array(pairs))]
    matrix = sparse.vstack([sparse.kron(sparse.csr_array(mix[i : i + 1]), places[i]) for i in range(3)])
    added = np.repeat([black, _MIDDLE, _MIDDLE], [h * w, h * w // 2, h * w // 2])
    return sparse.csr_array(matrix), added


def yuyv_image(rgb: NDArray[Any], card: SensorCard) -> NDArray[np.uint8]:
    """Image as "yuyv", shape (H, W, 2), W even, of codes of R, G, B, shape (H, W, 3), whole or not."""
    black, scale = _scale(card)
    ycc = (np.asarray(rgb, float) @ YCC_FROM_RGB.T) * scale
    chroma = np.pad(ycc[..., 1:], [(0, 0), (1, 1), (0, 0)], mode="reflect")
    width = ycc.shape[1]
    samples = sum(tap * chroma[:, k : k + width : 2] for k, tap in enumerate(card.chroma_taps))
    codes = np.stack([ycc[..., 0] + black, np.asarray(samples).reshape(len(ycc), width) + _MIDDLE], axis=-1)
    # 0 and 255 of a limited range are kept for synchronisation
    low, high = (1, 254) if card.ycbcr_range == "limited" else (0, 255)
    return np.clip(np.rint(codes), low, high).astype(np.uint8)
