"""Image processing of the camera, from DN to 8 bits, Y'CbCr 4:2:2 or JPEG: pure functions on stacks of images.

Planes R, G, B stand in the third axis from the end, shape (..., 3, H, W); the 8-bit image has them last. Every function
takes any number of leading axes and keeps float32, so that a fit can send many model images through at once. Pixels
beyond the border are mirrored about the border pixel, which keeps the order of the mosaic's colours.

The simulator's only demosaicing, Y'CbCr and JPEG are here; the estimator has its own. NumPy and Pillow.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from phibench.render.sensor.settings import Sensor
from phibench.render.sensor.srgb import srgb_encoded
from phibench.scenes.frames import Array

LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601, the Y' of YUYV and of JPEG
Matrix = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def linear_signal(dn: NDArray[Any], sensor: Sensor, dtype: type[np.floating[Any]] = np.float64) -> Array:
    """Signal relative to full scale, shape as `dn`: black level 0, largest code 1."""
    return (dn.astype(dtype) - dtype(sensor.black_level_dn)) * dtype(1.0 / (sensor.top_dn - sensor.black_level_dn))


def demosaic(raw: Array) -> Array:
    """Bilinear interpolation of an RGGB mosaic, shape (..., H, W) with red first, to planes, shape (..., 3, H, W)."""
    *lead, height, width = raw.shape
    p = np.pad(raw, [(0, 0)] * len(lead) + [(1, 1), (1, 1)], mode="reflect")
    planes = np.empty((*lead, 3, height, width), raw.dtype)
    quarter = raw.dtype.type(0.25)
    half = raw.dtype.type(0.5)
    for row in (0, 1):
        for column in (0, 1):

            def at(down: int, across: int, row: int = row, column: int = column) -> Array:
                rows = slice(1 + row + down, 1 + height + down, 2)
                return p[..., rows, slice(1 + column + across, 1 + width + across, 2)]

            site = (slice(row, None, 2), slice(column, None, 2))
            beside, above = at(0, -1) + at(0, 1), at(-1, 0) + at(1, 0)
            # red (0, 0) and blue (1, 1): green from four neighbours, the opposite colour from four corners
            if row == column:
                corners = (at(-1, -1) + at(-1, 1)) + (at(1, -1) + at(1, 1))
                planes[(..., 2 * row, *site)] = at(0, 0)
                planes[(..., 1, *site)] = (beside + above) * quarter
                planes[(..., 2 - 2 * row, *site)] = corners * quarter
            else:  # green: one colour lies in its row, the other in its column
                planes[(..., 1, *site)] = at(0, 0)
                planes[(..., 2 * row, *site)] = beside * half
                planes[(..., 2 * column, *site)] = above * half
    return planes


def white_balanced(planes: Array, gains: tuple[float, float, float]) -> Array:
    """Planes times the gains of R, G, B."""
    return planes * np.asarray(gains, planes.dtype)[:, None, None]


def colour_corrected(planes: Array, matrix: Matrix) -> Array:
    """Colour matrix times planes; written out, because a matrix product's rounding depends on the image's size."""
    if matrix == IDENTITY:
        return planes
    r, g, b = (planes[..., i, :, :] for i in range(3))
    m = np.asarray(matrix, planes.dtype)
    return np.stack([m[i, 0] * r + m[i, 1] * g + m[i, 2] * b for i in range(3)], axis=-3)


def sharpened(planes: Array, amount: float) -> Array:
    """Unsharp mask x + amount (x - blur x), blur (1 2 1)/4 along both axes."""
    if amount == 0.0:
        return planes
    # unsharp mask: what the blur takes away is added again, `amount` times
    return planes + planes.dtype.type(amount) * (planes - _blurred(planes))


def denoised(planes: Array, sensor: Sensor) -> Array:
    """R, G, B whose Cb and Cr are x + share (blur x - x), blur as in `sharpened`, and whose Y' is smoothed by itself.

    Y' of pixel i changes by share x the sum of b_j f(Y'_j - Y'_i) over the pixels j of a binomial blur with the weights
    b; f(d) = d exp(-d^2 / 2 T^2) spares edges (P. Perona, J. Malik, IEEE PAMI 12, 629, 1990, eq. 10: one step with more
    neighbours). Without a threshold T it is the blur.
    """
    result, of = planes, planes.dtype.type
    if sensor.denoise_chroma > 0.0:
        # all planes by their own change, less its luma: Y' stays as it is
        change = _blurred(planes) - planes
        result = result + of(sensor.denoise_chroma) * (change - luma_of(change)[..., None, :, :])
    if sensor.denoise_luma > 0.0:
        y = luma_of(planes)
        result = result + of(sensor.denoise_luma) * _smoothing(y, sensor)[..., None, :, :]
    return result


def denoise_margin_px(sensor: Sensor) -> int:
    """Pixels on each side that denoising looks at."""
    return max(sensor.denoise_reach_px * (sensor.denoise_luma > 0.0), int(sensor.denoise_chroma > 0.0))


def luma_of(planes: Array) -> Array:
    """Y', shape (..., H, W)."""
    r, g, b = (planes[..., i, :, :] for i in range(3))
    of = planes.dtype.type
    return np.asarray(of(LUMA[0]) * r + of(LUMA[1]) * g + of(LUMA[2]) * b)


