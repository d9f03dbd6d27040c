"""Gain, read noise, white balance, sharpening, denoising of processed frames, fitted to covariances of Y', Cb, Cr.

* Shot noise grows with the level: electrons of white. Read noise does not.
* Neighbours are alike by demosaicing, unsharp mask and denoising.
* Of the same light, the noise of a colour grows with the gain that its electrons got: white balance.
* Noise of Cb and Cr along rows: how 4:2:2 takes them from columns.

Three chains are tried, each with one more filter: unsharp mask or mild denoising; unsharp mask and denoising; the same
with 5 x 5 pixels and another share along columns. A chain is taken where it fits better by far. Bilinear interpolation
and a unit colour matrix are assumed. Sigmas come from a jackknife over blocks. JPEG's rounding of coefficients is not
noise that can be undone: MJPEG frames tell nothing here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from phibench.calibration.sensor_fit.block_sums import jackknife_sigma
from phibench.calibration.sensor_fit.edge_spread import Smoothing
from phibench.calibration.sensor_fit.noise_levels import NoiseLevel
from phibench.calibration.sensor_fit.plane_model import PlaneModel, PlaneParameters
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.scenes.frames import Array

_LEAST_VARIANCE = 0.15  # codes^2 of Y': below, terms of the rounding that are left out count
_LEAST_CODE, _MOST_CODE = 12.0, 243.0  # of a level whose noise is surely not cut
_FLOOR = 3e-4  # codes^2, of each autocovariance: what models of rounding and clipping leave
_BETTER = 30.0  # sum of squares by which another filter must fit better
_FOUND = 3.0  # sigmas from 0
_BASE = ("white_e", "read_noise_e", "sharpen", "chroma", "red", "blue")
# reach and numbers of denoising that are tried: one that fits no better is not taken
_CHAINS = ((1, ("denoise",)), (2, ("denoise", "vertical")))
_LOW = {"white_e": np.log(100.0), "sharpen": -1.0, "red": 0.2, "blue": 0.2, "left": -0.1, "right": -0.1}
_HIGH = {"white_e": np.log(1e6), "read_noise_e": 300.0, "sharpen": 4.0, "red": 8.0, "blue": 8.0}
_SCALE = {"white_e": 0.1, "read_noise_e": 2.0}
_REASONS = {
    "read_noise_e": "lost below shot noise and rounding: take darker levels",
    "denoise_chroma": "not above 0 in these frames",
}


@dataclass(frozen=True)
class ProcessedNoise:
    """Numbers found, by their names in `Sensor`, with sigmas; `reasons` for what was not found.

    `chi2` is the mean square of the standardised residuals; `card` and `numbers` are of the chain that was taken,
    `smoothing` its denoising of Y'.
    """

    values: dict[str, float | tuple[float, ...]]
    sigmas: dict[str, float | tuple[float, ...]]
    reasons: dict[str, str]
    chi2: float
    levels: tuple[NoiseLevel, ...]
    card: SensorCard
    numbers: PlaneParameters | None = None
    smoothing: Smoothing | None = None


@dataclass(frozen=True)
class _Solution:
    """Least squares with one chain: numbers, replicates of each by the jackknife, and deviations by the lattice."""

    model: PlaneModel
    names: tuple[str, ...]
    x: Array
    replicates: Array
    systematic: Array
    misfit: float
    chi2: float

    def numbers(self) -> PlaneParameters:
        return _numbers(self.names, self.x)


def fit_noise(
    levels: list[NoiseLevel], card: SensorCard, analogue_gain: float = 1.0, threshold_codes: float | None = None
) -> ProcessedNoise:
    """Fit the noise of some levels; what they leave open has its reason.

    Parameters
    ----------
    card : SensorCard
        Converter, output, and the tone curve.
    threshold_codes : float, optional
        Of denoising that spares edges, where edges have told it.
    """
    used = [level for level in levels if _usable(level)]
    if not used:
        reason = f"no level between codes {_LEAST_CODE:g} and {_MOST_CODE:g} has noise above {_LEAST_VARIANCE} codes^2"
        names = ("gain_dn_per_e", "read_noise_e", "sharpen_amount", "prnu", "denoise_luma", "denoise_chroma")
        return ProcessedNoise(
            {}, {}, dict.fromkeys((*names, "white_balance"), reason), float("nan"), tuple(levels), card
        )
    first = _solved(used, PlaneModel(card, 1, threshold_codes), (), None, None)
    lattice = [first.model.lattice_errors(level, first.numbers()) for level in used]
    best = _solved(used, first.model, (), first.numbers(), lattice)
    for reach, extra in _CHAINS:
        solution = _solved(used, PlaneModel(card, reach, threshold_codes), extra, best.numbers(), lattice)
        if solution.misfit < best.misfit - _BETTER:
            best = solution
    return _told(best, used, levels, card, analogue_gain)


def _usable(level: NoiseLevel) -> bool:
    inside = all(_LEAST_CODE <= code <= _MOST_CODE for code in level.codes)
    return inside and float(level.planes[0].covariance[0, 0]) > _LEAST_VARIANCE


def _numbers(names: tuple[str, ...], x: Array) -> PlaneParameters:
    values = {name: float(v) for name, v in zip(names, x, strict=True)}
    return replace(PlaneParameters(), **{**values, "white_e": float(np.exp(values["white_e"]))})


def _solved(
    used: list[NoiseLevel],
    model: PlaneModel,
    extra: tuple[str, ...],
    start: PlaneParameters | None,
    lattice: list[list[float]] | None,
) -> _Solution:
    names = (*_BASE, *(("left", "right") if model.halved else ()), *extra)
    seen = np.concatenate([plane.covariance[0] for level in used for plane in level.planes])
    scatter = [
        jackknife_sigma(plane.covariance[:, i])
        for level in used
        for plane in level.planes
        for i in range(plane.covariance.shape[1])
    ]
    planes = [plane for level in used for plane in level.planes]
    errors = [0.0] * len(planes) if lattice is None else [error for level in lattice for error in level]
    alike = [e * p.covariance[0] for e, p in zip(errors, planes, strict=True)]
    sigma = np.sqrt(np.square(scatter) + _FLOOR**2 + np.concatenate(alike) ** 2)

    def predicted(x: Array) -> Array:
        numbers = _numbers(names, x)
        return np.concatenate([part for level in used for part in model.covariances(level, numbers)])

    given = start or PlaneParameters(red=model.card.white_balance[0], blue=model.card.white_balance[2])
    first = np.array([np.log(given.white_e) if n == "white_e" else getattr(given, n) for n in names])
    if extra and start is not None and start.denoise == 0.0:
        first[names.index("denoise")] = 0.5
        first[names.index("sharpen")] = max(start.sharpen, 0.0) + 0.3
    low = np.array([0.0 if extra and n == "sharpen" else _LOW.get(n, 0.0) for n in names])
    high = np.array([_HIGH.get(n, 1.0) for n in names])
    first = np.clip(first, low + 1e-6, high - 1e-6)
    scale = [_SCALE.get(n, 0.1) for n in names]
    done = least_squares(lambda x: (predicted(x) - seen) / sigma, first, bounds=(low, high), x_scale=scale)
    gain = np.linalg.pinv(done.jac)  # change of the parameters by standardised residuals
    rows = [np.concatenate([p.covariance[r] for level in used for p in level.planes]) for r in range(_count(used))]
    replicates = done.x + ((np.stack(rows) - seen) / sigma) @ gain.T
    misfit = float(np.sum(done.fun**2))
    # all lags of a plane err together
    ends = np.cumsum([len(part) for part in alike])
    shifts = [
        gain[:, b - len(part) : b] @ (part / sigma[b - len(part) : b]) for part, b in zip(alike, ends, strict=True)
    ]
    systematic = np.sqrt(np.square(shifts).sum(axis=0) + ((gain * (_FLOOR / sigma)) ** 2).sum(axis=1))
    chi2 = misfit / max(len(seen) - len(names), 1)
    return _Solution(model, names, done.x, replicates, systematic, misfit, chi2)


def _count(used: list[NoiseLevel]) -> int:
    return min(len(plane.covariance) for level in used for plane in level.planes)


def _told(
    best: _Solution, used: list[NoiseLevel], levels: list[NoiseLevel], card: SensorCard, analogue_gain: float
) -> ProcessedNoise:
    """Numbers of the sensor."""
    column = {name: best.replicates[:, k] for k, name in enumerate(best.names)}
    error = {
        name: float(np.hypot(jackknife_sigma(column[name]), best.systematic[k])) for k, name in enumerate(best.names)
    }
    numbers, full = best.numbers(), card.top_dn - card.black_level_dn
    values: dict[str, Array] = {"gain_dn_per_e": full / np.exp(column["white_e"]) / analogue_gain}
    own_error = {"gain_dn_per_e": error["white_e"] * float(values["gain_dn_per_e"][0])}
    reasons: dict[str, str] = {}
    for name, own in (("read_noise_e", "read_noise_e"), ("denoise_chroma", "chroma")):
        if column[own][0] > _FOUND * error[own]:
            values[name], own_error[name] = column[own], error[own]
        else:
            reasons[name] = _REASONS[name]
    sharp = "sharpen_amount" if numbers.sharpen >= 0.0 else "denoise_luma"
    values[sharp], own_error[sharp] = np.abs(column["sharpen"]), error["sharpen"]
    for name, own in (("denoise_luma", "denoise"), ("denoise_vertical", "vertical")):
        if own in column:
            values[name], own_error[name] = column[own], error[own]
    pattern = _prnu(used, best.model, numbers)
    if pattern is not None and pattern[0] > _FOUND * jackknife_sigma(pattern):
        values["prnu"] = np.sqrt(np.maximum(pattern, 0.0))
    else:
        reasons["prnu"] = "lost in temporal noise: take more frames of the brighter levels"
    values_by_name: dict[str, float | tuple[float, ...]] = {n: float(x[0]) for n, x in values.items()}
    sigmas: dict[str, float | tuple[float, ...]] = {n: own_error.get(n, jackknife_sigma(x)) for n, x in values.items()}
    values_by_name["white_balance"] = (numbers.red, 1.0, numbers.blue)
    sigmas["white_balance"] = (error["red"], 0.0, error["blue"])
    if best.model.halved:
        middle = 1.0 - column["left"] - column["right"]
        left, right = max(numbers.left, 0.0), max(numbers.right, 0.0)  # noise takes absent taps below 0
        values_by_name["chroma_taps"] = (left, 1.0 - left - right, right)
        sigmas["chroma_taps"] = (error["left"], jackknife_sigma(middle), error["right"])
    share = numbers.denoise if "denoise" in column else max(-numbers.sharpen, 0.0)
    smoothing = Smoothing(share, best.model.reach_px, numbers.vertical) if share > 0.0 else None
    return ProcessedNoise(values_by_name, sigmas, reasons, best.chi2, tuple(levels), card, numbers, smoothing)


def _prnu(used: list[NoiseLevel], model: PlaneModel, numbers: PlaneParameters) -> Array | None:
    """Squared PRNU and its replicates."""
    known = [level for level in used if np.isfinite(level.spatial).all()]
    if not known:
        return None
    unit = np.array([model.pattern(level, numbers) for level in known])
    spatial = np.stack([level.spatial for level in known])
    noise = np.array([jackknife_sigma(level.spatial) for level in known])
    weights = (unit / noise) ** 2
    return np.asarray(np.sum(weights[:, None] * spatial / unit[:, None], axis=0) / weights.sum())
