"""Noise of processed flat frames: covariances of neighbouring pixels with a jackknife; tone curve, fitted and applied.

Planes are those of the frames, Y', Cb, Cr of "yuyv", whose chroma has half of the columns, or R, G, B. Besides each
plane's own covariances there are those of the first plane (of R, G, B: of green) with the two others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.optimize import least_squares

from phibench.calibration.sensor_fit.capture_folder import Capture, luma
from phibench.estimator.spots.camera_codes import YCC_FROM_RGB, linear_to_srgb, srgb_to_linear
from phibench.scenes.frames import Array

Lags = tuple[tuple[int, int], ...]
NEAR: Lags = ((0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (2, 0))
FAR: Lags = (*NEAR, (1, 2), (2, 1), (2, 2), (0, 3), (3, 0))
BESIDE: Lags = ((0, 0), (0, -1), (0, 1))
"""Lags (rows, columns): of chroma, of other planes, and from a pixel of chroma to one of Y'."""
BOX_PX = 5  # noise is what a pixel differs by from its surroundings: shading goes
_BLOCKS = 8  # along each side, for the jackknife
_EDGE = 3  # largest lag


@dataclass(frozen=True)
class PlaneNoise:
    """Noise of one plane of codes, or of two.

    Attributes
    ----------
    lags : of the covariances, each in the plane's own samples; of two planes in those of the first
    covariance : shape (replicates, lags), codes^2
        Of the time; the first row is the whole, the others leave a block out.
    mean : float, codes
    spread : float
        Variance of the pixels' means, codes^2.
    apart : shape (lags,)
        Variance of the difference of two pixels' means, codes^2.
    """

    lags: Lags
    covariance: Array
    mean: float = 0.0
    spread: float = 0.0
    apart: Array | None = None


@dataclass(frozen=True)
class NoiseLevel:
    """Noise of one level.

    Attributes
    ----------
    name : str
    codes : mean of R, G, B, codes
    planes : of the three planes; then of the main plane with the two others (0 with 1 and 2, or 1 with 0 and 2)
    spatial : shape (replicates,), codes^2
        Variance of the mean frame's Y' less a mean over 5 x 5 pixels, temporal noise taken off.
    """

    name: str
    codes: tuple[float, float, float]
    planes: tuple[PlaneNoise, ...]
    spatial: Array


def planes_of(frames: NDArray[Any]) -> list[Array]:
    """Planes, shape (n, h, w) each, or (n, h, w / 2) of chroma, of frames (n, h, w, 3), or (n, h, w, 2) of yuyv."""
    if frames.shape[-1] == 2:
        y, chroma = frames[..., 0].astype(float), frames[..., 1].astype(float)
        return [y, chroma[..., 0::2], chroma[..., 1::2]]
    return list(np.moveaxis(frames.astype(float), -1, 0))


def stack_level(name: str, frames: NDArray[Any], codes: tuple[float, float, float]) -> NoiseLevel:
    """Noise from frame to frame of two frames or more, as `planes_of` takes them."""
    halved = frames.shape[-1] == 2
    planes = planes_of(frames)
    own = [_plane(stack, NEAR if halved and k else FAR) for k, stack in enumerate(planes)]
    main, others = (0, (1, 2)) if halved else (1, (0, 2))
    noise = [_noise(stack) for stack in planes]
    both = [_both(noise[main], noise[k], halved) for k in others]
    luma = planes[0] if halved else np.tensordot(np.stack(planes, axis=-1), YCC_FROM_RGB[0], 1)
    return NoiseLevel(name, codes, (*own, *both), _spatial(np.asarray(luma)))


def _noise(stack: Array) -> Array:
    """Deviations from the mean frame and from each frame's mean, scaled to the variance of one frame."""
    noise = stack - stack.mean(axis=0)
    noise -= noise.mean(axis=(1, 2), keepdims=True)
    return np.asarray(noise * np.sqrt(len(stack) / (len(stack) - 1.0)))


