"""Noise of processed frames: electrons of white, read noise, PRNU, and sharpening or denoising, from flat frames.

Demosaicing, white balance, tone curve at one level, unsharp mask and denoising are linear. The answer of the luma to
one electron at each of the four places of the mosaic is computed once for every level. Its autocorrelation, times the
variance of a pixel's electrons, is the autocovariance of the noise. A fit of the measured autocovariances up to a lag
of two pixels gives

* the electrons of white, because shot noise grows with the level,
* read noise, which does not,
* the gain of the unsharp mask, or of denoising, which gives neighbours their correlation.

Bilinear interpolation is assumed, and the preset's white balance for Y'. Sigmas come from a jackknife over blocks.
JPEG's rounding of coefficients is not noise that can be undone: MJPEG frames tell nothing here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.optimize import least_squares

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.sensor_fit.photon_transfer import jackknife_sigma
from phibench.estimator.sensor_fit.tone_curve import Curve, decoded_by, encoded_by
from phibench.estimator.spots.image_planes import demosaiced
from phibench.scenes.frames import Array

LAGS = ((0, 0), (0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0))
"""Lags (rows, columns) of the autocovariances."""
LUMA = (0.299, 0.587, 0.114)
_LEAST_VARIANCE = 0.25  # codes^2: below, rounding to 8 bits is not white
_FLOOR = 0.005  # codes^2, of each autocovariance: what is left of that above; from fits of simulated frames
_LEAST_CODE, _MOST_CODE = 12.0, 243.0
_SIDE = 16
_BOX = 5
_BLOCKS = 8
_BINOMIAL = np.array([[1.0, 2.0, 1.0], [2.0, 4.0, 2.0], [1.0, 2.0, 1.0]]) / 16.0


@dataclass(frozen=True)
class NoiseLevel:
    """Noise of one level.

    Attributes
    ----------
    name : str
    codes : mean of R, G, B, codes
    covariance : shape (replicates, lags), codes^2; the first row is the whole, the others leave a block out
    spatial : shape (replicates,), codes^2
        Variance of the mean frame less a mean over 5 x 5 pixels, temporal noise taken off; NaN if unknown.
    """

    name: str
    codes: tuple[float, float, float]
    covariance: Array
    spatial: Array


@dataclass(frozen=True)
class ProcessedNoise:
    """Numbers found, by their names in `Sensor`, with sigmas; `reasons` for what was not found.

    `chi2` is the mean square of the standardised residuals.
    """

    values: dict[str, float]
    sigmas: dict[str, float]
    reasons: dict[str, str]
    chi2: float
    levels: tuple[NoiseLevel, ...]


def stack_level(name: str, frames: Array, codes: tuple[float, float, float]) -> NoiseLevel:
    """Noise from frame to frame, shape (n, h, w), n >= 2, of the luma."""
    n = len(frames)
    mean = frames.mean(axis=0)
    noise = frames - mean
    noise -= noise.mean(axis=(1, 2), keepdims=True)
    freedom = n / (n - 1)
    products = [np.mean([_lagged(one, lag) for one in noise], axis=0) * freedom for lag in LAGS]
    temporal = np.mean([_rough(one) ** 2 for one in noise], axis=0) * freedom
    spatial = _rough(mean) ** 2 - temporal / n
    totals = [_leave_one_out(x) for x in (*products, spatial)]
    counts = [_leave_one_out(np.ones_like(x)) for x in (*products, spatial)]
    parts = [total / count for total, count in zip(totals, counts, strict=True)]
    return NoiseLevel(name, codes, np.stack(parts[:-1], axis=1), parts[-1])


def patch_levels(name: str, patches: list[Array], codes: tuple[float, float, float]) -> NoiseLevel:
    """Noise from pixel to pixel of patches of single frames, each less a surface of second degree."""
    per_patch = np.array([[_lagged(flat, lag).mean() for lag in LAGS] for flat in map(_flattened, patches)])
    n = len(per_patch)
    total = per_patch.sum(axis=0)
    left_out = (total - per_patch) / max(n - 1, 1)
    covariance = np.concatenate([total[None] / n, left_out])
    return NoiseLevel(name, codes, covariance, np.full(n + 1, np.nan))


def _flattened(patch: Array) -> Array:
    h, w = patch.shape
    y, x = np.mgrid[-1.0 : 1.0 : h * 1j, -1.0 : 1.0 : w * 1j].reshape(2, -1)
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    values = patch.reshape(-1)
    rest = values - terms @ np.linalg.lstsq(terms, values, rcond=None)[0]
    # six of h w numbers are used up, mostly of white noise
    return np.asarray(rest.reshape(h, w) * np.sqrt(h * w / (h * w - 6.0)))


def _lagged(noise: Array, lag: tuple[int, int]) -> Array:
    """Products of pixels `lag` apart, in the image's inner part."""
    inner = noise[2:-2, 2:-2]
    rows, columns = lag
    return np.asarray(inner * noise[2 + rows : noise.shape[0] - 2 + rows, 2 + columns : noise.shape[1] - 2 + columns])


