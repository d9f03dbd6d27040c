"""Mean and covariance of processed images from the mean electrons of the raw pixels.

The stages, for a window of the image (of MJPEG whole units) and the raw pixels around it:

* raw pixels: independent, mean and variance in electrons, cut at saturation;
* bilinear demosaicing, white balance, colour matrix: a sparse matrix A on electrons;
* tone curve: mean and slope under the noise, from the converter's law (`mean_codes`), or, where a colour matrix mixes
  the pixels, of a Gaussian value (`noisy_code`);
* sharpening, denoising and what the output adds, a matrix T: nothing for srgb8; Y', Cb, Cr and their 4:2:2 for yuyv;
  Y, Cb, Cr, chroma averages and DCT for mjpeg;
* denoising that spares edges: its changes of Y' are values beside the codes (`edge_sparing`), which T adds.

The outputs are what is then quantised: codes in steps of 1, or coefficients in those of JPEG's tables. Covariance:
(T D A) V (T D A)^T with the slopes D, plus what rounding adds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.processed.neighbour_filters import EdgeSparing, denoise_margin_px, edge_sparing, neighbours
from phibench.estimator.processed.output_blocks import ByPixel, Part, Support
from phibench.estimator.spots.camera_codes import (
    CHROMA_STEP,
    YCC_FROM_RGB,
    coefficients,
    mcu_px,
    noisy_code,
    qtables_of,
    quantiser_steps,
    transform,
    ycbcr_transform,
)
from phibench.estimator.spots.image_planes import full_scale_e
from phibench.estimator.spots.pixel_statistics import BESIDE_CURVE, COUNTS, MeanCodes, mean_codes
from phibench.estimator.spots.raw_pixels import PixelNoise, bayer_filters
from phibench.scenes.frames import Array

_UNITS = 2  # a window of JPEG holds 2 x 2 units: the spot is at least half a unit from its sides
_SIDE_PX = 12  # of other windows: the spot is at least 5 px from its sides, and 18 px would tell 0.1 % more
_MOST_BLOCKS = 32
_ROUNDING = 1.0 / 12.0  # variance of rounding to whole codes: uniform over one code
UNIT_MATRIX = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class ChainModel:
    """One sensor's processing of one window.

    Attributes
    ----------
    noise : PixelNoise
        Without the converter's rounding.
    shape : (h, w) of the window, whole units of JPEG or pairs of rows and columns
    margin : int
        Raw pixels around the window on each side.
    filters : shape (h + 2 margin, w + 2 margin)
    linear : sparse, shape (3 p, r)
        From electrons of the raw pixels to linear R, G, B, full scale 1, on the window and what is needed around it.
    squared : sparse, shape (3 p, r)
        Squares of its elements.
    kinds : shape (3 p,)
        Colour and number of the pixels that a value is the mean of, as rows of the tables.
    tables : MeanCodes or None
        None where a colour matrix mixes the pixels.
    sparing : EdgeSparing or None
        Changes of Y' by denoising that spares edges, q of them; None where denoising is linear, and q is 0.
    transform : shape (3 p + q, n)
        From codes, and changes of Y', to outputs.
    block : shape (n,), int
        Outputs that depend on the same codes have the same number, such as those of one block of JPEG.
    step : shape (n,)
        Of the quantiser.
    shift : shape (n,)
        What is added: levels of black and of no colour, and libjpeg's way to round chroma averages.
    rounding : shape (n,)
        Variance of the outputs from all roundings before the quantiser.
    """

    card: SensorCard
    noise: PixelNoise
    shape: tuple[int, int]
    margin: int
    filters: NDArray[np.int64]
    linear: sparse.csr_array
    squared: sparse.csr_array
    kinds: NDArray[np.int64]
    tables: MeanCodes | None
    sparing: EdgeSparing | None
    transform: Array
    block: NDArray[np.int64]
    step: Array
    shift: Array
    rounding: Array

    @cached_property
    def by_pixel(self) -> ByPixel:
        """The linear way, pixel by pixel."""
        return ByPixel.of(self.linear)

    @cached_property
    def parts(self) -> list[Part]:
        """All outputs block by block."""
        return parts_of(self, self.transform, self.block)

    @cached_property
    def supports(self) -> tuple[Support, ...]:
        """Support of each block's outputs, in the order of the blocks' numbers; none where all are one block."""
        if not self.block.any():
            return ()
        first = (int(np.argmax(self.block == number)) for number in range(int(self.block.max()) + 1))
        return tuple(self.by_pixel.support(np.flatnonzero(self.transform[:, column])) for column in first)


@dataclass(frozen=True)
class Codes:
    """Mean codes of one raw mean, and how they change; p values of a plane, three planes, and q changes of Y'.

    Attributes
    ----------
    mean : shape (..., 3 p + q), codes
    by_mean : shape (..., 3 p), change of the mean code with that of the linear light, codes per unit of full scale
    regression : shape (..., 3 p), change of a drawn code with that of the drawn light
    excess : shape (..., 3 p), variance of the codes that the regression leaves
    smoothing : shape (..., k, q), change of a change of Y' with each of k differences; None for q = 0
    """

    mean: Array
    by_mean: Array
    regression: Array
    excess: Array
    smoothing: Array | None = None

    def one(self, index: int) -> Codes:
        """Codes of one of the means."""
        smoothing = None if self.smoothing is None else self.smoothing[index]
        return Codes(self.mean[index], self.by_mean[index], self.regression[index], self.excess[index], smoothing)


@lru_cache(maxsize=16)
def chain_model(card: SensorCard, noise: PixelNoise) -> ChainModel:
    """Model of a processed output, on `window_px` pixels; kept, because it is the same for all spots.

    Parameters
    ----------
    noise : PixelNoise
        Without the converter's rounding.
    """
    way = _way(replace(card, **{**BESIDE_CURVE, "jpeg_qtables": None}))
    linear = _linear(card, way.outer, way.margin)
    tables = mean_codes(card, noise, way.whole) if card.colour_matrix == UNIT_MATRIX else None
    fixed = way.kinds, tables, way.sparing, way.transform, way.block, _steps(way.shape, card), way.shift, way.rounding
    return ChainModel(card, noise, way.shape, way.margin, way.filters, linear, linear.power(2), *fixed)


@dataclass(frozen=True)
class _Way:
    """Part that models of cameras of one make share; `outer` is the shape of the codes that count, else `ChainModel`'s.

    `whole` says that codes of R, G, B are rounded before JPEG.
    """

    shape: tuple[int, int]
    outer: tuple[int, int]
    margin: int
    whole: bool
    filters: NDArray[np.int64]
    kinds: NDArray[np.int64]
    sparing: EdgeSparing | None
    transform: Array
    block: NDArray[np.int64]
    shift: Array
    rounding: Array


@lru_cache(maxsize=8)
def _way(card: SensorCard) -> _Way:
    """Way of a camera's make; arrays are read only. Nothing here depends on the numbers in `BESIDE_CURVE`."""
    h, w = window_px(card)
    # pixels that sharpening and denoising reach beyond their own
    mixed = (card.sharpen_amount > 0.0) + denoise_margin_px(card)
    # R, G, B are whole codes before JPEG; those that sharpening or denoising mix are rounded after it
    whole = card.output == "mjpeg" and not mixed and card.colour_matrix == UNIT_MATRIX
    output = _output((h, w), card, whole)
    # each filter looks one pixel further; the mosaic needs one more
    grown = output.margin + mixed
    margin, outer = grown + 1, (h + 2 * grown, w + 2 * grown)
    filters = bayer_filters(_corner(margin, card.mosaic_phase), (outer[0] + 2, outer[1] + 2))[0]
    sharp, smooth = neighbours(outer, card)
    # outputs = transform x smoothing x sharpening of codes; kept transposed, codes by outputs
    T = ((smooth @ sharp).T @ output.transform.T).toarray()
    sparing = edge_sparing(sharp, outer, card)
    if sparing is not None:  # R, G and B change by what Y' does
        same = sparse.kron(np.ones((3, 1)), sparse.eye_array(len(sparing.centre)))
        T = np.vstack([T, card.denoise_luma * (output.transform @ same).toarray().T])
    T = np.ascontiguousarray(T)
    way = _Way(
        (h, w), outer, margin, whole, filters, _kinds(filters), sparing, T, _blocks(T), output.shift, output.rounding
    )
    for array in (way.filters, way.kinds, way.transform, way.block, way.shift, way.rounding):
        array.flags.writeable = False
    return way