def _plane(stack: Array, lags: Lags) -> PlaneNoise:
    mean, noise = stack.mean(axis=0), _noise(stack)
    products = [_lagged(noise, noise, lag) for lag in lags]
    covariance = np.stack([_leave_one_out(x) / _leave_one_out(np.ones_like(x)) for x in products], axis=1)
    rest = (mean - mean.mean())[None]
    fixed = np.array([float(np.mean(_lagged(rest, rest, lag))) for lag in lags]) - covariance[0] / len(stack)
    apart = np.maximum(2.0 * (fixed[0] - fixed), 0.0)
    return PlaneNoise(lags, covariance, float(mean.mean()), max(float(fixed[0]), 0.0), apart)


def _both(main: Array, other: Array, halved: bool) -> PlaneNoise:
    """Covariances of the other plane's samples with the main plane's at the lags `BESIDE` from them."""
    if not halved:
        products = [_lagged(other, main, lag) for lag in BESIDE]
    else:
        h = main.shape[1]
        columns = np.arange(_EDGE // 2 + 1, other.shape[2] - _EDGE // 2 - 1)
        rows = slice(_EDGE, h - _EDGE)
        here, there = other[:, rows][..., columns], main[:, rows]
        products = [(here * there[..., 2 * columns + c]).mean(axis=0) for _, c in BESIDE]
    return PlaneNoise(BESIDE, np.stack([_leave_one_out(x) / _leave_one_out(np.ones_like(x)) for x in products], axis=1))


def _spatial(stack: Array) -> Array:
    temporal = np.mean([_rough(frame) ** 2 for frame in _noise(stack)], axis=0)
    spatial = _rough(stack.mean(axis=0)) ** 2 - temporal / len(stack)
    return _leave_one_out(spatial) / _leave_one_out(np.ones_like(spatial))


def _lagged(one: Array, two: Array, lag: tuple[int, int]) -> Array:
    """Mean products of a pixel and the other plane's pixel `lag` away, in the image's inner part."""
    rows, columns = lag
    _, h, w = one.shape
    inner = one[:, _EDGE : h - _EDGE, _EDGE : w - _EDGE]
    moved = two[:, _EDGE + rows : h - _EDGE + rows, _EDGE + columns : w - _EDGE + columns]
    return np.asarray((inner * moved).mean(axis=0))


def _rough(image: Array) -> Array:
    half = BOX_PX // 2
    return np.asarray((image - uniform_filter(image, BOX_PX, mode="reflect"))[half:-half, half:-half])


def _leave_one_out(values: Array) -> Array:
    rows, columns = (np.linspace(0, side, _BLOCKS + 1).astype(int)[:-1] for side in values.shape)
    sums = np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1).ravel()
    return np.concatenate([[sums.sum()], sums.sum() - sums])


# Tone curve of processed frames: codes of one surface at several exposure times.
#
# Codes are on 0 to 255. A curve is `srgb` (IEC 61966-2-1), `rec709` (ITU-R BT.709) or a table of straight lines. The
# only unknown of the first two is the exposure time that gives white.


Curve = Literal["srgb", "rec709", "table"]
_LEAST, _MOST = 4.0, 248.0  # codes that are surely not cut
_GOOD_CODES = 0.8  # rms; the curves of sRGB and Rec. 709 differ by up to 20 codes
_NEEDED = 4  # times: two numbers of a curve, and a misfit
_KNEE, _SLOPE = 0.018, 4.5  # of Rec. 709


def encoded_by(curve: Curve, linear: Array, points: tuple[tuple[float, float], ...] | None = None) -> Array:
    """Codes, 0 to 255, of linear light, cut to [0, 1]; any shape."""
    x = np.clip(linear, 0.0, 1.0)
    if curve == "srgb":
        return 255.0 * linear_to_srgb(x)
    if curve == "rec709":
        power = 1.099 * np.maximum(x, _KNEE) ** 0.45 - 0.099
        return 255.0 * np.where(x < _KNEE, _SLOPE * x, power)
    at, values = np.array(points).T
    return 255.0 * np.interp(x, at, values)


