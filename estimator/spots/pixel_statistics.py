"""Probability, mean and variance of pixel values after full well, converter, demosaicing and 8-bit rounding.

A code is a pixel's 8-bit value. All is in closed form or from exact sums.

* `code_law`: likelihood of the code at a pixel's own colour. Bilinear demosaicing keeps the value of a pixel behind its
  own filter, and white balance, tone curve and both roundings are a monotonic map from the converter's DN to the code.
  A code is therefore an interval [low, high) of electrons before the converter, with the probability
  Phi((high - mu) / s) - Phi((low - mu) / s), s^2 = V(mu). Rounding and clipping at both ends are in it exactly. The
  Poisson law is taken as a Gaussian.
* `mean_codes`: mean and spread of the codes of interpolated pixels, from the exact law of the converter's DN. A
  demosaiced value is the mean of 1, 2 or 4 pixels, on a lattice of 1, 1/2 or 1/4 DN. A webcam's converter and the sRGB
  curve are coarse against the noise (12.5 electrons a DN, up to 3 codes a DN), so that the code's rounding does not
  average out and smooth expansions are off by up to half a code. The sums over the lattice are done once, on nodes of
  the mean, for pixels of equal means; along the slope of a spot the variances add up to the same, V being affine.
* `cut_pixels`: pixels that the full well cuts, min(X, W) for a Gaussian X. With z = (W - mu) / s, Phi and phi of the
  normal law, and T = W - min(X, W):

    E[T] = s (z Phi(z) + phi(z)),    E[T^2] = s^2 ((z^2 + 1) Phi(z) + z phi(z)),    dE[min(X, W)] / dmu = Phi(z).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr

from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.spots.camera_codes import tone_of
from phibench.estimator.spots.raw_pixels import PixelNoise
from phibench.scenes.frames import Array

_LAW_NODES = 1024  # of the table of information, even in sign(mu) sqrt(|mu|)
_BELOW = 8.0  # square root of the electrons below 0 that a fit may try
_FAR = 6.0  # standard deviations beyond which an interval's score is that of its nearer end
_NO_CHANCE = 12.0  # standard deviations; Q(12) = 2e-33 is below the least chance that counts
_WELL_SIGMAS = 4.0  # of read noise: what is this near to saturation only says "at least"
_ROOT_2PI = np.sqrt(2.0 * np.pi)


# -- codes of a pixel's own colour -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class CodeTable:
    """Intervals of electrons, shape (3, 256): R, G, B, code; open ends are infinite.

    Attributes
    ----------
    low_e, high_e : shape (3, 256)
    """

    low_e: Array
    high_e: Array

    @property
    def middle_e(self) -> Array:
        """A value in each interval, shape (3, 256), electrons; the finite end where the other is open."""
        low = np.where(np.isfinite(self.low_e), self.low_e, self.high_e)
        return 0.5 * (low + np.where(np.isfinite(self.high_e), self.high_e, low))


def code_table(card: SensorCard) -> CodeTable:
    """Intervals of a sensor without sharpening and denoising whose colour matrix is the unit matrix.

    A code that no DN gives has the interval of the next one above that occurs.
    """
    dn = np.arange(card.top_dn + 1)
    # 1 at the last DN; below black it is negative, as the camera has it
    linear = np.asarray((dn - card.black_level_dn) / (card.top_dn - card.black_level_dn), float)
    rows = [
        _ends(np.rint(255.0 * tone_of(gain * linear, card)).astype(int), card.top_dn) for gain in card.white_balance
    ]
    low, high = ((np.array(x) - card.black_level_dn) / card.dn_per_e for x in zip(*rows, strict=True))
    well = card.saturation_e - _WELL_SIGMAS * np.sqrt(card.read_noise_e**2 + card.dsnu_e**2)
    full = high > well
    # all that are full are one code: "at least the lowest of them"
    lowest = np.min(np.where(full, low, np.inf), axis=1, keepdims=True)
    return CodeTable(np.where(full, lowest, low), np.where(full, np.inf, high))


def _ends(codes: NDArray[np.int64], top_dn: int) -> tuple[Array, Array]:
    """DN between which each of 256 codes lies, from the code of each DN, which rises."""
    there = np.unique(codes)
    # a code that no DN has is the next one's
    k = there[np.minimum(np.searchsorted(there, np.arange(256)), len(there) - 1)]
    first, last = np.searchsorted(codes, k, "left"), np.searchsorted(codes, k, "right") - 1
    return np.where(first == 0, -np.inf, first - 0.5), np.where(last == top_dn, np.inf, last + 0.5)


@dataclass(frozen=True)
class CodeLaw:
    """`PixelLaw` of codes; `x` of its methods is not looked at, the codes' intervals are.

    Attributes
    ----------
    low_e, high_e : shape (n, h, w)
    filters : shape (n, h, w)
    noise : PixelNoise
        Without the converter's rounding, which is in the intervals.
    table : shape (3, m)
        Information on nodes even in sign(mu) sqrt(|mu|) from -8, per filter.
    step : float
        Distance of the nodes, square roots of electrons.
    """

    low_e: Array
    high_e: Array
    filters: NDArray[np.int64]
    noise: PixelNoise
    table: Array
    step: float

    def rows(self, index: NDArray[np.int64]) -> CodeLaw:
        """Law of some of the spots."""
        return replace(self, low_e=self.low_e[index], high_e=self.high_e[index], filters=self.filters[index])

    def score(self, x: Array, mean: Array) -> Array:
        """Derivative of log(Phi(b) - Phi(a)) by the mean; far out that of the Gaussian at the nearer end."""
        s, by_mean = _deviation(self.noise, mean)
        a, b = (self.low_e - mean) / s, (self.high_e - mean) / s
        chance, change = _interval(a, b, s, by_mean)
        # beyond all digits the interval is its nearer end: score of a Gaussian at that place
        near = np.where(a > 0.0, a, b)
        far = (np.minimum(np.abs(a), np.abs(b)) > _FAR) & ((a > 0.0) == (b > 0.0))
        # a chance that underflows is `far`
        return np.asarray(np.where(far, near / s, change / np.maximum(chance, 1e-300)))

    def information(self, mean: Array) -> Array:
        """Sum over the codes of (dP/dmu)^2 / P, by linear interpolation in a table."""
        at = np.maximum(_BELOW + np.sign(mean) * np.sqrt(np.abs(mean)), 0.0) / self.step
        node = np.minimum(at.astype(np.int64), self.table.shape[1] - 2)
        share = np.minimum(at - node, 1.0)
        first = self.table[self.filters, node]
        return np.asarray(first + share * (self.table[self.filters, node + 1] - first))

    def misfit(self, x: Array, mean: Array) -> Array:
        """-2 log P."""
        s, _ = _deviation(self.noise, mean)
        a, b = (self.low_e - mean) / s, (self.high_e - mean) / s
        # the smaller tail of the two keeps its digits
        a, b = np.where(a > 0.0, -b, a), np.where(a > 0.0, -a, b)
        upper = log_ndtr(b)
        # log of a difference of two tails, by the larger one: neither underflows
        return np.asarray(-2.0 * (upper + np.log(np.maximum(-np.expm1(log_ndtr(a) - upper), 1e-300))))


def code_law(
    codes: NDArray[Any], filters: NDArray[np.int64], card: SensorCard, noise: PixelNoise, table: CodeTable
) -> CodeLaw:
    """Law of own-colour codes.

    Parameters
    ----------
    codes : shape (n, h, w), uint8
        Of each pixel's own colour.
    filters : shape (n, h, w), 0, 1, 2
    noise : PixelNoise
        Without rounding.
    table : CodeTable
        Of the card.
    """
    step, information = _information_table(card, noise)
    return CodeLaw(table.low_e[filters, codes], table.high_e[filters, codes], filters, noise, information, step)


@lru_cache(maxsize=8)
def _information_table(card: SensorCard, noise: PixelNoise) -> tuple[float, Array]:
    """Distance of the nodes and information on them, shape (3, m), read only; kept, because fits repeat a card."""
    # even in the root, in which shot noise is the same everywhere; fits try light beyond saturation
    root, step = np.linspace(-_BELOW, np.sqrt(1.3 * card.saturation_e), _LAW_NODES, retstep=True)
    mean, table = (np.sign(root) * root**2)[:, None], code_table(card)
    ends = zip(table.low_e, table.high_e, strict=True)
    information = np.stack([_information(low, high, mean, noise) for low, high in ends])
    information.flags.writeable = False
    return float(step), information


def _information(low: Array, high: Array, mean: Array, noise: PixelNoise) -> Array:
    """Information on the nodes `mean`, shape (m, 1), about codes with the ends `low`, `high`, shape (256,)."""
    s, by_mean = _deviation(noise, mean)
    _, once = np.unique(low, return_index=True)  # codes that do not occur repeat others
    a, b = (low[once] - mean) / s, (high[once] - mean) / s
    near, told = (a < _NO_CHANCE) & (b > -_NO_CHANCE), np.zeros(a.shape)
    by_node = (np.broadcast_to(x, a.shape)[near] for x in (s, by_mean))
    chance, change = _interval(a[near], b[near], *by_node)
    told[near] = np.where(chance > 1e-30, change**2 / np.maximum(chance, 1e-30), 0.0)
    return np.sum(told, axis=1)


def _deviation(noise: PixelNoise, mean: Array) -> tuple[Array, Array]:
    """Standard deviation and its derivative by the mean; the mean's way to 0 has no corner, within 1 electron."""
    root = np.sqrt(mean * mean + 1.0)
    # max(mean, 0) without a corner: the variance needs light that is not negative
    smooth, slope = 0.5 * (mean + root), 0.5 * (1.0 + mean / root)
    s = np.sqrt(noise.variance_e2(smooth))
    return s, slope * (1.0 + 2.0 * noise.prnu**2 * smooth) / (2.0 * s)