_BINOMIAL = {1: (0.25, 0.5, 0.25), 2: (0.0625, 0.25, 0.375, 0.25, 0.0625)}


def _smoothing(y: Array, sensor: Sensor) -> Array:
    """Sum of the weighted differences from the neighbours, those across edges suppressed; shape as `y`."""
    *lead, h, w = y.shape
    reach, of = sensor.denoise_reach_px, y.dtype.type
    taps = np.array(_BINOMIAL[reach])
    # share v of the blur along columns, the rest of no blur
    down = sensor.denoise_vertical * taps + (1.0 - sensor.denoise_vertical) * (np.arange(-reach, reach + 1) == 0)
    p = np.pad(y, [(0, 0)] * len(lead) + [(reach, reach)] * 2, mode="reflect")
    total = np.zeros_like(y)
    for i, row in enumerate(down):
        for j, column in enumerate(taps):
            if (i, j) == (reach, reach) or row == 0.0:
                continue
            difference = p[..., i : i + h, j : j + w] - y
            if sensor.denoise_threshold_codes is not None:
                per_t2 = of(-0.5 * (255.0 / sensor.denoise_threshold_codes) ** 2)
                difference = difference * np.exp(per_t2 * difference * difference)
            total += of(row * column) * difference
    return total


def _blurred(planes: Array) -> Array:
    *lead, _, _ = planes.shape
    p = np.pad(planes, [(0, 0)] * len(lead) + [(1, 1), (1, 1)], mode="reflect")
    quarter, two = planes.dtype.type(0.25), planes.dtype.type(2.0)
    down = (p[..., :-2, :] + two * p[..., 1:-1, :] + p[..., 2:, :]) * quarter
    return (down[..., :-2] + two * down[..., 1:-1] + down[..., 2:]) * quarter


# Tone curves: linear light to encoded R, G, B, both cut to [0, 1].


_ALPHA, _BETA = 1.09929682680944, 0.018053968510807  # ITU-R BT.709 with the digits of BT.2020, where the pieces meet


def tone_encoded(linear: Array, sensor: Sensor) -> Array:
    """Encoded values of linear light by the sensor's transfer function."""
    if sensor.transfer_function == "srgb":
        return srgb_encoded(linear)
    x = np.clip(linear, 0.0, 1.0)
    of = x.dtype.type
    if sensor.transfer_points is not None:
        return np.interp(x, *np.transpose(sensor.transfer_points)).astype(x.dtype)
    return np.where(x < _BETA, of(4.5) * x, of(_ALPHA) * np.power(x, of(0.45)) - of(_ALPHA - 1.0))


