"""Covariances of the codes of an even field, as the camera's processing makes them from independent raw pixels.

Where light is even, all of it is linear: demosaicing, white balance, the tone curve's slope under the noise, unsharp
mask, denoising, chroma of 4:2:2. The answer of each plane to one electron at each place of the mosaic gives, times the
variance of a pixel, the autocovariance. Denoising that spares edges has the weights that `neighbour_filters` gives for
the noise that comes in.

Rounding to whole codes is exact. With x and y Gaussian codes of mean mu, variance V and covariance C, the error of
rounding is the series of sin(2 pi k x) (-1)^k / (pi k), so that the covariance of the rounded codes is

    C (1 + 4 sum_k (-1)^k cos(2 pi k mu) E(k, 0)) + sum_kl (-1)^(k + l) / (2 pi^2 k l) (
        cos(2 pi (k - l) mu) (E(k, l) exp(4 pi^2 k l C) - E(k, l)) - cos(2 pi (k + l) mu) (E(k, l) exp(-4 pi^2 k l C)
        - E(k, l))),   E(k, l) = exp(-2 pi^2 (k^2 + l^2) V),

less what the spread of the pixels' means takes from the cosines. It is 1/12 on the variance, and nothing elsewhere,
only where the noise of a pixel differs from its neighbour's by more than half a code.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from phibench.calibration.sensor_fit.noise_levels import BOX_PX, NoiseLevel, PlaneNoise, decoded_by
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.camera_codes import RGB_FROM_YCC, YCC_FROM_RGB, noisy_code
from phibench.estimator.spots.image_planes import demosaiced_planes
from phibench.scenes.frames import Array

_SIDE = 16  # of the torus: answers reach 4 pixels, lags 3
_PLACES = ((0, 0), (0, 1), (1, 0), (1, 1))
_SITES = np.array([[0, 1], [1, 2]])  # colour of each place
_TAPS = {1: (0.25, 0.5, 0.25), 2: (0.0625, 0.25, 0.375, 0.25, 0.0625)}
Spectra = NDArray[np.complex128]
_HARMONICS = np.arange(1.0, 6.0)


@dataclass(frozen=True)
class PlaneParameters:
    """Numbers that are fitted.

    Attributes
    ----------
    white_e : electrons of white
    read_noise_e : electrons
    sharpen, denoise, vertical, chroma : settings of the chain; a negative `sharpen` is denoising of 3 x 3 pixels
    red, blue : white balance, green is 1
    left, right : chroma taps beside the middle one
    """

    white_e: float = 12000.0
    read_noise_e: float = 5.0
    sharpen: float = 0.0
    denoise: float = 0.0
    vertical: float = 1.0
    chroma: float = 0.0
    red: float = 1.0
    blue: float = 1.0
    left: float = 0.25
    right: float = 0.25


@dataclass(frozen=True)
class PlaneModel:
    """Known parts of the chain.

    Parameters
    ----------
    card : SensorCard
        Converter, tone curve and output.
    reach_px : 1 or 2, of denoising
    threshold_codes : of denoising, or None
    """

    card: SensorCard
    reach_px: int = 1
    threshold_codes: float | None = None

    @property
    def halved(self) -> bool:
        """Chroma has half of the columns."""
        return self.card.output == "yuyv"

    def covariances(self, level: NoiseLevel, x: PlaneParameters) -> list[Array]:
        """Covariances of `NoiseLevel.planes`, codes^2, rounding included."""
        ycc, variances = self._answers(level, x)
        answers = ycc if self.halved else np.einsum("ij,jshw->ishw", RGB_FROM_YCC, ycc)
        main, others = (0, (1, 2)) if self.halved else (1, (0, 2))
        result = []
        for k, plane in enumerate(level.planes[:3]):
            halved = self.halved and k > 0
            at = _correlated(answers[k], answers[k], variances, halved)
            result.append(_rounded(np.array([at[r, c * (2 if halved else 1)] for r, c in plane.lags]), plane))
        for k, plane in zip(others, level.planes[3:], strict=True):
            at = _correlated(answers[k], answers[main], variances, self.halved)
            result.append(np.array([at[lag] for lag in plane.lags]))
        return result

    def lattice_errors(self, level: NoiseLevel, x: PlaneParameters) -> list[float]:
        """Relative errors of `covariances`, one deviation, by planes: the converter's codes lie on a lattice.

        Steps of the converter are s codes of 8 bits apart. Rounding beats with them at |k s - round(k s)| = f per step;
        that changes the slope from the converter to the codes by up to 2 f exp(-2 pi^2 f^2 sigma^2) / (k s), twice as
        much the variance. Other pixels that are mixed in lessen it; the shares are from simulated frames.
        """
        card, k = self.card, np.arange(1, 5)[:, None]
        linear, raw, planes = self._light(level, x)
        at = noisy_code(linear, np.sqrt(planes[:, 0]), card)
        full = card.top_dn - card.black_level_dn
        steps = 255.0 * at.by_mean * self._balance(x) / full
        beat = np.abs(k * steps - np.rint(k * steps))
        waves = 4.0 * beat / (k * steps) * np.exp(-2.0 * (np.pi * beat * full) ** 2 * raw[[0, 1, 3]])
        each = np.sqrt(0.5 * (waves**2).sum(axis=0))
        if self.halved:
            return [0.25 * float(each.max())] * len(level.planes)
        own = [0.4 * each[0], each[1], 0.4 * each[2]]
        return [*map(float, own), *[0.5 * float(each[1])] * (len(level.planes) - 3)]

    def pattern(self, level: NoiseLevel, x: PlaneParameters) -> float:
        """`NoiseLevel.spatial` of a responsivity that spreads by 1."""
        answers, _ = self._answers(level, x)
        linear, _, _ = self._light(level, x)
        light = (linear / self._balance(x))[_SITES.ravel()]
        rough = np.fft.ifft2(answers[0][:4] * (1.0 - _box())).real
        return float(0.25 * light**2 @ (rough**2).sum(axis=(1, 2)))

    def _balance(self, x: PlaneParameters) -> Array:
        return np.array([x.red, 1.0, x.blue])

    def _light(self, level: NoiseLevel, x: PlaneParameters) -> tuple[Array, Array, Array]:
        """Linear light of R, G, B, shape (3,), variance of a raw pixel, (4,), and of the planes by place, (3, 4).

        Light is full scale 1 after white balance, a raw pixel before. The mean code of noisy light is the measured one.
        """
        card, balance = self.card, self._balance(x)
        points = card.transfer_points
        wanted = np.array(level.codes)
        linear = decoded_by(card.transfer_function, wanted, points)
        spread = np.array([[np.sum(_weights(c, p) ** 2) for p in range(4)] for c in range(3)])
        raw, planes = np.zeros(4), np.zeros((3, 4))
        for _ in range(3):
            electrons = np.maximum(linear / balance, 0.0)[_SITES.ravel()] * x.white_e
            converter = (x.white_e / (card.top_dn - card.black_level_dn)) ** 2 / 12.0
            raw = (electrons + x.read_noise_e**2 + converter) / x.white_e**2
            planes = raw[[0, 1, 3]][:, None] * spread * balance[:, None] ** 2
            at = noisy_code(np.repeat(linear[:, None], 4, axis=1), np.sqrt(planes), card)
            linear = linear + (wanted - 255.0 * at.mean.mean(axis=1)) / (255.0 * at.by_mean.mean(axis=1))
        return linear, raw, planes

    def _answers(self, level: NoiseLevel, x: PlaneParameters) -> tuple[Spectra, Array]:
        """Spectra of the answers of Y', Cb, Cr, shape (3, sources, side, side), and the sources' variances.

        Sources are raw pixels at four places, and what the tone curve's bend leaves of each colour at each place.
        """
        linear, raw, planes = self._light(level, x)
        at = noisy_code(np.repeat(linear[:, None], 4, axis=1), np.sqrt(planes), self.card)
        slope = 255.0 * at.by_mean * self._balance(x)[:, None]
        gains = np.tile(slope.reshape(3, 2, 2), (1, _SIDE // 2, _SIDE // 2))
        codes, own = list(gains * _pulses()), []
        excess = np.maximum(255.0**2 * at.variance - (255.0 * at.by_mean) ** 2 * planes, 0.0)
        for colour in range(3):
            for row, column in _PLACES:
                pulse = np.zeros((3, _SIDE, _SIDE))
                pulse[colour, _SIDE // 2 + row, _SIDE // 2 + column] = 1.0
                codes.append(pulse)
                own.append(excess[colour, 2 * row + column])
        variances = np.concatenate([raw, own])
        return self._filtered(np.stack(codes), variances, x), variances

    def _filtered(self, codes: Array, variances: Array, x: PlaneParameters) -> Spectra:
        """Spectra of Y', Cb, Cr after unsharp mask, denoising and 4:2:2, shape (3, sources, side, side)."""
        limited = self.halved and self.card.ycbcr_range == "limited"
        scale = np.array([219.0, 224.0, 224.0]) / 255.0 if limited else np.ones(3)
        ycc = np.fft.fft2(np.einsum("ij,sjhw->ishw", scale[:, None] * YCC_FROM_RGB, codes))
        rest = 1.0 - _transfer(_TAPS[1], _TAPS[1])
        ycc = ycc * (1.0 + max(x.sharpen, 0.0) * rest)
        ycc[0] = ycc[0] * (1.0 + min(x.sharpen, 0.0) * rest)
        if x.denoise > 0.0:
            ycc[0] = ycc[0] * (1.0 + x.denoise * self._smoothing(ycc[0] / scale[0], variances, x))
        ycc[1:] = ycc[1:] * (1.0 - x.chroma * rest)
        if self.halved:
            ycc[1:] = ycc[1:] * _transfer((0.0, 1.0, 0.0), (x.left, 1.0 - x.left - x.right, x.right))
        return np.asarray(ycc)

    def _smoothing(self, luma: Spectra, variances: Array, x: PlaneParameters) -> Array:
        """Transfer function of the blur of Y' less 1, by the noise that comes in, shape (side, side)."""
        across = np.array(_TAPS[self.reach_px])
        alone = np.zeros(len(across))
        alone[self.reach_px] = 1.0
        down = x.vertical * across + (1.0 - x.vertical) * alone
        kernel = np.zeros((_SIDE, _SIDE))
        at = _correlated(luma, luma, variances)
        for i, row in enumerate(down):
            for j, column in enumerate(across):
                lag = (i - self.reach_px, j - self.reach_px)
                if lag == (0, 0):
                    continue
                weight = row * column
                if self.threshold_codes is not None:
                    v = 2.0 * (at[0, 0] - at[lag])
                    weight *= (1.0 + v / self.threshold_codes**2) ** -1.5
                kernel[lag] += weight
                kernel[0, 0] -= weight
        return np.asarray(np.fft.fft2(kernel).real)