def _interval(a: Array, b: Array, s: Array, by_mean: Array) -> tuple[Array, Array]:
    """Phi(b) - Phi(a) and its derivative by the mean; a and b are (end - mean) / s, `by_mean` is ds/dmean."""
    # of two upper tails the difference loses its digits, of two lower ones it does not
    flip = a > 0.0
    chance = np.where(flip, ndtr(-a) - ndtr(-b), ndtr(b) - ndtr(a))
    # the ends move with the mean, and scale with s, which depends on it
    change = (_density(a) * (1.0 + _finite(a) * by_mean) - _density(b) * (1.0 + _finite(b) * by_mean)) / s
    return chance, change


def _density(x: Array) -> Array:
    return np.asarray(np.exp(-0.5 * x * x) / _ROOT_2PI)


def _finite(x: Array) -> Array:
    return np.where(np.isfinite(x), x, 0.0)


# -- codes of interpolated pixels ------------------------------------------------------------------------------------

COUNTS = (1, 2, 4)
"""Pixels in a mean."""

_TABLES = ("mean", "by_mean", "regression", "excess")
_MEAN_NODES = 400  # even in sqrt(mu)
_AT_ONCE = 4  # nodes that are worked out together
_POISSON_UP_TO_E = 300.0  # from there a Gaussian: skewness 0.06
_SIGMAS = 8.0  # of a mean: 1e-15 of its law lies beyond
_SHORT = 1000  # values of a law up to which a sum of products is quicker than Fourier's way