def shrunk(planes: Array, factor: int) -> Array:
    """Means over squares of `factor` x `factor` pixels, shape (..., h / factor, w / factor)."""
    *lead, h, w = planes.shape
    return np.asarray(planes.reshape(*lead, h // factor, factor, w // factor, factor).mean(axis=(-3, -1)))


def eight_bit(planes: Array) -> NDArray[np.uint8]:
    """Image, shape (..., H, W, 3), of planes in [0, 1], rounded and clipped."""
    # halves go to the even code, as numpy has it
    scaled = np.clip(np.rint(planes * planes.dtype.type(255.0)), 0.0, 255.0).astype(np.uint8)
    return np.ascontiguousarray(np.moveaxis(scaled, -3, -1))


def linear_rgb(signal: Array, sensor: Sensor) -> Array:
    """Demosaicing, white balance and colour matrix: the linear part; planes, shape (..., 3, H, W).

    A sensor without mosaic gives its signal to all three planes and has no colours to balance.
    """
    if sensor.mosaic == "mono":
        return np.repeat(signal[..., None, :, :], 3, axis=-3)
    return colour_corrected(white_balanced(demosaic(signal), sensor.white_balance), sensor.colour_matrix)


def rendered(linear: Array, sensor: Sensor, shrink: int = 1) -> Array:
    """Tone curve, sharpening and denoising: planes, shape (..., 3, H, W), before they are rounded to 8 bits.

    A camera that sends less pixels than it has shrinks between the tone curve and the unsharp mask.
    """
    encoded = tone_encoded(linear, sensor)
    if shrink > 1:
        encoded = shrunk(encoded, shrink)
    return denoised(sharpened(encoded, sensor.sharpen_amount), sensor)


# Y'CbCr 4:2:2, ITU-R BT.601, 8 bits.


_CODES = {"full": (0.0, 255.0, 255.0, 0, 255), "limited": (16.0, 219.0, 224.0, 1, 254)}
"""Y' of black, codes from black to white, codes of the whole Cb or Cr axis, least and largest code."""


def yuyv(planes: Array, sensor: Sensor) -> NDArray[np.uint8]:
    """Bytes of an image, shape (..., H, W, 2), of planes R, G, B in [0, 1]; the first column must be even.

    The first of each pixel's bytes is its Y'. The second is Cb at even columns and Cr at odd ones, both of chroma
    sample k = column // 2. It is a sensor's YUYV buffer, and what OpenCV delivers with CAP_PROP_CONVERT_RGB off.
    """
    black, luma, chroma, least, most = _CODES[sensor.ycbcr_range]
    of = planes.dtype.type
    y = luma_of(planes)
    width = y.shape[-1]
    second = np.empty_like(y)
    for first, plane, weight in ((0, planes[..., 2, :, :], LUMA[2]), (1, planes[..., 0, :, :], LUMA[0])):
        # B - Y' and R - Y', mirrored at the edges
        difference = np.pad(plane - y, [(0, 0)] * (y.ndim - 1) + [(1, 1)], mode="reflect")
        left, middle, right = (of(tap) * difference[..., k : k + width : 2] for k, tap in enumerate(sensor.chroma_taps))
        # scaled so that pure blue and pure red reach the ends of the axis; 128 is no colour
        samples = (left + middle + right) * of(0.5 * chroma / (1.0 - weight)) + of(128.0)
        second[..., first::2] = samples[..., : second[..., first::2].shape[-1]]
    codes = np.stack([y * of(luma) + of(black), second], axis=-1)
    return np.clip(np.rint(codes), least, most).astype(np.uint8)


def rgb_from_yuyv(image: NDArray[np.uint8], sensor: Sensor) -> NDArray[np.uint8]:
    """Picture, shape (..., H, W, 3), W even, of bytes as `yuyv` gives them; both pixels of a pair get its chroma."""
    black, luma, chroma, _, _ = _CODES[sensor.ycbcr_range]
    y = (image[..., 0] - black) / luma
    cb, cr = (np.repeat(image[..., k::2, 1], 2, axis=-1) for k in (0, 1))
    blue, red = ((c - 128.0) * 2.0 * (1.0 - weight) / chroma + y for c, weight in ((cb, LUMA[2]), (cr, LUMA[0])))
    # Y' solved for the third colour
    green = (y - LUMA[0] * red - LUMA[2] * blue) / LUMA[1]
    return eight_bit(np.stack([red, green, blue], axis=-3))


# JPEG: Pillow (libjpeg-turbo), and the grid on which it works.


MCU_PX = {"4:4:4": (8, 8), "4:2:2": (8, 16), "4:2:0": (16, 16)}
"""Rows and columns of a minimum coded unit.

A decoded pixel depends on its own unit and, where chroma is interpolated between samples, on the units beside it.
"""


def jpeg_bytes(image: NDArray[np.uint8], sensor: Sensor) -> bytes:
    """JPEG file of an image, shape (H, W, 3), with the sensor's tables, subsampling and restart markers."""
    file, tables = io.BytesIO(), sensor.jpeg_qtables
    # Pillow scales given tables by the quality in per cent: none is given with them
    steps = {"quality": sensor.jpeg_quality} if tables is None else {"qtables": [list(table) for table in tables]}
    Image.fromarray(image).save(
        file, "JPEG", subsampling=sensor.jpeg_subsampling, restart_marker_blocks=sensor.jpeg_restart_interval, **steps
    )
    return file.getvalue()


def jpeg_image(data: bytes) -> NDArray[np.uint8]:
    """Image, shape (H, W, 3), in a JPEG file."""
    with Image.open(io.BytesIO(data), formats=("JPEG",)) as image:
        return np.asarray(image.convert("RGB"))


def compressed(images: NDArray[np.uint8], sensor: Sensor) -> NDArray[np.uint8]:
    """Images, shape (..., H, W, 3), encoded and decoded again."""
    flat = images.reshape(-1, *images.shape[-3:])
    return np.stack([jpeg_image(jpeg_bytes(image, sensor)) for image in flat]).reshape(images.shape)
