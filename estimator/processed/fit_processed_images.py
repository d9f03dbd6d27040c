"""Fit of spots in processed images, through the camera's own chain: mosaic, demosaicing, tone curve, 8 bits, JPEG.

`fit_srgb` takes processed 8-bit images, `fit_yuyv` Y'CbCr ones, `fit_jpeg` decoded MJPEG ones. Fits to the luminance
have a floor of 0.1 to 0.25 px that does not fall with the signal, because a demosaiced, gamma-encoded spot is no
Gaussian. A fit of the raw pixels' model through the same processing has none.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.geometry.status import Status, flag, keep
from phibench.estimator.processed.chain_model import UNIT_MATRIX, ChainModel, chain_model, window_px
from phibench.estimator.processed.fit_processed_region import JpegRegion, fit_region, grid_px, region_window
from phibench.estimator.processed.inverse_processing import mean_unprocessed_electrons
from phibench.estimator.processed.quasi_score import CoefficientWindow, WindowFit
from phibench.estimator.spots.camera_codes import mcu_px
from phibench.estimator.spots.fit_raw import LEAST_SNR, SpotData, SpotFit, fit_law, spot_data
from phibench.estimator.spots.gaussian_spot import SpotBlur, SpotModel, covariance_bound
from phibench.estimator.spots.pixel_statistics import code_law, code_table
from phibench.estimator.spots.raw_pixels import (
    Background,
    GaussLaw,
    PixelNoise,
    bayer_filters,
    noise_before_rounding,
    spot_regions,
)
from phibench.scenes.frames import Array

_CUT_PX = 15  # side of the square of the first fit
_MATCHED = (0.0, 0.8, 0.8)  # px, of (image, v, u): a spot in focus has 0.7 px and the pixel, together 0.76 px
_LEVEL_PX = 2.0  # over which the level is taken that a pixel's noise is reckoned from
_ASTRAY_PX = 2.0  # from where the spot was seen
_ROUGH_CODES2 = 4.0  # variance of a decoded code that the first fit reckons with, codes squared


def fit_srgb(
    images: NDArray[Any],
    origin_px: ArrayLike,
    card: SensorCard,
    blur: SpotBlur,
    model: SpotModel | None = None,
    extra_e2: float = 0.0,
    background: Background | None = None,
    near_px: ArrayLike | None = None,
) -> SpotFit:
    """Fit one spot in each region of processed 8-bit images.

    Where each pixel's own colour is an interval of electrons (`codes_are_independent`), the likelihood of a single
    frame is exact (`pixel_statistics`). Otherwise mean and covariance of all codes are fitted, as `fit_jpeg` does it.

    Parameters
    ----------
    images : shape (n, h, w, 3), uint8; (n, f, h, w, 3) of f frames of each
    origin_px : shape (2,) or (n, 2)
        Image pixel (u, v) of the first column and row.
    blur, model
        As for `fit_law`.
    extra_e2 : float
        Variance of the known background's error, electrons squared; frames share it.
    background : Background, optional
        Where all codes are fitted, instead of the model's background and `extra_e2`.
    near_px
        As for `fit_law`.

    Raises
    ------
    ValueError
        If the images are not of three planes, or the sensor has no mosaic.
    """
    planes = _checked(images, card)
    origin = np.broadcast_to(np.asarray(origin_px, np.int64), (len(planes), 2))
    if not codes_are_independent(card) or planes.shape[1] > 1:
        known, shape = None if model is None else model.background_e, (len(planes), *planes.shape[2:4])
        levels = np.zeros(shape) if known is None else np.broadcast_to(known, shape)
        background = background or Background(levels, np.full(levels.shape, extra_e2))
        return _fit_windows(planes, origin, card, blur, model, background, near_px=near_px)
    data = code_data(planes[:, 0], origin, card, blur, model, extra_e2)
    return fit_law(data.regions, data.law, blur, model, near_px)


def code_data(
    planes: NDArray[np.uint8],
    origin: NDArray[np.int64],
    card: SensorCard,
    blur: SpotBlur,
    model: SpotModel | None = None,
    extra_e2: float = 0.0,
) -> SpotData:
    """Likelihood of each pixel's own code, of one frame, for `codes_are_independent`; the rest as `fit_srgb`."""
    filters = bayer_filters(origin + card.mosaic_phase, planes.shape[1:3])
    noise = noise_before_rounding(card)
    noise = PixelNoise(noise.gaussian_e2 + extra_e2, noise.prnu)
    table = code_table(card)
    codes = np.take_along_axis(planes, filters[..., None], axis=3)[..., 0]
    law = code_law(codes, filters, card, noise, table)
    regions = spot_regions(table.middle_e[filters, codes], origin, phase=card.mosaic_phase)
    return spot_data(regions, law, blur, model)


