"""Codes of processed images for the estimator: tone curves, Y'CbCr 4:2:2, JPEG coefficients, statistics of a quantiser.

* A tone curve takes linear light, full scale 1, to encoded R, G, B: sRGB (IEC 61966-2-1), Rec. 709 (ITU-R BT.709), or
  a measured table whose points straight lines join. `card.transfer_function` says which.
* "yuyv" images are bytes, shape (H, W, 2): Y' of each pixel, and in turns Cb (even columns) and Cr of a pair of pixels
  (ITU-R BT.601). `rgb_codes` is what a viewer makes of them, `ycbcr_codes` the numbers themselves; nothing is lost.

The simulator has its own (`render.sensor.processing`); tests compare the two.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.fft import dctn
from scipy.ndimage import uniform_filter
from scipy.special import ndtr

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.scenes.frames import Array

# Baseline JPEG as linear algebra: tables, transform, and the quantiser's statistics.
#
# * Numbers: ITU-T T.81 (1992), annex K, for the quantisation tables; libjpeg's scaling of them by the quality; JFIF
# 1.02 for the colours. `coefficients` is the linear part of the encoder, without rounding.
# * `room_variance`: error of the room's coefficients, known from the laser-off frame to a quantiser's step only. A
# coefficient c lies anywhere in its step s, with the variance s^2 / 12. Where the room is flat, the high frequencies
# are 0 and their step says nothing: of a coefficient whose neighbours have the mean square P the error has the variance
# (s^2 / 12) P / (P + s^2 / 12), Wiener's for two Gaussian laws.
# * `quantised_output`: mean, slope, variance of a Gaussian behind a uniform quantiser. Steps are in the unit of values.


Tables = tuple[tuple[int, ...], tuple[int, ...]]
BLOCK_PX = 8
CHROMA_STEP = {"4:4:4": (1, 1), "4:2:2": (1, 2), "4:2:0": (2, 2)}
"""Rows and columns of pixels per chroma sample."""

RGB_FROM_YCC = np.array([[1.0, 0.0, 1.402], [1.0, -0.344136286, -0.714136286], [1.0, 1.772, 0.0]])
YCC_FROM_RGB = np.linalg.inv(RGB_FROM_YCC)

_LUMA = """16 11 10 16 24 40 51 61 12 12 14 19 26 58 60 55 14 13 16 24 40 57 69 56 14 17 22 29 51 87 80 62
18 22 37 56 68 109 103 77 24 35 55 64 81 104 113 92 49 64 78 87 103 121 120 101 72 92 95 98 112 100 103 99"""
_CHROMA = """17 18 24 47 99 99 99 99 18 21 26 66 99 99 99 99 24 26 56 99 99 99 99 99 47 66 99 99 99 99 99 99
99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99 99"""


def mcu_px(subsampling: str) -> tuple[int, int]:
    """Rows and columns of a minimum coded unit."""
    down, across = CHROMA_STEP[subsampling]
    return BLOCK_PX * down, BLOCK_PX * across


def qtables_of(card: SensorCard) -> int | Tables:
    """Quality of a card's JPEG, or its tables where it has some."""
    return card.jpeg_quality if card.jpeg_qtables is None else card.jpeg_qtables