def decoded_by(curve: Curve, codes: Array, points: tuple[tuple[float, float], ...] | None = None) -> Array:
    """Linear light of codes; any shape."""
    y = np.clip(np.asarray(codes, float) / 255.0, 0.0, 1.0)
    if curve == "srgb":
        return srgb_to_linear(y)
    if curve == "rec709":
        return np.asarray(np.where(y < _SLOPE * _KNEE, y / _SLOPE, ((y + 0.099) / 1.099) ** (1.0 / 0.45)))
    at, values = np.array(points).T
    return np.asarray(np.interp(y, values, at))


@dataclass(frozen=True)
class ToneFit:
    """Tone curve with what it was fitted to.

    Attributes
    ----------
    curve : "srgb", "rec709" or "table"
    points : pairs (linear, encoded) of a table, or None
    seconds, codes : measured, codes of Y' on 0 to 255
    white_s : exposure time that gives white
    rms_codes : of the residuals of each curve that was tried
    """

    curve: Curve
    points: tuple[tuple[float, float], ...] | None
    seconds: tuple[float, ...]
    codes: tuple[float, ...]
    white_s: float
    rms_codes: dict[str, float]


def fit_tone(capture: Capture) -> ToneFit | str:
    """Tone curve, or the reason why these frames do not tell it."""
    if not capture.exposures:
        return "needs exposure/SECONDS: one surface at several exposure times"
    series = sorted((float(g.seconds or 0.0), _level(capture, g.files)) for g in capture.exposures)
    inside = [(t, y) for t, y in series if _LEAST <= y <= _MOST]
    if len(inside) < _NEEDED or inside[-1][1] < 3.0 * inside[0][1]:
        return f"exposure/SECONDS has {len(inside)} times between black and white: {_NEEDED} over a range of codes 1:3"
    times, codes = np.array(inside).T
    tried = {curve: _fitted(curve, times, codes) for curve in ("srgb", "rec709")}
    rms = {curve: error for curve, (_, error) in tried.items()}
    best: Curve = "srgb" if rms["srgb"] <= rms["rec709"] else "rec709"
    if rms[best] <= _GOOD_CODES:
        return ToneFit(best, None, tuple(times), tuple(codes), tried[best][0], rms)
    white_s, points = _table(times, codes)
    return ToneFit("table", points, tuple(times), tuple(codes), white_s, rms)


def _level(capture: Capture, files: tuple) -> float:  # type: ignore[type-arg]
    levels = []
    for path in files:
        y = luma(capture.read(path), capture.kind)
        h, w = y.shape
        levels.append(float(y[h // 3 : 2 * h // 3, w // 3 : 2 * w // 3].mean()))
    return float(np.mean(levels))


def _fitted(curve: Curve, times: Array, codes: Array) -> tuple[float, float]:
    """Exposure time of white, and the rms of the residuals, codes."""
    start = np.log(np.median(decoded_by(curve, codes) / times))

    def residuals(log_rate: Array) -> Array:
        return encoded_by(curve, times * np.exp(log_rate[0])) - codes

    solution = least_squares(residuals, [start])
    freedom = max(len(codes) - 1, 1)
    return float(np.exp(-solution.x[0])), float(np.sqrt(np.sum(solution.fun**2) / freedom))


def _table(times: Array, codes: Array) -> tuple[float, tuple[tuple[float, float], ...]]:
    """Table of straight lines; white lies on the power law of the two brightest times."""
    power = np.log(codes[-1] / codes[-2]) / np.log(times[-1] / times[-2])
    white_s = float(times[-1] * (255.0 / codes[-1]) ** (1.0 / max(power, 0.1)))
    points = [(0.0, 0.0), *zip(times / white_s, codes / 255.0, strict=True), (1.0, 1.0)]
    rising = [points[0]]
    for x, y in points[1:]:
        if x > rising[-1][0] and y > rising[-1][1]:
            rising.append((float(x), float(y)))
    return white_s, tuple(rising)