def fit_yuyv(
    images: NDArray[Any],
    origin_px: ArrayLike,
    card: SensorCard,
    blur: SpotBlur,
    model: SpotModel | None = None,
    background: Background | None = None,
    near_px: ArrayLike | None = None,
) -> SpotFit:
    """Fit one spot in each region of Y'CbCr 4:2:2 images, to their codes.

    Parameters
    ----------
    images : shape (n, h, w, 2), uint8; (n, f, h, w, 2) of f frames of each
        13 x 13 pixels or more.
    origin_px : shape (2,) or (n, 2)
        Image pixel (u, v) of the first column and row; it may be odd.
    card, blur, model, background, near_px
        As for `fit_jpeg`.

    Raises
    ------
    ValueError
        If the images are not of two planes or too small, or the sensor has no mosaic.
    """
    planes = _checked(images, card, 2)
    origin = np.broadcast_to(np.asarray(origin_px, np.int64), (len(planes), 2))
    return _fit_windows(planes, origin, card, blur, model, background, near_px=near_px)


def fit_jpeg(
    images: NDArray[Any],
    origin_px: ArrayLike,
    card: SensorCard,
    blur: SpotBlur,
    model: SpotModel | None = None,
    background: Background | None = None,
    size_px: tuple[int, int] = (1280, 720),
    near_px: ArrayLike | None = None,
) -> SpotFit:
    """Fit one spot in each region of decoded MJPEG images.

    Parameters
    ----------
    images : shape (n, h, w, 3), uint8; (n, f, h, w, 3) of f frames of each
        Whole units of the JPEG, 2 x 2 or more; one more on each side helps.
    origin_px : shape (2,) or (n, 2)
        Image pixel (u, v) of the first column and row, on the grid of units.
    card : SensorCard
        With the quality and the subsampling of the JPEG.
    blur, model
        As for `fit_law`; the model's background is not looked at, `background` is.
    background : Background, optional
        Room behind the spot; flat if it is not given. Levels per filter are fitted on top of it.
    size_px : (width, height) of the image
    near_px
        As for `fit_law`.

    Returns
    -------
    SpotFit
        As of `fit_raw`; `background_e` are the levels, `chi2` is of the coefficients.

    Raises
    ------
    ValueError
        If the images are not of three planes or not on the grid of units, or the sensor has no mosaic.
    """
    planes = _checked(images, card)
    origin = np.broadcast_to(np.asarray(origin_px, np.int64), (len(planes), 2))
    _on_grid(origin, planes.shape[2:4], card)
    return _fit_windows(planes, origin, card, blur, model, background, size_px, near_px)


def codes_are_independent(card: SensorCard) -> bool:
    """True if each pixel's own colour alone decides about its code."""
    smooth = max(card.sharpen_amount, card.denoise_luma, card.denoise_chroma) == 0.0
    return card.output == "srgb8" and smooth and card.colour_matrix == UNIT_MATRIX


def _fit_windows(
    planes: NDArray[np.uint8],
    origin: NDArray[np.int64],
    card: SensorCard,
    blur: SpotBlur,
    model: SpotModel | None,
    background: Background | None,
    size_px: tuple[int, int] = (0, 0),
    near_px: ArrayLike | None = None,
) -> SpotFit:
    """Fit each image's window of outputs; `size_px` of the whole image matters for JPEG alone."""
    n, model = len(planes), model or SpotModel()
    if n == 0:
        return _collected([], origin, np.zeros(0), model.free_width)
    chain, blurs = _chain(card, background), blur.each(n)
    widths = np.asarray(blurs.sigma_px)
    first = first_fit(planes, origin, card, SpotBlur(widths), model.response, background, near_px)
    rows = []
    for i in range(n):
        start = first[i] if not model.free_width else np.append(first[i], widths[i])
        region, corner = _region(planes[i], origin[i], card, background, i, size_px)
        start[:2] -= corner
        fit, off = fit_region(region, chain, start[None], blurs.rows(np.array([i])), model)
        fit.theta[:2] += corner
        rows.append((fit, off))
    return _collected(rows, origin, widths, model.free_width)


def _chain(card: SensorCard, background: Background | None) -> ChainModel:
    """Model of the processing; the room's pattern is the background's, where that holds it."""
    return chain_model(card, noise_before_rounding(card, background is not None and background.holds_pattern))