def _rounded(own: Array, plane: PlaneNoise) -> Array:
    """Covariances after rounding."""
    k = _HARMONICS
    sign, total = np.where(k % 2.0 == 1.0, -1.0, 1.0), 2.0 * np.pi**2 * own[0]
    waves = sign * np.exp(-(k**2) * total) * _cosine(k, plane)
    result = own * (1.0 + 4.0 * waves.sum())
    pairs, both = np.add.outer(k**2, k**2), np.multiply.outer(k, k)
    weight = np.multiply.outer(sign, sign) / (2.0 * np.pi**2 * both)
    fade = np.exp(-2.0 * np.pi**2 * np.multiply.outer(own * 0.0 if plane.apart is None else plane.apart, both))
    less, more = _cosine(np.subtract.outer(k, k), plane), _cosine(np.add.outer(k, k), plane)
    shared = 4.0 * np.pi**2 * np.multiply.outer(own, both)
    alone = np.exp(-pairs * total)
    # exponents are added before the exponential: each alone would overflow
    same = np.exp(shared - pairs * total) * fade - alone
    opposite = np.exp(-shared - pairs * total) * fade - alone
    result = result + (weight * (less * same - more * opposite)).sum(axis=(1, 2))
    # the series' tail at lag 0
    result[0] += 1.0 / 12.0 - (1.0 / (2.0 * (np.pi * k) ** 2)).sum()
    return np.asarray(result)