class MeanCodes:
    """Tables on nodes even in sqrt(mean), shape (3, 3, m): colour, one of `COUNTS`, node.

    * mean : codes
    * by_mean : codes per electron of the pixels' mean
    * regression : codes per electron: covariance of code and mean of the pixels, over the variance of the latter
    * excess : variance of the code that the regression leaves, codes squared

    A node is worked out when a mean beside it is first asked for: those of one window lie on a part of the nodes.

    Parameters
    ----------
    curve : shape (3, d), codes at every DN and the quarters between
    """

    def __init__(self, card: SensorCard, noise: PixelNoise, curve: Array) -> None:
        # as above, without dark pixels
        root, step = np.linspace(0.0, np.sqrt(1.3 * card.saturation_e), _MEAN_NODES, retstep=True)
        self._of, self._step, self._mean_e = (card, noise, curve), float(step), root**2
        self._known = range(0)
        self._tables = {name: np.zeros((3, len(COUNTS), _MEAN_NODES)) for name in _TABLES}

    def _fill(self, first: int, last: int) -> None:
        """Work out the nodes from `first` to `last`, and one beside on each side for the derivative."""
        begin, end = max(first - 1, 0), min(last + 2, _MEAN_NODES)
        known = self._known or range(begin, begin)
        if begin >= known.start and end <= known.stop:
            return
        begin = min(begin // _AT_ONCE * _AT_ONCE, known.start)
        end = max(min(-(-end // _AT_ONCE) * _AT_ONCE, _MEAN_NODES), known.stop)
        tables = self._tables
        for node in (*range(begin, known.start), *range(known.stop, end)):
            moments = _moments(float(self._mean_e[node]), *self._of)
            for name, values in zip(("mean", "regression", "excess"), moments, strict=True):
                tables[name][..., node] = values
        nodes = slice(begin, end)
        # at the ends of what is known the difference is one-sided, but of the outermost nodes these are not asked for
        tables["by_mean"][..., nodes] = np.gradient(tables["mean"][..., nodes], self._mean_e[nodes], axis=-1)
        self._known = range(begin, end)

    def at(self, name: str, mean_e: Array, which: NDArray[np.int64]) -> Array:
        """Values of one table, linear between nodes.

        Parameters
        ----------
        name : "mean", "by_mean", "regression" or "excess"
        mean_e : shape (..., p)
            Below 0 the mean goes on along its slope at 0.
        which : shape (p,), int
            Row of the table, 3 x colour + place in `COUNTS`.
        """
        (value,) = self.values((name,), mean_e, which)
        return value

    def values(self, names: Sequence[str], mean_e: Array, which: NDArray[np.int64]) -> tuple[Array, ...]:
        """Values of several tables at the same means, as `at`."""
        root = np.sqrt(np.maximum(mean_e, 0.0)) / self._step
        node = np.minimum(root.astype(np.int64), _MEAN_NODES - 2)
        if node.size:
            self._fill(int(node.min()), int(node.max()) + 1)
        share, place = np.minimum(root - node, 1.0), which * _MEAN_NODES + node

        def one(name: str) -> Array:
            table = self._tables[name].reshape(-1)
            first = table[place]
            value = first + share * (table[place + 1] - first)
            # less light than none: straight on from 0, so that a fit has a slope there
            below = self._tables["by_mean"].reshape(9, -1)[which, 0]
            return value + np.minimum(mean_e, 0.0) * below if name == "mean" else value

        return tuple(one(name) for name in names)


@lru_cache(maxsize=8)
def mean_codes(card: SensorCard, noise: PixelNoise, rounded: bool = True) -> MeanCodes:
    """Tables of a sensor whose colour matrix is the unit matrix; `noise` is without the converter's rounding.

    Codes are rounded to whole ones unless the camera goes on with finer ones.
    """
    return MeanCodes(card, noise, _codes_of_dn(replace(card, **BESIDE_CURVE), rounded))


_FINEST = COUNTS[-1]  # means of so many pixels lie on a lattice of DN on which all the others lie, too
BESIDE_CURVE: dict[str, Any] = {
    **{"name": "", "exposure_s": 0.0, "full_well_e": 0.0, "read_noise_e": 0.0, "prnu": 0.0, "dsnu_e": 0.0},
    **{"dn_per_e": 1.0, "jpeg_quality": 0},
}
"""Numbers in which cameras of one make differ, and which the codes of a DN do not depend on."""


@lru_cache(maxsize=8)
def _codes_of_dn(card: SensorCard, rounded: bool) -> Array:
    """Codes of R, G, B at every DN and the quarters between, shape (3, m), read only; kept for cameras of one make."""
    x = np.arange(_FINEST * card.top_dn + 1) / _FINEST - card.black_level_dn  # DN above black
    linear = x / (card.top_dn - card.black_level_dn)
    y = np.stack([255.0 * tone_of(gain * linear, card) for gain in card.white_balance])
    y = np.rint(y) if rounded else y
    y.flags.writeable = False
    return y


def _moments(mu: float, card: SensorCard, noise: PixelNoise, curve: Array) -> Array:
    """Mean code, regression and excess, shape (3, 3 colours, 3 counts); `curve` as of `_codes_of_dn`."""
    first, chance = _law(mu, card, noise)
    result = np.empty((3, 3, len(COUNTS)))
    for i, count in enumerate(COUNTS):
        if count > 1:
            chance = np.convolve(chance, chance) if len(chance) < _SHORT else _by_fourier(chance)
        x = first + np.arange(len(chance)) / count - card.black_level_dn  # DN above black
        p = chance / chance.sum()
        # a mean of 1, 2 or 4 pixels lies on every fourth, second or each value of the curve
        step, start = _FINEST // count, _FINEST * int(first)
        y = np.ascontiguousarray(curve[:, start : start + step * len(x) : step])
        mean = y @ p
        dx, dy = x - x @ p, y - mean[:, None]
        variance = dx**2 @ p
        covariance = dy * dx @ p
        slope = covariance / variance if variance > 0.0 else np.zeros(3)  # 0: full pixels have one DN only
        # variance of the codes that a straight line in DN does not explain
        left = dy**2 @ p - slope * covariance
        result[0, :, i], result[1, :, i], result[2, :, i] = mean, slope * card.dn_per_e, np.maximum(left, 0.0)
    return result


def _by_fourier(chance: Array) -> Array:
    return np.maximum(scipy.signal.fftconvolve(chance, chance), 0.0)


def _law(mu: float, card: SensorCard, noise: PixelNoise) -> tuple[float, Array]:
    """First DN and the chances of the DN from there on, of one pixel."""
    variance_e2 = noise.variance_e2(np.array(mu))
    spread = _SIGMAS * np.sqrt(variance_e2 + 1.0 / card.dn_per_e**2)
    ends = np.rint(card.black_level_dn + card.dn_per_e * np.array([mu - spread, mu + spread]))
    low, high = np.clip(ends, [0.0, 1.0], [card.top_dn - 1.0, card.top_dn])
    edges = (np.arange(low, high) + 0.5 - card.black_level_dn) / card.dn_per_e
    if mu > _POISSON_UP_TO_E:
        below = ndtr((edges - mu) / np.sqrt(variance_e2))
    else:
        # 12: eight sigma of few electrons are not the end of Poisson's tail
        n = np.arange(0.0, mu + 8.0 * np.sqrt(mu) + 12.0)
        # a sensor without noise: a step, not 0 / 0
        r = max(float(np.sqrt(noise.gaussian_e2 + (noise.prnu * mu) ** 2)), 1e-6)
        below = ndtr((edges[:, None] - n) / r) @ scipy.stats.poisson.pmf(n, mu)
    return float(low), np.diff(np.concatenate([[0.0], below, [1.0]]))


# -- full well -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CutPixels:
    """Pixels that the full well has cut, shapes as the means.

    Attributes
    ----------
    mean_e, variance_e2 : electrons, electrons squared
    slope : of the mean by the uncut mean, 1 far below the full well and 0 above it
    """

    mean_e: Array
    slope: Array
    variance_e2: Array


def cut_pixels(mean_e: Array, variance_e2: Array, well_e: float) -> CutPixels:
    """Cut pixels of these means and variances, any shape, at a full well."""
    s = np.sqrt(variance_e2)
    z = (well_e - mean_e) / s
    if not (z < _FAR).any():
        return CutPixels(mean_e, np.ones_like(mean_e), variance_e2)
    below, density = ndtr(z), np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    # partial moments of a Gaussian below the well; what is above reads the well itself
    lost = s * (z * below + density)
    square = variance_e2 * ((z * z + 1.0) * below + z * density)
    free = z >= _FAR
    return CutPixels(
        np.where(free, mean_e, well_e - lost),
        np.where(free, 1.0, below),
        np.where(free, variance_e2, np.maximum(square - lost * lost, 0.0)),
    )