def quantisation(quality: int | Tables) -> tuple[Array, Array]:
    """Steps of luma and chroma coefficients, shape (8, 8) each, rows are vertical frequencies.

    Parameters
    ----------
    quality : libjpeg's, 1 to 100, or the two tables, 64 steps each, row by row

    Raises
    ------
    ValueError
        If the quality is none of libjpeg's.
    """
    if not isinstance(quality, int):
        first, second = (np.array(table, float).reshape(8, 8) for table in quality)
        return first, second
    if not 1 <= quality <= 100:
        raise ValueError(f"JPEG quality {quality}: allowed range is 1 to 100")
    percent = 5000 // quality if quality < 50 else 200 - 2 * quality  # libjpeg's jpeg_quality_scaling, in whole numbers
    tables = (np.array(text.split(), int).reshape(8, 8) for text in (_LUMA, _CHROMA))
    # baseline tables have 8 bits, and no step is 0
    luma, chroma = (np.clip((table * percent + 50) // 100, 1, 255).astype(float) for table in tables)
    return luma, chroma


def blocks(plane: Array) -> Array:
    """DCT coefficients of 8 x 8 blocks, shape (..., h/8, w/8, 8, 8), of a plane, shape (..., h, w); orthonormal."""
    *lead, h, w = plane.shape
    cut = plane.reshape(*lead, h // 8, 8, w // 8, 8)
    return np.asarray(dctn(np.moveaxis(cut, -2, -3), axes=(-2, -1), norm="ortho"))


def block_means(plane: Array, step: tuple[int, int]) -> Array:
    """Means of `step` pixels, shape (..., h / down, w / across)."""
    *lead, h, w = plane.shape
    return np.asarray(plane.reshape(*lead, h // step[0], step[0], w // step[1], step[1]).mean(axis=(-3, -1)))


def coefficients(rgb: Array, subsampling: str) -> Array:
    """Coefficients of an image, shape (..., n): Y, then Cb, then Cr, block after block, without rounding.

    Parameters
    ----------
    rgb : shape (..., 3, h, w), whole units, codes 0 to 255
    subsampling : "4:4:4", "4:2:2" or "4:2:0"
    """
    ycc = np.einsum("ij,...jhw->i...hw", YCC_FROM_RGB, rgb)
    step = CHROMA_STEP[subsampling]
    planes = (ycc[0], block_means(ycc[1], step), block_means(ycc[2], step))
    lead = rgb.shape[:-3]
    return np.concatenate([blocks(plane).reshape(*lead, -1) for plane in planes], axis=-1)


@lru_cache(maxsize=8)
def transform(shape: tuple[int, int], subsampling: str) -> Array:
    """Matrix of `coefficients`, shape (n, 3 h w), for an image of `shape`, read only."""
    h, w = shape
    matrix = np.ascontiguousarray(coefficients(np.eye(3 * h * w).reshape(-1, 3, h, w), subsampling).T)
    matrix.flags.writeable = False
    return matrix


def quantiser_steps(shape: tuple[int, int], subsampling: str, quality: int | Tables) -> Array:
    """Quantiser's step of each of `coefficients`, shape (n,); quality as in `quantisation`."""
    luma, chroma = quantisation(quality)
    down, across = CHROMA_STEP[subsampling]
    count = shape[0] * shape[1] // 64
    return np.concatenate([np.tile(luma.ravel(), count), np.tile(chroma.ravel(), 2 * count // (down * across))])


# -- room behind a spot ----------------------------------------------------------------------------------------------

_SIDE = 8
_TERMS = 60  # of the sum over k: 1 % are left out without noise, nothing from a tenth of a step on
_NEAR = 3  # frequencies on a side of the square that the mean is taken over


def room_variance(coefficients: Array, step: Array, hidden: float | Array = 1.0) -> Array:
    """Variance of the error of the room's coefficients, shape (n,).

    Parameters
    ----------
    coefficients : shape (n,)
        Of the quantised frame without the laser, or the mean of several, blocks of 8 x 8 one after the other.
    step : shape (n,), of the quantiser
    hidden : 1, or shape (n,)
        Of several frames: `hidden_share`.
    """
    blocks = np.asarray(coefficients, float).reshape(-1, _SIDE, _SIDE)
    power = blocks * blocks
    power[:, 0, 0] = 0.0  # the level says nothing of the structure
    near = uniform_filter(power, (0, _NEAR, _NEAR), mode="constant") * _NEAR**2 / _counts()
    quantised = hidden * step * step / 12.0  # an error that is uniform over a step
    mean = near.ravel()
    variance = quantised * mean / (mean + quantised)
    levels = np.zeros((_SIDE, _SIDE), bool)
    levels[0, 0] = True
    return np.where(np.tile(levels.ravel(), len(blocks)), quantised, variance)


def step_correlation(sigma: Array) -> Array:
    """Correlation between frames of a quantiser's error, shape of `sigma`, the noise in steps; places spread evenly.

    6 / pi^2 sum over k of exp(-4 pi^2 k^2 sigma^2) / k^2 (B. Widrow, I. Kollar, "Quantization Noise", 2008, chapter 6).
    """
    k = np.arange(1, _TERMS + 1)
    terms = np.exp(-4.0 * np.pi**2 * k**2 * np.asarray(sigma)[..., None] ** 2) / k**2
    return np.asarray(6.0 / np.pi**2 * terms.sum(axis=-1))


def hidden_share(sigma: Array, count: int) -> Array:
    """Variance of a quantiser's error in the mean of frames over that in one, shape of `sigma`, the noise in steps."""
    rho = step_correlation(sigma)
    return np.asarray(rho + (1.0 - rho) / count)


def _counts() -> Array:
    """Frequencies in each square: at the block's sides, and beside the level, there are fewer."""
    there = np.ones((_SIDE, _SIDE))
    there[0, 0] = 0.0
    return np.asarray(np.maximum(uniform_filter(there, _NEAR, mode="constant") * _NEAR**2, 1.0))


# -- statistics of a quantiser ---------------------------------------------------------------------------------------

_FINE = 0.9  # standard deviations per step from which the output is input plus rounding: off by 2e-7 steps
_THRESHOLDS = np.arange(-5, 6) + 0.5  # about the nearest multiple: 5 steps are 5.5 of the coarsest deviation
_LEAST = 1e-4  # standard deviation in steps; a smaller one would make slopes that no step of a fit can follow


@dataclass(frozen=True)
class QuantisedOutput:
    """Output for Gaussian inputs, arrays of the inputs' shape.

    Attributes
    ----------
    mean : E Q
    slope : its derivative by the input's mean
    variance : of Q
    """

    mean: Array
    slope: Array
    variance: Array


def quantised_output(mean: Array, sigma: Array, step: Array) -> QuantisedOutput:
    """Round to multiples of `step`, halves either way; arrays broadcast together."""
    m, s, q = np.broadcast_arrays(mean / step, np.maximum(sigma / step, _LEAST), step)
    fine = s >= _FINE
    result = QuantisedOutput(
        m * q, np.ones_like(m), (s**2 + 1.0 / 12.0) * q**2
    )  # Sheppard: rounding adds a uniform error
    if fine.all():
        return result
    coarse = ~fine
    first, slope, variance = _sums(m[coarse], s[coarse])
    q = q[coarse]
    result.mean[coarse], result.slope[coarse], result.variance[coarse] = first * q, slope, variance * q**2
    return result


def _sums(m: Array, s: Array) -> tuple[Array, Array, Array]:
    """Unit step: round(x) = nearest + sum over thresholds above of 1[x > t] - sum below of 1[x < t]."""
    nearest = np.rint(m)
    t = (nearest[:, None] + _THRESHOLDS - m[:, None]) / s[:, None]
    above = ndtr(-t)  # chance to be above each threshold
    slope = np.exp(-0.5 * t * t).sum(axis=1) / (np.sqrt(2.0 * np.pi) * s)
    low = _THRESHOLDS[0] - 0.5
    mean = low + above.sum(axis=1)  # relative to the nearest
    # k^2 = sum of its increases 2 k' - 1 over the thresholds passed, k' the multiple above the threshold
    square = low**2 + above @ (2.0 * _THRESHOLDS)
    return nearest + mean, slope, np.maximum(square - mean**2, 0.0)


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