def _rough(image: Array) -> Array:
    half = _BOX // 2
    return np.asarray((image - uniform_filter(image, _BOX, mode="reflect"))[half:-half, half:-half])


def _leave_one_out(values: Array) -> Array:
    rows, columns = (np.linspace(0, side, _BLOCKS + 1).astype(int)[:-1] for side in values.shape)
    sums = np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1).ravel()
    return np.concatenate([[sums.sum()], sums.sum() - sums])


# -- model -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LumaModel:
    """Luma's noise as the chain's linear parts make it.

    Parameters
    ----------
    curve, points : tone curve
    card : SensorCard
        Converter and white balance that are not fitted.
    weights : of R, G, B in the luma
    scale : codes of the measured luma per code of 0 to 255 (219/255 for limited range)
    rounding : variance that rounding to 8 bits adds, codes^2; less than 1/12 for a luma of three rounded planes
    """

    curve: Curve
    points: tuple[tuple[float, float], ...] | None
    card: SensorCard
    weights: tuple[float, float, float] = LUMA
    scale: float = 1.0
    rounding: float = 1.0 / 12.0

    def answers(self, codes: tuple[float, float, float], sharpness: float) -> Array:
        """Luma, codes per linear light before white balance, to a pulse at each place, shape (4, side, side)."""
        linear = decoded_by(self.curve, np.array(codes), self.points)
        step = 1e-3
        low, high = (np.clip(linear * (1.0 + s) + s * 1e-3, 0.0, 1.0) for s in (-step, step))
        slope = (encoded_by(self.curve, high, self.points) - encoded_by(self.curve, low, self.points)) / (high - low)
        gains = slope * np.array(self.card.white_balance) * np.array(self.weights) * self.scale
        result = []
        for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
            pulse = np.zeros((_SIDE, _SIDE))
            pulse[_SIDE // 2 + row, _SIDE // 2 + column] = 1.0
            luma = np.einsum("c,chw->hw", gains, demosaiced(pulse))
            blurred = _convolved(luma)
            # below 0 it is a blur: denoising
            result.append(luma + sharpness * (luma - blurred))
        return np.stack(result)

    def variances(self, codes: tuple[float, float, float], white_e: float, read_noise_e: float) -> Array:
        """Variance of linear light, before white balance, at each place of the mosaic, shape (4,)."""
        linear = decoded_by(self.curve, np.array(codes), self.points) / np.array(self.card.white_balance)
        electrons = np.array([linear[0], linear[1], linear[1], linear[2]]) * white_e
        converter = (white_e / (self.card.top_dn - self.card.black_level_dn)) ** 2 / 12.0
        return np.asarray((electrons + read_noise_e**2 + converter) / white_e**2)

    def covariance(self, level: NoiseLevel, white_e: float, read_noise_e: float, sharpness: float) -> Array:
        """Autocovariances at `LAGS`, codes^2."""
        answers = self.answers(level.codes, sharpness)
        each = np.stack([_autocorrelation(answers, lag) for lag in LAGS], axis=1)
        result = 0.25 * self.variances(level.codes, white_e, read_noise_e) @ each
        result[0] += self.rounding
        return np.asarray(result)

    def pattern(self, level: NoiseLevel, sharpness: float) -> float:
        """`NoiseLevel.spatial` of a responsivity that spreads by 1."""
        answers = self.answers(level.codes, sharpness)
        linear = decoded_by(self.curve, np.array(level.codes), self.points) / np.array(self.card.white_balance)
        light = np.array([linear[0], linear[1], linear[1], linear[2]])
        rough = np.stack([one - uniform_filter(one, _BOX, mode="constant") for one in answers])
        return float(0.25 * light**2 @ (rough**2).sum(axis=(1, 2)))


def _convolved(image: Array) -> Array:
    padded = np.pad(image, 1)
    h, w = image.shape
    return np.asarray(sum(_BINOMIAL[i, j] * padded[i : i + h, j : j + w] for i in range(3) for j in range(3)))


def _autocorrelation(answers: Array, lag: tuple[int, int]) -> Array:
    moved = np.roll(answers, (-lag[0], -lag[1]), axis=(1, 2))
    return np.asarray((answers * moved).sum(axis=(1, 2)))


# -- fit -------------------------------------------------------------------------------------------------------------


def fit_noise(levels: list[NoiseLevel], model: LumaModel, analogue_gain: float = 1.0) -> ProcessedNoise:
    """Fit the noise of some levels; what they leave open has its reason."""
    used = [one for one in levels if _usable(one)]
    names = ("gain_dn_per_e", "read_noise_e", "sharpen_amount", "prnu")
    if not used:
        reason = f"no level between codes {_LEAST_CODE:g} and {_MOST_CODE:g} has noise above {_LEAST_VARIANCE} codes^2"
        return ProcessedNoise({}, {}, dict.fromkeys(names, reason), float("nan"), tuple(levels))
    scatter = [np.array([jackknife_sigma(one.covariance[:, i]) for i in range(len(LAGS))]) for one in used]

    def predicted(x: Array) -> Array:
        return np.concatenate([model.covariance(one, float(np.exp(x[0])), float(x[1]), float(x[2])) for one in used])

    seen = np.concatenate([one.covariance[0] for one in used])
    sigma = np.hypot(np.concatenate(scatter), _FLOOR)
    start = np.array([np.log(12000.0), 5.0, 0.0])
    bounds = ([np.log(100.0), 0.0, -1.0], [np.log(1e6), 300.0, 4.0])
    found = least_squares(lambda x: (predicted(x) - seen) / sigma, start, bounds=bounds, x_scale=[0.1, 1.0, 0.1])
    gain = np.linalg.pinv(found.jac)  # change of the parameters by standardised residuals
    white, read, sharp = _replicates(found.x, gain, used, seen, sigma)
    chi2 = float(np.mean(found.fun**2))
    full = model.card.top_dn - model.card.black_level_dn
    values: dict[str, Array] = {"gain_dn_per_e": full / np.exp(white) / analogue_gain}
    reasons: dict[str, str] = {}
    if read[0] > 3.0 * jackknife_sigma(read):
        values["read_noise_e"] = read
    else:
        reasons["read_noise_e"] = "lost below shot noise and rounding: take darker levels"
    values["sharpen_amount" if sharp[0] >= 0.0 else "denoise_luma"] = np.abs(sharp) if sharp[0] < 0.0 else sharp
    pattern = _prnu(used, model, float(sharp[0]))
    if pattern is not None and pattern[0] > 3.0 * jackknife_sigma(pattern):
        values["prnu"] = np.sqrt(np.maximum(pattern, 0.0))
    else:
        reasons["prnu"] = "lost in temporal noise: take more frames of the brighter levels"
    floor = np.sqrt(((gain * (_FLOOR / sigma)) ** 2).sum(axis=1))
    floors = {
        "gain_dn_per_e": floor[0] * float(values["gain_dn_per_e"][0]),
        "read_noise_e": floor[1],
        "sharpen_amount": floor[2],
        "denoise_luma": floor[2],
    }
    sigmas = {name: float(np.hypot(jackknife_sigma(x), floors.get(name, 0.0))) for name, x in values.items()}
    return ProcessedNoise({n: float(x[0]) for n, x in values.items()}, sigmas, reasons, chi2, tuple(levels))


def _usable(level: NoiseLevel) -> bool:
    inside = all(_LEAST_CODE <= code <= _MOST_CODE for code in level.codes)
    return inside and float(level.covariance[0, 0]) > _LEAST_VARIANCE


def _replicates(x: Array, gain: Array, used: list[NoiseLevel], seen: Array, sigma: Array) -> tuple[Array, ...]:
    """Parameters of the whole and without each block; levels of other numbers of blocks are independent."""
    counts = {len(one.covariance) for one in used}
    if len(counts) == 1:
        rows = [np.concatenate([one.covariance[r] for one in used]) for r in range(counts.pop())]
        return tuple((x + ((np.stack(rows) - seen) / sigma) @ gain.T).T)
    rows, start = [seen], 0
    for one in used:
        stop = start + len(LAGS)
        for part in one.covariance[1:]:
            changed = seen.copy()
            changed[start:stop] += part - one.covariance[0]
            rows.append(changed)
        start = stop
    return tuple((x + ((np.stack(rows) - seen) / sigma) @ gain.T).T)


def _prnu(used: list[NoiseLevel], model: LumaModel, sharpness: float) -> Array | None:
    known = [one for one in used if np.isfinite(one.spatial).all()]
    if not known:
        return None
    unit = np.array([model.pattern(one, sharpness) for one in known])
    spatial = np.stack([one.spatial for one in known])
    noise = np.array([jackknife_sigma(one.spatial) for one in known])
    weights = (unit / noise) ** 2
    return np.asarray(np.sum(weights[:, None] * spatial / unit[:, None], axis=0) / weights.sum())


def mean_codes(frames: NDArray[np.uint8]) -> tuple[float, float, float]:
    """Mean of R, G, B of frames, shape (..., 3)."""
    red, green, blue = frames.reshape(-1, 3).mean(axis=0)
    return float(red), float(green), float(blue)