def _blocks(transform: Array) -> NDArray[np.int64]:
    """Number of each output's block, shape (n,); one for all where there are many, whose products are not worth it."""
    first: dict[bytes, int] = {}
    block = np.array([first.setdefault(row.tobytes(), len(first)) for row in transform.T != 0.0], np.int64)
    # codes that different blocks do not share need no product
    return block if len(first) <= _MOST_BLOCKS else np.zeros_like(block)


def window_px(card: SensorCard) -> tuple[int, int]:
    """Rows and columns of a model's window."""
    if card.output != "mjpeg":
        return _SIDE_PX, _SIDE_PX
    down, across = mcu_px(card.jpeg_subsampling)
    return _UNITS * down, _UNITS * across


def codes(model: ChainModel, mean_e: Array) -> Codes:
    """Mean codes and their slopes for means of the raw pixels, shape (..., r), electrons."""
    at = _codes(model, mean_e)
    if model.sparing is None:
        return at
    flat, noise_e = at.mean.reshape(-1, at.mean.shape[-1]), np.sqrt(raw_variance_e2(model, mean_e))
    regression, noise_e = (x.reshape(len(flat), -1) for x in (at.regression, noise_e))
    parts = [
        model.sparing.means(mean, _spread(model, slope, sigma_e))
        for mean, slope, sigma_e in zip(flat, regression, noise_e, strict=True)
    ]
    lead = at.mean.shape[:-1]
    change, smoothing = (np.stack(x) for x in zip(*parts, strict=True))
    mean = np.concatenate([at.mean, change.reshape(*lead, -1)], axis=-1)
    return Codes(mean, at.by_mean, at.regression, at.excess, smoothing.reshape(*lead, *smoothing.shape[1:]))


