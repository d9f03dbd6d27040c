"""Tone curve of processed frames: codes of one surface at several exposure times.

Codes are on 0 to 255. A curve is `srgb` (IEC 61966-2-1), `rec709` (ITU-R BT.709) or a table of straight lines. The only
unknown of the first two is the exposure time that gives white.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import least_squares

from phibench.calibration.sensor_fit.capture_folder import Capture, luma
from phibench.estimator.spots.camera_codes import linear_to_srgb, srgb_to_linear
from phibench.scenes.frames import Array

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