def _region(
    frames: NDArray[np.uint8],
    origin: NDArray[np.int64],
    card: SensorCard,
    background: Background | None,
    index: int,
    size_px: tuple[int, int],
) -> tuple[JpegRegion, Array]:
    """Region of one image's frames, and its first row and column (u, v): the window's grid begins there."""
    (u0, v0), (h, w), zero = origin, frames.shape[1:3], np.zeros(frames.shape[1:3])
    ends = (bool(v0 == 0), bool(v0 + h == size_px[1]), bool(u0 == 0), bool(u0 + w == size_px[0]))
    known = (zero, zero) if background is None else (background.mean_e[index], background.variance_e2[index])
    room = None if background is None or background.image is None else _frames_of(background.image)[index]
    prnu = card.prnu if background is not None and background.holds_pattern else 0.0
    u1, v1 = origin % np.array(grid_px(card)[::-1])
    behind = (known[0][v1:, u1:], known[1][v1:, u1:])
    return JpegRegion(frames[:, v1:, u1:], ends, *behind, room, prnu), np.array([u1, v1])


def spot_window(
    image: NDArray[np.uint8],
    origin: NDArray[np.int64],
    uv_px: Array,
    card: SensorCard,
    blur: SpotBlur,
    model: SpotModel,
    background: Background | None,
    size_px: tuple[int, int],
) -> tuple[CoefficientWindow, Array, Array]:
    """Window of outputs of one image, a start of a fit at (u, v) of the whole image, and the window's corner there.

    Parameters as for `fit_jpeg`, with n = 1; `image` has the shape (1, f, h, w, planes), `origin` (1, 2).
    """
    planes = _checked(image, card, image.shape[-1])
    region, corner = _region(planes[0], origin[0], card, background, 0, size_px)
    single = blur.each(1)
    lens = SpotBlur(np.asarray(single.sigma_px))
    start = first_fit(planes, origin, card, lens, model.response, background, uv_px)[0]
    chain = _chain(card, background)
    window, first = region_window(region, chain, uv_px - origin[0] - corner, single, model)
    place = first + corner + origin[0]
    start[:2] = uv_px - place
    return window, start, place


def first_fit(
    images: NDArray[Any],
    origin: NDArray[np.int64],
    card: SensorCard,
    blur: SpotBlur,
    response: tuple[float, float, float] | None,
    background: Background | None = None,
    near_px: ArrayLike | None = None,
) -> Array:
    """Start of a fit, shape (n, 6): u, v in the region, flux, levels; a Gaussian fit of each pixel's own colour.

    `images` have the shape (n, f, h, w, c), f frames of each. It begins near `near_px` as `fit_law` does; where it
    leads farther away than `_ASTRAY_PX`, the start is that place.
    """
    if response is None:
        raise ValueError("the fit through the chain needs the response of the filters: SpotModel(response=...)")
    filters = bayer_filters(origin + card.mosaic_phase, images.shape[2:4])
    x, extra = mean_unprocessed_electrons(images, origin, card)
    rough, spread = _ROUGH_CODES2 * 12.0 * extra, noise_before_rounding(card)
    variance = spread.variance_e2(gaussian_filter(np.maximum(x, 0.0), (0.0, _LEVEL_PX, _LEVEL_PX))) + rough
    x = x - (0.0 if background is None else background.mean_e)
    if near_px is None:
        near = origin + _outstanding(x, variance, filters, response)
    else:
        near = np.broadcast_to(np.asarray(near_px, float), (len(x), 2))
    x, rough, corner = _cut(x, rough, np.rint(near - origin).astype(np.int64))
    regions = spot_regions(x, origin + corner, phase=card.mosaic_phase)
    fit = fit_law(regions, GaussLaw(spread, rough), blur, SpotModel(response), near)
    good = (fit.status == Status.OK) & (np.linalg.norm(fit.uv_px - near, axis=1) < _ASTRAY_PX)
    uv = np.where(good[:, None], fit.uv_px, near) - origin
    levels = np.where(good[:, None], fit.background_e, np.median(x, axis=(1, 2))[:, None])
    # the brightest pixel of a spot in focus holds about a quarter of its light
    flux = np.where(good, fit.flux_e, np.maximum(x.reshape(len(x), -1).max(axis=1) * 4.0, 1.0))
    return np.column_stack([uv, flux, levels])