def _codes(model: ChainModel, mean_e: Array) -> Codes:
    """Codes of R, G, B alone."""
    linear = _apply(model.linear, mean_e)
    if model.tables is None:
        sigma = np.sqrt(_apply(model.squared, raw_variance_e2(model, mean_e)))
        n = noisy_code(linear, sigma, model.card)
        # the slope carries (by_mean sigma)^2 through the matrices: only what is left of the variance is added as white
        excess = np.maximum(n.variance - (n.by_mean * sigma) ** 2, 0.0)
        return Codes(255.0 * n.mean, 255.0 * n.by_mean, 255.0 * n.by_mean, 255.0**2 * excess)
    # back to electrons of one pixel of the colour, in which the tables are
    gain = np.repeat(full_scale_e(model.card) / np.asarray(model.card.white_balance), linear.shape[-1] // 3)
    names = ("mean", "by_mean", "regression", "excess")
    mean, by_mean, regression, excess = model.tables.values(names, linear * gain, model.kinds)
    return Codes(mean, by_mean * gain, regression * gain, excess)


def raw_variance_e2(model: ChainModel, mean_e: Array) -> Array:
    """Variance of the raw pixels, shape as `mean_e`, rounding included."""
    # rounding to DN: uniform over one, 1 / 12 of it squared
    return model.noise.variance_e2(mean_e) + 1.0 / (12.0 * model.card.dn_per_e**2)


def code_slopes(model: ChainModel, at: Codes, derivatives: Array) -> Array:
    """Derivatives of `Codes.mean`, shape (..., k, 3 p + q), from those of the raw pixels, shape (..., k, r)."""
    slopes = at.by_mean[..., None, :] * _apply(model.linear, derivatives)
    if model.sparing is None or at.smoothing is None:
        return slopes
    if slopes.ndim == 2:
        return np.concatenate([slopes, model.sparing.changes(at.smoothing, slopes)], axis=-1)
    each = [model.sparing.changes(a, b) for a, b in zip(at.smoothing, slopes, strict=True)]
    return np.concatenate([slopes, np.stack(each)], axis=-1)


def parts_of(model: ChainModel, transform: Array, block: NDArray[np.int64]) -> list[Part]:
    """Outputs of a model, or some of them, block by block; `transform` holds zeros beside the parts."""
    if not model.supports:
        codes = np.flatnonzero(transform.any(axis=1))
        columns = np.arange(transform.shape[1])
        return [Part(0, codes, columns, np.ascontiguousarray(transform[codes]))] if len(columns) else []
    parts = []
    for number in np.unique(block):
        columns, codes = np.flatnonzero(block == number), model.supports[number].codes
        parts.append(Part(int(number), codes, columns, np.ascontiguousarray(transform[np.ix_(codes, columns)])))
    return parts


def noise_factor(
    model: ChainModel, at: Codes, variance_e2: Array, transform: Array, parts: Sequence[Part] | None = None
) -> Array:
    """Matrix F, shape (r, n), of which F^T F is the coefficients' covariance from the raw pixels' noise; one window.

    Parameters
    ----------
    at : Codes, of one window
    variance_e2 : shape (r,)
    transform : shape (3 p + q, n), of those coefficients
    parts : the same block by block, if known
    """
    # F = (slopes x sigma)^T x transform: C = F^T F needs no covariance of the raw pixels
    way, sigma_e = model.by_pixel, np.sqrt(variance_e2)
    spread = way.spread(at.regression, sigma_e)
    if parts is None or not model.supports or model.sparing is not None:
        matrix = sparse.csr_array((spread, way.codes, way.ends), shape=(len(sigma_e), way.count))
        return np.asarray(matrix @ _of_codes(model, at, transform))
    F = np.zeros((len(sigma_e), transform.shape[1]))
    for part in parts:
        support = model.supports[part.number]
        F[np.ix_(support.pixels, part.columns)] = support.matrix(spread) @ part.matrix
    return F


def excess_variance(model: ChainModel, at: Codes, transform: Array, parts: Sequence[Part] | None = None) -> Array:
    """Variance of outputs, shape (n,), by what the regression of the codes leaves; one window; as `noise_factor`."""
    if parts is None or model.sparing is not None:
        T = _of_codes(model, at, transform)
        return np.asarray(np.einsum("p,pn,pn->n", at.excess, T, T))
    variance = np.zeros(transform.shape[1])
    for part in parts:
        variance[part.columns] = np.einsum("p,pn,pn->n", at.excess[part.codes], part.matrix, part.matrix)
    return variance


def _spread(model: ChainModel, regression: Array, sigma_e: Array) -> sparse.csr_array:
    """Matrix from noise of variance 1 of the raw pixels to the codes, shape (3 p, r)."""
    return sparse.csr_array(sparse.diags_array(regression) @ model.linear @ sparse.diags_array(sigma_e))


def _of_codes(model: ChainModel, at: Codes, transform: Array) -> Array:
    """Outputs by codes of R, G, B, shape (3 p, n), the changes of Y' included."""
    if model.sparing is None or at.smoothing is None:
        return transform
    count = len(at.by_mean)
    return np.asarray(transform[:count] + model.sparing.of_codes(at.smoothing, transform[count:]))


def _apply(matrix: sparse.csr_array, values: Array) -> Array:
    """Matrix times the last axis."""
    flat = values.reshape(-1, values.shape[-1])
    return np.asarray((matrix @ flat.T).T).reshape(*values.shape[:-1], -1)


def _linear(card: SensorCard, outer: tuple[int, int], margin: int) -> sparse.csr_array:
    """Demosaicing by the mean of a colour's pixels among the nearest 3 x 3, or the own one; gains; matrix."""
    h, w = outer
    planes = sparse.vstack([_interpolation(h, w, margin, colour, card.mosaic_phase) for colour in range(3)]).tocsr()
    # columns of the matrix times the gains: 1 at full scale
    mix = np.asarray(card.colour_matrix) * np.asarray(card.white_balance) / full_scale_e(card)
    return sparse.csr_array(sparse.kron(sparse.csr_array(mix), sparse.eye_array(h * w)) @ planes)


def _kinds(filters: NDArray[np.int64]) -> NDArray[np.int64]:
    """3 x colour + place of the number of pixels in `COUNTS`, of all values of three planes."""
    inner = filters[1:-1, 1:-1]
    rows = []
    for colour in range(3):
        distance = np.abs(inner - colour)  # 0: own pixel
        # red and blue at a green pixel have two neighbours, all others four
        count = np.where(distance == 0, 1, np.where((inner == 1) & (colour != 1), 2, 4))
        rows.append(3 * colour + np.searchsorted(COUNTS, count))
    return np.concatenate([row.ravel() for row in rows])


def _corner(margin: int, phase: tuple[int, int]) -> NDArray[np.int64]:
    """Place in the mosaic of the first raw pixel around a window, shape (1, 2): the window's own first is even."""
    return (margin + np.array([phase])) % 2


@lru_cache(maxsize=32)
def _interpolation(h: int, w: int, margin: int, colour: int, phase: tuple[int, int]) -> sparse.csr_array:
    """One plane, shape (h w, (h + 2)(w + 2))."""
    filters = bayer_filters(_corner(margin, phase), (h + 2, w + 2))[0]
    rows, columns, values = [], [], []
    for v in range(1, h + 1):
        for u in range(1, w + 1):
            own = filters[v, u] == colour
            near = (
                [(v, u)]
                if own
                else [(a, b) for a in (v - 1, v, v + 1) for b in (u - 1, u, u + 1) if filters[a, b] == colour]
            )
            rows += [(v - 1) * w + u - 1] * len(near)
            columns += [a * (w + 2) + b for a, b in near]
            values += [1.0 / len(near)] * len(near)
    return sparse.csr_array((values, (rows, columns)), shape=(h * w, (h + 2) * (w + 2)))


@dataclass(frozen=True)
class _Output:
    """Way from codes of R, G, B on the window and `margin` pixels around to outputs; fields as `ChainModel`'s."""

    transform: sparse.csr_array
    margin: int
    shift: Array
    rounding: Array


def _output(shape: tuple[int, int], card: SensorCard, whole: bool) -> _Output:
    """Transform to what is quantised, shape (n, 3 p); `whole` codes are rounded before it, in their own law."""
    if card.output == "mjpeg":
        parts = shape, card.jpeg_subsampling
        rounding = _rounding(*parts, 0.0 if whole else _ROUNDING)
        return _Output(sparse.csr_array(transform(*parts)), 0, _shift(*parts), rounding)
    count = shape[0] * shape[1]
    if card.output == "yuyv":
        matrix, shift = ycbcr_transform(shape, card)
        return _Output(matrix, 1, shift, np.zeros(2 * count))
    return _Output(sparse.csr_array(sparse.eye_array(3 * count)), 0, *np.zeros((2, 3 * count)))


def _steps(shape: tuple[int, int], card: SensorCard) -> Array:
    """Quantiser's steps, shape (n,)."""
    if card.output == "mjpeg":
        return quantiser_steps(shape, card.jpeg_subsampling, qtables_of(card))
    return np.ones((2 if card.output == "yuyv" else 3) * shape[0] * shape[1])


def _shift(shape: tuple[int, int], subsampling: str) -> Array:
    """Coefficients of what is added before the DCT: -128 on Y, and the mean error of libjpeg's chroma averages."""
    h, w = shape
    down, across = CHROMA_STEP[subsampling]
    ycc = np.zeros((3, h, w))
    # JPEG codes Y less 128; chroma lies about 0 already
    ycc[0] = -128.0
    # libjpeg adds 0, 1, 0, 1 before it halves (1, 2, 1, 2 before it quarters): -1/4 and +1/4 (-1/8, +1/8) in turns
    if across > 1:
        ycc[1:] = (0.25 / down) * np.where(np.arange(w) // across % 2 == 0, -1.0, 1.0)
    return coefficients(np.einsum("ij,jhw->ihw", np.linalg.inv(YCC_FROM_RGB), ycc), subsampling)


def _rounding(shape: tuple[int, int], subsampling: str, of_rgb: float) -> Array:
    """Variance of orthonormal coefficients of white rounding: R, G, B by `of_rgb`, Y Cb Cr to integers, averages."""
    down, across = CHROMA_STEP[subsampling]
    count, n = shape[0] * shape[1], down * across
    of_codes = of_rgb * np.sum(YCC_FROM_RGB**2, axis=1)
    # mean square of rounding to whole numbers: halves err by 0, 1/2; quarters by 0, 1/4, 1/2, 1/4
    average = {1: 0.0, 2: 0.125, 4: 0.094}[n]
    chroma = [(code + _ROUNDING) / n + average for code in of_codes[1:]]
    return np.concatenate([np.full(count, of_codes[0] + _ROUNDING), *(np.full(count // n, code) for code in chroma)])