def _cosine(k: Array, plane: PlaneNoise) -> Array:
    """Mean of cos 2 pi k mu over the pixels."""
    return np.asarray(np.cos(2.0 * np.pi * k * plane.mean) * np.exp(-2.0 * (np.pi * k) ** 2 * plane.spread))


def _weights(colour: int, place: int) -> Array:
    """Weights of bilinear interpolation of a colour at a place."""
    here = _SITES[place // 2, place % 2]
    if here == colour:
        return np.ones(1)
    beside = colour != 1 and here == 1
    return np.full(2 if beside else 4, 0.5 if beside else 0.25)


def _transfer(down: tuple[float, ...], across: tuple[float, ...]) -> Array:
    """Transfer function of a separable filter on the torus, complex."""
    sides = []
    for taps in (down, across):
        reach = len(taps) // 2
        kernel = np.zeros(_SIDE)
        for k, tap in enumerate(taps):
            kernel[reach - k] += tap  # the sample at n takes tap k of the pixel n + k - reach
        sides.append(np.fft.fft(kernel))
    return np.asarray(np.outer(*sides))


def _box() -> Array:
    return _transfer((1.0 / BOX_PX,) * BOX_PX, (1.0 / BOX_PX,) * BOX_PX)


def _correlated(one: Spectra, two: Spectra, variances: Array, halved: bool = False) -> Array:
    """Covariances of a sample of one plane with the other plane's pixel at each lag, by their spectra.

    Shape (side, side), mean over the places of a sample. Samples of chroma of "yuyv" lie on even columns.
    """
    weight = 0.25
    if halved:
        # of an answer times (1 + (-1)^column) / 2
        weight, one = 0.5, 0.5 * (one + np.roll(one, _SIDE // 2, axis=-1))
    spectrum = (variances[:, None, None] * np.conj(one) * two).sum(axis=0)
    return np.asarray(weight * np.fft.ifft2(spectrum).real)


@lru_cache(maxsize=1)
def _pulses() -> Array:
    """Planes of one electron at each place, shape (4, 3, side, side)."""
    planes = []
    for row, column in _PLACES:
        pulse = np.zeros((_SIDE, _SIDE))
        pulse[_SIDE // 2 + row, _SIDE // 2 + column] = 1.0
        planes.append(demosaiced_planes(pulse))
    return np.stack(planes)