def _outstanding(
    x: Array, variance: Array, filters: NDArray[np.int64], response: tuple[float, float, float]
) -> NDArray[np.int64]:
    """Pixel (u, v) of regions, shape (n, 2), at which a spot stands out most from its noise."""
    seen = np.asarray(response)[filters]
    level = np.stack([np.where(filters == c, np.median(x, axis=(1, 2))[:, None, None], 0.0) for c in range(3)]).sum(0)
    weight = seen / variance
    match = gaussian_filter(weight * (x - level), _MATCHED) / np.sqrt(gaussian_filter(weight * seen, _MATCHED))
    v, u = np.unravel_index(np.argmax(match.reshape(len(x), -1), axis=1), x.shape[1:])
    return np.stack([u, v], axis=1)


def _cut(x: Array, extra: Array, middle: NDArray[np.int64]) -> tuple[Array, Array, NDArray[np.int64]]:
    """Squares about pixels (u, v), shape (n, 2): values, variances, and the squares' corners (u, v)."""
    h, w = (min(_CUT_PX, side) for side in x.shape[1:])
    corner = np.clip(middle - [w // 2, h // 2], 0, [x.shape[2] - w, x.shape[1] - h])
    parts = [(slice(b, b + h), slice(a, a + w)) for a, b in corner]
    cut_x, cut_extra = (np.stack([values[i][part] for i, part in enumerate(parts)]) for values in (x, extra))
    return cut_x, cut_extra, np.asarray(corner, np.int64)


def _collected(
    rows: list[tuple[WindowFit, Array]], origin: NDArray[np.int64], widths: Array, free_width: bool
) -> SpotFit:
    # u, v, flux, three levels, width
    theta = np.array([fit.theta for fit, _ in rows]).reshape(-1, 7 if free_width else 6)
    covariance = np.stack([covariance_bound(fit.fisher, keep=3) for fit, _ in rows]) if rows else np.zeros((0, 3, 3))
    off = np.array([off for _, off in rows]).reshape(-1, 2)
    status = flag(
        (~(theta[:, 2] > LEAST_SNR * np.sqrt(covariance[:, 2, 2])), Status.NO_SPOT),
        ((off > 1.0).any(axis=1), Status.SPOT_CUT),
        (np.array([not fit.converged for fit, _ in rows], bool), Status.NOT_CONVERGED),
    )
    sigma = theta[:, 6] if free_width else widths
    chi2 = np.array([fit.chi2 for fit, _ in rows], float)
    values = (theta[:, :2] + origin, covariance[:, :2, :2], theta[:, 2], theta[:, 3:6], sigma, chi2)
    uv, uv_covariance, flux, levels, width, misfit = (keep(np.asarray(value, float), status) for value in values)
    return SpotFit(uv, uv_covariance, flux, levels, width, misfit, status, np.full(uv_covariance.shape, np.nan))


def _on_grid(origin: NDArray[np.int64], shape: tuple[int, int], card: SensorCard) -> None:
    down, across = mcu_px(card.jpeg_subsampling)
    units, left = np.divmod(shape, (down, across))
    if (origin % [across, down]).any() or left.any() or units.min() < 2:
        raise ValueError(
            f"region of {shape[1]} x {shape[0]} pixels: origin and size must be multiples of {across} x {down} "
            f"pixels, the JPEG's units, and the size 2 x 2 units or more"
        )


def _frames_of(images: NDArray[Any]) -> NDArray[Any]:
    """Images with an axis of frames, shape (n, f, h, w, c); of single ones it has the length 1."""
    return images[:, None] if images.ndim == 4 else images


def _checked(images: NDArray[Any], card: SensorCard, count: int = 3) -> NDArray[np.uint8]:
    planes = _frames_of(np.asarray(images))
    if planes.ndim != 5 or planes.shape[4] != count or planes.shape[1] < 1 or planes.dtype != np.uint8:
        raise ValueError(
            f"images have the shape {np.shape(images)} and are {planes.dtype}: (n, h, w, {count}) or, of f frames, "
            f"(n, f, h, w, {count}) of uint8 is needed"
        )
    least = 0 if codes_are_independent(card) or card.output == "mjpeg" else window_px(card)[0] + 1
    if min(planes.shape[2:4]) < least:
        raise ValueError(f"images have the shape {np.shape(images)}: {least} x {least} pixels or more are needed")
    if card.mosaic != "bayer":
        raise ValueError(
            f"sensor '{card.name}' has the mosaic '{card.mosaic}': the fit through the chain needs 'bayer'"
        )
    return planes
